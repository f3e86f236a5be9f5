#!/usr/bin/env python3
# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare how many seeded faults the tests of two versions of the repository notice.

    python tools/mutations.py --old DIR --new DIR --out RESULTS.json [--count N] [--seed N]
        [--jobs N] [--coverage TREE FILE]... [--renamed FILE] [--durations LOG ...]

A mutation flips a sign, negates a comparison, moves its limit, changes a number or drops a call. It
is made in a line of ``core`` or ``ops`` that stands with the same text in a function of the same
name once in each of the two trees, so both versions get the same faults wherever the line has
moved. Messages, calls of loggers and annotations are left alone.

The tests of a mutation are those that execute its line by coverage recorded with
``--cov-context=test`` in any tree that has the line, fastest first by ``--durations`` (a log of
``pytest --durations=0``); ``--renamed`` tells where test files are in the other tree (JSON, a
path to a list of paths). Both trees run the tests that either would choose, at the same time, as
far as they have them. Without coverage they are those whose files import or are named after its
module. Coverage sees no lines of compiled functions: there the lines count that call them, through
other compiled functions too. Tests that fail without the mutation are left out. Results are written
after each mutation; the same command continues where it was stopped.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PACKAGE = "gaussian_wrapping_addon"
PARTS = ("core", "ops")
COMPILED = {"kernel", "part", "inline"}
LOGGERS = re.compile(r"_?log(ger|ging)?")
NEGATED = {
    "<": ">=", "<=": ">", ">": "<=", ">=": "<", "==": "!=", "!=": "==", "is": "is not",
    "is not": "is", "in": "not in", "not in": "in",
}  # fmt: skip
MOVED = {"<": "<=", "<=": "<", ">": ">=", ">=": ">"}
_NOT_COPIED = shutil.ignore_patterns(".git", ".venv*", ".cache", "__pycache__", ".*_cache", "dist")
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+\.py(?:::.*?)?)(?: - .*)?$", re.MULTILINE)
_DURATION = re.compile(r"^\s*([0-9.]+)s (?:call|setup|teardown)\s+(tests/.+)$", re.MULTILINE)

Key = tuple[str, str, str, int]
"""Function, text of the line, kind of mutation, which of this kind in the line."""


@dataclass(frozen=True)
class Site:
    """A mutation in one of the trees."""

    path: str
    """Below the tree, with ``/``."""
    function: str
    line: int
    start: int
    """Bytes of the line before the replaced ones."""
    end: int
    replacement: str
    is_compiled: bool


