# SPDX-License-Identifier: GPL-3.0-or-later
"""``--device``: refused at once and without a trace where there is no such GPU, else noted."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core import devices
from gaussian_wrapping_addon.core.devices import DeviceChoice
from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, EXIT_USAGE, DeviceError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs import runner
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.commands import device_check, doctor
from gaussian_wrapping_addon.core.jobs.parts import runner as part_runner
from gaussian_wrapping_addon.core.jobs.stages.meshing import mesh_key
from gaussian_wrapping_addon.core.jobs.store.job_file import (
    BakeRequest,
    make_bake_job,
    make_job,
    read_job,
    training_keys,
)
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.worker import _log_to
from gaussian_wrapping_addon.core.settings import JobSettings, declared
from tests.core.jobs.finished_sphere import write_cube, write_finished_sphere

BATCH = Path(batch.__file__)


def state_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Photos that are none, and the finished job of a sphere; the driver is missing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").write_text("no photo: whoever reads it says so")
    folder = write_finished_sphere(tmp_path / "job")
    write_json(next(folder.stages.glob("train-*")) / "checkpoint-000000010.json", {})
    without_driver(monkeypatch)
    return tmp_path


def without_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> int:
        raise DeviceError("The NVIDIA driver library x was not found.", "Update it.")

    monkeypatch.setattr(devices.choice, "device_count", missing)


COMMANDS = [
    "wrap photos --out new --no-blend",
    "estimate photos",
    "mesh --out job/out --no-blend",
    "more --out job/out --iterations 5 --no-blend",
    "resume job/out --no-blend",
    "resume job/out --max-gaussians 5000 --no-blend",
    "run-part job/out train",
]


@pytest.mark.parametrize("words", COMMANDS)
def test_a_gpu_without_a_driver_is_refused_and_leaves_nothing(
    place: Path, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    before = state_of(place)
    assert batch.main([*words.split(), "--device", "cuda:1"]) == EXIT_BAD_DATA == 3
    told = capfd.readouterr()
    assert "The device cuda:1 cannot be used: The NVIDIA driver library" in told.out + told.err
    assert state_of(place) == before
    assert not (place / "new").exists()


WRONG = ("gpu", "cuda:", "cuda:x", "cuda:-1", "CPU", "cuda:1234", "cuda:1 ", "")


@pytest.mark.parametrize(
    ("words", "device"),
    [*((words, "cuda:x") for words in COMMANDS), *((COMMANDS[0], device) for device in WRONG)],
)
def test_other_words_are_refused(
    place: Path, words: str, device: str, capfd: pytest.CaptureFixture[str]
) -> None:
    before = state_of(place)
    assert batch.main([*words.split(), f"--device={device}"]) == EXIT_USAGE
    told = capfd.readouterr()
    assert "--device is out of range. Give auto, cpu, cuda or cuda:N" in told.out + told.err
    assert state_of(place) == before


def test_the_refusal_takes_less_than_five_seconds(tmp_path: Path) -> None:
    """In a process of its own, on whatever machine this is: no machine has a thousand GPUs."""
    (tmp_path / "photos").mkdir()
    words = ["wrap", "photos", "--out", "new", "--no-blend", "--device", "cuda:999"]
    begun_s = time.monotonic()
    done = subprocess.run(
        [sys.executable, str(BATCH), *words], cwd=tmp_path, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert time.monotonic() - begun_s < 5.0
    assert done.returncode == EXIT_BAD_DATA
    assert "The device cuda:999 cannot be used: " in done.stdout + done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


@pytest.mark.parametrize("words", COMMANDS)
def test_with_a_driver_the_workers_python_decides(
    place: Path, words: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    monkeypatch.setattr(devices.choice, "device_count", lambda: 1000)
    before = state_of(place)
    assert batch.main([*words.split(), "--device", "cuda:999"]) == EXIT_BAD_DATA
    told = capfd.readouterr()
    assert "The device cuda:999 cannot be used: " in told.out + told.err  # no CUDA, or no such GPU
    assert state_of(place) == before


def test_a_worker_that_says_nothing_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices.choice, "device_count", lambda: 1)
    answers = [(1, "", "Traceback\nthe last line"), (0, '{"device": "cuda:0"}\n', "")]
    monkeypatch.setattr(doctor, "run_to_end", lambda *_: answers.pop(0))
    with pytest.raises(device_check.WorkerError, match="without a result: the last line"):
        device_check.require_device("cuda")
    device_check.require_device("cuda")
    assert answers == []
    device_check.require_device("auto")  # asks nobody


def test_blender_starts_and_resumes_no_job_without_its_gpu(place: Path) -> None:
    job = replace(read_job(place / "job/out/job.json"), settings=JobSettings(device="cuda"))
    before = state_of(place)
    with pytest.raises(DeviceError, match="The device cuda cannot be used"):
        JobClient.start(place / "new", job)
    with pytest.raises(DeviceError, match="The device cuda cannot be used"):
        JobClient.resume(place / "job/out", device="cuda")
    assert state_of(place) == before
    assert not (place / "new").exists()


class _Started(Exception):  # noqa: N818 - no error: stands for a worker that starts
    pass


@pytest.fixture
def starts(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Let workers end where they would start; GPUs are there."""

    def launch(*_: object) -> None:
        raise _Started

    monkeypatch.setattr(JobClient, "_launch", launch)
    monkeypatch.setattr(device_check, "require_device", lambda setting: None)
    return lambda: monkeypatch.setattr(devices.choice, "device_count", lambda: 8)


