# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshing and texture options of all commands that make a mesh."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from ...core.errors import UsageError
from ...core.settings import JobSettings, MeshingSettings, with_values
from .setting_options import add_options, declared_options, given_settings, option_of

_IGNORED_BY_PIVOTS: dict[str, tuple[Any, ...]] = {
    "edge_length": (0.0,),
    "points": (0,),
    "spacing": (),
    "tiles": ("auto", "off"),
}
"""Settings that the method pivots ignores, and their values without effect: an edge length or
number of 0, and tiles that pivots do not use anyway."""


_ONLY_BY_PIVOTS = ("pivots", "pivot_box", "pivot_samples")
"""Settings that only the method pivots reads."""


def add_method_options(parser: ArgumentParser) -> None:
    """Add the meshing method and resolution."""
    add_options(parser, "method")


def method_settings(options: Namespace) -> dict[str, Any]:
    """Return the meshing settings, by name, of :func:`add_method_options`.

    Options that are not given have their defaults, not the values of an earlier mesh.

    Raises
    ------
    UsageError
        An option is given that the method ignores.
    """
    values = given_settings(options, "method")
    given = {path.removeprefix("meshing."): value for path, value in values.items()}
    method = given.get("method", MeshingSettings().method)
    if method == "pivots":
        for name, no_effect in _IGNORED_BY_PIVOTS.items():
            if name in given and given[name] not in no_effect:
                option = option_of(f"meshing.{name}")
                raise UsageError(
                    f"{option} {given[name]} has no effect with --method pivots, whose resolution "
                    "is that of the Gaussians and which makes the mesh in one piece.",
                    f"Omit one of the two; --method pam uses {option}.",
                )
        if "pivot_box" in given and given.get("pivots", MeshingSettings().pivots) != 9:
            raise UsageError(
                f"--pivot-box {given['pivot_box']} has no effect without --pivots 9.",
                "Add --pivots 9, or omit --pivot-box.",
            )
    else:
        for name in _ONLY_BY_PIVOTS:
            if name in given:
                option = option_of(f"meshing.{name}")
                raise UsageError(
                    f"{option} {given[name]} has no effect with --method {method}.",
                    f"Add --method pivots, or omit {option}.",
                )
    return {
        entry.name: given.get(entry.name, entry.default) for entry in declared_options("method")
    }


def add_region_options(parser: ArgumentParser) -> None:
    """Add the options shared by ``wrap`` and ``mesh``: regions, field, clean-up, texture, files."""
    add_options(parser, "region")


def region_settings(
    settings: JobSettings, options: Namespace, *, texture_stays: bool = False
) -> JobSettings:
    """Return settings with the options of :func:`add_method_options` and `add_region_options`.

    Options that are not given have their defaults, not the values of an earlier mesh; with
    ``texture_stays``, those of the texture have the values of ``settings``.

    Raises
    ------
    UsageError
        An option is given that the method ignores, or a value cannot be parsed.
    """
    given = given_settings(options, "region")
    values = {
        entry.path: entry.default
        for entry in declared_options("region")
        if not (texture_stays and entry.group == "texture")
    }
    values |= {f"meshing.{name}": value for name, value in method_settings(options).items()}
    values |= given
    if options.threads is not None:
        values["threads"] = options.threads
    if options.device is not None:
        values["device"] = options.device
    return with_values(settings, values)
