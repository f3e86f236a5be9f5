# SPDX-License-Identifier: GPL-3.0-or-later
"""A video wrapped with no option given: ``python -m benchmarks.video``.

Spot above a floor is filmed in one walk around it, with shake, blurred frames and a pause, and
photographed from 40 places on the same way. Frames are judged by which are blurred, cameras by the
exact ones, meshes by the true surface. Records go beside those of other benchmarks, the page is
``docs/benchmarks/video.md``. ``--frames-only`` makes the video and chooses its frames, in minutes.
"""

from __future__ import annotations

import argparse
import datetime
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.dataset.video.extract import extract_frames
from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.evaluation.alignment.pose_error import pose_errors
from gaussian_wrapping_addon.core.evaluation.surface.scores import score_protocols
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.machine import processor_name
from gaussian_wrapping_addon.core.progress import Progress

from ..speed_error.plan import THRESHOLD_SHARES, Run
from ..speed_error.runs import ROOT, Settings, code_state, measured, run_wrap
from ..speed_error.score import read_textured, stage_folder
from ..tables import Table
from .filmed import (
    FPS,
    SECONDS,
    Studio,
    Walk,
    frames,
    photo_cameras,
    walk,
    write_photos,
    write_video,
)

_logger = logging.getLogger("benchmarks")

RECORDS = ROOT / "benchmarks" / "records" / "video"
PAGE = ROOT / "docs" / "benchmarks" / "video.md"
WIDTH_PX, HEIGHT_PX = 1920, 1080
PHOTOS = 40
CASES = ("video", "photos")
FRAMES_CASE = "frames"
SCAN = "scan"


