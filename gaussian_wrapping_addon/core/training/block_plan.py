# SPDX-License-Identifier: GPL-3.0-or-later
"""A training in blocks: coarse training, cells, their photos, files of the plan."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..array_file import read_arrays, write_arrays
from ..errors import ParseError, UsageError
from ..files import read_json, write_json
from ..gaussians.model import OrientedGaussians
from ..limits import MAX_BLOCKS
from ..parallel import default_threads
from ..progress import Progress, ReportWarning
from ..regions.shapes import Tiling, split_evenly
from ..render.projection import RawArrays
from ..render.types import Renderer, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..scene.camera import Camera
from ..scene.scene import PhotoSource, Scene, evenly_spaced, training_views
from ..settings import TrainingSettings
from ..stereo.depth_maps import FILE_NAME, DepthPrior, load_priors, matching_divisor
from .backend import Backend
from .density import largest_contributors
from .exposure import Exposure
from .focus import Focus
from .image_size_selection import photo_detail, select_image_size
from .live_view import divisor_for
from .model_selection import ModelSelection
from .start import Handover
from .state import fingerprint, load_checkpoint
from .trainer import DETAIL_PHOTOS, train

# -- How a training is divided into blocks, and the settings of the coarse training before it -----

SMALLEST_PX = 32
"""Least long side of the photos of the coarse training: that of the setting."""

MARGIN = 0.2
"""A block also trains what lies so far outside of its cell, as a share of the cell's size."""

COARSE_ITERATIONS, COARSE_PX = 0.3, 0.5
"""Shares of the iterations, and of the photos' long side, that the coarse training has."""

COARSE_GAUSSIANS = 0.5
"""Share of the Gaussians that the coarse training has at most; less for more blocks, so that it
does not need the most memory (:func:`coarse_settings`)."""

BEGIN = 0.1
"""Share of the schedule at which blocks begin. Earlier than the coarse training has come: what they
add takes most rounds of growth, and moves fastest, at first."""

COVERAGE = 0.95
"""A block takes the fewest photos that together show this share, by weight, of what lies in its
cell and margin."""

HIDDEN_SHARE = 0.002
"""Of the Gaussians around a block, those stay away that make up less than this share of the weights
in each of its photos."""

POLISH_ITERATIONS = 0.1
"""Share of the iterations that the joined Gaussians are trained together."""


def coarse_settings(settings: TrainingSettings) -> TrainingSettings:
    """Return the settings of the coarse training, for settings of the whole training."""
    share = min(COARSE_GAUSSIANS, 2.0 / settings.blocks)
    return dataclasses.replace(
        settings,
        iterations=max(1, round(COARSE_ITERATIONS * settings.iterations)),
        extra_iterations=0,
        max_gaussians=max(1, round(share * settings.max_gaussians)),
        max_image_px=max(SMALLEST_PX, math.ceil(COARSE_PX * settings.max_image_px)),
    )


# -- The coarse training of a whole scene: what all blocks start from and do not decide anew ------


@dataclass(frozen=True, eq=False)
class CoarseTraining:
    """Gaussians of the whole scene, and all that was decided about its model."""

    gaussians: OrientedGaussians
    """float32, scene frame, without harmonics that are not used, and without a backdrop."""
    model_selection: ModelSelection
    exposure: Exposure | None
    """Exposures of all views, or ``None`` where they are not modelled."""
    poses: np.ndarray | None
    """(views, 3, 4) float64 refined ``cam_from_world``, or ``None`` where those given hold."""
    key: str
    """Names its inputs: the confirmed depths in its folder carry it."""
    warnings: tuple[ReportWarning, ...] = ()
    """Of the training; none in a plan that was read from its file."""


