# SPDX-License-Identifier: GPL-3.0-or-later
"""Name, preferences and properties of the add-on in Blender."""

from __future__ import annotations

from typing import Any

import bpy


def addon_package() -> str:
    """Return the name under which Blender has enabled the add-on."""
    return __package__.rpartition(".ops")[0]


def addon_preferences(context: bpy.types.Context) -> Any:
    """Return the preferences, or ``None`` where the package is not enabled as an add-on."""
    addon = context.preferences.addons.get(addon_package())
    return addon.preferences if addon is not None else None


def properties_of(owner: bpy.types.Scene | bpy.types.Object) -> Any:
    """Return the add-on's properties of a scene or region (``ui/properties.py``)."""
    return owner.gwrap  # type: ignore[union-attr]
