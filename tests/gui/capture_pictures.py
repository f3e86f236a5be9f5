# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the guide's pictures of captures: inputs, a real Blender (``drive_captures.py``), crops.

``BLENDER=... python -m tests.gui.capture_pictures --job DIR [--keep DIR]``: ``--job`` is a finished
job of the flowerpot with made masks. Findings are those of the real worker on photos that are
spoiled here on purpose; the worker is kept from seeing its HEIC package.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageFilter

from tests.core.jobs.parts.job_parts import graph, job_folder, write_state
from tests.core.photos import small_videos
from tests.core.readers.model_writers import ring_model, write_binary
from tests.gui.conftest import ADDON, HERE, REPOSITORY, with_window

PICTURES = REPOSITORY / "docs" / "images"
GAP_PX = 12
TABS_PX = 26
CLOSED_PX = 28
"""Height of a closed sub-panel."""
MENU_AT = (420, 604, 710, 716)
"""Of a menu in the middle of the view: left, upper, right, lower edge in the screenshot."""
COLORS = 64
BACKGROUND = (24, 24, 24)
SCALE = 10
_HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"
_WITHOUT_HEIC = """import runpy, sys
arguments = sys.argv[1:]
while arguments[0].startswith("-"):
    option = arguments.pop(0)
    if option == "-X":
        name, _, value = arguments.pop(0).partition("=")
        sys._xoptions[name] = value or True
sys.modules["pillow_heif"] = None
sys.argv = arguments
runpy.run_path(arguments[0], run_name="__main__")
"""
"""A Python that takes the options of the worker's, and lacks a package."""
START_Y = 560
"""Where the settings of the start begin in the picture of *Advanced*."""
VISITS = ("dataset", "training", "masks", "languages", "computers")


