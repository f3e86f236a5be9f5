# SPDX-License-Identifier: GPL-3.0-or-later
"""How many of the pairs that really overlap are found by resemblance, against all pairs."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.matching.match_pairs import nearest_pairs
from gaussian_wrapping_addon.core.dataset.matching.pair_choice import VERIFIED_MATCHES
from gaussian_wrapping_addon.core.dataset.matching.resemblance import resemblances
from gaussian_wrapping_addon.core.dataset.photos.photo_finder import list_photos
from gaussian_wrapping_addon.core.dataset.pycolmap_import import import_pycolmap

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
