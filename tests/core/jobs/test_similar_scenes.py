# SPDX-License-Identifier: GPL-3.0-or-later
"""The same scene at other scales and places gives the same mesh (docs/method.md, section 1.7).

Bit for bit in the scene frame; in world coordinates to the digits that a file holds.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.jobs.runner import run_job
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.frames import CENTER_STEP, POINT_STEP
from gaussian_wrapping_addon.core.scene.scene import Scene
from gaussian_wrapping_addon.core.settings import (
    JobSettings,
    MeshingSettings,
    TextureSettings,
    TrainingSettings,
)
from tests.core.jobs.transforms_file import write_transforms
from tests.synthetic import BallScene, write_ball_scene

SIMILARITIES = {
    "as it is": (1.0, (0.0, 0.0, 0.0)),
    "1e-3": (1e-3, (0.0, 0.0, 0.0)),
    "1e4": (1e4, (0.0, 0.0, 0.0)),
    "5e5 away": (1.0, (5e5, 5e5, 5e5)),
    "UTM": (1.0, (5e5, 4e6, 0.0)),
}
SHARE = 1e-4
"""Largest distance of two meshes as a share of their size."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, BallScene]:
    """Return the scene at every similarity; all have the same photos."""
    root = tmp_path_factory.mktemp("similar")
    return {
        name: write_ball_scene(
            root / name / "input", photos=16, width=64, height=56, scale=scale, offset=offset
        )
        for name, (scale, offset) in SIMILARITIES.items()
    }


def points_of(scene: BallScene) -> np.ndarray:
    return np.loadtxt(scene.folder / "sparse" / "0" / "points3D.txt", usecols=(1, 2, 3))


def loaded(source: Path, work: Path) -> Scene:
    return load_scene(source, work, Progress(), seed=0, threads=1)


@pytest.mark.parametrize("kind", ["COLMAP text", "transforms.json"])
def test_scenes_are_loaded_with_the_same_bits(
    inputs: dict[str, BallScene], tmp_path: Path, kind: str
) -> None:
    scenes = {
        name: loaded(
            scene.folder
            if kind == "COLMAP text"
            else write_transforms(scene.folder, scene.cameras, points_of(scene)),
            tmp_path / name,
        )
        for name, scene in inputs.items()
    }
    base = scenes["as it is"]
    # What was rounded stays close to what the input says.
    true = inputs["as it is"].cameras
    back = base.world_from_scene.points(np.array([camera.center for camera in base.cameras]))
    limit = CENTER_STEP * base.world_from_scene.scale
    np.testing.assert_allclose(back, [camera.center for camera in true], rtol=0, atol=limit)
    assert len(base.points) == 2400
    np.testing.assert_array_equal(base.points % POINT_STEP, 0.0)
    for name, scene in scenes.items():
        np.testing.assert_array_equal(scene.points, base.points, err_msg=name)
        for camera, other in zip(scene.cameras, base.cameras, strict=True):
            np.testing.assert_array_equal(camera.cam_from_world, other.cam_from_world, name)


@pytest.fixture(scope="module")
def meshed(inputs: dict[str, BallScene]) -> dict[str, Path]:
    """Train and mesh the scene at every similarity, in this process; return the results."""
    results = {}
    for name, scene in inputs.items():
        box = scene.folder.parent / "ball.json"
        low, high = np.array([[-1.3, -1.3, -0.95], [1.3, 1.3, 1.65]]) * scene.scale + scene.offset
        write_region(box, Region.box("ball", low, high))
        settings = JobSettings(
            regions=(str(box),),
            training=TrainingSettings(iterations=80, max_gaussians=2500),
            meshing=MeshingSettings(edge_length=0.15 * scene.scale, points=0),
            texture=TextureSettings(size_px=64),
            export=("glb", "obj", "ply"),
        )
        job = make_job("wrap", scene.folder, settings)
        folder = JobFolder(scene.folder.parent / "out")
        folder.create()
        run_job(folder, job, lambda event: None, lambda: False)
        results[name] = folder.result / "ball"
    return results


@pytest.mark.proof
@pytest.mark.parametrize("name", list(SIMILARITIES)[1:])
def test_the_mesh_has_the_same_bits(meshed: dict[str, Path], name: str) -> None:
    with (
        np.load(meshed["as it is"] / "mesh.npz") as base,
        np.load(meshed[name] / "mesh.npz") as own,
    ):
        assert len(base["faces"]) > 300
        for array in ("faces", "vertices", "corner_uvs"):
            np.testing.assert_array_equal(own[array], base[array], err_msg=array)


@pytest.mark.proof
@pytest.mark.parametrize("name", list(SIMILARITIES))
@pytest.mark.parametrize("file", ["mesh.ply", "mesh.obj", "mesh.glb"])
def test_files_hold_the_mesh_after_undoing_the_similarity(
    meshed: dict[str, Path], name: str, file: str
) -> None:
    """Vertex by vertex, which bounds the Hausdorff distance, where a file keeps their order."""
    scale, offset = SIMILARITIES[name]

    def in_ball_units(own: str) -> trimesh.Trimesh:
        path, (own_scale, own_offset) = meshed[own], SIMILARITIES[own]
        with np.load(path / "mesh.npz") as arrays:
            vertices, faces = arrays["vertices"], arrays["faces"]
        frame = json.loads((path / "transform.json").read_text())
        world = Similarity.from_json(frame["world_from_scene"]).points(vertices)
        return trimesh.Trimesh((world - own_offset) / own_scale, faces, process=False)

    base = in_ball_units("as it is")
    size = float(np.linalg.norm(np.ptp(base.vertices, axis=0)))
    assert 3.0 < size < 5.0
    np.testing.assert_allclose(in_ball_units(name).vertices, base.vertices, atol=1e-9 * size)
    shift = np.array(json.loads((meshed[name] / "transform.json").read_text())["offset"])
    mesh = trimesh.load(meshed[name] / file, force="mesh", process=False)
    world = np.asarray(mesh.vertices, np.float64)
    if file == "mesh.glb":
        world = world @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # Y up to Z up
    if file != "mesh.ply":
        world = world + shift
    local = (world - offset) / scale
    _, there, _ = trimesh.proximity.closest_point(base, local)
    written = trimesh.Trimesh(local, mesh.faces, process=False)
    _, back, _ = trimesh.proximity.closest_point(written, base.vertices)
    assert max(there.max(), back.max()) < 0.1 * SHARE * size
