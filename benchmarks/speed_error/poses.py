# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras solved from a scene's photos alone, against the exact ones."""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.evaluation.alignment.pose_error import pose_errors
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.progress import Progress


def solve(scene: Path, folder: Path, threads: int) -> dict[str, Any]:
    """Solve the cameras of a scene's photos and return their errors and the seconds it took.

    The photos are copied first: beside their model they would be read with it.
    """
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "exact").mkdir(parents=True)
    shutil.copytree(scene / "images", folder / "photos")
    begun_s = time.monotonic()
    solved = load_scene(folder / "photos", folder, Progress(), seed=0, threads=threads)
    seconds = time.monotonic() - begun_s
    exact = load_scene(scene, folder / "exact", Progress(), seed=0, threads=threads)
    errors = pose_errors(
        [camera.moved(solved.world_from_scene) for camera in solved.cameras],
        [camera.moved(exact.world_from_scene) for camera in exact.cameras],
    )
    return {
        "seconds": seconds,
        "photos": len(exact.cameras),
        "solved": len(solved.cameras),
        "errors": errors.to_json(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Write ``poses.json`` into the folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args(arguments)
    found = solve(options.scene, options.folder, options.threads)
    write_json(options.folder / "poses.json", found)


if __name__ == "__main__":
    main()
