# SPDX-License-Identifier: GPL-3.0-or-later
"""One declaration for each setting: default, range, option, panel property, help."""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, cast

from ..errors import SettingError, UsageError

# -- Checks of a setting's value: numeric ranges, choices, subsets and other conditions -----------


class Check(Protocol):
    """Condition that a setting's value must fulfil, with a description of valid values."""

    @property
    def wanted(self) -> str:
        """Description of valid values, for the sentence "Give <wanted>."."""

    def holds(self, value: Any) -> bool:
        """Tell whether a value is valid."""


@dataclass(frozen=True)
class Range:
    """A finite number from ``low`` to ``high``."""

    low: float
    high: float = math.inf
    zero: str = ""  # meaning of 0, if it is allowed in addition to the range
    words: str = ""  # replaces the generated description
    below_high: bool = False  # whether ``high`` itself is excluded

    @property
    def wanted(self) -> str:
        if self.words:
            return self.words
        to = "to below" if self.below_high else "to"
        span = f"from {_plain(self.low)} {to} {_plain(self.high)}"
        return f"0 ({self.zero}) or {span}" if self.zero else span

    @property
    def lowest(self) -> float:
        """The smallest valid value, 0 if it has a meaning of its own."""
        return 0 if self.zero else self.low

    def holds(self, value: Any) -> bool:
        if self.zero and value == 0:
            return True
        if value == math.inf or (self.below_high and value >= self.high):
            return False
        return bool(self.low <= value <= self.high)


@dataclass(frozen=True)
class Choices:
    """One of a list of words or numbers."""

    values: tuple[Any, ...]
    earlier: tuple[Any, ...] = ()
    """Further words in files of earlier versions, which mean the setting's default."""

    @property
    def wanted(self) -> str:
        return f"one of {', '.join(map(str, self.values))}"

    def holds(self, value: Any) -> bool:
        return value in self.values or value in self.earlier


@dataclass(frozen=True)
class Subset:
    """Any number of words of a list."""

    values: tuple[str, ...]

    @property
    def wanted(self) -> str:
        return f"among {', '.join(self.values)}"

    def holds(self, value: Any) -> bool:
        return set(value) <= set(self.values)


@dataclass(frozen=True)
class Condition:
    """Any value that a function accepts."""

    accepts: Callable[[Any], bool]
    wanted: str

    def holds(self, value: Any) -> bool:
        return self.accepts(value)


def _plain(number: float) -> str:
    return str(int(number)) if float(number).is_integer() else str(number)


# -- The choices of settings ----------------------------------------------------------------------


PRESETS = ("draft", "standard", "fine", "paper", "large")
SELECTION_MODES = ("auto", "on", "off")
"""Of what is chosen by evidence in the photos where it is ``"auto"``."""
SWITCH = ("off", "on")

DEVICE = r"auto|cpu|cuda(:[0-9]{1,3})?"  # pattern of the devices that a job can be given
COMPUTERS = r"|local|(tcp|tls)://(\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9._-]{1,253}):[0-9]{1,5}"
"""Pattern of where the parts of a job run; empty: here, in one process."""
MAX_PROCESSES = 64

MASK_MODES = ("ignore", "background", "auto")
"""``"auto"``: background where the masks were made of a turntable, a region or by a model, else
ignore."""
MASKS_MADE = ("off", "region")
MODEL_RANGES = ("imagenet", "half", "unit")
"""Colours of a segmentation model: mean and deviation of ImageNet, -0.5 to 0.5, 0 to 1."""
MAX_MASK_GROW_PX = 200
CORRELATIONS = ("signed", "squared")
SPACINGS = ("adaptive", "uniform")
MESH_METHODS = ("pam", "pivots")
PIVOT_COUNTS = (2, 3, 9)
PIVOT_BOXES = ("normal", "gof")
PIVOT_SAMPLES = ("depth", "none")
BOUNDARIES = ("closed", "open")
UNSEEN = ("empty", "occupied")
FIELD_CAMERAS = ("training", "all")
MAX_LODS = 8
TEXTURE_SOURCES = ("photos", "gaussians")
UV_CHOICES = ("auto", "own", "new")
"""Of a mesh from elsewhere; ``"auto"``: its own if it has any."""
UP_AXES = ("auto", "y", "z")  # Of a mesh file; ``"auto"``: as the format is exported.


