# SPDX-License-Identifier: GPL-3.0-or-later
"""Render the scene of a single matte thing whose module is its own."""

from __future__ import annotations

from pathlib import Path

from gaussian_wrapping_addon.core.dataset.similarity import Similarity

from .build import BuildSize, _write_data
from .catalogue import SceneContent, SceneKind
from .rendering import render_photos, require_bpy

WALL_DENSITY_AT_640 = 140.0
"""Detail of the studio's walls, as of all single things."""


def build_matte_thing(
    kind: SceneKind, content: SceneContent, size: BuildSize, folder: Path
) -> None:
    """Make the scene in an empty folder, as :func:`.build.build_scene` makes the others.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    images, tests = folder / "images", folder / "test" / "images"
    images.mkdir(parents=True)
    tests.mkdir(parents=True)
    paths = [images / camera.name for camera in content.cameras]
    paths += [tests / camera.name for camera in content.test_cameras]
    render_photos(
        content.parts, [*content.cameras, *content.test_cameras], paths, content.light,
        samples=kind.samples, glossy_bounces=0, wall_shadows=False,
        wall_density=WALL_DENSITY_AT_640 * size.width / 640,
    )  # fmt: skip
    facts: dict[str, object] = {"bpy": require_bpy().app.version_string}
    _write_data(kind, kind.seed, content, size, Similarity(), facts, folder)
