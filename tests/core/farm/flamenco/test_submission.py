# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders submitted to a stub of a Manager: what it gets, and what is refused before."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.errors import (
    DatasetError,
    FarmError,
    ParseError,
    ResourceError,
    UsageError,
    WrapError,
)
from gaussian_wrapping_addon.core.farm.flamenco import submission
from gaussian_wrapping_addon.core.farm.flamenco.job_record import (
    JobRecord,
    read_record,
    submitted,
    write_record,
)
from gaussian_wrapping_addon.core.farm.flamenco.job_state import cancel, read_state, retry
from gaussian_wrapping_addon.core.farm.flamenco.manager import Manager, platform
from gaussian_wrapping_addon.core.farm.flamenco.submission import (
    SHARED_VARIABLE,
    Choices,
    ask_farm,
    folder_on_farm,
    submit,
)
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from tests.core.farm.flamenco.stub_manager import JOB, TAG, StubManager, serving
from tests.core.farm.job_parts import GRAPHS, graph, job_folder


@pytest.fixture
def stub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StubManager:
    monkeypatch.delenv(SHARED_VARIABLE, raising=False)
    found = StubManager()
    found.variables["gw_shared"]["value"] = str(tmp_path)
    return found


@pytest.fixture
def manager(stub: StubManager) -> Iterator[Manager]:
    with serving(stub) as address:
        yield Manager(address)


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    return job_folder(tmp_path / "jobs" / "the castle", GRAPHS["several regions"])


def submitted_with(manager: Manager, folder: JobFolder, **choices: Any) -> Any:
    chosen = Choices(**choices)
    return submit(ask_farm(manager, chosen), folder.root, chosen)


def test_a_job_is_submitted(stub: StubManager, manager: Manager, folder: JobFolder) -> None:
    folder.cancel_path.touch()
    done = submitted_with(manager, folder, priority=70, tag="big")
    (body,) = stub.submitted
    parts = json.loads(body["settings"].pop("parts"))
    keys = ("name", "kind", "needs")
    assert parts == {
        "version": 1,
        "parts": [{k: p[k] for k in keys} for p in GRAPHS["several regions"]["parts"]],
    }
    assert body.pop("metadata")["gaussian-wrapping.code"] == "0.2.0-0123456789ab"
    assert body == {
        "name": "the castle", "type": "gaussian-wrapping", "type_etag": "abc123", "priority": 70,
        "submitter_platform": platform(), "worker_tag": TAG,
        "settings": {
            "job_folder": "{gw_shared}/jobs/the castle", "python": "{gw_python}",
            "program": "{gw_batch}", "threads": 0, "device": "", "script_version": 1,
        },
    }  # fmt: skip
    assert str(folder.root.parent) not in json.dumps(body)
    assert (done.record, done.parts, done.notes) == (JobRecord(manager.address, JOB), 24, ())
    assert read_record(folder.root) == done.record
    assert not folder.cancel_path.exists(), "an earlier request to stop would stop every part"


def test_metadata_are_texts(stub: StubManager, manager: Manager, folder: JobFolder) -> None:
    submitted_with(manager, folder)
    (body,) = stub.submitted
    assert "worker_tag" not in body
    assert all(isinstance(value, str) for value in body["metadata"].values())


@pytest.mark.parametrize("way", ["choice", "environment"])
def test_the_shared_folder_is_told(
    stub: StubManager, manager: Manager, folder: JobFolder, monkeypatch: pytest.MonkeyPatch,
    way: str,
) -> None:  # fmt: skip
    here = str(folder.root.parent)
    stub.variables["gw_shared"]["value"] = "/elsewhere"
    if way == "environment":
        monkeypatch.setenv(SHARED_VARIABLE, here)
    submitted_with(manager, folder, shared=here if way == "choice" else "", root="S:/farm/")
    assert stub.submitted[0]["settings"]["job_folder"] == "S:/farm/the castle"


def test_missing_variables_are_said(stub: StubManager, manager: Manager, folder: JobFolder) -> None:
    del stub.variables["gw_python"], stub.variables["gw_batch"]
    notes = submitted_with(manager, folder).notes
    assert [note.split()[5] for note in notes] == ["gw_python", "gw_batch"]
    del stub.variables["gw_shared"]
    with pytest.raises(UsageError, match=r"no variable gw_shared.*flamenco-manager\.yaml"):
        ask_farm(manager, Choices())
    with pytest.raises(UsageError, match=r"workers would not find the job folder.*--root"):
        ask_farm(manager, Choices(shared=str(folder.root.parent)))


