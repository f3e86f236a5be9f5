# SPDX-License-Identifier: GPL-3.0-or-later
"""``result/scene.json``: cameras, photo paths and frame of a scene, for Blender."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ...files import write_json

if TYPE_CHECKING:
    from ...dataset.scene import Scene


def write_scene_summary(path: Path, scene: Scene) -> None:
    """Write ``result/scene.json``, the cameras and frame for Blender (docs/architecture.md)."""
    from ...tolerances import SCENE_RADIUS

    units = scene.facts.get("georeference")
    write_json(
        path,
        {
            **({} if units is None else {"georeference": units}),
            "version": 1,
            "world_from_scene": scene.world_from_scene.to_json(),
            "radius": SCENE_RADIUS,
            "cameras": [
                {**view.camera.to_json(), "photo": str(view.photo_path)} for view in scene.views
            ],
        },
    )
