# SPDX-License-Identifier: GPL-3.0-or-later
"""A turntable wrapped with no option given: ``python -m benchmarks.turntable``.

Spot turns before a static, textured wall and table. Its photos are wrapped without cameras, with
and without ``--turntable off``. Cameras are judged by the exact ones, the mesh by the true surface
that the photos show, after aligning the cameras. Records go to ``benchmarks/records/turntable``,
the page is ``docs/benchmarks/turntable.md``.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import logging
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.evaluation.alignment.pose_error import pose_errors
from gaussian_wrapping_addon.core.evaluation.surface.scores import score_protocols
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.limits import MAX_IMAGE_SIDE_PX
from gaussian_wrapping_addon.core.machine import processor_name

from ..scenes.visibility import RayScene
from ..speed_error.plan import THRESHOLD_SHARES, Run
from ..speed_error.runs import ROOT, Settings, code_state, measured, run_wrap
from ..speed_error.score import read_textured, stage_folder
from ..tables import Table
from .photos import Turntable, truth_of, turntable, write_photos

_logger = logging.getLogger("benchmarks")

RECORDS = ROOT / "benchmarks" / "records" / "turntable"
PAGE = ROOT / "docs" / "benchmarks" / "turntable.md"
WIDTH_PX, HEIGHT_PX = 640, 480
CASES = ((48, 1, "auto"), (24, 1, "off"), (24, 1, "auto"), (48, 2, "auto"))
"""Photos, places of the camera, ``--turntable``."""
SCAN = "scan"


def main(arguments: Sequence[str] | None = None) -> int:
    """Make missing runs and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="make runs that have a record, too")
    parser.add_argument("--kept", type=Path, help="folder of kept runs, used again where they are")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    for photos, places, mode in CASES:
        record = RECORDS / f"{options.preset}-{photos}-{places}-{mode}.json"
        if record.is_file() and not options.again:
            continue
        with tempfile.TemporaryDirectory() as folder:
            kept = options.kept or Path(folder)
            values = _run(
                photos, places, mode, options.preset, options.threads, kept,
                reuse=options.kept is not None,
            )  # fmt: skip
        record.parent.mkdir(parents=True, exist_ok=True)
        write_json(record, values)
        _logger.info("%s: %s", record.stem, values)
    PAGE.write_text(_page([read_json(path) for path in sorted(RECORDS.glob("*.json"))]), "utf-8")
    return 0


def _run(
    photos: int, places: int, mode: str, preset: str, threads: int, kept: Path, *, reuse: bool
) -> dict[str, Any]:
    made = turntable(photos, WIDTH_PX, HEIGHT_PX, elevations=places)
    source = kept / f"photos-{photos}-{places}"
    shutil.rmtree(source, ignore_errors=True)
    write_photos(made, source)
    settings = Settings(kept, threads, reuse)
    values: dict[str, Any] = {
        "photos": photos, "places": places, "turntable": mode, "preset": preset,
        "code": code_state(), "date": datetime.date.today().isoformat(),
        "machine": processor_name(), "threads": threads,
    }  # fmt: skip
    # "auto" is what the program does where nothing is said.
    more = () if mode == "auto" else ("--turntable", mode)
    try:
        done = run_wrap(Run(source.name, preset, 0, mode, more), source, settings)
    except WorkerError as error:
        lines = [line for line in error.message.splitlines() if line.startswith("error:")]
        return {**values, "failed": lines[-1] if lines else error.message}
    report = measured(done)["report"]
    seconds = [stage.get("processor_seconds") or 0.0 for stage in report["stages"]]
    return {
        **values,
        "code": measured(done)["code"],
        "processor_s": sum(seconds),
        "held_out_psnr": report["training"].get("held_out_psnr"),
        **_judge(made, done, threads),
    }


