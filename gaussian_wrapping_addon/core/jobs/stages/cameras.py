# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages before a training: frames of a video, cameras, the scene of a splat."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import DatasetError, ParseError, UsageError
from ...files import read_json, write_bytes, write_json
from ...loading.other_inputs import (
    NO_PHOTOS_HINT,
    NO_PHOTOS_WARNING,
    cameras_on_spheres,
    scene_frame,
    splat_extent,
)
from ...loading.source_kind import SPLAT
from ...names import AUTO
from ...progress import Progress, ReportWarning, read_warnings
from ...readers.point_files import is_splat_path
from ...scene.scene import Scene, View
from ..store.job_file import JobFile, training_keys
from ..store.job_folder import JobFolder
from ..store.rollback import shorter_training
from ..store.stage_folder import (
    STAGE_VERSIONS,
    Stage,
    read_done,
    run_stage,
    source_fingerprint,
    stage_key,
)

if TYPE_CHECKING:
    from ...loading.real_world import UnitsRequest
    from ...regions.shapes import Region


# -- Frames stage: photos out of a video, kept in a stage folder of their own ---------------------
#
# Another seed or other masks need new cameras, but the same frames.


@dataclass(frozen=True)
class FramesRequest:
    """A video, and the key of the frames that a job takes from it."""

    video: Path
    key: str

    def folder(self, stages: Path) -> Path:
        """Return the folder of the stage."""
        return stages / f"frames-{self.key}"


def frames_request(job: JobFile) -> FramesRequest | None:
    """Return what a job takes from a video; ``None`` where its input is none."""
    from ...loading.source_kind import VIDEO, source_kind
    from ...photos.video import is_video_path

    source = Path(job.source)
    if not is_video_path(source) or source.is_dir():
        try:
            kind = source_kind(source)
        except DatasetError:
            return None  # said again where the input is loaded
        if kind.kind != VIDEO or kind.video is None:
            return None
        source = kind.video
    try:
        state = source.stat()
        file = [state.st_size, state.st_mtime_ns]
    except OSError:
        file = []  # a finished training needs its frames only; loading says what is missing
    settings = job.settings
    key = stage_key(
        STAGE_VERSIONS["frames"], str(source), *file,
        settings.video_frames, 0.0 if settings.video_frames else settings.video_fps,
    )  # fmt: skip
    return FramesRequest(source, key)


def run_frames(
    folder: JobFolder, job: JobFile, request: FramesRequest, progress: Progress, *, threads: int
) -> tuple[Path, dict[str, Any]]:
    """Take the frames of a job's video; return their folder and the stage's ``done.json``.

    Raises DatasetError, ParseError: the video cannot be used.
    """
    from ...photos.video_frames import FRAMES_FOLDER, extract_frames

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        found = extract_frames(
            request.video, stage_folder, progress,
            frames=job.settings.video_frames, fps=job.settings.video_fps, threads=threads,
        )  # fmt: skip
        return {
            "names": list(found.names),
            "facts": found.facts,
            "warnings": [warning.to_json() for warning in found.warnings],
        }

    def whole(stage_folder: Path) -> bool:
        names = (read_done(stage_folder) or {}).get("names")
        return isinstance(names, list) and all(
            isinstance(name, str) and (stage_folder / FRAMES_FOLDER / name).is_file()
            for name in names
        )

    stage = run_stage(folder.stages, "frames", request.key, progress, work, whole=whole)
    return stage.folder / FRAMES_FOLDER, stage.done


# -- Make a scene of a splat without photos: place virtual cameras around it and render them ------

MAX_START_POINTS = 30_000
"""Centres of at most this many opaque Gaussians serve as sparse points."""

MIN_START_OPACITY = 0.5
"""Minimum opacity of Gaussians that serve as sparse points."""


def start_splat_of(job: JobFile) -> Path | None:
    """Return the splat that a job's training starts from: the setting, or the input itself."""
    if job.settings.start_splat:
        return Path(job.settings.start_splat)
    source = Path(job.source)
    return source if is_splat(source) else None


def is_splat(source: Path) -> bool:
    """Tell whether an input is a splat file."""
    return source.is_file() and is_splat_path(source)


