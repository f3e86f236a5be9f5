# SPDX-License-Identifier: GPL-3.0-or-later
"""The text of all kernels, and their compiled form."""

from __future__ import annotations

import ctypes
import functools
import math
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ... import image_metrics, limits
from ...errors import DeviceError
from ..projection_kernels import CAMERA_VALUES
from ..query_kernels import BOX_END
from ..simd import FLOAT32_MAX, FRONT_SIGMAS
from .compiler import DriverModule, compile_text, find_nvrtc, load_driver

# -- CUDA C source of all kernels: the constants of the method, followed by the ``.cu`` files -----


PARTS = (
    "common.cu", "projection.cu", "projection_backward.cu", "binning.cu", "raster.cu",
    "isosurface.cu", "raster_backward.cu", "vacancy.cu", "losses.cu", "adam.cu", "query.cu",
    "multi_view.cu",
)  # fmt: skip

KERNELS = (
    "project_gaussians", "project_backward", "count_pairs", "list_pairs", "forward_tiles",
    "forward_tiles_weights", "sum_weights", "isosurface_tiles", "backward_tiles",
    "backward_tiles_depth", "backward_tiles_absolute", "backward_tiles_depth_absolute", "sum_pairs",
    "finish_params", "locate_points", "transmittance_tiles", "ssim_maps", "color_gradient",
    "agree_normals", "gather_depth", "prior_depths", "adam_rows", "project_finely", "bound_points",
    "count_areas", "list_areas", "solve_points", "query_gradients", "position_gradients",
    "grey_pixels", "measure_pixels", "pick_pixels", "lift_points", "return_points",
    "compare_patches", "finish_pixels",
)  # fmt: skip
"""Names of the kernels (entry points)."""

THREADS_PER_BLOCK = 256

