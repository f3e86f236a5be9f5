# SPDX-License-Identifier: GPL-3.0-or-later
"""The decorators for numba kernels: flags, on-disk cache, and life without a cache."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

from .kernel_cache import KernelCache, warn_without_cache

# Everything except what would let NaN tests be folded away in code that relies on them.
FAST_MATH = {"nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"}
# Fused multiply-adds and nothing else: NaN tests and the order of operations stand.
FUSED_MATH = {"contract"}


def kernel(*, fast: bool, fused: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function on first call, with the GIL released.

    Kernels are called from Python and call one another never: see :func:`part`.

    Parameters
    ----------
    fast : bool
        Allow reassociation and fused operations (float32 raster loops). Geometry that needs exact
        comparisons passes ``False``.
    fused : bool
        With ``fast=False``: let a product and a sum become one fused operation.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        compiled = numba.njit(nogil=True, **_options(fast, fused))(function)
        try:
            compiled._cache = KernelCache(function)  # what njit(cache=True) does with its own
        except RuntimeError:
            warn_without_cache("no folder for them can be written")
        return compiled

    return decorate


def is_ready(compiled: Any) -> bool:
    """Tell whether calling a kernel will not compile it: it was called, or lies in the cache."""
    if compiled.signatures:
        return True
    cache = compiled._cache
    return isinstance(cache, KernelCache) and not cache.is_empty()


def part(*, fast: bool, fused: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator for a large helper of kernels: compiled alone, then inlined into each.

    Optimised before its caller is, which keeps long loops packed that LLVM would not recognise
    amid the caller's other arrays; parameters are those of :func:`kernel`. A kernel that was called
    by kernels would round differently from run to run. LLVM puts a copy of it, optimised once more,
    into each caller's machine code, under the same name; which of the copies all callers then
    reach depends on what was compiled or loaded first in the process. A part leaves no function
    behind that could be called, and is never taken from the cache itself.
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
    """Compile a small helper that is inlined into every kernel that calls it."""
    return numba.njit(inline="always", error_model="numpy", fastmath=FAST_MATH)(function)
