# SPDX-License-Identifier: GPL-3.0-or-later
"""Run the cases with one version of the add-on: a checkout, a folder of fixed name, a cache.

Both versions run in the same folder, one after the other: names of stage folders depend on absolute
paths of the inputs. What they wrote is moved aside.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from .cases import Case, Step
from .scene import MODIFIED_UNIX_S

BATCH = Path("gaussian_wrapping_addon") / "batch.py"
STEP_LIMIT_S = 900.0
_ARCHIVED = (str(BATCH.parent), "blender_manifest.toml")
_PACKAGES = ("numpy", "torch", "numba", "scipy", "pillow", "xatlas", "pycolmap", "bpy")


class SideError(Exception):
    """A command did not end as it should."""


@contextlib.contextmanager
def locked(cache: Path) -> Iterator[None]:
    """Hold the cache for this process; another one waits."""
    cache.mkdir(parents=True, exist_ok=True)
    with open(cache / "lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"waiting for another comparison in {cache}", flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def commit_of(repository: Path, name: str) -> str:
    """Return the full hash of a commit."""
    command = ["git", "-C", str(repository), "rev-parse", "--verify", f"{name}^{{commit}}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SideError(f"{name} is no commit of {repository}.")
    return done.stdout.strip()


def checkout(repository: Path, commit: str, cache: Path) -> Path:
    """Return a folder with the files of a commit; made once, compiled kernels stay in it."""
    folder = cache / "trees" / commit[:12]
    if not folder.is_dir():
        command = ["git", "-C", str(repository), "archive", commit, *_ARCHIVED]
        data = subprocess.run(command, capture_output=True, check=True).stdout
        half = folder.with_name(f"{folder.name}.half")
        shutil.rmtree(half, ignore_errors=True)
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            archive.extractall(half, filter="data")
        half.rename(folder)
    return folder


def cache_key(commit: str, inputs: Path) -> str:
    """Hash what the results of a version depend on besides its code, and the code's commit."""
    state = hashlib.sha256(f"{commit} {inputs} {sys.version} {os.cpu_count()}".encode())
    for name in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            state.update(f"{name} {version(name)}".encode())
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        named = {line for line in lines if line.startswith(("model name", "flags"))}
        state.update("".join(sorted(named)).encode())
    for path in sorted(p for p in inputs.rglob("*") if p.is_file()):
        state.update(path.relative_to(inputs).as_posix().encode() + path.read_bytes())
    state.update(Path(__file__).with_name("cases.py").read_bytes())
    return state.hexdigest()[:16]


def run_cases(
    tree: Path, cases: Sequence[Case], inputs: Path, run: Path, target: Path
) -> dict[str, float]:
    """Run the cases with the add-on in ``tree``; what they wrote lies in ``target`` by case.

    Parameters
    ----------
    run : Path
        Folder that the commands write into; emptied before.

    Returns
    -------
    dict
        Wall seconds of each case.

    Raises
    ------
    SideError
        A command ended with another code than it should.
    """
    for folder in (run, target):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    seconds = {}
    for case in cases:
        print(f"{tree.name}: {case.name}", flush=True)
        begun_s = time.monotonic()
        said = []
        for step in case.steps:
            said.append(_run_step(tree, case, step, inputs, run))
        seconds[case.name] = time.monotonic() - begun_s
        folder = target / case.folder
        folder.mkdir()
        for name in case.outputs:
            source = run / name
            if source.is_dir():
                shutil.copytree(source, folder / name)
            else:
                shutil.copy2(source, folder / name)
        for number, (step, text) in enumerate(zip(case.steps, said, strict=True)):
            (folder / f"said-{number}.log").write_text(text)
            if step.figures_in:
                lines = [line for line in text.splitlines() if re.search(step.figures_in, line)]
                figures = [re.findall(r"\d[\d .]*", line) for line in lines]
                (folder / f"said-{number}.json").write_text(json.dumps(figures))
    (target / "seconds.json").write_text(json.dumps(seconds))
    return seconds


@functools.cache
def _options(tree: Path, command: str) -> frozenset[str]:
    """Return the options of a command in a tree."""
    done = subprocess.run(
        [sys.executable, str(tree / BATCH), command, "--help"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return frozenset(re.findall(r"--[\w-]+", done.stdout))


def _spelled(tree: Path, words: list[str]) -> list[str]:
    """Return arguments as a tree takes them: ``--set name=value`` where it has no such option."""
    known = _options(tree, words[0])
    if "--set" not in known:
        return words
    spelled, left = [], list(words)
    while left:
        word = left.pop(0)
        if not word.startswith("--") or word in known:
            spelled.append(word)
        else:
            value = left.pop(0) if left and not left[0].startswith("--") else "on"
            spelled += ["--set", f"{word[2:].replace('-', '_')}={value}"]
    return spelled


def _run_step(tree: Path, case: Case, step: Step, inputs: Path, run: Path) -> str:
    """Run one command and return what it said."""
    words = [a.replace("{in}", str(inputs)).replace("{out}", str(run)) for a in step.arguments]
    arguments = _spelled(tree, words)
    if step.start:
        shutil.copyfile(run / step.start, run / "start.ply")
        os.utime(run / "start.ply", (MODIFIED_UNIX_S, MODIFIED_UNIX_S))
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment = {
        **kept, "CUDA_VISIBLE_DEVICES": "", "GAUSSIAN_WRAPPING_DATA": str(run / "user-data"),
    }  # fmt: skip
    with subprocess.Popen(
        [sys.executable, str(tree / BATCH), *arguments],
        cwd=run, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as process:  # fmt: skip
        if step.cancel_in:
            _cancel(process, Path(arguments[arguments.index("--out") + 1]), step.cancel_in)
        said, _ = process.communicate(timeout=STEP_LIMIT_S)
    if process.returncode != step.exit_code:
        command = " ".join(arguments)
        raise SideError(
            f"{tree}: {case.name}: exit code {process.returncode} instead of {step.exit_code}:\n"
            f"{command}\n{said[-3000:]}"
        )
    return said


def _cancel(process: subprocess.Popen[str], job: Path, stage: str) -> None:
    """Ask a job to stop once its stage counts iterations, as its Cancel button does."""
    while process.poll() is None:
        time.sleep(0.01)
        try:
            status = json.loads((job / "status.json").read_text())
        except (OSError, ValueError):
            continue
        if status.get("stage") == stage and status.get("figures", {}).get("iteration"):
            (job / "cancel").touch()
            return
