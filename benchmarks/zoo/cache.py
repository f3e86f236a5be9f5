# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes of the zoo are rendered on first use, each in a process of its own, and kept."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import uuid
from pathlib import Path

from gaussian_wrapping_addon.core.errors import WorkerError

from ..scenes.cache import CACHE, REPOSITORY
from .catalogue import zoo_scene

_PACKAGE = Path(__file__).parent

_DECIDING = (
    "build", "catalogue", "content", "looks", "paths", "places", "points", "rendering", "shapes",
    "surroundings", "things",
)  # fmt: skip
"""Modules of this package that a scene folder's content depends on."""
_DECIDING_SCENES = (
    "colmap_project", "exposure", "geometry", "ground_truth", "nodes", "rendering",
    "sparse_points", "viewpoints", "visibility",
)  # fmt: skip
"""Modules of :mod:`benchmarks.scenes` besides."""

_OF_FAMILIES = {
    "things": lambda family: family not in ("rooms", "streets"),
    "places": lambda family: family in ("rooms", "streets"),
}
"""Modules that decide some families only."""

_LAST_WORDS = 1500


def scene_folder(name: str, root: Path | None = None) -> Path:
    """Return where a scene is kept; its hash covers the sources that decide its content."""
    family = zoo_scene(name).family
    digest = hashlib.sha256(name.encode())
    sources = [
        _PACKAGE / f"{module}.py"
        for module in _DECIDING
        if module not in _OF_FAMILIES or _OF_FAMILIES[module](family)
    ]
    sources += [_PACKAGE.parent / "scenes" / f"{module}.py" for module in _DECIDING_SCENES]
    for path in sources:
        # Line ends differ between checkouts and change nothing.
        digest.update(path.name.encode() + path.read_bytes().replace(b"\r\n", b"\n"))
    return (root or CACHE) / f"zoo-{name}-{digest.hexdigest()[:12]}"


def ensure_zoo_scene(name: str, threads: int = 1, root: Path | None = None) -> Path:
    """Return the folder of a scene; render it first where it does not exist yet.

    Parameters
    ----------
    root : Path or None
        Where scenes are kept, ``.cache/scenes`` of the repository by default.

    Raises
    ------
    UsageError
        There is no such scene.
    WorkerError
        The rendering process failed; carries its last words.
    """
    target = scene_folder(name, root)
    if target.is_dir():
        return target
    partial = target.with_name(f"{target.name}.rendering.{uuid.uuid4().hex[:8]}")
    partial.mkdir(parents=True)
    try:
        command = [sys.executable, "-m", "benchmarks.zoo", "--build", name]
        command += ["--into", str(partial.resolve()), "--threads", str(threads)]
        done = subprocess.run(
            command, cwd=REPOSITORY, capture_output=True, text=True, errors="replace", check=False
        )
        if done.returncode != 0:
            raise WorkerError(
                f"Rendering scene {name!r} failed with exit code {done.returncode}: "
                f"{(done.stdout + done.stderr)[-_LAST_WORDS:]}",
                f"Run it alone to see more: python -m benchmarks.zoo --render --only {name}.",
            )
        try:
            os.rename(partial, target)
        except OSError:
            if not target.is_dir():  # else another process was first: the same scene
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target
