# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: exposure, and what needs no training to decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..image_metrics import FIT_BRIGHTEST, FIT_DARKEST
from ..scene.scene import PhotoSource, Scene
from ..settings import TrainingSettings
from .background import pixels_of
from .exposure import SRGB_PEDESTAL, Exposure
from .model_selection import Decision, ModelSelection, decide, select_multi_view

# -- Detect, before training, whether the photos differ in exposure -------------------------------
#
# See docs/method.md, section 4.4.
#
# The colour of every sparse point is sampled in every photo that may see it. Visibility is not
# known: points behind others are rejected by a coarse depth buffer, and the remaining outliers
# (occlusion, highlights, wrong matches) by weights that fall with the square of the disagreement.
#
# An exposure changes all parts of a scene alike; view-dependent shading changes one. A thin
# object lit from one side and seen from both looks like an exposure if all points are taken
# together. So the points are split spatially, gains are solved for each part alone, and the
# consensus of the parts decides.

NEEDED_SPREAD = 0.025
"""Robust spread of the log gains above which exposures are modelled. At middle grey such photos
differ by 1.2 % of white, an error that alone limits the PSNR to 38 dB. Among the scenes it was
chosen on, rendered at one exposure, a matte body has 0.002 and a thin fence lit from one side
0.011; photos altered by factors of light up to 1.35 either way have 0.060."""

MIN_STANDARD_ERRORS = 4.0
"""The spread must also exceed this many standard errors of a photo's gain."""

OUTLIER_SPREADS = 3.0
OUTLIER_SHARE = 0.1
"""Exposures are also modelled if at least this share of the photos (at least two) differ from the
median by more than :data:`OUTLIER_SPREADS` times :data:`NEEDED_SPREAD`, which a median deviation
does not show."""

MIN_POINTS = 24
"""Sum of point weights from which a photo's gain is known."""
MIN_PHOTOS = 3
MIN_KNOWN_SHARE = 0.5
"""Share of the photos whose gain must be known for a decision."""

PARTS = 8
"""Number of parts into which the points are split, a power of two; fewer for few points."""
MIN_PART_POINTS = 80
MIN_POINTS_IN_PART = 12
"""Like :data:`MIN_POINTS`, for a photo's gain from one part alone."""
MIN_PART_SHARE = 0.2
"""Share of the photos for which a part must give known gains to count."""

SAMPLE_SIDE_PX = 128
"""Photos are downsampled as long as their long side stays at least this: averaged pixels are less
noisy and tolerate pose errors."""

MAX_POINTS = 4000
MAX_SAMPLES = 2_000_000
"""Most samples of points in photos; bounds the memory (about 60 bytes each)."""

BUFFER_CELLS = 24
"""Cells of the depth buffer along the long side of a photo."""
OCCLUSION_SHARE = 0.06
"""A point is occluded if it lies behind the nearest one around it by this share of the depth."""

ROUNDS = 24
FIRST_SCALE, LAST_SCALE = 0.3, 0.06
"""Scale of the robust weights in log colour, in the first and last round: it must admit gains at
first and only noise at last."""
PRIOR_POINTS = 5.0
"""Weight of the prior towards a gain of one, in points."""


@dataclass(frozen=True)
class ExposureEvidence:
    """Evidence on whether to train gains and offsets per photo."""

    needed: bool
    known: bool
    """False if the data do not suffice; exposures are then not modelled."""
    spread: float
    """Robust standard deviation, over the photos, of the consensus log gain of the scene's parts;
    largest of the three channels."""
    outliers: int
    """Number of photos whose gain is far from the median."""
    photos: int
    """Number of photos whose gain is known."""
    log_gains: np.ndarray
    """(views of the scene, 3) float64, median 0: initial values for training; 0 where unknown.
    Of display values plus :data:`.exposure.SRGB_PEDESTAL`."""
    evidence: str
    """One sentence for the report."""


@dataclass(frozen=True)
class LogGains:
    """Gains of photos, from :func:`solve_log_gains`."""

    values: np.ndarray
    """(photos, 3), median 0 over the photos with enough points."""
    errors: np.ndarray
    """(photos, 3) standard errors; inf where there is no point."""
    points: np.ndarray
    """(photos, 3) sums of the point weights."""