def make_splat_scene(source: Path, folder: Path, progress: Progress, *, threads: int = 0) -> Scene:
    """Render a splat from virtual cameras into ``folder/images`` and return the scene.

    The scene frame keeps the axes of the file. The background is black, as in training. Raises
    ParseError, DatasetError: the file is not a splat, or has no visible Gaussian.
    """
    import torch

    from ...gaussians.files import read_foreign_splat
    from ...gaussians.model import SH_C0
    from ...render.render import render
    from ...render.types import RenderOptions
    from ...training.splat_start import baked, fit_filter, transform_gaussians, within_reach

    progress.update(0.0, "reading the splat")
    splat = read_foreign_splat(source)
    world = baked(splat.gaussians)
    means, opacities = world.means.numpy(), torch.sigmoid(world.opacity_logits).numpy()
    extent = splat_extent(means, opacities)
    file_cameras = cameras_on_spheres(extent)
    scene_from_world = scene_frame(file_cameras)
    cameras = [camera.moved(scene_from_world) for camera in file_cameras]
    moved, _ = within_reach(transform_gaussians(world, scene_from_world))  # training warns of it
    gaussians = fit_filter(moved, cameras, threads=threads)
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    options = RenderOptions(depth=False, threads=threads)
    views = []
    for index, camera in enumerate(cameras):
        progress.update(index / len(cameras), f"rendering view {index + 1} of {len(cameras)}")
        with torch.no_grad():
            color = render(gaussians, camera, options).color.numpy()
        path = images / camera.name
        write_bytes(path, _png(color))
        views.append(View(camera, path))
    with np.errstate(over="ignore"):
        near = np.linalg.norm(means - extent.center, axis=1) <= extent.radius
    chosen = np.nonzero((opacities >= MIN_START_OPACITY) & near)[0]
    chosen = chosen[:: max(1, -(-len(chosen) // MAX_START_POINTS))]
    colors = np.clip(0.5 + SH_C0 * world.sh[chosen, 0].numpy(), 0.0, 1.0)  # (m, 3)
    warnings = [*splat.warnings, ReportWarning("without-photos", NO_PHOTOS_WARNING, NO_PHOTOS_HINT)]
    if extent.has_surroundings:
        text = "The splat reaches far beyond its middle; only the middle is covered by the views."
        warnings.append(ReportWarning("surroundings-not-covered", text))
    facts = {"kind": SPLAT, "views": len(views), "points": len(chosen), **splat.facts}
    progress.update(1.0, f"{len(views)} views are rendered")
    return Scene(
        tuple(views), scene_from_world.points(means[chosen]),
        np.round(255.0 * colors).astype(np.uint8), scene_from_world.inverse(), tuple(warnings),
        facts,
    )  # fmt: skip


def _png(color: np.ndarray) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    pixels = np.round(255.0 * np.clip(color, 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(pixels).save(stream, "PNG", compress_level=1)
    return stream.getvalue()


# -- ``result/scene.json``: cameras, photo paths and frame of a scene, for Blender ----------------


def write_scene_summary(path: Path, scene: Scene) -> None:
    """Write ``result/scene.json``, the cameras and frame for Blender (docs/architecture.md)."""
    from ...limits import SCENE_RADIUS

    units = scene.facts.get("georeference")
    cameras = [{**view.camera.to_json(), "photo": str(view.photo_path)} for view in scene.views]
    values = {
        **({} if units is None else {"georeference": units}), "version": 1,
        "world_from_scene": scene.world_from_scene.to_json(), "radius": SCENE_RADIUS,
        "cameras": cameras,
    }  # fmt: skip
    write_json(path, values)


# -- Cameras stage: load the input as a scene, or re-use the cameras of a finished training -------

FRAMES_SHARE = 0.4
"""Rough share of the stage's time, where the photos are frames of a video."""

_logger = logging.getLogger(__name__)

MASKED = "masked"
"""Name of the stage that takes the place of ``cameras`` where masks are made."""


def run_cameras(folder: JobFolder, job: JobFile, progress: Progress, *, threads: int) -> Stage:
    """Load the scene, or re-use a finished cameras stage.

    ``mesh``, ``bake`` and ``more`` use the cameras of the finished training even if the photos have
    changed since, or an earlier version has loaded them. Raises DatasetError, ParseError,
    UsageError: the input cannot be used, or has nothing by which it could get metres as asked.
    """
    from ...loading.load import load_scene
    from ...loading.real_world import UnitsRequest
    from ...photos.photo_file import AS_WRITTEN, MaskReading

    source, settings = Path(job.source), job.settings
    turntable, equirectangular = settings.turntable, settings.equirectangular
    reading = MaskReading(settings.mask_invert == "on", settings.mask_grow_px)
    units = UnitsRequest(settings.georeference, settings.markers, settings.control_points)
    wanted = frames_request(job)
    photos = source_fingerprint(source) if wanted is None else wanted.key
    key = stage_key(
        STAGE_VERSIONS["cameras"], job.source, photos, settings.seed,
        *([] if turntable == "auto" else [turntable]),
        *([] if equirectangular == "auto" else ["equirectangular", equirectangular]),
        *([] if reading == AS_WRITTEN else [reading.invert, reading.grow_px]),
        *_units_key(units),
    )  # fmt: skip
    is_there = read_done(folder.stages / f"cameras-{key}") is not None
    if job.command in ("mesh", "more", "bake") and not is_there:
        earlier = scene_of_finished_training(folder, job)
        if earlier is not None:
            _logger.warning(
                "%s has changed since the training, its files have new dates, or it was loaded by "
                "an earlier version or with other masks: the mesh is of the training as it is. To "
                "train anew, run wrap.",
                source,
            )  # fmt: skip
            return earlier

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        if is_splat(source):
            if units.markers or units.control_points or units.georeference == "on":
                raise UsageError(
                    "A splat has no photos to tell its size by.",
                    "Leave out markers, control points and georeference.",
                )
            scene = make_splat_scene(source, stage_folder, progress, threads=threads)
        else:
            root, taken = source, None
            if wanted is not None:
                if units.georeference == "on" and not units.control_points:
                    raise UsageError(
                        "Frames of a video have no GPS position.",
                        "Leave georeference out; give markers, control points or a measured "
                        "length.",
                    )
                span = progress.span(0.0, FRAMES_SHARE)
                root, taken = run_frames(folder, job, wanted, span, threads=threads)
                progress = progress.span(FRAMES_SHARE, 1.0)
            scene = load_scene(
                root, stage_folder, progress,
                seed=settings.seed, threads=threads, turntable=turntable, reading=reading,
                equirectangular=equirectangular, units=units, in_order=taken is not None,
            )  # fmt: skip
            if taken is not None:
                warnings = (*read_warnings(taken["warnings"]), *scene.warnings)
                scene = replace(scene, warnings=warnings, facts={**scene.facts, **taken["facts"]})
        return saved_scene(scene, stage_folder)

    def whole(stage_folder: Path) -> bool:
        if wanted is not None and read_done(wanted.folder(folder.stages)) is None:
            return False  # its photos may lie there
        return is_whole_scene(stage_folder)

    return run_stage(folder.stages, "cameras", key, progress, work, whole=whole)


def _units_key(units: UnitsRequest) -> list[str]:
    """Return what the stage's key has of the request for metres; nothing of the default."""
    from ...loading.real_world import BY_GPS_IF_GOOD
    from ...units.control_points import MAX_FILE_BYTES

    if units == BY_GPS_IF_GOOD:
        return []
    content = ""
    if units.control_points:
        # A file that cannot be read is refused where it is needed, not for a finished stage.
        with contextlib.suppress(OSError), Path(units.control_points).open("rb") as stream:
            content = hashlib.sha256(stream.read(MAX_FILE_BYTES + 1)).hexdigest()
    return ["units", units.georeference, units.markers, content]


def saved_scene(scene: Scene, stage_folder: Path) -> dict[str, Any]:
    """Save the scene of a stage; return the content of ``done.json``."""
    from ...scene.scene import save_scene

    save_scene(scene, stage_folder)
    return {
        "views": len(scene.views), "points": len(scene.points),
        "warnings": [warning.to_json() for warning in scene.warnings], "facts": scene.facts,
    }  # fmt: skip


def is_whole_scene(stage_folder: Path) -> bool:
    """Return whether the files of a saved scene are there and whole."""
    from ...array_file import is_whole
    from ...scene.scene import MOST_POINTS_BYTES, POINTS_NAME, SCENE_NAME

    try:
        read_json(stage_folder / SCENE_NAME)
    except (FileNotFoundError, ParseError):
        return False
    return is_whole(stage_folder / POINTS_NAME, MOST_POINTS_BYTES)


def regions_listed(listed: str, scene: Scene) -> list[Region]:
    """Return the regions of a setting that is a JSON list of region bodies, scene frame.

    ``"auto"`` instead of a body is the automatic region.
    """
    from ...regions.scene_regions import automatic_region, parse_region, region_in_scene

    return [
        automatic_region(scene)
        if body == AUTO
        else region_in_scene(parse_region(body, Path("job.json")), scene.world_from_scene)
        for body in json.loads(listed)
    ]


def scene_stage_name(job: JobFile) -> str:
    """Return the name of the stages whose scene a job trains on."""
    return MASKED if job.settings.masks_are_made else "cameras"


def scene_of_finished_training(folder: JobFolder, job: JobFile) -> Stage | None:
    """Return the newest finished scene with a finished training of this job.

    It is that of the cameras, or the masked one where the job makes masks. For ``more``, a shorter
    training that it can continue is one as well.
    """
    extra = job.settings.training.extra_iterations
    name = scene_stage_name(job)
    found: list[tuple[float, int, Stage]] = []
    for path in sorted(folder.stages.glob(f"{name}-*")):
        done, key = read_done(path), path.name.removeprefix(f"{name}-")
        train_key, base_key = training_keys(key, job)
        trained = read_done(folder.stages / f"train-{train_key}")
        if trained is None and job.command == "more":
            shorter = shorter_training(folder.stages, base_key, extra)
            trained = None if shorter is None else read_done(shorter)
        if done is not None and trained is not None:
            stage = Stage(name, key, path, done, True)
            found.append((trained["finished_unix_s"], len(found), stage))
    return max(found)[2] if found else None
