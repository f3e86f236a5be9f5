# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole way of a job: submitted to a stub, compiled by the script, its commands run.

A Worker's part is played here: variables are replaced, tasks run in the order of their needs,
without a shell. The program that they start is a stand-in that writes the states of parts.
"""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.farm.flamenco.job_state import read_state, retry
from gaussian_wrapping_addon.core.farm.flamenco.manager import Manager
from gaussian_wrapping_addon.core.farm.flamenco.submission import (
    Choices,
    ask_farm,
    submit,
)
from gaussian_wrapping_addon.core.farm.part_states import PartReader
from gaussian_wrapping_addon.core.names import SHARED_VARIABLE
from tests.core.farm.flamenco.stub_manager import StubManager, serving
from tests.core.farm.flamenco.test_job_type import compiled, needs_node
from tests.core.farm.job_parts import GRAPHS, job_folder

# Fails where a need is not done, and where a file says so.
PROGRAM = """
import json, pathlib, sys, time
command, root, name = sys.argv[1:]
assert command == "run-part"
root = pathlib.Path(root)
parts = {p["name"]: p for p in json.loads((root / "parts.json").read_text())["parts"]}
states = root / "parts"
states.mkdir(exist_ok=True)
for need in parts[name]["needs"]:
    assert json.loads((states / f"{need}.json").read_text())["state"] == "DONE", need
fails = (root / "fails").exists() and (root / "fails").read_text() == name
state = {"state": "FAILED" if fails else "DONE", "plan": "", "place": "blade-3", "pid": 1,
         "pid_started": 1, "token": "", "begun_s": 1.0, "heartbeat_s": time.time(),
         "fraction": 1.0, "message": "", "attempts": 1,
         "error": "Too little memory." if fails else "", "hint": "", "exit_code": 2 * fails,
         "seconds": 1.0, "peak_memory_bytes": 1, "figures": {}, "outputs": []}
(states / f"{name}.json").write_text(json.dumps(state))
print(f"error: {state['error']}" if fails else "done")
sys.exit(2 if fails else 0)
"""


def run_tasks(stub: StubManager, variables: dict[str, str]) -> None:
    """Run what the Manager has, as one Worker would."""
    settings: dict[str, Any] = stub.submitted[-1]["settings"]
    waiting = {task["name"]: task for task in compiled(settings)["tasks"]}
    rows = {row["name"]: row for row in stub.tasks}
    assert list(rows) == list(waiting)
    while True:
        ready = [
            task
            for task in waiting.values()
            if rows[task["name"]]["status"] == "queued"
            and all(rows[need]["status"] == "completed" for need in task["needs"])
        ]
        if not ready:
            return
        (command,) = ready[0]["commands"]
        words = [command["parameters"]["exe"], *command["parameters"]["args"]]
        for name, value in variables.items():
            words = [word.replace(f"{{{name}}}", value) for word in words]
        done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
        assert "Traceback" not in done.stderr, done.stderr
        row = rows[ready[0]["name"]]
        row["status"] = "completed" if done.returncode == 0 else "failed"
        stub.logs[row["id"]] = done.stdout


@needs_node
def test_a_part_fails_and_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = tmp_path / "the farm"
    folder = job_folder(shared / "jobs" / "a $castle; x", GRAPHS["several regions"])
    program = tmp_path / "my program.py"
    program.write_text(PROGRAM)
    (folder.root / "fails").write_text("gather-engine")
    monkeypatch.setenv(SHARED_VARIABLE, str(shared))
    # As the Workers see them: the shared folder has another path there.
    seen = tmp_path / "seen by workers"
    seen.symlink_to(shared)
    variables = {"gw_shared": str(seen), "gw_python": sys.executable, "gw_batch": str(program)}
    stub = StubManager()
    with serving(stub) as address:
        record = submit(ask_farm(Manager(address), Choices()), folder.root, Choices()).record
        run_tasks(stub, variables)
        board = PartReader(folder.root).read()
        assert dict(board.counts)["gather"] == (1, 0, 1, 0)
        assert dict(board.counts)["faces"] == (2, 0, 0, 3), "the other region went on"
        assert [(p.name, p.place, p.error) for p in board.failed] == [
            ("gather-engine", "blade-3", "Too little memory.")
        ]
        (task,) = read_state(record).failed
        assert (task.name, task.lines) == ("gather-engine", ("error: Too little memory.",))
        (folder.root / "fails").unlink()
        retry(folder.root, record)
        for row in stub.tasks:  # as the Manager does then
            row["status"] = "completed" if row["status"] == "completed" else "queued"
        run_tasks(stub, variables)
        assert PartReader(folder.root).read().finished
        assert Counter(dict(read_state(record).counts)) == {"completed": 24}
