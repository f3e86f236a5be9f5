# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel "Computers" against a stub of a Flamenco Manager: test, submit, watch, stop, retry."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.farm import part_states
from gaussian_wrapping_addon.core.farm.flamenco.job_record import read_record
from gaussian_wrapping_addon.core.farm.flamenco.submission import SHARED_VARIABLE
from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.processes.process_identity import process_alive
from gaussian_wrapping_addon.ops.common import background, known_jobs
from gaussian_wrapping_addon.ops.computers import dask_doctor, farm_actions, farm_calls, part_watch
from gaussian_wrapping_addon.ops.jobs.panel_settings import job_settings
from gaussian_wrapping_addon.ui.computers import computers_panel
from tests.blender.fake_layout import FakeLayout, draw
from tests.blender.panel_states import buttons, choose_photos, words
from tests.core.farm.flamenco.stub_manager import JOB, TAG, StubManager, serving
from tests.core.farm.job_parts import graph, job_folder, write_state

pytestmark = pytest.mark.usefixtures("addon")

PANEL = computers_panel.GWRAP_PT_computers


@pytest.fixture(autouse=True)
def _nothing_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_jobs, "_session", [])
    monkeypatch.delenv(SHARED_VARIABLE, raising=False)


@pytest.fixture
def stub(tmp_path: Path) -> StubManager:
    found = StubManager()
    found.variables["gw_shared"]["value"] = str(tmp_path)
    return found


@pytest.fixture
def url(stub: StubManager) -> Iterator[str]:
    with serving(stub) as address:
        choices = bpy.context.scene.gwrap.computers
        choices.kind, choices.flamenco_address = "FLAMENCO", str(address)
        yield str(address)


def wait_for(holds: Callable[[], bool], seconds: float = 20.0) -> None:
    """Play the timer, which never fires in background Blender, until something holds."""
    end_s = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end_s
        background.poll()
        time.sleep(0.01)


def answered() -> FakeLayout:
    """Wait for the request that runs; return the panel."""
    wait_for(lambda: not farm_calls.is_busy())
    return draw(PANEL)


def show(folder: Path) -> None:
    """Let the scene show a job folder that was used on this computer."""
    known_jobs.remember(folder)
    properties = bpy.context.scene.gwrap
    properties.job_folder = properties.computers.folder = str(folder)


def shown(folder: Path) -> FakeLayout:
    """Show the parts of a folder as they are now."""
    show(folder)
    draw(PANEL)
    part_watch.refresh(str(folder))
    wait_for(lambda: part_watch._watched[str(folder)].read_s > 0.0)
    return draw(PANEL)


@pytest.mark.parametrize(
    ("kind", "fields", "offered"),
    [
        ("THIS", ["kind", "processes"], []),
        ("DASK", ["kind", "dask_address", "certificates"], ["test_computers"]),
        (
            "FLAMENCO",
            ["kind", "flamenco_address", "shared", "tiles", "priority", "tag"],
            ["test_computers", "-submit_farm", "save_job_type"],
        ),
    ],
)
def test_the_choice_decides_what_is_asked_for(
    kind: str, fields: list[str], offered: list[str]
) -> None:
    bpy.context.scene.gwrap.computers.kind = kind
    layout = draw(PANEL)
    assert [field.name for field in layout.fields] == fields
    assert buttons(layout) == offered
    assert layout.header == {"THIS": "Local", "DASK": "Dask", "FLAMENCO": "Flamenco"}[kind]


@pytest.mark.parametrize(
    ("kind", "address", "processes", "wanted"),
    [
        ("THIS", "tcp://x:1", 1, ("", 2)),  # the default, which says nothing then
        ("THIS", "tcp://x:1", 3, ("local", 3)),
        ("DASK", " tls://computer:8786 ", 3, ("tls://computer:8786", 2)),
        ("DASK", "tcp://localhost:8786", 3, ("tcp://localhost:8786", 2)),
        ("DASK", "tls://[::1]:8786", 1, ("tls://[::1]:8786", 2)),
        ("FLAMENCO", "tcp://x:1", 3, ("", 2)),
    ],
)
def test_the_choice_becomes_settings_of_the_job(
    kind: str, address: str, processes: int, wanted: tuple[str, int]
) -> None:
    properties = bpy.context.scene.gwrap
    properties.computers.kind, properties.computers.dask_address = kind, address
    properties.processes = processes
    settings = job_settings(bpy.context.scene, threads=0).validated()
    assert (settings.computers, settings.processes) == wanted


