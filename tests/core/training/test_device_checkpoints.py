# SPDX-License-Identifier: GPL-3.0-or-later
"""A training begun on one device is finished on another."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.gaussians.model import TRAINED
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import start, trainer
from gaussian_wrapping_addon.core.training.device_adam import DeviceAdam
from gaussian_wrapping_addon.core.training.state import TrainingState, load_checkpoint
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.device_kernels import DEVICES
from tests.core.training.device_training import backend_of, perturbed_sphere
from tests.core.training.small_scene import sphere_scene
from tests.core.training.test_trainer import StopAt

ITERATIONS, STOP, SEED = 20, 10, 1

SETTINGS = TrainingSettings(
    iterations=ITERATIONS, max_gaussians=160, max_image_px=32, sh_degree=1, densify_every=4,
    wrap_rounds=1, wrap_from=0.6, orient_from=0.3, depth_from=0.1, checkpoint_every_s=1e9,
    dense_start="off", multi_view="off", harmonics="on", wrapping="on", prune_share=0.0,
    exposure="on", refine_poses="on",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _uneven_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start, "initial_gaussians", lambda *_, **__: perturbed_sphere(100, SEED))


@pytest.mark.parametrize("first", ["cpu", "device"])
@pytest.mark.parametrize("device", DEVICES)
def test_begun_on_one_device_and_finished_on_the_other(
    request: pytest.FixtureRequest, device: str, first: str, tmp_path: Path
) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    (tmp_path / "whole").mkdir()
    whole = train(scene, photos, SETTINGS, tmp_path / "whole", Progress(), seed=SEED, threads=1)
    backends = [None, backend_of(device, request)]
    if first == "device":
        backends.reverse()
    with pytest.raises(Cancelled):
        train(
            scene, photos, SETTINGS, tmp_path, StopAt(STOP).progress(), seed=SEED, threads=1,
            backend=backends[0],
        )  # fmt: skip
    assert [p.stem for p in tmp_path.glob("checkpoint-*.json")] == [f"checkpoint-{STOP:09d}"]
    watch = StopAt(10**9)
    found = train(
        scene, photos, SETTINGS, tmp_path, watch.progress(), seed=SEED, threads=1,
        backend=backends[1],
    )  # fmt: skip
    reported = [e.figures["iteration"] for e in watch.events if "iteration" in e.figures]
    assert min(reported) > STOP
    assert found.device == (whole.device if first == "device" else backends[1].name)
    assert (found.iterations, found.warnings) == (ITERATIONS, ())
    assert all(bool(tensor.isfinite().all()) for _, tensor in found.gaussians.tensors())
    assert len(found.gaussians) == len(whole.gaussians)
    assert found.history[-1]["loss"] == pytest.approx(whole.history[-1]["loss"], rel=1e-3)
    assert found.held_out_psnr == pytest.approx(whole.held_out_psnr, abs=0.02)


@pytest.mark.parametrize("device", DEVICES)
def test_a_checkpoint_holds_every_bit_of_the_device(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, device: str, tmp_path: Path
) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    kept: list[tuple[TrainingState, str]] = []
    honest = trainer.save_checkpoint

    def save(folder: Path, state: TrainingState, key: str) -> Any:
        kept.append((state, key))
        return honest(folder, state, key)

    monkeypatch.setattr(trainer, "save_checkpoint", save)
    settings = dataclasses.replace(SETTINGS, densify_every=7)  # with statistics in between
    with pytest.raises(Cancelled):
        train(
            scene, photos, settings, tmp_path, StopAt(STOP).progress(), seed=SEED, threads=1,
            backend=backend_of(device, request),
        )  # fmt: skip
    held, key = kept[-1]
    restored = load_checkpoint(tmp_path, key)
    assert restored is not None
    adam = held.adam
    assert isinstance(adam, DeviceAdam)
    assert type(restored.adam) is not DeviceAdam
    assert adam.device.type == ("cuda" if device == "cuda" else "cpu")
    for name, tensor in adam.tensors.items():
        assert np.array_equal(restored.adam.array(name), tensor.cpu().numpy()), name
    moments = adam.device_moments.cpu().numpy()
    assert np.array_equal(restored.adam.all_moments, moments)
    assert all(np.any(restored.adam.moments(name)[0]) for name in TRAINED)
    assert np.array_equal(restored.adam.steps, adam.device_steps.cpu().numpy())
    for name in ("gradient", "gradient_abs", "views"):
        sums = getattr(held.statistics, name)
        assert np.any(sums)
        assert np.array_equal(getattr(restored.statistics, name), sums)
    assert restored.to_json() == held.to_json()
    others = held.to_arrays()
    assert restored.to_arrays().keys() == others.keys()
    assert all(np.array_equal(a, others[n]) for n, a in restored.to_arrays().items())
