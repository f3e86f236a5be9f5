# SPDX-License-Identifier: GPL-3.0-or-later
"""The job type's script, run under node with a stub of Flamenco's ``author``.

It is not run in Flamenco's own JavaScript engine here: no Manager is at hand.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.farm.flamenco.job_type_file import SCRIPT, write_job_type
from gaussian_wrapping_addon.core.farm.flamenco.manager import JOB_TYPE, SCRIPT_VERSION
from gaussian_wrapping_addon.core.farm.flamenco.submission import job_body
from gaussian_wrapping_addon.core.jobs.parts.graph import NAME, VERSION, read_parts
from tests.core.farm.flamenco.stub_manager import CHOICES, FARM
from tests.core.farm.job_parts import GRAPHS, graph, part

NODE = shutil.which("node")
STUB = Path(__file__).with_name("author_stub.js")
FOLDER = "{gw_shared}/jobs/the castle"

needs_node = pytest.mark.skipif(
    NODE is None, reason="node, which runs JavaScript, is not installed"
)


def settings_of(values: Any, tmp_path: Path) -> dict[str, Any]:
    """Return the settings of a submission of these parts."""
    (tmp_path / "parts.json").write_text(json.dumps(values))
    body = job_body("castle", read_parts(tmp_path), FOLDER, FARM, CHOICES)
    settings: dict[str, Any] = body["settings"]
    return settings


def all_compiled(settings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Let the script compile each of some settings."""
    assert NODE is not None
    done = subprocess.run(
        [NODE, str(STUB), str(SCRIPT)], input=json.dumps(settings).encode(),
        capture_output=True, timeout=60, check=True,
    )  # fmt: skip
    answers: list[dict[str, Any]] = json.loads(done.stdout)
    return answers


def compiled(settings: dict[str, Any]) -> dict[str, Any]:
    (answer,) = all_compiled([settings])
    return answer


@needs_node
@pytest.mark.parametrize("name", GRAPHS)
def test_tasks_are_the_parts(tmp_path: Path, name: str) -> None:
    values = GRAPHS[name]
    tasks = compiled(settings_of(values, tmp_path))["tasks"]
    assert [(t["name"], t["needs"]) for t in tasks] == [
        (p["name"], p["needs"]) for p in values["parts"]
    ]
    for task in tasks:
        assert (task["type"], task["added"]) == ("misc", True)
        args = ["{gw_batch}", "run-part", FOLDER, task["name"]]
        assert task["commands"] == [
            {"name": "exec", "parameters": {"exe": "{gw_python}", "args": args}}
        ]


@needs_node
def test_threads_device_and_a_program_without_python(tmp_path: Path) -> None:
    settings = settings_of(GRAPHS["one piece"], tmp_path)
    settings |= {"threads": 4, "device": "cuda:1", "python": "", "program": "/opt/gw/wrap"}
    task = compiled(settings)["tasks"][0]
    args = ["run-part", FOLDER, "cameras", "--threads", "4", "--device", "cuda:1"]
    parameters = {"exe": "/opt/gw/wrap", "args": args}
    assert task["commands"] == [{"name": "exec", "parameters": parameters}]


@needs_node
def test_the_largest_list_is_compiled(tmp_path: Path) -> None:
    names = [f"points-a-{k:04d}" for k in range(limits.MAX_PARTS - 1)]
    many = [part(name, "points") for name in names]
    settings = settings_of(graph({}) | {"parts": [*many, part("g", "gather", names)]}, tmp_path)
    tasks = compiled(settings)["tasks"]
    assert len(tasks) == limits.MAX_PARTS
    assert tasks[-1]["needs"] == names


@needs_node
def test_the_type_declares_what_a_submission_sets(tmp_path: Path) -> None:
    settings = settings_of(GRAPHS["tiles"], tmp_path)
    declared = compiled(settings)["jobType"]["settings"]
    kinds = {"string": str, "int32": int}
    assert {entry["key"]: kinds[entry["type"]] for entry in declared} == {
        key: type(value) for key, value in settings.items()
    }
    (version,) = (entry for entry in declared if entry["key"] == "script_version")
    assert version["default"] == SCRIPT_VERSION
    assert {entry["visible"] for entry in declared} <= {"hidden", "web"}


