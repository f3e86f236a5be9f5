# SPDX-License-Identifier: GPL-3.0-or-later
"""CUDA C source of all kernels: the constants of the method, followed by the ``.cu`` files."""

from __future__ import annotations

import functools
import math
from pathlib import Path

from ... import tolerances
from ...imaging import ssim_kernels
from ..query.fine_screen import BOX_END
from ..simd.raster_math import FLOAT32_MAX, FRONT_SIGMAS

PARTS = (
    "common.cu",
    "projection.cu",
    "projection_backward.cu",
    "binning.cu",
    "raster.cu",
    "isosurface.cu",
    "raster_backward.cu",
    "vacancy.cu",
    "losses.cu",
    "adam.cu",
    "query.cu",
    "multi_view.cu",
)

KERNELS = (
    "project_gaussians",
    "project_backward",
    "count_pairs",
    "list_pairs",
    "forward_tiles",
    "forward_tiles_weights",
    "sum_weights",
    "isosurface_tiles",
    "backward_tiles",
    "backward_tiles_depth",
    "backward_tiles_absolute",
    "backward_tiles_depth_absolute",
    "sum_pairs",
    "finish_params",
    "locate_points",
    "transmittance_tiles",
    "ssim_maps",
    "color_gradient",
    "agree_normals",
    "gather_depth",
    "prior_depths",
    "adam_rows",
    "project_finely",
    "bound_points",
    "count_areas",
    "list_areas",
    "solve_points",
    "query_gradients",
    "position_gradients",
    "grey_pixels",
    "measure_pixels",
    "pick_pixels",
    "lift_points",
    "return_points",
    "compare_patches",
    "finish_pixels",
)
"""Names of the kernels (entry points)."""

THREADS_PER_BLOCK = 256