# -- Declare a setting once, as a field of a settings class with metadata -------------------------
#
# Validation, command line, Blender properties, panels, job file and ``docs/settings.md`` are
# generated from these declarations. To add a setting, add one field::
#
#     smoothness: float = setting(
#         0.5,
#         help="Weight of the smoothness term.",
#         check=Range(0.0, 1.0),
#         option=Option("--smoothness", metavar="W"),
#         panel=PanelProperty("Smoothness", "How strongly neighbouring vertices hold each other"),
#     )


_KEY = "setting"

Scope = Literal["training", "method", "region", "more"]
"""Groups of settings on the command line: training; meshing method and resolution (all that an
estimate needs); other settings of regions; the command ``more`` (continue a training)."""

Owner = Literal["scene", "training", "preferences"]
"""Owner of a property in Blender: ``Scene.gwrap``, ``Scene.gwrap.training``, or the add-on."""

PanelName = Literal[
    "dataset", "train", "train_advanced", "mesh", "mesh_advanced", "texture", "computers",
    "preferences",
]  # fmt: skip
"""A panel in Blender."""

JOB = "job"  # group of the settings that are direct fields of the job's settings
_SCOPES: Mapping[str, Scope] = {
    JOB: "training", "training": "training", "meshing": "region", "texture": "region",
}  # fmt: skip
_PANEL_NAMES: Mapping[str, PanelName] = {
    JOB: "train_advanced", "training": "train_advanced", "meshing": "mesh_advanced",
    "texture": "texture",
}  # fmt: skip


@dataclass(frozen=True)
class Option:
    """How a setting is given on the command line."""

    name: str = ""  # With its leading dashes; empty: the setting's.
    metavar: str = ""
    help: str = ""
    """Replaces the setting's help."""
    scope: Scope | None = None  # ``None``: by the setting's group
    exclusive: str = ""  # options with the same name here exclude each other
    flag: str = ""  # if not empty, the option takes no value and sets the setting to this word
    many: bool = False  # whether it takes several values and may be repeated
    own: bool = False
    """Whether it is an option of its own; others are given as ``--set NAME=VALUE``."""
    parse: Callable[[Any], Any] | None = None
    """Converts the text (``many``: list of texts) to the setting's value; may raise UsageError."""

    @property
    def word(self) -> str:
        """The name for ``--set``."""
        return self.name.lstrip("-").replace("-", "_")


@dataclass(frozen=True)
class Item:
    """One entry of an enum in Blender."""

    value: Any
    label: str
    description: str


def auto_on_off(auto: str, on: str, off: str) -> tuple[Item, ...]:
    """Return the entries of a setting that is ``"auto"``, ``"on"`` or ``"off"``, by tooltips."""
    return Item("auto", "Auto", auto), Item("on", "On", on), Item("off", "Off", off)


@dataclass(frozen=True)
class PanelProperty:
    """How a setting is shown in Blender. Property names and identifiers are stored in .blend files.

    Blender stores the index of an enum's entry: new ``items`` must be appended at the end.
    """

    label: str
    description: str
    name: str = ""
    """Name of the property; empty uses the setting's."""
    items: tuple[Item, ...] = ()  # Entries of an enum; identifiers are the values in upper case.
    default: Any = None  # default of the property, if it differs from the setting's
    preset_if_zero: bool = False  # whether 0, the property's default, uses the preset's number
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
    owner: Owner | None = None  # ``None``: by the setting's group
    panel_name: PanelName | None = None  # The panel; ``None``: by the setting's group.
    order: int = 100  # Position within the panel; equal numbers keep the order of declaration.
    drawn_label: str = ""  # shorter label in the panel, if its title provides the context
    expand: bool = False  # whether all entries of an enum are shown side by side
    shown_if: tuple[str, str | bool | int] | None = None
    """Property of the scene and its value for which this one is shown."""
    default_if_hidden: bool = False
    """Whether the setting takes its default while the property is hidden."""