@pytest.mark.parametrize("address", ["", "local", "http://x:1", "tcp://x", "tcp://x:99999"])
def test_a_bad_address_of_a_scheduler_is_refused(address: str) -> None:
    choices = bpy.context.scene.gwrap.computers
    choices.kind, choices.dask_address = "DASK", address
    with pytest.raises(RuntimeError, match="no address of a Dask scheduler"):
        bpy.ops.gwrap.test_computers()


def test_what_others_can_read_is_refused_by_test_and_job_alike() -> None:
    choices = bpy.context.scene.gwrap.computers
    choices.kind, choices.dask_address = "DASK", "tcp://10.0.0.7:8786"
    with pytest.raises(RuntimeError, match="is not encrypted"):
        bpy.ops.gwrap.test_computers()
    with pytest.raises(UsageError, match="is not encrypted"):
        job_settings(bpy.context.scene, threads=0)


def test_certificates_of_a_server_are_not_looked_for() -> None:
    choices = bpy.context.scene.gwrap.computers
    choices.kind, choices.dask_address = "DASK", "tls://localhost:8786"
    choices.certificates = r"\\server\share"
    with pytest.raises(UsageError, match="is on another computer"):
        job_settings(bpy.context.scene, threads=0)


def test_a_good_manager(stub: StubManager, url: str, tmp_path: Path) -> None:
    assert bpy.ops.gwrap.test_computers() == {"FINISHED"}
    assert "Asking…" in draw(PANEL).texts
    assert not bpy.ops.gwrap.test_computers.poll(), "one request at a time"
    said = words(answered())
    assert "Flamenco 3.8.2 has the job type." in said
    assert f"Shared folder on this computer: {tmp_path}".replace(" ", "") in said.replace(" ", "")
    bpy.context.scene.gwrap.computers.flamenco_address = "http://localhost:1"
    assert "has the job type" not in words(draw(PANEL)), "it was about another address"


def test_missing_variables_are_told(stub: StubManager, url: str) -> None:
    del stub.variables["gw_python"]
    bpy.ops.gwrap.test_computers()
    assert "The Manager has no variable gw_python" in words(answered())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: setattr(s, "job_type", None), "has no job type gaussian-wrapping. Put"),
        (lambda s: s.version.update(shortversion="3.1"), "is Flamenco 3.1; 3.3 or a later 3"),
        (lambda s: setattr(s, "instead", lambda _m, _p: (200, {}, b"<html>")), "with a web page"),
        (lambda s: setattr(s, "instead", lambda _m, _p: (302, {}, b"")), "sends on to another"),
        (lambda s: s.variables.clear(), "Nothing says which folder"),
    ],
)
def test_what_is_wrong_is_told(
    stub: StubManager, url: str, change: Callable[[StubManager], object], said: str
) -> None:
    change(stub)
    bpy.ops.gwrap.test_computers()
    assert said in words(answered())


def test_nobody_answers() -> None:
    choices = bpy.context.scene.gwrap.computers
    choices.kind, choices.flamenco_address = "FLAMENCO", "http://127.0.0.1:9"
    bpy.ops.gwrap.test_computers()
    assert "Nothing answers at http://127.0.0.1:9." in words(answered())


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
        assert module == "jobs.commands.farm.doctor"
        asked.append(json.loads(request))
        return [sys.executable, "-c", code]

    monkeypatch.setattr(dask_doctor, "child_command", command)
    return asked


def choose_dask(address: str) -> None:
    choices = bpy.context.scene.gwrap.computers
    choices.kind, choices.dask_address = "DASK", address


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
    wait_for(lambda: pid.exists() and bool(pid.read_text()))
    background.before_load()
    wait_for(lambda: not process_alive(int(pid.read_text()), 0))
    assert not farm_calls.is_busy()


