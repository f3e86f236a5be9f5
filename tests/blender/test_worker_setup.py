# SPDX-License-Identifier: GPL-3.0-or-later
"""The preferences' set-up in Blender: what is drawn and greyed in each state, and one real run."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from gaussian_wrapping_addon.core.jobs import client as job_client
from gaussian_wrapping_addon.core.jobs.install import FoundPython, SetupRequest, SetupTask, probe
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobStatus
from gaussian_wrapping_addon.core.worker import environment as worker_environment
from gaussian_wrapping_addon.core.worker.environment import (
    EXTRAS,
    WorkerEnvironment,
    requirements_file,
)
from gaussian_wrapping_addon.ops import background, worker_setup
from gaussian_wrapping_addon.ui import dataset_panel, worker_setup_view
from tests.blender.fake_layout import FakeLayout, draw
from tests.blender.job_play import play_background
from tests.core.setup.wheels import write_wheel

pytestmark = pytest.mark.usefixtures("addon")

PYTHON = FoundPython("/usr/bin/python3.12", (3, 12, 1))


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder for the environment, and one Python that was found."""
    folder = tmp_path / "worker"
    # What a set-up has made is remembered here; no later test may take it for its worker.
    monkeypatch.setenv(worker_environment.DATA_VARIABLE, str(tmp_path / "data"))
    monkeypatch.setattr(worker_setup, "environment", lambda: WorkerEnvironment(folder))
    fresh = worker_setup.State(pythons=[PYTHON], has_searched=True)
    for name, value in vars(fresh).items():
        monkeypatch.setattr(worker_setup.state, name, value)
    yield folder
    worker_setup.stop_setup()
    worker_setup.stop()


def drawn() -> FakeLayout:
    layout = FakeLayout()
    worker_setup_view.draw_setup(layout, bpy.context)
    return layout


def no_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(job_client.PYTHON_VARIABLE, raising=False)
    monkeypatch.setattr(job_client, "_has_torch", lambda: False)
    worker_setup.forget_problem()


def test_without_a_worker_the_panel_leads_to_the_button(monkeypatch: pytest.MonkeyPatch) -> None:
    assert worker_setup.worker_ready(), "the Python of the tests has torch"
    assert "gwrap.open_preferences" not in draw(dataset_panel.GWRAP_PT_dataset).operators
    no_worker(monkeypatch)
    assert not worker_setup.worker_ready()
    first = draw(dataset_panel.GWRAP_PT_dataset)
    assert first.operators[0] == "gwrap.open_preferences"
    assert "No worker is set up yet." in first.texts
    assert "Jobs need one" in drawn().texts


def test_the_answer_is_kept_for_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(worker_setup, "worker_python", lambda p: asked.append(p) or "x")
    worker_setup.forget_problem()
    for _ in range(50):
        assert worker_setup.worker_ready()
    assert len(asked) == 1
    worker_setup.forget_problem()
    worker_setup.worker_ready()
    assert len(asked) == 2


@pytest.mark.parametrize("name", ["RUNNING", "DONE", "FAILED", "CANCELLED"])
def test_every_state_draws(name: str, root: Path) -> None:
    task = SetupTask(SetupRequest(str(root), PYTHON.path, ""))
    task.status = JobStatus(
        name, "install", 0.4, "torch: Collecting torch", error="It broke.", hint="Do that."
    )
    worker_setup.state.task = task
    layout = drawn()
    running = name == "RUNNING"
    assert ("gwrap.cancel_setup" in layout.operators) is running
    assert ("Install · 40 %" in layout.texts) is running
    assert ("It broke. Do that." in layout.texts) is (name in ("FAILED", "CANCELLED"))
    assert ("The worker is ready" in layout.texts) is (name == "DONE")


def test_going_online_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    poll = bpy.ops.gwrap.set_up_worker.poll
    assert not bpy.app.online_access, "the bpy module is offline"
    assert not poll()
    assert "Allow Online Access" in drawn().texts.replace("\n", " ")
    monkeypatch.setattr(worker_setup, "wheel_folder", lambda _context: "/wheels")
    assert poll()
    worker_setup.state.pythons = []
    assert not poll()


def test_only_what_we_made_can_be_removed(root: Path) -> None:
    assert not bpy.ops.gwrap.remove_worker.poll()
    root.mkdir()
    WorkerEnvironment(root).marker_path.write_text('{"made_by": "gaussian_wrapping_addon"}')
    assert bpy.ops.gwrap.remove_worker.poll()
    assert bpy.ops.gwrap.remove_worker() == {"FINISHED"}
    play_background(lambda: not worker_setup.state.is_busy)
    assert not root.exists()
    assert "The worker is removed" in drawn().texts


