# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of the command line, made from the declarations of the settings.

In: a parser, or its parsed options. Out: options, or settings. Settings that most users never touch
have no option of their own: ``--set NAME=VALUE`` gives them (``settings`` lists them).
"""

from __future__ import annotations

import difflib
import logging
from argparse import Action, ArgumentError, ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Protocol

from ..core.errors import SettingError, UsageError
from ..core.settings import (
    MODEL_SELECTION,
    Declaration,
    JobSettings,
    MeshingSettings,
    declarations,
    declared,
    preset,
    with_values,
)
from ..core.settings.declaration import Scope
from ..core.settings.job import read_saved_settings, savable_settings

_logger = logging.getLogger("gaussian_wrapping")

# -- One option for each setting ------------------------------------------------------------------


def declared_options(*scopes: Scope) -> tuple[Declaration, ...]:
    """Return the settings of scopes that can be given on the command line."""
    known = [entry for entry in declarations(JobSettings) if entry.option is not None]
    return tuple(entry for scope in scopes for entry in known if entry.scope == scope)


def option_of(path: str) -> str:
    """Return how the command line calls a setting, ``""`` if it does not know it."""
    options = {e.path: e.option for e in declarations(JobSettings) if e.option is not None}
    option = options.get(path)
    if option is None:
        return ""
    return option.name if option.own else f"--set {option.word}"


def _as_given(path: str, value: Any) -> str:
    """Return how the command line gives a value to a setting."""
    option = option_of(path)
    return f"{option}={value}" if option.startswith("--set ") else f"{option} {value}"


def with_option_name(error: SettingError) -> SettingError:
    """Return the error with the setting's option in place of its path."""
    return SettingError(error.setting, error.wanted, called=option_of(error.setting))


def given_path(text: str) -> Path:
    """Return the path that an option names; an empty one, as of an unset variable, is none."""
    if not text.strip():
        raise ArgumentTypeError("an empty path; name the file or folder")
    return Path(text)


def add_options(parser: ArgumentParser, entries: Iterable[Declaration]) -> None:
    """Add options of settings, and ``--set`` for those without their own. Once for a parser.

    Options that are not given are ``None``.
    """
    exclusive: dict[str, Any] = {}
    others: dict[str, Declaration] = {}
    known: dict[str, str] = {}
    for entry in entries:
        option = entry.option
        assert option is not None
        known[option.word] = option.name
        if not option.own:
            others[option.word] = entry
            parser.set_defaults(**{entry.path: None})
            continue
        target: Any = parser
        if option.exclusive:
            if option.exclusive not in exclusive:
                exclusive[option.exclusive] = parser.add_mutually_exclusive_group()
            target = exclusive[option.exclusive]
        add_option(target, entry)
    parser.add_argument(
        "--set", action=SetAction, settings=others, known=known, metavar="NAME=VALUE",
        help="any other setting, such as --set exposure=on; may be repeated; the command settings "
        "lists them",
    )  # fmt: skip


