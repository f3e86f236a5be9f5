# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians as PLY files: native format (write and read) and viewer format (write).

The order of the properties is that of the original 3D Gaussian splatting code:
positions, zero normals, harmonics channel by channel, opacity logit, log scales, quaternion wxyz;
the native file appends ``filter_3D`` and ``gaussian_features_0..3`` (direction and sign).
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..dataset.similarity import Similarity
from ..errors import MeshingError, ParseError
from ..files import write_bytes
from ..ply.header import read_ply_header
from ..ply.table import read_vertices
from .model import OrientedGaussians

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
    world_from_scene: Similarity | None
    """Frame of the input, if the header has it."""
    dropped: int
    """Gaussians dropped because of non-finite or invalid values."""


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
    wide = OrientedGaussians(**{n: t.detach().cpu().double() for n, t in gaussians.tensors()})
    log_opacity = wide.log_opacities()
    # logit = log(a / (1 - a)), from log a without losing a close to 1
    logit = log_opacity - torch.log(-torch.expm1(log_opacity.clamp_max(-1e-12)))
    logit = logit.clamp(-MAX_OPACITY_LOGIT, MAX_OPACITY_LOGIT)
    baked = wide.replaced(log_scales=torch.log(wide.scales()), opacity_logits=logit)
    arrays = {name: t.numpy() for name, t in baked.tensors()}
    valid = np.ones(len(arrays["means"]), np.bool_)
    for name in ("means", "sh", "opacity_logits", "log_scales", "quats"):
        with np.errstate(over="ignore"):
            single = arrays[name].reshape(len(valid), -1).astype(np.float32)
        valid &= np.isfinite(single).all(axis=1)
    if not valid.all():
        raise MeshingError(
            f"Gaussian {int(np.argmin(valid))} of the splat to write is not finite.",
            "Train the scene again.",
        )
    _write(path, standard_names(arrays["sh"].shape[1]), _standard_columns(arrays), [])


def standard_names(coefficients: int) -> list[str]:
    """Return the properties of the original code's files, in their order."""
    rest = 3 * (coefficients - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def _standard_columns(arrays: dict[str, np.ndarray]) -> list[np.ndarray]:
    count = len(arrays["means"])
    sh = arrays["sh"]
    return [
        arrays["means"],
        np.zeros((count, 3)),
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(count, -1),  # all of red, then green, then blue
        arrays["opacity_logits"][:, None],
        arrays["log_scales"],
        arrays["quats"],
    ]


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
        raise ParseError(
            path, "header", "not binary little endian.", "Save it as binary little endian."
        )
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
        except (ValueError, KeyError, TypeError, RecursionError):
            raise ParseError(path, "header", f"the {_FRAME_COMMENT} comment.", _HINT) from None
        numbers = np.concatenate([[frame.scale], frame.rotation.ravel(), frame.translation])
        if not (np.isfinite(numbers).all() and frame.scale > 0):
            raise ParseError(path, "header", f"the {_FRAME_COMMENT} comment.", _HINT)
        return frame
    return None
