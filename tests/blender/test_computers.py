# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel "Computers": the choice, the doctor of a Dask cluster, parts of the shown job."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.jobs.parts import states
from gaussian_wrapping_addon.core.names import SHARED_VARIABLE
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from gaussian_wrapping_addon.ops import addon, background, computers
from gaussian_wrapping_addon.ops.panel_settings import job_settings
from gaussian_wrapping_addon.ui import computers_panel
from tests.blender.fake_layout import FakeLayout, draw
from tests.blender.job_play import play_background
from tests.blender.panel_states import buttons, choose_photos, words
from tests.core.jobs.parts.job_parts import graph, job_folder, write_state

pytestmark = pytest.mark.usefixtures("addon")

PANEL = computers_panel.GWRAP_PT_computers


@pytest.fixture(autouse=True)
def _nothing_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(addon, "_session", [])
    monkeypatch.delenv(SHARED_VARIABLE, raising=False)


def answered() -> FakeLayout:
    """Wait for the request that runs; return the panel."""
    play_background(lambda: not computers.is_busy())
    return draw(PANEL)


def show(folder: Path) -> None:
    """Let the scene show a job folder that was used on this computer."""
    addon.remember(folder)
    properties = bpy.context.scene.gwrap
    properties.job_folder = str(folder)


def shown(folder: Path) -> FakeLayout:
    """Show the parts of a folder as they are now."""
    show(folder)
    computers.stop()
    draw(PANEL)
    play_background(lambda: computers._watched[str(folder)].read_s > 0.0)
    return draw(PANEL)


def test_the_choice_decides_what_is_asked_for() -> None:
    for kind, header, fields, offered in (
        ("THIS", "Local", ["kind", "processes"], []),
        ("DASK", "Dask", ["kind", "dask_address", "certificates"], ["test_computers"]),
    ):
        bpy.context.scene.gwrap.computers.kind = kind
        layout = draw(PANEL)
        assert [field.name for field in layout.fields] == fields
        assert buttons(layout) == offered
        assert layout.header == header


@pytest.mark.parametrize(
    ("kind", "address", "processes", "wanted"),
    [
        ("THIS", "tcp://x:1", 1, ("", 2, "")),  # the defaults, which say nothing then
        ("THIS", "tcp://x:1", 3, ("local", 3, "")),
        ("DASK", " tls://computer:8786 ", 3, ("tls://computer:8786", 2, "{stored}")),
    ],
)
def test_the_choice_becomes_settings_of_the_job(
    kind: str, address: str, processes: int, wanted: tuple[str, int, str], tmp_path: Path
) -> None:
    properties = bpy.context.scene.gwrap
    properties.computers.certificates = str(tmp_path)
    properties.computers.kind, properties.computers.dask_address = kind, address
    properties.processes = processes
    settings = job_settings(bpy.context.scene, threads=0).validated()
    assert (settings.computers, settings.processes) == wanted[:2]
    assert settings.certificates == wanted[2].format(stored=tmp_path)


def choose_dask(address: str) -> None:
    choices = bpy.context.scene.gwrap.computers
    choices.kind, choices.dask_address = "DASK", address


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("local", "no address of a Dask scheduler"),
        ("tcp://x:99999", "no address of a Dask scheduler"),
        ("tcp://10.0.0.7:8786", "is not encrypted"),
        ("tls://10.0.0.1:1", r"may not go online\. Turn on Allow Online Access"),
        ("tcp://localhost:8786", "No folder is known that all computers share"),
    ],
)
def test_what_cannot_be_tested_is_refused(
    address: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not bpy.app.online_access, "the bpy module is offline"
    assert not bpy.ops.gwrap.test_computers.poll(), "without an address"
    asked = play_doctor(monkeypatch, "pass")
    choose_dask(address)
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.gwrap.test_computers()
    assert asked == []


@pytest.mark.parametrize(
    ("address", "certificates", "words"),
    [
        ("tcp://10.0.0.7:8786", "", "is not encrypted"),
        ("tls://localhost:8786", r"\\server\share", "is on another computer"),
    ],
)
def test_jobs_refuse_them_too(address: str, certificates: str, words: str) -> None:
    choose_dask(address)
    bpy.context.scene.gwrap.computers.certificates = certificates
    with pytest.raises(UsageError, match=words):
        job_settings(bpy.context.scene, threads=0)


GOOD_WORKER = {
    "name": "blade (10.0.0.7:1)", "good": True, "problems": [], "cores": 16, "memory_gib": 63.9,
    "gpu": "",
}  # fmt: skip
BAD_WORKER = {
    "name": "tower (10.0.0.8:1)", "good": False, "cores": 0, "memory_gib": 0.0, "gpu": "",
    "problems": ["tower does not see /mnt/farm. Mount the shared folder there."],
}  # fmt: skip


def play_doctor(monkeypatch: pytest.MonkeyPatch, code: str) -> list[dict[str, object]]:
    """Put a program in the place of the doctor; return what it is asked for."""
    asked: list[dict[str, object]] = []

    def command(module: str, request: str, *, python: str) -> list[str]:
        assert module == "jobs.commands.farm_doctor"
        asked.append(json.loads(request))
        return [sys.executable, "-c", code]

    monkeypatch.setattr(computers, "child_command", command)
    return asked


def test_each_dask_worker_has_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, worker: Callable[..., None]
) -> None:
    told = [{"line": "x", "worker": GOOD_WORKER}, {"line": "y", "worker": BAD_WORKER}]
    said = "\n".join(map(json.dumps, [*told, {"error": "1 of 2 workers", "hint": "Mend"}]))
    asked = play_doctor(monkeypatch, f"print({said!r}); raise SystemExit(3)")
    choose_photos(tmp_path)
    choose_dask("tcp://localhost:8786")
    bpy.context.scene.gwrap.computers.certificates = str(tmp_path / "keys")
    assert bpy.ops.gwrap.test_computers() == {"FINISHED"}
    assert "Asking…" in draw(PANEL).texts
    layout = answered()
    assert words(layout).endswith(
        "1 of 2 workers can be used. tower (10.0.0.8:1): tower does not see /mnt/farm. Mount the "
        "shared folder there. blade (10.0.0.7:1): 16 cores, 63.9 GiB, no GPU"
    )
    assert asked == [
        {"address": "tcp://localhost:8786", "certificates": str(tmp_path / "keys"),
         "folder": str(tmp_path), "limit_s": 120.0}
    ]  # fmt: skip
    choose_dask("tcp://localhost:8787")
    assert "workers can be used" not in words(draw(PANEL)), "it was about another address"


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ('print(\'{"error": "No scheduler.", "hint": "Start one."}\')', "No scheduler. Start one."),
        ("raise SystemExit('odd')", "The test ended without a result: odd. See Check Worker."),
        ("pass", "The test ended without a result: no output."),
    ],
)
def test_a_doctor_that_finds_no_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, said: str,
    worker: Callable[..., None],
) -> None:  # fmt: skip
    play_doctor(monkeypatch, code)
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path))
    choose_dask("tcp://localhost:8786")
    bpy.ops.gwrap.test_computers()
    assert said in words(answered())


