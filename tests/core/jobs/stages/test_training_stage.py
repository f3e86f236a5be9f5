# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages of a training: blocks, and retries after running out of memory."""

from __future__ import annotations

import shutil
import weakref
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.devices import choose_device
from gaussian_wrapping_addon.core.errors import (
    EXIT_RESOURCES,
    Cancelled,
    DatasetError,
    ResourceError,
    UsageError,
    WorkerError,
)
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.jobs.stages.training import (
    GAUSSIANS_NAME,
    MIN_GAUSSIANS,
    MIN_IMAGE_PX,
    TrainingStages,
    reduced_settings,
    train_with_oom_retry,
)
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.rollback import continue_training_job
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene
from gaussian_wrapping_addon.core.settings import JobSettings, TrainingSettings
from gaussian_wrapping_addon.core.training import blocks as block_module
from gaussian_wrapping_addon.core.training.block_plan import (
    coarse_settings,
    plan_blocks,
    train_coarse,
)
from tests.core.jobs.block_jobs import TRAINING, cameras_of, row_job
from tests.core.training.row_scene import join_blocks, train_block
from tests.core.training.test_trainer import StopAt, assert_same

Finished = tuple[JobFolder, JobFile, Stage]


def stages(folder: JobFolder, job: JobFile) -> TrainingStages:
    return TrainingStages(folder, job, cameras_of(folder), 1, choose_device("cpu"))


def trained(folder: JobFolder, job: JobFile, progress: Progress | None = None) -> Stage:
    """Run all parts of the training."""
    progress = progress or Progress()
    stages(folder, job).coarse(progress)
    for index in range(job.settings.training.blocks):
        stages(folder, job).block(index, progress)
    return stages(folder, job).run(progress)


def of_library(folder: JobFolder, root: Path, settings: TrainingSettings) -> OrientedGaussians:
    """Return what the library makes of the same scene and settings."""
    scene = load_saved_scene(cameras_of(folder).folder)
    for name in ("coarse", "0", "1", "joined"):
        (root / name).mkdir(parents=True)
    less = coarse_settings(settings)
    photos, progress = PhotoStore(scene, settings.max_image_px), Progress()
    coarse = train_coarse(
        scene, PhotoStore(scene, less.max_image_px), less, root / "coarse", progress, threads=1
    )
    plan = plan_blocks(coarse, scene, photos, settings, progress, threads=1)
    parts = [
        train_block(plan, k, scene, photos, settings, root / str(k), progress, threads=1).gaussians
        for k in range(2)
    ]
    return join_blocks(
        plan, parts, scene, photos, settings, root / "joined", progress, threads=1
    ).gaussians


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder, job = row_job(tmp_path_factory.mktemp("blocks"))
    return folder, job, trained(folder, job)


def copied(finished: Finished, to: Path) -> JobFolder:
    shutil.copytree(finished[0].root, to / "out")
    return JobFolder(to / "out")


def without_joined(finished: Finished, to: Path) -> Finished:
    """Return a copy whose blocks are still to be joined."""
    folder = copied(finished, to)
    shutil.rmtree(folder.stages / finished[2].folder.name)
    return folder, *finished[1:]


def gaussians_of(stage: Stage) -> OrientedGaussians:
    return load_gaussians(stage.folder / GAUSSIANS_NAME)


def test_the_stages_make_what_the_library_makes(finished: Finished, tmp_path: Path) -> None:
    folder, _, stage = finished
    expected = of_library(folder, tmp_path, TRAINING)
    assert_same(gaussians_of(stage), expected)
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
    finished: Finished, tmp_path: Path
) -> None:
    def times() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in folder.stages.rglob("*.npz")}

    folder, job, stage = copied(finished, tmp_path), *finished[1:]
    before = times()
    assert trained(folder, job).reused
    assert times() == before
    # More training joins the same blocks.
    longer = trained(folder, continue_training_job(folder, job, 10))
    assert longer.done["iterations"] == stage.done["iterations"] + 10
    assert stage.done["held_out_psnr"] < longer.done["held_out_psnr"]
    assert times().items() >= before.items()
    (blocks,) = folder.stages.glob("blocks-*")
    shutil.rmtree(blocks)
    again = trained(folder, job)
    assert (again.reused, again.before) == (True, ())
    assert not blocks.exists()


@pytest.mark.parametrize("damaged", ["block-0001/gaussians.npz", "blocks.npz"])
def test_what_is_damaged_is_made_again(finished: Finished, tmp_path: Path, damaged: str) -> None:
    folder, job, stage = without_joined(finished, tmp_path)
    (path,) = folder.stages.glob(f"blocks-*/{damaged}")
    path.write_bytes(path.read_bytes()[:-200])
    assert_same(gaussians_of(trained(folder, job)), gaussians_of(stage))


def test_an_interrupted_block_goes_on_to_the_same_gaussians(
    finished: Finished, tmp_path: Path
) -> None:
    folder, job, stage = without_joined(finished, tmp_path)
    (block,) = folder.stages.glob("blocks-*/block-0000")
    shutil.rmtree(block)
    with pytest.raises(Cancelled):
        trained(folder, job, StopAt(30).progress())
    assert list(block.glob("checkpoint-*.json"))
    with pytest.raises(WorkerError, match="missing"):
        stages(folder, job).run(Progress())
    assert_same(gaussians_of(trained(folder, job)), gaussians_of(stage))


