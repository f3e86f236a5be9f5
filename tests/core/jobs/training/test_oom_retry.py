# SPDX-License-Identifier: GPL-3.0-or-later
"""Retries after running out of memory: reduced settings, a warning, the same when resumed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import Cancelled, DatasetError, ResourceError
from gaussian_wrapping_addon.core.jobs.stages.training import (
    GAUSSIANS_FACTOR,
    IMAGE_FACTOR,
    MIN_GAUSSIANS,
    MIN_IMAGE_PX,
    killed_hint,
    reduced_settings,
    train_with_oom_retry,
)
from gaussian_wrapping_addon.core.settings import TrainingSettings

ASKED = TrainingSettings(max_gaussians=10_000, max_image_px=400)
FIRST = (6000, 300)
SECOND = (3600, 225)


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
    "error",
    [
        MemoryError("Unable to allocate 3 GiB"),
        MemoryError(),
        ResourceError("9 pairs of Gaussian and tile do not fit.", "Render a smaller image."),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 3 bytes"),
        RuntimeError("CUDA out of memory. Tried to allocate"),
    ],
)
@pytest.mark.parametrize("times", [1, 2])
def test_steps_down_and_says_so(tmp_path: Path, error: Exception, times: int) -> None:
    train, seen = failing(error, times)
    forgotten: list[int] = []
    trained = train_with_oom_retry(train, ASKED, tmp_path, lambda: forgotten.append(len(seen)))
    assert seen == [(10_000, 400), FIRST, SECOND][: times + 1]
    assert trained.result == seen[-1]
    assert (trained.settings.max_gaussians, trained.settings.max_image_px) == seen[-1]
    assert forgotten == list(range(1, times + 1))
    assert len(trained.warnings) == times
    for warning, (gaussians, side_px) in zip(trained.warnings, seen[1:], strict=True):
        assert f"{gaussians} Gaussians" in warning.text
        assert f"{side_px} px" in warning.text


def test_the_third_failure_is_told(tmp_path: Path) -> None:
    train, seen = failing(MemoryError("full"), 9)
    with pytest.raises(ResourceError, match="even with at most 3600 Gaussians") as caught:
        train_with_oom_retry(train, ASKED, tmp_path, lambda: None)
    assert len(seen) == 3
    assert caught.value.hint


@pytest.mark.parametrize(
    "error", [RuntimeError("shape mismatch"), ValueError("x"), Cancelled(), DatasetError("x")]
)
def test_other_failures_are_passed_on_at_once(tmp_path: Path, error: Exception) -> None:
    train, seen = failing(error, 1)
    with pytest.raises(type(error)):
        train_with_oom_retry(train, ASKED, tmp_path, lambda: pytest.fail("nothing to forget"))
    assert len(seen) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_resumed_run_stays_as_small_as_it_was(tmp_path: Path) -> None:
    sizes: list[int] = []

    def interrupted(settings: TrainingSettings) -> None:
        sizes.append(settings.max_gaussians)
        raise MemoryError if len(sizes) == 1 else Cancelled

    with pytest.raises(Cancelled):
        train_with_oom_retry(interrupted, ASKED, tmp_path, lambda: None)
    train, seen = failing(MemoryError(), 0)
    trained = train_with_oom_retry(train, ASKED, tmp_path, lambda: pytest.fail("kept checkpoints"))
    assert seen == [FIRST]
    assert len(trained.warnings) == 1


def test_memory_of_the_failed_try_is_free_before_the_next(tmp_path: Path) -> None:
    import weakref

    class Large:
        pass

    alive: list[weakref.ref] = []

    def train(_settings: TrainingSettings) -> int:
        if alive:
            return sum(reference() is not None for reference in alive)
        large = Large()
        alive.append(weakref.ref(large))
        raise MemoryError

    assert train_with_oom_retry(train, ASKED, tmp_path, lambda: None).result == 0


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


def test_a_killed_worker_is_told_a_number() -> None:
    assert "--max-gaussians 6000" in killed_hint(ASKED)
    assert (GAUSSIANS_FACTOR, IMAGE_FACTOR) == (0.6, 0.75)
