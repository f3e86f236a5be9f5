# SPDX-License-Identifier: GPL-3.0-or-later
"""The job: what is asked for, the same for button, command line and bug report."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import DatasetError, ParseError, SettingError, UsageError
from ..files import read_json, write_json
from ..names import is_reserved_name
from ..regions.region_file import parse_region_file, read_region_body
from ..settings import JobSettings, MeshingSettings, from_json, to_json
from .stages import stage_key

SCHEMA_VERSION = 1
COMMANDS = ("wrap", "mesh", "more")
AUTOMATIC_REGIONS = ("auto", "all")
NAME_CHARACTERS = 40
PICTURES = "report"
"""Folder of a result in which the report's pictures lie: no region's."""


@dataclass(frozen=True)
class JobFile:
    """One job. Region files are read when the job is made, so that a resume needs none of them."""

    command: str
    source: str
    """Absolute path of the input: a folder or a transforms.json."""
    settings: JobSettings
    region_bodies: dict[str, Any] = field(default_factory=dict)
    """Content of each region file, by the string that names it in ``settings.regions``."""
    edge_lengths: dict[str, float] = field(default_factory=dict)
    """Edge length, world units, of each region that has its own, by the same string. It decides
    there in place of ``settings.meshing``'s edge length or number of points."""

    def meshing_of(self, request: str) -> MeshingSettings:
        """Return how a region of ``settings.regions`` is meshed."""
        meshing = self.settings.meshing
        if request not in self.edge_lengths:
            return meshing
        return replace(meshing, edge_length=self.edge_lengths[request], points=0)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        # Jobs without lengths of their own are written as before there were any.
        own = {"edge_lengths": self.edge_lengths} if self.edge_lengths else {}
        return {
            **own,
            "schema_version": SCHEMA_VERSION,
            "command": self.command,
            "source": self.source,
            "settings": to_json(self.settings),
            "region_bodies": self.region_bodies,
        }

    @classmethod
    def from_json(cls, values: Any) -> JobFile:
        """Build from :meth:`to_json`'s values.

        Raises
        ------
        UsageError
            An entry is missing, unknown, of the wrong type or out of range.
        """
        wanted = {"schema_version", "command", "source", "settings", "region_bodies"}
        if not isinstance(values, dict) or set(values) - {"edge_lengths"} != wanted:
            raise UsageError("job.json does not hold the entries of a job.", "Start the job again.")
        if values["schema_version"] != SCHEMA_VERSION:
            raise UsageError(
                f"job.json has schema version {values['schema_version']!r}, not {SCHEMA_VERSION}.",
                "Start the job again with this version of the add-on.",
            )
        if values["command"] not in COMMANDS or not isinstance(values["source"], str):
            raise UsageError("job.json names no command or source.", "Start the job again.")
        if not isinstance(values["region_bodies"], dict):
            raise UsageError("job.json: region_bodies must be an object.", "Start the job again.")
        settings = from_json(JobSettings, values["settings"]).validated()
        lengths = _checked_lengths(values.get("edge_lengths", {}), settings.regions)
        return cls(values["command"], values["source"], settings, values["region_bodies"], lengths)