_SINGLE = {
    "ALPHA_MIN": tolerances.ALPHA_MIN,
    "ALPHA_MAX": tolerances.ALPHA_MAX,
    "TRANSMITTANCE_MIN": tolerances.TRANSMITTANCE_MIN,
    "ISO_LEVEL": tolerances.ISO_LEVEL,
    "DENOMINATOR_MIN": tolerances.DENOMINATOR_MIN,
    "FRONT_SIGMAS": float(FRONT_SIGMAS),
    "SLOPE_FLOOR": tolerances.SLOPE_FLOOR,
    "TINY": 1e-30,
    "FARTHEST": 3e38,
    "FLOAT32_LARGE": 3.0e38,  # every smaller magnitude is a usable float32
    # Ellipses above this half width take every row of their box: rows are narrowed in float32,
    # whose rounding at this size stays a tenth of the margin.
    "NARROW_PX": 2048.0,
    "NARROW_MARGIN": 0.05,
    # As in ray_solver.py, where they are explained.
    "NEGLIGIBLE": 30.0,
    "FALL_END": 22.4,
    "SOLVER_STEP_SIGMAS": 5e-4,
    "SOLVER_LEVEL_MARGIN": 3e-7,  # as in isosurface_steps.py
    "SOLVER_BRACKET_SHARE": 1.25e-7,
    "SOLVER_LEAST_SHARE": 1.25e-7,
    "SOLVER_POLISH_SIGMAS": 3e-3,
    "SOLVER_LEVEL_FAR": 0.05,
    "SOLVER_FLAT": 0.02,
    "SOLVER_LEAST_SLOPE": 1e-12,
    "FLOAT_MARGIN": 4e-6,  # as in query_spans.py
    # As in core/field/vacancy/vacancy_kernels.py.
    "FACTOR_MIN": 1e-7,
    "TRANSMITTANCE_LOST": 1e-4,
    **{f"SSIM_W{tap}": weight for tap, weight in enumerate(ssim_kernels.WEIGHTS[:6])},
    "SSIM_C1": ssim_kernels.C1,
    "SSIM_C2": ssim_kernels.C2,
    # As in core/training: loss_kernels.py, adam_kernels.py.
    "MIN_NORMAL_SQ": 1e-30,
    "ADAM_BETA1": 0.9,
    "ADAM_BETA2": 0.999,
    "ADAM_EPSILON": 1e-15,
}
_DOUBLE = {
    "ALPHA_MIN_WIDE": tolerances.ALPHA_MIN,
    "QUATERNION_MIN_NORM": tolerances.QUATERNION_MIN_NORM,
    "DIRECTION_MIN_NORM": tolerances.DIRECTION_MIN_NORM,
    "FINITE_OFFSET_PX": tolerances.FINITE_OFFSET_PX,
    "FINITE_NUM": tolerances.FINITE_NUM,
    "FINITE_DEN": tolerances.FINITE_DEN,
    "FINITE_SPREAD": tolerances.FINITE_SPREAD,
    "FINITE_PULL": tolerances.FINITE_PULL,
    "FINITE_Z_MIN": tolerances.FINITE_Z_MIN,
    "FINITE_Z_MAX": tolerances.FINITE_Z_MAX,
    "FINITE_SIGMA_Z": tolerances.FINITE_SIGMA_Z,
    "FINITE_COLOR": tolerances.FINITE_COLOR,
    "FLOAT32_MAX": FLOAT32_MAX,
    # As in projection_backward.py.
    "GRADIENT_MAX": 1e38,
    "BASIS_MAX": 3.0,
    # As in projection_kernels.py and tile_kernels.py.
    "PLANE_MARGIN": 1e-12,
    # As in core/training/losses/depth_prior_loss.py.
    "PRIOR_TOLERANCE": 0.01,
    "PRIOR_OUTLIER": 0.03,
    "FLOAT32_STEP": 2.0**-23,
    "FARTHEST_PX": 1.0e9,
    "SHARE_MARGIN": 1e-6,
    "STRIP_MARGIN": 0.02,
    # As in fine_screen.py.
    "BOX_END": BOX_END,
    "PATCH_STEP_PX": tolerances.PATCH_STEP_PX,
    "MAX_NOISE_PX": tolerances.MAX_NOISE_PX,
    "MIN_NOISE_PX": tolerances.MIN_NOISE_PX,
    "SPREAD_PRODUCT": tolerances.SPREAD_PRODUCT,
    "MAX_PATCH_ERROR": tolerances.MAX_PATCH_ERROR,
    "MIN_PLANE_NORMAL": tolerances.MIN_PLANE_NORMAL,
    "MIN_PLANE_FACING": tolerances.MIN_PLANE_FACING,
    "SH_C0": 0.5 / math.sqrt(math.pi),
    "SH_C1": math.sqrt(3.0 / (4.0 * math.pi)),
    "SH_C2A": math.sqrt(15.0 / (4.0 * math.pi)),
    "SH_C2B": math.sqrt(5.0 / (16.0 * math.pi)),
    "SH_C2C": math.sqrt(15.0 / (16.0 * math.pi)),
    "SH_C3A": math.sqrt(35.0 / (32.0 * math.pi)),
    "SH_C3B": math.sqrt(105.0 / (4.0 * math.pi)),
    "SH_C3C": math.sqrt(21.0 / (32.0 * math.pi)),
    "SH_C3D": math.sqrt(7.0 / (16.0 * math.pi)),
    "SH_C3E": math.sqrt(105.0 / (16.0 * math.pi)),
}
_INTEGER = {
    "TILE": tolerances.TILE_PX,
    "SOLVER_NEWTON_STEPS": 8,
    "SOLVER_MAX_STEPS": 80,
    "HALF_PATCH": tolerances.HALF_PATCH,
    "PATCH_SKIPPED": tolerances.PATCH_SKIPPED,
    "PATCH_KEPT": tolerances.PATCH_KEPT,
    "PATCH_BROKEN": tolerances.PATCH_BROKEN,
}


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
