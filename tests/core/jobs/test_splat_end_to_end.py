# SPDX-License-Identifier: GPL-3.0-or-later
"""A splat of another program is meshed without photos through the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.loading.other_inputs import fibonacci_directions
from gaussian_wrapping_addon.core.scene.camera import Similarity
from tests.core.gaussians.splat_files import permuted, splat_columns, write_ply
from tests.core.training.splat_shells import AXES, shell_of_discs

BATCH = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon" / "batch.py"
MOVE = np.array([30.0, -12.0, 5.0])
SIZE = 4.0


def write_foreign_splat(path: Path) -> Path:
    """Write a shell of the degree 3, moved and enlarged, in another order and with extras."""
    shell, normals = shell_of_discs(2000, sh_degree=3)
    columns = splat_columns(shell, normals=False)
    for axis, name in enumerate("xyz"):
        columns[name] = SIZE * columns[name] + MOVE[axis]
        columns[f"scale_{axis}"] = columns[f"scale_{axis}"] + np.float32(np.log(SIZE))
        columns[f"normal_{name}"] = normals[:, axis]
    columns["label"] = np.arange(len(normals)) % 7
    return write_ply(path, columns, order=permuted(columns), kinds={"label": "u1", "x": "f8"})


@pytest.mark.proof
@pytest.mark.slow
def test_a_permuted_splat_becomes_a_closed_mesh_on_its_surface(tmp_path: Path) -> None:
    path = write_foreign_splat(tmp_path / "other.ply")
    done = subprocess.run(
        [
            sys.executable, str(BATCH), "wrap", str(path), "--out", str(tmp_path / "out"),
            "--preset", "draft", "--iterations", "120", "--max-image-px", "160",
            "--max-gaussians", "4000", "--points", "2500", "--texture-size", "256",
            "--no-blend",
        ],
        capture_output=True, text=True, check=False, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    result = tmp_path / "out" / "result"
    with np.load(result / "auto" / "mesh.npz", allow_pickle=False) as arrays:
        vertices, faces = arrays["vertices"], arrays["faces"]
    values = json.loads((result / "scene.json").read_text())["world_from_scene"]
    frame = Similarity.from_json(values)
    assert np.array_equal(frame.rotation, np.eye(3))
    mesh = trimesh.Trimesh(frame.points(vertices), faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0
    # Distance to the ellipsoid, to first order, in its half axes' unit.
    local = (mesh.triangles_center - MOVE) / SIZE
    level = np.linalg.norm(local / AXES, axis=1)
    slope = np.linalg.norm(local / np.square(AXES), axis=1) / level
    distance = np.abs(level - 1.0) / slope
    assert np.median(distance) < 0.03
    assert np.percentile(distance, 95) < 0.08
    # The shell is covered from all sides, not only met by what there is of the mesh.
    truth = SIZE * fibonacci_directions(400) * AXES + MOVE
    _, gap, _ = trimesh.proximity.closest_point(mesh, truth)
    assert np.percentile(gap / SIZE, 95) < 0.08
    assert "virtual views" in (result / "report.json").read_text()
