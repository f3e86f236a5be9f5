# SPDX-License-Identifier: GPL-3.0-or-later
"""Fresh and cached kernels are bitwise equal; stale caches; operation without a cache."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import compiled
from tests.proofs import first_then_proofs
from tests.read_only import read_only

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "gaussian_wrapping_addon"
STAGES = Path(__file__).with_name("kernel_stages.py")
NOWHERE = os.devnull + "/nowhere"
TIMEOUT_S = 240


def start(command: list[str], root: Path, **environment: str) -> subprocess.Popen[str]:
    """Start a Python that finds the package in ``root`` and inherits no place for its cache."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA_", "PYTHON"))}
    return subprocess.Popen(
        [sys.executable, *command], env={**kept, "PYTHONPATH": str(root), **environment},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=root,
    )  # fmt: skip


def finish(process: subprocess.Popen[str]) -> tuple[str, str]:
    output, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, output + errors
    return output, errors


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A copy of the package with a kernel whose helper and constant lie in other files."""
    root = tmp_path / "site"
    target = root / PACKAGE.name
    shutil.copytree(PACKAGE, target, ignore=shutil.ignore_patterns("__pycache__"))
    core = target / "core"
    (core / "some_constant.py").write_text("AMOUNT = 1.0\n")
    (core / "some_helper.py").write_text(
        "from .compiled import inline\nfrom .some_constant import AMOUNT\n\n\n"
        "@inline\ndef added(x):\n    return x + AMOUNT\n"
    )
    (core / "some_kernel.py").write_text(
        "from .compiled import kernel\nfrom .some_helper import added\n\n\n"
        "@kernel(fast=True)\ndef run(x):\n    return added(x)\n"
    )
    return root


RUN = (
    "import logging; logging.basicConfig(format='%(message)s')\n"
    "from gaussian_wrapping_addon.core.some_kernel import run\n"
    "from gaussian_wrapping_addon.core.gaussians.model import mip_filter\n"
    "print(run(1.0), sum(run.stats.cache_hits.values()))\n"
)


@pytest.mark.parametrize(
    "order", first_then_proofs([["losses"], ["one_view", "losses", "fields"]]), ids=len
)
def test_fresh_and_cached_kernels_give_the_same_bits(order: list[str], tmp_path: Path) -> None:
    def run(order: list[str], folder: str) -> subprocess.Popen[str]:
        return start([str(STAGES), *order], ROOT, NUMBA_CACHE_DIR=str(tmp_path / folder))

    both = run(order, "a"), run(order[:0:-1], "b")
    fresh, otherwise = (finish(process)[0].splitlines() for process in both)
    cached = finish(run(order[::-1], "a"))[0].splitlines()
    assert len(fresh) == len(order), "kernels left functions that others could call"
    assert cached == fresh[::-1]
    assert otherwise == fresh[:0:-1]


def test_no_kernel_calls_a_kernel() -> None:
    """It would round differently when loaded from the cache (``compiled.part``)."""
    calls: dict[tuple[Path, str], set[str]] = {}
    kernels: set[tuple[Path, str]] = set()
    own: dict[Path, set[str]] = {}
    for path in sorted((PACKAGE / "core").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef):
                continue
            marks = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
            names = {mark.id for mark in marks if isinstance(mark, ast.Name)}
            own.setdefault(path, set()).add(node.name)
            if "kernel" in names:
                kernels.add((path, node.name))
            if names & {"kernel", "part", "inline"}:
                calls[path, node.name] = {
                    inner.func.id
                    for inner in ast.walk(node)
                    if isinstance(inner, ast.Call) and isinstance(inner.func, ast.Name)
                }
    assert len(kernels) > 40
    anywhere = {name for _, name in kernels}
    wrong = [
        f"{path.name}: {caller} calls {name}"
        for (path, caller), names in calls.items()
        for name in names & anywhere
        if (path, name) in kernels or name not in own[path]
    ]
    assert wrong == []


def test_a_change_in_an_imported_file_is_compiled(installed: Path) -> None:
    def value() -> str:
        return finish(start(["-c", RUN], installed))[0]

    assert value() == "2.0 0\n"
    assert value() == "2.0 1\n"
    # Another length: Python tells its own .pyc files apart by whole seconds and length only.
    (installed / PACKAGE.name / "core" / "some_constant.py").write_text("AMOUNT = 5.0  # new\n")
    assert value() == "6.0 0\n"
    assert value() == "6.0 1\n"
    # Another file that the kernel does not import changes nothing.
    (installed / PACKAGE.name / "core" / "limits.py").touch()
    with (installed / PACKAGE.name / "core" / "settings" / "job.py").open("a") as file:
        file.write("\n")
    assert value() == "6.0 1\n"


def test_imports_are_followed_however_they_are_written() -> None:
    core = PACKAGE / "core"
    found = compiled._imported(core / "render" / "projection_kernels.py")
    assert core / "limits.py" in found  # from .. import limits
    assert core / "compiled.py" in found  # from ..compiled import inline, kernel
    found = compiled._imported(core / "render" / "raster.py")
    assert core / "render" / "simd.py" in found  # names in brackets, over many lines
    found = compiled._imported(core / "jobs" / "stages" / "training.py")
    assert core / "training" / "trainer.py" in found  # within a function
    assert all(path.is_file() for path in found)


def block_caches(package: Path) -> None:
    """A plain file where a folder is wanted stops everybody, the administrator too."""
    for folder in [package, *(p for p in package.rglob("*") if p.is_dir())]:
        (folder / "__pycache__").touch()


@pytest.mark.proof
def test_without_any_place_kernels_work_and_one_line_says_so(installed: Path) -> None:
    block_caches(installed / PACKAGE.name)
    environment = {"HOME": NOWHERE, "XDG_CACHE_HOME": NOWHERE, "LOCALAPPDATA": NOWHERE}
    for _ in range(2):
        output, errors = finish(start(["-c", RUN], installed, **environment))
        assert output == "2.0 0\n"
        assert errors.count("\n") == 1
        assert "NUMBA_CACHE_DIR" in errors
    chosen = installed.parent / "chosen"
    for hits in (0, 1):
        finished = start(["-c", RUN], installed, NUMBA_CACHE_DIR=str(chosen), **environment)
        assert finish(finished) == (f"2.0 {hits}\n", "")
    assert list(chosen.rglob("some_kernel.run-*.nbc"))


def test_a_read_only_package_without_a_home(installed: Path) -> None:
    script = "import os; os.environ.pop('HOME', None)\n" + RUN
    environment = {"XDG_CACHE_HOME": NOWHERE, "LOCALAPPDATA": NOWHERE}
    with read_only(installed / PACKAGE.name):
        output, errors = finish(start(["-c", script], installed, **environment))
    assert output == "2.0 0\n"
    assert errors.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in errors


def test_a_disk_that_fills_up_later_stops_nothing(installed: Path) -> None:
    chosen = installed.parent / "chosen"
    lost = f"import shutil; shutil.rmtree({str(chosen)!r}); open({str(chosen)!r}, 'w').close()"
    script = RUN.replace("print(", lost + "\nprint(")
    output, errors = finish(start(["-c", script], installed, NUMBA_CACHE_DIR=str(chosen)))
    assert output == "2.0 0\n"
    assert errors.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in errors


def test_a_damaged_file_is_compiled_anew(installed: Path) -> None:
    chosen = installed.parent / "chosen"
    command = ["-c", RUN]
    assert finish(start(command, installed, NUMBA_CACHE_DIR=str(chosen))) == ("2.0 0\n", "")
    (kept,) = chosen.rglob("some_kernel.run-*.nbc")
    kept.write_bytes(kept.read_bytes()[:50])
    output, errors = finish(start(command, installed, NUMBA_CACHE_DIR=str(chosen)))
    assert output == "2.0 0\n"
    assert errors.count("\n") == 1
    assert finish(start(command, installed, NUMBA_CACHE_DIR=str(chosen))) == ("2.0 1\n", "")
