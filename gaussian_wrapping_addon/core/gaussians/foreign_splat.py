# SPDX-License-Identifier: GPL-3.0-or-later
"""Read 3D Gaussian splatting PLY files of other programs as oriented Gaussians.

Formats: that of the original code, gsplat and nerfstudio exports (with or without normals,
or with plain colours), 2D Gaussian splatting (two scales), files with Mip-Splatting's
``filter_3D``, and our own with ``gaussian_features_*``.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..dataset.readers.splat_header import EXPECTED, SplatHeader, read_splat_header
from ..errors import ParseError
from ..ply.table import read_vertices
from ..report_warning import LEFT_OUT_HINT, ReportWarning
from ..tolerances import QUATERNION_MIN_NORM
from .initialisation import SH_C0
from .model import OrientedGaussians
from .splat_ply import MAX_LOG_SCALE, MAX_OPACITY_LOGIT, harmonics_of

_logger = logging.getLogger(__name__)

MAX_DEGREE = 3
"""Higher degrees of the harmonics are dropped: the renderer does not support them."""

SURFEL_THICKNESS = 0.02
"""Thickness given to surfels, relative to their shorter axis: visually flat, and far from the discs
of 1e8 : 1 that float32 cannot render."""

THINNEST_AXIS = 1e-5
"""Minimum length of an axis relative to the longest one."""

_ACTIVATED_SHARE = 0.999
"""If this share of opacities and scales could be activated values, the file likely has them."""


@dataclass(frozen=True)
class ForeignSplat:
    """A splat file of any program."""

    gaussians: OrientedGaussians
    """In the frame of the file. float64 where the file has doubles, else float32; the orientation
    is zero where the file has none."""
    oriented: bool
    """Whether the file has orientations."""
    dropped: int
    """Gaussians dropped because of non-finite or invalid values."""
    warnings: tuple[ReportWarning, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)


def read_foreign_splat(path: Path) -> ForeignSplat:
    """Read a 3D Gaussian splatting PLY with properties of any order and type, and extra ones.

    Raises
    ------
    ParseError
        If the file is no splat, truncated, or has no valid Gaussian; names location and next step.
    DatasetError
        If the splat format is not supported, or the file holds no Gaussians.
    """
    header = read_splat_header(path)
    rows = read_vertices(path, header.ply, EXPECTED)
    wide = any(kind == "f8" for _, kind in header.ply.elements[0].properties)
    dtype = np.float64 if wide else np.float32

    def columns(*names: str) -> np.ndarray:
        with np.errstate(over="ignore"):  # becomes infinite: such Gaussians are left out
            stacked = [rows[name].astype(dtype) for name in names]  # (n,) each
        return np.stack(stacked, axis=1) if stacked else np.zeros((len(rows), 0), dtype)

    names = header.names
    features = [f"gaussian_features_{i}" for i in range(4)]
    oriented = set(features) <= names
    count = len(rows)
    arrays = {
        "means": columns("x", "y", "z"),
        "log_scales": columns(*(f"scale_{i}" for i in range(header.axes))),
        "quats": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        "opacity_logits": columns("opacity")[:, 0],
        "sh": _harmonics(header, columns),
        "orientation": columns(*features) if oriented else np.zeros((count, 4), dtype),
        "filter_3d": columns("filter_3D")[:, 0] if "filter_3D" in names else np.zeros(count, dtype),
    }
    valid = _is_valid(arrays)
    dropped = count - int(valid.sum())
    if not valid.any():
        raise ParseError(
            path, "body", f"none of the {count} Gaussians has valid values.",
            "Export the splat again.",
        )  # fmt: skip
    arrays = {name: array[valid] for name, array in arrays.items()}
    warnings = _warnings(header, arrays, dropped, count)
    _normalise(arrays, header.axes)
    tensors = {k: torch.from_numpy(np.ascontiguousarray(v, dtype)) for k, v in arrays.items()}
    facts = {
        "splat_gaussians": int(valid.sum()),
        "splat_dropped": dropped,
        "splat_degree": header.degree,
        "splat_surfels": header.axes == 2,
        "splat_oriented": oriented,
    }
    for warning in warnings:
        _logger.warning("%s: %s", path.name, warning.text)
    return ForeignSplat(OrientedGaussians(**tensors), oriented, dropped, tuple(warnings), facts)


def _harmonics(header: SplatHeader, columns: Any) -> np.ndarray:
    """Return (n, k, 3) coefficients, at most of :data:`MAX_DEGREE`."""
    constant = columns(*header.colors)  # (n, 3)
    if header.colors[0] == "red":
        kinds = dict(header.ply.elements[0].properties)
        full = 1.0 if kinds["red"].startswith("f") else float(np.iinfo(kinds["red"]).max)
        constant = (constant / full - 0.5) / SH_C0
    stored = (header.degree + 1) ** 2 - 1
    used = (min(header.degree, MAX_DEGREE) + 1) ** 2 - 1
    # Channel by channel: the coefficients of one channel that are used come first in it.
    rest = columns(*(f"f_rest_{c * stored + i}" for c in range(3) for i in range(used)))
    return harmonics_of(constant, rest)


def _is_valid(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """(n,) bool: finite, with a valid rotation and a plausible size."""
    valid = np.ones(len(arrays["means"]), np.bool_)
    for array in arrays.values():
        valid &= np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    valid &= np.abs(arrays["quats"]).max(axis=1) > QUATERNION_MIN_NORM
    valid &= np.abs(arrays["log_scales"].max(axis=1)) < MAX_LOG_SCALE  # the longest axis
    return valid & (arrays["filter_3d"] >= 0)


def _warnings(
    header: SplatHeader, arrays: dict[str, np.ndarray], dropped: int, count: int
) -> list[ReportWarning]:
    out = []
    if dropped:
        text = f"{dropped} of {count} Gaussians with invalid values were left out."
        out.append(ReportWarning("gaussians-left-out", text, LEFT_OUT_HINT))
    if header.degree > MAX_DEGREE:
        text = (
            f"The splat's harmonics are of degree {header.degree}; those above degree "
            f"{MAX_DEGREE} are left out, so that highlights may look softer."
        )
        out.append(ReportWarning("harmonics-left-out", text, LEFT_OUT_HINT))
    opacity, scales = arrays["opacity_logits"], arrays["log_scales"]
    activated = (opacity >= 0) & (opacity <= 1) & (scales > 0).all(axis=1)
    if activated.mean() > _ACTIVATED_SHARE and np.ptp(opacity) > 0:
        text = (
            "Opacities and scales look activated; logits and logarithms are expected. "
            "If the mesh looks wrong, export the splat again in Inria's convention."
        )
        out.append(ReportWarning("values-look-activated", text))
    return out


def _normalise(arrays: dict[str, np.ndarray], axes: int) -> None:
    """Give surfels a third axis; clamp extreme values to what float32 can render."""
    log_scales = arrays["log_scales"]
    if axes == 2:
        third = log_scales.min(axis=1, keepdims=True) + math.log(SURFEL_THICKNESS)
        log_scales = np.concatenate([log_scales, third.astype(log_scales.dtype)], axis=1)
    least = log_scales.max(axis=1, keepdims=True) + math.log(THINNEST_AXIS)
    arrays["log_scales"] = np.maximum(log_scales, least.astype(log_scales.dtype))
    limit = MAX_OPACITY_LOGIT
    arrays["opacity_logits"] = np.clip(arrays["opacity_logits"], -limit, limit)
    quats = arrays["quats"]
    largest = np.abs(quats).max(axis=1, keepdims=True)  # (n, 1)
    extreme = (largest < 1e-6) | (largest > 1e6)  # their squares leave float32
    arrays["quats"] = np.where(extreme, quats / largest, quats)
