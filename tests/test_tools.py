# SPDX-License-Identifier: GPL-3.0-or-later
"""The tools that measure the code and its tests, on tiny trees."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tools import house, mutations

PARTS = '''"""Two lines
of words."""
from math import (
    pi,
)

LIMIT = 3.0


# A comment.
@kernel(fast=True)
def _area(a, b, c, d, e, f, g, h, i):
    return pi * a


class Counted:
    def many(self, a, b, c, d, e, f, g, h, *, i=1):
        """Words."""
        _logger.info("%d", a + 1)
        return _area(a) < b


def size(x: int = 2) -> int:
    Counted().many(x)
    Counted()
    check(x)
    return x - 1
'''


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    root = tmp_path / "tree"
    for name, text in {
        "pyproject.toml": "[tool.pytest.ini_options]\npythonpath = ['.']\n",
        "gaussian_wrapping_addon/__init__.py": "",
        "gaussian_wrapping_addon/batch.py": "print('''\\n  -h, --help\\n  --a A  x\\n  --b''')\n",
        "gaussian_wrapping_addon/core/parts.py": PARTS,
        "gaussian_wrapping_addon/core/shapes.py": (
            "def check(x):\n    if x < 3:\n        raise ValueError(x + 1)\n"
        ),
        "benchmarks/timing.py": "X = 1\n",
        "tests/test_shapes.py": (
            "import pytest\nfrom gaussian_wrapping_addon.core.shapes import check\n\n\n"
            "def test_check():\n    check(3)\n    with pytest.raises(ValueError):\n"
            "        check(2)\n\n\ndef test_broken():\n    assert False\n"
        ),
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_the_table_measures_a_tree(tree: Path) -> None:
    rows = house.measure(tree)
    assert rows == {
        "package: lines": str(PARTS.count("\n") + 1 + 3),
        "package: lines of code": str(16 + 3 + 1),
        "modules (without `__init__.py`)": "3",
        "folders": "2",
        "modules below 60 lines": "3",
        "modules of 60 to 120 lines": "0",
        "functions": "4",
        "mean length of a function": f"{(2 + 4 + 5 + 3) / 4:.1f}",
        "function names called in exactly one place": "3",
        "import lines at the top of modules": "3",
        "functions of more than 8 parameters": "1",
        "functions of more than 10 parameters": "0",
        "functions of more than 12 parameters": "0",
        "options of `wrap`": "2",
        "tests: lines": "12",
        "tests: files": "1",
        "tests: functions `test_*`": "2",
        "benchmarks: lines": "1",
        "benchmarks: files": "1",
        "tools: lines": "0",
    }
    text = house.table({"before": rows, "now": rows})
    assert text.splitlines()[:3] == [
        "| | before | now |", "|---|---:|---:|", "| package: lines | 31 | 31 |",
    ]  # fmt: skip


def test_mutations_are_made_where_they_change_something(tree: Path) -> None:
    found = mutations.sites(tree)
    source = {path: (tree / path).read_bytes() for path in {site.path for site in found.values()}}
    made = set()
    for key, site in found.items():
        lines = mutations.mutated(source[site.path], site).decode().splitlines()
        made.add((*key[:1], *key[2:], lines[site.line - 1].strip()))
    assert made == {
        ("many", "comparison", 0, "return _area(a) >= b"),
        ("many", "limit", 0, "return _area(a) <= b"),
        ("size", "call", 0, "pass"),
        ("size", "sign", 0, "return x + 1"),
        ("size", "constant", 0, "return x - 2"),
        ("check", "comparison", 0, "if x >= 3:"),
        ("check", "limit", 0, "if x <= 3:"),
        ("check", "constant", 0, "if x < 4:"),
    }
    both = mutations.chosen(found, {key: found[key] for key in list(found)[:4]}, 9, seed=3)
    assert sorted(both) == sorted(list(found)[:4])
    assert mutations.chosen(found, found, 5, 3) == mutations.chosen(found, found, 9, 3)[:5]


def test_the_lines_of_a_compiled_function_are_those_that_call_it(tree: Path) -> None:
    site = mutations.Site("gaussian_wrapping_addon/core/parts.py", "_area", 13, 0, 1, "", True)
    assert mutations.lines_to_cover(tree, site) == {(site.path, 20)}


def test_tests_are_spread_over_files_fastest_first() -> None:
    seconds = {"a::1": 3.0, "a::2": 1.0, "b::1": 2.0}
    assert mutations.spread(["a::1", "a::2", "b::1"], seconds, 2) == ["a::2", "b::1"]


def test_the_tests_that_execute_a_line_are_taken(tree: Path, tmp_path: Path) -> None:
    coverage = pytest.importorskip("coverage")
    data = coverage.CoverageData(str(tmp_path / "covered"))
    for test, line in (("tests/gone.py::test_far|run", 2), ("tests/old.py::test_check[1]|run", 2)):
        data.set_context(test)
        data.add_lines({"/elsewhere/gaussian_wrapping_addon/core/shapes.py": [line]})
    data.write()
    found = mutations.sites(tree)
    measured = [mutations.Measured(tree, tmp_path / "covered")]
    renamed = {"tests/old.py": ["tests/none.py", "tests/test_shapes.py"]}
    select = mutations.Selection(tree, measured, renamed, {}, 9)
    key = next(key for key in found if key[0] == "check")
    assert select.tests(key, found[key]) == (["tests/test_shapes.py::test_check[1]"], "coverage")
    unmeasured = (*key[:1], "another line", *key[2:])
    assert select.tests(unmeasured, found[key]) == (["tests/test_shapes.py"], "names")


@pytest.mark.proof
def test_two_trees_are_compared_by_the_same_faults(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results.json"
    (tree / "gaussian_wrapping_addon/core/parts.py").unlink()
    command = ["--old", str(tree), "--new", str(tree), "--out", str(out), "--jobs", "2"]
    monkeypatch.setattr(sys, "argv", ["mutations", *command, "--python", sys.executable])
    assert mutations.main() == 0
    results = json.loads(out.read_text())
    assert {(r["kind"], r["old"]["status"], r["new"]["by"]) for r in results.values()} == {
        (kind, "caught", "tests/test_shapes.py::test_check")
        for kind in ("comparison", "limit", "constant")
    }
    assert "| caught | 3 | 3 |" in capsys.readouterr().out
    assert mutations.main() == 0, "runs nothing again"
