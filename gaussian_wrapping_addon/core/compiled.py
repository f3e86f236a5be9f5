# SPDX-License-Identifier: GPL-3.0-or-later
"""The one decorator for numba kernels: flags, on-disk cache, and life without a cache."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numba

_logger = logging.getLogger(__name__)

# Everything except what would let NaN tests be folded away in code that relies on them.
FAST_MATH = {"nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"}
# Fused multiply-adds and nothing else: NaN tests and the order of operations stand.
FUSED_MATH = {"contract"}


def kernel(*, fast: bool, fused: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function on first call, with the GIL released.

    Parameters
    ----------
    fast : bool
        Allow reassociation and fused operations (float32 raster loops). Geometry that needs exact
        comparisons passes ``False``.
    fused : bool
        With ``fast=False``: let a product and a sum become one fused operation.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        options: dict[str, Any] = {
            "nogil": True,
            "error_model": "numpy",
            "boundscheck": False,
            "fastmath": FAST_MATH if fast else (FUSED_MATH if fused else False),
        }
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:
            # numba raises here, at decoration, when no cache folder is writable.
            _logger.warning("No writable kernel cache: kernels are compiled anew in each run")
            return numba.njit(**options)(function)

    return decorate


def inline(function: Callable[..., Any]) -> Any:
    """Compile a small helper that is inlined into every kernel that calls it."""
    return numba.njit(inline="always", error_model="numpy", fastmath=FAST_MATH)(function)