def _judge(made: Turntable, done: Path, threads: int) -> dict[str, Any]:
    """Compare cameras, masks and mesh of a finished run with the exact ones."""
    cameras = stage_folder(done / "out", "cameras")
    scene = load_saved_scene(cameras)
    world = scene.world_from_scene
    solved = [camera.moved(world) for camera in scene.cameras]
    errors = pose_errors(solved, made.cameras)
    true_from_scene = errors.transform.after(world)
    mesh = read_textured(done / "mesh").mesh
    thresholds = [share * made.mesh_diagonal for share in THRESHOLD_SHARES]
    moved = [camera.moved(errors.transform) for camera in solved]
    score = score_protocols(
        true_from_scene.points(mesh.vertices), mesh.faces, truth_of(made), moved, thresholds,
        threads=threads, protocols=(SCAN,),
    )[SCAN]  # fmt: skip
    return {
        "placed": len(solved),
        "rotation_degrees_median": float(np.median(errors.rotation_degrees)),
        "f1": list(score.f1),
        "precision": list(score.precision),
        "recall": list(score.visible_recall or score.recall),
        "mask_iou": _mask_overlap(made, scene),
    }


def _mask_overlap(made: Turntable, scene: Scene) -> float | None:
    """Return the median intersection over union of masks and true silhouettes."""
    rays = RayScene(made.mesh.vertices, made.mesh.faces)
    exact = {camera.name: camera for camera in made.cameras}
    photos = PhotoStore(scene, MAX_IMAGE_SIDE_PX)
    shares = []
    for index, view in enumerate(scene.views):
        mask = photos.mask(index)
        if mask is None:
            continue
        # With the solved lens: masks are of photos without its distortion.
        pose = exact[view.camera.name].cam_from_world
        camera = dataclasses.replace(photos.camera(index), cam_from_world=pose)
        y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
        local = [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy]
        directions = np.stack([*local, np.ones(x.shape)], -1) @ camera.rotation
        directions = directions.reshape(-1, 3)
        origins = np.broadcast_to(camera.center, directions.shape)
        seen = (rays.first_hits(origins, directions)[1] >= 0).reshape(mask.shape)
        shares.append((seen & mask).sum() / max((seen | mask).sum(), 1))
    return float(np.median(shares)) if shares else None


def _page(records: Sequence[dict[str, Any]]) -> str:
    rows = []
    for r in records:
        name = f"{r['photos']} photos from {r['places']} place{'s' * (r['places'] > 1)}"
        if "failed" in r:
            rows.append((name, r["turntable"], r["preset"], r["failed"], *[""] * 6))
            continue
        overlap = "" if r["mask_iou"] is None else f"{r['mask_iou']:.3f}"
        rows.append(
            (
                name, r["turntable"], r["preset"], f"{r['placed']} of {r['photos']}",
                f"{r['rotation_degrees_median']:.2f}", overlap,
                " / ".join(f"{value:.3f}" for value in r["f1"]),
                " / ".join(f"{value:.3f}" for value in r["precision"]),
                " / ".join(f"{value:.3f}" for value in r["recall"]), f"{r['processor_s']:.0f}",
            )
        )  # fmt: skip
    header = (
        "photos", "--turntable", "preset", "placed", "cameras off, degrees", "masks, IoU",
        "F1 at 0.25 / 0.5 / 1 %", "precision", "recall", "processor s",
    )  # fmt: skip
    origins = sorted({f"{r['code']}, {r['date']}, {r['machine']}" for r in records})
    notes = (
        (
            "Of what the photos show; shares of the cow's diagonal. Masks against the true "
            "silhouettes, median over the photos."
        ),
        f"Code, date and machine: {'; '.join(origins)}.",
    )
    return (
        "# Turntable\n\n"
        "Spot turns before a wall and a table that stand still and look like it; "
        f"{WIDTH_PX} x {HEIGHT_PX} pixels, JPEG, noise of 1.5 levels, light that stands still. "
        "`python -m benchmarks.turntable`\n\n"
        + Table("With no option given, and without the treatment", header, rows, notes).markdown()
    )


if __name__ == "__main__":
    sys.exit(main())
