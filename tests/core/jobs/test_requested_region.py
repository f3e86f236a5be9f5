# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions of a job in the frames of scene and world."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.jobs.stages.meshing import requested_region
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Similarity

COS, SIN = np.cos(0.7), np.sin(0.7)


@dataclass
class PlacedScene:
    """Of a scene, where it lies."""

    world_from_scene: Similarity


def test_a_region_file_comes_out_of_a_job_bit_by_bit(tmp_path: Path) -> None:
    """Meshed from what an earlier mesh has left, again and again, a region does not wander."""
    world_from_scene = Similarity(
        0.317, np.array([[COS, -SIN, 0], [SIN, COS, 0], [0, 0, 1]]), np.array([5e5, 4.1e6, 87.3])
    )
    vertices = np.random.default_rng(3).normal(size=(30, 3)) * 7.7 + world_from_scene.translation
    path = tmp_path / "0.json"
    write_region(path, Region("Würfel 1", vertices))
    first = path.read_bytes()
    for number in range(1, 4):
        scene = cast(Any, PlacedScene(world_from_scene))
        inside, region = requested_region(str(path), read_json(path), scene, cast(Any, None))
        back = world_from_scene.points(inside.vertices)
        np.testing.assert_allclose(back, vertices, rtol=0, atol=4e-6 * region.diagonal)
        path = tmp_path / f"{number}.json"
        write_region(path, region)
        assert path.read_bytes() == first
