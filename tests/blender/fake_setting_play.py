# SPDX-License-Identifier: GPL-3.0-or-later
"""Meet the fake setting in Blender: property, panel, and what a job gets; no test by itself.

python -m tests.blender.fake_setting_play GROUP
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

os.environ["BLENDER_USER_RESOURCES"] = str(Path("profile").resolve())

import bpy

import gaussian_wrapping_addon
from gaussian_wrapping_addon.ops.panel_settings import job_settings, meshing_choices
from gaussian_wrapping_addon.ui import mesh_panel, training_panel
from tests.blender.fake_layout import draw

PANELS = {
    "training": training_panel.GWRAP_PT_train_advanced,
    "meshing": mesh_panel.GWRAP_PT_mesh_advanced,
    "texture": mesh_panel.GWRAP_PT_texture,
}


def chosen(group: str) -> int:
    """Return the number that a job started from the panels would get."""
    scene = bpy.context.scene
    if group == "meshing":
        return int(meshing_choices(scene, 1.0)["meshing.fake_number"])
    return int(getattr(job_settings(scene, 0), group).fake_number)


def main(group: str) -> None:
    gaussian_wrapping_addon.register()
    properties = bpy.context.scene.gwrap
    owner = properties.training if group == "training" else properties
    rna = owner.bl_rna.properties["fake_number"]
    before = chosen(group)
    owner.fake_number = 7
    values = {
        "package": gaussian_wrapping_addon.__file__,
        "rna": [rna.name, rna.description, rna.default, rna.hard_min, rna.hard_max],
        "drawn": [field.name for field in draw(PANELS[group]).fields],
        "chosen": [before, chosen(group)],
    }
    gaussian_wrapping_addon.unregister()
    print(json.dumps(values))


if __name__ == "__main__":
    main(sys.argv[1])