def test_a_shared_folder_that_is_not_there_is_named(stub: StubManager, manager: Manager) -> None:
    stub.variables["gw_shared"]["value"] = "/nowhere/farm"
    with pytest.raises(UsageError, match=r"The shared folder /nowhere/farm does not exist on this"):
        ask_farm(manager, Choices())


@pytest.mark.parametrize("path", ["//server/farm", r"\\server\farm"])
def test_a_server_that_the_manager_names_is_not_asked(
    stub: StubManager, manager: Manager, path: str
) -> None:
    stub.variables["gw_shared"]["value"] = path
    with pytest.raises(UsageError, match="names the shared folder by its server"):
        ask_farm(manager, Choices())


@pytest.mark.parametrize("priority", [-1, 101])
def test_priorities_are_from_0_to_100(manager: Manager, stub: StubManager, priority: int) -> None:
    with pytest.raises(UsageError, match=r"priority -?\d+ is out of range\. Give from 0 to 100"):
        ask_farm(manager, Choices(priority=priority))
    assert stub.asked == []


@pytest.mark.parametrize("name", ["a{gw_shared}", "a\\b", "a\nb"])
def test_names_that_would_be_changed_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match=r"Rename the folder\."):
        folder_on_farm(tmp_path / name, tmp_path, "{gw_shared}")


def test_a_folder_outside_of_the_shared_one_is_refused(
    stub: StubManager, manager: Manager, folder: JobFolder
) -> None:
    for shared in (str(folder.root), str(folder.root.parent / "photos")):
        with pytest.raises(
            UsageError, match=r"is not in the folder that the farm shares.*GW_SHARED"
        ):
            submitted_with(manager, folder, shared=shared)
    assert stub.submitted == []
    assert read_record(folder.root) is None


def test_what_is_no_job_or_at_work_is_refused(
    stub: StubManager, manager: Manager, folder: JobFolder, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="holds no job"):
        submitted_with(manager, JobFolder(tmp_path / "photos"))
    (folder.root / "parts.json").rename(folder.root / "aside.json")
    with pytest.raises(UsageError, match=r"batch\.py parts DIR"):
        submitted_with(manager, folder)
    (folder.root / "aside.json").rename(folder.root / "parts.json")
    folder.lock()
    with pytest.raises(UsageError, match="A job is running"):
        submitted_with(manager, folder)
    folder.unlock()
    (folder.root / "link").symlink_to("/etc")
    with pytest.raises(DatasetError, match="is a link"):
        submitted_with(manager, folder)
    assert stub.submitted == []


@pytest.mark.parametrize(
    ("tiles", "regions", "refused"),
    [("auto", {"a": 0}, True), ("auto", {"a": 3}, False), ("off", {"a": 0}, False),
     ("1", {"a": 0}, False), ("auto", {"a": 3, "b": 0}, True), ("auto", {}, False)],
)  # fmt: skip
def test_tiles_must_be_known(
    stub: StubManager, manager: Manager, tmp_path: Path, tiles: str, regions: dict[str, int],
    refused: bool,
) -> None:  # fmt: skip
    folder = job_folder(tmp_path / "job", graph(regions), tiles)
    if not refused:
        submitted_with(manager, folder)
        assert len(stub.submitted) == 1
        return
    with pytest.raises(UsageError, match=r"known only while the job runs.*--tiles N"):
        submitted_with(manager, folder)
    assert stub.submitted == []


def test_a_submitted_job_is_not_submitted_again_while_it_runs(
    stub: StubManager, manager: Manager, folder: JobFolder
) -> None:
    submitted_with(manager, folder)
    for status in ("active", "queued", "paused"):
        stub.status = status
        with pytest.raises(UsageError, match=rf"job {JOB} is {status}\. .*farm cancel DIR"):
            submitted_with(manager, folder)
    for status in ("completed", "failed", "canceled"):
        stub.status = status
        submitted_with(manager, folder)
    stub.status, stub.known = "active", False  # deleted there
    submitted_with(manager, folder)
    assert len(stub.submitted) == 5