class SetAction(Action):
    """``--set NAME=VALUE``: has the effect of an option with the setting's name."""

    def __init__(
        self, *, settings: dict[str, Declaration], known: dict[str, str], **keywords: Any
    ) -> None:
        super().__init__(**keywords)
        self.settings = settings
        self.known = known
        """Options of all settings of the command, by word."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        name, given, text = values.partition("=")
        word = name.strip().replace("-", "_")
        entry = self.settings.get(word)
        if entry is None:
            raise ArgumentError(self, self._unknown(word))
        if not given:
            raise ArgumentError(self, f"no value in {values!r}; give {word}=VALUE")
        value: Any = text
        assert entry.option is not None
        if entry.option.parse is None and entry.kind in (int, float):
            try:
                value = _number_reader(entry)(text)
            except ArgumentTypeError as error:
                raise ArgumentError(self, f"{word}: {error}") from None
        if entry.choices and value not in entry.choices:
            words = ", ".join(map(str, entry.choices))
            raise ArgumentError(self, f"{word}: invalid choice: {text!r} (choose from {words})")
        setattr(namespace, entry.path, value)

    def _unknown(self, word: str) -> str:
        if word in self.known:
            return f"{word} has an option of its own: {self.known[word]}"
        near = difflib.get_close_matches(word, self.settings, n=1)
        if near:
            return f"unknown setting {word!r}, the nearest is {near[0]}"
        if any(word == e.option.word for e in declarations(JobSettings) if e.option is not None):
            return f"{word} is no setting of this command"
        return f"unknown setting {word!r}; the command settings lists them"


def add_option(parser: Any, entry: Declaration, **changes: Any) -> None:
    """Add the option of one setting to a parser or argument group.

    ``changes``: keywords of ``add_argument`` that replace the declared ones.
    """
    option = entry.option
    assert option is not None
    keywords: dict[str, Any] = {
        "dest": entry.path,
        "help": (option.help or entry.help).replace("%", "%%"),
    }
    if option.flag:
        keywords |= {"action": "store_const", "const": option.flag}
    else:
        # Without a metavar or choices, argparse would show the dotted path.
        shown = option.metavar or option.name.lstrip("-").replace("-", "_").upper()
        keywords["metavar"] = option.metavar or (None if entry.choices else shown)
        keywords["choices"] = entry.choices or None
        if option.parse is None and entry.kind in (int, float):
            keywords["type"] = _number_reader(entry)
    if option.many:
        keywords |= {"nargs": "+", "action": "extend"}
    parser.add_argument(option.name, **(keywords | changes))


def _number_reader(entry: Declaration) -> Callable[[str], Any]:
    """Return what reads the number of an option; its error gives the valid ones."""

    def read(text: str) -> Any:
        try:
            return entry.kind(text)
        except ValueError:
            valid = f"; give {entry.check.wanted}" if entry.check is not None else ""
            kind = entry.kind.__name__
            raise ArgumentTypeError(f"invalid {kind} value: {text!r}{valid}") from None

    return read


def given_settings(options: Namespace, entries: Iterable[Declaration]) -> dict[str, Any]:
    """Return those of the settings, by path, whose options were given.

    Raises UsageError: a value cannot be parsed.
    """
    values = {}
    for entry in entries:
        assert entry.option is not None
        value = getattr(options, entry.path)
        if value is not None:
            values[entry.path] = entry.option.parse(value) if entry.option.parse else value
    return values


# -- Settings of the training ---------------------------------------------------------------------

_SELECTION_VALUES = {"auto": "auto", "all": "on", "none": "off"}
"""Values of ``--needs`` and the model selection that they set."""

_USER_PRESET = "--user-preset"


def add_training_options(parser: ArgumentParser) -> None:
    """Add what sets many settings of the training at once: a user's preset, model selection."""
    parser.add_argument(
        _USER_PRESET, type=given_path, metavar="FILE.json",
        help="settings of training and texture of a preset saved in the panel (My Presets); other "
        "options override it",
    )  # fmt: skip
    parser.add_argument(
        "--needs", choices=tuple(_SELECTION_VALUES),
        help=f"model selection: sets {', '.join(MODEL_SELECTION)}, each of which overrides this "
        "option; auto: selected from the photos; all: on; none: off",
    )  # fmt: skip


def training_settings(options: Namespace) -> JobSettings:
    """Return settings: the preset's, a user's preset, the options.

    Ranges are checked when the job is made.
    """
    values = given_settings(options, declared_options("training"))
    saved = _saved_values(options, values.get("preset"))
    if options.needs is not None:
        word = _SELECTION_VALUES[options.needs]
        known = (d for d in declarations(JobSettings) if d.model_selection)
        selected = {d.path: word for d in known if word in d.choices}
        values = {**selected, **values}
    values = {**saved, **values}
    chosen = preset(values.pop("preset", JobSettings().preset))
    return with_values(chosen, values)


def _saved_values(options: Namespace, given_preset: str | None) -> dict[str, Any]:
    """Return the settings of the option's file, by path, as Wrap Scene in the panel takes them.

    Settings of meshes are left out, and what the file leaves to the preset.

    ``given_preset``: overrides that of the file.
    Raises UsageError, ParseError: the file cannot be used.
    """
    if options.user_preset is None:
        return {}
    try:
        saved = read_saved_settings(options.user_preset)
    except OSError as error:
        raise UsageError(
            f"{options.user_preset} cannot be read: {error.strerror or error}.",
            f"Check the path after {_USER_PRESET}.",
        ) from None
    for note in saved.notes:
        _logger.warning("warning: %s: %s", options.user_preset.name, note)
    chosen = given_preset or saved.values.get("preset", JobSettings().preset)
    values = {}
    for entry in savable_settings():
        if entry.path not in saved.values or entry.group == "meshing":
            continue
        value, panel = saved.values[entry.path], entry.panel
        if panel is not None and panel.preset_if_zero and not value:
            continue
        if entry.model_selection and chosen in entry.presets and value == entry.default:
            continue  # Auto leaves it to the preset
        values[entry.path] = value
    return values