@dataclass(frozen=True)
class Declaration:
    """The declaration of one setting."""

    default: Any
    help: str  # what the setting does, in full sentences
    check: Check | None = None
    unit: str = ""
    presets: Mapping[str, Any] = field(default_factory=dict)
    """Values in presets that differ from the default."""
    option: Option | None = None
    panel: PanelProperty | None = None
    model_selection: bool = False
    """Whether it selects a part of the model: ``--needs`` sets all of these."""
    affects_result: bool = True  # Whether the result depends on it; if not, stage keys exclude it.
    since: str = ""
    """Version that added it; empty: 0.1.0. Stage keys exclude a later setting at its default, so
    that results of earlier versions stay valid."""
    path: str = ""  # dotted, within the job's settings, such as ``"training.iterations"``
    kind: Any = None  # the type: ``int``, ``float``, ``str`` or ``tuple[str, ...]``

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
        return self.panel.owner or ("training" if self.group in (JOB, "training") else "scene")

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


def setting(default: Any, **declared: Any) -> Any:
    """Declare a setting as a field of a settings class; see :class:`Declaration`."""
    return field(default=default, metadata={_KEY: Declaration(default, **declared)})


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
            option = declared.option
            if option is not None and not option.name:
                option = dataclasses.replace(option, name=f"--{entry.name.replace('_', '-')}")
            yield dataclasses.replace(declared, path=path, kind=hint, option=option)
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


# -- Convert settings to JSON values and back, as in ``job.json`` ---------------------------------


_KINDS: dict[Any, str] = {int: "a whole number", float: "a number", str: "text"}
_SHOWN_NAME = 40
"""Characters of an unknown entry that a message shows."""


def to_json(settings: Any) -> dict[str, Any]:
    """Convert a settings dataclass to plain JSON values."""
    return dataclasses.asdict(settings)


def key_values(settings: Any) -> dict[str, Any]:
    """Return the JSON values that decide about the result of a stage, for its key.

    Settings without influence on the result are left out, and settings that 0.1.0 did not have
    where they have their default: results of earlier versions stay valid.
    """
    left_out = {
        entry.path
        for entry in declarations(cast(type, type(settings)))
        if not entry.affects_result
        or (entry.since and value_at(settings, entry.path) == entry.default)
    }
    return {name: value for name, value in to_json(settings).items() if name not in left_out}


def has_kind(kind: Any, value: Any) -> bool:
    """Return whether a JSON value is one of a setting of type ``int``, ``float`` or ``str``."""
    if kind is float:
        try:
            return not isinstance(value, bool) and math.isfinite(value)
        except (TypeError, OverflowError):
            return False
    return kind in (int, str) and type(value) is kind


def from_json(kind: type, values: Any, location: str = "settings") -> Any:
    """Build a settings dataclass from JSON values.

    Raises
    ------
    UsageError
        A key is unknown or a value has the wrong type; names the location and the expected type.
    """
    if not isinstance(values, dict):
        raise UsageError(f"{location} must be an object.", "Write it as {...}.")
    hints = typing.get_type_hints(kind)
    fields = {f.name for f in dataclasses.fields(kind)}
    unknown = sorted(set(values) - fields)
    if unknown:
        name = unknown[0][:_SHOWN_NAME]
        raise UsageError(f"{location} has an unknown entry {name!r}.", "Remove it.")
    arguments = {}
    for name, value in values.items():
        wanted = hints[name]
        where = f"{location}.{name}"
        if dataclasses.is_dataclass(wanted):
            arguments[name] = from_json(typing.cast(type, wanted), value, where)
        elif wanted is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            try:
                arguments[name] = float(value)
            except OverflowError:
                raise UsageError(f"{where} is too large.", "Give a smaller number.") from None
        elif wanted is not float and has_kind(wanted, value):
            arguments[name] = value
        elif typing.get_origin(wanted) is tuple and isinstance(value, (list, tuple)):
            if not all(isinstance(v, str) for v in value):
                raise UsageError(f"{where} must hold only text.", "Use strings.")
            arguments[name] = tuple(value)
        else:
            kind_wanted = _KINDS.get(wanted, "a list of text")
            raise UsageError(f"{where} has the wrong type.", f"Give {kind_wanted}.")
    return kind(**arguments)