def test_a_refused_job_leaves_no_record(
    stub: StubManager, manager: Manager, folder: JobFolder
) -> None:
    farm = ask_farm(manager, Choices())
    with pytest.raises(FarmError, match="412: rejecting job because"):
        submit(replace(farm, etag="old"), folder.root, Choices())
    assert read_record(folder.root) is None


def test_a_job_whose_number_cannot_be_kept_is_cancelled(
    stub: StubManager, manager: Manager, folder: JobFolder
) -> None:
    (folder.root / "flamenco.json").mkdir()
    farm = ask_farm(manager, Choices())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(submission, "read_record", lambda _root: None)
        with pytest.raises(ResourceError, match=r"flamenco\.json cannot be written"):
            submit(farm, folder.root, Choices())
    assert len(stub.submitted) == 1
    assert [change["status"] for change in stub.changes] == ["cancel-requested"]


def test_an_earlier_manager_that_is_gone_is_named(
    stub: StubManager, manager: Manager, folder: JobFolder
) -> None:
    with serving(StubManager()) as gone:
        pass
    write_record(folder.root, JobRecord(gone, JOB))
    words = f"was submitted before, .* Nothing answers at {gone}.*delete flamenco.json"
    with pytest.raises(FarmError, match=words):
        submitted_with(manager, folder)
    assert stub.submitted == []


def test_state_and_log_of_failed_tasks(
    stub: StubManager, manager: Manager, folder: JobFolder
) -> None:
    record = submitted_with(manager, folder).record
    stub.status = "failed"
    stub.fail("train", "iteration 10\nerror: Too little memory.\n")
    stub.fail("plan-engine", "", "soft-failed")
    state = read_state(record)
    assert (state.status, state.counts) == (
        "failed", (("queued", 22), ("failed", 1), ("soft-failed", 1)),
    )  # fmt: skip
    assert [(t.name, t.worker, t.lines) for t in state.failed] == [
        ("train", "blade-3", ("iteration 10", "error: Too little memory.")),
        ("plan-engine", "blade-3", ()),
    ]


def test_many_failed_tasks_are_not_all_asked_for(
    stub: StubManager, manager: Manager, folder: JobFolder
) -> None:
    record = submitted_with(manager, folder).record
    for task in stub.tasks:
        task["status"] = "failed"
    stub.asked.clear()
    assert len(read_state(record).failed) == 8
    assert len(stub.asked) == 2 + 2 * 8


def test_cancel_and_retry(stub: StubManager, manager: Manager, folder: JobFolder) -> None:
    record = submitted_with(manager, folder).record
    cancel(folder.root, record)
    assert folder.cancel_path.exists()
    retry(folder.root, record)
    assert not folder.cancel_path.exists()
    assert [c["status"] for c in stub.changes] == ["cancel-requested", "requeueing"]
    stub.known = False
    with pytest.raises(FarmError, match=r"will stop, but the Manager was not told: .* answers 404"):
        cancel(folder.root, record)
    assert folder.cancel_path.exists()


RECORDS = ("{", "[]", "{}", '{"version": 2}', '{"version": 1, "address": "file:///x", "job": "%s"}',
           '{"version": 1, "address": "http://x", "job": "../x"}',
           '{"version": 1, "address": "http://x"}')  # fmt: skip


@pytest.mark.parametrize("text", RECORDS)
def test_damaged_records_are_refused(folder: JobFolder, text: str) -> None:
    (folder.root / "flamenco.json").write_text(text.replace("%s", JOB))
    with pytest.raises(ParseError, match=r"flamenco\.json"):
        submitted(folder.root)


def test_no_record(folder: JobFolder) -> None:
    with pytest.raises(UsageError, match="was not submitted to Flamenco"):
        submitted(folder.root)


def test_every_error_of_a_manager_that_is_gone_is_typed(folder: JobFolder) -> None:
    with serving(StubManager()) as address:
        pass
    record = JobRecord(address, JOB)
    for call in (
        lambda: ask_farm(Manager(address), Choices()),
        lambda: read_state(record),
        lambda: cancel(folder.root, record),
        lambda: retry(folder.root, record),
    ):
        with pytest.raises(WrapError, match=f"Nothing answers at {address}"):
            call()
