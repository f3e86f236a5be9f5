# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender properties and rows of panels, made from the declarations of the settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ...core.settings import Declaration, JobSettings, declarations
from ...core.settings.checks import Range
from ...core.settings.declaration import Owner, PanelName
from ...ops.jobs.panel_settings import is_shown

_Group = TypeVar("_Group", bound=type)


def property_of(declared: Declaration, **changes: Any) -> Any:
    """Return the property of a setting, for a class's annotations.

    Parameters
    ----------
    changes : dict
        Keywords of Blender's property that differ from the declaration.
    """
    panel = declared.panel
    assert panel is not None
    default = declared.default if panel.default is None else panel.default
    keywords: dict[str, Any] = {"name": panel.label, "description": panel.description}
    if panel.items:
        items = [(declared.to_panel(i.value), i.label, i.description) for i in panel.items]
        return EnumProperty(
            **(keywords | {"items": items, "default": declared.to_panel(default)} | changes)
        )
    if declared.is_switch:
        return BoolProperty(**(keywords | {"default": default == "on"} | changes))
    blender = {"subtype": panel.subtype, "unit": panel.unit}
    keywords |= {name: value for name, value in blender.items() if value}
    if declared.kind is str:
        return StringProperty(**(keywords | {"default": default} | changes))
    kind = FloatProperty if declared.kind is float else IntProperty
    keywords |= _limits(declared) | {"default": 0 if panel.preset_if_zero else default}
    return kind(**(keywords | changes))


def _limits(declared: Declaration) -> dict[str, Any]:
    panel, check = declared.panel, declared.check
    assert panel is not None
    low, high = panel.low, math.inf
    if isinstance(check, Range):
        high = check.high
        if low is None:
            low = 0 if panel.preset_if_zero else check.lowest
    numbers = {
        "min": low,
        "max": high if math.isfinite(high) else None,
        "soft_min": panel.soft_low,
        "soft_max": panel.soft_high,
    }
    limits = {name: declared.kind(value) for name, value in numbers.items() if value is not None}
    shown = {"step": panel.step, "precision": panel.precision}
    return limits | {name: value for name, value in shown.items() if value is not None}


def with_settings(owner: Owner) -> Callable[[_Group], _Group]:
    """Return a decorator that gives a class the properties of the settings that it owns."""

    def give(cls: _Group) -> _Group:
        for declared in declarations(JobSettings):
            if declared.panel is not None and declared.property_owner == owner:
                cls.__annotations__[declared.property_name] = property_of(declared)
        return cls

    return give


def settings_in(panel_name: PanelName) -> list[Declaration]:
    """Return the settings that a panel shows, in its order."""
    shown = [
        d for d in declarations(JobSettings) if d.panel is not None and d.panel_name == panel_name
    ]
    return sorted(shown, key=lambda declared: declared.panel.order if declared.panel else 0)


def draw_settings(layout: Any, properties: Any, settings: Iterable[Declaration]) -> None:
    """Draw a row for each setting that applies to the current choices.

    Parameters
    ----------
    properties : bpy.types.PropertyGroup
        ``Scene.gwrap``.
    """
    for declared in settings:
        panel = declared.panel
        if panel is None or not is_shown(declared, properties):
            continue
        owner = properties.training if declared.property_owner == "training" else properties
        target = layout.row() if panel.expand else layout
        keywords: dict[str, Any] = {"text": panel.drawn_label} if panel.drawn_label else {}
        if panel.expand:
            keywords["expand"] = True
        target.prop(owner, declared.property_name, **keywords)