def test_a_real_doctor_where_nothing_listens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    monkeypatch.setenv(PYTHON_VARIABLE, sys.executable)
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path))
    choose_dask("tcp://127.0.0.1:9")
    bpy.ops.gwrap.test_computers()
    wait_for(lambda: not farm_calls.is_busy(), 120.0)
    assert "Nothing accepts connections at tcp://127.0.0.1:9" in words(draw(PANEL))
    assert list(tmp_path.iterdir()) == []


def test_without_a_folder_nothing_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = play_doctor(monkeypatch, "pass")
    choose_dask("tcp://localhost:8786")
    with pytest.raises(RuntimeError, match="No folder is known that all computers share"):
        bpy.ops.gwrap.test_computers()
    assert asked == []


@pytest.mark.parametrize("kind", ["DASK", "FLAMENCO"])
def test_other_computers_need_online_access(kind: str) -> None:
    assert not bpy.app.online_access, "the bpy module is offline"
    choices = bpy.context.scene.gwrap.computers
    choices.kind = kind
    choices.dask_address, choices.flamenco_address = "tls://10.0.0.1:1", "http://10.0.0.1:1"
    with pytest.raises(RuntimeError, match=r"may not go online\. Turn on Allow Online Access"):
        bpy.ops.gwrap.test_computers()


def submit(tmp_path: Path) -> Path:
    choose_photos(tmp_path)
    assert bpy.ops.gwrap.submit_farm() == {"FINISHED"}
    wait_for(lambda: not farm_calls.is_busy())
    return tmp_path / "photos_wrap"