def write_inputs(folder: Path, job: Path) -> None:
    """Write a video, photos of a phone, photos with cameras, and a copy of the job."""
    bananas = REPOSITORY / "examples" / "bananas"
    shutil.copytree(bananas, folder / "bananas")
    small_videos.write(folder / "clip.mp4", small_videos.pan(range(0, 1200, 4)))
    phone = folder / "phone"
    phone.mkdir()
    for number, path in enumerate(sorted(bananas.glob("*.JPG"))):
        photo = Image.open(path).convert("RGB")
        photo.thumbnail((1200, 1200))
        if number == 4:
            photo = photo.filter(ImageFilter.GaussianBlur(6))
        if number == 9:
            photo = photo.point([round(255 * (v / 255) ** 2.6) for v in range(256)] * 3)
        photo.save(phone / f"IMG_{2101 + number}.jpg", quality=92)
    shutil.copy(phone / "IMG_2107.jpg", phone / "IMG_2107 copy.jpg")
    heic = folder / "heic"
    shutil.copytree(bananas, heic)
    for number in (2141, 2142):  # what such files begin with: nothing else is read of them
        (heic / f"IMG_{number}.HEIC").write_bytes(_HEIC + bytes(64))
    posed = ring_model(14, points=600)
    posed.cameras = [
        (number, kind, SCALE * width, SCALE * height, [SCALE * value for value in lens])
        for number, kind, width, height, lens in posed.cameras
    ]
    _, _, width, height, _ = posed.cameras[0]
    (folder / "posed" / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for number, image in enumerate(posed.images):
        image.name = f"IMG_{3001 + number}.png"
        if number == 6:
            image.translation = -image.translation  # looks away from the others
        pixels = Image.fromarray(rng.integers(0, 255, (height // 8, width // 8, 3), np.uint8))
        pixels.resize((width, height)).save(folder / "posed" / "images" / image.name)
    write_binary(posed, folder / "posed" / "sparse" / "0")
    target = folder / "pot_wrap"
    shutil.copytree(job, target)
    listed = json.loads((target / "masks" / "masks.json").read_text())
    (target / "photos").mkdir()
    for entry in listed["masks"]:
        shutil.copy(entry["image"], target / "photos")
        entry["image"] = f"photos/{Path(entry['image']).name}"
    (target / "masks" / "masks.json").write_text(json.dumps(listed))


def write_farm_job(folder: Path) -> None:
    """Write a job whose parts run on several computers, and photos to choose."""
    if not (folder / "bananas").exists():
        shutil.copytree(REPOSITORY / "examples" / "bananas", folder / "bananas")
    root = job_folder(folder / "castle_wrap", graph({"castle": 12})).root
    now_s = time.time() + 600.0  # none of them is silent while the pictures are made
    for name in ("cameras", "train", "plan-castle", "gather-castle"):
        write_state(root, name, "DONE", place="workshop")
    for tile in range(12):
        write_state(root, f"points-castle-{tile:04d}", "DONE", place="workshop")
        name = f"faces-castle-{tile:04d}"
        if tile < 5:
            write_state(root, name, "DONE", place="attic")
        elif tile < 8:
            write_state(root, name, "RUNNING", place="attic", heartbeat_s=now_s)
    write_state(
        root, "faces-castle-0008", "FAILED", place="laptop", error="Not enough memory.",
        hint="Close other programs, or choose a smaller preset.",
    )  # fmt: skip


def visit(
    folder: Path, blender: str, visits: Sequence[str]
) -> dict[str, tuple[int, int, int, int]]:
    """Let a real Blender with a clean profile take its screenshots; return where the panels are."""
    worker = folder / "worker" / "python"
    worker.parent.mkdir()
    (worker.parent / "without.py").write_text(_WITHOUT_HEIC)
    python = f'"{sys.executable}" -I -u "{worker.parent / "without.py"}"'
    worker.write_text(f'#!/bin/sh\nexec {python} "$@"\n')
    worker.chmod(0o755)
    environment = {
        **os.environ,
        "BLENDER_USER_RESOURCES": str(folder / "profile"),
        "GW_GUI_FOLDER": str(folder),
        "GW_BIND": f"{os.path.realpath(sys.prefix)}:{REPOSITORY}",
        "GW_GEOMETRY": "1400x1300",
        "GAUSSIAN_WRAPPING_PYTHON": str(worker),
    }
    zipped = folder / "zip"
    run = {"env": environment, "cwd": REPOSITORY, "check": True}
    subprocess.run([sys.executable, "build_addon.py", "--output", str(zipped)], **run)
    (archive,) = zipped.glob(f"{ADDON}*.zip")
    install = [blender, "--command", "extension", "install-file", "-r", "user_default", "-e"]
    subprocess.run([*install, str(archive)], **run)
    places = {}
    for name in visits:
        command = [*with_window(blender), "-P", str(HERE / "drive_captures.py")]
        subprocess.run(command, timeout=400, **{**run, "env": {**environment, "GW_PICTURE": name}})
        outcome = json.loads((folder / "outcome.json").read_text())
        if outcome["error"]:
            raise SystemExit(outcome["error"])
        places |= json.loads((folder / f"places-{name}.json").read_text())
    return places


def panel(
    folder: Path, name: str, at: tuple[int, int, int, int], above: int = 0, below: int = 0
) -> Image.Image:
    """Return the side panel of a screenshot, less closed sub-panels ``above`` and ``below``."""
    x, y, width, height = at
    screen = Image.open(folder / f"{name}.png").convert("RGB")
    found = screen.crop((x, y, x + width, y + height))
    inside = np.asarray(found).astype(int)[:, 10 : width - 60]
    rows = np.flatnonzero(np.ptp(inside, axis=1).max(1) > 60)
    end = min(height, int(rows.max()) + 14) - below * CLOSED_PX
    return found.crop((0, above * CLOSED_PX, width - TABS_PX, end))


def above_each_other(pictures: list[Image.Image]) -> Image.Image:
    """Return pictures above each other, aligned at the left."""
    turned = [p.transpose(Image.Transpose.TRANSPOSE) for p in pictures]
    return beside(turned).transpose(Image.Transpose.TRANSPOSE)


def beside(pictures: list[Image.Image]) -> Image.Image:
    """Return pictures beside each other, their tops aligned."""
    width = sum(p.width for p in pictures) + GAP_PX * (len(pictures) - 1)
    sheet = Image.new("RGB", (width, max(p.height for p in pictures)), BACKGROUND)
    x = 0
    for picture in pictures:
        sheet.paste(picture, (x, 0))
        x += picture.width + GAP_PX
    return sheet


def main() -> None:
    """Make the pictures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--job", type=Path, help="needed by all visits but computers")
    parser.add_argument("--only", nargs="+", choices=VISITS, default=VISITS, metavar="VISIT")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="captures") as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if set(options.only) - {"computers"}:
            write_inputs(folder, options.job)
        write_farm_job(folder)
        places = visit(folder, os.environ["BLENDER"], options.only)
        write_pictures(folder, places, PICTURES)


def write_pictures(
    folder: Path, places: dict[str, tuple[int, int, int, int]], target: Path
) -> None:
    """Compose the pictures from the screenshots."""

    def of(name: str, above: int = 0, below: int = 0) -> Image.Image:
        return panel(folder, name, places[name], above, below)

    if "dask" in places:
        sheet = of("dask", 2, 6)
        palette = sheet.quantize(COLORS, dither=Image.Dither.NONE)
        palette.save(target / "panel-computers.png", optimize=True)
    if "review" not in places:
        return
    menu = Image.open(folder / "menu.png").convert("RGB").crop(MENU_AT)
    inputs = [of(f"dataset-{name}", 0, 8) for name in ("clip.mp4", "heic", "phone", "posed")]
    advanced = of("advanced", 1, 7)
    upper = advanced.crop((0, 0, advanced.width, START_Y))
    lower = advanced.crop((0, START_Y, advanced.width, advanced.height))
    sheets = {
        "panel-inputs": beside([above_each_other([inputs[0], inputs[3]]), *inputs[1:3]]),
        "panel-advanced": beside([upper, above_each_other([lower, menu])]),
        "panel-masks": of("review", 2, 7),
        "panel-languages": beside([of("de_DE", 0, 5), of("ja_JP", 0, 5)]),
        "guide-dataset": of("en_US", 0, 5),
    }
    for name, sheet in sheets.items():
        colors = 255 if name == "panel-masks" else COLORS
        palette = sheet.quantize(colors, dither=Image.Dither.NONE)
        palette.save(target / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
