# SPDX-License-Identifier: GPL-3.0-or-later
"""Input path to scene."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MemoryShortageError, ResourceError, UsageError, WorkerError
from ..files import real_path
from ..limits import NEAR_Z, SCENE_RADIUS
from ..photos.finder import list_photos, photo_root
from ..photos.formats import require_extras
from ..photos.photo_file import AS_WRITTEN, MaskReading
from ..poses.solver import solve_poses, triangulate_points
from ..progress import Progress, ReportWarning
from ..readers.source_model import PHOTOS
from ..scene.camera import Camera, Similarity
from ..scene.frames import snapped_camera
from ..scene.scene import Scene, View
from .check import (
    MIN_POINTS,
    check_photo_count,
    coverage_warnings,
    frame_of_poses,
    nothing_in_common,
    points_in_scene,
    second_copies_warning,
)
from .other_inputs import (
    shape_warning,
    solve_views_of_panoramas,
    takes_for_panoramas,
    with_views_of_panoramas,
)
from .real_world import BY_GPS_IF_GOOD, UnitsRequest, camera_of, find_real_units, moved_views
from .source_kind import read_poses, source_kind
from .views import PreparedView, prepare_views

# -- Make start points for inputs without any: triangulated from the photos, else random ----------

_logger = logging.getLogger(__name__)

RANDOM_POINTS = 20_000
_ROUNDS = 40
_MIN_SEEN = 2

_HINT = "Photos with more texture help, or a COLMAP model with its points."


def make_start_points(
    views: Sequence[View],
    work_folder: Path,
    progress: Progress,
    warnings: list[ReportWarning],
    *,
    seed: int,
    threads: int,
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return points (n, 3) float64 and colours (n, 3) uint8 in the scene frame, and their origin.

    Triangulation keeps the poses of the input. If it finds too few points (no texture, inaccurate
    poses), points are drawn at random in view of the cameras, and a warning is added.

    Raises MemoryShortageError: the system gave the triangulation too little memory.
    """
    try:
        points, colors = triangulate_points(
            views, work_folder, progress, seed=seed, threads=threads
        )
    except MemoryShortageError:
        raise  # with enough memory the same photos would give points
    except (WorkerError, ResourceError) as error:
        _logger.warning("triangulation failed: %s", error)
        text = f"Start points could not be triangulated: {error.message}"
        warnings.append(ReportWarning("points-not-triangulated", text, _HINT))
        points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if len(points) >= MIN_POINTS:
        return points, colors, "triangulated from the photos"
    text = (
        f"The photos gave only {len(points)} start points; random ones are used, which makes "
        "training slower and less exact."
    )
    warnings.append(ReportWarning("random-start-points", text, _HINT))
    points = random_points([view.camera for view in views], seed=seed)
    return points, np.full(points.shape, 128, np.uint8), "random"