def select_exposure(scene: Scene, photos: PhotoSource, views: Sequence[int]) -> ExposureEvidence:
    """Decide from the colours of the sparse points whether to model exposures of the views.

    With too few points, the evidence is ``known=False`` and ``needed=False``: the mean brightness
    of photos is no evidence, since they show different things.
    """
    views = list(views)
    count = len(scene.views)
    finite = np.isfinite(scene.points).all(axis=1) if len(scene.points) else np.zeros(0, bool)
    kept = np.nonzero(finite)[0]
    most = max(MIN_POINTS, min(MAX_POINTS, MAX_SAMPLES // max(1, len(views))))
    if len(kept) > most:
        kept = kept[np.linspace(0, len(kept) - 1, most).round().astype(np.int64)]
    points = np.asarray(scene.points, np.float64).reshape(-1, 3)[kept]
    if len(views) < MIN_PHOTOS or len(points) < MIN_POINTS:
        few = f"{len(views)} photos and {len(points)} sparse points"
        return _unknown(count, f"Unknown: {few} are too few to compare.")
    colors, valid = sample_points(points, photos, views)
    reference = np.asarray(scene.point_colors).reshape(-1, 3)[kept] / 255.0
    found = solve_log_gains(colors, valid, reference)
    parts = [solve_log_gains(colors[p], valid[p], reference[p]) for p in split_spatially(points)]
    shared = int(np.count_nonzero(valid.any(axis=2).sum(axis=1) >= 2))
    return exposure_evidence(found, parts, views, count, shared)


def split_spatially(points: np.ndarray) -> list[np.ndarray]:
    """Return indices of up to :data:`PARTS` parts, by repeated median splits of the widest axis."""
    parts = [np.arange(len(points))]
    while len(parts) < PARTS and len(points) >= 2 * len(parts) * MIN_PART_POINTS:
        halves = []
        for part in parts:
            # Without the outermost tenths: far points must not choose the axis.
            low, high = np.quantile(points[part], (0.1, 0.9), axis=0)
            order = part[np.argsort(points[part, np.argmax(high - low)], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        parts = halves
    return parts


def sample_points(
    points: np.ndarray, photos: PhotoSource, views: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points' colours in the photos that may see them.

    Returns
    -------
    colors : (n, views, 3) float32
        Display values in [0, 1].
    valid : (n, views, 3) bool
        The point lies in the photo and its mask, no other point occludes it, and the value is not
        clipped.
    """
    colors = np.zeros((len(points), len(views), 3), np.float32)
    valid = np.zeros(colors.shape, bool)
    for slot, view in enumerate(views):
        base = photos.camera(view, 1)
        side = max(base.width, base.height)
        divisor = next((d for d in (4, 2) if side >= d * SAMPLE_SIDE_PX), 1)
        camera, photo = photos.camera(view, divisor), photos.photo(view, divisor)
        mask = photos.mask(view, divisor)
        rows, columns, depth, seen = pixels_of(points, camera)
        shown = _unoccluded(rows, columns, depth, max(camera.width, camera.height))
        if mask is not None:
            shown &= mask[rows, columns]
        rows, columns, seen = rows[shown], columns[shown], seen[shown]
        value = photo[rows, columns].astype(np.float32) / np.float32(255.0)  # (m, 3)
        colors[seen, slot] = value
        valid[seen, slot] = (value >= FIT_DARKEST) & (value <= FIT_BRIGHTEST)
    return colors, valid


def _unoccluded(
    rows: np.ndarray, columns: np.ndarray, depth: np.ndarray, side_px: int
) -> np.ndarray:
    """Tell which points are not occluded by a point in the same or a neighbouring cell."""
    cell = max(1.0, side_px / BUFFER_CELLS)
    y, x = (rows / cell).astype(np.int64) + 1, (columns / cell).astype(np.int64) + 1
    nearest = np.full((BUFFER_CELLS + 3, BUFFER_CELLS + 3), np.inf)
    np.minimum.at(nearest, (y, x), depth)
    around = nearest.copy()
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            inner = nearest[1 + dy : nearest.shape[0] - 1 + dy, 1 + dx : nearest.shape[1] - 1 + dx]
            around[1:-1, 1:-1] = np.minimum(around[1:-1, 1:-1], inner)
    return depth <= (1.0 + OCCLUSION_SHARE) * around[y, x]


def solve_log_gains(
    colors: np.ndarray, valid: np.ndarray, reference: np.ndarray | None = None
) -> LogGains:
    """Solve for the gains of photos that align the colours of common points.

    ``log(c[i, p] + 0.055) = level[i] + gain[p]`` by alternating weighted means, with Geman-McClure
    weights, one for the three channels of a sample (an occluder changes all of them), whose scale
    shrinks from :data:`FIRST_SCALE` to :data:`LAST_SCALE`.

    Parameters
    ----------
    colors : (n, photos, 3)
        Display values in [0, 1].
    valid : (n, photos, 3) bool
    reference : (n, 3), optional
        Colours of the points, from photos that see them. By default the medians of ``colors``.
    """
    logs = np.log(np.asarray(colors, np.float64) + SRGB_PEDESTAL).astype(np.float32)
    valid = valid & (valid.any(axis=2).sum(axis=1) >= 2)[:, None, None]
    present = valid.astype(np.float32)
    channels = np.maximum(present.sum(axis=2), 1.0)  # (n, photos)
    if reference is None:
        level = _median_of(logs, valid)
    else:
        level = np.log(np.asarray(reference, np.float64) + SRGB_PEDESTAL).astype(np.float32)
    residual = (logs - level[:, None]) * present
    gain = np.stack([_median_of(residual[..., c].T, valid[..., c].T) for c in range(3)], axis=1)
    weight = present
    for scale in np.geomspace(FIRST_SCALE, LAST_SCALE, ROUNDS):
        residual = (logs - level[:, None] - gain) * present
        square = (residual * residual).sum(axis=2) / channels  # (n, photos)
        weight = present * ((1.0 + square / np.float32(scale**2)) ** -2)[..., None]
        total = weight.sum(axis=0)  # (photos, 3)
        gain = (weight * (logs - level[:, None])).sum(axis=0) / (total + PRIOR_POINTS)
        gain -= _median_gain(gain, total)
        per_point = weight.sum(axis=1)  # (n, 3)
        fresh = (weight * (logs - gain)).sum(axis=1) / np.maximum(per_point, 1e-9)
        level = np.where(per_point > 1e-3, fresh, level)
    residual = (logs - level[:, None] - gain) * present
    total = weight.sum(axis=0).astype(np.float64)
    noise = np.sqrt(((weight * residual) ** 2).sum(axis=0, dtype=np.float64))
    # At least the noise of one 8-bit step: synthetic points may agree to the last bit.
    floor = np.sqrt(np.maximum(total, 1.0)) / 255.0
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.where(total > 0, np.maximum(noise, floor) / total, np.inf)
    return LogGains(gain.astype(np.float64), errors, total)


def exposure_evidence(
    found: LogGains, parts: Sequence[LogGains], views: Sequence[int], count: int, points: int
) -> ExposureEvidence:
    """Return the evidence from gains and their standard errors.

    ``found`` are the gains of the photos ``views`` from all points, ``parts`` those from the points
    of each part of the scene; the scene has ``count`` views, and ``points`` common points.
    """
    known = (found.points >= MIN_POINTS).all(axis=1)
    number = int(np.count_nonzero(known))
    if number < max(MIN_PHOTOS, MIN_KNOWN_SHARE * len(views)):
        only = f"only {number} of {len(views)} photos share enough sparse points"
        return _unknown(count, f"Unknown: {only} to be compared.", number)
    values = found.values[known] - np.median(found.values[known], axis=0)  # (known, 3)
    consensus = _consensus(parts, values, known)
    errors = found.errors[known]
    spread, error = _spread(consensus), float(np.median(errors))
    limit = np.maximum(OUTLIER_SPREADS * NEEDED_SPREAD, MIN_STANDARD_ERRORS * errors)
    far = (np.abs(consensus) > limit) & (np.abs(values) > limit)
    outliers = int(np.count_nonzero(far.any(axis=1)))
    differs = spread > max(NEEDED_SPREAD, MIN_STANDARD_ERRORS * error)
    several = outliers >= max(2.0, OUTLIER_SHARE * number)
    needed = bool(differs or several)
    log_gains = np.zeros((count, 3))
    log_gains[np.asarray(views)[known]] = values
    evidence = (
        f"Gains of {number} photos, from {points} sparse points, have a robust standard deviation "
        f"of {100 * spread:.1f} % by consensus of the scene's parts (limit "
        f"{100 * NEEDED_SPREAD:.1f} %; standard error of a photo {100 * error:.1f} %; all points "
        f"together {100 * _spread(values):.1f} %), and {outliers} photos differ by more than "
        f"{100 * OUTLIER_SPREADS * NEEDED_SPREAD:.1f} %."
    )
    return ExposureEvidence(needed, True, spread, outliers, number, log_gains, evidence)


def _consensus(parts: Sequence[LogGains], values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(known, 3) medians over the parts of each photo's gain, median 0 over the photos.

    A part is seen by some of the photos only, and its gains are relative to their median: aligning
    it with the gains of all points would bias it towards what it has to check.
    """
    rows = []
    for part in parts:
        sure = (part.points[known] >= MIN_POINTS_IN_PART).all(axis=1)
        if np.count_nonzero(sure) < max(MIN_PHOTOS, MIN_PART_SHARE * len(known)):
            continue
        gain = part.values[known]
        level = np.median(gain[sure], axis=0)
        rows.append(np.where(sure[:, None], gain - level, np.nan))
    if not rows:
        return values
    stacked = np.stack(rows)  # (parts, known, 3)
    covered = np.isfinite(stacked[..., 0]).any(axis=0)
    consensus = values.copy()
    consensus[covered] = np.nanmedian(stacked[:, covered], axis=0)
    return consensus - np.median(consensus, axis=0)


def _spread(values: np.ndarray) -> float:
    return float((1.4826 * np.median(np.abs(values), axis=0)).max())


def _unknown(count: int, evidence: str, photos: int = 0) -> ExposureEvidence:
    return ExposureEvidence(False, False, 0.0, 0, photos, np.zeros((count, 3)), evidence)


def _median_of(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the median of the valid values over the second axis; 0 without any."""
    hidden = np.sort(np.where(valid, values, np.inf), axis=1)
    number = valid.sum(axis=1)
    lower, upper = np.maximum(number - 1, 0) // 2, number // 2
    last = values.shape[1] - 1
    low, high = (
        np.take_along_axis(hidden, np.minimum(at, last)[:, None], axis=1)[:, 0]
        for at in (lower, upper)
    )
    with np.errstate(invalid="ignore"):
        middle = 0.5 * (low + high)
    return np.where(number > 0, middle, 0.0).astype(values.dtype)


def _median_gain(gain: np.ndarray, total: np.ndarray) -> np.ndarray:
    """(3,) median gain of the photos with enough points."""
    known = (total >= MIN_POINTS).all(axis=1)
    if not known.any():
        return np.zeros(3, gain.dtype)
    return np.median(gain[known], axis=0).astype(gain.dtype)


# -- All decisions that need no training ----------------------------------------------------------


def first_decisions(
    scene: Scene, photos: PhotoSource, views: Sequence[int], neighbours: Mapping[int, np.ndarray],
    settings: TrainingSettings, image_size: Decision,
) -> tuple[ModelSelection, Exposure | None]:  # fmt: skip
    """Decide on exposure and multi-view terms.

    ``views`` are those trained on, ``image_size`` was decided before.
    """
    found = select_exposure(scene, photos, views)
    selection = ModelSelection((image_size,)).with_decision(
        decide("exposure", settings.exposure, found.needed, found.evidence)
    )
    exposure = None
    if selection.chose("exposure"):
        exposure = Exposure(len(scene.views), views, found.log_gains)
    pairs = [neighbours[view] for view in views]
    return selection.with_decision(select_multi_view(pairs, settings.multi_view)), exposure