def main(arguments: Sequence[str] | None = None) -> int:
    """Make missing runs and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="make runs that have a record, too")
    parser.add_argument("--kept", type=Path, help="folder of kept runs, used again where they are")
    parser.add_argument("--frames-only", action="store_true", help="choose frames, train nothing")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    studio = Studio()
    for case in (FRAMES_CASE,) if options.frames_only else CASES:
        preset = "" if options.frames_only else f"{options.preset}-"
        record = RECORDS / f"{preset}{case}.json"
        if record.is_file() and not options.again:
            continue
        with tempfile.TemporaryDirectory() as folder:
            settings = Settings(
                options.kept or Path(folder), options.threads, options.kept is not None
            )
            values = (
                _choose(studio, settings)
                if options.frames_only
                else _run(studio, case, options.preset, settings)
            )
        record.parent.mkdir(parents=True, exist_ok=True)
        write_json(record, values)
        _logger.info("%s: %s", record.stem, values)
    PAGE.write_text(_page([read_json(path) for path in sorted(RECORDS.glob("*.json"))]), "utf-8")
    return 0


def _choose(studio: Studio, settings: Settings) -> dict[str, Any]:
    """Choose frames as a job does where no option is given."""
    way = walk(WIDTH_PX, HEIGHT_PX)
    source = _source(studio, "video", settings)
    before = os.times()
    with tempfile.TemporaryDirectory(dir=settings.folder) as folder:
        found = extract_frames(source, Path(folder), Progress(), threads=settings.threads)
    after = os.times()
    return {
        **_origin(FRAMES_CASE, settings),
        "preset": "any",
        # Of the helper process.
        "processor_s": after.children_user - before.children_user
        + after.children_system - before.children_system,
        **frame_figures(found.names, found.facts, way),
    }  # fmt: skip


def _source(studio: Studio, case: str, settings: Settings) -> Path:
    """Return the video or the folder of the photos, made where it is missing."""
    source = settings.folder / ("clip.mp4" if case == "video" else "photos")
    settings.folder.mkdir(parents=True, exist_ok=True)
    if source.exists():
        return source
    partial = source.with_name(f"partial-{source.name}")
    if case == "video":
        write_video(partial, frames(studio, walk(WIDTH_PX, HEIGHT_PX)))
    else:
        shutil.rmtree(partial, ignore_errors=True)
        write_photos(studio, photo_cameras(PHOTOS, WIDTH_PX, HEIGHT_PX), partial)
    os.replace(partial, source)
    return source


def _origin(case: str, settings: Settings) -> dict[str, Any]:
    return {
        "case": case, "code": code_state(), "date": datetime.date.today().isoformat(),
        "machine": processor_name(), "threads": settings.threads,
    }  # fmt: skip


def _run(studio: Studio, case: str, preset: str, settings: Settings) -> dict[str, Any]:
    way = walk(WIDTH_PX, HEIGHT_PX)
    stills = photo_cameras(PHOTOS, WIDTH_PX, HEIGHT_PX)
    source = _source(studio, case, settings)
    values: dict[str, Any] = {**_origin(case, settings), "preset": preset}
    try:
        done = run_wrap(Run(source.name, preset), source, settings)
    except WorkerError as error:
        lines = [line for line in error.message.splitlines() if line.startswith("error:")]
        return {**values, "failed": lines[-1] if lines else error.message}
    report = measured(done)["report"]
    values |= {
        "code": measured(done)["code"],
        "processor_s": sum(s.get("processor_seconds") or 0.0 for s in report["stages"]),
        "held_out_psnr": report["training"].get("held_out_psnr"),
    }
    cameras = way.cameras if case == "video" else stills
    if case == "video":
        stage = read_json(stage_folder(done / "out", "frames") / "done.json")
        values |= frame_figures(stage["names"], stage["facts"], way)
    return {**values, **_judge(studio, cameras, stills, done, settings.threads)}


def frame_figures(names: Sequence[str], facts: dict[str, Any], way: Walk) -> dict[str, Any]:
    """Return which frames of the walk are used, and what was left out."""
    chosen = [int(name.removeprefix("frame-").removesuffix(".jpg")) for name in names]
    return {
        "read": facts["video_frames_read"],
        "found_blurred": facts["video_frames_blurred"],
        "found_still": facts["video_frames_still"],
        "kept": len(chosen),
        "blurred": int(way.blurred.sum()),
        "kept_blurred": int(way.blurred[chosen].sum()),
        "kept_of_pause": int(way.paused[chosen].sum()),
    }


def _judge(
    studio: Studio, exact: list[Camera], stills: list[Camera], done: Path, threads: int
) -> dict[str, Any]:
    """Compare cameras and mesh of a finished run with the exact ones.

    What counts as seen is what the photos show, for the video, too.
    """
    scene = load_saved_scene(stage_folder(done / "out", "cameras"))
    world = scene.world_from_scene
    solved = [camera.moved(world) for camera in scene.cameras]
    errors = pose_errors(solved, exact)
    true_from_scene = errors.transform.after(world)
    mesh = read_textured(done / "mesh").mesh
    thresholds = [share * studio.diagonal for share in THRESHOLD_SHARES]
    moved = [camera.moved(errors.transform) for camera in solved]
    score = score_protocols(
        true_from_scene.points(mesh.vertices), mesh.faces, studio.truth(stills), moved, thresholds,
        threads=threads, protocols=(SCAN,),
    )[SCAN]  # fmt: skip
    return {
        "photos": scene.facts["photos"],
        "placed": len(solved),
        "rotation_degrees_median": float(np.median(errors.rotation_degrees)),
        "f1": list(score.f1),
        "precision": list(score.precision),
        "recall": list(score.visible_recall or score.recall),
    }


def _page(records: Sequence[dict[str, Any]]) -> str:
    rows: list[tuple[Any, ...]] = []
    for r in records:
        if r["case"] == FRAMES_CASE:
            continue
        name = f"{PHOTOS} photos" if r["case"] == "photos" else "video"
        if "failed" in r:
            rows.append((name, r["preset"], r["failed"], *[""] * 5))
            continue
        rows.append(
            (
                name, r["preset"], f"{r['placed']} of {r['photos']}",
                f"{r['rotation_degrees_median']:.2f}",
                *(" / ".join(f"{v:.3f}" for v in r[key]) for key in ("f1", "precision", "recall")),
                f"{r['processor_s']:.0f}",
            )
        )  # fmt: skip
    header = (
        "input", "preset", "placed", "cameras off, degrees", "F1 at 0.25 / 0.5 / 1 %",
        "precision", "recall", "processor s",
    )  # fmt: skip
    origins = sorted({f"{r['code']}, {r['date']}, {r['machine']}" for r in records})
    notes = (
        (
            "Inside the cow's box, of what two of the photos show; shares of the cow's diagonal. "
            "Processor seconds without helper processes (decoding, cameras)."
        ),
        f"Code, date and machine: {'; '.join(origins)}.",
    )
    text = (
        "# Video\n\n"
        f"Spot above a floor, filmed in one walk around it: {SECONDS} s, {FPS} frames a second, "
        f"{WIDTH_PX} x {HEIGHT_PX} pixels, H.264, shake, a third of the frames blurred by 8 to 24 "
        f"pixels, a pause of two seconds; and {PHOTOS} photos of the same size on the same way. No "
        "option is given. `python -m benchmarks.video`\n\n"
    )
    if not records:
        return text + "It has not been run yet.\n"
    if rows:
        text += Table("Meshes", header, rows, notes).markdown() + "\n"
    else:
        text += f"Only the frames were chosen; no mesh was made yet. {notes[-1]}\n\n"
    counted = [r for r in records if "kept" in r]
    if counted:
        figures = [
            (
                r["preset"], str(r["read"]), str(r["blurred"]), str(r["found_blurred"]),
                str(r["found_still"]), str(r["kept"]), str(r["kept_blurred"]),
                str(r["kept_of_pause"]),
            )
            for r in counted
        ]  # fmt: skip
        columns = (
            "preset", "frames", "blurred in truth", "left out as blurred", "left out as still",
            "kept", "of these blurred", "of these of the pause",
        )  # fmt: skip
        text += Table("Frames", columns, figures).markdown()
    return text


if __name__ == "__main__":
    sys.exit(main())