def make_job(
    command: str,
    source: Path,
    settings: JobSettings,
    edge_lengths: Mapping[str, float] | None = None,
) -> JobFile:
    """Check the settings, read the region files, and return the job.

    Parameters
    ----------
    edge_lengths : mapping, optional
        Edge lengths, world units, of regions that have their own, by their string in
        ``settings.regions``.

    Raises
    ------
    UsageError, DatasetError
        A setting is out of range; the source or a region file is missing or unreadable; two
        regions have one name.
    """
    settings = settings.validated()
    own = _checked_lengths(dict(edge_lengths or {}), settings.regions)
    lengths: dict[str, float] = {}
    if not source.exists():
        raise DatasetError(f"{source} does not exist.", "Check the path.")
    names: list[str] = []
    bodies: dict[str, Any] = {}
    for region in settings.regions:
        if region in AUTOMATIC_REGIONS:
            names.append(region)
            lengths |= {region: own[region]} if region in own else {}
            continue
        path = Path(region)
        name = str(path.resolve())
        bodies[name] = read_region_body(path)
        parse_region_file(bodies[name], path)
        names.append(name)
        lengths |= {name: own[region]} if region in own else {}
    names = list(dict.fromkeys(names))
    region_names(names, bodies)
    start = settings.start_splat
    if start and not Path(start).is_file():
        raise DatasetError(f"The start splat {start} does not exist.", "Check the path.")
    training = settings.training
    if command == "wrap":
        weighted = training.region_weight != 1.0 and bodies
        focus = json.dumps(list(bodies.values()), sort_keys=True) if weighted else ""
        training = replace(training, focus=focus)
    settings = replace(
        settings,
        training=training,
        regions=tuple(names),
        start_splat=str(Path(start).resolve()) if start else "",
    )
    return JobFile(command, str(source.resolve()), settings, bodies, lengths)


def _checked_lengths(values: Any, regions: Sequence[str]) -> dict[str, float]:
    """Return edge lengths of single regions, or refuse them."""
    if not isinstance(values, dict) or not set(values) <= set(regions):
        raise UsageError("edge_lengths must name regions of the job.", "Start the job again.")
    for name, value in values.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not math.isfinite(value) or value <= 0:
            raise SettingError(f"edge_lengths[{name!r}]", "a positive length")
    return {name: float(value) for name, value in values.items()}


def region_name(request: str, body: Any) -> str:
    """Return the folder name of a requested region: ASCII, short, never empty."""
    if request in AUTOMATIC_REGIONS:
        return request
    text = _wanted_name(request, body)
    clean = re.sub(r"[^A-Za-z0-9_-]+", "_", text).strip("_")[:NAME_CHARACTERS]
    if not clean or clean.lower() in AUTOMATIC_REGIONS:
        return f"region_{stage_key(request)[:6]}"
    taken = clean.lower() == PICTURES or is_reserved_name(clean)
    return f"region_{clean}" if taken else clean


def _wanted_name(request: str, body: Any) -> str:
    wanted = body.get("blender_object_name") if isinstance(body, dict) else None
    return wanted if isinstance(wanted, str) and wanted.strip() else Path(request).stem


def region_names(requests: Sequence[str], bodies: dict[str, Any]) -> list[str]:
    """Return the folder names of all requested regions.

    Raises
    ------
    UsageError
        Two have one name, or names that are one where case does not count: the result of one
        would replace that of the other.
    """
    names = [region_name(request, bodies.get(request)) for request in requests]
    for index, name in enumerate(names):
        if name.lower() in (other.lower() for other in names[:index]):
            raise UsageError(
                f"Two regions have the same name, {name}.", "Give each region its own name."
            )
    return names


def refuse_other_regions(result: Path, folders: dict[str, str]) -> None:
    """Refuse regions whose folder in a result is that of a region with another name.

    A region of the same name is the same region, meshed again.

    Parameters
    ----------
    folders : dict
        For the name of each region, as its file gives it, that of its folder.

    Raises
    ------
    UsageError
        Names both.
    """
    there = {path.parent.name: path for path in sorted(result.glob("*/region.json"))}
    for wanted, name in folders.items():
        for folder, path in there.items():
            if folder.lower() != name.lower():
                continue
            try:
                found = read_json(path).get("blender_object_name")
            except (OSError, ParseError, AttributeError):
                continue
            if isinstance(found, str) and found != wanted:
                raise UsageError(
                    f"Region {wanted!r} would replace the result of region {found!r}: both are "
                    f"kept in a folder {name}.",
                    "Give it another name.",
                )


def read_job(path: Path) -> JobFile:
    """Read ``job.json``."""
    if not path.is_file():
        raise UsageError(f"{path} does not exist.", "Choose a folder in which a job was started.")
    return JobFile.from_json(read_json(path))


def write_job(path: Path, job: JobFile) -> None:
    """Write ``job.json`` atomically."""
    write_json(path, job.to_json())
