# SPDX-License-Identifier: GPL-3.0-or-later
"""Divide a coarse training into blocks of about the same cost (docs/method.md, section 16)."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from ...dataset.camera import Camera
from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...dataset.view_split import evenly_spaced, training_views
from ...errors import UsageError
from ...kernels.parallel import default_threads
from ...progress import Progress
from ...regions.tiling import Tiling, split_evenly
from ...render.types.renderer import Renderer
from ...render.view_renderer import ViewRenderer
from ...settings import TrainingSettings
from ..density.contribution import largest_contributors
from ..selection.image_size_selection import photo_detail, select_image_size
from ..trainer import DETAIL_PHOTOS
from .block_plan import Block, BlockPlan
from .block_settings import BlockSettings
from .coarse_training import CoarseTraining
from .photo_choice import Visibility, chosen_photos

_logger = logging.getLogger(__name__)

OUTLIER_SHARE = 0.005
"""Share of the weight at either end of each axis that no cell is divided by."""

NEAREST_SHARE, FAR_DEPTHS = 0.1, 5.0
"""What a photo shows deeper than so many times the depth of its nearest tenth is not what blocks
are divided by: sky fills half of a photo, and margins as wide as the sky hold the whole scene."""

BALANCE_ROUNDS = 3
"""Divisions that are tried. The first one is by what photos show; where a cell then costs more than
that, because its photos show other cells as well, the next one counts it for more."""

SHOWN_SHARE = 0.5
"""A Gaussian is trained by a block whose photos hold at least this share of its weight in all
photos. Others stand still: as the block's photos hardly show them, it would only disturb them."""


def plan_blocks(
    coarse: CoarseTraining,
    scene: Scene,
    photos: PhotoSource,
    settings: TrainingSettings,
    blocks: BlockSettings,
    progress: Progress,
    *,
    renderer: Renderer | None = None,
    threads: int = 0,
) -> BlockPlan:
    """Divide a training into blocks. The plan depends on the inputs alone.

    Parameters
    ----------
    coarse : CoarseTraining
    scene : Scene
        With the poses of the coarse training.
    photos : PhotoSource
        Of this scene, at the size that blocks train at.
    settings : TrainingSettings
        Of the whole training.
    blocks : BlockSettings
    progress : Progress
        Checked for cancellation before each photo.
    renderer : Renderer, optional
        Overwrites its last view; by default one on the processor.
    threads : int
        The plan does not depend on it.

    Raises
    ------
    UsageError
        There are more blocks than the photos can be divided into.
    Cancelled
    """
    threads = threads or default_threads()
    views = training_views(scene, photos, settings.holdout_every)
    gaussians = coarse.gaussians
    means = gaussians.means.double().numpy()
    if blocks.blocks > min(len(views), len(means)):
        raise _too_many(blocks.blocks, f"{len(views)} photos, {len(means)} Gaussians")
    seen = Visibility(gaussians, photos, views, renderer or ViewRenderer(), threads)
    total, near = np.zeros(len(means)), np.zeros(len(means))
    shown = seen.weights(progress.span(0.0, 0.2), "what photos show")
    for view, weights in zip(views, shown, strict=True):
        total += weights
        near += np.where(_is_near(photos.camera(view, 1), means, weights), weights, 0.0)
    if not total.any():
        raise UsageError(
            "No photo shows any Gaussian of the coarse training.", "Check the camera poses."
        )
    cameras = [photos.camera(view, 1) for view in views]
    sizes = np.array([camera.width * camera.height for camera in cameras])
    tiling, chosen = _balanced(means, near, sizes, blocks, seen, progress.span(0.2, 0.8))
    low, high = _extent(means, near)
    margins = _margins(tiling, blocks.margin, low, high)
    within = [tiling.within(index, means, margins[index]) for index in range(blocks.blocks)]
    own = [np.zeros(np.count_nonzero(inside)) for inside in within]
    needed = np.zeros((blocks.blocks, len(means)), np.bool_)
    for row, weights in enumerate(seen.weights(progress.span(0.8, 1.0), "photos of blocks")):
        largest = largest_contributors(weights, blocks.hidden_share)
        for index in np.flatnonzero(chosen[row]):
            own[index] += weights[within[index]]
            needed[index, largest] = True
    owner = tiling.owner(means)
    trained = [
        np.flatnonzero(inside)[held >= SHOWN_SHARE * total[inside]]
        for inside, held in zip(within, own, strict=True)
    ]
    limits = _limits(owner, trained, settings.max_gaussians)
    made = []
    for index, rows in enumerate(trained):
        needed[index, rows] = False
        mine = chosen[:, index]
        if len(rows) == 0:
            raise _too_many(blocks.blocks, f"nothing to train in block {index}")
        made.append(
            Block(
                tuple(np.array(views)[mine].tolist()),
                rows.astype(np.int32),
                np.flatnonzero(needed[index]).astype(np.int32),
                limits[index],
                int(sizes[mine].sum()),
            )
        )
        _logger.info(
            "block %d: %d photos, %d Gaussians to train, %d around them",
            index, len(made[-1].views), len(rows), len(made[-1].still),
        )  # fmt: skip
    return BlockPlan(
        coarse, tiling, margins, tuple(made), tuple(views), blocks.begin,
        _full_size(photos, views, settings),
    )  # fmt: skip


