# SPDX-License-Identifier: GPL-3.0-or-later
"""``evaluate --metric mbr`` on a stored job: its held-out photo, and photos of a folder."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, UsageError
from gaussian_wrapping_addon.core.evaluation.layouts import read_mesh
from gaussian_wrapping_addon.core.jobs.commands.evaluate_command import job_mesh
from gaussian_wrapping_addon.core.jobs.commands.mesh_based_command import (
    MeshBasedRequest,
    evaluate_mesh_based,
    job_scene,
    table,
)
from gaussian_wrapping_addon.core.progress import Progress

STORED = Path(__file__).resolve().parents[3] / "data" / "job-0.1.0" / "job"


@pytest.fixture
def job(tmp_path: Path) -> Path:
    shutil.copytree(STORED, tmp_path / "job")
    return tmp_path / "job"


def edit(path: Path, change: Any) -> None:
    values = json.loads(path.read_text(encoding="utf-8"))
    change(values)
    path.write_text(json.dumps(values), encoding="utf-8")


def hold_out(job: Path, *names: str) -> None:
    edit(
        job / "result" / "report.json",
        lambda report: report["training"].update(held_out=[{"name": n} for n in names]),
    )


def measure(job: Path, **options: Any) -> dict[str, Any]:
    request = MeshBasedRequest(options.pop("photos", job), **options)
    return evaluate_mesh_based(*read_mesh(job_mesh(job, None)), request, Progress())


def write_test_folder(job: Path, folder: Path, names: list[str]) -> Path:
    """Write photos of the job with their cameras as a folder of test views, world frame."""
    (folder / "images").mkdir(parents=True)
    scene, _ = job_scene(job)
    cameras = []
    for view in scene.views:
        if view.camera.name in names:
            cameras.append(view.camera.moved(scene.world_from_scene).to_json())
            shutil.copy(view.photo_path, folder / "images" / view.camera.name)
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    return folder


def test_a_job_is_judged_by_the_photos_that_it_held_out(job: Path, tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    assert batch.main(["evaluate", str(job), "--metric", "mbr", "--out", str(out)]) == 0
    values = json.loads(out.read_text())
    scene, held_out = job_scene(job)
    assert [view["name"] for view in values["views"]] == held_out == ["00.jpg"]
    assert values["training_views"] == len(scene.views) - 1
    assert values["metric"] == "mbr"
    assert values["psnr"] > 8.0
    assert 0.0 < values["uncovered"] < 0.6
    assert values["covered_psnr"] > values["psnr"]
    assert values["mesh"]["faces"] > 0


def test_refined_poses_of_the_result_are_those_that_judge(job: Path) -> None:
    """The stage of the cameras keeps the poses that were given."""
    given, _ = job_scene(job)
    edit(
        job / "result" / "scene.json",
        lambda summary: summary["cameras"][3]["cam_from_world"][0].__setitem__(3, 0.125),
    )
    found, _ = job_scene(job)
    assert found.views[3].camera.cam_from_world[0, 3] == 0.125
    for k in (0, 1, 2, 4):
        assert found.views[k].camera.to_json() == given.views[k].camera.to_json()
    edit(job / "result" / "scene.json", lambda summary: summary["cameras"][3].update(fx=1.0))
    with pytest.raises(DatasetError, match="no longer in its stages"):
        job_scene(job)


def test_a_folder_of_test_photos_is_as_good_as_holding_them_out(job: Path, tmp_path: Path) -> None:
    held = measure(job)
    folder = write_test_folder(job, tmp_path / "test", ["00.jpg"])
    given = measure(job, test=folder)
    for name in ("psnr", "ssim", "uncovered", "training_psnr"):
        assert given[name] == pytest.approx(held[name], abs=1e-6)
    assert (held["test_from"], given["test_from"]) == ("held-out photos of the job", str(folder))
    assert any("uncovered pixels" in line for line in table(given))
    half = measure(job, max_image_px=40)
    assert half["training_pixels"] == pytest.approx(held["training_pixels"] / 4, rel=0.05)


def test_without_held_out_photos_training_photos_are_not_judged(job: Path, tmp_path: Path) -> None:
    hold_out(job)
    with pytest.raises(UsageError, match="held no photo out") as caught:
        measure(job)
    assert "--holdout" in caught.value.hint
    assert "--test" in caught.value.hint
    assert batch.main(["evaluate", str(job), "--metric", "mbr"]) == 2
    # Nor are they as photos of a folder.
    folder = write_test_folder(job, tmp_path / "test", ["01.jpg"])
    with pytest.raises(UsageError, match=r"01\.jpg has the camera of the training photo 01\.jpg"):
        measure(job, test=folder)


@pytest.mark.proof
def test_a_mesh_file_with_the_photos_of_a_job(job: Path, tmp_path: Path) -> None:
    mesh = str(job_mesh(job, None))
    out = tmp_path / "figures.json"
    words = ["evaluate", mesh, "--metric", "mbr"]
    assert batch.main(words) == 2
    assert batch.main([*words, "--cameras", str(job), "--out", str(out)]) == 0
    assert json.loads(out.read_text())["psnr"] == pytest.approx(measure(job)["psnr"], abs=1e-6)
    # A dataset has no photos that were held out.
    photos = str(STORED.parent / "photos")
    assert batch.main([*words, "--cameras", photos]) == 2


@pytest.mark.parametrize(
    "words",
    [
        "--metric mbr --truth mesh.ply",
        "--metric mbr --max-image-px 10",
        "--truth mesh.ply --test photos",
        "",
    ],
)
def test_options_of_the_other_metric_are_refused(job: Path, words: str) -> None:
    assert batch.main(["evaluate", str(job), *words.split()]) == 2


def test_a_job_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert batch.main(["evaluate", str(tmp_path / "gone"), "--metric", "mbr"]) == 2
    assert "gone does not exist" in capsys.readouterr().out


def test_broken_jobs_and_folders_are_named(job: Path, tmp_path: Path) -> None:
    folder = write_test_folder(job, tmp_path / "test", ["00.jpg"])
    (folder / "images" / "00.jpg").unlink()
    with pytest.raises(ParseError, match="camera 0"):
        measure(job, test=folder)
    (folder / "cameras.json").write_text("[]")
    with pytest.raises(ParseError, match="cameras"):
        measure(job, test=folder)
    bare = tmp_path / "bare"
    bare.mkdir()
    Image.fromarray(np.zeros((20, 20, 3), np.uint8)).save(bare / "a.png")
    with pytest.raises(UsageError, match="photos without cameras"):
        measure(job, test=bare)
    edit(job / "result" / "scene.json", lambda scene: scene["cameras"].pop())
    with pytest.raises(DatasetError, match="no longer in its stages"):
        measure(job)
    (job / "result" / "report.json").unlink()
    with pytest.raises(DatasetError, match=r"no report\.json"):
        measure(job)
