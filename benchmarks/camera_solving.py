# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras of hundreds of photos: ``python -m benchmarks.camera_solving``.

``town`` is 400 rendered photos of streets with exact cameras, ``hall`` a room whose four walls
look the same, ``odm_caliterra`` and ``odm_brighton_beach`` are photos of drones, ``fox`` is by hand
(``--data DIR`` names the folder that has them). What has a record in
``benchmarks/records/camera_solving`` is not run again. The page is
``docs/benchmarks/camera-solving.md``.
"""

from __future__ import annotations

import argparse
import logging
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.evaluation.alignment import pose_errors
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.photos.exif import read_gps_exif
from gaussian_wrapping_addon.core.photos.finder import list_photos
from gaussian_wrapping_addon.core.poses.checks import check_solution
from gaussian_wrapping_addon.core.poses.matching import (
    VERIFIED_MATCHES,
    nearest_pairs,
    resemblances,
)
from gaussian_wrapping_addon.core.poses.solver import solve_poses
from gaussian_wrapping_addon.core.poses.solver_helper import joined, mended, place_one_by_one
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.readers.lenses import import_pycolmap
from gaussian_wrapping_addon.core.readers.source_model import SourceModel
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.scene.placement import umeyama
from gaussian_wrapping_addon.core.worker.helper_process import largest_helper_bytes

from . import provenance
from .camera_places import PLACES, ensure_photos, hall_tracks, write_database
from .provenance import DOCUMENTS, code_of_tree, write_figures, write_page

_EARTH_M = 6_371_000.0


@dataclass(frozen=True)
class Case:
    """Photos of a place made here, or of a folder."""

    name: str
    count: int = 0
    """Photos of a place; 0 for all of a folder."""
    first: int = 0
    """Only so many of them are used, the first by name; 0 for all."""

    @property
    def identity(self) -> str:
        """Name of its record."""
        parts = [self.name, *(str(n) for n in (self.count, self.first) if n)]
        return "-".join(parts)


CASES = (
    Case("town", 400),
    Case("town", 400, first=176),
    Case("hall", 64),
    Case("odm_caliterra"),
    Case("odm_brighton_beach"),
    Case("fox"),
)


def run(case: Case, data: Path | None, threads: int, tell: Callable[[str], None]) -> dict[str, Any]:
    """Solve the cameras of a case and return its record.

    Parameters
    ----------
    data : Path or None
        Folder of the real photo sets.
    """
    if case.name in PLACES:
        exact = PLACES[case.name](case.count).cameras
        photos = ensure_photos(case.name, case.count, threads=threads) / "images"
    else:
        assert data is not None
        exact, photos = (), data / case.name / "images"
    paths = list_photos(photos)[: case.first or None]
    messages: list[str] = []

    def listen(event: Any) -> None:
        kind = event.message.split(",")[0].split(" photo ")[0]
        if not messages or messages[-1] != kind:
            messages.append(kind)
            tell(event.message)

    begun_s, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        model = solve_poses(
            photos, paths, [], Path(folder), Progress("cameras", listen), threads=threads
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    record = {
        "case": case.identity,
        "seconds": time.monotonic() - begun_s,
        "processor_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "peak_bytes": largest_helper_bytes(),
        "photos": len(paths),
        "placed": len(model.photos),
        "facts": model.facts,
        "warnings": [warning.to_json() for warning in model.warnings],
    }
    if exact:
        errors = pose_errors(_cameras(model), exact[: len(paths)]).to_json()
        record["errors"] = {k: errors[k] for k in errors if k not in ("transform", "missing")}
    else:
        record["gps"] = gps_errors(model, photos)
    return record


def _cameras(model: SourceModel) -> list[Camera]:
    # Errors are of poses: any lens will do.
    return [Camera(p.name, 2, 2, 1.0, 1.0, 1.0, 1.0, p.cam_from_world) for p in model.photos]


def gps_errors(model: SourceModel, photos: Path) -> dict[str, float] | None:
    """Return distances of camera centres from their GPS after a similarity, metres."""
    places, centers = [], []
    for camera in _cameras(model):
        position = read_gps_exif(photos / camera.name)
        if position is not None and position.altitude_m is not None:
            places.append([position.longitude_deg, position.latitude_deg, position.altitude_m])
            centers.append(camera.center)
    if len(places) < 3:
        return None
    angles = np.array(places)
    middle = angles.mean(0)
    metres = np.radians(angles - middle) * _EARTH_M
    metres[:, 0] *= np.cos(np.radians(middle[1]))
    metres[:, 2] = angles[:, 2] - middle[2]
    found = umeyama(np.array(centers), metres, with_scale=True)
    apart = found.points(np.array(centers)) - metres
    return {
        "photos": len(places),
        "median_m": float(np.median(np.linalg.norm(apart, axis=1))),
        "median_over_ground_m": float(np.median(np.linalg.norm(apart[:, :2], axis=1))),
    }


NEAREST = (5, 10, 20)
BEST = 5
"""Strongest neighbours of a photo that are looked for."""


def recall_record(photos: Path, threads: int) -> dict[str, Any]:
    """Match all pairs of a folder's photos, and return what resemblance would have found."""
    pycolmap = import_pycolmap()

    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.use_gpu = False
        extraction.num_threads = threads
        names = [path.relative_to(photos).as_posix() for path in list_photos(photos)]
        pycolmap.extract_features(
            database, photos, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE,
            extraction_options=extraction, device=pycolmap.Device.cpu,
        )  # fmt: skip
        matching = pycolmap.FeatureMatchingOptions()
        matching.use_gpu = False
        matching.num_threads = threads
        pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
        return recall_of(database)


