# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of the zoo as a camera takes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.study import record_path, write_record
from benchmarks.zoo import scene as taken_photos
from benchmarks.zoo.scene import compressed, ensure_taken_scene, scene_folder, taken, taken_folder
from benchmarks.zoo.study import FIGURES, TAKEN, find_scene, is_made, run_case
from tests.benchmarks.invented_records import invented

NAME = "thin-d1"


def grey(level: int) -> np.ndarray:
    return np.full((200, 300, 3), level, np.uint8)


@pytest.mark.parametrize("level", [30, 128, 200])
def test_noise_grows_with_light(level: int) -> None:
    photo = taken(grey(level), 0.4, 2.0, 100, np.random.default_rng(0)).astype(float)
    luma = (photo @ [0.299, 0.587, 0.114]).std()  # JPEG keeps colours at half the size
    of_light = 2.0 * np.sqrt(0.3 + 0.7 * level / 128.0) * np.linalg.norm([0.299, 0.587, 0.114])
    rounding = 0.4  # twice
    assert luma == pytest.approx(np.hypot(of_light, rounding), rel=0.1)
    assert photo.mean() == pytest.approx(level, abs=0.2)


def test_steps_become_soft() -> None:
    step = grey(60)
    step[:, 150:] = 180
    photo = taken(step, 0.6, 0.0, 100, np.random.default_rng(0)).astype(float).mean((0, 2))
    assert 62 < photo[149] < 118
    assert photo[148] < 75
    assert photo[146] == pytest.approx(60, abs=2)


def test_lower_quality_leaves_less() -> None:
    photo = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    lost = [np.abs(compressed(photo, q).astype(float) - photo).mean() for q in (95, 60)]
    assert 0.0 < lost[0] < lost[1]


def scene_in(root: Path) -> Path:
    """Write what stands for the clean scene."""
    clean = scene_folder(NAME, root)
    for folder in ("images", "test/images"):
        (clean / folder).mkdir(parents=True)
        for number in range(2):
            Image.fromarray(grey(90)).save(clean / folder / f"{number}.png")
    (clean / "scene.json").write_text("{}")
    return clean


def test_photos_change_and_nothing_else(tmp_path: Path) -> None:
    clean = scene_in(tmp_path)
    made = ensure_taken_scene(NAME, root=tmp_path)
    assert made == taken_folder(NAME, tmp_path)
    assert made.name.startswith(f"{clean.name}-taken-")
    names = sorted(path.relative_to(clean) for path in clean.rglob("*"))
    assert sorted(path.relative_to(made) for path in made.rglob("*")) == names
    changed = [n for n in names if (clean / n).is_file() and not same(clean / n, made / n)]
    assert [str(n.parent) for n in changed] == ["images", "images"]
    photos = [np.asarray(Image.open(made / n)) for n in changed]
    assert not np.array_equal(*photos)  # each has its own noise
    assert ensure_taken_scene(NAME, root=tmp_path) == made
    assert sorted(tmp_path.iterdir()) == [clean, made]


def same(one: Path, other: Path) -> bool:
    return one.read_bytes() == other.read_bytes()


def test_labels_say_which_photos_a_run_is_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.zoo.scene.CACHE", tmp_path)
    scene_in(tmp_path)
    clean, camera = (run_case(NAME, label, "draft", ()) for label in ("draft", "draft" + TAKEN))
    assert find_scene(clean) == scene_folder(NAME)
    assert find_scene(camera) == taken_folder(NAME)
    monkeypatch.setattr(
        "benchmarks.zoo.study.record_path", lambda case: record_path(case, tmp_path)
    )
    for folder, made in ((scene_folder(NAME), False), (taken_folder(NAME), True)):
        record = invented(camera)
        record.scores[FIGURES] = {"scene": folder.name}
        write_record(record, tmp_path)
        assert is_made(camera) is made


def test_half_made_scenes_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clean = scene_in(tmp_path)
    monkeypatch.setattr(taken_photos, "taken", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        ensure_taken_scene(NAME, root=tmp_path)
    assert list(tmp_path.iterdir()) == [clean]
