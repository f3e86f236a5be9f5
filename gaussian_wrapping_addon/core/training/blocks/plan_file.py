# SPDX-License-Identifier: GPL-3.0-or-later
"""Write and read a plan of blocks: ``blocks.npz``, and ``blocks.json``, which is written last."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...array_file import read_arrays
from ...errors import ParseError, UsageError
from ...files import read_json, write_bytes, write_json
from ...gaussians.model import OrientedGaussians
from ...limits import MAX_BLOCKS
from ...regions.tiling import Tiling
from ..appearance.photo_exposure import Exposure
from ..selection.model_selection import ModelSelection
from .block_plan import Block, BlockPlan
from .coarse_training import CoarseTraining

PLAN_NAME = "blocks.json"
ARRAYS_NAME = "blocks.npz"
VERSION = 1

_AGAIN = "Delete both files of the plan: it is made again."
_GAUSSIANS = {
    "means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "orientation": (4,),
    "filter_3d": (),
}  # fmt: skip
_EXPOSURE = ("values", "trained", "first", "second", "steps")


def save_plan(folder: Path, plan: BlockPlan) -> None:
    """Write a plan into a folder; both files are replaced atomically."""
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **plan.to_arrays())
    write_bytes(folder / ARRAYS_NAME, stream.getvalue())
    write_json(
        folder / PLAN_NAME, {"version": VERSION, "digest": plan.digest, "plan": plan.to_json()}
    )


def load_plan(folder: Path) -> BlockPlan:
    """Read what :func:`save_plan` wrote.

    Raises
    ------
    ParseError
        A file is missing, damaged, of another version, or the two do not belong together.
    """
    path = folder / PLAN_NAME
    try:
        values = read_json(path)
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read ({error}).", _AGAIN) from None
    except ParseError as error:
        if not isinstance(error.__cause__, OSError):  # it may be read, but is damaged
            error.hint = _AGAIN
        raise
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise ParseError(path, "version", f"version {VERSION} was expected.", _AGAIN)
    try:
        plan = _plan(values["plan"], folder / ARRAYS_NAME)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, UsageError) as error:
        raise ParseError(path, "plan", f"is inconsistent ({error}).", _AGAIN) from None
    if plan.digest != values.get("digest"):
        raise ParseError(path, "digest", "the arrays are of another plan.", _AGAIN)
    return plan


def _plan(values: dict[str, Any], path: Path) -> BlockPlan:
    tiling = Tiling.from_json(values["splits"])
    listed, views = values["blocks"], tuple(int(view) for view in values["views"])
    count = len(listed)
    if not 1 <= count <= MAX_BLOCKS or count != len(tiling):
        raise ValueError(f"{count} blocks, {len(tiling)} cells")
    for new, (cell, axis, at) in enumerate(tiling.splits, 1):
        if not (0 <= cell < new and 0 <= axis < 3 and np.isfinite(at)):
            raise ValueError(f"split {new}")
    rows = [f"{kind}.{index}" for index in range(count) for kind in ("trained", "still")]
    tensors = [f"gaussians.{name}" for name in (*_GAUSSIANS, "sh")]
    exposures = [f"exposure.{name}" for name in (*_EXPOSURE, "active")]
    arrays = read_arrays(
        path, (*tensors, *rows, "margins"), optional=(*exposures, "poses"), hint=_AGAIN
    )
    gaussians = _gaussians(arrays)
    margins = _checked(arrays["margins"], np.float64, (count, 3), "margins")
    if not (margins >= 0.0).all():
        raise ValueError("margins")
    exposure = {n.removeprefix("exposure."): a for n, a in arrays.items() if n in exposures}
    poses = arrays.get("poses")
    if poses is not None:
        _checked(poses, np.float64, (len(poses), 3, 4), "poses")
    coarse = CoarseTraining(
        gaussians,
        ModelSelection.from_json(values["decisions"]),
        Exposure.restore(exposure) if exposure else None,
        poses,
        str(values["key"]),
    )
    blocks = tuple(
        _block(entry, views, len(gaussians), arrays[f"trained.{k}"], arrays[f"still.{k}"])
        for k, entry in enumerate(listed)
    )
    begin = float(values["begin"])
    if not 0.0 <= begin < 1.0:
        raise ValueError(f"begin at {begin}")
    return BlockPlan(
        coarse, tiling, margins, blocks, views, begin, values["full_size"] is True
    )  # fmt: skip


def _gaussians(arrays: dict[str, np.ndarray]) -> OrientedGaussians:
    count = len(arrays["gaussians.means"])
    for name, shape in _GAUSSIANS.items():
        _checked(arrays[f"gaussians.{name}"], np.float32, (count, *shape), name)
    sh = arrays["gaussians.sh"]
    if sh.ndim != 3 or sh.shape[1] not in (1, 4, 9, 16):
        raise ValueError(f"sh is {sh.shape}")
    _checked(sh, np.float32, (count, sh.shape[1], 3), "sh")
    return OrientedGaussians(
        **{name: torch.from_numpy(arrays[f"gaussians.{name}"]) for name in (*_GAUSSIANS, "sh")}
    )


def _block(
    entry: dict[str, Any],
    all_views: tuple[int, ...],
    count: int,
    trained: np.ndarray,
    still: np.ndarray,
) -> Block:
    views = tuple(int(view) for view in entry["views"])
    if not views or not set(views) <= set(all_views):
        raise ValueError("views of a block")
    for rows in (trained, still):
        increasing = rows.dtype == np.int32 and rows.ndim == 1 and bool((np.diff(rows) > 0).all())
        if not increasing or (len(rows) and not 0 <= rows[0] <= rows[-1] < count):
            raise ValueError("rows of a block")
    if not len(trained) or np.isin(trained, still).any():
        raise ValueError("rows of a block")
    most, pixels = int(entry["max_gaussians"]), int(entry["pixels"])
    if most < len(trained) or pixels < 1:
        raise ValueError("limits of a block")
    return Block(views, trained, still, most, pixels)


def _checked(
    array: np.ndarray, kind: type[np.floating], shape: tuple[int, ...], name: str
) -> np.ndarray:
    if array.dtype != kind or array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name} is {array.dtype} {array.shape}")
    return array