def focus_point(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the (3,) point nearest to the rays of all images' middles (regularised towards 0)."""
    total, right = 1e-3 * np.eye(3), np.zeros(3)
    for camera in cameras:
        gaze = camera.gaze / np.linalg.norm(camera.gaze)
        across = np.eye(3) - np.outer(gaze, gaze)
        total += across
        right += across @ camera.center
    return np.linalg.solve(total, right)


def random_points(cameras: Sequence[Camera], *, seed: int) -> np.ndarray:
    """Draw (``RANDOM_POINTS``, 3) points around the point that the cameras look at.

    Points are uniform in a ball whose radius follows the cameras' median distance; those seen by
    at least two cameras are kept.
    """
    rng = np.random.default_rng(seed)
    focus = focus_point(cameras)
    distances = np.array([np.linalg.norm(c.center - focus) for c in cameras])
    radius = min(max(0.75 * float(np.median(distances)), 0.1 * SCENE_RADIUS), 2.0 * SCENE_RADIUS)
    kept: list[np.ndarray] = []
    found = 0
    for _ in range(_ROUNDS):
        directions = rng.normal(size=(RANDOM_POINTS, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = focus + directions * radius * rng.uniform(size=(RANDOM_POINTS, 1)) ** (1 / 3)
        good = points[count_observing_views(cameras, points) >= _MIN_SEEN]
        kept.append(good)
        found += len(good)
        if found >= RANDOM_POINTS:
            break
    return np.concatenate(kept)[:RANDOM_POINTS]


def count_observing_views(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """Count the cameras whose image contains each of (n, 3) points, (n,) int."""
    seen = np.zeros(len(points), np.int64)
    for camera in cameras:
        indices, _, _, depth = camera.shown(points)
        seen[indices[depth > NEAR_Z]] += 1
    return seen


# -- Load an input path as a :class:`~.scene.Scene`: poses, photos, frame, start points ----------

_CAMERAS_ARE_GIVEN = ReportWarning(
    "no-turntable",
    "The input has cameras: a turntable is looked for where they are solved.",
    "Give the photos alone, or masks.",
)


_NO_TURNTABLE_OF_PANORAMAS = ReportWarning(
    "no-turntable",
    "The photos are panoramas, of which no turntable is looked for.",
    "Say --set equirectangular=off if they are ordinary photos.",
)
_NO_PANORAMAS = ReportWarning(
    "no-panoramas",
    "The input's cameras are no panoramas: its photos are not cut into views.",
    "Give the photos alone, or cameras that say EQUIRECTANGULAR.",
)


def load_scene(
    source: Path,
    work_folder: Path,
    progress: Progress,
    *,
    seed: int = 0,
    threads: int = 0,
    turntable: str = "auto",
    equirectangular: str = "auto",
    reading: MaskReading = AS_WRITTEN,
    units: UnitsRequest = BY_GPS_IF_GOOD,
    in_order: bool = False,
) -> Scene:
    """Load photos and cameras, solving and undistorting where needed.

    Parameters
    ----------
    source : Path
        Folder of photos, COLMAP project (``images/`` and ``sparse/0``), ``transforms.json`` or a
        folder that contains it. Nothing is written there.
    work_folder : Path
        Undistorted photos, masks and the solved cameras are written here.
    progress : Progress
    seed : int
    threads : int
        0 uses every core.
    turntable : {"auto", "on", "off"}
        Of photos without poses; see :func:`~.solver.solve_poses`.
    equirectangular : {"auto", "on", "off"}
        Whether photos without poses are panoramas, which are cut into views; ``"auto"``: where
        all are exactly twice as wide as high and none says another projection.
    reading : MaskReading
        How mask files are understood.
    units : UnitsRequest
        What is known about size and place. Where it is applied, the scene's world is metric.
    in_order : bool
        Photos without poses follow each other by name, as frames of a video do.

    Returns
    -------
    Scene
        In the scene frame; ``warnings`` and ``facts`` list what was read, left out and solved.

    Raises
    ------
    DatasetError, ParseError
        The input cannot be used; names the problem and its location.
    MissingExtraError
        Photos need a package that the worker lacks.
    """
    source = real_path(source)
    work_folder = real_path(work_folder)
    control = units.checked()  # before cameras are solved, which takes minutes
    kind = source_kind(source)
    work_folder.mkdir(parents=True, exist_ok=True)
    progress.update(0.0, "reading the input")
    warnings: list[ReportWarning] = []
    facts: dict[str, Any] = {"kind": kind.kind}
    if kind.kind == PHOTOS:
        solve_span = progress.span(0.0, 0.8)
        root = photo_root(kind.folder)
        photos = list_photos(root)
        check_photo_count(len(photos))
        require_extras(photos)
        warnings += second_copies_warning(root)
        # Frames of a video as wide as two of their heights are what phones film.
        mode = "off" if in_order else equirectangular
        if takes_for_panoramas(photos, mode):
            warnings += shape_warning(photos, mode)
            _refuse_places_of_panoramas(units)
            if turntable == "on":
                warnings.append(_NO_TURNTABLE_OF_PANORAMAS)
            model, kind = solve_views_of_panoramas(
                photos, kind, work_folder, solve_span, reading, seed=seed, threads=threads
            )
        else:
            units.check_gps(photos)
            model = solve_poses(
                root, photos, kind.mask_roots, work_folder, solve_span, seed=seed, threads=threads,
                turntable=turntable, reading=reading, in_order=in_order,
            )  # fmt: skip
        prepare_span = progress.span(0.8, 1.0)
    else:
        model = read_poses(kind)
        if turntable == "on":
            warnings.append(_CAMERAS_ARE_GIVEN)
        if any(photo.is_panorama for photo in model.photos):
            check_photo_count(len(model.photos))
            _refuse_places_of_panoramas(units)
            model, kind = with_views_of_panoramas(
                model, kind, work_folder, progress.span(0.0, 0.3), reading, threads=threads
            )
        elif equirectangular == "on":
            warnings.append(_NO_PANORAMAS)
        prepare_span = progress.span(0.0, 1.0 if len(model.points) >= MIN_POINTS else 0.3)
        if kind.kind == "COLMAP model" and kind.transforms is not None:
            facts["also_present"] = f"{kind.transforms.name} (not used: the COLMAP model is)"
    warnings += [*model.warnings, *coverage_warnings(model)]
    facts |= model.facts
    check_photo_count(len(model.photos))
    views, notes, counts = prepare_views(
        model, kind, work_folder, prepare_span.span(0.0, 0.9), threads=threads, reading=reading
    )
    warnings += notes
    facts |= counts
    check_photo_count(len(views), notes)
    real, note = find_real_units(
        units, control, views, kind, work_folder, prepare_span.span(0.9, 1.0), warnings,
        threads=threads,
    )  # fmt: skip
    given_points, z_up = model.points, False
    if real is not None:
        facts["georeference"] = real.to_json()
        if real.applied:
            views = moved_views(views, real.metric_from_world)
            given_points, z_up = real.metric_from_world.points(given_points), real.z_up
    if note:
        facts["georeference_note"] = note
    views, scene_from_world, facts["up_from"] = _frame(views, warnings, z_up)
    in_scene = tuple(
        View(
            snapped_camera(camera_of(view).moved(scene_from_world)), view.photo_path, view.mask_path
        )
        for view in views
    )
    if (apart := nothing_in_common(model)) is not None:
        warnings.append(apart)
    points, colors = points_in_scene(given_points, model.point_colors, scene_from_world, warnings)
    if len(points) < MIN_POINTS:
        span = progress.span(0.3, 1.0)
        points, colors, facts["start_points"] = make_start_points(
            in_scene, work_folder, span, warnings, seed=seed, threads=threads
        )
    facts["views"], facts["points"] = len(views), len(points)
    sizes = {f"{view.camera.width} x {view.camera.height}" for view in in_scene}
    facts["photo_sizes"] = sorted(sizes)[:4]
    progress.update(1.0, f"{len(views)} photos and {len(points)} points are ready")
    return Scene(in_scene, points, colors, scene_from_world.inverse(), tuple(warnings), facts)


def _refuse_places_of_panoramas(units: UnitsRequest) -> None:
    """Raise where places are asked for that the views cut from panoramas do not have."""
    if units.georeference == "on" or units.control_points:
        hint = "Leave these options out; markers, or a measured length afterwards, give the scale."
        raise UsageError("GPS and control points are not read for 360 degree photos.", hint)


def _frame(
    views: list[PreparedView], warnings: list[ReportWarning], z_up: bool
) -> tuple[list[PreparedView], Similarity, str]:
    """Remove outlier cameras far from all others; return also the scene frame and its up rule."""
    frame = frame_of_poses([view.cam_from_world for view in views], z_up=z_up)
    far = [view.name for view, keep in zip(views, frame.keep, strict=True) if not keep]
    if far:
        text = (
            f"{len(far)} cameras are far away from all others and were left out: "
            f"{', '.join(far[:3])}."
        )
        hint = "Check the poses of these cameras."
        warnings.append(ReportWarning("cameras-far-away", text, hint))
    if frame.collinear:
        text = "All cameras lie on one line; depth and the up direction are inaccurate."
        hint = "Take photos from other heights and directions too."
        warnings.append(ReportWarning("cameras-on-a-line", text, hint))
    kept = [view for view, keep in zip(views, frame.keep, strict=True) if keep]
    return kept, frame.scene_from_world, frame.up_rule
