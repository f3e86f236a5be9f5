# SPDX-License-Identifier: GPL-3.0-or-later
"""Every method of the meshing study makes a mesh of a shell of Gaussians, and tells its cost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks.meshing_runs import ADAPTIVE, MEASURED, MESH, TETRAHEDRA, UNIFORM, Method
from benchmarks.one_mesh import Trained, measure
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.mesh.surface_mesh import load_mesh
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from tests.core.field.field_scenes import cameras_around, shell_arrays
from tests.core.meshing.meshing_scenes import cube


@pytest.fixture(scope="module")
def trained() -> Trained:
    arrays = shell_arrays(0.9)
    count = len(arrays)
    quats = Rotation.from_matrix(arrays.rotations).as_quat()[:, [3, 0, 1, 2]]
    length = np.linalg.norm(arrays.normals, axis=1, keepdims=True)
    orientation = np.concatenate([arrays.normals / length, np.arctanh(length)], axis=1)
    opacity = np.exp(arrays.log_opacities)
    values = {
        "means": arrays.means,
        "log_scales": np.log(arrays.scales),
        "quats": quats,
        "opacity_logits": np.log(opacity / (1 - opacity)),
        "sh": np.zeros((count, 1, 3)),
        "orientation": orientation,
        "filter_3d": np.zeros(count),
    }
    gaussians = OrientedGaussians(
        **{name: torch.from_numpy(np.asarray(v, np.float32)) for name, v in values.items()}
    )
    views = tuple(View(camera, Path("unused.png")) for camera in cameras_around(6))
    scene = Scene(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), Similarity())
    return Trained(scene, gaussians, cube(1.3))


@pytest.mark.parametrize(
    "method", [Method(UNIFORM, 800), Method(ADAPTIVE, 400), Method(TETRAHEDRA, 2)], ids=str
)
def test_method_makes_a_closed_ball(method: Method, trained: Trained, tmp_path: Path) -> None:
    figures = measure(trained, method, tmp_path, threads=1)
    mesh = load_mesh(tmp_path / MESH)
    check = validate_manifold(mesh.vertices, mesh.faces)
    assert check.good, check.defects()
    assert max(check.parts, key=lambda part: part.faces).euler == 2
    assert np.median(np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1.0)) < 0.02
    assert figures["vertices"] == len(mesh.vertices)
    assert figures["cpu_s"] > 0 < figures["peak_bytes"]
    assert not (tmp_path / MEASURED).exists()  # written by the command, not here
