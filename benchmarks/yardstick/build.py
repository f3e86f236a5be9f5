# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiles the C++ yardstick with the compilers this machine has, and calls it on a view."""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import llvmlite.binding
import numpy as np

from gaussian_wrapping_addon.core.kernels.parallel import even_bounds, run_chunks
from gaussian_wrapping_addon.core.render.raster.blend import Images, RenderBuffers, ScreenView

SOURCE = Path(__file__).with_name("raster.cpp")
_CACHE = Path(__file__).resolve().parents[2] / ".cache" / "yardstick"
_FLAGS = ("-O3", "-ffast-math", "-std=c++17", "-fPIC", "-w")
# Linked apart: linking with -ffast-math adds start-up code that makes the whole process flush
# denormal numbers to 0.
_LINK_FLAGS = ("-shared",)
_TIMEOUT_S = 300
_VALUES = 24
NO_COMPILER = (
    "No C++ compiler was found (ziglang of requirements-benchmarks.txt, clang++ or g++ on the "
    "PATH), so the rows of the C++ yardstick are left out."
)


@dataclasses.dataclass(frozen=True)
class InstructionSet:
    """What a yardstick is compiled for."""

    name: str
    march: str
    lanes: int


AVX512 = InstructionSet("AVX-512", "x86-64-v4", 16)
AVX2 = InstructionSet("AVX2", "x86-64-v3", 8)
NATIVE = InstructionSet("native", "native", 8)


def host_instruction_sets() -> list[InstructionSet]:
    """Return the instruction sets of this machine that the kernels have variants for, best first.

    The first is what the kernels are compiled for when nothing else is asked for.
    """
    features = llvmlite.binding.get_host_cpu_features()
    if features.get("avx512f") and features.get("avx512dq") and features.get("avx512vl"):
        return [AVX512, AVX2]
    return [AVX2] if features.get("avx2") and features.get("fma") else [NATIVE]


@dataclasses.dataclass(frozen=True)
class Compiler:
    """One C++ compiler of this machine."""

    name: str
    command: tuple[str, ...]

    @functools.cached_property
    def version(self) -> str:
        """First line of what it says about itself."""
        done = subprocess.run(
            [*self.command, "--version"], capture_output=True, text=True, timeout=_TIMEOUT_S
        )
        return (done.stdout or done.stderr).splitlines()[0].strip()


def compilers() -> list[Compiler]:
    """Return clang, from the ziglang package or the PATH, and g++, as far as they exist."""
    found = []
    if importlib.util.find_spec("ziglang"):
        found.append(Compiler("clang", (sys.executable, "-m", "ziglang", "c++")))
    elif clang := shutil.which("clang++"):
        found.append(Compiler("clang", (clang,)))
    gcc = shutil.which("g++")
    # On macOS g++ is another name of clang.
    if gcc and "clang" not in Compiler("g++", (gcc,)).version:
        found.append(Compiler("g++", (gcc,)))
    return found


def build(compiler: Compiler, instructions: InstructionSet, cache: Path = _CACHE) -> Path:
    """Return the library compiled from ``raster.cpp``, from the cache if nothing has changed.

    Raises
    ------
    RuntimeError
        With the compiler's message, if it fails.
    """
    march = instructions.march
    if "ziglang" in compiler.command:
        march = march.replace("-", "_")
    flags = [*_FLAGS, f"-march={march}", f"-DLANES={instructions.lanes}"]
    key = hashlib.sha256()
    key.update(SOURCE.read_bytes())
    key.update("\0".join([*compiler.command, compiler.version, *flags, *_LINK_FLAGS]).encode())
    library = cache / f"raster-{key.hexdigest()[:16]}.so"
    if library.exists():
        return library
    cache.mkdir(parents=True, exist_ok=True)
    fresh = library.with_name(f"{library.name}.{os.getpid()}")
    compiled = fresh.with_suffix(".o")
    for arguments in (
        [*flags, "-c", "-o", str(compiled), str(SOURCE)],
        [*_LINK_FLAGS, "-o", str(fresh), str(compiled)],
    ):
        done = subprocess.run(
            [*compiler.command, *arguments], capture_output=True, text=True, timeout=_TIMEOUT_S
        )
        if done.returncode:
            raise RuntimeError(
                f"{compiler.name} cannot compile {SOURCE.name}:\n{done.stderr[-2000:]}"
            )
    compiled.unlink()
    os.replace(fresh, library)
    return library


