# SPDX-License-Identifier: GPL-3.0-or-later
"""What a Dask worker does: start a child and tell how it ended, without the add-on."""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.farm import child
from gaussian_wrapping_addon.core.farm.dask import request_of
from gaussian_wrapping_addon.core.names import SHARED_VARIABLE


def run(code: str, folder: Path, **changes: Any) -> dict[str, Any]:
    request = {
        "module": "some.module", "arguments": {"part": "a"}, "folder": str(folder),
        "is_shared": False, "command": [sys.executable, "-c", code], **changes,
    }  # fmt: skip
    return child.run_child(request)


@pytest.mark.parametrize(
    ("code", "ended", "says"),
    [
        ("pass", 0, ""),
        ('print(\'{"error": "Bad.", "hint": "Mend it."}\'); raise SystemExit(1)', 1, "Bad."),
        ("raise SystemExit(7)", 7, "Its process ended with code 7: no output."),
        ("raise ValueError('odd')", 1, "Its process ended with code 1: ValueError: odd."),
    ],
)
def test_how_it_ended_is_told(code: str, ended: int, says: str, tmp_path: Path) -> None:
    result = run(code, tmp_path)
    assert (result["code"], result["error"]) == (ended, says)
    assert result["host"]


@pytest.mark.skipif(sys.platform == "win32", reason="a process is ended by a signal")
def test_a_killed_child_is_told_with_what_it_said_last(tmp_path: Path) -> None:
    code = (
        'import os,signal,sys; print(\'{"message": "at work"}\'); sys.stdout.flush();'
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    result = run(code, tmp_path)
    assert result["code"] == -9
    assert result["error"] == "Its process was stopped by signal 9: no output."
    assert result["lines"] == ['{"message": "at work"}']


def test_the_child_gets_module_folder_and_arguments_and_long_output_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = run("import sys; print(sys.argv[1:])", tmp_path)
    module, arguments = ast.literal_eval(result["lines"][0])
    assert module == "some.module"
    assert json.loads(arguments) == {"part": "a", "out": str(tmp_path)}
    result = run("[print('x' * 99) for _ in range(5000)]", tmp_path)
    assert (result["code"], len(result["lines"])) == (0, child.LAST_LINES)
    monkeypatch.delenv(child.ENTRY_VARIABLE, raising=False)
    assert "GW_ENTRY is not set" in run("", tmp_path, command=None)["error"]


def test_the_shared_folder_is_that_of_this_computer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there" / "jobs" / "a").mkdir(parents=True)
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path / "here"))
    (tmp_path / "here" / "jobs" / "a").mkdir(parents=True)
    request = request_of(tmp_path / "here" / "jobs" / "a", "m", {}, None)
    assert (request["folder"], request["is_shared"]) == ("jobs/a", True)
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path / "there"))
    code = "import json,sys; print(json.loads(sys.argv[2])['out'])"
    result = child.run_child({**request, "command": [sys.executable, "-c", code]})
    assert result["lines"] == [str(tmp_path / "there" / "jobs" / "a")]
    monkeypatch.delenv(SHARED_VARIABLE)
    assert "GW_SHARED is not set" in child.run_child(request)["error"]
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path))
    told = child.run_child(request)
    assert told["code"] == 2
    assert "does not see" in told["error"]


def test_it_needs_nothing_but_the_standard_library() -> None:
    tree = ast.parse(Path(child.__file__).read_text(encoding="utf-8"))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names.add(str(node.module).split(".")[0])
    assert names <= sys.stdlib_module_names
    assert child.SHARED_VARIABLE == SHARED_VARIABLE
