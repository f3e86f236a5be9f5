# SPDX-License-Identifier: GPL-3.0-or-later
"""CUDA kernels emulated on the host: compiled by g++ with ``emulator.cpp``, run on CPU tensors."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.render.cuda.kernels import KERNELS, Kernels, cuda_source

# No fused operations but those the text asks for; setjmp switches stacks, which fortified libc
# functions refuse.
FLAGS = ("-std=c++17", "-O2", "-march=native", "-ffp-contract=off", "-U_FORTIFY_SOURCE",
         "-fPIC", "-shared", "-Wall", "-Wno-unknown-pragmas", "-Wno-unused-function")  # fmt: skip


class EmulatedKernels(Kernels):
    """Kernels of a compiled emulator library.

    Parameters
    ----------
    library : Path
    backwards : bool
        Run the threads of a block in the opposite order.
    ulp : float
        Error of the hardware's approximate exp and quotient, in shares of the documented bound.
    """

    def __init__(self, library: Path, *, backwards: bool = False, ulp: float = 0.0) -> None:
        self._emulate = ctypes.CDLL(str(library)).emulate
        self._backwards, self._ulp = int(backwards), ctypes.c_float(ulp)

    def _run(self, name: str, blocks: int, parameters: ctypes.Array) -> None:
        result = self._emulate(name.encode(), blocks, parameters, self._backwards, self._ulp)
        assert result == 0, f"{name}: {('', 'no such kernel', 'the threads wait for ever')[result]}"


def build_emulator(folder: Path, text: str | None = None, names: tuple[str, ...] = KERNELS) -> Path:
    """Compile the emulator into a folder; skip the test where there is no g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed; it compiles the CUDA text for the host")
    (folder / "text.cu").write_text(text or cuda_source(), encoding="utf-8")
    (folder / "table.inc").write_text("".join(f"KERNEL({name})\n" for name in names))
    library = folder / "emulator.so"
    source = Path(__file__).with_name("emulator.cpp")
    done = subprocess.run(
        [compiler, *FLAGS, f'-DKERNEL_TEXT="{folder}/text.cu"',
         f'-DKERNEL_TABLE="{folder}/table.inc"', str(source), "-o", str(library)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return library