def test_too_little_memory_names_the_block_and_may_work_elsewhere(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, job, _ = without_joined(finished, tmp_path)
    shutil.rmtree(next(folder.stages.glob("blocks-*/block-0001")))

    def full(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 9 GiB")

    monkeypatch.setattr(block_module, "block_training", full)
    with pytest.raises(ResourceError, match="Block 1 ran out of memory") as caught:
        trained(folder, job)
    assert "--set blocks" in caught.value.hint
    assert caught.value.exit_code == EXIT_RESOURCES


def test_blocks_that_are_none_are_refused(tmp_path: Path) -> None:
    folder, job = row_job(tmp_path, blocks=500)
    with pytest.raises(UsageError, match="cannot be divided into 500 blocks"):
        stages(folder, job).coarse(Progress())
    with pytest.raises(WorkerError, match="not divided into blocks yet"):
        stages(folder, job).block(0, Progress())
    for index in (-1, 500):
        with pytest.raises(UsageError, match=f"no block {index}, but 500 blocks"):
            stages(folder, job).block(index, Progress())


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
    original = block_module.block_training

    def noted(plan: object, index: int, settings: object, priors: dict[int, object]):
        given.append(len(priors))
        return original(plan, index, settings, priors)

    monkeypatch.setattr(block_module, "block_training", noted)
    stage = trained(folder, job)
    assert given == [of["photos"] for of in stage.done["blocks"]]
    assert stage.done["poses_refined"] is True
    poses = np.load(stage.folder / "camera_poses.npz")["cam_from_world"]
    given_poses = np.array(
        [v.camera.cam_from_world for v in load_saved_scene(cameras_of(folder).folder).views]
    )
    assert 0.0 < np.abs(poses - given_poses).max() < 0.1


ASKED = TrainingSettings(max_gaussians=10_000, max_image_px=400)
FIRST, SECOND = (6000, 300), (3600, 225)


def failing(error: Exception, times: int) -> tuple[Callable, list[tuple[int, int]]]:
    """Return a training that fails so many times, and the list of what it was given."""
    seen: list[tuple[int, int]] = []

    def train(settings: TrainingSettings) -> tuple[int, int]:
        seen.append((settings.max_gaussians, settings.max_image_px))
        if len(seen) <= times:
            raise error
        return seen[-1]

    return train, seen


@pytest.mark.parametrize(
    ("error", "times"),
    [
        (MemoryError("Unable to allocate 3 GiB"), 1),
        (ResourceError("9 pairs of Gaussian and tile do not fit.", "Render a smaller image."), 2),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 3 bytes"), 1),
        (RuntimeError("CUDA out of memory. Tried to allocate"), 2),
        (MemoryError(), 9),
    ],
)
def test_steps_down_and_says_so(tmp_path: Path, error: Exception, times: int) -> None:
    train, seen = failing(error, times)
    forgotten: list[int] = []
    told = nullcontext() if times < 3 else pytest.raises(ResourceError, match="at most 3600 Gauss")
    with told as caught:
        trained = train_with_oom_retry(train, ASKED, tmp_path, lambda: forgotten.append(len(seen)))
    assert seen == [(10_000, 400), FIRST, SECOND][: times + 1]
    if caught is not None:
        assert caught.value.hint
        return
    assert trained.result == seen[-1]
    assert (trained.settings.max_gaussians, trained.settings.max_image_px) == seen[-1]
    assert forgotten == list(range(1, times + 1))
    assert len(trained.warnings) == times
    for warning, (gaussians, side_px) in zip(trained.warnings, seen[1:], strict=True):
        assert f"{gaussians} Gaussians" in warning.text
        assert f"{side_px} px" in warning.text


@pytest.mark.parametrize(
    "error", [RuntimeError("shape mismatch"), ValueError("x"), Cancelled(), DatasetError("x")]
)
def test_other_failures_are_passed_on_at_once(tmp_path: Path, error: Exception) -> None:
    train, seen = failing(error, 1)
    with pytest.raises(type(error)):
        train_with_oom_retry(train, ASKED, tmp_path, lambda: pytest.fail("nothing to forget"))
    assert len(seen) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_resumed_run_stays_as_small_as_it_was_and_the_failed_try_is_freed(
    tmp_path: Path,
) -> None:
    class Large:
        pass

    alive: list[weakref.ref] = []

    def interrupted(settings: TrainingSettings) -> None:
        if alive:
            assert alive[0]() is None
            raise Cancelled
        large = Large()
        alive.append(weakref.ref(large))
        raise MemoryError

    with pytest.raises(Cancelled):
        train_with_oom_retry(interrupted, ASKED, tmp_path, lambda: None)
    train, seen = failing(MemoryError(), 0)
    trained = train_with_oom_retry(train, ASKED, tmp_path, lambda: pytest.fail("kept checkpoints"))
    assert seen == [FIRST]
    assert len(trained.warnings) == 1


def test_a_step_has_a_floor_and_never_goes_up() -> None:
    settings: TrainingSettings | None = TrainingSettings(max_gaussians=1500, max_image_px=120)
    steps = 0
    while (reduced := reduced_settings(settings)) is not None:
        assert reduced.max_gaussians <= settings.max_gaussians
        assert reduced.max_image_px <= settings.max_image_px
        settings, steps = reduced, steps + 1
    assert (settings.max_gaussians, settings.max_image_px) == (MIN_GAUSSIANS, MIN_IMAGE_PX)
    assert 0 < steps < 5
    assert reduced_settings(TrainingSettings(max_gaussians=500, max_image_px=64)) is None
