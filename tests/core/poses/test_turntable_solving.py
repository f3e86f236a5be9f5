# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a turntable without cameras: solved by what turns, masked, and trained as such."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.evaluation.alignment import pose_errors
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.scene import Scene, load_saved_scene, save_scene
from tests.core.poses.turntable_photos import Turntable, turntable, write_photos

COUNT, WIDTH, HEIGHT = 20, 400, 300


@pytest.fixture(scope="module")
def made() -> Turntable:
    return turntable(COUNT, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def photos(made: Turntable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("turntable") / "photos"
    write_photos(made, folder)
    return folder


@pytest.fixture(scope="module")
def solved(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(photos, tmp_path_factory.mktemp("solved"), Progress(), threads=2)


@pytest.mark.proof
def test_cameras_go_around_what_turns(made: Turntable, solved: Scene) -> None:
    errors = pose_errors(solved.cameras, made.cameras)
    assert len(errors.names) == COUNT
    assert np.median(errors.rotation_degrees) < 1.0
    assert np.median(errors.center_shares) < 0.02
    assert solved.facts["turntable_photos"] == COUNT


@pytest.mark.proof
def test_each_photo_has_a_mask_of_what_turns(solved: Scene) -> None:
    assert solved.facts["photos_masked_as_turning"] == COUNT
    assert solved.facts["photos_masked"] == COUNT
    store = PhotoStore(solved, 4096)
    shares = [float(np.mean(store.mask(i))) for i in range(COUNT)]
    assert 0.05 < min(shares) <= max(shares) < 0.5
    # The points are of what turns: every mask contains them.
    for i in range(0, COUNT, 4):
        mask = store.mask(i)
        pixels, depth = store.camera(i).project(solved.points)
        visible = (depth > 0) & (pixels >= 0).all(1) & (pixels < mask.shape[::-1]).all(1)
        column, row = pixels[visible].astype(int).T
        assert mask[row, column].mean() > 0.9


@pytest.mark.proof
def test_masks_of_a_turntable_show_background(solved: Scene, tmp_path: Path) -> None:
    modes = {mode: solved.mask_mode(mode) for mode in ("auto", "ignore", "background")}
    assert modes == {"auto": "background", "ignore": "ignore", "background": "background"}
    save_scene(solved, tmp_path)
    assert load_saved_scene(tmp_path).mask_mode("auto") == "background"


@pytest.mark.proof
def test_masks_of_the_user_are_taken_instead(made: Turntable, photos: Path, tmp_path: Path) -> None:
    """They mean what the user says, not that nothing is there."""
    source = tmp_path / "own"
    (source / "masks").mkdir(parents=True)
    for path in sorted(photos.iterdir()):
        Image.open(path).save(source / path.name, quality=95, exif=Image.open(path).getexif())
        Image.new("L", (WIDTH, HEIGHT), 255).save(source / "masks" / f"{path.name}.png")
    scene = load_scene(source, tmp_path / "work", Progress(), threads=2)
    assert scene.facts["turntable_photos"] == COUNT
    assert "photos_masked_as_turning" not in scene.facts
    assert scene.mask_mode("auto") == "ignore"
    assert len(scene.views) >= 0.8 * COUNT
    assert [w.code for w in scene.warnings if "turntable" in w.code] == ["turntable-with-masks"]


@pytest.mark.proof
def test_the_camera_may_stand_in_two_places(tmp_path: Path) -> None:
    """Between both the background moves as one body, which masks need not contain."""
    made = turntable(36, 480, 360, elevations=2)
    write_photos(made, tmp_path / "photos")
    scene = load_scene(tmp_path / "photos", tmp_path / "work", Progress(), threads=2)
    assert scene.facts["photos_masked_as_turning"] == len(scene.views) == 36
    assert np.median(pose_errors(scene.cameras, made.cameras).rotation_degrees) < 1.0


@pytest.mark.proof
def test_a_pause_over_a_repeated_pattern_is_no_turntable(tmp_path: Path) -> None:
    """Wrong matches among tiles move as one body; nothing differs in the photos."""
    random = np.random.default_rng(0)
    tile = random.integers(0, 255, (24, 24, 3))
    photo = random.integers(0, 255, (30, 40, 3)).repeat(8, 0).repeat(8, 1)[:240, :320]
    photo[:, 160:] = np.tile(tile, (10, 7, 1))[:, :160]
    source = tmp_path / "pause"
    source.mkdir()
    for k in range(9):
        noisy = (photo + random.normal(size=photo.shape) * 2).clip(0, 255).astype(np.uint8)
        Image.fromarray(noisy).save(source / f"{k}.png")
    with pytest.raises(DatasetError) as caught:  # nothing has parallax
        load_scene(source, tmp_path / "work", Progress(), threads=2)
    assert "placed" in caught.value.message
    assert not (tmp_path / "work" / "turntable").exists()


def test_a_walk_around_an_object_is_no_turntable(tmp_path: Path) -> None:
    bananas = Path(__file__).parents[3] / "examples" / "bananas"
    source = tmp_path / "bananas"
    source.mkdir()
    for path in sorted(bananas.glob("*.JPG"))[:5]:
        with Image.open(path) as image:
            image.resize((400, 266)).save(source / path.name, quality=95, exif=image.getexif())
    scene = load_scene(source, tmp_path / "work", Progress(), threads=2)
    assert "turntable_photos" not in scene.facts
    assert all(view.mask_path is None for view in scene.views)