def _address(array: np.ndarray) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


class Yardstick:
    """The compiled C++ rasterizer: :func:`blend` and :func:`blend_backward` without depth."""

    def __init__(self, compiler: Compiler, instructions: InstructionSet) -> None:
        self.name = f"C++ {compiler.name} {instructions.name}"
        self.compiler, self.instructions = compiler, instructions
        self._library = ctypes.CDLL(str(build(compiler, instructions)))
        # What is measured beside it would not be itself any more.
        assert np.nextafter(np.zeros(1), 1.0)[0] * 0.5 + 1e-310 > 0.0, "denormals are flushed to 0"

    def blend(self, view: ScreenView, rows: np.ndarray, images: Images) -> None:
        """Fill colour, normals and alpha of ``images``; ``rows (pairs, 2) uint8`` are what each
        pair's ellipse reaches (:func:`~benchmarks.evaluations.reached_rows`)."""
        background = np.asarray(view.options.background, np.float32)
        shared = self._shared(view, rows, with_slots=False)
        outputs = [
            _address(image)
            for image in (images.color, images.normal, images.geometric, images.alpha)
        ]

        def run(first: int, end: int) -> None:
            self._library.forward(
                *map(ctypes.c_int64, (first, end)), *shared, _address(background), *outputs
            )

        run_chunks(run, view.bounds, view.threads)

    def blend_backward(
        self,
        view: ScreenView,
        rows: np.ndarray,
        images: Images,
        grads: list[np.ndarray],
        buffers: RenderBuffers,
    ) -> np.ndarray:
        """Return the gradient on params (n, 24); ``grads`` as the kernels take them."""
        lists = view.lists
        intersections = buffers.take_intersections(len(lists.gaussian_ids))
        shared = self._shared(view, rows, with_slots=True)
        arrays = [
            images.color,
            images.normal,
            images.geometric,
            images.alpha,
            *grads[:4],
            intersections,
        ]
        arguments = [_address(array) for array in arrays]

        def run(first: int, end: int) -> None:
            self._library.backward(*map(ctypes.c_int64, (first, end)), *shared, *arguments)

        run_chunks(run, view.bounds, view.threads)
        gradients = np.zeros((len(view.screen), _VALUES), np.float32)
        sums = [_address(a) for a in (intersections, lists.intersection_offsets, gradients)]

        def combine(first: int, end: int) -> None:
            self._library.sum_pairs(*map(ctypes.c_int64, (first, end)), *sums)

        run_chunks(combine, even_bounds(len(view.screen), view.threads), view.threads)
        buffers.intersections.append(intersections)
        return gradients

    @staticmethod
    def _shared(view: ScreenView, rows: np.ndarray, *, with_slots: bool) -> list[object]:
        """Return the arguments from params to the image's height."""
        lists = view.lists
        assert rows.dtype == np.uint8
        assert rows.shape == (len(lists.gaussian_ids), 2)
        arrays = [view.screen.params, lists.start, lists.gaussian_ids]
        arrays += [lists.intersection_slots] if with_slots else []
        arrays += [lists.pixel_ranges, rows]
        sizes = (lists.tiles_x, view.camera.width, view.camera.height)
        return [*map(_address, arrays), *map(ctypes.c_int64, sizes)]


def yardsticks(instructions: InstructionSet) -> list[Yardstick]:
    """Return the yardsticks of all compilers of this machine; empty where there is none."""
    return [Yardstick(compiler, instructions) for compiler in compilers()]
