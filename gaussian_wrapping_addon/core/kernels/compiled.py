# SPDX-License-Identifier: GPL-3.0-or-later
"""Decorators for numba kernels: compiler flags and the on-disk cache."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

from .kernel_cache import KernelCache, warn_without_cache

# Everything except what would let NaN tests be folded away in code that relies on them.
FAST_MATH = {"nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"}
# Fused multiply-adds only: NaN tests and the order of operations are preserved.
FUSED_MATH = {"contract"}


def kernel(*, fast: bool, fused: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function on first call, with the GIL released.

    Kernels are called from Python and never call one another: see :func:`part`.

    Parameters
    ----------
    fast : bool
        Allow reassociation and fused operations (float32 raster loops). ``False`` for geometry that
        needs exact comparisons.
    fused : bool
        With ``fast=False``: allow fused multiply-adds.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        compiled = numba.njit(nogil=True, **_options(fast, fused))(function)
        try:
            compiled._cache = KernelCache(function)  # as njit(cache=True) does with its own
        except RuntimeError:
            warn_without_cache("no cache folder is writable")
        return compiled

    return decorate


def is_ready(compiled: Any) -> bool:
    """Return whether a kernel was called or is in the cache, so that a call does not compile it."""
    if compiled.signatures:
        return True
    cache = compiled._cache
    return isinstance(cache, KernelCache) and not cache.is_empty()


def part(*, fast: bool, fused: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator for a large helper of kernels: compiled alone, then inlined into each.

    It is optimised before its caller, so that long loops are vectorised which LLVM would not
    recognise amid the caller's other arrays; parameters are those of :func:`kernel`. Kernels called
    by kernels would round differently from run to run: LLVM puts a copy, optimised once more, into
    each caller's machine code under the same name, and which copy all callers use depends on what
    was compiled or loaded first in the process. A part leaves no callable function behind and is
    never loaded from the cache itself.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        return numba.njit(forceinline=True, **_options(fast, fused))(function)

    return decorate


def _options(fast: bool, fused: bool) -> dict[str, Any]:
    return {
        "error_model": "numpy",
        "boundscheck": False,
        "fastmath": FAST_MATH if fast else (FUSED_MATH if fused else False),
    }


def inline(function: Callable[..., Any]) -> Any:
    """Compile a small helper that is inlined into every kernel calling it."""
    return numba.njit(inline="always", error_model="numpy", fastmath=FAST_MATH)(function)
