# SPDX-License-Identifier: GPL-3.0-or-later
"""How exact metres are: ``python -m benchmarks.units markers`` and ``... georeference FOLDER ...``.

``markers`` renders a table with markers and measures the scale, with exact cameras, through a lens
with distortion, and with cameras solved from the photos alone. ``georeference`` solves the cameras
of photos with GPS, aligns them, writes the sidecar of an export, and reads it back.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.dataset.frames.file_frame import FileFrame
from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.dataset.loading.real_world import UnitsRequest
from gaussian_wrapping_addon.core.dataset.photos.gps_exif import read_gps_exif
from gaussian_wrapping_addon.core.dataset.photos.photo_finder import photo_root
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.similarity import Similarity
from gaussian_wrapping_addon.core.dataset.units.geodesy import (
    GeoPoint,
    enu_from_geographic,
    geographic_from_enu,
)
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.jobs.stages.scene_summary import write_scene_summary
from gaussian_wrapping_addon.core.jobs.store.sidecar import sidecar_path, write_sidecar
from gaussian_wrapping_addon.core.progress import Progress

from .marker_scene import DICTIONARY, SIDE_M, UNITS_PER_METRE, ring_cameras, write_photos

_logger = logging.getLogger("benchmarks")

MARKERS = f"{DICTIONARY}:{SIDE_M}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and log the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    markers = commands.add_parser("markers")
    markers.add_argument("--photos", type=int, default=20)
    markers.add_argument("--width", type=int, default=800)
    georeference = commands.add_parser("georeference")
    georeference.add_argument("folders", type=Path, nargs="+")
    for each in (markers, georeference):
        each.add_argument("--threads", type=int, default=1)
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    logging.getLogger("gaussian_wrapping_addon").setLevel(logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        if options.command == "markers":
            _markers(Path(folder), options.photos, options.width, options.threads)
        else:
            for i, source in enumerate(options.folders):
                _georeference(source, Path(folder) / str(i), options.threads)
    return 0


def _markers(folder: Path, photos: int, width: int, threads: int) -> None:
    height = 3 * width // 4
    for name, k1, solve in (
        ("exact cameras", 0.0, False),
        ("exact cameras, distorted photos", -0.1, False),
        ("cameras solved from the distorted photos", -0.1, True),
    ):
        source = folder / f"k{k1}"
        if not source.exists():
            write_photos(source, photos, width, height, k1=k1)
        begun_s = time.monotonic()
        scene = _loaded(
            source / "images" if solve else source, folder / name, threads, markers=MARKERS
        )
        record = scene.facts["georeference"]
        if solve:
            # Against the exact cameras: the metric distances of all pairs of centres.
            truth = {
                c.name: c.center / UNITS_PER_METRE for c in ring_cameras(photos, width, height)
            }
            found = scene.world_from_scene.points(np.array([c.center for c in scene.cameras]))
            known = np.array([truth[Path(c.name).name] for c in scene.cameras])
            ratio = np.sqrt(_spread(found) / _spread(known))
        else:
            ratio = record["world_from_input"]["scale"] * UNITS_PER_METRE
        _logger.info(
            "%s: scale %+.3f %% off, stated %.3f %%; %d markers, %d cameras, %.0f s",
            name, 100 * (ratio - 1), 100 * record["scale_error"], record["markers"]["used"],
            len(scene.cameras), time.monotonic() - begun_s,
        )  # fmt: skip


def _spread(points: np.ndarray) -> float:
    return float(((points - points.mean(0)) ** 2).sum())


def _loaded(source: Path, work: Path, threads: int, **request: str) -> Scene:
    return load_scene(source, work, Progress(), threads=threads, units=UnitsRequest(**request))


def _georeference(source: Path, work: Path, threads: int) -> None:
    scene = _loaded(source, work, threads, georeference="on")
    record = scene.facts["georeference"]
    write_scene_summary(work / "scene.json", scene)
    frame = FileFrame("glb", scene.world_from_scene)
    mesh = work / "mesh.glb"
    write_sidecar(
        mesh, frame, scene.world_from_scene, scene.world_from_scene,
        placed=False, result=work, contents={},
    )  # fmt: skip
    in_file = frame.file_from_scene().points(np.array([c.center for c in scene.cameras]))
    read = read_json(sidecar_path(mesh))["georeference"]
    origin = GeoPoint(**read["origin"])
    metric = Similarity.from_json(read["metric_from_file"]).points(in_file)
    again = enu_from_geographic(geographic_from_enu(metric, origin), origin)
    root = photo_root(source)
    found = [read_gps_exif(root / c.name) for c in scene.cameras]
    known = [i for i, p in enumerate(found) if p is not None and p.altitude_m is not None]
    gps = [(found[i].latitude_deg, found[i].longitude_deg, found[i].altitude_m) for i in known]  # type: ignore[union-attr]
    distances = np.linalg.norm(again[known] - enu_from_geographic(np.array(gps), origin), axis=1)
    _logger.info(
        "%s: %d cameras, %d with GPS, %d used; cameras against GPS median %.3f m, largest %.2f m; "
        "scale %.2f %%, tilt %.2f degrees (standard deviations); UTM %s; by the sidecar: median "
        "%.3f m, largest %.2f m",
        source.name, len(scene.cameras), record["gps"]["photos_with_position"],
        record["gps"]["used"], record["gps"]["median_m"], record["gps"]["max_m"],
        100 * record["scale_error"], record["gps"]["tilt_error_deg"], record["utm"]["zone"],
        float(np.median(distances)), float(distances.max()),
    )  # fmt: skip
    for warning in scene.warnings:
        _logger.info("  %s: %s", warning.code, warning.text)


if __name__ == "__main__":
    sys.exit(main())
