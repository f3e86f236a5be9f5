# SPDX-License-Identifier: GPL-3.0-or-later
"""Cache of a scene's regions and their shapes, updated by handlers.

Drawing queries it many times a second. It stores names and numbers, never objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import bpy
from bpy.app.handlers import persistent

from ..common import tags


@dataclass
class _Known:
    names: dict[int, tuple[int, tuple[str, ...]]] = field(default_factory=dict)
    """By the scene's session id: number of its objects and names of its regions."""
    versions: dict[int, int] = field(default_factory=dict)
    """By the object's session id: number of changes of its geometry."""


_known = _Known()


@persistent
def after_update(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Handler: something in a scene has changed."""
    if depsgraph is None:
        _known.names.clear()
        return
    for update in depsgraph.updates:
        thing = update.id.original
        if not isinstance(thing, bpy.types.Object):
            if isinstance(thing, bpy.types.Scene | bpy.types.Collection):
                _known.names.clear()
            continue
        if tags.kind_of(thing) == "region":
            _known.names.clear()
        if update.is_updated_geometry:
            uid = thing.session_uid
            _known.versions[uid] = _known.versions.get(uid, 0) + 1


@persistent
def after_load(*_arguments: object) -> None:
    """Handler: another file, or an undo; session ids may mean other objects."""
    forget()


def forget() -> None:
    """Clear the cache."""
    _known.names.clear()
    _known.versions.clear()


def region_names(scene: bpy.types.Scene) -> tuple[str, ...]:
    """Return the names of a scene's regions, sorted."""
    count = len(scene.objects)
    stored = _known.names.get(scene.session_uid)
    if stored is not None and stored[0] == count and all(n in scene.objects for n in stored[1]):
        return stored[1]
    names = tuple(sorted(thing.name for thing in tags.objects_of_kind(scene, "region")))
    _known.names[scene.session_uid] = (count, names)
    return names


def shape_key(thing: bpy.types.Object) -> tuple[object, ...]:
    """Return a key of a region's shape in its own coordinates."""
    if thing.type == "EMPTY":
        return ("EMPTY", thing.empty_display_type, thing.empty_display_size)
    return (thing.type, thing.session_uid, _known.versions.get(thing.session_uid, 0))
