# SPDX-License-Identifier: GPL-3.0-or-later
"""Export stage: gather the results of all regions in ``result/`` and write the report."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...dataset.frames.placement_file import FILE_NAME as PLACEMENT
from ...dataset.frames.placement_file import read_placement, write_placement
from ...dataset.similarity import Similarity
from ...dataset.units.real_units import blender_start
from ...errors import ParseError
from ...evaluation.report.markdown import CURVE
from ...evaluation.report.report import write_report
from ...files import finite_json, read_json, resolve_inside, write_json
from ...names import REPORT_FOLDER
from ...progress import Progress
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.result_swap import new_result
from ..store.stage_folder import Stage
from .scene_summary import write_scene_summary

if TYPE_CHECKING:
    from ...dataset.scene import Scene

REPORTS = ("report.json", "report.md")
"""Replaced last, since they describe all other files."""


def export_results(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    trained: Stage,
    regions: list[tuple[str, Stage, Stage]],
    summary: dict[str, Any],
    progress: Progress,
) -> None:
    """Fill ``result/``; regions of earlier jobs in the same folder stay.

    Files are replaced together at the end: after a failure the result is unchanged.

    Parameters
    ----------
    regions : list of (name, mesh stage, texture stage)
    summary : dict
        Measurements of the whole job, from the runner.
    """
    from ...dataset.refined_scene import load_refined_scene
    from ...gaussians.gaussian_file import load_gaussians
    from ...gaussians.splat_ply import write_splat_ply

    with new_result(folder.result, last=REPORTS) as new:
        progress.update(0.1, "writing the scene")
        scene = load_refined_scene(cameras.folder, trained.folder)
        write_scene_summary(new / "scene.json", scene)
        _place_in_metres(folder.result, new, scene)
        gaussians = load_gaussians(trained.folder / "gaussians.npz")
        write_splat_ply(new / "gaussians.ply", gaussians, scene.world_from_scene)
        for index, (name, meshed, textured) in enumerate(regions):
            progress.update(0.2 + 0.6 * index / len(regions), f"writing {name}")
            target = new / name
            shutil.copytree(textured.folder / "files", target)
            shutil.copy2(meshed.folder / "region.json", target / "region.json")
            for picture in sorted(textured.folder.glob("comparison-*.jpg")):
                shutil.copy2(picture, target / picture.name)
            shutil.copy2(textured.folder / "preview.png", target / "preview.png")
            figures = _region_figures(trained, meshed, textured)
            figures["world"] = _in_world_units(meshed, figures, scene.world_from_scene)
            write_json(target / "figures.json", _json_values(figures))
        shutil.copy2(regions[0][2].folder / "preview.png", new / "preview.png")
        progress.update(0.9, "writing the report")
        # A region of this job or of an earlier one may have the name of this folder.
        if (folder.result / REPORT_FOLDER).is_dir() and not (new / REPORT_FOLDER).exists():
            shutil.copytree(folder.result / REPORT_FOLDER, new / REPORT_FOLDER)
        _training_pictures(trained, new / REPORT_FOLDER)
        # Regions of an earlier training stay on disk; the report covers this training only.
        known = {**_figures_in(folder.result), **_figures_in(new)}
        of_training = {n: f for n, f in sorted(known.items()) if f.get("training") == trained.key}
        report = _json_values({**summary, **_job_report(cameras, trained, regions)})
        write_report(new, report, of_training, earlier=folder.result)


def _place_in_metres(earlier: Path, new: Path, scene: Scene) -> None:
    """Write the first placement of a scene that has metres; one made in Blender stays."""
    start = blender_start(scene.facts.get("georeference"), scene.world_from_scene)
    if start is None:
        return
    path = earlier / PLACEMENT
    with contextlib.suppress(ParseError):  # a damaged one is replaced
        if path.is_file() and read_placement(path, scene.world_from_scene) is not None:
            return
    write_placement(new / PLACEMENT, start, scene.world_from_scene)


def _figures_in(result: Path) -> dict[str, dict[str, Any]]:
    return {path.parent.name: read_json(path) for path in sorted(result.glob("*/figures.json"))}


def _job_report(
    cameras: Stage, trained: Stage, regions: list[tuple[str, Stage, Stage]]
) -> dict[str, Any]:
    training = [*trained.before, trained]
    stages = [*cameras.before, cameras, *training, *(s for _, m, t in regions for s in (m, t))]
    return {
        "stages": [
            {
                "name": s.name,
                "seconds": s.done.get("seconds"),
                "processor_seconds": s.done.get("processor_seconds"),
                "reused": s.reused,
            }
            for s in stages
        ],
        "cameras": {k: v for k, v in cameras.done.items() if k != "finished_unix_s"},
        "training": {k: v for k, v in trained.done.items() if k != "finished_unix_s"},
    }


def _region_figures(trained: Stage, meshed: Stage, textured: Stage) -> dict[str, Any]:
    figures = {**meshed.done, **textured.done}
    figures["training"] = trained.key
    figures["seconds"] = {"mesh": meshed.done["seconds"], "texture": textured.done["seconds"]}
    return _json_values(figures)


def _in_world_units(
    meshed: Stage, figures: dict[str, Any], world_from_scene: Similarity
) -> dict[str, Any]:
    from ...evaluation.report.mesh_size import sizes_in_world
    from ...mesh.mesh_file import load_mesh

    mesh = load_mesh(meshed.folder / "mesh.npz")
    texels = figures.get("texture", {}).get("texels_used", 0)
    return sizes_in_world(mesh.vertices, mesh.faces, world_from_scene, texels)


def _training_pictures(trained: Stage, folder: Path) -> None:
    """Copy the training's pictures into ``folder``, replacing those of an earlier training."""
    from ...evaluation.report.pictures import write_learning_curve

    # Only these files: others may belong to a region with the name of this folder.
    folder.mkdir(exist_ok=True)
    for old in (*folder.glob("held-out-*.jpg"), folder / CURVE):
        old.unlink(missing_ok=True)
    for picture in trained.done.get("pictures", []):
        source = resolve_inside(trained.folder, picture["file"])
        if source is not None and source.is_file():
            shutil.copy2(source, folder / source.name)
    write_learning_curve(trained.done, folder / CURVE)


def _json_values(values: Any) -> Any:
    """Return the values as read back from JSON: lists for tuples, finite numbers only."""
    return json.loads(json.dumps(finite_json(values)))
