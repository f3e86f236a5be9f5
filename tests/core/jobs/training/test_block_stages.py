# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages of a training in blocks: what the library makes, used again, and done again if damaged."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.devices import choose_device
from gaussian_wrapping_addon.core.errors import (
    EXIT_RESOURCES,
    Cancelled,
    ResourceError,
    UsageError,
    WorkerError,
)
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.jobs.stages.training import (
    GAUSSIANS_NAME,
    run_block,
    run_coarse,
    run_training,
)
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.rollback import continue_training_job
from gaussian_wrapping_addon.core.jobs.store.stage_folder import STAGE_VERSIONS, Stage
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene
from gaussian_wrapping_addon.core.settings import JobSettings, TrainingSettings
from gaussian_wrapping_addon.core.training import blocks as block_module
from gaussian_wrapping_addon.core.training.block_plan import (
    BlockSettings,
    plan_blocks,
    train_coarse,
)
from gaussian_wrapping_addon.core.training.blocks import join_blocks, train_block
from tests.core.jobs.block_jobs import TRAINING, cameras_of, row_job
from tests.core.training.test_trainer import StopAt, assert_same

KNOWN = {"version": STAGE_VERSIONS["train"], "threads": 1, "device": choose_device("cpu")}


def trained(folder: JobFolder, job: JobFile, progress: Progress | None = None) -> Stage:
    """Run all parts of the training."""
    cameras, progress = cameras_of(folder), progress or Progress()
    run_coarse(folder, job, cameras, progress, **KNOWN)
    for index in range(job.settings.training.blocks):
        run_block(folder, job, cameras, index, progress, **KNOWN)
    return run_training(folder, job, cameras, progress, **KNOWN)


def of_library(folder: JobFolder, root: Path, settings: TrainingSettings) -> OrientedGaussians:
    """Return what the library makes of the same scene and settings."""
    scene, blocks = load_saved_scene(cameras_of(folder).folder), BlockSettings.of(settings)
    for name in ("coarse", "0", "1", "joined"):
        (root / name).mkdir(parents=True)
    less = blocks.coarse(settings)
    photos, progress = PhotoStore(scene, settings.max_image_px), Progress()
    coarse = train_coarse(
        scene, PhotoStore(scene, less.max_image_px), less, root / "coarse", progress, threads=1
    )
    plan = plan_blocks(coarse, scene, photos, settings, blocks, progress, threads=1)
    parts = [
        train_block(plan, k, scene, photos, settings, root / str(k), progress, threads=1).gaussians
        for k in range(2)
    ]
    return join_blocks(
        plan, parts, scene, photos, settings, blocks, root / "joined", progress, threads=1
    ).gaussians


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[JobFolder, JobFile, Stage]:
    folder, job = row_job(tmp_path_factory.mktemp("blocks"))
    return folder, job, trained(folder, job)


def copied(finished: tuple[JobFolder, JobFile, Stage], to: Path) -> JobFolder:
    shutil.copytree(finished[0].root, to / "out")
    return JobFolder(to / "out")


def tokens(folder: JobFolder) -> dict[str, int]:
    """Return the times of the files that trainings leave."""
    return {
        path.relative_to(folder.stages).as_posix(): path.stat().st_mtime_ns
        for path in folder.stages.rglob("*.npz")
    }


def test_the_stages_make_what_the_library_makes(
    finished: tuple[JobFolder, JobFile, Stage], tmp_path: Path
) -> None:
    folder, _, stage = finished
    expected = of_library(folder, tmp_path, TRAINING)
    assert_same(load_gaussians(stage.folder / GAUSSIANS_NAME), expected)
    assert [before.name for before in stage.before] == ["coarse", "block", "block"]
    figures = stage.done["blocks"]
    assert len(figures) == 2
    assert all(
        of["photos"] >= 8 and of["gaussians"] >= 100 and of["peak_memory_bytes"] > 1 << 20
        for of in figures
    )
    assert stage.done["gaussians"] == len(expected)
    assert stage.done["estimate"]["seconds_high"] > stage.done["estimate"]["seconds_low"] > 0
    left = [p.name for p in folder.stages.glob("blocks-*/*/checkpoint*")]
    assert left == [], "blocks that are done need no checkpoints"


def test_finished_stages_are_used_again_and_blocks_may_go_once_they_are_joined(
    finished: tuple[JobFolder, JobFile, Stage], tmp_path: Path
) -> None:
    folder, job = copied(finished, tmp_path), finished[1]
    before = tokens(folder)
    assert trained(folder, job).reused
    assert tokens(folder) == before
    (blocks,) = folder.stages.glob("blocks-*")
    shutil.rmtree(blocks)
    again = trained(folder, job)
    assert (again.reused, again.before) == (True, ())
    assert not blocks.exists()