def recall_of(database: Path) -> dict[str, Any]:
    """Return the recall of a database in which all pairs are matched and verified."""
    pycolmap = import_pycolmap()

    with pycolmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        index = {image.image_id: k for k, image in enumerate(images)}
        alike = resemblances(
            len(images), lambda k: np.asarray(db.read_descriptors(images[k].image_id).data), seed=0
        )
        verified = {}
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            i, j = sorted(index[number] for number in pycolmap.pair_id_to_image_pair(pair_id))
            verified[i, j] = len(geometry.inlier_matches)
    return {"photos": len(images), **recall(alike, verified)}


def recall(alike: np.ndarray, verified: Mapping[tuple[int, int], int]) -> dict[str, Any]:
    """Return recalls of the pairs with enough matches, by matches, and of the strongest ones."""
    true = {pair: n for pair, n in verified.items() if n >= VERIFIED_MATCHES}
    matches = np.zeros(alike.shape)
    for (i, j), count in true.items():
        matches[i, j] = matches[j, i] = count
    strongest = set(nearest_pairs(np.where(matches > 0, -matches, np.inf), BEST))
    rows = []
    for nearest in NEAREST:
        found = set(nearest_pairs(-alike.astype(np.float64), nearest))
        hits = found & true.keys()
        rows.append(
            {
                "nearest": nearest,
                "pairs": len(found),
                "precision": len(hits) / len(found),
                "recall": len(hits) / len(true),
                "recall_of_matches": sum(true[pair] for pair in hits) / sum(true.values()),
                "recall_of_strongest": len(found & strongest) / len(strongest),
            }
        )
    return {"all_pairs": len(alike) * (len(alike) - 1) // 2, "true_pairs": len(true), "rows": rows}


PHOTOS, FLOOR_POINTS = 32, 150
KINDS = ((1, 1.0), (2, 1.0), (3, 1.0), (4, 1.0), (2, 0.7), (4, 0.5))
"""Walls that look the same, and the share of their points that do."""
SEEDS = (0, 1)


def repeating_record(tell: Callable[[str], None]) -> dict[str, Any]:
    """Return rows of all kinds and seeds."""
    rows = []
    for repeats, alike in KINDS:
        for seed in SEEDS:
            with tempfile.TemporaryDirectory() as folder:
                rows.append(solve_hall(Path(folder), repeats, alike, seed))
            tell(f"{rows[-1]}")
    return {"photos": PHOTOS, "rows": rows}


def solve_hall(folder: Path, repeats: int, alike: float, seed: int) -> dict[str, Any]:
    """Solve the hall from its matches; return errors and what the check says."""
    tracks = hall_tracks(PHOTOS, FLOOR_POINTS, repeats=repeats, seed=seed, alike=alike)
    database = folder / "database.db"
    write_database(database, tracks, seed=seed)
    (folder / "images").mkdir()

    def solve(database: Path) -> Any:
        models = place_one_by_one(database, folder, seed, PHOTOS)
        return joined(database, folder, seed, models)[0] if models else None

    model = solve(database)
    verdict = check_solution(database, model)
    first = _degrees(model, tracks.cameras)
    is_suspected, is_mended = verdict.is_doubtful, False
    if is_suspected:
        model, verdict, is_mended = mended(database, folder, solve, model, verdict)
    return {
        "repeats": repeats, "alike": alike, "seed": seed, "placed": model.num_reg_images(),
        "degrees_first": first, "degrees": _degrees(model, tracks.cameras),
        "is_suspected": is_suspected, "is_doubtful": verdict.is_doubtful, "is_mended": is_mended,
        "contradicting_pairs": len(verdict.contradicting), "strong_pairs": len(verdict.strong),
        "contradicting_share": verdict.contradicting_share,
    }  # fmt: skip


def _degrees(model: Any, exact: tuple[Camera, ...]) -> float:
    """Return the median rotation error."""
    cameras = [
        Camera(
            model.image(number).name, 2, 2, 1.0, 1.0, 1.0, 1.0,
            np.asarray(model.image(number).cam_from_world().matrix()),
        )
        for number in sorted(model.reg_image_ids())
    ]  # fmt: skip
    return float(np.median(pose_errors(cameras, exact).rotation_degrees))


Records = Mapping[str, Mapping[str, Any]]

_HEAD = (
    "`python -m benchmarks.camera_solving --data DIR`, with `odm_caliterra`, `odm_brighton_beach`, "
    "`fox` and `conch_turntable` in DIR; from records. Processor "
    "seconds are of the solver's process and all its threads; seconds on the clock mean something "
    "only where nothing else runs."
)
_RUNS = (
    "Rotation and centre: medians against exact cameras after a similarity, centres over their "
    "spread. GPS: median distance from the positions in EXIF after a similarity. `town-400` is "
    "rendered streets of 640 x 480 pixels, `town-400-176` the first 176 of its photos, `hall-64` a "
    "room with four equal walls."
)
_RETRIEVAL = (
    "A true pair has 30 verified matches where all pairs are matched. In these small sets most "
    "pairs are true, so that recall is bounded by the number of pairs; what cameras need are the "
    "strongest pairs of each photo."
)
_REPEATING = (
    "A hall of four walls by its matches alone, without pictures, made so that photos of different "
    "walls match. Right cameras must not be doubted, wrong ones must."
)


def page(records: Records) -> list[str]:
    """Return the lines of the page below its title."""
    return [
        _HEAD,
        "",
        *_runs(records),
        *_retrieval(records),
        *_repeating(records),
    ]


def _runs(records: Records) -> list[str]:
    rows = []
    for name, record in records.items():
        if "placed" not in record:
            continue
        errors, gps, facts = record.get("errors"), record.get("gps"), record["facts"]
        rows.append(
            [
                name,
                f"{record['placed']} / {record['photos']}",
                facts["mapper"],
                facts["pairs_matched"],
                f"{record['processor_seconds']:.0f}",
                f"{record['seconds']:.0f}",
                f"{record['peak_bytes'] / 2**30:.2f}",
                _number(errors and errors["rotation_degrees_median"], 3),
                _number(errors and 100 * errors["center_share_median"], 2),
                _number(facts.get("mean_reprojection_error_px"), 2),
                _number(gps and gps["median_m"], 1),
                facts["pairs_contradicting_cameras"],
                ", ".join(warning["code"] for warning in record["warnings"]) or "none",
                record["date"][:10],
                record.get("code", {}).get("commit", "not recorded"),
            ]
        )
    if not rows:
        return []
    head = [
        "photos", "placed", "mapper", "pairs", "processor s", "clock s", "GiB", "rotation deg",
        "centre %", "reprojection px", "GPS m", "contradicting pairs", "warnings", "date", "commit",
    ]  # fmt: skip
    threads = sorted({record["threads"] for record in records.values() if "placed" in record})
    processors = sorted(
        {
            record.get("machine") or record["processor"]
            for record in records.values()
            if "placed" in record
        }
    )
    return [
        "## Solved cameras",
        "",
        f"{', '.join(processors)}; threads: {', '.join(map(str, threads))}. {_RUNS}",
        "",
        *_table(head, rows),
    ]


def _retrieval(records: Records) -> list[str]:
    rows = []
    for name, record in records.items():
        if not name.startswith("recall-"):
            continue
        for row in record["rows"]:
            rows.append(
                [
                    name.removeprefix("recall-"),
                    record["photos"],
                    f"{record['true_pairs']} / {record['all_pairs']}",
                    row["nearest"],
                    row["pairs"],
                    f"{row['precision']:.2f}",
                    f"{row['recall']:.2f}",
                    f"{row['recall_of_matches']:.2f}",
                    f"{row['recall_of_strongest']:.2f}",
                ]
            )
    if not rows:
        return []
    head = [
        "set", "photos", "true / all pairs", "nearest", "pairs", "precision", "recall",
        "recall of matches", "recall of the 5 strongest",
    ]  # fmt: skip
    return [
        "## Pairs by resemblance alone",
        "",
        _RETRIEVAL,
        "",
        *_table(head, rows),
    ]


def _repeating(records: Records) -> list[str]:
    record = records.get("repeating")
    if record is None:
        return []
    rows = [
        [
            row["repeats"], f"{100 * row['alike']:.0f} %", row["seed"], row["placed"],
            f"{row['degrees_first']:.2f}", "yes" if row["is_suspected"] else "no",
            "yes" if row["is_mended"] else "no", f"{row['degrees']:.2f}",
            f"{row['contradicting_pairs']} / {row['strong_pairs']}",
            "yes" if row["is_doubtful"] else "no",
        ]
        for row in record["rows"]
    ]  # fmt: skip
    head = [
        "equal walls", "of their points", "seed", "placed", "rotation deg, first", "doubted",
        "solved again", "rotation deg, last", "contradicting pairs", "warned",
    ]  # fmt: skip
    return [
        "## Walls that repeat",
        "",
        f"{record['photos']} photos. {_REPEATING}",
        "",
        *_table(head, rows),
    ]


def _number(value: Any, digits: int) -> str:
    return "" if value is None else f"{float(value):.{digits}f}"


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    return [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows),
        "",
    ]