def train_coarse(
    scene: Scene, photos: PhotoSource, settings: TrainingSettings, folder: Path, progress: Progress,
    *, seed: int = 0, threads: int = 0, focus: Focus | None = None,
    backend: Backend | None = None,
) -> CoarseTraining:  # fmt: skip
    """Train the whole scene coarsely, or read a finished such training of the same folder.

    Parameters
    ----------
    settings : TrainingSettings
        Of :func:`coarse_settings`; the photos have their size. All else is as for
        :func:`~.trainer.train`, and so are the errors raised.
    """
    result = train(
        scene, photos, settings, folder, progress,
        seed=seed, threads=threads, focus=focus, backend=backend,
    )  # fmt: skip
    settings = dataclasses.replace(settings, mask_mode=scene.mask_mode(settings.mask_mode))
    key = fingerprint(scene, settings, seed)
    state = load_checkpoint(folder, key)
    if state is None:
        raise ParseError(
            folder, "checkpoint", "was removed while the training ended.", "Train again."
        )
    own = torch.arange(len(state.adam))  # what lies behind them is the backdrop
    return CoarseTraining(
        result.gaussians.select(own), state.model_selection, state.exposure, result.poses, key,
        result.warnings,
    )  # fmt: skip


def confirmed_depths(
    coarse: CoarseTraining, folder: Path, photos: PhotoSource, settings: TrainingSettings,
    all_views: Sequence[int], views: Sequence[int],
) -> dict[int, DepthPrior]:  # fmt: skip
    """Read the depths that a dense start of the coarse training confirmed for some views.

    There are none without a dense start, or where the settings have no use for depths. ``folder``,
    ``photos`` and ``settings`` are the coarse training's, ``all_views`` all training views.

    Raises
    ------
    ParseError
        The file is missing, damaged or of another training.
    """
    wanted = settings.lambda_depth_prior > 0.0 or settings.free_views > 0
    if not (wanted and coarse.model_selection.chose("dense_start")):
        return {}
    divisor = matching_divisor([photos.camera(view, 1) for view in all_views], settings.match_px)
    cameras = {view: photos.camera(view, divisor) for view in all_views}
    priors = load_priors(folder, cameras, coarse.key, views)
    if priors is None:
        raise ParseError(
            folder / FILE_NAME, "whole file", "missing, damaged, or of another training.",
            "Delete the folder of the coarse training and train again.",
        )  # fmt: skip
    return priors


# -- The plan of a training in blocks: cells, photos of each, what it trains and what stands still


