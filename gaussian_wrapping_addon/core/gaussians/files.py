# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians in files: our own and those of other programs."""

from __future__ import annotations

import io
import json
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..array_file import read_arrays
from ..errors import MeshingError, ParseError
from ..files import write_bytes
from ..limits import QUATERNION_MIN_NORM
from ..ply import read_ply_header, read_vertices
from ..progress import LEFT_OUT_HINT, ReportWarning
from ..readers.point_files import EXPECTED, SplatHeader, read_splat_header
from ..scene.camera import Similarity
from .model import SH_C0, OrientedGaussians

# -- Store Gaussians between stages: an uncompressed npz of the raw parameters --------------------


_SHAPES = {
    "means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "orientation": (4,),
    "filter_3d": (),
}  # fmt: skip


def save_gaussians(path: Path, gaussians: OrientedGaussians) -> None:
    """Write all parameters atomically."""
    stream = io.BytesIO()
    np.savez(stream, **{k: v.detach().cpu().numpy() for k, v in gaussians.tensors()})
    write_bytes(path, stream.getvalue())


def load_gaussians(path: Path) -> OrientedGaussians:
    """Read what :func:`save_gaussians` wrote.

    Raises
    ------
    ParseError
        The file is damaged, or an array is missing, of the wrong shape, or not finite.
    """
    hint = "Delete the folder and run the job again."
    loaded = read_arrays(path, (*_SHAPES, "sh"), hint=hint)
    count = loaded["means"].shape[:1]
    for name, array in loaded.items():
        good = array.dtype.kind == "f" and array.shape[:1] == count and np.isfinite(array).all()
        fits = array.ndim == 3 if name == "sh" else array.shape[1:] == _SHAPES[name]
        if not (good and fits):
            raise ParseError(path, name, "wrong shape or non-finite values.", hint)
    return OrientedGaussians(**{name: torch.from_numpy(array) for name, array in loaded.items()})


# -- Gaussians as PLY files: native format (write and read) and viewer format (write) -------------
#
# The order of the properties is that of the original 3D Gaussian splatting code: positions, zero
# normals, harmonics channel by channel, opacity logit, log scales, quaternion wxyz; the native
# file appends ``filter_3D`` and ``gaussian_features_0..3`` (direction and sign).


_logger = logging.getLogger(__name__)

MAX_LOG_SCALE = 40.0
"""Gaussians with scales beyond e^40, which are implausible, are dropped."""
MAX_OPACITY_LOGIT = 30.0
"""Opacity logits in viewer files are clamped to this and its negative: sigmoid is 1 or 0 to 13
digits."""
_FRAME_COMMENT = "world_from_scene"
_HINT = "Write the file again with this program."


@dataclass(frozen=True)
class SplatFile:
    """Content of a native file."""

    gaussians: OrientedGaussians
    world_from_scene: Similarity | None  # Frame of the input, if the header has it
    dropped: int  # Gaussians dropped because of non-finite or invalid values


def write_splat_ply(path: Path, gaussians: OrientedGaussians, world_from_scene: Similarity) -> None:
    """Write a native file: raw parameters, scene frame; a header comment defines the frame."""
    arrays = {name: t.detach().cpu().numpy() for name, t in gaussians.tensors()}
    names = [*standard_names(arrays["sh"].shape[1]), "filter_3D"]
    names += [f"gaussian_features_{i}" for i in range(4)]
    columns = [*_standard_columns(arrays), arrays["filter_3d"][:, None], arrays["orientation"]]
    frame = json.dumps(world_from_scene.to_json(), separators=(",", ":"))
    _write(path, names, columns, [f"{_FRAME_COMMENT} {frame}"])


def write_viewer_ply(path: Path, gaussians: OrientedGaussians) -> None:
    """Write a file for splat viewers: the filter is baked into scale and opacity.

    Raises
    ------
    MeshingError
        If a Gaussian is not finite in single precision: viewers would show nothing, or crash.
    """
    baked = gaussians.baked()
    logits = baked.opacity_logits.clamp(-MAX_OPACITY_LOGIT, MAX_OPACITY_LOGIT)
    baked = baked.replaced(opacity_logits=logits)
    arrays = {name: t.numpy() for name, t in baked.tensors()}
    valid = np.ones(len(arrays["means"]), np.bool_)
    for name in ("means", "sh", "opacity_logits", "log_scales", "quats"):
        with np.errstate(over="ignore"):
            single = arrays[name].reshape(len(valid), -1).astype(np.float32)
        valid &= np.isfinite(single).all(axis=1)
    if not valid.all():
        text = f"Gaussian {int(np.argmin(valid))} of the splat to write is not finite."
        raise MeshingError(text, "Train the scene again.")
    _write(path, standard_names(arrays["sh"].shape[1]), _standard_columns(arrays), [])


def standard_names(coefficients: int) -> list[str]:
    """Return the properties of the original code's files, in their order."""
    return [
        "x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * (coefficients - 1))), "opacity",
        *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
    ]  # fmt: skip


def _standard_columns(arrays: dict[str, np.ndarray]) -> list[np.ndarray]:
    count, sh = len(arrays["means"]), arrays["sh"]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, -1)  # all of red, then green, then blue
    return [
        arrays["means"], np.zeros((count, 3)), sh[:, 0], rest, arrays["opacity_logits"][:, None],
        arrays["log_scales"], arrays["quats"],
    ]  # fmt: skip


