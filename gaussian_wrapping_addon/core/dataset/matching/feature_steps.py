# SPDX-License-Identifier: GPL-3.0-or-later
"""Find and match features, in the helper processes that solve cameras and points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...processes.helper_process import emit
from ..photos.gps_exif import GpsPosition
from ..pycolmap_import import import_pycolmap
from .gps_distances import gps_distances
from .match_pairs import EXHAUSTIVE_LIMIT, all_pairs
from .pair_choice import choose_pairs, second_round
from .resemblance import resemblances

EXTRACT_END, MATCH_END = 0.5, 0.85
"""Shares of the solver's progress."""
_SECOND_ROUND_BEGIN = 0.8
_MATCHING_BLOCKS = 3
_MATCHING_BLOCK_PAIRS = 1500
"""Every block rebuilds the search index of each of its photos: few, large blocks are faster."""


def extract(
    folder: Path,
    database: Path,
    names_of_camera: dict[int, list[str]],
    threads: int,
    max_features: int,
) -> None:
    """Find features of photos of each camera, in order, with progress."""
    pycolmap = import_pycolmap()

    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    options.use_gpu = False
    options.sift.max_num_features = max_features
    reader = pycolmap.ImageReaderOptions()
    if any((folder / "masks").iterdir()):
        reader.mask_path = folder / "masks"
    total = sum(len(names) for names in names_of_camera.values())
    done = 0
    for camera_id, names in names_of_camera.items():
        reader.existing_camera_id = camera_id
        # Import in order first: extraction would number the photos as its threads finish.
        pycolmap.import_images(
            database,
            folder / "images",
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=names,
            options=reader,
        )
        for begin in range(0, len(names), 2 * threads):
            block = names[begin : begin + 2 * threads]
            emit(
                fraction=EXTRACT_END * done / total,
                message=f"searching features, photo {done + 1} of {total}",
            )
            pycolmap.extract_features(
                database,
                folder / "images",
                image_names=block,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(block)


def match_chosen(folder: Path, database: Path, task: dict[str, Any], names: list[str]) -> None:
    """Choose pairs, match them, and in large sets those of a second round; ``task`` gets both.

    Parameters
    ----------
    task : dict
        ``seed``, ``threads``, ``in_order`` and ``positions`` (degrees of latitude and longitude of
        each photo, or None); gets ``pairs`` of names.
    names : list of str
        All photos, sorted.
    """
    count = len(names)
    if count <= EXHAUSTIVE_LIMIT:
        task["pairs"] = _named(all_pairs(count), names)
        match(folder, database, task)
        return
    pycolmap = import_pycolmap()

    emit(fraction=EXTRACT_END, message=f"comparing {count} photos")
    with pycolmap.Database.open(database) as db:
        number_of = {image.name: image.image_id for image in db.read_all_images()}

        def descriptors(index: int) -> np.ndarray:
            return np.asarray(db.read_descriptors(number_of[names[index]]).data)

        alike = resemblances(count, descriptors, seed=task["seed"])
    metres = gps_distances(
        [
            None if place is None else GpsPosition(place[0], place[1], None)
            for place in task["positions"]
        ]
    )
    first = choose_pairs(count, in_order=task["in_order"], metres=metres, resemblance=alike)
    task["pairs"] = _named(first, names)
    match(folder, database, task, end=_SECOND_ROUND_BEGIN)
    index = {number_of[name]: k for k, name in enumerate(names)}
    verified = {}
    with pycolmap.Database.open(database) as db:
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            i, j = sorted(index[number] for number in pycolmap.pair_id_to_image_pair(pair_id))
            verified[i, j] = len(geometry.inlier_matches)
    more = _named(second_round(count, first, verified, alike), names)
    match(folder, database, {**task, "pairs": more}, begin=_SECOND_ROUND_BEGIN)
    task["pairs"] = task["pairs"] + more


def _named(pairs: list[tuple[int, int]], names: list[str]) -> list[list[str]]:
    return [[names[i], names[j]] for i, j in pairs]


def match(
    folder: Path,
    database: Path,
    task: dict[str, Any],
    *,
    begin: float = EXTRACT_END,
    end: float = MATCH_END,
    is_turntable: bool = False,
) -> None:
    """Match and verify the pairs of ``task``, with progress from ``begin`` to ``end``."""
    pycolmap = import_pycolmap()

    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = task["threads"]
    verification = _options_of(task, is_turntable=is_turntable)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    pairs = task["pairs"]
    step = max(1, min(-(-len(pairs) // _MATCHING_BLOCKS), _MATCHING_BLOCK_PAIRS))
    for done in range(0, len(pairs), step):
        emit(
            fraction=begin + (end - begin) * done / len(pairs),
            message=f"matching photos, pair {done + 1} of {len(pairs)}",
        )
        block = pairs[done : done + step]
        pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in block))
        pycolmap.match_image_pairs(
            database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def verify_again(database: Path, task: dict[str, Any], *, is_turntable: bool) -> None:
    """Verify all matches anew."""
    pycolmap = import_pycolmap()

    with pycolmap.Database.open(database) as db:
        db.clear_two_view_geometries()
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = task["threads"]
    pycolmap.geometric_verification(
        database,
        verifier_options=verifier,
        two_view_geometry_options=_options_of(task, is_turntable=is_turntable),
    )


def _options_of(task: dict[str, Any], *, is_turntable: bool) -> Any:
    options = import_pycolmap().TwoViewGeometryOptions()
    options.ransac.random_seed = task["seed"]
    options.filter_stationary_matches = is_turntable
    return options