@pytest.mark.parametrize("cuda", [False, True])
def test_the_dialog_shows_the_commands(
    cuda: bool, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_setup, "wheel_folder", lambda _context: "/wheels")
    worker_setup.state.has_cuda = cuda
    layout = FakeLayout()
    layout_prop = SimpleNamespace(properties={"python", "torch", "extras"})
    fake = SimpleNamespace(
        layout=layout, python=PYTHON.path, torch="cpu", extras={"raw"}, bl_rna=layout_prop
    )
    worker_setup.GWRAP_OT_set_up_worker.draw(fake, bpy.context)
    text = " ".join(layout.texts.split())
    made = f"{PYTHON.path} -I -m venv --clear {root / 'env'}"
    assert made.replace(" ", "") in text.replace(" ", ""), "a long path is broken at its hyphens"
    assert "--no-index --find-links /wheels" in text
    assert f"-r {requirements_file()}" in text
    assert "rawpy==" in text
    assert "pillow-heif" not in text
    assert "gwrap.copy_setup_commands" in layout.operators
    choices = [item[0] for item in worker_setup._torch_items(None, None)]
    assert choices == (["cpu", "cuda", "index"] if cuda else ["cpu", "index"])
    assert "on the GPU" not in text
    fake.layout, fake.torch = FakeLayout(), "cuda"
    worker_setup.GWRAP_OT_set_up_worker.draw(fake, bpy.context)
    assert "Training and vacancy on the GPU, for several GiB more" in fake.layout.texts


def test_extras_have_a_button_each_until_they_are_there(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "gwrap.add_extra" not in drawn().operators, "there is nothing to add to"
    assert not bpy.ops.gwrap.add_extra.poll()
    environment = WorkerEnvironment(root)
    python = worker_environment.venv_python(root / "env")
    python.parent.mkdir(parents=True)
    python.touch()
    environment.ready_path.write_text("{}")
    marker = {"made_by": "gaussian_wrapping_addon", "python": PYTHON.path, "kind": "venv"}
    environment.marker_path.write_text(json.dumps({**marker, "extras": ["heif"]}))
    layout = drawn()
    assert "HEIC Photos: installed" in layout.texts
    assert layout.operators.count("gwrap.add_extra") == len(EXTRAS) - 1
    assert "Add Camera RAW…" in layout.texts
    assert not bpy.ops.gwrap.add_extra.poll(), "Blender may not go online"
    monkeypatch.setattr(worker_setup, "wheel_folder", lambda _context: "/wheels")
    assert bpy.ops.gwrap.add_extra.poll()
    shown = FakeLayout()
    fake = SimpleNamespace(layout=shown, extra="raw")
    worker_setup.GWRAP_OT_add_extra.draw(fake, bpy.context)
    text = "".join(shown.texts.split())
    assert f"{python}-I-mpip--isolatedinstall" in text
    assert "--find-links/wheels--no-depsrawpy==" in text


def small_request(root: Path, folder: Path) -> SetupRequest:
    """Ask for an environment with one package, from a folder of wheels."""
    write_wheel(folder / "wheels", "gwalpha", "1.0")
    requirements = folder / "r.txt"
    requirements.write_text("gwalpha==1.0\n")
    python = probe(sys.executable).path
    return SetupRequest(str(root), python, str(requirements), "cpu", str(folder / "wheels"))


def test_a_set_up_from_start_to_end_in_blender(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Driven by the timer, as in a window; the doctor looks at the result by itself."""
    request = small_request(root, tmp_path)
    asked = []
    monkeypatch.setattr(worker_setup, "start", asked.append)
    no_worker(monkeypatch)
    longest_s = 0.0
    worker_setup.start_setup(request)
    assert bpy.app.timers.is_registered(background.poll)
    while worker_setup.state.is_busy:
        begun_s = time.monotonic()
        background.poll()
        longest_s = max(longest_s, time.monotonic() - begun_s)
        time.sleep(0.05)
    task = worker_setup.state.task
    assert task is not None
    assert task.status.state == "DONE", task.status
    assert asked == [""]
    assert worker_setup.worker_ready(), "found at once"
    assert job_client.worker_python() == WorkerEnvironment(root).worker()
    assert longest_s < 1.0, "a tick never waits for the set-up"


def test_a_set_up_is_cancelled(root: Path, tmp_path: Path) -> None:
    worker_setup.start_setup(small_request(root, tmp_path))
    assert bpy.ops.gwrap.cancel_setup() == {"FINISHED"}
    assert not bpy.ops.gwrap.cancel_setup.poll(), "once is enough"
    assert "Cancelling…" in drawn().texts
    play_background(lambda: not worker_setup.state.is_busy)
    assert worker_setup.state.task is not None
    assert worker_setup.state.task.status.state == "CANCELLED"
    assert not root.exists()


def test_pythons_are_searched_in_the_background(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_setup, "find_pythons", lambda _own: [PYTHON, PYTHON])
    worker_setup.state.pythons, worker_setup.state.has_searched = None, False
    worker_setup.search_pythons()
    worker_setup.search_pythons()
    play_background(lambda: worker_setup.state.pythons is not None)
    assert worker_setup.state.pythons == [PYTHON, PYTHON]
