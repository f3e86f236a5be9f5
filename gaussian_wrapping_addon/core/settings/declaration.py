# SPDX-License-Identifier: GPL-3.0-or-later
"""Declare a setting once, as a field of a settings class with metadata.

Validation, command line, Blender properties, panels, job file and ``docs/settings.md`` are
generated from these declarations. To add a setting, add one field::

    smoothness: float = setting(
        0.5,
        help="Weight of the smoothness term.",
        check=Range(0.0, 1.0),
        option=Option("--smoothness", metavar="W"),
        panel=PanelProperty("Smoothness", "How strongly neighbouring vertices hold each other"),
    )
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ..errors import SettingError
from .checks import Check, Choices
from .choices import SWITCH

_KEY = "setting"

Scope = Literal["training", "constants", "method", "region", "more"]
"""Groups of options on the command line: training; constants of the training method; meshing method
and resolution (all that an estimate needs); other options of regions; the command ``more``
(continue a training)."""

Owner = Literal["scene", "training", "preferences"]
"""Owner of a property in Blender: ``Scene.gwrap``, ``Scene.gwrap.training``, or the add-on."""

PanelName = Literal[
    "dataset",
    "train",
    "train_advanced",
    "mesh",
    "mesh_advanced",
    "texture",
    "computers",
    "preferences",
]
"""A panel in Blender."""

JOB = "job"
"""Group of the settings that are direct fields of the job's settings."""

_SCOPES: Mapping[str, Scope] = {"training": "training", "meshing": "region", "texture": "region"}
_PANEL_NAMES: Mapping[str, PanelName] = {
    "training": "train_advanced", "meshing": "mesh_advanced", "texture": "texture",
}  # fmt: skip


@dataclass(frozen=True)
class Option:
    """How a setting is given on the command line."""

    name: str
    """With its leading dashes."""
    metavar: str = ""
    help: str = ""
    """Replaces the setting's help."""
    scope: Scope | None = None
    """``None``: by the setting's group."""
    exclusive: str = ""
    """Options with the same name here exclude each other."""
    flag: str = ""
    """If not empty, the option takes no value and sets the setting to this word."""
    many: bool = False
    """Whether it takes several values and may be repeated."""
    parse: Callable[[Any], Any] | None = None
    """Converts the text (``many``: list of texts) to the setting's value; may raise UsageError."""


@dataclass(frozen=True)
class Item:
    """One entry of an enum in Blender."""

    value: Any
    label: str
    description: str


@dataclass(frozen=True)
class PanelProperty:
    """How a setting is shown in Blender. Property names and identifiers are stored in .blend files.

    Blender stores the index of an enum's entry: new ``items`` must be appended at the end.
    """

    label: str
    description: str
    name: str = ""
    """Name of the property; empty uses the setting's."""
    items: tuple[Item, ...] = ()
    """Entries of an enum; identifiers are the values in upper case."""
    default: Any = None
    """Default of the property, if it differs from the setting's."""
    preset_if_zero: bool = False
    """Whether 0, the property's default, uses the preset's number."""
    low: float | None = None
    """Smallest number, if it differs from the smallest that the check allows."""
    soft_low: float | None = None
    soft_high: float | None = None
    """Ends of the slider; larger numbers can be typed."""
    step: int | None = None
    precision: int | None = None
    subtype: str = ""
    unit: str = ""
    """Blender's subtype and unit, such as ``"DISTANCE"`` and ``"LENGTH"``."""
    owner: Owner | None = None
    """``None``: by the setting's group."""
    panel_name: PanelName | None = None
    """The panel; ``None``: by the setting's group."""
    order: int = 100
    """Position within the panel; equal numbers keep the order of declaration."""
    drawn_label: str = ""
    """Shorter label in the panel, if its title provides the context."""
    expand: bool = False
    """Whether all entries of an enum are shown side by side."""
    shown_if: tuple[str, str | bool | int] | None = None
    """Property of the scene and its value for which this one is shown."""
    default_if_hidden: bool = False
    """Whether the setting takes its default while the property is hidden."""


