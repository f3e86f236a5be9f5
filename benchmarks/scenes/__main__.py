# SPDX-License-Identifier: GPL-3.0-or-later
"""Render ground-truth scenes: ``python -m benchmarks.scenes NAME|all``."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from gaussian_wrapping_addon.core.errors import WrapError

from .build import CUP_INSIDE, TORUS, BuildSize, build_cup_inside, build_scene, build_torus
from .cache import ALL_KINDS, REPOSITORY, ensure_scene, write_contact_sheet
from .catalogue import KINDS, scene_kind

SHEET = REPOSITORY / "docs" / "images" / "scenes.jpg"

_OWN = {CUP_INSIDE.name: build_cup_inside, TORUS.name: build_torus}
"""What builds the scenes that have modules of their own."""


def _arguments(given: list[str]) -> argparse.Namespace:
    size = BuildSize()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scenes", description=__doc__)
    parser.add_argument(
        "name", nargs="?", default="all", help=f"all, or one of {', '.join(ALL_KINDS)}"
    )
    parser.add_argument("--out", type=Path, help="where scenes are kept (default .cache/scenes)")
    parser.add_argument("--photos", type=int, default=size.photos)
    parser.add_argument("--test-views", type=int, default=size.test_views)
    parser.add_argument("--width", type=int, default=size.width, help="pixels")
    parser.add_argument("--height", type=int, default=size.height, help="pixels")
    parser.add_argument("--sheet", action="store_true", help=f"write {SHEET.name} of all scenes")
    # For the child process that holds Blender's state:
    parser.add_argument("--build-into", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--base", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args(given)


def main(given: list[str] | None = None) -> int:
    """Run the command line, return the exit code."""
    options = _arguments(sys.argv[1:] if given is None else given)
    try:
        if options.build_into is not None:
            size = BuildSize(options.photos, options.test_views, options.width, options.height)
            if options.name in _OWN:
                _OWN[options.name](size, options.build_into)
            else:
                build_scene(scene_kind(options.name), size, options.build_into, options.base)
            return 0
        names = [options.name]
        if options.sheet or options.name == "all":
            names = list(KINDS if options.sheet else ALL_KINDS)
        folders = []
        for name in names:
            begin_s = time.perf_counter()
            folders.append(
                ensure_scene(
                    name,
                    options.out,
                    photos=options.photos,
                    width=options.width,
                    height=options.height,
                    test_views=options.test_views,
                )
            )
            print(f"{name}: {time.perf_counter() - begin_s:.1f} s, {folders[-1]}", flush=True)
        if options.sheet:
            write_contact_sheet(folders, SHEET)
            print(SHEET)
    except WrapError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
