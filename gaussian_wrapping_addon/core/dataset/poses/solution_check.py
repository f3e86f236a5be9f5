# SPDX-License-Identifier: GPL-3.0-or-later
"""Hold a solver's reconstruction against the verified matches in its database.

Runs in the helper process of :mod:`.pose_solver`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..pycolmap_import import import_pycolmap
from .pose_consistency import PairEvidence, Side, Verdict, agreeing_matches


def check_solution(database: Path, model: Any) -> Verdict:
    """Return how the verified pairs of placed photos agree with a pycolmap reconstruction.

    Pairs that the solver did not use, or gave up, count like all others.
    """
    pycolmap = import_pycolmap()

    placed = {image_id: _Placed(model, image_id) for image_id in sorted(model.reg_image_ids())}
    pairs = []
    with pycolmap.Database.open(database) as db:
        for image_id, photo in placed.items():
            photo.read_features(db.read_keypoints(image_id)[:, :2])
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            matches = geometry.inlier_matches
            if not len(matches) or not all(image_id in placed for image_id in ids):
                continue
            first, second = (placed[image_id] for image_id in ids)
            agreeing = agreeing_matches(first.side(matches[:, 0]), second.side(matches[:, 1]))
            pairs.append(PairEvidence(first.name, second.name, len(matches), int(agreeing.sum())))
    return Verdict(tuple(sorted(pairs, key=lambda pair: (pair.first, pair.second))))


class _Placed:
    """A placed photo with its features."""

    def __init__(self, model: Any, image_id: int) -> None:
        image = model.image(image_id)
        self.name: str = image.name
        self.pose = np.asarray(image.cam_from_world().matrix())
        self._camera = model.camera(image.camera_id)
        numbers = [p.point3D_id if p.has_point3D() else None for p in image.points2D]
        self._points = np.full((len(numbers), 3), np.nan)
        for at, number in enumerate(numbers):
            if number is not None:
                self._points[at] = model.point3D(number).xyz
        self._rays = np.zeros((0, 2))

    def read_features(self, pixels: np.ndarray) -> None:
        """Set the rays of all features from their (n, 2) pixels."""
        self._rays = np.asarray(self._camera.cam_from_img(pixels.astype(np.float64)))
        if len(self._points) != len(pixels):  # a photo without any match has no features there
            self._points = np.full((len(pixels), 3), np.nan)

    def side(self, features: np.ndarray) -> Side:
        """Return this photo with the features of a pair's matches."""
        return Side(
            self.pose, self._rays[features], self._points[features],
            float(self._camera.mean_focal_length()),
        )  # fmt: skip
