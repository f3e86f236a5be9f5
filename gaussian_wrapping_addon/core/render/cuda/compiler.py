# SPDX-License-Identifier: GPL-3.0-or-later
"""NVRTC and the CUDA driver: kernels compiled at run time and launched."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import os
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ...errors import DeviceError

# -- Load and launch kernels through the CUDA driver API (ctypes) ---------------------------------
#
# Kernels run in the device's primary context, which torch uses as well, so they can access
# torch's memory and use its streams.


_DRIVER_HINT = "Update the NVIDIA driver, or render on the CPU."


class DriverModule:
    """Compiled kernels loaded into the primary context of the GPU of torch's device index.

    Raises DeviceError if the driver is missing or fails.
    """

    def __init__(self, device_index: int, image: bytes, names: Sequence[str]) -> None:
        self._cuda = load_driver()
        device = ctypes.c_int()
        _check_driver(self._cuda, "cuDeviceGet", ctypes.byref(device), device_index)
        # Never released: torch keeps the context for the life of the process.
        self._context = ctypes.c_void_p()
        _check_driver(self._cuda, "cuDevicePrimaryCtxRetain", ctypes.byref(self._context), device)
        self._functions: dict[str, ctypes.c_void_p] = {}
        self._enter()
        try:
            module = ctypes.c_void_p()
            _check_driver(
                self._cuda, "cuModuleLoadDataEx", ctypes.byref(module), image, 0, None, None
            )
            for name in names:
                function = ctypes.c_void_p()
                _check_driver(
                    self._cuda, "cuModuleGetFunction", ctypes.byref(function), module,
                    name.encode(),
                )  # fmt: skip
                self._functions[name] = function
        finally:
            self._leave()

    def launch(
        self, name: str, blocks: int, threads: int, parameters: ctypes.Array, stream: int
    ) -> None:
        """Queue a kernel; ``parameters`` points to the values of its arguments, in order.

        Raises DeviceError if it cannot be queued; torch reports errors during execution, later.
        """
        self._enter()
        try:
            _check_driver(
                self._cuda, "cuLaunchKernel", self._functions[name],
                *(ctypes.c_uint(value) for value in (blocks, 1, 1, threads, 1, 1, 0)),
                ctypes.c_void_p(stream), parameters, None,
            )  # fmt: skip
        finally:
            self._leave()

    def _enter(self) -> None:
        # The calling thread (autograd has its own) may have another context, or none.
        _check_driver(self._cuda, "cuCtxPushCurrent_v2", self._context)

    def _leave(self) -> None:
        _check_driver(self._cuda, "cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))


@functools.cache
def load_driver() -> ctypes.CDLL:
    """Return the NVIDIA driver library, initialised; DeviceError if it is not installed."""
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        cuda = ctypes.CDLL(name)
    except OSError:
        raise DeviceError(
            f"The NVIDIA driver library {name} was not found.", _DRIVER_HINT
        ) from None
    _check_driver(cuda, "cuInit", 0)
    return cuda


def device_count() -> int:
    """Return how many GPUs the driver shows to this process; needs no torch.

    Raises DeviceError if the driver is not installed, fails, or finds no GPU.
    """
    count = ctypes.c_int()
    _check_driver(load_driver(), "cuDeviceGetCount", ctypes.byref(count))
    return count.value


def driver_cuda_version() -> str:
    """Return the newest version of CUDA that the driver supports, such as ``"13.0"``.

    Raises DeviceError if the driver is not installed or fails.
    """
    number = ctypes.c_int()
    _check_driver(load_driver(), "cuDriverGetVersion", ctypes.byref(number))
    return f"{number.value // 1000}.{number.value % 1000 // 10}"


def _check_driver(cuda: ctypes.CDLL, function: str, *arguments: object) -> None:
    result = getattr(cuda, function)(*arguments)
    if result != 0:
        description = ctypes.c_char_p()
        cuda.cuGetErrorString(result, ctypes.byref(description))
        text = (description.value or b"unknown error").decode(errors="replace")
        raise DeviceError(
            f"{function} of the NVIDIA driver failed: {text} ({result}).", _DRIVER_HINT
        )


# -- Compile CUDA C with NVRTC, the runtime compiler shipped with CUDA builds of torch ------------


_FILE_NAME = re.compile(r"libnvrtc\.so\.(\d+)(?:\.\d+)*|nvrtc64_(\d+)\d_\d\.dll")
_HINT = "Install a PyTorch with CUDA, or the package nvidia-cuda-nvrtc."
_MAX_FOLDER_DEPTH = 4


@dataclass(frozen=True)
class CompiledText:
    """Compiled code for the driver, and the compiler log."""

    image: bytes
    """Machine code of one architecture, or PTX ending in a zero byte."""
    log: str


@functools.cache
def find_nvrtc(cuda_major: int | None = None) -> Path | None:
    """Return the NVRTC library to use, or ``None`` if there is none.

    Searched in the ``nvidia`` wheels that torch depends on, in torch's own folder (Windows), and in
    the CUDA toolkit of ``CUDA_PATH`` or ``CUDA_HOME``. That of ``cuda_major``, torch's CUDA, which
    the driver is known to support, is preferred; otherwise the newest is returned.
    """
    found = []
    for path in _library_files():
        match = _FILE_NAME.fullmatch(path.name)
        if match:
            found.append((int(match[1] or match[2]), path))
    if not found:
        return None
    return max(found, key=lambda item: (item[0] == cuda_major, item[0], str(item[1])))[1]


def compile_text(
    text: str, capability: tuple[int, int], library: Path, *, verbose: bool = False
) -> CompiledText:
    """Compile CUDA C for one compute capability, such as (8, 9).

    For an architecture newer than the compiler, PTX of the newest known one is returned, which the
    driver translates. ``verbose`` logs registers, shared memory and spills of every kernel.

    Raises
    ------
    DeviceError
        If the compiler cannot be loaded, supports no architecture this old, or rejects the source;
        the message contains its log.
    """
    nvrtc = _load(library)
    wanted = capability[0] * 10 + capability[1]
    known = _architectures(nvrtc)
    usable = [number for number in known if number <= wanted]
    if not usable:
        raise DeviceError(
            f"{library.name} does not support a GPU as old as compute capability "
            f"{capability[0]}.{capability[1]}.",
            "Render on the CPU.",
        )
    exact = wanted in known
    architecture = f"--gpu-architecture={'sm' if exact else 'compute'}_{max(usable)}"
    options = ["--std=c++17", "--restrict", architecture, *["--ptxas-options=-v"] * verbose]
    program = ctypes.c_void_p()
    _check_compiler(
        nvrtc,
        nvrtc.nvrtcCreateProgram(
            ctypes.byref(program), text.encode(), b"gaussian_wrapping.cu", 0, None, None
        ),
    )
    try:
        encoded = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        result = nvrtc.nvrtcCompileProgram(program, len(options), encoded)
        log = _read(nvrtc, program, "ProgramLog").rstrip(b"\0").decode(errors="replace").strip()
        if result != 0:
            raise DeviceError(
                f"NVRTC {library.name} rejected the kernels for compute capability "
                f"{capability[0]}.{capability[1]}: {log or _error_text(nvrtc, result)}",
                "Report this message; rendering on the CPU works meanwhile.",
            )
        return CompiledText(_read(nvrtc, program, "CUBIN" if exact else "PTX"), log)
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _library_files() -> Iterable[Path]:
    folders: list[Path] = []
    for package in ("nvidia", "torch"):
        spec = importlib.util.find_spec(package)
        for location in (spec.submodule_search_locations or ()) if spec is not None else ():
            folders.append(Path(location) / "lib" if package == "torch" else Path(location))
    for variable in ("CUDA_PATH", "CUDA_HOME"):
        if os.environ.get(variable):
            folders += [Path(os.environ[variable]) / name for name in ("bin", "lib64", "lib")]
    for folder in folders:
        for location, subfolders, names in os.walk(folder):
            if len(Path(location).relative_to(folder).parts) >= _MAX_FOLDER_DEPTH:
                subfolders.clear()
            yield from (Path(location) / name for name in names if "nvrtc" in name)


@functools.cache
def _load(library: Path) -> ctypes.CDLL:
    try:
        if sys.platform == "win32":
            # Its own libraries are found there.
            with os.add_dll_directory(str(library.parent)):
                nvrtc = ctypes.CDLL(str(library))
        else:
            nvrtc = ctypes.CDLL(str(library))
    except OSError as error:
        raise DeviceError(f"{library.name} cannot be loaded: {error}.", _HINT) from None
    nvrtc.nvrtcGetErrorString.restype = ctypes.c_char_p
    return nvrtc


def _architectures(nvrtc: ctypes.CDLL) -> list[int]:
    count = ctypes.c_int()
    _check_compiler(nvrtc, nvrtc.nvrtcGetNumSupportedArchs(ctypes.byref(count)))
    numbers = (ctypes.c_int * count.value)()
    _check_compiler(nvrtc, nvrtc.nvrtcGetSupportedArchs(numbers))
    return list(numbers)


def _read(nvrtc: ctypes.CDLL, program: ctypes.c_void_p, what: str) -> bytes:
    size = ctypes.c_size_t()
    _check_compiler(nvrtc, getattr(nvrtc, f"nvrtcGet{what}Size")(program, ctypes.byref(size)))
    buffer = ctypes.create_string_buffer(size.value)
    _check_compiler(nvrtc, getattr(nvrtc, f"nvrtcGet{what}")(program, buffer))
    return buffer.raw


def _error_text(nvrtc: ctypes.CDLL, result: int) -> str:
    return str((nvrtc.nvrtcGetErrorString(result) or b"unknown error").decode())


def _check_compiler(nvrtc: ctypes.CDLL, result: int) -> None:
    if result != 0:
        raise DeviceError(f"NVRTC failed: {_error_text(nvrtc, result)}.", _HINT)
