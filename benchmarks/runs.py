# SPDX-License-Identifier: GPL-3.0-or-later
"""Run jobs through the command line, as a user would, and keep what they measured."""

from __future__ import annotations

import dataclasses
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.settings import JobSettings, declarations

from .provenance import ROOT, code_of_tree

PRESETS = ("draft", "standard", "fine")
THRESHOLD_SHARES = (0.0025, 0.005, 0.01)
"""Thresholds of precision, recall and F1, as shares of the crop volume's diagonal."""


@dataclasses.dataclass(frozen=True)
class Photos:
    """How a scene is photographed."""

    count: int
    width: int
    height: int


@dataclasses.dataclass(frozen=True)
class Run:
    """One job through the command line."""

    scene: str
    preset: str
    seed: int = 0
    name: str = ""
    """What is varied, empty for the plain preset."""
    arguments: tuple[str, ...] = ()
    parameter: int = 0

    @property
    def identity(self) -> str:
        """Folder name."""
        parts = [self.scene, self.preset, f"seed{self.seed}"]
        if self.name:
            parts.append(f"{self.name}{self.parameter}")
        return "-".join(parts)


BATCH = ROOT / "gaussian_wrapping_addon" / "batch.py"
LAST_LINES = 12


@dataclasses.dataclass(frozen=True)
class Settings:
    """How runs are made."""

    folder: Path
    """Where runs are kept."""
    threads: int
    reuse: bool
    """Keep finished runs of the same name; whoever sets it answers for the code being the same."""


def run_wrap(run: Run, scene: Path, settings: Settings) -> Path:
    """Wrap a scene and return the run's folder, which holds ``out/`` and ``measured.json``.

    The region is that of the scene's ``region.json``, or the automatic one where it has none.

    Raises
    ------
    WorkerError
        With the last lines of the job's output.
    """
    folder = settings.folder / run.identity
    if settings.reuse and (folder / "measured.json").is_file():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    arguments = [
        "wrap", str(scene), "--out", str(folder / "out"), "--preset", run.preset,
        "--seed", str(run.seed), *_region(scene), *with_set(run.arguments),
    ]  # fmt: skip
    _batch(arguments, folder, settings)
    return folder


def warm_up(scene: Path, settings: Settings, more: tuple[str, ...] = ()) -> None:
    """Wrap a scene in a minute and forget it, so that no measured run compiles kernels.

    ``more`` arguments switch on what the measured runs use. Several may warm up at a time.
    """
    arguments = ("--iterations", "400", "--max-gaussians", "8000", *more)
    run = Run(scene.name, "draft", 0, "warm-up", arguments)
    settings.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="warm-up-", dir=settings.folder) as folder:
        run_wrap(run, scene, dataclasses.replace(settings, folder=Path(folder)))


def with_set(words: Sequence[str]) -> list[str]:
    """Return arguments with ``--set name=value`` for options that name another setting.

    Runs and records name every setting by an option, ``--dense-start off``.
    """
    others = {}
    for entry in declarations(JobSettings):
        if entry.option is not None and not entry.option.own:
            others[entry.option.name] = entry.option
    left = list(words)
    spelled = []
    while left:
        word = left.pop(0)
        option = others.get(word)
        if option is None or (not option.flag and (not left or left[0].startswith("--"))):
            spelled.append(word)
        else:
            spelled += ["--set", f"{option.word}={option.flag or left.pop(0)}"]
    return spelled


def _batch(arguments: list[str], folder: Path, settings: Settings) -> None:
    """Run the command and keep its result (without the Gaussians) and its wall time."""
    out = folder / "out"
    command = [
        sys.executable, str(BATCH), *arguments, "--export", "ply", "--no-blend",
        "--threads", str(settings.threads),
    ]  # fmt: skip
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    begun_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall_s = time.monotonic() - begun_s
    if done.returncode != 0:
        words = "\n".join((done.stdout + done.stderr).splitlines()[-LAST_LINES:])
        raise WorkerError(f"A run failed with exit code {done.returncode}: {words}", f"See {out}.")
    report = read_json(out / "result" / "report.json")
    (name,) = _region_names(out)
    result = folder / "mesh"
    shutil.copytree(out / "result" / name, result)
    values = {
        "command": ["batch.py", *_without_paths(arguments)],
        "wall_s": wall_s,
        "load_before": load,
        "code": code_state(),
        "report": report,
    }
    write_json(folder / "measured.json", {**values, "region": name})


def code_state() -> str:
    """Return the commit, and whether files of the core differ from it."""
    code = code_of_tree()
    return f"{code.commit} with changes" if code.changed else code.commit


def _region(scene: Path) -> list[str]:
    path = scene / "region.json"
    return ["--region", str(path)] if path.is_file() else []


def _region_names(out: Path) -> list[str]:
    return sorted(path.parent.name for path in (out / "result").glob("*/mesh.npz"))


def _without_paths(arguments: list[str]) -> list[str]:
    """Return the arguments with folders' names only, for the record."""
    return [Path(a).name if "/" in a or "\\" in a else a for a in arguments]


def measured(folder: Path) -> dict[str, Any]:
    """Return what a run measured of itself."""
    return dict(read_json(folder / "measured.json"))


def judged_by(module: str, arguments: list[str], path: Path, settings: Settings) -> dict[str, Any]:
    """Run a module in a process of its own, and read the JSON that it writes.

    Parameters
    ----------
    module : str
        Full name.
    arguments : list of str
        Its command line, without the threads.
    path : Path
        The file that it writes; kept from before where the settings allow it.

    Raises
    ------
    WorkerError
        With the last lines of its output.
    """
    if not (settings.reuse and path.is_file()):
        command = [sys.executable, "-m", module, *arguments, "--threads", str(settings.threads)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
        if done.returncode != 0:
            words = "\n".join((done.stdout + done.stderr).splitlines()[-LAST_LINES:])
            raise WorkerError(f"{module} {' '.join(arguments)} failed: {words}")
    return dict(read_json(path))


def first_line(text: str) -> str:
    """Return the line of a job's output that names the error, or the last one."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    named = [line for line in lines if "error" in line.lower()]
    return (named or lines or ["no words"])[-1]