def test_more_training_joins_the_same_blocks(
    finished: tuple[JobFolder, JobFile, Stage], tmp_path: Path
) -> None:
    folder, job, stage = copied(finished, tmp_path), *finished[1:]
    blocks = {name: at for name, at in tokens(folder).items() if name.startswith("blocks")}
    longer = trained(folder, continue_training_job(folder, job, 10))
    assert longer.done["iterations"] == stage.done["iterations"] + 10
    assert stage.done["held_out_psnr"] < longer.done["held_out_psnr"]
    assert {n: at for n, at in tokens(folder).items() if n.startswith("blocks")} == blocks


@pytest.mark.parametrize("damaged", ["block-0001/gaussians.npz", "blocks.npz"])
def test_what_is_damaged_is_made_again(
    finished: tuple[JobFolder, JobFile, Stage], tmp_path: Path, damaged: str
) -> None:
    folder, job, stage = copied(finished, tmp_path), *finished[1:]
    shutil.rmtree(folder.stages / stage.folder.name)
    (path,) = folder.stages.glob(f"blocks-*/{damaged}")
    path.write_bytes(path.read_bytes()[:-200])
    again = trained(folder, job)
    assert_same(
        load_gaussians(again.folder / GAUSSIANS_NAME), load_gaussians(stage.folder / GAUSSIANS_NAME)
    )


def test_an_interrupted_block_goes_on_to_the_same_gaussians(
    finished: tuple[JobFolder, JobFile, Stage], tmp_path: Path
) -> None:
    folder, job, stage = copied(finished, tmp_path), *finished[1:]
    shutil.rmtree(folder.stages / stage.folder.name)
    (block,) = folder.stages.glob("blocks-*/block-0000")
    shutil.rmtree(block)
    with pytest.raises(Cancelled):
        trained(folder, job, StopAt(30).progress())
    assert list(block.glob("checkpoint-*.json"))
    with pytest.raises(WorkerError, match="missing"):
        run_training(folder, job, cameras_of(folder), Progress(), **KNOWN)
    again = trained(folder, job)
    assert_same(
        load_gaussians(again.folder / GAUSSIANS_NAME), load_gaussians(stage.folder / GAUSSIANS_NAME)
    )


def test_a_block_before_the_coarse_training_is_refused(tmp_path: Path) -> None:
    folder, job = row_job(tmp_path)
    with pytest.raises(WorkerError, match="not divided into blocks yet"):
        run_block(folder, job, cameras_of(folder), 0, Progress(), **KNOWN)


@pytest.mark.parametrize("index", [-1, 2])
def test_a_block_that_is_none_is_refused(tmp_path: Path, index: int) -> None:
    folder, job = row_job(tmp_path)
    with pytest.raises(UsageError, match=f"no block {index}, but 2 blocks"):
        run_block(folder, job, cameras_of(folder), index, Progress(), **KNOWN)


def test_too_little_memory_names_the_block_and_may_work_elsewhere(
    finished: tuple[JobFolder, JobFile, Stage], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, job, stage = copied(finished, tmp_path), *finished[1:]
    shutil.rmtree(folder.stages / stage.folder.name)
    shutil.rmtree(next(folder.stages.glob("blocks-*/block-0001")))

    def full(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 9 GiB")

    monkeypatch.setattr(block_module, "train_block", full)
    with pytest.raises(ResourceError, match="Block 1 ran out of memory") as caught:
        trained(folder, job)
    assert "--set blocks" in caught.value.hint
    assert caught.value.exit_code == EXIT_RESOURCES


def test_more_blocks_than_the_scene_has_are_refused(tmp_path: Path) -> None:
    folder, job = row_job(tmp_path, blocks=500)
    with pytest.raises(UsageError, match="cannot be divided into 500 blocks"):
        run_coarse(folder, job, cameras_of(folder), Progress(), **KNOWN)


def test_a_training_from_a_splat_is_not_divided(tmp_path: Path) -> None:
    splat = tmp_path / "cloud.ply"
    splat.write_bytes(b"ply\n")
    (tmp_path / "photos").mkdir()
    training = TrainingSettings(blocks=2)
    for source, start in ((splat, ""), (tmp_path / "photos", str(splat))):
        with pytest.raises(UsageError, match="divided into blocks"):
            make_job("wrap", source, JobSettings(training=training, start_splat=start))


def test_all_priors_and_poses_of_the_coarse_training_reach_blocks_and_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dense start leaves confirmed depths for each block; refined poses are the result's."""
    folder, job = row_job(tmp_path, dense_start="on", refine_poses="on")
    given: list[int] = []
    original = block_module.train_block

    def noted(plan: object, index: int, *rest: object, priors: dict[int, object], **more: object):
        given.append(len(priors))
        return original(plan, index, *rest, priors=priors, **more)

    monkeypatch.setattr(block_module, "train_block", noted)
    stage = trained(folder, job)
    assert given == [of["photos"] for of in stage.done["blocks"]]
    assert stage.done["poses_refined"] is True
    poses = np.load(stage.folder / "camera_poses.npz")["cam_from_world"]
    given_poses = np.array(
        [v.camera.cam_from_world for v in load_saved_scene(cameras_of(folder).folder).views]
    )
    assert 0.0 < np.abs(poses - given_poses).max() < 0.1