@pytest.mark.parametrize(
    ("words", "device"),
    [
        ("wrap job/photos --out new --no-blend", "auto"),
        ("wrap job/photos --out new --no-blend --device cpu", "cpu"),
        ("wrap job/photos --out new --no-blend --device cuda:3", "cuda:3"),
        ("mesh --out job/out --no-blend", "auto"),
        ("mesh --out job/out --no-blend --device cuda", "cuda"),
        ("more --out job/out --iterations 5 --no-blend", "cuda:2"),
        ("more --out job/out --iterations 5 --no-blend --device auto", "auto"),
        ("resume job/out --no-blend", "cuda:2"),
        ("resume job/out --no-blend --device cpu", "cpu"),
        ("resume job/out --no-blend --device cpu --max-gaussians 9000", "cpu"),
    ],
)
def test_the_device_is_noted_in_the_job(
    place: Path, words: str, device: str, starts: Callable[[], None]
) -> None:
    starts()
    folder = JobFolder(place / "job/out")
    job = read_job(folder.job_path)
    with pytest.raises(_Started):
        JobClient.start(folder.root, replace(job, settings=replace(job.settings, device="cuda:2")))
    with pytest.raises(_Started):
        batch.main(words.split())
    written = place / ("new" if "new" in words else "job/out") / "job.json"
    assert read_job(written).settings.device == device


def test_no_stage_depends_on_the_device(tmp_path: Path) -> None:
    folder = write_finished_sphere(tmp_path)
    job = read_job(folder.job_path)
    others = [replace(job, settings=replace(job.settings, device=d)) for d in ("cpu", "cuda:1")]
    assert {training_keys("c", j) for j in (job, *others)} == {training_keys("c", job)}
    assert {mesh_key(j, "auto", "auto", "t") for j in (job, *others)} == {
        mesh_key(job, "auto", "auto", "t")
    }
    entry = declared("device")
    assert (entry.default, entry.affects_result, entry.since) == ("auto", False, "0.2.0")


def finished_mesh(folder: JobFolder, device: str) -> None:
    """Run a small mesh job of the sphere in this process."""
    earlier = read_job(folder.job_path)
    meshing = replace(
        earlier.settings.meshing, method="pivots", pivots=2, pivot_samples="none",
        min_component_share=0.0,
    )  # fmt: skip
    cube = write_cube(folder.root / "ball.json")
    settings = replace(earlier.settings, meshing=meshing, regions=(str(cube),), device=device)
    handler = _log_to(folder.log_path)
    try:
        job = make_job("mesh", Path(earlier.source), settings)
        runner.run_job(folder, job, lambda event: None, lambda: False)
    finally:
        handler.close()
        logging.getLogger().removeHandler(handler)


def test_auto_goes_on_on_the_processor_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_finished_sphere(tmp_path)
    chosen = {"auto": DeviceChoice("cpu", "", "There is no GPU here.")}
    monkeypatch.setattr(runner, "choose_device", chosen.__getitem__)
    finished_mesh(folder, "auto")
    report = read_json(folder.result / "report.json")
    assert (report["device"], report["device_reason"]) == ("cpu", "There is no GPU here.")
    assert report["settings"]["device"] == "auto"
    told = [line for line in folder.log_path.read_text().splitlines() if "no GPU here" in line]
    assert len(told) == 1
    assert told[0].endswith("device: processor: There is no GPU here.")
    text = (folder.result / "report.md").read_text()
    assert "- Device: cpu. There is no GPU here." in text


def test_a_job_that_names_a_missing_gpu_ends_before_its_photos_are_read(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(place / "job/out")

    def missing(setting: str) -> DeviceChoice:
        raise DeviceError(f"The device {setting} cannot be used: none.")

    monkeypatch.setattr(runner, "choose_device", missing)
    monkeypatch.setattr(part_runner, "run_cameras", lambda *_, **__: pytest.fail("read the photos"))
    job = read_job(folder.job_path)
    with pytest.raises(DeviceError, match="The device auto cannot be used"):
        runner.run_job(folder, job, lambda event: None, lambda: False)


@pytest.mark.usefixtures("starts")
def test_a_bake_needs_no_gpu(place: Path) -> None:
    mesh = place / "mesh.off"
    mesh.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    earlier = read_job(place / "job/out/job.json")
    on_gpu = replace(earlier, settings=replace(earlier.settings, device="cuda"))
    with pytest.raises(_Started):
        JobClient.start(place / "job/out", make_bake_job(on_gpu, BakeRequest(str(mesh), "m")))
