# SPDX-License-Identifier: GPL-3.0-or-later
"""What stereo knows of the photos' depths, kept for the training that started on them."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..array_file import read_arrays
from ..dataset.camera import Camera
from ..errors import ParseError
from ..files import write_bytes
from .depth_maps import DepthMap

FILE_NAME = "depth_priors.npz"

PLANE_STEP_PX = 5
PLANE_SHARE = 0.004
"""Largest second difference of inverse depths so far apart, as a share, on a plane. On the room of
benchmarks/scenes a third of the pixels pass, whose depths err by 0.02 % of the diagonal in the
median and 0.06 % at 90 % (all confirmed ones: 0.03 and 0.27 %). On curved things hardly any pass,
and there training finds the surface better than windows do."""


@dataclass(frozen=True)
class DepthPrior:
    """What is known of the depths of one photo."""

    camera: Camera
    """Of this size, scene frame."""
    depth: np.ndarray
    """(h, w) float32 z-depth, scene units; 0 where nothing is confirmed or planar."""
    confidence: np.ndarray
    """(h, w) float32 in [0, 1]; 0 where nothing is confirmed."""
    known: np.ndarray
    """(h, w) float32 confirmed z-depth, of planes or not; 0 where nothing is confirmed."""
    free: np.ndarray
    """(h, w) float32 z-depth before which the photo shows nothing; 0 where that is not known."""


_LAYERS = ("depth", "confidence", "known", "free")
_MOST_HEADER_BYTES = 1024
"""Of an array in the file; the key is no longer either."""


def priors_of(views: Sequence[int], depth_maps: Sequence[DepthMap]) -> dict[int, DepthPrior]:
    """Return the priors of views, by view."""
    priors = {}
    for view, found in zip(views, depth_maps, strict=True):
        plane = planar_pixels(found)
        priors[view] = DepthPrior(
            found.camera,
            np.where(plane, found.depth, np.float32(0)),
            np.where(plane, found.confidence, np.float32(0)),
            np.where(found.confidence > 0, found.depth, np.float32(0)),
            np.zeros_like(found.depth) if found.free is None else found.free,
        )
    return priors


def planar_pixels(depth_map: DepthMap) -> np.ndarray:
    """Tell where the depth of a pixel is that of a plane through its neighbours, (h, w) bool.

    On a plane, inverse depth is linear in the pixel. The neighbours lie :data:`PLANE_STEP_PX` away
    in all eight directions, and are confirmed.
    """
    confirmed, step = depth_map.confidence > 0, PLANE_STEP_PX
    inverse = 1.0 / depth_map.depth.astype(np.float64)
    planar = confirmed.copy()
    for x, y in ((step, 0), (0, step), (step, step), (step, -step)):
        one, other = (np.roll(inverse, shift, (0, 1)) for shift in ((y, x), (-y, -x)))
        planar &= np.abs(one + other - 2.0 * inverse) <= PLANE_SHARE * inverse
        for shift in ((y, x), (-y, -x)):
            planar &= np.roll(confirmed, shift, (0, 1))
    planar[:step] = planar[-step:] = False
    planar[:, :step] = planar[:, -step:] = False
    return planar


def save_priors(folder: Path, priors: Mapping[int, DepthPrior], key: str) -> None:
    """Write ``depth_priors.npz`` into a folder; ``key`` names what they were made from."""
    arrays = {"key": np.array(key)}
    for view, prior in priors.items():
        arrays |= {f"{layer}.{view}": getattr(prior, layer) for layer in _LAYERS}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(folder / FILE_NAME, buffer.getvalue())


def load_priors(
    folder: Path, cameras: Mapping[int, Camera], key: str, views: Collection[int] | None = None
) -> dict[int, DepthPrior] | None:
    """Read what :func:`save_priors` wrote for the same key.

    Parameters
    ----------
    cameras : mapping of int to Camera
        Of all views that were matched, at the size they were matched at.
    views : collection of int, optional
        Those that priors are wanted for; by default all.

    Returns
    -------
    dict of int to DepthPrior, or None
        ``None`` where the file is missing, damaged or of another key: the priors follow from the
        photos and can be made again.
    """
    wanted = cameras.keys() if views is None else views
    names = ["key", *(f"{layer}.{view}" for view in wanted for layer in _LAYERS)]
    pixels = sum(camera.width * camera.height for camera in cameras.values())
    entries = 1 + len(_LAYERS) * len(cameras)
    most_bytes = 4 * len(_LAYERS) * pixels + _MOST_HEADER_BYTES * entries
    try:
        arrays = read_arrays(folder / FILE_NAME, names, most_bytes=most_bytes)
        if str(arrays["key"]) != key:
            return None
        return {
            view: _prior(cameras[view], [arrays[f"{layer}.{view}"] for layer in _LAYERS])
            for view in wanted
        }
    except (ParseError, ValueError):
        return None


def _prior(camera: Camera, layers: Sequence[np.ndarray]) -> DepthPrior:
    for layer in layers:
        if not (layer.dtype == np.float32 and layer.ndim == 2 and np.isfinite(layer).all()):
            raise ValueError("not (h, w) float32 depths and confidences")
        if layer.shape != (camera.height, camera.width):
            raise ValueError(f"depths are {layer.shape}, the photo is matched at another size")
    return DepthPrior(camera, *layers)