# -- Settings of meshing and texture --------------------------------------------------------------

_IGNORED_BY_PIVOTS: dict[str, tuple[Any, ...]] = {
    "edge_length": (0.0,), "points": (0,), "spacing": (), "tiles": ("auto", "off"),
}  # fmt: skip
"""Settings that the method pivots ignores, and their values without effect: an edge length or
number of 0, and tiles that pivots do not use anyway."""


_ONLY_BY_PIVOTS = ("pivots", "pivot_box", "pivot_samples")
"""Settings that only the method pivots reads."""


def method_settings(options: Namespace) -> dict[str, Any]:
    """Return the meshing settings, by name, of the scope ``method``.

    Options that are not given have their defaults, not the values of an earlier mesh. Raises
    UsageError: an option is given that the method ignores.
    """
    values = given_settings(options, declared_options("method"))
    given = {path.removeprefix("meshing."): value for path, value in values.items()}
    method = given.get("method", MeshingSettings().method)
    pivots = given.get("pivots", MeshingSettings().pivots)
    for name, value in given.items():
        if method == "pivots" and name in _IGNORED_BY_PIVOTS:
            if value in _IGNORED_BY_PIVOTS[name]:
                continue
            reason, hint = "with --set method=pivots", "Leave out one of the two."
        elif method != "pivots" and name in _ONLY_BY_PIVOTS:
            reason = f"with --set method={method}"
            hint = "Add --set method=pivots, or leave it out."
        elif name == "pivot_box" and pivots != 9:
            reason, hint = "without --set pivots=9", "Add --set pivots=9, or leave it out."
        else:
            continue
        raise UsageError(f"{_as_given(f'meshing.{name}', value)} has no effect {reason}.", hint)
    return {
        entry.name: given.get(entry.name, entry.default) for entry in declared_options("method")
    }


def region_settings(
    settings: JobSettings, options: Namespace, *, texture_stays: bool = False
) -> JobSettings:
    """Return settings with the options of the scopes ``method`` and ``region``.

    Options that are not given have their defaults, not the values of an earlier mesh; with
    ``texture_stays``, those of the texture have the values of ``settings``. Raises UsageError: an
    option is given that the method ignores, or a value cannot be parsed.
    """
    entries = declared_options("region")
    stays = "texture" if texture_stays else None
    values = {entry.path: entry.default for entry in entries if entry.group != stays}
    values |= {f"meshing.{name}": value for name, value in method_settings(options).items()}
    values |= given_settings(options, entries)
    if options.threads is not None:
        values["threads"] = options.threads
    if options.device is not None:
        values["device"] = options.device
    return with_values(settings, values)


# -- Options shared by several commands -----------------------------------------------------------


class Commands(Protocol):
    """The subcommands of a parser."""

    def add_parser(self, name: str, *, help: str) -> Any:
        """Return the parser of a new command."""


def add_out(parser: ArgumentParser) -> None:
    """Add ``--out``, the job folder."""
    parser.add_argument("--out", type=given_path, required=True, metavar="DIR")


def add_threads(parser: ArgumentParser) -> None:
    threads = declared("threads")
    add_option(parser, threads, default=threads.default)


def add_device(parser: ArgumentParser, *, kept: bool = False) -> None:
    """Add ``--device``; with ``kept``, the job's own is kept where it is not given."""
    device = declared("device")
    if kept:
        help_kept = "another device than the job's: auto, cpu, cuda or cuda:N"
        add_option(parser, device, help=help_kept)
    else:
        add_option(parser, device, default=device.default)


def add_no_blend(parser: ArgumentParser) -> None:
    """Add ``--no-blend``: write no Blender files."""
    parser.add_argument(
        "--no-blend", action="store_true", help="write no scene.blend; needs no bpy"
    )
