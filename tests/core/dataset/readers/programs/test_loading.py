# SPDX-License-Identifier: GPL-3.0-or-later
"""From another program's cameras to a scene: cameras, points, masks, photos elsewhere."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.jobs.commands.estimate_command import input_facts
from gaussian_wrapping_addon.core.jobs.store.stage_folder import source_fingerprint
from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.loading.source_kind import source_kind
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.frames import POINT_STEP
from gaussian_wrapping_addon.core.scene.scene import Scene
from tests.core.dataset.poses.test_pose_solver import textured_plane
from tests.core.dataset.readers.programs import writers
from tests.core.dataset.readers.programs.known_scene import NAMES, shots, write_photos
from tests.core.dataset.readers.programs.writers import Shots

OSFM = {"focal_x": 0.9, "focal_y": 0.9, "k1": -0.05}


def load(source: Path, work: Path) -> Scene:
    return load_scene(source, work, Progress(), seed=1, threads=1)


def test_poses_and_points_become_a_scene(tmp_path: Path) -> None:
    points = np.random.default_rng(4).uniform(-0.5, 0.5, (300, 3))
    write_photos(tmp_path / "set" / "images")
    written = shots(OSFM, points=points)
    writers.write_opensfm(tmp_path / "set", written)
    scene = load(tmp_path / "set", tmp_path / "work")
    assert scene.facts["kind"] == "OpenSfM reconstruction"
    assert scene.facts["photos_undistorted"] == 4
    centers = scene.world_from_scene.points(np.array([c.center for c in scene.cameras]))
    np.testing.assert_allclose(centers, written.centers(), atol=1e-5)
    step = POINT_STEP * scene.world_from_scene.scale
    np.testing.assert_allclose(scene.world_from_scene.points(scene.points), points, atol=step)
    assert (scene.point_colors == [200, 100, 50]).all()


def test_points_are_triangulated_where_the_file_has_none(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    cameras = textured_plane(tmp_path / "set")
    shutil.rmtree(tmp_path / "set" / "sparse")
    first = cameras[0]
    written = Shots(
        [camera.name for camera in cameras],
        [camera.cam_from_world for camera in cameras],
        first.width,
        first.height,
        {"f": first.fx, "b1": first.fx - first.fy, "cx": 0.0},
    )
    path = writers.write_metashape(tmp_path / "set", written)
    scene = load(path, tmp_path / "work")
    assert scene.facts["start_points"] == "triangulated from the photos"
    assert len(scene.points) >= 200
    world = scene.world_from_scene.points(scene.points)
    assert np.percentile(np.abs(world[:, 2]), 90) < 0.02  # cameras are 2.8 away


def test_masks_beside_photos_of_another_program(tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    (tmp_path / "masks").mkdir()
    Image.new("L", (96, 64), 255).save(tmp_path / "masks" / "IMG_0002.png")
    writers.write_metashape(tmp_path, shots({"f": 88.0}))
    texts = [finding.message for finding in check_input(tmp_path)]
    assert "1 of 4 photos have a mask." in texts
    assert "The input is of kind: Metashape cameras." in texts


def test_a_project_of_opendronemap(tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    (tmp_path / "opensfm").mkdir()
    writers.write_opensfm(tmp_path / "opensfm", shots(OSFM))
    for source in (tmp_path, tmp_path / "opensfm", tmp_path / "opensfm" / "reconstruction.json"):
        kind = source_kind(source)
        assert kind.kind == "OpenSfM reconstruction"
        assert kind.photo_roots[0] == tmp_path / "images"
        findings = check_input(source)
        assert not [f for f in findings if f.severity == "error"]
        assert findings[0].message == "4 photos: 4 of 96 x 64."


def test_polycam_prefers_corrected_cameras(tmp_path: Path) -> None:
    lens = {"fx": 80.0, "fy": 80.0, "cx": 48.0, "cy": 32.0}
    writers.write_polycam(tmp_path, shots(lens), corrected=False)
    write_photos(tmp_path / "keyframes" / "images")
    assert source_kind(tmp_path).program.path.name == "cameras"  # type: ignore[union-attr]
    writers.write_polycam(tmp_path, shots(lens))
    write_photos(tmp_path / "keyframes" / "corrected_images")
    for source in (tmp_path, tmp_path / "keyframes"):
        kind = source_kind(source)
        assert kind.program is not None
        assert kind.program.path.name == "corrected_cameras"
        assert kind.photo_roots == [tmp_path / "keyframes" / "corrected_images"]
        assert not [f for f in check_input(source) if f.severity == "error"]


def test_xmp_files_without_a_pose_are_not_cameras(tmp_path: Path) -> None:
    text = (
        "<x:xmpmeta xmlns:x='adobe:ns:meta/'><d xmlns:xcr='http://www.capturingreality.com/ns/xcr/"
        "1.1#' xcr:Version='3' xcr:PosePrior='initial'/></x:xmpmeta>"
    )
    write_photos(tmp_path)
    for name in NAMES:
        (tmp_path / name).with_suffix(".xmp").write_text(text)
    assert source_kind(tmp_path).kind == "photos"


def test_xmp_files_of_other_programs_are_not_cameras(tmp_path: Path) -> None:
    write_photos(tmp_path)
    for name in NAMES:
        (tmp_path / name).with_suffix(".xmp").write_text("<x:xmpmeta xmlns:x='adobe:ns:meta/'/>")
    assert source_kind(tmp_path).kind == "photos"


def test_photos_that_are_nowhere_are_said(tmp_path: Path) -> None:
    writers.write_meshroom(tmp_path, shots({"f": 32.0}))
    with pytest.raises(DatasetError, match="None of the 4 photos that the Meshroom cameras names"):
        load(tmp_path / "cameras.sfm", tmp_path / "work")


def test_estimates_and_stages_know_the_file(tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    path = writers.write_realityscan_csv(tmp_path, shots({"f": 30.0}))
    assert input_facts(path).photos == 4
    before = source_fingerprint(tmp_path)
    path.write_text(path.read_text().replace("30.0", "31.0"))
    assert source_fingerprint(tmp_path) != before
