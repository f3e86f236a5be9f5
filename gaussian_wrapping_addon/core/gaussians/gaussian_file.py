# SPDX-License-Identifier: GPL-3.0-or-later
"""Store Gaussians between stages: an uncompressed npz of the raw parameters."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch

from ..array_file import read_arrays
from ..errors import ParseError
from ..files import write_bytes
from .model import OrientedGaussians

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
        good = array.dtype.kind == "f" and (
            array.shape[1:] == _SHAPES[name] if name != "sh" else array.ndim == 3
        )
        if not good or array.shape[:1] != count or not np.isfinite(array).all():
            raise ParseError(path, name, "wrong shape or non-finite values.", hint)
    return OrientedGaussians(**{name: torch.from_numpy(array) for name, array in loaded.items()})
