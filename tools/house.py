#!/usr/bin/env python3
# SPDX-License-Identifier: GPL-3.0-or-later
"""Print a Markdown table of the size and shape of the code of one tree or of two side by side.

    python tools/house.py [--tree DIR] [--against COMMIT_OR_DIR]

Only files that end in ``.py`` count. "Called in one place" counts the names of functions and
methods for which the package has exactly one call of that name. Parameters exclude ``self`` and
``cls``, and functions that are compiled (``kernel``, ``part``, ...) are left
out there. The options of ``wrap`` are those that ``wrap --help`` shows in a process of that tree.
"""

from __future__ import annotations

import argparse
import ast
import io
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "gaussian_wrapping_addon"
COMPILED = {"kernel", "part", "inline", "intrinsic", "compile_time"}
Function = ast.FunctionDef | ast.AsyncFunctionDef
_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip


def python_texts(folder: Path) -> dict[Path, str]:
    """Return the text of each Python file of a folder and its folders."""
    paths = sorted(path for path in folder.rglob("*.py") if "__pycache__" not in path.parts)
    return {path: path.read_text(encoding="utf-8") for path in paths}


def docstring_lines(tree: ast.Module) -> set[int]:
    """Return the lines of statements that are only a string."""
    found: set[int] = set()
    for node in ast.walk(tree):
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            found.update(range(value.lineno, (value.end_lineno or value.lineno) + 1))
    return found


def code_lines(text: str, tree: ast.Module) -> int:
    """Return the number of lines without blank ones, comments and docstrings."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - docstring_lines(tree))


def functions_of(tree: ast.Module) -> Iterator[Function]:
    """Yield all functions and methods."""
    yield from (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))


def is_compiled(function: Function) -> bool:
    """Return whether numba compiles the function."""
    marks = [d.func if isinstance(d, ast.Call) else d for d in function.decorator_list]
    return any(getattr(m, "id", getattr(m, "attr", "")) in COMPILED for m in marks)


def parameters(function: Function) -> int:
    """Return the number of parameters, ``self`` and ``cls`` not counted."""
    a = function.args
    named = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
    return sum(argument.arg not in ("self", "cls") for argument in named)


def called_names(trees: list[ast.Module]) -> Counter[str]:
    """Return how many calls there are of each name."""
    calls: Counter[str] = Counter()
    for node in (node for tree in trees for node in ast.walk(tree)):
        if isinstance(node, ast.Call):
            calls[getattr(node.func, "id", getattr(node.func, "attr", ""))] += 1
    return calls


def wrap_options(root: Path) -> int | None:
    """Return the number of options that ``wrap --help`` shows, ``None`` if it fails."""
    with tempfile.TemporaryDirectory(prefix="house-data-") as data:
        environment = {**os.environ, "COLUMNS": "200", "GAUSSIAN_WRAPPING_DATA": data}
        done = subprocess.run(
            [sys.executable, "-B", str(root / PACKAGE / "batch.py"), "wrap", "--help"],
            capture_output=True, text=True, cwd=root, env=environment, check=False,
        )  # fmt: skip
    found = set(re.findall(r"^  (?:-\w, )?(--[\w-]+)", done.stdout, re.MULTILINE)) - {"--help"}
    return len(found) if done.returncode == 0 else None


def measure(root: Path) -> dict[str, str]:
    """Return the rows of the table for a tree: what, and how much of it."""
    texts = python_texts(root / PACKAGE)
    trees = {path: ast.parse(text) for path, text in texts.items()}
    lengths = {path: len(text.splitlines()) for path, text in texts.items()}
    modules = {path: n for path, n in lengths.items() if path.name != "__init__.py"}
    functions = [function for tree in trees.values() for function in functions_of(tree)]
    spans = [(f.end_lineno or f.lineno) - f.lineno + 1 for f in functions]
    counts = [parameters(function) for function in functions if not is_compiled(function)]
    calls = called_names(list(trees.values()))
    names = {f.name for f in functions if not f.name.startswith("__")}
    imports = [
        (node.end_lineno or node.lineno) - node.lineno + 1
        for tree in trees.values()
        for node in tree.body
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    tests = python_texts(root / "tests")
    benchmarks = python_texts(root / "benchmarks")
    tools = python_texts(root / "tools")
    test_count = sum(
        function.name.startswith("test_")
        for text in tests.values()
        for function in functions_of(ast.parse(text))
    )
    options = wrap_options(root)
    small = sum(n < 60 for n in modules.values())
    rows: dict[str, float | None] = {
        "package: lines": sum(lengths.values()),
        "package: lines of code": sum(code_lines(texts[p], tree) for p, tree in trees.items()),
        "modules (without `__init__.py`)": len(modules),
        "folders": len({path.parent for path in texts}),
        "modules below 60 lines": small,
        "modules of 60 to 120 lines": sum(n <= 120 for n in modules.values()) - small,
        "functions": len(functions),
        "mean length of a function": sum(spans) / max(len(spans), 1),
        "function names called in exactly one place": sum(calls[name] == 1 for name in names),
        "import lines at the top of modules": sum(imports),
        **{f"functions of more than {k} parameters": sum(n > k for n in counts)
           for k in (8, 10, 12)},
        "options of `wrap`": options,
        "tests: lines": sum(len(text.splitlines()) for text in tests.values()),
        "tests: files": len(tests),
        "tests: functions `test_*`": test_count,
        "benchmarks: lines": sum(len(text.splitlines()) for text in benchmarks.values()),
        "benchmarks: files": len(benchmarks),
        "tools: lines": sum(len(text.splitlines()) for text in tools.values()),
    }  # fmt: skip
    return {
        name: "?" if value is None else f"{value:.1f}" if isinstance(value, float) else f"{value:,}"
        for name, value in rows.items()
    }


def table(columns: dict[str, dict[str, str]]) -> str:
    """Return a Markdown table: a row for each quantity, a column for each tree."""
    rows = [f"| | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    for name in next(iter(columns.values())):
        rows.append(f"| {name} | {' | '.join(column[name] for column in columns.values())} |")
    return "\n".join(rows) + "\n"


def measure_commit(tree: Path, commit: str) -> dict[str, str]:
    """Return :func:`measure` of a commit of the repository that ``tree`` belongs to."""
    command = ["git", "-C", str(tree), "archive", "--format=tar", commit]
    packed = subprocess.run(command, check=True, capture_output=True).stdout
    with tempfile.TemporaryDirectory(prefix="house-") as folder:
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(folder, filter="data")
        return measure(Path(folder))


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure the size and shape of the code.")
    parser.add_argument("--tree", type=Path, default=ROOT, metavar="DIR")
    parser.add_argument("--against", metavar="COMMIT_OR_DIR", help="an earlier commit, or a folder")
    options = parser.parse_args()
    columns = {}
    if options.against:
        other = Path(options.against)
        is_tree = (other / PACKAGE).is_dir()
        columns[options.against] = (
            measure(other) if is_tree else measure_commit(options.tree, options.against)
        )
    columns["now" if options.tree == ROOT else str(options.tree)] = measure(options.tree)
    sys.stdout.write(table(columns))
    return 0


if __name__ == "__main__":
    sys.exit(main())
