# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``gaussian-wrapping`` command: declared, importable, and complete in the wheel."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAME = "gaussian-wrapping"


@pytest.fixture(scope="module")
def entry() -> tuple[str, str]:
    """Module and function of the command."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    module, _, function = project["scripts"][NAME].partition(":")
    return module, function


def run_entry(
    entry: tuple[str, str], *arguments: str, place: Path = ROOT, prelude: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run the command as an installer's script does, with the package that lies in ``place``."""
    module, function = entry
    text = f"import sys\n{prelude}\nfrom {module} import {function}\nsys.exit({function}())"
    return subprocess.run(
        [sys.executable, "-P", "-c", text, *arguments],
        env={**os.environ, "PYTHONPATH": str(place)},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


def test_it_calls_the_main_of_batch(
    entry: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = importlib.import_module(entry[0])
    assert module.__name__ == "gaussian_wrapping_addon.batch"
    seen: list[object] = []
    monkeypatch.setattr(module, "main", lambda *given: seen.extend(given) or 4)
    monkeypatch.setattr(sys, "argv", [NAME, "resume", "job"])
    assert getattr(module, entry[1])() == 4
    assert seen == [["resume", "job"], NAME]


def test_help_and_usage_errors_call_it_by_its_name(entry: tuple[str, str]) -> None:
    asked = run_entry(entry, "--help")
    assert asked.returncode == 0, asked.stderr
    assert asked.stdout.startswith(f"usage: {NAME} ")
    wrong = run_entry(entry, "no-such-command")
    assert wrong.returncode == 2
    assert f"{NAME} [-h]" in wrong.stdout + wrong.stderr


def test_a_python_without_numpy_is_told_what_to_use(entry: tuple[str, str]) -> None:
    lacking = run_entry(entry, "check", "photos", prelude="sys.modules['numpy'] = None")
    assert lacking.returncode == 1
    assert "This Python lacks numpy" in lacking.stdout
    assert lacking.stdout.rstrip().endswith("Use another Python: that of Blender, or of the worker")


def test_a_python_without_numpy_can_set_up_the_worker(
    entry: tuple[str, str], tmp_path: Path
) -> None:
    """Only the worker needs packages: any Python makes it."""
    command = ("set-up-worker", "--dry-run", "--to", str(tmp_path / "worker"))
    shown = run_entry(entry, *command, prelude="sys.modules['numpy'] = None")
    assert shown.returncode == 0, shown.stdout + shown.stderr
    assert "-m pip install" in shown.stdout
    assert not (tmp_path / "worker").exists()


def test_the_wheel_is_complete(entry: tuple[str, str], tmp_path: Path) -> None:
    """Built without isolation, as there may be no network; unpacked, it finds its own files."""
    source = tmp_path / "source"
    package = "gaussian_wrapping_addon"
    unneeded = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / package, source / package, ignore=unneeded)
    extras = sorted(p.name for p in ROOT.glob("requirements-worker-*-hashes.txt"))
    lists = ("requirements-worker.txt", "requirements-worker-hashes.txt", *extras)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", *lists):
        shutil.copy(ROOT / name, source)
    built = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet",
         "--wheel-dir", str(tmp_path), str(source)],
        capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        for name in lists:
            assert archive.read(f"{package}/{name}") == (ROOT / name).read_bytes()
        data = [p for p in (ROOT / package).rglob("*") if p.suffix in (".js", ".json", ".cu")]
        assert len(data) >= 3
        assert {p.relative_to(ROOT).as_posix() for p in data} <= set(archive.namelist())
        scripts = next(n for n in archive.namelist() if n.endswith("entry_points.txt"))
        assert f"{NAME} = {':'.join(entry)}" in archive.read(scripts).decode()
        archive.extractall(tmp_path / "site")
    checked = run_entry(
        entry, "set-up-worker", "--dry-run", "--python", sys.executable,
        "--to", str(tmp_path / "worker"), place=tmp_path / "site",
    )  # fmt: skip
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert f"--require-hashes -r {tmp_path / 'site' / package / lists[1]}" in checked.stdout