@dataclass(frozen=True, eq=False)
class Block:
    """One part of a training. Rows are those of the coarse training's Gaussians."""

    views: tuple[int, ...]
    """Training views, in increasing order."""
    trained: np.ndarray
    """(t,) int32 increasing: in the cell or its margin, and shown by these views."""
    still: np.ndarray
    """(s,) int32 increasing: rendered as they are, because these views show them."""
    max_gaussians: int
    """Largest number of those that are trained."""
    pixels: int
    """Of its photos together, which its time is in proportion to."""


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """How a coarse training is continued in blocks."""

    coarse: CoarseTraining
    tiling: Tiling
    """Cells of the blocks, half-open boxes that partition space, scene frame."""
    margins: np.ndarray
    """(blocks, 3) float64: how far outside of its cell a block trains, scene units."""
    blocks: tuple[Block, ...]
    views: tuple[int, ...]
    """All training views."""
    begin: float
    """Share of the schedule at which blocks begin."""
    full_size: bool
    """Whether photos are trained on at their full size, not at half of it."""

    def kept(self, index: int) -> np.ndarray:
        """Return the rows in a block's cell that it does not train, (k,) int64 increasing."""
        owner = self.tiling.owner(self.coarse.gaussians.means.double().numpy())
        return np.setdiff1d(np.flatnonzero(owner == index), self.blocks[index].trained)

    @functools.cached_property
    def digest(self) -> str:
        """Hash of all of it."""
        digest = hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode())
        for name, array in sorted(self.to_arrays().items()):
            digest.update(f"{name} {array.dtype} {array.shape} ".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def handover(self, part: str, **further: Any) -> Handover:
        """Return a handover of what all parts take over alike.

        ``part`` names it among those of the plan; ``further`` are the other fields.
        """
        # Each block decides by its own photos whether it is for the regions.
        lasting = tuple(d for d in self.coarse.model_selection if d.name != "region_weight")
        return Handover(
            degree=self.coarse.gaussians.sh_degree,
            model_selection=ModelSelection(lasting),
            exposure=self.coarse.exposure,
            filter_views=self.views,
            digest=f"{self.digest} {part}",
            **further,
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values of all but the arrays."""
        return {
            "splits": self.tiling.to_json(),
            "views": list(self.views),
            "begin": self.begin,
            "full_size": self.full_size,
            "key": self.coarse.key,
            "decisions": self.coarse.model_selection.to_json(),
            "blocks": [
                {"views": list(b.views), "max_gaussians": b.max_gaussians, "pixels": b.pixels}
                for b in self.blocks
            ],
        }

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays, by name."""
        coarse = self.coarse
        arrays = {f"gaussians.{n}": t.detach().numpy() for n, t in coarse.gaussians.tensors()}
        arrays["margins"] = self.margins
        if coarse.exposure is not None:
            arrays |= {f"exposure.{n}": array for n, array in coarse.exposure.to_arrays().items()}
        if coarse.poses is not None:
            arrays["poses"] = coarse.poses
        for index, block in enumerate(self.blocks):
            arrays |= {f"trained.{index}": block.trained, f"still.{index}": block.still}
        return arrays


# -- What photos show of the coarse Gaussians, and which of them a block needs --------------------

LONGEST_PX = 144
"""Long side of the views that are rendered: shares of an image need no detail."""


class Visibility:
    """Renders what each photo shows of some Gaussians, small, in the renderer's last view."""

    def __init__(
        self, gaussians: OrientedGaussians, photos: PhotoSource, views: Sequence[int],
        renderer: Renderer, threads: int,
    ) -> None:  # fmt: skip
        self._raw, self._photos, self._views = RawArrays.from_gaussians(gaussians), photos, views
        self._renderer = renderer
        self._options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)

    def weights(self, progress: Progress, doing: str) -> Iterator[np.ndarray]:
        """Yield, view by view, the share of the image that each Gaussian fills, (n,) float64.

        Raises
        ------
        Cancelled
            Before the next view.
        """
        for number, view in enumerate(self._views):
            progress.update(number / len(self._views), f"{doing}, photo {number + 1}")
            camera = self._photos.camera(view, divisor_for(self._photos, view, LONGEST_PX))
            found = self._renderer.render(self._raw, camera, self._options).statistics
            assert found is not None
            yield found.weight_sum.astype(np.float64) / (camera.width * camera.height)


def chosen_photos(shown: np.ndarray, coverage: float) -> np.ndarray:
    """Choose the photos of each block: the fewest that together show most of what it trains.

    A photo that no block would choose belongs to that of which it shows most. ``shown``, (photos,
    blocks) float64, is the weight of each block's cell and margin in each photo, at least 0; the
    chosen ones, (photos, blocks) bool, hold at least ``coverage`` of a block's weights over all
    photos.
    """
    chosen = np.zeros(shown.shape, np.bool_)
    for block, weights in enumerate(shown.T):
        order = np.argsort(-weights, kind="stable")
        before = np.cumsum(weights[order]) - weights[order]  # held by those that show more
        needed = (before < coverage * weights.sum()) & (weights[order] > 0.0)
        chosen[order[needed], block] = True
    left = ~chosen.any(1)
    chosen[left, np.argmax(shown[left], axis=1)] = True
    return chosen


# -- Write and read a plan of blocks: ``blocks.npz``, and ``blocks.json``, which is written last

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
    write_arrays(folder / ARRAYS_NAME, **plan.to_arrays())
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
        gaussians, ModelSelection.from_json(values["decisions"]),
        Exposure.restore(exposure) if exposure else None, poses, str(values["key"]),
    )  # fmt: skip
    blocks = tuple(
        _block(entry, views, len(gaussians), arrays[f"trained.{k}"], arrays[f"still.{k}"])
        for k, entry in enumerate(listed)
    )
    begin = float(values["begin"])
    if not 0.0 <= begin < 1.0:
        raise ValueError(f"begin at {begin}")
    return BlockPlan(coarse, tiling, margins, blocks, views, begin, values["full_size"] is True)


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


