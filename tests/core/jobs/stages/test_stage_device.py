# SPDX-License-Identifier: GPL-3.0-or-later
"""The device that stages compute on: handed to the training, noted, and in no key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.devices import DeviceChoice, checks, choose_device
from gaussian_wrapping_addon.core.evaluation.report import pictures
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians
from gaussian_wrapping_addon.core.jobs.stages import training
from gaussian_wrapping_addon.core.jobs.stages.training import GAUSSIANS_NAME, TrainingStages
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage, read_done
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.training import device_backend, trainer
from gaussian_wrapping_addon.core.training.state import TrainingResult
from tests.core.jobs.finished_sphere import write_finished_sphere

GPU = DeviceChoice("cuda:1", "Some GPU", "It passed.")


def stage_of(folder: JobFolder, name: str) -> Stage:
    (found,) = folder.stages.glob(f"{name}-*")
    return Stage(name, found.name.partition("-")[2], found, read_done(found) or {}, True)


def trained(folder: JobFolder, device: DeviceChoice) -> Stage:
    job, cameras = read_job(folder.job_path), stage_of(folder, "cameras")
    return TrainingStages(folder, job, cameras, 1, device).run(Progress())


def test_the_training_gets_the_device_and_notes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    folder = write_finished_sphere(tmp_path)
    path = stage_of(folder, "train").folder / GAUSSIANS_NAME
    gaussians = load_gaussians(path)
    path.unlink()
    given: list[Any] = []

    def train(*_: object, backend: object, **__: object) -> TrainingResult:
        given.append(backend)
        return TrainingResult(gaussians, 7, (), (), 1.0, (), device="cuda:1")

    def with_renderer(device: str, what: str, work: Callable[[Any], Any]) -> Any:
        given.append((device, what))
        return work("its renderer")

    def write_held_out(*_: object, renderer: object, **__: object) -> list[dict[str, Any]]:
        given.append(renderer)
        return []

    monkeypatch.setattr(trainer, "train", train)
    monkeypatch.setattr(
        device_backend, "chosen_backend", lambda device, threads, **_: f"backend of {device}"
    )
    monkeypatch.setattr(checks, "with_renderer", with_renderer)
    monkeypatch.setattr(pictures, "write_held_out", write_held_out)
    monkeypatch.setattr(training, "stage_device", lambda chosen, *_: chosen)
    monkeypatch.setattr(TrainingStages, "_estimated", lambda *_: ({}, []))
    done = trained(folder, GPU)
    expected = [
        "backend of cuda:1", ("cuda:1", "Pictures of held-out photos"), "its renderer",
    ]  # fmt: skip
    assert given == expected
    assert (done.done["device"], done.done["device_reason"]) == ("cuda:1", "It passed.")
    assert "training on cuda:1" in caplog.messages
    again = trained(folder, choose_device("cpu"))
    assert (again.reused, again.folder, again.done["device"]) == (True, done.folder, "cuda:1")
    assert given == expected