def _parts(*parts: Any) -> dict[str, Any]:
    return {"parts": json.dumps({"version": 1, "parts": list(parts)})}


DAMAGED = {
    "not JSON": ({"parts": "{"}, "not JSON"),
    "no text": ({"parts": None}, "format version"),
    "a list": ({"parts": "[]"}, "format version"),
    "another version": ({"parts": '{"version": 2, "parts": []}'}, "format version 1"),
    "no parts": (_parts(), "1 to 50000 parts"),
    "parts of null": (_parts(None), "part number 1 has no name"),
    "an option as a name": (_parts(part("--device", "points")), "part number 1 has no name"),
    "a path as a name": (_parts(part("../x", "points")), "part number 1 has no name"),
    "a number as a name": (_parts({"name": 5, "kind": "x", "needs": []}), "has no name"),
    "a name twice": (_parts(part("x", "points"), part("x", "points")), "name x is there twice"),
    "no needs": (_parts({"name": "x", "kind": "points"}), "part x has no kind or no list"),
    "an unknown need": (_parts(part("x", "mesh", ["y"])), "x needs y, which is no part"),
    "a need twice": (
        _parts(part("y", "points"), part("x", "mesh", ["y", "y"])), "x needs another one twice",
    ),
    "itself": (_parts(part("x", "mesh", ["x"])), "parts x wait for each other"),
    "a circle": (
        _parts(part("a", "x"), part("b", "x", ["a", "d"]), part("c", "x", ["b"]),
               part("d", "x", ["c"])),
        "parts b, c, d wait for each other",
    ),
    "another script": ({"script_version": 2}, "made for version 2"),
    "no folder": ({"job_folder": ""}, "job_folder must be a text, and not an empty one"),
    "an option as a folder": ({"job_folder": "--help"}, "job_folder begins with a dash"),
    "a line break": ({"job_folder": "a\nb"}, "line break"),
    "out of the shared folder": ({"job_folder": "{gw_shared}/../x"}, "must not contain"),
    "out by a backslash": ({"job_folder": "S:\\x\\..\\y"}, "must not contain"),
    "no program": ({"program": ""}, "program must be a text"),
    "python as a number": ({"python": 3}, "python must be a text"),
    "half a thread": ({"threads": 0.5}, "threads must be a whole number"),
    "too many threads": ({"threads": 1025}, "threads must be a whole number"),
    "threads as text": ({"threads": "4"}, "threads must be a whole number"),
    "a device with an option": ({"device": "cpu --x"}, "device must be"),
}  # fmt: skip


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What the script says of each damaged submission; node starts once."""
    if NODE is None:
        pytest.skip("node, which runs JavaScript, is not installed")
    good = settings_of(GRAPHS["one piece"], tmp_path_factory.mktemp("parts"))
    answers = all_compiled([good | changes for changes, _ in DAMAGED.values()])
    return dict(zip(DAMAGED, answers, strict=True))


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_is_refused_with_words(damaged: dict[str, dict[str, Any]], name: str) -> None:
    answer, words = damaged[name], DAMAGED[name][1]
    assert "tasks" not in answer
    assert answer["error"].startswith("Gaussian Wrapping: ")
    assert words in answer["error"]


def test_script_and_package_agree() -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    assert text.startswith("// SPDX-License-Identifier: GPL-3.0-or-later\n")
    numbers = dict(re.findall(r"^const ([A-Z_]+) = (\d+);$", text, re.MULTILINE))
    assert numbers == {
        "SCRIPT_VERSION": str(SCRIPT_VERSION), "FORMAT_VERSION": str(VERSION),
        "MAX_PARTS": str(limits.MAX_PARTS), "MAX_THREADS": "1024",
    }  # fmt: skip
    assert f"const PART_NAME = /^{NAME.pattern}$/;" in text
    assert SCRIPT.stem == JOB_TYPE, "a Manager names a type by its file"
    assert not re.search(r"\beval\(|\brequire\(|/bin/|\bsh\b", text)


def test_the_script_is_written_where_it_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / SCRIPT.name).write_text("an older one")
    assert write_job_type(tmp_path) == tmp_path / SCRIPT.name
    assert (tmp_path / SCRIPT.name).read_bytes() == SCRIPT.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == [SCRIPT.name]
