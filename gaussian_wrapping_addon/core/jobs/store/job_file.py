# SPDX-License-Identifier: GPL-3.0-or-later
"""The job file: command, input, settings and regions, the same for button and command line."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

from ...errors import DatasetError, ParseError, SettingError, UsageError
from ...files import read_json, real_path, write_json
from ...limits import SHORTEST_EDGE
from ...masks.model_file import check_model_file
from ...names import AUTOMATIC_REGIONS, region_name, region_names
from ...regions.region_file import parse_region_file, read_region_body
from ...settings import JobSettings, MeshingSettings, from_json, to_json
from .bake_request import BakeRequest

SCHEMA_VERSION = 1
COMMANDS = ("wrap", "mesh", "more", "bake")


@dataclass(frozen=True)
class JobFile:
    """One job. It contains the region files, so that resuming does not need them."""

    command: str
    source: str
    """Absolute path of the input: a folder or a transforms.json."""
    settings: JobSettings
    region_bodies: dict[str, Any] = field(default_factory=dict)
    """Content of each region file, keyed by its entry in ``settings.regions``."""
    edge_lengths: dict[str, float] = field(default_factory=dict)
    """Edge length, world units, of each region that has its own, by the same key. It replaces
    ``settings.meshing``'s edge length or number of points."""
    bake: BakeRequest | None = None
    """Of the command ``bake`` only; all else is of the job whose photos are baked."""

    def meshing_of(self, request: str) -> MeshingSettings:
        """Return the meshing settings of a region of ``settings.regions``."""
        meshing = self.settings.meshing
        if request not in self.edge_lengths:
            return meshing
        return replace(meshing, edge_length=self.edge_lengths[request], points=0)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        # Omitted if empty: job files stay as they were before this entry existed.
        own = {"edge_lengths": self.edge_lengths} if self.edge_lengths else {}
        bake = {"bake": self.bake.to_json()} if self.bake is not None else {}
        return {
            **own,
            **bake,
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
            An entry is missing, unknown, of the wrong type or out of range; a region is invalid.
        """
        wanted = {"schema_version", "command", "source", "settings", "region_bodies"}
        if not isinstance(values, dict) or set(values) - {"edge_lengths", "bake"} != wanted:
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
        settings = _settings_of(values["settings"])
        _check_source(values["source"])
        _check_bodies(settings, values["region_bodies"])
        lengths = _checked_lengths(values.get("edge_lengths", {}), settings.regions)
        if (values["command"] == "bake") != ("bake" in values):
            raise UsageError("job.json names no mesh to bake onto.", "Start the bake again.")
        bake = BakeRequest.from_json(values["bake"]) if "bake" in values else None
        bodies = values["region_bodies"]
        return cls(values["command"], values["source"], settings, bodies, lengths, bake)


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
        Edge lengths, world units, of regions that have their own, keyed by their entry in
        ``settings.regions``.

    Raises
    ------
    UsageError, DatasetError
        A setting is out of range; the source or a region file is missing or unreadable; two
        regions have the same name.
    """
    settings = settings.validated()
    _check_source(str(real_path(source)))
    own = _checked_lengths(dict(edge_lengths or {}), settings.regions)
    lengths: dict[str, float] = {}
    # A finished training may hold all that it needs of its input, such as the frames of a video.
    if command == "wrap" and not source.exists():
        raise DatasetError(f"{source} does not exist.", "Check the path.")
    names: list[str] = []
    bodies: dict[str, Any] = {}
    for region in settings.regions:
        if region in AUTOMATIC_REGIONS:
            names.append(region)
            lengths |= {region: own[region]} if region in own else {}
            continue
        path = Path(region)
        name = str(real_path(path))
        bodies[name] = read_region_body(path)
        parse_region_file(bodies[name], path)
        names.append(name)
        lengths |= {name: own[region]} if region in own else {}
    names = list(dict.fromkeys(names))
    region_names(names, bodies)
    start = settings.start_splat
    if start and not Path(start).is_file():
        raise DatasetError(f"The start splat {start} does not exist.", "Check the path.")
    if start and (settings.markers or settings.control_points or settings.georeference == "on"):
        raise UsageError(
            "A splat to start from lies in the frame of the cameras, which markers, control points "
            "and georeference on replace by metres.",
            "Leave one of them out; a result can be scaled by a measured length.",
        )
    from_splat = bool(start) or source.suffix.lower() == ".ply"
    if command == "wrap" and settings.training.blocks > 1 and from_splat:
        raise UsageError(
            "A training that starts from a splat cannot be divided into blocks.",
            "Leave out --blocks.",
        )
    control = settings.control_points
    # A finished training is meshed without it.
    if command == "wrap" and control and not Path(control).is_file():
        raise DatasetError(f"The control points {control} do not exist.", "Check the path.")
    training, mask_regions = settings.training, settings.mask_regions
    if command == "wrap":
        listed = json.dumps(list(bodies.values()), sort_keys=True)
        weighted = training.region_weight != 1.0 and bodies
        training = replace(training, focus=listed if weighted else "")
        mask_regions = listed if _makes_masks_of_regions(settings, source, bodies) else ""
    settings = replace(
        settings,
        training=training,
        mask_regions=mask_regions,
        mask_model=str(real_path(settings.mask_model)) if settings.mask_model else "",
        regions=tuple(names),
        start_splat=str(real_path(start)) if start else "",
        control_points=str(real_path(control)) if control else "",
    )
    return JobFile(command, str(real_path(source)), settings, bodies, lengths)


def _makes_masks_of_regions(settings: JobSettings, source: Path, bodies: Mapping[str, Any]) -> bool:
    """Return whether masks are made of region files; raise where the job could make none."""
    if not settings.masks_are_made:
        return False
    if source.suffix.lower() == ".ply":
        raise UsageError(
            "A splat alone has no photos that masks could be made for.", "Leave the masks out."
        )
    if settings.mask_model:
        check_model_file(Path(settings.mask_model))
        if settings.make_masks != "off":
            raise UsageError(
                "Masks are made of regions or by a model, not both.",
                "Give --make-masks region or --mask-model.",
            )
        return False
    if not bodies:
        raise UsageError(
            "Masks of a region need a region file: the automatic region is no object's.",
            "Give --region REGION.json with a box around the object.",
        )
    return True


def _settings_of(values: Any) -> JobSettings:
    """Return the settings of a job file; errors name the file, not options."""
    try:
        settings: JobSettings = from_json(JobSettings, values).validated()
    except SettingError as error:
        raise UsageError(
            f"job.json: settings.{error.setting} is out of range.", f"Give {error.wanted}."
        ) from None
    except UsageError as error:
        raise UsageError(f"job.json: {error.message}", error.hint) from None
    return settings


def _check_source(source: str) -> None:
    """Raise for a source that would be the working directory or a whole disk."""
    path = PurePath(source)
    if "\0" in source or path == PurePath(path.anchor):
        raise UsageError(
            f"{source!r} cannot be the source of a job.", "Give the folder of the photos."
        )


def _check_bodies(settings: JobSettings, bodies: dict[str, Any]) -> None:
    """Raise for regions of a job file that no stage could use."""
    missing = set(settings.regions) - set(AUTOMATIC_REGIONS) - set(bodies)
    if missing:
        raise UsageError(f"job.json holds no region {min(missing)!r}.", "Start the job again.")
    _check_regions(bodies)
    if (settings.make_masks != "off") != bool(settings.mask_regions):
        raise UsageError(
            "job.json: settings.mask_regions does not fit make_masks.", "Start the job again."
        )
    for where, text in (
        ("training.focus", settings.training.focus), ("mask_regions", settings.mask_regions),
    ):  # fmt: skip
        if text:
            _check_region_list(where, text)


def _check_region_list(where: str, text: str) -> None:
    """Raise for a setting that is no JSON list of region bodies."""
    try:
        listed = json.loads(text)
    except (ValueError, RecursionError):
        listed = None
    if not isinstance(listed, list) or not listed:
        raise UsageError(
            f"job.json: settings.{where} is no list of regions.", "Start the job again."
        )
    name = where.rpartition(".")[2]
    _check_regions({f"{name}[{number}]": body for number, body in enumerate(listed)})


def _check_regions(bodies: dict[str, Any]) -> None:
    for name, body in bodies.items():
        try:
            parse_region_file(body, Path(name))
        except ParseError as error:
            raise UsageError(f"job.json: {error.message}", "Start the job again.") from None


def make_bake_job(earlier: JobFile, request: BakeRequest) -> JobFile:
    """Return the job that bakes the photos of a finished job onto a mesh.

    Raises
    ------
    UsageError, DatasetError
        A setting is out of range, or a file does not exist.
    """
    return replace(earlier, command="bake", bake=request.validated())


def _checked_lengths(values: Any, regions: Sequence[str]) -> dict[str, float]:
    """Return validated edge lengths of single regions."""
    if not isinstance(values, dict) or not set(values) <= set(regions):
        raise UsageError("edge_lengths must name regions of the job.", "Start the job again.")
    for name, value in values.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not math.isfinite(value) or value < SHORTEST_EDGE:
            wanted = f"a positive length of at least {SHORTEST_EDGE:g}"
            raise SettingError(f"edge_lengths[{name!r}]", wanted)
    return {name: float(value) for name, value in values.items()}


def reject_region_conflicts(result: Path, job: JobFile) -> None:
    """Raise if a region of a job would overwrite the result of a different region.

    A region of the same name is the same region, meshed again.

    Parameters
    ----------
    result : Path
        The result folder of the job; need not exist.

    Raises
    ------
    UsageError
        Two regions of the job, or one of it and one meshed before, conflict; names both.
    ParseError
        A region in the job file is invalid.
    """
    region_names(job.settings.regions, job.region_bodies)
    folders = {
        parse_region_file(body, Path(request)).name: region_name(request, body)
        for request, body in job.region_bodies.items()
    }
    reject_folder_conflicts(result, folders)


def reject_folder_conflicts(result: Path, folders: dict[str, str]) -> None:
    """Raise if a region's result folder belongs to a region with another name.

    A region of the same name is the same region, meshed again.

    Parameters
    ----------
    folders : dict
        Folder name by region name, as the region's file gives it.

    Raises
    ------
    UsageError
        Two regions conflict; names both.
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
    if not os.path.lexists(path):
        raise UsageError(f"{path} does not exist.", "Choose a folder in which a job was started.")
    return JobFile.from_json(read_json(path))


def write_job(path: Path, job: JobFile) -> None:
    """Write ``job.json`` atomically."""
    write_json(path, job.to_json())