def _write(path: Path, names: list[str], columns: list[np.ndarray], comments: list[str]) -> None:
    table = np.concatenate([np.asarray(c, np.float64) for c in columns], axis=1).astype("<f4")
    assert table.shape[1] == len(names)
    header = [
        "ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments),
        f"element vertex {len(table)}", *(f"property float {n}" for n in names), "end_header",
    ]  # fmt: skip
    write_bytes(path, ("\n".join(header) + "\n").encode("ascii") + table.tobytes())


def read_splat_ply(path: Path) -> SplatFile:
    """Read a native file; properties may be in any order, be double, and include extra ones.

    Gaussians with a non-finite value, a zero quaternion or an implausible scale are dropped and
    counted.

    Raises
    ------
    ParseError
        If the file is invalid; names the line or property. Nothing is allocated before the file
        size is checked against the header.
    """
    header = read_ply_header(path, _HINT)
    if header.encoding != "<":
        hint = "Save it as binary little endian."
        raise ParseError(path, "header", "not binary little endian.", hint)
    if [element.name for element in header.elements] != ["vertex"]:
        raise ParseError(
            path, "header", "only one element, named vertex, is expected.",
            "This looks like a mesh or a compressed splat file; give a native splat file.",
        )  # fmt: skip
    return _gaussians_of(path, read_vertices(path, header, _HINT), header.comments)


def harmonics_of(constant: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return (n, k, 3) from (n, 3) f_dc and (n, 3 (k - 1)) f_rest, which is channel by channel."""
    count = len(constant)
    higher = rest.reshape(count, 3, rest.shape[1] // 3)
    return np.concatenate([constant[:, None], higher.transpose(0, 2, 1)], axis=1)


def _gaussians_of(path: Path, table: np.ndarray, comments: Sequence[str]) -> SplatFile:
    names = set(table.dtype.names or ())
    rest = sum(1 for name in names if name.startswith("f_rest_"))
    degree = math.isqrt(rest // 3 + 1) - 1
    if rest != 3 * ((degree + 1) ** 2 - 1) or degree > 3:
        raise ParseError(path, "header", f"{rest} f_rest properties fit no degree 0 to 3.", _HINT)
    wanted = [n for n in standard_names((degree + 1) ** 2) if n not in ("nx", "ny", "nz")]
    wanted += ["filter_3D", *(f"gaussian_features_{i}" for i in range(4))]
    for name in wanted:
        if name not in names:
            raise ParseError(
                path, "header", f"property {name} is missing.",
                "Give a file written by this program, with filter and orientation.",
            )  # fmt: skip
    values = np.stack([table[name].astype(np.float32) for name in wanted], axis=1)  # (n, p)
    at = {name: i for i, name in enumerate(wanted)}
    quats = values[:, at["rot_0"] : at["rot_0"] + 4]
    log_scales = values[:, at["scale_0"] : at["scale_0"] + 3]
    valid = np.isfinite(values).all(axis=1) & (quats != 0).any(axis=1)
    valid &= (log_scales < MAX_LOG_SCALE).all(axis=1) & (values[:, at["filter_3D"]] >= 0)
    dropped = int(len(values) - valid.sum())
    if dropped:
        _logger.warning("%s: %d Gaussians with invalid values were dropped", path.name, dropped)
    if not valid.any():
        raise ParseError(path, "body", "no Gaussian has valid values.", _HINT)
    values, quats, log_scales = values[valid], quats[valid], log_scales[valid]
    first = at["f_dc_0"]
    sh = harmonics_of(values[:, first : first + 3], values[:, first + 3 : first + 3 + rest])
    orientation = values[:, at["gaussian_features_0"] : at["gaussian_features_0"] + 4]
    arrays = {
        "means": values[:, 0:3], "log_scales": log_scales, "quats": quats,
        "opacity_logits": values[:, at["opacity"]], "sh": sh, "orientation": orientation,
        "filter_3d": values[:, at["filter_3D"]],
    }  # fmt: skip
    tensors = {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items()}
    return SplatFile(OrientedGaussians(**tensors), _frame_in(path, comments), dropped)


def _frame_in(path: Path, comments: Sequence[str]) -> Similarity | None:
    for comment in comments:
        key, _, text = comment.partition(" ")
        if key != _FRAME_COMMENT:
            continue
        try:
            frame = Similarity.from_json(json.loads(text))
            numbers = np.concatenate([[frame.scale], frame.rotation.ravel(), frame.translation])
            if not (np.isfinite(numbers).all() and frame.scale > 0):
                raise ValueError("not a similarity")
        except (ValueError, KeyError, TypeError, RecursionError):
            raise ParseError(path, "header", f"the {_FRAME_COMMENT} comment.", _HINT) from None
        return frame
    return None


# -- Read 3D Gaussian splatting PLY files of other programs as oriented Gaussians -----------------
#
# Formats: that of the original code, gsplat and nerfstudio exports (with or without normals, or
# with plain colours), 2D Gaussian splatting (two scales), files with Mip-Splatting's
# ``filter_3D``, and our own with ``gaussian_features_*``.


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
    warnings: tuple[ReportWarning, ...]
    facts: dict[str, Any]


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
        "splat_gaussians": int(valid.sum()), "splat_dropped": dropped,
        "splat_degree": header.degree, "splat_surfels": header.axes == 2,
        "splat_oriented": oriented,
    }  # fmt: skip
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
    arrays["opacity_logits"] = arrays["opacity_logits"].clip(-MAX_OPACITY_LOGIT, MAX_OPACITY_LOGIT)
    quats = arrays["quats"]
    largest = np.abs(quats).max(axis=1, keepdims=True)  # (n, 1)
    extreme = (largest < 1e-6) | (largest > 1e6)  # their squares leave float32
    arrays["quats"] = np.where(extreme, quats / largest, quats)
