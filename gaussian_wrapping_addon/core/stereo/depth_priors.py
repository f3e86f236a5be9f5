# SPDX-License-Identifier: GPL-3.0-or-later
"""Confirmed depths of the photos, kept for the training that started on them."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..dataset.camera import Camera
from ..files import write_bytes
from .depth_maps import DepthMap

FILE_NAME = "depth_priors.npz"

PLAIN_VARIANCE = np.float32(20.0)
"""Variance of grey in a window, squared levels of 256, at which a depth counts half."""


@dataclass(frozen=True)
class DepthPrior:
    """Confirmed depths of one photo."""

    camera: Camera
    """Of this size, scene frame."""
    depth: np.ndarray
    """(h, w) float32 z-depth, scene units; 0 where nothing is confirmed."""
    confidence: np.ndarray
    """(h, w) float32 in [0, 1], the less the more texture; 0 where nothing is confirmed."""


def priors_of(views: Sequence[int], depth_maps: Sequence[DepthMap]) -> dict[int, DepthPrior]:
    """Return the priors of views, by view.

    Texture takes from their weight: where there is some, photos tell the depth more finely than
    windows do, and thin parts are what windows miss.
    """
    return {
        view: DepthPrior(
            found.camera,
            np.where(found.confidence > 0, found.depth, np.float32(0)),
            found.confidence * (PLAIN_VARIANCE / (PLAIN_VARIANCE + found.variance)),
        )
        for view, found in zip(views, depth_maps, strict=True)
    }


def save_priors(folder: Path, priors: Mapping[int, DepthPrior], key: str) -> None:
    """Write ``depth_priors.npz`` into a folder; ``key`` names what they were made from."""
    arrays = {"key": np.array(key)}
    for view, prior in priors.items():
        arrays[f"depth.{view}"], arrays[f"confidence.{view}"] = prior.depth, prior.confidence
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(folder / FILE_NAME, buffer.getvalue())


def load_priors(
    folder: Path, cameras: Mapping[int, Camera], key: str
) -> dict[int, DepthPrior] | None:
    """Read what :func:`save_priors` wrote for the same key.

    Parameters
    ----------
    cameras : mapping of int to Camera
        Of the views that priors are wanted for, at the size they were matched at.

    Returns
    -------
    dict of int to DepthPrior, or None
        ``None`` where the file is missing, damaged or of another key: the priors follow from the
        photos and can be made again.
    """
    try:
        with np.load(folder / FILE_NAME, allow_pickle=False) as arrays:
            if str(arrays["key"]) != key:
                return None
            return {
                view: _prior(camera, arrays[f"depth.{view}"], arrays[f"confidence.{view}"])
                for view, camera in cameras.items()
            }
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zipfile.LargeZipFile):
        return None


def _prior(camera: Camera, depth: np.ndarray, confidence: np.ndarray) -> DepthPrior:
    good = depth.dtype == confidence.dtype == np.float32 and depth.shape == confidence.shape
    if not (good and depth.ndim == 2 and np.isfinite(depth).all()):
        raise ValueError("not (h, w) float32 depths and confidences")
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"depths are {depth.shape}, the photo is matched at another size")
    return DepthPrior(camera, depth, confidence)
