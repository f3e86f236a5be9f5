# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians as PLY files: our native one, one for viewers, and a bounded reader of the native one.

The order of the properties is that of the original 3D Gaussian splatting code (conventions.md C.6):
positions, zero normals, harmonics channel by channel, opacity logit, log scales, quaternion wxyz;
the native file appends ``filter_3D`` and ``gaussian_features_0..3`` (direction and sign).
"""

from __future__ import annotations

import json
import logging
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from .. import limits
from ..dataset.similarity import Similarity
from ..errors import ParseError
from ..files import write_bytes
from .model import OrientedGaussians

_logger = logging.getLogger(__name__)

MAX_HEADER_BYTES = 64 * 1024
MAX_LOG_SCALE = 40.0
"""Scales beyond e^40 cannot be meant; such Gaussians are dropped."""

_FRAME_COMMENT = "world_from_scene"
_HINT = "Write the file again with this program."
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2",
    "ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4",
    "uint32": "<u4", "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip


@dataclass(frozen=True)
class SplatFile:
    """What a native file holds."""

    gaussians: OrientedGaussians
    world_from_scene: Similarity | None
    """Frame of the input, where the header names it."""
    dropped: int
    """Gaussians left out because a value was not finite or senseless."""


def write_splat_ply(path: Path, gaussians: OrientedGaussians, world_from_scene: Similarity) -> None:
    """Write the native file: raw parameters, scene frame, the frame in a header comment."""
    arrays = {name: t.detach().cpu().numpy() for name, t in gaussians.tensors()}
    names = [*_standard_names(arrays["sh"].shape[1]), "filter_3D"]
    names += [f"gaussian_features_{i}" for i in range(4)]
    columns = [*_standard_columns(arrays), arrays["filter_3d"][:, None], arrays["orientation"]]
    frame = json.dumps(world_from_scene.to_json(), separators=(",", ":"))
    _write(path, names, columns, [f"{_FRAME_COMMENT} {frame}"])


def write_viewer_ply(path: Path, gaussians: OrientedGaussians) -> None:
    """Write a file for splat viewers, scene frame: the filter is baked into scale and opacity."""
    wide = OrientedGaussians(**{n: t.detach().cpu().double() for n, t in gaussians.tensors()})
    log_opacity = wide.log_opacities()
    # logit = log(a / (1 - a)), from log a without losing a close to 1
    logit = log_opacity - torch.log(-torch.expm1(log_opacity.clamp_max(-1e-12)))
    baked = wide.replaced(log_scales=torch.log(wide.scales()), opacity_logits=logit)
    arrays = {name: t.numpy() for name, t in baked.tensors()}
    _write(path, _standard_names(arrays["sh"].shape[1]), _standard_columns(arrays), [])


def _standard_names(coefficients: int) -> list[str]:
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
    """Read a native file; properties may come in any order, be double, and have extra ones beside.

    Gaussians with a value that is not finite, a zero quaternion or a senseless scale are dropped
    and counted.

    Raises
    ------
    ParseError
        Not such a file; names the line or property. Nothing is allocated before the file's size
        is known to hold what the header promises.
    """
    size_bytes = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(MAX_HEADER_BYTES)
        count, properties, comments, begin = _parse_header(path, head)
        kind = np.dtype([(name, _TYPES[t]) for name, t in properties])
        need_bytes = begin + count * kind.itemsize
        if size_bytes < need_bytes:
            raise ParseError(
                path, f"byte {size_bytes}", f"cut off: the header promises {need_bytes} bytes.",
                _HINT,
            )  # fmt: skip
        stream.seek(begin)
        table = np.frombuffer(stream.read(count * kind.itemsize), kind)
    return _gaussians_of(path, table, comments)


def _parse_header(path: Path, head: bytes) -> tuple[int, list[tuple[str, str]], list[str], int]:
    """Return count, (name, type) of the properties, comments, and where the body begins."""
    if not re.match(rb"ply\r?\n", head):
        raise ParseError(path, "byte 0", "not a PLY file.", _HINT)
    end = re.search(rb"\nend_header\r?\n", head)
    if end is None:
        raise ParseError(path, "header", f"does not end within {MAX_HEADER_BYTES} bytes.", _HINT)
    count = -1
    properties: list[tuple[str, str]] = []
    comments = []
    for number, raw in enumerate(head[: end.start()].splitlines()[1:], start=2):
        words = raw.decode("ascii", "replace").split()
        place = f"line {number}"
        if not words or words[0] == "obj_info":
            continue
        if words[0] == "comment":
            comments.append(" ".join(words[1:]))
        elif words[0] == "format":
            if words[1:2] != ["binary_little_endian"]:
                raise ParseError(
                    path, place, f"format {' '.join(words[1:])} is not read.",
                    "Save it as binary little endian.",
                )  # fmt: skip
        elif words[0] == "element":
            if count >= 0 or words[1:2] != ["vertex"]:
                raise ParseError(
                    path, place, "only one element, named vertex, is expected.",
                    "This looks like a mesh or a compressed splat file; give a native splat file.",
                )  # fmt: skip
            if len(words) != 3 or not re.fullmatch(r"\d{1,18}", words[2]):
                raise ParseError(path, place, "no count of vertices.", _HINT)
            count = int(words[2])
        elif words[0] == "property":
            if len(words) != 3 or words[1] not in _TYPES or count < 0:
                raise ParseError(path, place, f"property {' '.join(words[1:])!r}.", _HINT)
            if words[2] in (name for name, _ in properties):
                raise ParseError(path, place, f"property {words[2]} comes twice.", _HINT)
            properties.append((words[2], words[1]))
        else:
            raise ParseError(path, place, f"unknown header line {words[0]!r}.", _HINT)
    if not 0 <= count <= limits.MAX_GAUSSIANS:
        raise ParseError(
            path, "header", f"{count} vertices; at most {limits.MAX_GAUSSIANS} are read.", _HINT
        )
    if not properties:
        raise ParseError(path, "header", "no properties.", _HINT)
    return count, properties, comments, end.end()


def _gaussians_of(path: Path, table: np.ndarray, comments: list[str]) -> SplatFile:
    names = set(table.dtype.names or ())
    rest = sum(1 for name in names if name.startswith("f_rest_"))
    degree = math.isqrt(rest // 3 + 1) - 1
    if rest != 3 * ((degree + 1) ** 2 - 1) or degree > 3:
        raise ParseError(path, "header", f"{rest} f_rest properties fit no degree 0 to 3.", _HINT)
    wanted = [n for n in _standard_names((degree + 1) ** 2) if n not in ("nx", "ny", "nz")]
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
    good = np.isfinite(values).all(axis=1) & (quats != 0).any(axis=1)
    good &= (log_scales < MAX_LOG_SCALE).all(axis=1) & (values[:, at["filter_3D"]] >= 0)
    dropped = int(len(values) - good.sum())
    if dropped:
        _logger.warning("%s: %d Gaussians with senseless values were dropped", path.name, dropped)
    if not good.any():
        raise ParseError(path, "body", "no Gaussian has sensible values.", _HINT)
    values, quats, log_scales = values[good], quats[good], log_scales[good]
    count = len(values)
    first = at["f_dc_0"]
    higher = values[:, first + 3 : first + 3 + rest].reshape(count, 3, rest // 3)
    sh = np.concatenate([values[:, None, first : first + 3], higher.transpose(0, 2, 1)], axis=1)
    orientation = values[:, at["gaussian_features_0"] : at["gaussian_features_0"] + 4]
    arrays = {
        "means": values[:, 0:3], "log_scales": log_scales, "quats": quats,
        "opacity_logits": values[:, at["opacity"]], "sh": sh, "orientation": orientation,
        "filter_3d": values[:, at["filter_3D"]],
    }  # fmt: skip
    tensors = {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items()}
    return SplatFile(OrientedGaussians(**tensors), _frame_in(path, comments), dropped)


def _frame_in(path: Path, comments: list[str]) -> Similarity | None:
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
