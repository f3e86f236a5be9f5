# SPDX-License-Identifier: GPL-3.0-or-later
"""NVRTC compiles the CUDA source for all current GPU generations; errors are typed, with reason."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import DeviceError
from gaussian_wrapping_addon.core.render.cuda import compiler, kernels
from gaussian_wrapping_addon.core.render.cuda.compiler import compile_text, find_nvrtc
from gaussian_wrapping_addon.core.render.cuda.kernels import KERNELS, PARTS, cuda_source
from tests.proofs import first_then_proofs

REPOSITORY = Path(__file__).resolve().parents[4]
# Turing, Ampere (data centre, consumer), Ada, Hopper, Blackwell (data centre, consumer).
CAPABILITIES = [(7, 5), (8, 0), (8, 6), (8, 9), (9, 0), (10, 0), (12, 0)]
MAX_REGISTERS_OF_TILES = 64
"""With 256 threads, at least four blocks of the raster kernels fit a multiprocessor's registers."""
MAX_SHARED_BYTES = 16384
MAX_SPILL_BYTES = 16
"""A thread's; a value or two kept in memory outside of the loops costs nothing."""


@pytest.fixture(scope="module")
def nvrtc() -> Path:
    library = find_nvrtc()
    if library is None:
        pytest.skip("no NVRTC library is installed (package nvidia-cuda-nvrtc, or a CUDA torch)")
    return library


@pytest.mark.parametrize(
    "capability", first_then_proofs(CAPABILITIES), ids=lambda c: f"sm_{c[0]}{c[1]}"
)
def test_compiles_with_sane_registers(nvrtc: Path, capability: tuple[int, int]) -> None:
    compiled = compile_text(cuda_source(), capability, nvrtc, verbose=True)
    assert compiled.image[:4] == b"\x7fELF", "machine code, not PTX"
    assert "warning" not in compiled.log
    blocks = compiled.log.split("Compiling entry function")[1:]
    entries = {re.search(r"'(\w+)'", block)[1]: block for block in blocks}  # type: ignore[index]
    assert set(entries) == set(KERNELS)
    for name, block in entries.items():
        assert int(re.search(r"(\d+) bytes spill stores", block)[1]) <= MAX_SPILL_BYTES, name  # type: ignore[index]
        registers = int(re.search(r"Used (\d+) registers", block)[1])  # type: ignore[index]
        shared = re.search(r"(\d+) bytes smem", block)
        if "tiles" in name:
            assert registers <= MAX_REGISTERS_OF_TILES, name
        assert int(shared[1] if shared else 0) <= MAX_SHARED_BYTES, name


def test_newer_gpus_get_ptx(nvrtc: Path) -> None:
    small = 'extern "C" __global__ void probe(int* out) { out[0] = 1; }'
    image = compile_text(small, (99, 9), nvrtc).image
    assert b".visible .entry probe" in image
    assert image.endswith(b"\0")


def test_errors_name_file_line_and_reason(nvrtc: Path) -> None:
    with pytest.raises(DeviceError, match=r'raster\.cu\(5\): error: identifier "nonsense"'):
        compile_text('#line 4 "raster.cu"\n__global__ void probe() {\nnonsense(); }', (8, 9), nvrtc)
    with pytest.raises(DeviceError, match=r"GPU as old as compute capability 1\.0"):
        compile_text("", (1, 0), nvrtc)


def test_a_library_that_does_not_load_is_named(tmp_path: Path) -> None:
    broken = tmp_path / "libnvrtc.so.13"
    broken.write_bytes(b"not a library")
    with pytest.raises(DeviceError, match=r"libnvrtc\.so\.13 cannot be loaded"):
        compile_text("", (8, 9), broken)


def test_the_library_of_torchs_cuda_is_preferred(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [
        "libnvrtc.so.12", "libnvrtc.so.13", "libnvrtc-builtins.so.13.5", "libnvrtc.alt.so.13",
        "nvrtc64_112_0.dll", "nvrtc64_120_0.alt.dll", "nvrtc-builtins64_133.dll",
    ]  # fmt: skip
    monkeypatch.setattr(compiler, "_library_files", lambda: [Path(name) for name in names])
    find = find_nvrtc.__wrapped__
    assert find(None) == Path("libnvrtc.so.13")
    assert find(12) == Path("libnvrtc.so.12")
    assert find(11) == Path("nvrtc64_112_0.dll")
    assert find(99) == Path("libnvrtc.so.13")
    monkeypatch.setattr(compiler, "_library_files", lambda: [])
    assert find(13) is None


def test_a_missing_driver_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(compiler.ctypes, "CDLL", absent)
    with pytest.raises(DeviceError, match=r"NVIDIA driver library \S+ was not found"):
        compiler.load_driver.__wrapped__()


def test_the_text_reaches_zip_and_wheel() -> None:
    spec = importlib.util.spec_from_file_location("build_addon", REPOSITORY / "build_addon.py")
    assert spec is not None
    assert spec.loader is not None
    build_addon = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build_addon)
    files = build_addon.package_files()
    assert {f"core/render/cuda/{part}" for part in PARTS} <= set(files)
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]
    assert patterns[kernels.__package__] == ["*.cu"]
    assert {path.name for path in Path(kernels.__file__).parent.glob("*.cu")} == set(PARTS)
