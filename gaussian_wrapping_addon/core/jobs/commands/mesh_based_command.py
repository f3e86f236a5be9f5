# SPDX-License-Identifier: GPL-3.0-or-later
"""``evaluate --metric mbr``: mesh-based rendering of a job, or of a mesh file with its photos."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import DatasetError, ParseError, UsageError
from ...files import read_json
from ...names import JOB_MARKER
from ...progress import Progress
from ..stages.cameras import MASKED
from ..store.job_folder import JobFolder

if TYPE_CHECKING:
    import numpy as np

    from ...scene.scene import Scene


@dataclass(frozen=True)
class MeshBasedRequest:
    """Options of the command."""

    photos: Path
    """A job folder, or a dataset with cameras in the frame of the mesh."""
    test: Path | None = None
    """Dataset of test photos; ``None``: those that the job held out."""
    max_image_px: int | None = None
    seed: int = 0
    threads: int = 1


def evaluate_mesh_based(
    vertices: np.ndarray, faces: np.ndarray, request: MeshBasedRequest, progress: Progress
) -> dict[str, Any]:
    """Return the figures of a mesh in world coordinates as plain JSON values.

    Raises UsageError: there are no test photos, or one of them is a training photo; DatasetError,
    ParseError: photos or cameras cannot be used.
    """
    from ...evaluation.mesh_based_rendering import MeshBasedSettings, mesh_based_rendering
    from ...evaluation.photo_views import LONG_SIDE_PX, folder_scene, photo_views
    from ...image_metrics import lpips_if_ready

    longest = request.max_image_px or LONG_SIDE_PX
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        is_job = (request.photos / JOB_MARKER).exists()
        if is_job:
            scene, held_out = job_scene(request.photos)
        else:
            scene = folder_scene(
                request.photos, work / "training", progress.span(0.0, 0.1), threads=request.threads
            )
            held_out = []
        apart = set(held_out)
        names = [view.camera.name for view in scene.views]
        training = [index for index, name in enumerate(names) if name not in apart]
        if request.test is not None:
            tested = folder_scene(
                request.test, work / "test", progress.span(0.1, 0.2), threads=request.threads
            )
            test = photo_views(tested, range(len(tested.views)), max_image_px=longest)
        else:
            chosen = [index for index, name in enumerate(names) if name in apart]
            if not chosen:
                raise no_test_photos(request.photos.name, is_job)
            test = photo_views(scene, chosen, max_image_px=longest)
        lpips, reason = lpips_if_ready()
        found = mesh_based_rendering(
            vertices, faces, photo_views(scene, training, max_image_px=longest), test,
            replace(MeshBasedSettings(), seed=request.seed), lpips=lpips,
            threads=request.threads, progress=progress.span(0.2, 1.0),
        )  # fmt: skip
    values = found.to_json()
    if reason:
        values["lpips_note"] = reason
    test_from = "held-out photos of the job" if request.test is None else str(request.test)
    return {"metric": "mbr", "photos": str(request.photos), "test_from": test_from, **values}


def no_test_photos(name: str, is_job: bool) -> UsageError:
    """Return the error of an evaluation that would have to judge training photos."""
    if is_job:
        return UsageError(
            f"The job {name} held no photo out of training: there is none to test with.",
            "Train with --holdout 8, or give other photos with --test.",
        )
    return UsageError(
        f"All photos of {name} are training photos: there is none to test with.",
        "Give others with --test, or a job that held photos out with --cameras.",
    )


def job_scene(folder: Path) -> tuple[Scene, list[str]]:
    """Return the scene of a job's result and the names of the photos held out of its training.

    Raises DatasetError: the job has no result, or lacks its cameras; ParseError: a file is damaged.
    """
    import numpy as np

    from ...scene.scene import MASKS_MADE, SCENE_NAME, load_saved_scene, with_poses

    job = JobFolder(folder)
    job.check_entries()
    again = "Export the job again with resume."
    paths = job.result / "scene.json", job.result / "report.json"
    for path in paths:
        if not path.is_file():
            raise DatasetError(f"The job {folder.name} has no {path.name} yet.", "Resume it first.")
    try:
        summary = read_json(paths[0])
        shown, frame = list(summary["cameras"]), summary["world_from_scene"]
        lenses = [_lens(entry) for entry in shown]
        poses = np.array([entry["cam_from_world"] for entry in shown], np.float64)
        poses = poses.reshape(len(shown), 3, 4)
        report = read_json(paths[1])
        held_out = [str(entry["name"]) for entry in report["training"]["held_out"]]
        name = MASKED if MASKS_MADE in report.get("cameras", {}).get("facts", {}) else "cameras"
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ParseError(paths[0], "cameras", f"not as expected ({error}).", again) from None
    for stage in sorted(job.stages.glob(f"{name}-*")):
        if not (stage / SCENE_NAME).is_file():
            continue
        # Photos may have been added since: only the stage with the result's own cameras counts.
        # Their poses may be refined; the frame and all else is the stage's.
        saved = read_json(stage / SCENE_NAME)
        try:
            same = saved["world_from_scene"] == frame and lenses == [
                _lens(entry["camera"]) for entry in saved["views"]
            ]
        except (KeyError, TypeError, AttributeError):
            same = False
        if same:
            return with_poses(load_saved_scene(stage), poses), held_out
    raise DatasetError(
        f"The photos that the result of {folder.name} was made from are no longer in its stages.",
        "Resume the job, or give the photos with --cameras.",
    )


def _lens(entry: Any) -> dict[str, Any]:
    """Return a camera's entry without its pose and photo."""
    return {k: v for k, v in dict(entry).items() if k not in ("photo", "cam_from_world")}


def table(values: dict[str, Any]) -> list[str]:
    """Return the figures as lines of text."""

    def shown(name: str, digits: int, unit: str = "") -> str:
        value = values.get(name)
        return "not measured" if value is None else f"{value:.{digits}f}{unit}"

    tested, trained = len(values["views"]), values["training_views"]
    figures = f"PSNR {shown('psnr', 2, ' dB')}, SSIM {shown('ssim', 4)}, LPIPS {shown('lpips', 4)}"
    lines = [
        f"mesh-based rendering: {tested} test photos, colour field trained on {trained} others",
        f"{figures} (pixels that no face covers are black)",
        f"PSNR of covered pixels {shown('covered_psnr', 2, ' dB')}",
    ]
    uncovered = values.get("uncovered")
    if uncovered is not None:
        lines.append(f"uncovered pixels {100.0 * uncovered:.2f} %")
    if values["left_out"]:
        lines.append(f"{values['left_out']} test photos had no pixel to compare")
    return lines