def _is_compiled(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    marks = [d.func if isinstance(d, ast.Call) else d for d in function.decorator_list]
    return any(getattr(m, "id", getattr(m, "attr", "")) in COMPILED for m in marks)


def _is_logging(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and isinstance(node.func.value, ast.Name)
        and LOGGERS.fullmatch(node.func.value.id) is not None
    )


def _mutable(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what may be mutated below ``node``, not what inner functions hold."""
    left_alone = (ast.JoinedStr, ast.Raise, ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "args") and isinstance(
            node, ast.AnnAssign | ast.FunctionDef | ast.AsyncFunctionDef
        ):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, left_alone) or not isinstance(child, ast.AST):
                continue
            if not _is_logging(child):
                yield child
                yield from _mutable(child)


def _edits(node: ast.AST, lines: list[bytes]) -> Iterator[tuple[str, int, int, int, str]]:
    """Yield kind, line, first and last byte and replacement of the mutations of one node."""

    def between(left: ast.expr, right: ast.expr) -> tuple[int, int, int, str] | None:
        """Return line, bytes and text of the operator between two operands of one line."""
        if left.end_lineno != right.lineno:
            return None
        row = lines[right.lineno - 1][left.end_col_offset : right.col_offset]
        text = row.decode().replace("(", " ").replace(")", " ")
        if not text.strip():
            return None
        first = (left.end_col_offset or 0) + len(text) - len(text.lstrip())
        return right.lineno, first, first + len(text.strip()), " ".join(text.split())

    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
        if place := between(node.left, node.right):
            line, first, last, text = place
            yield "sign", line, first, last, "-" if text == "+" else "+"
    elif isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add | ast.Sub):
        if place := between(node.target, node.value):
            line, first, last, text = place
            yield "sign", line, first, last, "-=" if text == "+=" else "+="
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign", node.lineno, node.col_offset, node.col_offset + 1, "+"
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        if place := between(node.left, node.comparators[0]):
            line, first, last, text = place
            for kind, others in (("comparison", NEGATED), ("limit", MOVED)):
                if text in others:
                    yield kind, line, first, last, others[text]
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        value = node.value
        new = value + 1 if isinstance(value, int) else value * 1.5 if value else 1.0
        if node.lineno == node.end_lineno:
            last = node.end_col_offset or node.col_offset
            yield "constant", node.lineno, node.col_offset, last, repr(new)
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        last = node.end_col_offset or node.col_offset
        if node.lineno == node.end_lineno and not _is_logging(node.value):
            yield "call", node.lineno, node.col_offset, last, "pass"


def sites(root: Path) -> dict[Key, Site]:
    """Return the mutations of a tree whose key it has once."""
    found: dict[Key, list[Site]] = defaultdict(list)
    for path in sorted(p for part in PARTS for p in (root / PACKAGE / part).rglob("*.py")):
        source = path.read_bytes()
        lines = source.split(b"\n")
        for function in ast.walk(ast.parse(source)):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            seen: Counter[tuple[int, str]] = Counter()
            edits = (edit for node in _mutable(function) for edit in _edits(node, lines))
            for kind, line, first, last, new in sorted(edits):
                key = (function.name, lines[line - 1].decode().strip(), kind, seen[line, kind])
                seen[line, kind] += 1
                found[key].append(
                    Site(
                        path.relative_to(root).as_posix(), function.name, line, first, last, new,
                        _is_compiled(function),
                    )
                )  # fmt: skip
    return {key: places[0] for key, places in found.items() if len(places) == 1}


def chosen(old: dict[Key, Site], new: dict[Key, Site], count: int, seed: int) -> list[Key]:
    """Return mutations that both trees have, as many of each kind as possible, in random order."""
    by_kind: dict[str, list[Key]] = defaultdict(list)
    for key in sorted(old.keys() & new.keys()):
        by_kind[key[2]].append(key)
    chance = random.Random(seed)
    for keys in by_kind.values():
        chance.shuffle(keys)
    picked: list[Key] = []
    while len(picked) < count and any(by_kind.values()):
        for keys in by_kind.values():
            if keys and len(picked) < count:
                picked.append(keys.pop())
    return picked


def mutated(source: bytes, site: Site) -> bytes:
    """Return the source with the mutation."""
    lines = source.split(b"\n")
    row = lines[site.line - 1]
    lines[site.line - 1] = row[: site.start] + site.replacement.encode() + row[site.end :]
    return b"\n".join(lines)


def lines_to_cover(root: Path, site: Site) -> set[tuple[str, int]]:
    """Return the lines whose tests count: that of the mutation, or those that call it compiled."""
    if not site.is_compiled:
        return {(site.path, site.line)}
    callers: dict[str, list[tuple[str, int, str]]] = defaultdict(list)
    compiled: set[str] = set()
    for path in sorted((root / PACKAGE).rglob("*.py")):
        for function in ast.walk(ast.parse(path.read_bytes())):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            if _is_compiled(function):
                compiled.add(function.name)
            for node in ast.walk(function):
                if isinstance(node, ast.Name | ast.Attribute):
                    name = node.id if isinstance(node, ast.Name) else node.attr
                    place = path.relative_to(root).as_posix(), node.lineno, function.name
                    callers[name].append(place)
    found: set[tuple[str, int]] = set()
    seen, waiting = {site.function}, [site.function]
    while waiting:
        for path_name, line, caller in callers[waiting.pop()]:
            if caller not in compiled:
                found.add((path_name, line))
            elif caller not in seen:
                seen.add(caller)
                waiting.append(caller)
    return found


class Measured:
    """A tree with coverage of its tests."""

    def __init__(self, root: Path, coverage_file: Path) -> None:
        from coverage import CoverageData

        self._root, self._sites = root, sites(root)
        self._data = CoverageData(str(coverage_file))
        self._data.read()
        self._files: dict[str, str] = {}
        for name in self._data.measured_files():
            _, found, below = name.replace(os.sep, "/").rpartition(f"{PACKAGE}/")
            if found:
                self._files[found + below] = name

    def tests(self, key: Key) -> set[str]:
        """Return the tests that execute the line of a mutation."""
        found: set[str] = set()
        if key in self._sites:
            for path, line in lines_to_cover(self._root, self._sites[key]):
                if path in self._files:
                    contexts = self._data.contexts_by_lineno(self._files[path])
                    found.update(context.rpartition("|")[0] for context in contexts.get(line, ()))
        return {test for test in found if "::" in test}


class Selection:
    """Which tests of a tree run for a mutation."""

    def __init__(
        self, root: Path, measured: list[Measured], renamed: dict[str, list[str]],
        seconds: dict[str, float], most: int,
    ) -> None:  # fmt: skip
        self.root = root
        self.most = most
        self._measured, self._renamed, self._seconds = measured, renamed, seconds
        self._tests = {
            path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
            for path in sorted((root / "tests").rglob("test_*.py"))
        }

    def tests(self, key: Key, site: Site) -> tuple[list[str], str]:
        """Return the tests and how they were found, ``"coverage"`` or ``"names"``."""
        covering = {here for m in self._measured for t in m.tests(key) if (here := self.named(t))}
        if tests := spread(covering, self._seconds, self.most):
            return tests, "coverage"
        return self._by_name(site), "names"

    def named(self, test: str) -> str | None:
        """Return the name that a test has in this tree, None if it has none."""
        file, _, name = test.partition("::")
        function = name.partition("[")[0].rpartition("::")[2]
        for path in (file, *self._renamed.get(file, [])):
            if f"def {function}(" in self._tests.get(path, ""):
                return f"{path}::{name}"
        return None

    def _by_name(self, site: Site) -> list[str]:
        module = Path(site.path).stem
        imports = re.compile(
            rf"^\s*from \S*\b{module} import|^\s*from \S+ import [^#\n]*\b{module}\b", re.MULTILINE
        )
        ranked = []
        for file, text in self._tests.items():
            is_named = Path(file).stem == f"test_{module}"
            if is_named or imports.search(text):
                calls = re.search(rf"\b{site.function}\b", text) is not None
                ranked.append((-2 * is_named - calls, file))
        return [file for _, file in sorted(ranked)][: max(1, self.most // 8)]


def spread(tests: Iterable[str], seconds: dict[str, float], most: int) -> list[str]:
    """Return at most ``most`` tests, the fastest of each file first, then the second ones, ..."""
    by_file: dict[str, list[str]] = defaultdict(list)
    for test in sorted(tests, key=lambda test: (seconds.get(test, 0.0), test)):
        by_file[test.partition("::")[0]].append(test)
    order = [
        (turn, seconds.get(test, 0.0), test)
        for tests_of_file in by_file.values()
        for turn, test in enumerate(tests_of_file)
    ]
    first = sorted(order)[:most]
    return [test for _, _, test in sorted(first, key=lambda entry: entry[1:])]


def read_seconds(logs: list[Path]) -> dict[str, float]:
    """Return the seconds of the tests in logs of ``pytest --durations=0``, set-ups included."""
    found: Counter[str] = Counter()
    for log in logs:
        for seconds, test in _DURATION.findall(log.read_text(encoding="utf-8")):
            found[test.rstrip()] += float(seconds)
    return dict(found)


class Copy:
    """A copy of a tree in which mutations are made; kernels compiled before each come from one."""

    def __init__(self, source: Path, place: Path, python: Path) -> None:
        self.tree = place / "tree"
        self._python = python
        self._clean, self._used = place / "kernels", place / "kernels-mutated"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(source, self.tree, ignore=_NOT_COPIED, symlinks=True)
        if (source / ".venv").exists():
            (self.tree / ".venv").symlink_to((source / ".venv").resolve())
        self._clean.mkdir()
        self._known: dict[str, bool] = {}
        self._failing: set[str] = set()
        """Without a mutation."""

    def _pytest(self, tests: list[str], cache: Path, limit_s: float, *more: str) -> tuple[int, str]:
        """Return exit code (-1: out of time) and output."""
        command = [str(self._python), "-m", "pytest", "-q", "-p", "no:cacheprovider", *more, *tests]
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
        process = subprocess.Popen(
            command, cwd=self.tree, env=environment, text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            encoding="utf-8", errors="replace",
        )  # fmt: skip
        try:
            output, _ = process.communicate(timeout=limit_s)
            return process.returncode, output
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return -1, process.communicate()[0]

    def sound(self, tests: list[str], limit_s: float) -> list[str]:
        """Return the tests that pass without a mutation."""
        new = [test for test in tests if test not in self._known]
        if new:
            code, output = self._pytest(new, self._clean, limit_s, "-rfE")
            failed = set(_FAILED.findall(output))
            self._failing |= failed
            for test in new:
                self._known[test] = code in (0, 1) and test not in failed
            if code not in (0, 1) and len(new) > 1:  # a test that is gone stops all others
                for test in new:
                    del self._known[test]
                    self.sound([test], limit_s)
        return [test for test in tests if self._known[test]]

    def run(self, site: Site, tests: list[str], limit_s: float) -> dict[str, Any]:
        """Return what came of one mutation."""
        before = time.monotonic()
        tests = self.sound(tests, 4 * limit_s)
        result: dict[str, Any] = {"path": site.path, "line": site.line, "tests": len(tests)}
        if not tests:
            return {**result, "status": "no tests", "seconds": 0.0}
        shutil.rmtree(self._used, ignore_errors=True)
        shutil.copytree(self._clean, self._used, copy_function=os.link)
        path = self.tree / site.path
        source = path.read_bytes()
        changed = mutated(source, site)
        compile(changed, site.path, "exec")
        path.write_bytes(changed)
        try:
            code, output = self._pytest(
                tests, self._used, limit_s, "-x", "-rfE",
                *(f"--deselect={test}" for test in sorted(self._failing)),
            )  # fmt: skip
        finally:
            path.write_bytes(source)
        status = {0: "survived", -1: "timeout"}.get(code, "caught")
        failed = _FAILED.findall(output)
        return {
            **result, "status": status, "by": failed[0] if failed else "",
            "seconds": round(time.monotonic() - before, 1),
        }  # fmt: skip


def summary(results: dict[str, Any]) -> str:
    """Return the counts of both sides as a Markdown table."""
    counts = {side: Counter(r[side]["status"] for r in results.values()) for side in ("old", "new")}
    lines = ["| | old | new |", "|---|---:|---:|"]
    for status in ("caught", "timeout", "survived", "no tests"):
        lines.append(f"| {status} | {counts['old'][status]} | {counts['new'][status]} |")
    noticed = {"caught", "timeout"}
    for this, other in (("old", "new"), ("new", "old")):
        for name, r in results.items():
            if r[this]["status"] in noticed and r[other]["status"] not in noticed:
                lines.append(f"\nOnly {this}: {r[other]['path']}:{r[other]['line']} {name}")
    return "\n".join(lines) + "\n"


def compare(options: argparse.Namespace) -> dict[str, Any]:
    """Run what is missing in the results, write them after each mutation and return them."""
    trees = {"old": options.old.resolve(), "new": options.new.resolve()}
    places = {side: sites(tree) for side, tree in trees.items()}
    keys = chosen(places["old"], places["new"], options.count, options.seed)
    results: dict[str, Any] = {}
    if options.out.exists():
        results = json.loads(options.out.read_text(encoding="utf-8"))
    seconds = read_seconds(options.durations)
    measured = [Measured(Path(tree).resolve(), Path(file)) for tree, file in options.coverage]
    renamed = json.loads(options.renamed.read_text(encoding="utf-8")) if options.renamed else {}
    select = {s: Selection(trees[s], measured, renamed, seconds, options.most_tests) for s in trees}
    work = (options.work or options.out.with_suffix(".work")).resolve()
    copies: queue.Queue[dict[str, Copy]] = queue.Queue()
    for job in range(options.jobs):
        copies.put({s: Copy(trees[s], work / f"{s}{job}", options.python) for s in trees})
    reading, writing = threading.Lock(), threading.Lock()

    def work_on(key: Key) -> None:
        found: dict[str, Any] = {"kind": key[2]}
        pair = copies.get()
        try:
            with reading:
                chosen_here = {s: select[s].tests(key, places[s][key]) for s in trees}

            def run_side(side: str) -> dict[str, Any]:
                tests, how = chosen_here[side]
                # Those of the other tree too: where files were merged, other ones come first.
                others = chosen_here["new" if side == "old" else "old"][0]
                there = (select[side].named(test) for test in others)
                tests = list(dict.fromkeys([*tests, *(test for test in there if test)]))
                result = pair[side].run(places[side][key], tests, options.timeout)
                return {**result, "found_by": how}

            with ThreadPoolExecutor(len(trees)) as sides:
                found.update(zip(trees, sides.map(run_side, trees), strict=True))
        finally:
            copies.put(pair)
        with writing:
            results[str(key)] = found
            options.out.write_text(json.dumps(results, indent=1), encoding="utf-8")
            words = [f"{side} {found[side]['status']} ({found[side]['tests']})" for side in trees]
            sys.stdout.write(f"{len(results)}/{len(keys)} {', '.join(words)}: {key}\n")
            sys.stdout.flush()

    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(work_on, [key for key in keys if str(key) not in results]))
    shutil.rmtree(work)
    return {name: results[name] for name in map(str, keys)}


def main() -> int:
    """Compare two trees."""
    parser = argparse.ArgumentParser(description="Compare the tests of two trees by mutations.")
    parser.add_argument("--old", type=Path, required=True, metavar="DIR")
    parser.add_argument("--new", type=Path, required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, metavar="RESULTS.json")
    parser.add_argument("--count", type=int, default=100, help="mutations")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--coverage", nargs=2, action="append", default=[], metavar=("TREE", "FILE")
    )
    parser.add_argument("--renamed", type=Path, metavar="FILE")
    parser.add_argument("--durations", type=Path, nargs="*", default=[], metavar="LOG")
    parser.add_argument("--most-tests", type=int, default=40, help="of a mutation")
    parser.add_argument("--timeout", type=float, default=300.0, metavar="SECONDS")
    parser.add_argument("--python", type=Path, default=Path(sys.executable))
    parser.add_argument("--work", type=Path, metavar="DIR", help="for the copies of the trees")
    sys.stdout.write(summary(compare(parser.parse_args())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