def test_a_job_is_submitted(
    stub: StubManager, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    choices = bpy.context.scene.gwrap.computers
    choices.tiles, choices.priority, choices.tag = 3, 80, "big"
    folder = submit(tmp_path)
    (body,) = stub.submitted
    assert (body["priority"], body["worker_tag"]) == (80, TAG)
    assert body["settings"]["job_folder"] == "{gw_shared}/photos_wrap"
    record = read_record(folder)
    assert record is not None
    assert (str(record.address), record.job) == (url, JOB)
    settings = read_job(folder / "job.json").settings
    assert (settings.meshing.tiles, settings.threads, settings.device) == ("3", 0, "auto")
    assert (settings.computers, settings.processes) == ("", 1)
    assert not (folder / "lock.json").exists(), "nothing was started here"
    wait_for(lambda: draw(PANEL).header == "0 of 13")
    layout = draw(PANEL)
    assert "Submitted: 13 parts." in words(layout)
    assert "Points 0 of 3 Gather 0 of 1 Faces 0 of 3" in words(layout)
    assert buttons(layout)[-3:] == ["retry_farm", "cancel_farm", "update_farm"]


@pytest.mark.parametrize(("tiles", "wanted"), [(1, "off"), (8, "8")])
def test_one_tile_is_one_piece(
    stub: StubManager, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiles: int,
    wanted: str,
) -> None:  # fmt: skip
    bpy.context.scene.gwrap.computers.tiles = tiles
    folder = submit(tmp_path)
    assert read_job(folder / "job.json").settings.meshing.tiles == wanted
    assert len(stub.submitted) == 1


def test_a_failed_submission_is_told(
    stub: StubManager, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(folder: JobFolder) -> None:
        (folder.root / "parts.json").write_text('{"version": 1}')

    monkeypatch.setattr(farm_actions, "plan_if_missing", damaged)
    folder = submit(tmp_path)
    assert "parts.json, parts: not a list" in words(draw(PANEL))
    assert stub.submitted == []
    assert read_record(folder) is None


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
    assert buttons(layout) == ["resume_job", "-cancel_job"], "it was not submitted"


def test_flamenco_is_asked_for_the_last_lines(
    stub: StubManager, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = submit(tmp_path)
    stub.status = "failed"
    stub.fail("train", "".join(f"iteration {k}\n" for k in range(9)) + "error: No memory.\n")
    shown(folder)
    assert bpy.ops.gwrap.update_farm() == {"FINISHED"}
    said = words(answered())
    assert (
        "State in Flamenco: failed train · blade-3 iteration 7 iteration 8 error: No memory."
        in said
    )


def test_cancel_and_retry(
    stub: StubManager, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = submit(tmp_path)
    shown(folder)
    assert bpy.ops.gwrap.cancel_farm() == {"FINISHED"}
    assert "Cancelled. Retry continues it." in words(answered())
    assert (folder / "cancel").exists()
    assert bpy.ops.gwrap.retry_farm() == {"FINISHED"}
    assert "Queued again." in words(answered())
    assert not (folder / "cancel").exists()
    assert [c["status"] for c in stub.changes] == ["cancel-requested", "requeueing"]


def test_a_finished_job_can_be_imported(
    stub: StubManager, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = graph({"auto": 0})
    folder = submit(tmp_path)
    assert "Import Finished Result" not in shown(folder).texts
    for part in values["parts"]:
        write_state(folder, part["name"], "DONE")
    layout = shown(folder)
    assert layout.header == "6 of 6"
    assert "Import Finished Result" in layout.texts


def test_undo_keeps_the_submitted_job(
    stub: StubManager, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = submit(tmp_path)
    choices = bpy.context.scene.gwrap.computers
    choices.folder = ""  # as an undo leaves it
    farm_actions.after_undo()
    assert choices.folder == str(folder)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    farm_actions.after_undo()
    assert bpy.context.scene.gwrap.computers.folder == "", "another file has another scene"


def test_nothing_is_written_where_no_manager_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    choices = bpy.context.scene.gwrap.computers
    choices.kind, choices.flamenco_address = "FLAMENCO", "http://127.0.0.1:9"
    folder = submit(tmp_path)
    assert "Nothing answers at http://127.0.0.1:9." in words(draw(PANEL))
    assert not folder.exists()
    assert choices.folder == ""


def test_a_shared_folder_of_a_server_is_not_looked_for(stub: StubManager, url: str) -> None:
    bpy.context.scene.gwrap.computers.shared = r"\\server\share"
    with pytest.raises(RuntimeError, match="names a server"):
        bpy.ops.gwrap.test_computers()
    assert stub.asked == []


def test_each_choice_shows_its_own_job(tmp_path: Path) -> None:
    here = job_folder(tmp_path / "here", graph({"a": 0})).root
    there = job_folder(tmp_path / "there", graph({"a": 2})).root
    properties = bpy.context.scene.gwrap
    for kind, wanted in (("THIS", "0 of 6"), ("FLAMENCO", "0 of 11"), ("DASK", "0 of 6")):
        shown(there)
        known_jobs.remember(here)
        properties.job_folder, properties.computers.kind = str(here), kind
        wait_for(lambda wanted=wanted: draw(PANEL).header == wanted)


def test_damage_is_told(tmp_path: Path) -> None:
    folder = job_folder(tmp_path / "job", {"version": 5}).root
    assert "parts.json, version: it is not 1." in words(shown(folder))


def test_a_folder_from_elsewhere_is_not_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = job_folder(tmp_path / "job", graph({"a": 0})).root
    (folder / "flamenco.json").write_text(
        json.dumps({"version": 1, "address": "http://127.0.0.1:9", "job": JOB})
    )
    touched: list[str] = []
    monkeypatch.setattr(part_watch, "_read", lambda reader: touched.append(str(reader.root)))
    for name in (str(folder), r"\\server\share\job"):
        properties = bpy.context.scene.gwrap
        properties.job_folder = properties.computers.folder = name
        draw(PANEL)
        for _ in range(5):
            background.poll()
            time.sleep(0.01)
        assert not bpy.ops.gwrap.cancel_farm.poll()
    assert touched == []


def test_the_timer_reads_nothing_itself_and_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = job_folder(tmp_path / "job", graph({"a": 0})).root
    shown(folder)
    monkeypatch.setattr(part_watch, "EVERY_S", 0.3)
    main = threading.main_thread()
    read: list[bool] = []
    inner = part_states.read_parts
    monkeypatch.setattr(
        part_states,
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


def test_the_job_type_is_saved(tmp_path: Path) -> None:
    assert bpy.ops.gwrap.save_job_type(directory=str(tmp_path)) == {"FINISHED"}
    assert (tmp_path / "gaussian-wrapping.js").is_file()
    with pytest.raises(RuntimeError, match="is no folder"):
        bpy.ops.gwrap.save_job_type(directory=str(tmp_path / "none"))


def test_buttons_without_a_job() -> None:
    for name in ("retry_farm", "cancel_farm", "update_farm", "submit_farm", "test_computers"):
        assert not getattr(bpy.ops.gwrap, name).poll()
