# SPDX-License-Identifier: GPL-3.0-or-later
"""Train on masked photos as empty space: composite render and photo over a random background.

With ``mask_mode="ignore"`` masked pixels enter no loss and may show anything. With ``"background"``
the space behind them must be empty: over a colour that changes every iteration, no Gaussian can
imitate the background, so that only transparency lowers the loss.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from .. import limits
from ..parallel import ArrayStore
from ..scene.camera import Camera

MIN_SHARE = 0.75
"""Points of the object lie inside its mask in every photo; this tolerates some bad masks."""


def draw_background(random: np.random.Generator) -> np.ndarray:
    """Return a random colour (3,) float32 in [0, 1); three numbers are drawn."""
    return random.random(3).astype(np.float32)


def composited(
    color: np.ndarray, alpha: np.ndarray, photo: np.ndarray, mask: np.ndarray | None,
    background: np.ndarray, *, store: ArrayStore | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Composite render and photo over a background colour, to be compared without a mask.

    Parameters
    ----------
    color : (h, w, 3) float32 or float64
        Render, blended over black (``sum w c``).
    alpha : (h, w), the same type
    photo : (h, w, 3) uint8, or floats in [0, 1]
    mask : (h, w) bool, optional
        False where the photo must be empty. Without it, the photo is unchanged.
    background : (3,)
        In [0, 1].
    store : ArrayStore, optional
        Memory for both, which are then valid until the next call with it.

    Returns
    -------
    image : (h, w, 3), of the colour's type
        ``color + (1 - alpha) background``.
    target : (h, w, 3), the same type
        The photo inside the mask, the background elsewhere.
    """
    color, alpha, store = np.asarray(color), np.asarray(alpha), store or ArrayStore()
    behind = np.asarray(background, color.dtype)
    image, target = (
        store.take(f"{name} {color.dtype}", color.shape, color.dtype)
        for name in ("over background", "target")
    )
    np.multiply((1 - alpha)[..., None], behind, out=image)  # (h, w, 3)
    image += color
    white = 255.0 if np.asarray(photo).dtype == np.uint8 else 1.0
    np.multiply(photo, color.dtype.type(1.0 / white), out=target, casting="unsafe")
    if mask is not None:
        target[~np.asarray(mask, np.bool_)] = behind
    return image, target


def background_gradient(by_image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Return the gradient of :func:`composited` on alpha (h, w); on colour it is ``by_image``."""
    return -(by_image @ np.asarray(background, by_image.dtype))


def inside_masks(
    points: np.ndarray,
    cameras: Sequence[Camera],
    masks: Iterable[np.ndarray | None],
) -> np.ndarray:
    """Tell which points (n, 3), scene frame, lie inside the masks of most photos that hold them.

    Other points would initialise Gaussians in empty space, and would extend an automatic region
    over what was masked out. ``None`` masks nothing; one mask is held at a time. The result, (n,)
    bool, is false also for points outside all images.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    held, inside = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for camera, mask in zip(cameras, masks, strict=True):
        rows, columns, _, seen = pixels_of(points, camera)
        held[seen] += 1
        inside[seen] += 1 if mask is None else mask[rows, columns]
    return (inside > 0) & (inside >= MIN_SHARE * held)


def pixels_of(
    points: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and depths (m,) of the points in an image, and their indices (m,)."""
    where, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        held = (depth > limits.NEAR_Z) & (where >= 0).all(axis=1)
        held &= (where[:, 0] < camera.width) & (where[:, 1] < camera.height)
    seen = np.nonzero(held)[0]
    column, row = np.floor(where[seen]).astype(np.int64).T
    return row, column, depth[seen], seen
