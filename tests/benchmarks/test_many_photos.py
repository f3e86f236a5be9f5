# SPDX-License-Identifier: GPL-3.0-or-later
"""Every n-th photo of a project is a project; records become a page."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import many_photos, published_preset
from benchmarks.many_photos import every_nth_photo, photos_case, plan, write_document
from benchmarks.scenes.colmap_project import write_colmap
from benchmarks.scenes.sparse_points import SparsePoints
from gaussian_wrapping_addon.core.dataset.readers.colmap_reader import read_colmap
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.settings import preset
from tests.benchmarks.invented_records import invented
from tests.core.training.small_scene import ring_cameras

FIGURES = {
    "code": "abc", "date": "2026-01-01", "machine": "a machine", "threads": 1, "iterations": 3000,
    "gaussians": 12, "train_processor_s": 60.0, "psnr": 20.0, "ssim": 0.5, "normals": 0.9,
    "thin_recall": None, "f1": {"0.25 %": 0.25, "0.5 %": 0.5, "1 %": 0.75},
}  # fmt: skip


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Six photos; point k is seen by photos k and k + 1, the last one by all."""
    cameras = ring_cameras(6, 16)
    pairs = [(k, k) for k in range(5)] + [(k, k + 1) for k in range(5)] + [(5, c) for c in range(6)]
    pairs.sort()
    ids, views = np.array(pairs).T
    sparse = SparsePoints(
        points=np.arange(18.0).reshape(6, 3),
        colors=np.full((6, 3), 100, np.uint8),
        errors_px=np.full(6, 0.5),
        point_ids=ids,
        camera_ids=views,
        pixels=np.full((len(ids), 2), 8.0),
    )
    folder = tmp_path / "whole"
    write_colmap(folder / "sparse" / "0", cameras, sparse)
    (folder / "images").mkdir()
    for camera in cameras:
        Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(folder / "images" / camera.name)
    (folder / "region.json").write_text("{}")
    return folder


def test_every_second_photo_is_a_project_of_its_own(project: Path, tmp_path: Path) -> None:
    half = every_nth_photo(project, 2, tmp_path / "half")
    assert sorted(p.name for p in (half / "images").iterdir()) == [
        "000.png", "002.png", "004.png",
    ]  # fmt: skip
    found, whole = read_colmap(half), read_colmap(project)
    assert [photo.name for photo in found.photos] == ["000.png", "002.png", "004.png"]
    for mine, other in zip(found.photos, whole.photos[::2], strict=True):
        np.testing.assert_array_equal(mine.cam_from_world, other.cam_from_world)
    # Of neighbours every second is gone, so that one photo is left for all points but the last.
    np.testing.assert_array_equal(found.points, whole.points[5:])


def test_a_part_of_the_photos_is_judged_by_the_whole_scene(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("truth.npz", "crop.json", "scene.json"):
        (project / name).write_text(name)
    (project / "test").mkdir()
    (project / "test" / "cameras.json").write_text("{}")
    monkeypatch.setattr(many_photos, "ensure_scene", lambda *_, **__: project)
    monkeypatch.setattr(many_photos, "KEPT_RUNS", tmp_path / "kept")
    whole, half = (many_photos.find_scene(photos_case("room", step, 0)) for step in (1, 2))
    assert whole == project
    assert sorted(p.name for p in half.iterdir()) == sorted(p.name for p in project.iterdir())
    assert len(list((half / "images").iterdir())) == 3
    assert (half / "truth.npz").read_text() == "truth.npz"
    assert many_photos.find_scene(photos_case("room", 2, 1)) == half


def test_records_become_a_page(tmp_path: Path) -> None:
    levels = {("room", 2, 0): 0.5, ("room", 1, 0): 0.53, ("room", 2, 1): 0.6, ("room", 1, 1): 0.61}
    cases = {key: photos_case(*key) for key in levels}
    records = {c.identity: invented(c, levels[key]) for key, c in cases.items()}
    last = photos_case("room", 1, 2)
    records[last.identity] = invented(last, 0.59)
    text = write_document(tmp_path, records, plan()).read_text()
    assert "1 of 6 planned runs are not made yet" in text
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith("| room")
    ]
    assert [row[:3] for row in rows] == [
        ["room", "60", "2"],
        ["room", "120", "3"],
        ["room", "difference", "2"],
    ]
    f1 = [row[6] for row in rows]
    assert f1[:2] == ["0.550 ± 0.071", "0.577 ± 0.042"]
    assert f1[2] == "+0.020 ± 0.014"


def test_the_page_of_the_published_settings_says_what_ran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(published_preset, "RECORDS", tmp_path)
    for run in published_preset.RUNS:
        write_json(tmp_path / f"{run.scene}-{run.name}.json", {**FIGURES, "run": run.name})
    text = published_preset.document()
    rows = [line for line in text.splitlines() if line.startswith(("| Standard", "| Paper"))]
    assert [row.split("|")[1].strip() for row in rows] == list(published_preset.LABELS.values())
    assert "0.02" in rows[0]  # 60 s of 3000 iterations
    assert "10 %" in rows[1]  # of the published 30 000


def test_paper_runs_differ_by_wrapping_alone() -> None:
    _, with_it, without = published_preset.RUNS
    assert with_it.preset == without.preset == "paper"
    assert without.arguments == (*with_it.arguments, "--wrapping", "off")


def test_paper_decides_nothing_from_the_photos() -> None:
    training = dataclasses.asdict(preset("paper").training)
    del training["mask_mode"]  # what masks mean is no part of the model
    assert "auto" not in training.values()