def _is_near(camera: Camera, means: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Tell which Gaussians a photo shows not much deeper than what is nearest, (n,) bool."""
    shown = np.flatnonzero(weights)
    depths = camera.to_camera(means[shown])[:, 2]
    order = np.argsort(depths, kind="stable")
    held = np.cumsum(weights[shown][order])
    result = np.zeros(len(means), np.bool_)
    if len(shown):
        nearest = depths[order[np.searchsorted(held, NEAREST_SHARE * held[-1])]]
        result[shown[depths <= FAR_DEPTHS * nearest]] = True
    return result


def _balanced(
    means: np.ndarray,
    near: np.ndarray,
    sizes: np.ndarray,
    blocks: BlockSettings,
    seen: Visibility,
    progress: Progress,
) -> tuple[Tiling, np.ndarray]:
    """Return the cells, and the photos of each, (photos, cells) bool, of least largest cost."""
    low, high = _extent(means, near)
    costs = np.where(((means >= low) & (means <= high)).all(1), near, 0.0)
    best: tuple[int, Tiling, np.ndarray] | None = None
    for number in range(BALANCE_ROUNDS):
        tiling = split_evenly(means, costs, (low, high), lambda count, _: count >= blocks.blocks)
        owner = tiling.owner(means)
        part = progress.span(number / BALANCE_ROUNDS, (number + 1) / BALANCE_ROUNDS)
        margins = _margins(tiling, blocks.margin, low, high)
        within = [tiling.within(k, means, reach) for k, reach in enumerate(margins)]
        # No product of matrices: its sums depend on the threads of the linear algebra.
        shown = np.array(
            [_sums(weights, within) for weights in seen.weights(part, "dividing the scene")]
        )
        chosen = chosen_photos(shown, blocks.coverage)
        pixels = sizes @ chosen
        if best is None or pixels.max() < best[0]:
            best = (int(pixels.max()), tiling, chosen)
        held = np.bincount(owner, costs, len(tiling))
        costs *= np.divide(pixels, held, out=np.zeros(len(tiling)), where=held > 0.0)[owner]
    assert best is not None
    return best[1], best[2]


def _sums(weights: np.ndarray, within: Sequence[np.ndarray]) -> list[float]:
    """Return the sum of a photo's weights in each cell; looks only at what the photo shows."""
    rows = np.flatnonzero(weights)
    held = weights[rows]
    return [float(held[inside[rows]].sum()) for inside in within]


def _extent(means: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the box that holds most of what photos show near, its lowest and highest corner."""
    corners = []
    for axis in range(3):
        order = np.argsort(means[:, axis], kind="stable")
        share = np.cumsum(near[order]) / near.sum()
        ends = np.searchsorted(share, (OUTLIER_SHARE, 1.0 - OUTLIER_SHARE))
        corners.append(means[order[np.minimum(ends, len(means) - 1)], axis])
    low, high = np.array(corners).T
    return low, high


def _margins(tiling: Tiling, share: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the (cells, 3) margins: a share of each cell's extent in the box of the scene."""
    cells = [tiling.box(index) for index in range(len(tiling))]
    sizes = [np.minimum(last, high) - np.maximum(first, low) for first, last in cells]
    return share * np.maximum(sizes, 0.0)


def _limits(owner: np.ndarray, trained: Sequence[np.ndarray], most: int) -> list[int]:
    """Return the largest number of Gaussians of each block, so that cells together hold ``most``.

    In proportion to those it begins with: the margin, which is cut off in the end, has its share.
    """
    counted = sum(int((owner[rows] == index).sum()) for index, rows in enumerate(trained))
    growth = max(1.0, (most - (len(owner) - counted)) / max(1, counted))
    return [max(len(rows), int(growth * len(rows))) for rows in trained]


def _full_size(photos: PhotoSource, views: Sequence[int], settings: TrainingSettings) -> bool:
    """Decide for all blocks whether photos are trained on at their full size."""
    sample = evenly_spaced(views, DETAIL_PHOTOS)
    found = select_image_size([photo_detail(photos.photo(v, 1), photos.mask(v, 1)) for v in sample])
    return found.uses_full_size(settings.full_size)


def _too_many(blocks: int, what: str) -> UsageError:
    return UsageError(
        f"The training cannot be divided into {blocks} blocks: {what}.", "Choose fewer blocks."
    )