_SINGLE = {
    "ALPHA_MIN": limits.ALPHA_MIN, "ALPHA_MAX": limits.ALPHA_MAX,
    "TRANSMITTANCE_MIN": limits.TRANSMITTANCE_MIN, "ISO_LEVEL": limits.ISO_LEVEL,
    "DENOMINATOR_MIN": limits.DENOMINATOR_MIN, "FRONT_SIGMAS": float(FRONT_SIGMAS),
    "SLOPE_FLOOR": limits.SLOPE_FLOOR, "TINY": 1e-30, "FARTHEST": 3e38,
    "FLOAT32_LARGE": 3.0e38,  # every smaller magnitude is a usable float32
    # Ellipses above this half width take every row of their box: rows are narrowed in float32,
    # whose rounding at this size stays a tenth of the margin.
    "NARROW_PX": 2048.0,
    "NARROW_MARGIN": 0.05,
    # As in query_kernels.py, where they are explained.
    "NEGLIGIBLE": 30.0,
    "FALL_END": 22.4,
    "SOLVER_STEP_SIGMAS": 5e-4,
    "SOLVER_LEVEL_MARGIN": 3e-7,  # as in isosurface.py
    "SOLVER_BRACKET_SHARE": 1.25e-7, "SOLVER_LEAST_SHARE": 1.25e-7, "SOLVER_POLISH_SIGMAS": 3e-3,
    "SOLVER_LEVEL_FAR": 0.05, "SOLVER_FLAT": 0.02, "SOLVER_LEAST_SLOPE": 1e-12,
    "FLOAT_MARGIN": 4e-6,  # as in query_kernels.py
    # As in core/field/vacancy_kernels.py.
    "FACTOR_MIN": 1e-7,
    "TRANSMITTANCE_LOST": 1e-4,
    **{f"SSIM_W{tap}": weight for tap, weight in enumerate(image_metrics.WEIGHTS[:6])},
    "SSIM_C1": image_metrics.C1,
    "SSIM_C2": image_metrics.C2,
    # As in core/training: losses.py, adam.py.
    "MIN_NORMAL_SQ": 1e-30,
    "ADAM_BETA1": 0.9,
    "ADAM_BETA2": 0.999,
    "ADAM_EPSILON": 1e-15,
}  # fmt: skip
_DOUBLE = {
    "ALPHA_MIN_WIDE": limits.ALPHA_MIN, "QUATERNION_MIN_NORM": limits.QUATERNION_MIN_NORM,
    "DIRECTION_MIN_NORM": limits.DIRECTION_MIN_NORM, "FINITE_OFFSET_PX": limits.FINITE_OFFSET_PX,
    "FINITE_NUM": limits.FINITE_NUM, "FINITE_DEN": limits.FINITE_DEN,
    "FINITE_SPREAD": limits.FINITE_SPREAD, "FINITE_PULL": limits.FINITE_PULL,
    "FINITE_Z_MIN": limits.FINITE_Z_MIN, "FINITE_Z_MAX": limits.FINITE_Z_MAX,
    "FINITE_SIGMA_Z": limits.FINITE_SIGMA_Z, "FINITE_COLOR": limits.FINITE_COLOR,
    "FLOAT32_MAX": FLOAT32_MAX,
    # As in projection.py.
    "GRADIENT_MAX": 1e38,
    "BASIS_MAX": 3.0,
    # As in projection_kernels.py and tile_kernels.py.
    "PLANE_MARGIN": 1e-12,
    # As in core/training/losses.py.
    "PRIOR_TOLERANCE": 0.01,
    "PRIOR_OUTLIER": 0.03,
    "FLOAT32_STEP": 2.0**-23,
    "FARTHEST_PX": 1.0e9,
    "SHARE_MARGIN": 1e-6,
    "STRIP_MARGIN": 0.02,
    # As in query_kernels.py.
    "BOX_END": BOX_END, "PATCH_STEP_PX": limits.PATCH_STEP_PX, "MAX_NOISE_PX": limits.MAX_NOISE_PX,
    "MIN_NOISE_PX": limits.MIN_NOISE_PX, "SPREAD_PRODUCT": limits.SPREAD_PRODUCT,
    "MAX_PATCH_ERROR": limits.MAX_PATCH_ERROR, "MIN_PLANE_NORMAL": limits.MIN_PLANE_NORMAL,
    "MIN_PLANE_FACING": limits.MIN_PLANE_FACING,
    "SH_C0": 0.5 / math.sqrt(math.pi), "SH_C1": math.sqrt(3.0 / (4.0 * math.pi)),
    "SH_C2A": math.sqrt(15.0 / (4.0 * math.pi)), "SH_C2B": math.sqrt(5.0 / (16.0 * math.pi)),
    "SH_C2C": math.sqrt(15.0 / (16.0 * math.pi)), "SH_C3A": math.sqrt(35.0 / (32.0 * math.pi)),
    "SH_C3B": math.sqrt(105.0 / (4.0 * math.pi)), "SH_C3C": math.sqrt(21.0 / (32.0 * math.pi)),
    "SH_C3D": math.sqrt(7.0 / (16.0 * math.pi)), "SH_C3E": math.sqrt(105.0 / (16.0 * math.pi)),
}  # fmt: skip
_INTEGER = {
    "TILE": limits.TILE_PX, "SOLVER_NEWTON_STEPS": 8, "SOLVER_MAX_STEPS": 80,
    "HALF_PATCH": limits.HALF_PATCH, "PATCH_SKIPPED": limits.PATCH_SKIPPED,
    "PATCH_KEPT": limits.PATCH_KEPT, "PATCH_BROKEN": limits.PATCH_BROKEN,
}  # fmt: skip


@functools.cache
def cuda_source() -> str:
    """Return the whole source; compiler errors name the file and line of each part."""
    folder = Path(__file__).resolve().parent
    lines = [f"#define {name} {value}" for name, value in _INTEGER.items()]
    lines += [f"#define {name} {value!r}" for name, value in _DOUBLE.items()]
    lines += [f"#define {name} {value!r}f" for name, value in _SINGLE.items()]
    lines.append("#define INFINITE __int_as_float(0x7f800000)")
    for part in PARTS:
        lines += [f'#line 1 "{part}"', (folder / part).read_text(encoding="utf-8")]
    return "\n".join(lines)