def test_the_process_of_a_test_ends_with_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, worker: Callable[..., None]
) -> None:
    pid = tmp_path / "pid"
    nap = f"import os,time; open({str(pid)!r}, 'w').write(str(os.getpid())); time.sleep(300)"
    play_doctor(monkeypatch, nap)
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path))
    choose_dask("tcp://localhost:8786")
    bpy.ops.gwrap.test_computers()
    play_background(lambda: pid.exists() and bool(pid.read_text()))
    background.before_load()
    play_background(lambda: not process_alive(int(pid.read_text()), 0))
    assert not computers.is_busy()


def test_a_real_doctor_where_nothing_listens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    monkeypatch.setenv(PYTHON_VARIABLE, sys.executable)
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path))
    choose_dask("tcp://127.0.0.1:9")
    bpy.ops.gwrap.test_computers()
    play_background(lambda: not computers.is_busy(), 120.0)
    assert "Nothing accepts connections at tcp://127.0.0.1:9" in words(draw(PANEL))
    assert list(tmp_path.iterdir()) == []


def test_parts_and_failures_are_shown(tmp_path: Path) -> None:
    folder = job_folder(tmp_path / "job", graph({"engine": 2})).root
    write_state(folder, "cameras", "DONE")
    write_state(folder, "train", "RUNNING", heartbeat_s=time.time())
    write_state(
        folder, "points-engine-0001", "FAILED", place="blade-7", error="Too little memory.",
        hint="Close other programs.",
    )  # fmt: skip
    layout = shown(folder)
    said = words(layout)
    assert "Cameras 1 of 1 Train 0 of 1 1 running Plan 0 of 1 Points 0 of 2 1 failed" in said
    assert "points-engine-0001 · blade-7 Too little memory. Close other programs." in said
    assert layout.header == "1 of 11"
    assert buttons(layout) == ["resume_job", "-cancel_job"]
    folder = job_folder(tmp_path / "damaged", {"version": 5}).root
    assert "parts.json, version: it is not 1." in words(shown(folder))


def test_a_folder_from_elsewhere_is_not_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = job_folder(tmp_path / "job", graph({"a": 0})).root
    touched: list[str] = []
    monkeypatch.setattr(computers, "_read", lambda reader: touched.append(str(reader.root)))
    for name in (str(folder), r"\\server\share\job"):
        bpy.context.scene.gwrap.job_folder = name
        draw(PANEL)
        for _ in range(5):
            background.poll()
            time.sleep(0.01)
    assert touched == []


def test_the_timer_reads_nothing_itself_and_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = job_folder(tmp_path / "job", graph({"a": 0})).root
    shown(folder)
    monkeypatch.setattr(computers, "EVERY_S", 0.3)
    main = threading.main_thread()
    read: list[bool] = []
    inner = states.read_parts
    monkeypatch.setattr(
        states,
        "read_parts",
        lambda root: read.append(threading.current_thread() is main) or inner(root),
    )

    def refuse(_thread: threading.Thread) -> None:
        raise AssertionError("a thread is started")

    os.utime(folder / "parts.json", (1.0, 1.0))
    draw(PANEL)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        begun_s = time.monotonic()
        while background.poll() is not None:  # nobody draws: it goes out by itself
            assert time.monotonic() - begun_s < 10.0
            time.sleep(0.01)
    assert read == [False]