_logger = logging.getLogger("benchmarks")
RECORDS = provenance.RECORDS / "camera_solving"
PAGE = "camera-solving.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Make missing runs and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", help="these cases alone")
    parser.add_argument("--data", type=Path, help="folder of the real photo sets")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="make runs that have a record, too")
    parser.add_argument("--document", action="store_true", help="make no run, write the page")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    code = code_of_tree()

    def wanted(name: str) -> bool:
        is_new = options.again or not (RECORDS / f"{name}.json").is_file()
        listed = options.only is None or name in options.only
        return is_new and listed and not options.document

    def keep(name: str, figures: dict[str, Any]) -> None:
        write_figures(RECORDS / f"{name}.json", figures, options.threads, code)

    for case in CASES:
        if wanted(case.identity) and (case.count or options.data is not None):
            record = run(case, options.data, options.threads, _logger.info)
            keep(case.identity, record)
            _logger.info("%s: %s", case.identity, record)
    if wanted("repeating"):
        keep("repeating", repeating_record(_logger.info))
    for name in ("fox", "odm_caliterra", "conch_turntable"):
        if options.data is not None and wanted(f"recall-{name}"):
            photos = options.data / name / "images"
            keep(f"recall-{name}", recall_record(photos, options.threads))
    records = {path.stem: read_json(path) for path in sorted(RECORDS.glob("*.json"))}
    commits = [record.get("code", {}).get("commit") for record in records.values()]
    write_page(DOCUMENTS / PAGE, "Cameras of hundreds of photos", commits, page(records))
    return 0


if __name__ == "__main__":
    sys.exit(main())
