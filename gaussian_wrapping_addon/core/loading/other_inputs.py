# SPDX-License-Identifier: GPL-3.0-or-later
"""Inputs of another kind: panoramas, splats without photos."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DatasetError
from ..limits import SCENE_RADIUS
from ..photos.finder import PhotoIndex, find_mask, photo_root, resolve_photo
from ..photos.photo_file import MaskReading
from ..poses.panoramas import (
    BY_SHAPE,
    CUT_FOLDER,
    VIEWS,
    Panorama,
    cut_panoramas,
    panorama_evidence,
    solve_panoramas,
    view_lens,
)
from ..poses.solver import check_unreadable_share
from ..progress import UNREADABLE_HINT, Progress, ReportWarning
from ..readers.source_model import PosedPhoto, SourceModel
from ..scene.camera import Camera, Similarity, pose_at
from ..scene.frames import RADIUS_MARGIN
from .source_kind import SourceKind

# -- Panoramas of an input replaced by their pinhole views, posed or to be solved -----------------

_CUTTING = 0.3
"""Share of the progress that cutting takes where cameras are solved afterwards."""


def takes_for_panoramas(photos: Sequence[Path], mode: str) -> bool:
    """Whether photos without cameras are cut: ``"on"``, or ``"auto"`` where they look so."""
    return mode == "on" or (mode == "auto" and bool(panorama_evidence(photos)))


def shape_warning(photos: Sequence[Path], mode: str) -> list[ReportWarning]:
    """Return the warning about photos that are cut for their shape alone, or none."""
    if mode != "auto" or panorama_evidence(photos) != BY_SHAPE:
        return []
    text = (
        "The photos are taken for 360 degree panoramas, as all are exactly twice as wide as high; "
        f"each is cut into {len(VIEWS)} views. Nothing else in them says so."
    )
    hint = "Set 360° Photos to Off (--set equirectangular=off) if they are ordinary photos."
    return [ReportWarning("panoramas-by-shape", text, hint)]


def with_views_of_panoramas(
    model: SourceModel,
    kind: SourceKind,
    work_folder: Path,
    progress: Progress,
    reading: MaskReading,
    *,
    threads: int,
) -> tuple[SourceModel, SourceKind]:
    """Cut the panoramas of a model with poses; other photos stay.

    Returns the model with every panorama replaced by its views, and the kind that finds these.
    Raises DatasetError: no panorama was found, or one is not twice as wide as high.
    """
    index = PhotoIndex(kind.photo_roots)
    posed = [photo for photo in model.photos if photo.is_panorama]
    found: list[Panorama] = []
    owners: list[PosedPhoto] = []
    missing: list[str] = []
    masks_missing: list[str] = []
    used: set[Path] = set()
    for photo in sorted(posed, key=lambda one: one.name):
        match = index.find(photo.name)
        if match is None or match.path in used:
            missing.append(photo.name)
            continue
        used.add(match.path)
        if photo.mask_name is None:
            mask = find_mask(kind.mask_roots, photo.name, kind.photo_roots)
        else:
            named = resolve_photo(kind.folder, photo.mask_name)
            mask = named if named is not None and named.is_file() else None
            if mask is None:
                masks_missing.append(photo.mask_name)
        found.append(Panorama(photo.name, match.path, mask))
        owners.append(photo)
    if not found:
        text = f"None of the {len(posed)} panoramas that the {model.kind} names was found."
        hint = f"Looked for {missing[0]} in {', '.join(str(root) for root in kind.photo_roots)}."
        raise DatasetError(text, hint)
    cut, bad = cut_panoramas(found, work_folder, progress, reading, threads=threads)
    check_unreadable_share(bad, len(found))
    photos = [photo for photo in model.photos if not photo.is_panorama]
    for view in cut:
        turned = VIEWS[view.view].cam_from_panorama @ owners[view.panorama].cam_from_world
        photos.append(PosedPhoto(view.name, view_lens(view.width), turned, mask_path=view.mask))
    warnings = [*model.warnings, *_warnings(bad, missing)]
    if masks_missing:
        text = f"{len(masks_missing)} masks were not used: {masks_missing[0]} is missing."
        warnings.append(ReportWarning("masks-not-used", text))
    facts = {**model.facts, "panoramas": len(found), "views_of_panoramas": len(cut)}
    model = dataclasses.replace(model, photos=tuple(photos), warnings=tuple(warnings), facts=facts)
    return model, dataclasses.replace(kind, cut_folder=work_folder / CUT_FOLDER)


def solve_views_of_panoramas(
    photos: Sequence[Path],
    kind: SourceKind,
    work_folder: Path,
    progress: Progress,
    reading: MaskReading,
    *,
    seed: int,
    threads: int,
) -> tuple[SourceModel, SourceKind]:
    """Cut photos without cameras, and solve the poses of the panoramas.

    Raises DatasetError: a photo is not twice as wide as high, or too few panoramas can be placed.
    """
    root = photo_root(kind.folder)
    names = [path.relative_to(root).as_posix() for path in photos]
    panoramas = [
        Panorama(name, path, find_mask(kind.mask_roots, name, [root]))
        for name, path in zip(names, photos, strict=True)
    ]
    cut, bad = cut_panoramas(
        panoramas, work_folder, progress.span(0.0, _CUTTING), reading, threads=threads
    )
    check_unreadable_share(bad, len(panoramas))
    model = solve_panoramas(
        cut, work_folder, progress.span(_CUTTING, 1.0), seed=seed, threads=threads
    )
    model = dataclasses.replace(model, warnings=(*model.warnings, *_warnings(bad, [])))
    return model, dataclasses.replace(kind, cut_folder=work_folder / CUT_FOLDER)


def _warnings(bad: Sequence[str], missing: Sequence[str]) -> list[ReportWarning]:
    found = []
    if bad:
        text = f"{len(bad)} panoramas cannot be read and are not used: {bad[0]}"
        found.append(ReportWarning("photos-unreadable", text, UNREADABLE_HINT))
    if missing:
        text = f"{len(missing)} panoramas were not found: {', '.join(missing[:3])}."
        found.append(ReportWarning("photos-not-found", text))
    return found


# -- Place virtual cameras around a splat that comes without photos -------------------------------

PHOTO_SIDE_PX = 800
FIELD_OF_VIEW_DEG = 50.0

FAR_VIEWS, NEAR_VIEWS = 28, 20
"""Far views show the whole splat, near views its middle at higher resolution."""

FAR_MARGIN = 1.05
NEAR_DISTANCE = 1.7
"""Distance of the near views in radii; from the far views the sphere fits the image."""

MIN_OPACITY = 0.1
"""Gaussians of lower opacity are ignored when measuring the extent."""

WHOLE_SHARE, MIDDLE_SHARE = 0.98, 0.5
SURROUNDINGS_RATIO = 3.0
"""If the radius of :data:`WHOLE_SHARE` is more than this many times that of :data:`MIDDLE_SHARE`,
the splat has surroundings, and this ratio limits the radius that the cameras cover."""

MAX_RADIUS = 1e15
"""Of half of the Gaussians: beyond it, float32 holds no scene."""

NO_PHOTOS_WARNING = (
    "A splat without photos is wrapped from virtual views around its middle: surroundings and "
    "rooms seen from inside are not covered, and errors of the splat remain."
)
NO_PHOTOS_HINT = "If its photos exist, give them as the input and the splat as the start."


@dataclass(frozen=True)
class SplatExtent:
    """Centre and radius of a splat, frame of the file."""

    center: np.ndarray
    """(3,) float64."""
    radius: float
    has_surroundings: bool
    """Whether a substantial part lies beyond ``radius``."""


def splat_extent(means: np.ndarray, opacities: np.ndarray) -> SplatExtent:
    """Return the robust centre and radius of the opaque Gaussians.

    Parameters
    ----------
    means : (n, 3)
        Finite.
    opacities : (n,)
        Effective opacities in [0, 1], used as weights.

    Raises
    ------
    DatasetError
        All Gaussians are transparent or coincide, or they are scattered without bounds.
    """
    opaque = opacities >= MIN_OPACITY
    if not opaque.any():
        hint = "Check that opacities are stored as logits."
        raise DatasetError("All Gaussians of the splat are transparent.", hint)
    points = np.asarray(means, np.float64)[opaque]
    weights = np.asarray(opacities, np.float64)[opaque]
    center = np.array([_quantile(points[:, k], weights, 0.5) for k in range(3)])
    with np.errstate(over="ignore"):  # some may lie as far away as numbers go
        distance = np.linalg.norm(points - center, axis=1)
    middle = _quantile(distance, weights, MIDDLE_SHARE)
    whole = _quantile(distance, weights, WHOLE_SHARE)
    if not whole > 0.0:
        raise DatasetError("All Gaussians of the splat coincide.", "Export it again.")
    if not middle < MAX_RADIUS:
        text = "The Gaussians of the splat are scattered too far for one scene."
        raise DatasetError(text, "Export it again.")
    has_surroundings = middle > 0.0 and whole > SURROUNDINGS_RATIO * middle
    radius = SURROUNDINGS_RATIO * middle if has_surroundings else whole
    return SplatExtent(center, float(radius), bool(has_surroundings))


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(total, share * total[-1]), len(values) - 1)])


def cameras_on_spheres(extent: SplatExtent) -> list[Camera]:
    """Return cameras on two spheres around a splat that look at its centre, frame of the file."""
    half = math.radians(0.5 * FIELD_OF_VIEW_DEG)
    focal_px = 0.5 * PHOTO_SIDE_PX / math.tan(half)
    far = FAR_MARGIN / math.sin(half)
    cameras: list[Camera] = []
    for count, distance in ((FAR_VIEWS, far), (NEAR_VIEWS, NEAR_DISTANCE)):
        for direction in fibonacci_directions(count):
            eye = extent.center + distance * extent.radius * direction
            right = np.cross(-direction, [0.0, 0.0, 1.0])  # no direction of the lattice is a pole
            right /= np.linalg.norm(right)
            rotation = np.stack([right, np.cross(-direction, right), -direction])
            name, side, middle = f"view_{len(cameras):03d}.png", PHOTO_SIDE_PX, 0.5 * PHOTO_SIDE_PX
            lens = (side, side, focal_px, focal_px, middle, middle)
            cameras.append(Camera(name, *lens, pose_at(rotation, eye)))
    return cameras


def scene_frame(cameras: list[Camera]) -> Similarity:
    """Return ``scene_from_world``: translation and scale only, keeping the file's axes."""
    centers = np.stack([camera.center for camera in cameras])
    mean = centers[0] + (centers - centers[0]).mean(axis=0)
    reach = float(np.linalg.norm(centers - mean, axis=1).max())
    return Similarity(RADIUS_MARGIN * reach / SCENE_RADIUS, np.eye(3), mean).inverse()


def fibonacci_directions(count: int) -> np.ndarray:
    """Return (count, 3) unit vectors of a spherical Fibonacci lattice; none is a pole."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
