# SPDX-License-Identifier: GPL-3.0-or-later
"""What a Manager says, and what it is asked to do, against a stub of one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from gaussian_wrapping_addon.core.errors import FarmError, UsageError
from gaussian_wrapping_addon.core.farm.flamenco.exchange import NotFoundError
from gaussian_wrapping_addon.core.farm.flamenco.manager import MAX_LOG_LINES, Manager
from tests.core.farm.flamenco.stub_manager import JOB, TAG, TASK, StubManager, serving


@pytest.fixture
def stub() -> StubManager:
    return StubManager()


@pytest.fixture
def manager(stub: StubManager) -> Iterator[Manager]:
    with serving(stub) as address:
        yield Manager(address)


@pytest.mark.parametrize("text", ["3.3", "3.3-alpha0", "3.8.2", "3.10"])
def test_versions_that_fit(stub: StubManager, manager: Manager, text: str) -> None:
    stub.version = {"version": f"{text} (git)", "shortversion": text}
    assert manager.version() == text


@pytest.mark.parametrize("text", ["3.2", "2.5", "4.0", "3.2.9"])
def test_versions_that_do_not(stub: StubManager, manager: Manager, text: str) -> None:
    stub.version = {"version": text, "shortversion": text}
    words = rf"http://\S+ is Flamenco {text}; 3\.3 or a later 3 is needed\. Install another"
    with pytest.raises(FarmError, match=words):
        manager.version()


@pytest.mark.parametrize("values", [{}, {"version": "x"}, {"shortversion": 3.3}, {"version": None}])
def test_no_version_is_no_manager(stub: StubManager, manager: Manager, values: Any) -> None:
    stub.version = values
    with pytest.raises(FarmError, match="gives no version of Flamenco"):
        manager.version()


def test_the_job_type_is_installed(stub: StubManager, manager: Manager) -> None:
    assert manager.job_type_etag() == "abc123"


@pytest.mark.parametrize(
    "change",
    [
        {"settings": []},
        {"settings": None},
        {"settings": [{"key": "script_version", "default": 2}]},
        {"settings": [{"key": "script_version"}, 5]},
        {"etag": None},
    ],
)
def test_a_job_type_of_another_version(stub: StubManager, manager: Manager, change: Any) -> None:
    stub.job_type |= change
    with pytest.raises(FarmError, match=r"another version of the add-on.*farm job-type FOLDER"):
        manager.job_type_etag()


def test_a_manager_without_the_job_type(stub: StubManager, manager: Manager) -> None:
    stub.job_type = None
    with pytest.raises(FarmError, match=r"no job type gaussian-wrapping.*scripts beside"):
        manager.job_type_etag()


def test_variables_of_this_system(stub: StubManager, manager: Manager) -> None:
    stub.variables |= {"odd": 5, "empty": {"value": ""}, "number": {"value": 3}}
    wanted = {"gw_shared": "/farm", "gw_python": "/gw/python", "gw_batch": "/gw/batch.py"}
    assert manager.variables("users") == wanted


def test_tags_by_name(stub: StubManager, manager: Manager) -> None:
    assert manager.tag_id("big") == TAG
    with pytest.raises(UsageError, match=r"no tag 'small'\. It has: big\."):
        manager.tag_id("small")
    stub.tags = {}
    with pytest.raises(UsageError, match="It has none"):
        manager.tag_id("big")
    stub.tags = {"tags": [{"name": "big", "id": "../../x"}]}
    with pytest.raises(FarmError, match="without an id"):
        manager.tag_id("big")


def test_jobs_and_tasks(stub: StubManager, manager: Manager) -> None:
    stub.tasks = [{"id": TASK.format(1), "name": "train\n", "status": "active"}, 5]
    assert manager.job_status(JOB) == "queued"
    (task,) = manager.tasks(JOB)
    assert (task.id, task.name, task.status) == (TASK.format(1), "train", "active")
    assert manager.worker_of(task.id) == "blade-3"
    assert manager.last_lines(task.id) == ()
    stub.logs[task.id] = "".join(f"line {k}\r\n\n" for k in range(100)) + "x" * 1000 + "\x1b[2J\n"
    lines = manager.last_lines(task.id)
    assert len(lines) == MAX_LOG_LINES
    assert lines[-2:] == ("line 99", "x" * 300)
    stub.known = False
    for call in (manager.job_status, manager.tasks, manager.cancel):
        with pytest.raises(NotFoundError):
            call(JOB)


def test_a_job_is_cancelled_and_queued_again(stub: StubManager, manager: Manager) -> None:
    manager.cancel(JOB)
    manager.requeue(JOB)
    assert [change["status"] for change in stub.changes] == ["cancel-requested", "requeueing"]
    assert all(change["reason"] for change in stub.changes)


@pytest.mark.parametrize(
    "call", [lambda m: m.tasks(JOB), lambda m: m.submit({"type_etag": "abc123"})]
)
def test_ids_of_others_are_not_put_into_paths(
    stub: StubManager, manager: Manager, call: Callable[[Manager], object]
) -> None:
    stub.instead = lambda _m, _p: (200, {}, b'{"id": "../x", "tasks": [{"id": "../x"}]}')
    with pytest.raises(FarmError, match="answers without an id"):
        call(manager)


def test_a_job_without_a_state(stub: StubManager, manager: Manager) -> None:
    stub.instead = lambda _method, _path: (200, {}, b"{}")
    assert manager.tasks(JOB) == []
    with pytest.raises(FarmError, match="gives no state"):
        manager.job_status(JOB)
