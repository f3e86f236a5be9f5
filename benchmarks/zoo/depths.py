# SPDX-License-Identifier: GPL-3.0-or-later
"""How right are the depths that a dense start begins with? ``python -m benchmarks.zoo.depths``.

Photos of scenes of the zoo are matched, plain parts are put on planes, and both are compared with
the depth of all that was rendered, things and surroundings. ``docs/benchmarks/stereo-depths.md`` is
written anew from the scenes of the run. ``--only`` also takes the room of :mod:`benchmarks.scenes`,
whose photos are noisy.
"""

from __future__ import annotations

import argparse
import datetime
import logging
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.view_split import training_views
from gaussian_wrapping_addon.core.evaluation.surface.truth import read_truth
from gaussian_wrapping_addon.core.files import write_bytes
from gaussian_wrapping_addon.core.machine import processor_name
from gaussian_wrapping_addon.core.mesh.depth_buffer import depth_buffer
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthMap, estimate_depth_maps
from gaussian_wrapping_addon.core.stereo.plain.filling import fill_plain_parts

from ..scenes import ensure_scene
from ..study.command import DOCUMENTS
from ..study.origin import reading
from ..tables import Table, versions
from .cache import ensure_zoo_scene
from .catalogue import DEVELOPMENT, SCENES, draw_content, zoo_scene
from .noisy_photos import NoisyPhotos
from .surroundings import SKY_NAME

_logger = logging.getLogger("benchmarks")

PHOTO_PX = 640
MATCH_PX = 400
"""Longest side at which photos are matched; Standard matches at 640, Draft at 320."""
HELD_OUT = 8
SHARES = (0.003, 0.01)
"""Errors of a depth, relative to it, that the table counts."""
WRONG_SHARE = 0.03
SINGLE = 1
"""Source that confirms a depth alone."""
PAGE, READING = "stereo-depths.md", "stereo-depths-reading.md"
COMMAND = "python -m benchmarks.zoo.depths"


def main(given: Sequence[str] | None = None) -> int:
    """Run the command line, return the exit code."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="scenes to match")
    parser.add_argument("--match-px", type=int, default=MATCH_PX, help="longest side matched")
    parser.add_argument(
        "--noise", type=float, default=0.0, metavar="LEVELS",
        help="standard deviation of the noise that photos get, grey levels",
    )  # fmt: skip
    parser.add_argument(
        "--jpeg", type=int, default=0, metavar="QUALITY", help="compress photos; 0: do not"
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=DOCUMENTS, help="folder of the page")
    options = parser.parse_args(given)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("numba").setLevel(logging.WARNING)
    development = [name for name, scene in SCENES.items() if scene.part == DEVELOPMENT]
    names = options.only or development
    rows = []
    for name in names:
        rows.append(_row(name, options.match_px, options.noise, options.jpeg, options.threads))
        _logger.info("%s", " ".join(str(cell) for cell in rows[-1]))
    table = Table(
        "Depths before and after planes",
        (
            "Scene", "Photos", "Known, %", "Within 0.3 %", "Within 1 %",
            "Known with planes, %", "Within 0.3 %", "Within 1 %", "Off by more than 3 %",
            "Known by one source, %", "Within 0.3 %", "Within 1 %", "Matching, s", "Planes, s",
        ),
        rows,
    )  # fmt: skip
    today = datetime.datetime.now(datetime.UTC).date()
    lines = [
        "# Depths of a dense start",
        "",
        f"`{COMMAND}`, {today}, {processor_name()}, {versions()},",
        f"threads: {options.threads}. Photos of at most",
        f"{PHOTO_PX} px are matched at {options.match_px} px or less,",
        f"with noise of {options.noise:g} grey levels added"
        + (f" and JPEG of quality {options.jpeg}" if options.jpeg else "")
        + ". Known is the share of all",
        "pixels, within the share of the known ones whose depth errs by less, relative to it, per",
        "cent.",
        "Seconds are of the processor, kernels compiled before.",
        "",
        *reading(options.out / READING),
        table.markdown(),
    ]
    write_bytes(options.out / PAGE, ("\n".join(lines).rstrip() + "\n").encode())
    return 0


def _row(
    name: str, match_px: int, noise: float, jpeg_quality: int, threads: int
) -> tuple[str | float | int, ...]:
    at = ensure_zoo_scene(name, threads) if name in SCENES else ensure_scene(name)
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(at, Path(folder), Progress())
        photos = NoisyPhotos(scene, PHOTO_PX, noise, jpeg_quality)
        views = list(training_views(scene, photos, HELD_OUT))
        begun_s = time.process_time()
        matched = estimate_depth_maps(
            photos, views, scene.points, Progress(), side_px=match_px, threads=threads
        )
        matching_s = time.process_time() - begun_s
        fill_plain_parts(matched, scene.points, Progress())  # compiles the kernels
        begun_s = time.process_time()
        filled = fill_plain_parts(matched, scene.points, Progress())
        planes_s = time.process_time() - begun_s
    truth = _true_depths(name, at, scene, matched, threads)
    return (
        name, len(views), *known_and_right(matched, truth), *known_and_right(filled, truth),
        wrong(filled, truth), *known_and_right(matched, truth, SINGLE), round(matching_s, 1),
        round(planes_s, 1),
    )  # fmt: skip


def _true_depths(
    name: str, at: Path, scene: Scene, maps: Sequence[DepthMap], threads: int
) -> list[np.ndarray]:
    """Return the (h, w) depths of all parts but the sky, infinite where there is none."""
    if name in SCENES:
        content = draw_content(zoo_scene(name))
        parts = [p for p in (*content.subject.parts, *content.around) if p.name != SKY_NAME]
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        vertices = np.concatenate([part.vertices for part in parts])
        faces = np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=False)])
    else:
        truth = read_truth(at).mesh
        assert truth is not None
        vertices, faces = truth
    vertices = scene.world_from_scene.inverse().points(vertices)
    depths = []
    for depth_map in maps:
        buffer = depth_buffer(vertices, faces.astype(np.int32), depth_map.camera, threads=threads)
        depths.append(buffer.depth)
    return depths


def known_and_right(
    maps: Sequence[DepthMap], truth: Sequence[np.ndarray], most_sources: int = 255
) -> tuple[int, ...]:
    """Return per cent of pixels known, and of these right within each of :data:`SHARES`.

    Parameters
    ----------
    maps : sequence of DepthMap
    truth : sequence of (h, w)
    most_sources : int
        Pixels that more sources confirm do not count as known.
    """
    known, errors = [], []
    for depth_map, depth in zip(maps, truth, strict=True):
        confirmed = (depth_map.confidence > 0) & (depth_map.agreeing <= most_sources)
        known.append(confirmed.mean())
        errors.append(np.abs(depth_map.depth / depth - 1.0)[confirmed])
    error = np.concatenate(errors)
    right = [float((error < share).mean()) if len(error) else 0.0 for share in SHARES]
    return tuple(round(100.0 * share) for share in (float(np.mean(known)), *right))


def wrong(maps: Sequence[DepthMap], truth: Sequence[np.ndarray]) -> float:
    """Return per cent of the known pixels whose depth errs by more than :data:`WRONG_SHARE`."""
    pairs = zip(maps, truth, strict=True)
    errors = [np.abs(m.depth / depth - 1.0)[m.confidence > 0] for m, depth in pairs]
    error = np.concatenate(errors)
    return round(100.0 * float((error > WRONG_SHARE).mean()), 1) if len(error) else 0.0


if __name__ == "__main__":
    raise SystemExit(main())
