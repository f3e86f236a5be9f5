# SPDX-License-Identifier: GPL-3.0-or-later
"""A training whose device fails goes on with less of its memory, or without it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from gaussian_wrapping_addon.core.devices.checks import is_device_failure, is_memory_failure
from gaussian_wrapping_addon.core.errors import Cancelled, DeviceError, ResourceError, WrapError
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import start, trainer
from gaussian_wrapping_addon.core.training.cpu_backend import CpuBackend
from gaussian_wrapping_addon.core.training.device_adam import DeviceAdam
from gaussian_wrapping_addon.core.training.device_backend import DeviceBackend
from gaussian_wrapping_addon.core.training.state import TrainingResult
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.device_kernels import kernels_of
from tests.core.training.device_training import emulated_backend, perturbed_sphere
from tests.core.training.small_scene import sphere_scene
from tests.core.training.test_trainer import StopAt, assert_same

ITERATIONS, SNAPSHOT, SEED = 12, 4, 1

SETTINGS = TrainingSettings(
    iterations=ITERATIONS, max_gaussians=120, max_image_px=32, sh_degree=1, densify_every=4,
    depth_from=0.1, checkpoint_every_s=1e9, dense_start="off", multi_view="off", harmonics="off",
    wrapping="off", prune_share=0.0, exposure="on", refine_poses="on",
)  # fmt: skip

DRIVER = RuntimeError("CUDA error: an illegal memory access was encountered")
FULL = (torch.OutOfMemoryError("CUDA out of memory."), ResourceError("The lists are too long."))


@pytest.fixture(autouse=True)
def _uneven_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start, "initial_gaussians", lambda *_, **__: perturbed_sphere(80, SEED))
    monkeypatch.setattr(trainer, "SNAPSHOT_EVERY", SNAPSHOT)


@pytest.fixture
def backend(request: pytest.FixtureRequest) -> DeviceBackend:
    return emulated_backend(kernels_of("emulated", request), "cuda:0")


def trained(folder: Path, backend: DeviceBackend | None, **changes: Any) -> TrainingResult:
    folder.mkdir(exist_ok=True)
    scene, photos = sphere_scene(views=9, size_px=16)
    settings = dataclasses.replace(SETTINGS, **changes)
    return train(
        scene, photos, settings, folder, Progress(), seed=SEED, threads=1, backend=backend
    )  # fmt: skip


def fails(owner: Any, name: str, errors: dict[int, Exception]) -> Callable[[], int]:
    """Make calls of a method raise, counted from 1; return what tells the number of calls."""
    honest, calls = getattr(owner, name), [0]

    def sometimes(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        if calls[0] in errors:
            raise errors[calls[0]]
        return honest(*arguments, **named)

    setattr(owner, name, sometimes)
    return lambda: calls[0]


def told(result: TrainingResult) -> list[str]:
    """Return the warnings, all of which tell of the device."""
    assert {warning.code for warning in result.warnings} <= {"device-failed"}
    return [warning.text for warning in result.warnings]


@pytest.mark.parametrize("error", FULL, ids=lambda error: type(error).__name__)
def test_too_little_memory_once_goes_on_with_less_from_the_last_snapshot(
    backend: DeviceBackend, error: Exception, tmp_path: Path
) -> None:
    calls = fails(backend, "render", {7: error})
    found = trained(tmp_path / "a", backend)
    (text,) = told(found)
    assert "it went on with less memory from iteration 4" in text
    assert (found.device, found.iterations, calls()) == ("cuda:0", ITERATIONS, ITERATIONS + 3)
    assert backend.budget_share < 1.0
    # With the same pieces as before, as all fitted: no bit is lost.
    undisturbed = trained(tmp_path / "b", emulated_backend(backend.kernels))
    assert_same(found.gaussians, undisturbed.gaussians)
    assert found.held_out == undisturbed.held_out


def test_too_little_memory_twice_goes_on_on_the_processor(
    backend: DeviceBackend, tmp_path: Path
) -> None:
    calls = fails(backend, "render", {7: FULL[0], 12: FULL[1]})
    found = trained(tmp_path / "a", backend)
    first, second = told(found)
    assert "with less memory from iteration 4" in first
    assert "on the processor from iteration 8" in second
    assert (found.device, found.iterations, calls()) == ("cpu", ITERATIONS, 12)
    alone = trained(tmp_path / "b", None)
    assert found.history[-1]["loss"] == pytest.approx(alone.history[-1]["loss"], rel=1e-3)


def test_a_driver_that_fails_leaves_the_last_snapshot(
    backend: DeviceBackend, tmp_path: Path
) -> None:
    fails(backend, "render", {7: DRIVER})
    found = trained(tmp_path / "a", backend)
    (text,) = told(found)
    assert "cuda:0 failed in the training (CUDA error" in text
    assert "on the processor from iteration 4" in text
    assert found.device == "cpu"


@pytest.mark.parametrize(("saved", "start"), [(True, 6), (False, 0)])
def test_a_driver_that_takes_the_snapshot_along(
    backend: DeviceBackend,
    monkeypatch: pytest.MonkeyPatch,
    saved: bool,
    start: int,
    tmp_path: Path,
) -> None:
    calls = fails(backend, "render", {7: DRIVER})
    copy = DeviceAdam.copy

    def lost(self: DeviceAdam) -> DeviceAdam:
        if calls() >= 7:
            raise DRIVER
        return copy(self)

    monkeypatch.setattr(DeviceAdam, "copy", lost)
    found = trained(tmp_path / "a", backend, checkpoint_every_s=0.0 if saved else 1e9)
    (text,) = told(found)
    assert f"on the processor from iteration {start}." in text
    assert (found.device, found.iterations) == ("cpu", ITERATIONS)
    alone = trained(tmp_path / "b", None)
    assert found.history[-1]["loss"] == pytest.approx(alone.history[-1]["loss"], rel=1e-3)
    if not saved:
        assert_same(found.gaussians, alone.gaussians)


@pytest.mark.parametrize("where", ["step", "numbers", "compare_colors"])
def test_other_parts_of_an_iteration_may_fail_as_well(
    backend: DeviceBackend, where: str, tmp_path: Path
) -> None:
    fails(backend, where, {6: DRIVER})
    found = trained(tmp_path, backend)
    assert "on the processor from iteration 4" in told(found)[0]


def test_a_round_between_iterations_may_fail(backend: DeviceBackend, tmp_path: Path) -> None:
    fails(backend.renderer, "render", {3: FULL[1]})
    found = trained(tmp_path, backend, prune_share=0.03)
    assert [text.partition(" from")[0][-16:] for text in told(found)] == ["with less memory"]
    assert found.device == "cuda:0"


@pytest.mark.parametrize("where", ["live picture", "checkpoint", "end"])
def test_what_is_done_beside_the_training_may_fail(
    backend: DeviceBackend, where: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    changes = {}
    if where == "live picture":
        monkeypatch.setattr(trainer, "REPORT_EVERY", 6)
        fails(backend.renderer, "render", {1: DRIVER})
        changes["preview_every_s"] = 1e-9
    elif where == "checkpoint":
        monkeypatch.setattr(DeviceAdam, "on_host", DeviceAdam.on_host)  # undone at the end
        fails(DeviceAdam, "on_host", {6: DRIVER})
        changes["checkpoint_every_s"] = 0.0
    else:
        monkeypatch.setattr(trainer, "held_out_metrics", trainer.held_out_metrics)
        fails(trainer, "held_out_metrics", {1: DRIVER})
    found = trained(tmp_path, backend, **changes)
    (text,) = told(found)
    assert f"on the processor from iteration {ITERATIONS if where == 'end' else 4}." in text
    assert (found.device, found.iterations) == ("cpu", ITERATIONS)
    assert len(found.held_out) == 2


def test_no_room_for_the_snapshots_copy_goes_on_from_the_checkpoint(
    backend: DeviceBackend, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls = fails(backend, "render", {7: FULL[1]})
    copy = DeviceAdam.copy

    def lost(self: DeviceAdam) -> DeviceAdam:
        if calls() >= 7:
            raise FULL[0]
        return copy(self)

    monkeypatch.setattr(DeviceAdam, "copy", lost)
    found = trained(tmp_path, backend, checkpoint_every_s=0.0)
    assert "on the processor from iteration 6" in told(found)[0]
    assert (found.device, found.iterations) == ("cpu", ITERATIONS)


@pytest.mark.parametrize(
    "error", [RuntimeError("shapes do not match"), WrapError("Something else.")], ids=type
)
def test_other_errors_are_raised(backend: DeviceBackend, error: Exception, tmp_path: Path) -> None:
    fails(backend, "render", {7: error})
    with pytest.raises(type(error)) as caught:
        trained(tmp_path, backend)
    assert caught.value is error


def test_the_processors_memory_is_no_device(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise FULL[1]

    monkeypatch.setattr(CpuBackend, "render", full)
    with pytest.raises(ResourceError):
        trained(tmp_path, None)


def test_which_errors_are_a_devices() -> None:
    assert all(is_memory_failure(error) and is_device_failure(error) for error in FULL)
    for error in (DRIVER, DeviceError("x"), RuntimeError("CUDA driver error: unknown")):
        assert is_device_failure(error)
        assert not is_memory_failure(error)
    for error in (RuntimeError("index out of range"), ValueError("CUDA error"), WrapError("x")):
        assert not is_device_failure(error)


@pytest.mark.parametrize("owner", ["backend", "adam"])
def test_no_room_at_the_very_start_goes_on_on_the_processor(
    owner: str, backend: DeviceBackend, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    alone = trained(tmp_path / "cpu", None)
    if owner == "backend":
        monkeypatch.setattr(backend, "adopted", failing(backend.adopted, {1: FULL[0]}))
    else:
        monkeypatch.setattr(DeviceAdam, "copy", failing(DeviceAdam.copy, {1: FULL[0]}))
    result = trained(tmp_path / "device", backend)
    assert result.device == "cpu"
    assert [w.code for w in result.warnings].count("device-failed") == 1
    assert_same(result.gaussians, alone.gaussians)


def test_a_device_that_fails_while_going_back_is_left(
    backend: DeviceBackend, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    honest, calls = backend.compare_colors, [0]

    def once_not_a_number(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        value, gradients, squared = honest(*arguments, **named)
        return value * (float("nan") if calls[0] == 6 else 1.0), gradients, squared

    monkeypatch.setattr(backend, "compare_colors", once_not_a_number)
    adopted = failing(backend.adopted, {2: DRIVER})
    monkeypatch.setattr(backend, "adopted", adopted)
    result = trained(tmp_path, backend)
    assert result.device == "cpu"
    assert "device-failed" in [w.code for w in result.warnings]
    assert all(torch.isfinite(t).all() for _, t in result.gaussians.tensors())


def test_cancelling_after_the_device_has_died_is_cancelling(
    backend: DeviceBackend, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stop = StopAt(10)
    scene, photos = sphere_scene(views=9, size_px=16)
    monkeypatch.setattr(DeviceAdam, "is_finite", failing(DeviceAdam.is_finite, {3: DRIVER}))
    with pytest.raises(Cancelled):
        train(scene, photos, SETTINGS, tmp_path, stop.progress(), seed=SEED, backend=backend)


def failing(honest: Callable[..., Any], errors: dict[int, Exception]) -> Callable[..., Any]:
    """Return a callable that raises instead of its calls of some numbers, from 1."""
    calls = [0]

    def sometimes(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        if calls[0] in errors:
            raise errors[calls[0]]
        return honest(*arguments, **named)

    return sometimes
