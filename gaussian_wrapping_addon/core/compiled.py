# SPDX-License-Identifier: GPL-3.0-or-later
"""Numba kernels: compiler flags, and their cache on disk."""

from __future__ import annotations

import functools
import hashlib
import logging
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

# -- On-disk cache of compiled kernels, invalidated by changes of any imported source file --------
#
# numba stores the machine code of a kernel in the first writable folder of ``NUMBA_CACHE_DIR``,
# ``__pycache__`` beside the kernel's file and the user's cache folder. By default it recompiles
# only if the kernel's own file has changed. Helpers and constants of other files are compiled
# into a kernel too, so here a kernel is stale as soon as any file changes that its file imports,
# directly or indirectly. numba itself distinguishes processors, Python versions and its own
# versions.


_logger = logging.getLogger(__name__)

_ROOT = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(r"^[ \t]*from (\.+)([\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
_COMMENT = re.compile(r"#[^\n]*")


@functools.cache
def _source(path: Path) -> bytes:
    return path.read_bytes()


@functools.cache
def _imported(path: Path) -> frozenset[Path]:
    """Return the package's files that a file imports directly (relative imports only)."""
    return frozenset(p for p in _named(path) if p.is_file() and p.is_relative_to(_ROOT))


def _named(path: Path) -> Iterator[Path]:
    for dots, module, names in _IMPORT.findall(_source(path).decode()):
        folder = path.parents[len(dots) - 1].joinpath(*filter(None, module.split(".")))
        yield folder.with_suffix(".py")
        yield folder / "__init__.py"
        for name in _COMMENT.sub("", names).strip("()").split(","):
            if name.strip():
                yield folder / f"{name.split()[0]}.py"


@functools.cache
def source_stamp(path: Path) -> str:
    """Return a hash of a file of the package and of all files that it imports, transitively.

    Files are read once per process: later changes need a new process, as for Python modules.
    """
    found, waiting = {path}, [path]
    while waiting:
        news = _imported(waiting.pop()) - found
        found |= news
        waiting += news
    state = hashlib.sha256()
    for one in sorted(found):
        state.update(hashlib.sha256(_source(one)).digest())
    return state.hexdigest()


class _ImportStamp:
    """A cache locator that uses :func:`source_stamp` as its source stamp."""

    _py_file: str

    def get_source_stamp(self) -> str:
        """Return the stamp that numba compares with the one stored with the machine code."""
        return source_stamp(Path(self._py_file).resolve())


class _ChosenFolder(_ImportStamp, caching.UserProvidedCacheLocator):
    """``NUMBA_CACHE_DIR``."""


class _BesideSource(_ImportStamp, caching.InTreeCacheLocator):
    """``__pycache__`` beside the kernel's file."""


class _UserFolder(_ImportStamp, caching.UserWideCacheLocator):
    """The user's cache folder."""


class _CacheLocators(caching.CompileResultCacheImpl):
    """The locators in order; raises ``RuntimeError`` if none is writable."""

    _locator_classes = [_ChosenFolder, _BesideSource, _UserFolder]  # noqa: RUF012 - as its base


class KernelCache(caching.FunctionCache):
    """The cache of one kernel; if it becomes unreadable or unwritable, kernels work without it."""

    _impl_class = _CacheLocators

    def is_empty(self) -> bool:
        """Return whether no machine code is stored for the current sources."""
        try:
            return not self._cache_file._load_index()
        except Exception as error:  # as in load_overload: it will be recompiled
            warn_without_cache(f"{type(error).__name__}: {error}")
            return True

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return stored machine code, or ``None``."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # unpickling a damaged file can raise anything
            warn_without_cache(f"{type(error).__name__}: {error}")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store newly compiled machine code."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            warn_without_cache(f"{type(error).__name__}: {error}")


_warned = threading.Event()


def warn_without_cache(reason: str) -> None:
    """Warn once per process that kernels are not cached."""
    if _warned.is_set():
        return
    _warned.set()
    _logger.warning(
        "Compiled kernels cannot be cached on disk, so each run recompiles them (about a minute): "
        "%s. Set NUMBA_CACHE_DIR to a writable folder.",
        reason,
    )


# -- Decorators for numba kernels: compiler flags and the on-disk cache ---------------------------


# Everything except what would let NaN tests be folded away in code that relies on them.
FAST_MATH = {"nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"}
# Fused multiply-adds only: NaN tests and the order of operations are preserved.
FUSED_MATH = {"contract"}


def kernel(*, fast: bool, fused: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function on first call, with the GIL released.

    Kernels are called from Python and never call one another: see :func:`part`. ``fast`` allows
    reassociation and fused operations (float32 raster loops); without it, for geometry that needs
    exact comparisons, ``fused`` allows fused multiply-adds.
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
