# SPDX-License-Identifier: GPL-3.0-or-later
"""Walk through the steps of a comparison, each in a process of its own, blocks two at a time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import write_json

from .comparison import COARSE, JOINED, MESH, WHOLE, Comparison

SLOTS = 2
"""Processes at a time, and threads of a step that runs alone."""
WALLS = "walls.json"


class StepFailed(Exception):  # noqa: N818 - says which
    """A step ended with an error."""


def walk(
    comparison: Comparison,
    command: Sequence[str],
    meshes: Sequence[str],
    say: Callable[[str], object],
) -> None:
    """Run all steps that have no figures yet.

    Parameters
    ----------
    command : sequence of str
        Words after the interpreter's that reach this comparison, without its step.
    meshes : sequence of str
        Steps whose Gaussians are meshed.

    Raises
    ------
    StepFailed
    """
    stages = [[WHOLE], [COARSE], comparison.block_names, [JOINED]]
    stages += [[f"{MESH}{name}"] for name in meshes]
    for names in stages:
        left = [name for name in names if not comparison.figures_path(name).is_file()]
        if not left:
            continue
        threads = SLOTS if len(names) == 1 else 1
        before, begun_s = _busy_s(), time.perf_counter()
        _run(command, left, threads, say)
        wall_s, after = time.perf_counter() - begun_s, _busy_s()
        if left == names:
            busy_s = None if before is None or after is None else round(after - before, 1)
            folder = comparison.figures_path(names[0]).parent
            write_json(folder / WALLS, {"wall_s": round(wall_s, 1), "machine_s": busy_s})


def _run(
    command: Sequence[str], names: Sequence[str], threads: int, say: Callable[[str], object]
) -> None:
    """Run steps, as many at a time as there are slots."""
    waiting, running = list(names), dict[str, subprocess.Popen[bytes]]()
    try:
        while waiting or running:
            while waiting and len(running) < SLOTS:
                name = waiting.pop(0)
                words = [*command, "--step", name, "--threads", str(threads)]
                running[name] = subprocess.Popen([sys.executable, "-m", *words])
                say(f"{name} begins")
            time.sleep(0.2)
            for name, child in list(running.items()):
                code = child.poll()
                if code is not None:
                    del running[name]
                    say(f"{name} ended with exit code {code}")
                    if code:
                        raise StepFailed(name)
    finally:
        for child in running.values():
            child.terminate()
            child.wait()


def _busy_s() -> float | None:
    """Return the processor seconds that all programs of the machine used since it started."""
    try:
        words = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()
        used = [int(words[k]) for k in (1, 2, 3, 6, 7)]  # user, nice, system, interrupts
        return sum(used) / float(os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError, AttributeError):
        return None