# -- Launch CUDA kernels by name with torch tensors as arguments; check CUDA availability ---------


class CameraValues(ctypes.Structure):
    """A packed camera, passed to kernels by value."""

    _fields_ = [("v", ctypes.c_double * CAMERA_VALUES)]

    @classmethod
    def of(cls, packed: np.ndarray) -> CameraValues:
        """Copy what ``pack_camera`` returned."""
        return cls.from_buffer_copy(np.ascontiguousarray(packed, np.float64).tobytes())


Argument = Tensor | int | float | CameraValues | ctypes.c_double


class Kernels(ABC):
    """Runs the kernels of the CUDA source on tensors of one device."""

    def launch(self, name: str, blocks: int, *arguments: Argument) -> None:
        """Run a kernel with :data:`THREADS_PER_BLOCK` threads per block; 0 blocks do nothing.

        Tensors must be contiguous and are passed by address; integers are passed as ``int``, other
        numbers as ``float``, but a ``c_double`` as ``double``.
        """
        if blocks == 0:
            return
        values = [_value(argument) for argument in arguments]
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        self._run(name, blocks, pointers)

    def launch_each(self, name: str, count: int, *arguments: Argument) -> None:
        """Run a kernel with one thread per item; ``count`` is its first argument."""
        self.launch(name, -(-count // THREADS_PER_BLOCK), count, *arguments)

    @abstractmethod
    def _run(self, name: str, blocks: int, parameters: ctypes.Array) -> None: ...


class DeviceKernels(Kernels):
    """The kernels, compiled for and run on one GPU."""

    def __init__(self, device_index: int) -> None:
        library = nvrtc_of_torch()
        if library is None:
            raise DeviceError("No NVRTC library was found.", _NO_NVRTC_HINT)
        capability = torch.cuda.get_device_capability(device_index)
        compiled = compile_text(cuda_source(), capability, library)
        self._device_index = device_index
        self._module = DriverModule(device_index, compiled.image, KERNELS)

    def _run(self, name: str, blocks: int, parameters: ctypes.Array) -> None:
        stream = torch.cuda.current_stream(self._device_index).cuda_stream
        self._module.launch(name, blocks, THREADS_PER_BLOCK, parameters, stream)


_NO_NVRTC_HINT = "Install the package nvidia-cuda-nvrtc of torch's CUDA version."


@functools.cache
def device_kernels(device_index: int) -> DeviceKernels:
    """Return the kernels of a GPU, compiled on the first call of the process.

    Raises DeviceError if the compiler or the driver is missing or fails.
    """
    return DeviceKernels(device_index)


def cuda_available(device_index: int | None = None) -> tuple[bool, str]:
    """Return whether the renderer can run on a GPU, by default torch's current one, and why."""
    if torch.version.cuda is None:
        return False, "This PyTorch was built without CUDA."
    if not torch.cuda.is_available():
        return False, "PyTorch finds no CUDA device, or the driver is too old for it."
    library = nvrtc_of_torch()
    if library is None:
        return False, f"No NVRTC library was found. {_NO_NVRTC_HINT}"
    try:
        load_driver()
    except DeviceError as error:
        return False, str(error)
    count = torch.cuda.device_count()
    if device_index is not None and device_index >= count:
        return False, f"There is no GPU {device_index}: PyTorch finds {count}, counted from 0."
    name = torch.cuda.get_device_name(device_index)
    return True, f"{name}, kernels compiled by {library.name}."


def nvrtc_of_torch() -> Path | None:
    """Return the NVRTC library for torch's version of CUDA; ``None`` where there is none."""
    return find_nvrtc(int(torch.version.cuda.split(".")[0]) if torch.version.cuda else None)


def _value(argument: Argument) -> ctypes._SimpleCData | ctypes.Structure:
    if isinstance(argument, Tensor):
        assert argument.is_contiguous()
        return ctypes.c_void_p(argument.data_ptr())
    if isinstance(argument, (CameraValues, ctypes.c_double)):
        return argument
    if isinstance(argument, (int, np.integer)):
        return ctypes.c_int(int(argument))
    return ctypes.c_float(argument)
