# SPDX-License-Identifier: GPL-3.0-or-later
"""One picture of all scenes, two photos each."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import uuid
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from PIL import Image, ImageDraw

from gaussian_wrapping_addon.core.errors import ResourceError, WorkerError

from .build import CUP_INSIDE, TORUS, BuildSize
from .catalogue import KINDS, MESHES, SceneKind, scene_kind
from .rendering import require_bpy

REPOSITORY = Path(__file__).resolve().parents[2]
CACHE = REPOSITORY / ".cache" / "scenes"

DRAWN = 1
"""Raised whenever a scene comes out otherwise."""

ALL_KINDS = {**KINDS, CUP_INSIDE.name: CUP_INSIDE, TORUS.name: TORUS}
"""Every scene that can be rendered."""

_LAST_WORDS = 1500


def kind_named(name: str) -> SceneKind:
    """Return the scene of this name among all.

    Raises
    ------
    UsageError
        There is none.
    """
    return ALL_KINDS[name] if name in ALL_KINDS else scene_kind(name)


def scene_folder(name: str, size: BuildSize, root: Path | None = None) -> Path:
    """Return where a scene of this size is kept; its hash covers description, meshes and size."""
    kind = kind_named(name)
    digest = hashlib.sha256(
        json.dumps([DRAWN, asdict(kind), asdict(size)], sort_keys=True).encode()
    )
    meshes = sorted(p for p in MESHES.iterdir() if p.suffix != ".md")
    for path in meshes:
        # Line ends differ between checkouts and change nothing.
        digest.update(path.name.encode() + path.read_bytes().replace(b"\r\n", b"\n"))
    return (root or CACHE) / f"{name}-{digest.hexdigest()[:12]}"


def ensure_scene(
    name: str,
    folder: Path | None = None,
    *,
    photos: int = 40,
    width: int = 640,
    height: int = 480,
    test_views: int = 8,
) -> Path:
    """Return the folder of a scene; render it first where it does not exist yet.

    Parameters
    ----------
    folder : Path or None
        Where scenes are kept, ``.cache/scenes`` of the repository by default.
    photos, test_views : int
        Training photos, and views for tests that are never given to the pipeline.
    width, height : int
        Pixels.

    Raises
    ------
    UsageError
        There is no such scene.
    ResourceError
        It must be rendered, and bpy, trimesh or embreex is missing.
    WorkerError
        The rendering process failed; carries its last words.
    """
    size = BuildSize(photos, test_views, width, height)
    target = scene_folder(name, size, folder)
    if target.is_dir():
        return target
    kind = kind_named(name)
    if importlib.util.find_spec("bpy") is None:
        require_bpy()  # raises with the way to get it
    for module in ("trimesh", "embreex"):
        if importlib.util.find_spec(module) is None:
            raise ResourceError(
                f"Ground truth needs the module {module}, which is missing.",
                f"Install it: pip install {module}.",
            )
    base = None
    if kind.derived_from:
        base = ensure_scene(
            kind.derived_from, folder, photos=photos, width=width, height=height,
            test_views=test_views,
        )  # fmt: skip
    partial = target.with_name(f"{target.name}.rendering.{uuid.uuid4().hex[:8]}")
    partial.mkdir(parents=True)
    try:
        _build_in_child(name, size, partial, base)
        try:
            os.rename(partial, target)
        except OSError:
            if not target.is_dir():  # else another process was first: the same scene
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def _build_in_child(name: str, size: BuildSize, folder: Path, base: Path | None) -> None:
    command = [
        sys.executable,
        "-m",
        "benchmarks.scenes",
        name,
        "--build-into",
        str(folder.resolve()),
    ]
    command += ["--photos", str(size.photos), "--test-views", str(size.test_views)]
    command += ["--width", str(size.width), "--height", str(size.height)]
    if base is not None:
        command += ["--base", str(base.resolve())]
    done = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode != 0:
        lines = (done.stdout + done.stderr)[-_LAST_WORDS:]
        raise WorkerError(
            f"Rendering scene {name!r} failed with exit code {done.returncode}: {lines}",
            f"Run it alone to see more: python -m benchmarks.scenes {name}.",
        )


_CELL = (320, 240)
_CAPTION_PX = 16
_SHARES = (0.26, 0.34)
"""Which two of a scene's photos are shown: these shares of the way through them."""


def write_contact_sheet(folders: Sequence[Path], path: Path) -> None:
    """Write a JPEG with two scenes a row, captioned by the folders' scene names."""
    width, height = _CELL[0], _CELL[1] + _CAPTION_PX
    rows = -(-len(folders) // 2)
    sheet = Image.new("RGB", (4 * width, rows * height), "white")
    draw = ImageDraw.Draw(sheet)
    for index, folder in enumerate(folders):
        photos = sorted((folder / "images").iterdir())
        x, y = (index % 2) * 2 * width, (index // 2) * height
        draw.text((x + 4, y + 2), folder.name.rsplit("-", 1)[0], fill="black")
        for k, share in enumerate(_SHARES):
            with Image.open(photos[int(share * len(photos))]) as photo:
                small = photo.convert("RGB").resize(_CELL, Image.Resampling.LANCZOS)
            sheet.paste(small, (x + k * width, y + _CAPTION_PX))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path, quality=82, optimize=True)