@dataclass(frozen=True)
class Declaration:
    """The declaration of one setting."""

    default: Any
    help: str
    """What the setting does, in full sentences."""
    check: Check | None = None
    unit: str = ""
    presets: Mapping[str, Any] = field(default_factory=dict)
    """Values in presets that differ from the default."""
    option: Option | None = None
    panel: PanelProperty | None = None
    model_selection: bool = False
    """Whether it selects a part of the model: ``--needs`` sets all of these."""
    affects_result: bool = True
    """Whether the result depends on it; if not, stage keys exclude it."""
    since: str = ""
    """Version that added it; empty: 0.1.0. Stage keys exclude a later setting at its default, so
    that results of earlier versions stay valid."""
    path: str = ""
    """Dotted, within the job's settings, such as ``"training.iterations"``."""
    kind: Any = None
    """The type: ``int``, ``float``, ``str`` or ``tuple[str, ...]``."""

    @property
    def name(self) -> str:
        """The field's name."""
        return self.path.rpartition(".")[2]

    @property
    def group(self) -> str:
        """The group of settings it belongs to, such as ``"training"``."""
        return self.path.rpartition(".")[0] or JOB

    @property
    def choices(self) -> tuple[Any, ...]:
        """The choices of the setting, empty if it has none."""
        return self.check.values if isinstance(self.check, Choices) else ()

    @property
    def is_switch(self) -> bool:
        """Whether it is on or off, without ``"auto"``."""
        return self.choices == SWITCH

    @property
    def scope(self) -> Scope:
        """The scope of its option."""
        assert self.option is not None
        return self.option.scope or _SCOPES[self.group]

    @property
    def property_name(self) -> str:
        """The name of its property in Blender."""
        assert self.panel is not None
        return self.panel.name or self.name

    @property
    def property_owner(self) -> Owner:
        """The owner of its property in Blender."""
        assert self.panel is not None
        return self.panel.owner or ("training" if self.group == "training" else "scene")

    @property
    def panel_name(self) -> PanelName:
        """The panel that shows it."""
        assert self.panel is not None
        return self.panel.panel_name or _PANEL_NAMES[self.group]

    def to_panel(self, value: Any) -> Any:
        """Convert a value of the setting to its property's value."""
        assert self.panel is not None
        if self.is_switch:
            return value == "on"
        return str(value).upper() if self.panel.items else value

    def from_panel(self, stored: Any) -> Any:
        """Convert a property's value to the setting's value.

        Raises
        ------
        KeyError
            The enum has no such entry.
        """
        assert self.panel is not None
        if self.is_switch:
            return "on" if stored else "off"
        if not self.panel.items:
            return stored
        return {self.to_panel(item.value): item.value for item in self.panel.items}[stored]


def setting(
    default: Any,
    *,
    help: str,
    check: Check | None = None,
    unit: str = "",
    presets: Mapping[str, Any] | None = None,
    option: Option | None = None,
    panel: PanelProperty | None = None,
    model_selection: bool = False,
    affects_result: bool = True,
    since: str = "",
) -> Any:
    """Declare a setting as a field of a settings class; see :class:`Declaration`."""
    declared = Declaration(
        default,
        help,
        check,
        unit,
        presets or {},
        option,
        panel,
        model_selection,
        affects_result,
        since,
    )
    return field(default=default, metadata={_KEY: declared})


@functools.cache
def declarations(kind: type) -> tuple[Declaration, ...]:
    """Return the declarations of a settings class in order, those of its groups included.

    Raises
    ------
    TypeError
        A field is neither declared with :func:`setting` nor a group of settings.
    """
    return tuple(_walk(kind, ""))


def _walk(kind: type, prefix: str) -> Iterable[Declaration]:
    hints = typing.get_type_hints(kind)
    for entry in dataclasses.fields(kind):
        hint, path = hints[entry.name], f"{prefix}{entry.name}"
        declared = entry.metadata.get(_KEY)
        if dataclasses.is_dataclass(hint):
            yield from _walk(typing.cast(type, hint), f"{path}.")
        elif isinstance(declared, Declaration):
            yield dataclasses.replace(declared, path=path, kind=hint)
        else:
            raise TypeError(f"{kind.__name__}.{entry.name} is not declared by setting()")


def value_at(settings: Any, path: str) -> Any:
    """Return the value of a setting by its path."""
    return functools.reduce(getattr, path.split("."), settings)


def with_values(settings: Any, values: Mapping[str, Any]) -> Any:
    """Return settings with some values replaced, by path."""
    changes: dict[str, Any] = {p: value for p, value in values.items() if "." not in p}
    for group in dict.fromkeys(path.partition(".")[0] for path in values if "." in path):
        inside = {
            path.partition(".")[2]: value
            for path, value in values.items()
            if path.startswith(f"{group}.")
        }
        changes[group] = with_values(getattr(settings, group), inside)
    return dataclasses.replace(settings, **changes)


def validate(settings: Any) -> None:
    """Raise :class:`SettingError` for the first setting whose value is invalid."""
    kind: type = type(settings)
    for declared in declarations(kind):
        check = declared.check
        if check is not None and not check.holds(value_at(settings, declared.path)):
            raise SettingError(declared.path, check.wanted)