# -- Divide a coarse training into blocks of about the same cost (docs/method.md, section 16) -----

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
    coarse: CoarseTraining, scene: Scene, photos: PhotoSource, settings: TrainingSettings,
    progress: Progress, *, threads: int = 0,
) -> BlockPlan:  # fmt: skip
    """Divide a training into ``settings.blocks`` blocks. The plan depends on the inputs alone.

    The scene has the poses of the coarse training, the photos the size that blocks train at.

    Raises
    ------
    UsageError
        There are more blocks than the photos can be divided into.
    Cancelled
        Before the next photo.
    """
    threads, count = threads or default_threads(), settings.blocks
    views = training_views(scene, photos, settings.holdout_every)
    gaussians = coarse.gaussians
    means = gaussians.means.double().numpy()
    if count > min(len(views), len(means)):
        raise _too_many(count, f"{len(views)} photos, {len(means)} Gaussians")
    seen = Visibility(gaussians, photos, views, ViewRenderer(), threads)
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
    tiling, chosen = _balanced(means, near, sizes, count, seen, progress.span(0.2, 0.8))
    low, high = _extent(means, near)
    margins = _margins(tiling, low, high)
    within = [tiling.within(index, means, margins[index]) for index in range(count)]
    own = [np.zeros(np.count_nonzero(inside)) for inside in within]
    needed = np.zeros((count, len(means)), np.bool_)
    for row, weights in enumerate(seen.weights(progress.span(0.8, 1.0), "photos of blocks")):
        largest = largest_contributors(weights, HIDDEN_SHARE)
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
            raise _too_many(count, f"nothing to train in block {index}")
        still = np.flatnonzero(needed[index]).astype(np.int32)
        own_views, pixels = tuple(np.array(views)[mine].tolist()), int(sizes[mine].sum())
        made.append(Block(own_views, rows.astype(np.int32), still, limits[index], pixels))
        _logger.info(
            "block %d: %d photos, %d Gaussians to train, %d around them",
            index, len(own_views), len(rows), len(still),
        )  # fmt: skip
    # Decided for all blocks alike: whether photos are trained on at their full size.
    sample = evenly_spaced(views, DETAIL_PHOTOS)
    found = select_image_size([photo_detail(photos.photo(v, 1), photos.mask(v, 1)) for v in sample])
    full_size = found.uses_full_size(settings.full_size)
    return BlockPlan(coarse, tiling, margins, tuple(made), tuple(views), BEGIN, full_size)


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
    means: np.ndarray, near: np.ndarray, sizes: np.ndarray, cells: int, seen: Visibility,
    progress: Progress,
) -> tuple[Tiling, np.ndarray]:  # fmt: skip
    """Return the cells, and the photos of each, (photos, cells) bool, of least largest cost."""
    low, high = _extent(means, near)
    costs = np.where(((means >= low) & (means <= high)).all(1), near, 0.0)
    best: tuple[int, Tiling, np.ndarray] | None = None
    for number in range(BALANCE_ROUNDS):
        tiling = split_evenly(means, costs, (low, high), lambda count, _: count >= cells)
        owner = tiling.owner(means)
        part = progress.span(number / BALANCE_ROUNDS, (number + 1) / BALANCE_ROUNDS)
        margins = _margins(tiling, low, high)
        within = [tiling.within(k, means, reach) for k, reach in enumerate(margins)]
        # No product of matrices: its sums depend on the threads of the linear algebra.
        shown = np.array(
            [_sums(weights, within) for weights in seen.weights(part, "dividing the scene")]
        )
        chosen = chosen_photos(shown, COVERAGE)
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


def _margins(tiling: Tiling, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the (cells, 3) margins: a share of each cell's extent in the box of the scene."""
    cells = [tiling.box(index) for index in range(len(tiling))]
    sizes = [np.minimum(last, high) - np.maximum(first, low) for first, last in cells]
    return MARGIN * np.maximum(sizes, 0.0)


def _limits(owner: np.ndarray, trained: Sequence[np.ndarray], most: int) -> list[int]:
    """Return the largest number of Gaussians of each block, so that cells together hold ``most``.

    In proportion to those it begins with: the margin, which is cut off in the end, has its share.
    """
    counted = sum(int((owner[rows] == index).sum()) for index, rows in enumerate(trained))
    growth = max(1.0, (most - (len(owner) - counted)) / max(1, counted))
    return [max(len(rows), int(growth * len(rows))) for rows in trained]


def _too_many(blocks: int, what: str) -> UsageError:
    return UsageError(
        f"The training cannot be divided into {blocks} blocks: {what}.", "Choose fewer blocks."
    )
