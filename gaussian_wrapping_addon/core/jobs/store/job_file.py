# SPDX-License-Identifier: GPL-3.0-or-later
"""The job file and the sidecar of a result."""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import math
import os
import platform
import stat
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from ...errors import DatasetError, ParseError, SettingError, UsageError, WrapError
from ...files import finite_json, read_json, real_path, write_json
from ...limits import SHORTEST_EDGE
from ...masks.mask_folder import check_model_file
from ...names import AUTO, AUTOMATIC_REGIONS, RESULT_FORMATS, file_stem, region_name, region_names
from ...regions.files import SHAPE_ENTRIES, parse_region_file, read_region_body
from ...scene.camera import Similarity
from ...scene.frames import FileFrame
from ...settings import (
    UP_AXES,
    UV_CHOICES,
    JobSettings,
    MeshingSettings,
    TextureSettings,
    TrainingSettings,
    from_json,
    key_values,
    to_json,
)
from ...units.georeference import metric_from_world
from .stage_folder import STAGE_VERSIONS, stage_key

# -- What a job bakes the photos onto: the entry ``bake`` of the job file -------------------------
#
# Standard library only.

MAX_FACES = 100_000_000
MIN_FACES = 4
"""No closed surface has fewer."""


@dataclass(frozen=True)
class BakeRequest:
    """One mesh to bake onto."""

    mesh: str
    """Absolute path of the mesh: a file, or what Blender hands over."""
    name: str
    """Folder of the result below ``baked/``."""
    sidecar: str = ""
    """Absolute path of the sidecar of the file that the mesh was made from; may be empty."""
    up: str = "auto"
    """Up axis of the files: one of :data:`UP_AXES`."""
    uvs: str = "auto"
    """One of :data:`UV_CHOICES`."""
    faces: int = 0
    """Faces to decimate to; 0 keeps all."""
    dense: str = ""
    """Absolute path of the mesh whose detail goes into the normal map; may be empty."""
    texture: TextureSettings = field(default_factory=TextureSettings)
    export: tuple[str, ...] = ("glb",)

    def validated(self) -> BakeRequest:
        """Return self with a safe name, or raise.

        Raises UsageError: a choice is unknown or out of range, or contradicts another one;
        DatasetError: a file does not exist.
        """
        files = ((self.mesh, "mesh"), (self.sidecar, "sidecar"), (self.dense, "dense mesh"))
        for path, what in files:
            if (path or what == "mesh") and not os.path.isfile(path):
                raise DatasetError(f"The {what} {path} does not exist.", "Check the path.")
        for value, known in ((self.uvs, UV_CHOICES), (self.up, UP_AXES)):
            if value not in known:
                raise UsageError(f"{value!r} is no choice.", f"Give one of {', '.join(known)}.")
        if self.faces and not MIN_FACES <= self.faces <= MAX_FACES:
            raise UsageError(
                f"A mesh cannot have {self.faces} faces.",
                f"Give 0 (all) or from {MIN_FACES} to {MAX_FACES} faces.",
            )
        if self.faces and self.uvs == "own":
            raise UsageError(
                "A mesh with fewer faces cannot keep its UVs.",
                "Leave out --uvs own, or decimate the mesh before.",
            )
        if not set(self.export) <= set(RESULT_FORMATS):
            raise UsageError(
                "A format cannot be written by a bake.", f"Use {', '.join(RESULT_FORMATS)}."
            )
        if self.texture.lods:
            raise UsageError("Baking makes no levels of detail.", "Leave out --set lods.")
        JobSettings(texture=self.texture).validated()
        return replace(self, name=file_stem(self.name, 0))


# -- The job file: command, input, settings and regions, the same for button and command line -----

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
        bake = {"bake": to_json(self.bake)} if self.bake is not None else {}
        return {
            **own, **bake, "schema_version": SCHEMA_VERSION, "command": self.command,
            "source": self.source, "settings": to_json(self.settings),
            "region_bodies": self.region_bodies,
        }  # fmt: skip

    @classmethod
    def from_json(cls, values: Any) -> JobFile:
        """Build from :meth:`to_json`'s values.

        Raises UsageError: an entry is missing, unknown, of the wrong type or out of range; a region
        is invalid.
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
        try:
            bake = from_json(BakeRequest, values["bake"], "bake") if "bake" in values else None
        except TypeError:
            raise UsageError("job.json: bake names no mesh.", "Start the bake again.") from None
        bodies = values["region_bodies"]
        return cls(values["command"], values["source"], settings, bodies, lengths, bake)


def make_job(
    command: str, source: Path, settings: JobSettings,
    edge_lengths: Mapping[str, float] | None = None,
) -> JobFile:  # fmt: skip
    """Check the settings, read the region files, and return the job.

    ``edge_lengths``: of regions that have their own, world units, by entry in ``settings.regions``.
    Raises UsageError, DatasetError: a setting is out of range; the source or a region file is
    missing or unreadable; two regions have the same name.
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
            "Leave out --set blocks.",
        )
    control = settings.control_points
    # A finished training is meshed without it.
    if command == "wrap" and control and not Path(control).is_file():
        raise DatasetError(f"The control points {control} do not exist.", "Check the path.")
    training, mask_regions = settings.training, settings.mask_regions
    if command == "wrap":
        shapes = _shapes_of(bodies)
        training = replace(training, focus=_focus_of(training, names, shapes))
        listed = json.dumps(shapes, sort_keys=True)
        mask_regions = listed if _makes_masks_of_regions(settings, source, bodies) else ""
    settings = replace(
        settings, training=training, mask_regions=mask_regions,
        mask_model=str(real_path(settings.mask_model)) if settings.mask_model else "",
        regions=tuple(names), start_splat=str(real_path(start)) if start else "",
        control_points=str(real_path(control)) if control else "",
    )  # fmt: skip
    return JobFile(command, str(real_path(source)), settings, bodies, lengths)


def _shapes_of(bodies: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return where regions are, sorted: names and order are no reason to train again."""
    shapes = [{name: body[name] for name in SHAPE_ENTRIES} for body in bodies.values()]
    return [json.loads(text) for text in sorted({json.dumps(shape) for shape in shapes})]


def _focus_of(
    training: TrainingSettings, names: Sequence[str], shapes: Sequence[dict[str, Any]]
) -> str:
    """Return the setting that tells what the training is for; empty where that is everything."""
    if training.region_weight == 1.0 or "all" in names:
        return ""
    return json.dumps([*shapes, *([AUTO] if AUTO in names else [])], sort_keys=True)


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
                "Give --make-masks region or --set mask_model=FILE.",
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
            _check_region_list(where, text, automatic=where == "training.focus")


def _check_region_list(where: str, text: str, *, automatic: bool) -> None:
    """Raise for a setting that is no JSON list of region bodies, the automatic one among them."""
    try:
        listed = json.loads(text)
    except (ValueError, RecursionError):
        listed = None
    if not isinstance(listed, list) or not listed:
        raise UsageError(
            f"job.json: settings.{where} is no list of regions.", "Start the job again."
        )
    name = where.rpartition(".")[2]
    _check_regions(
        {
            f"{name}[{number}]": body
            for number, body in enumerate(listed)
            if not (automatic and body == AUTO)
        }
    )


def _check_regions(bodies: dict[str, Any]) -> None:
    for name, body in bodies.items():
        try:
            parse_region_file(body, Path(name))
        except ParseError as error:
            raise UsageError(f"job.json: {error.message}", "Start the job again.") from None


def make_bake_job(earlier: JobFile, request: BakeRequest) -> JobFile:
    """Return the job that bakes the photos of a finished job onto a mesh.

    Raises UsageError, DatasetError: a setting is out of range, or a file does not exist.
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
    """Raise if a region of a job would overwrite the result of a different region in ``result``.

    A region of the same name is the same region, meshed again. Raises UsageError: names both
    regions; ParseError: a region in the job file is invalid.
    """
    region_names(job.settings.regions, job.region_bodies)
    folders = {
        parse_region_file(body, Path(request)).name: region_name(request, body)
        for request, body in job.region_bodies.items()
    }
    reject_folder_conflicts(result, folders)


def reject_folder_conflicts(result: Path, folders: dict[str, str]) -> None:
    """Raise UsageError if a region's result folder belongs to a region with another name.

    ``folders``: folder name by region name, as the region's file gives it. A region of the same
    name is the same region, meshed again.
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


# -- Keys of trainings: the hashes that name their folders ----------------------------------------


def start_fingerprint(path: str) -> list[Any]:
    """Return path, size and time of the start splat for the stage key; empty for none.

    Raises DatasetError: the file does not exist, or is a pipe or a device.
    """
    if not path:
        return []
    hint = "Put the file back, or start the job without it."
    try:
        state = Path(path).stat()
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"The start splat {path} cannot be read: {getattr(error, 'strerror', error)}.", hint
        ) from None
    if not stat.S_ISREG(state.st_mode):
        raise DatasetError(f"The start splat {path} is not a regular file.", hint)
    return [path, state.st_size, state.st_mtime_ns]


def training_keys(cameras_key: str, job: JobFile) -> tuple[str, str]:
    """Return the key of a training's stage, and the key without the extra iterations."""
    described = key_values(job.settings.training)
    start = start_fingerprint(job.settings.start_splat)
    parts = (STAGE_VERSIONS["train"], cameras_key, job.settings.seed, *([start] if start else []))
    key = stage_key(*parts, described)
    described.pop("extra_iterations")
    return key, stage_key(*parts, described)


def blocks_key(cameras_key: str, job: JobFile) -> str:
    """Return the key of the blocks of a training: without what follows when they are joined."""
    described = key_values(job.settings.training)
    described.pop("extra_iterations")
    return stage_key("blocks", STAGE_VERSIONS["train"], cameras_key, job.settings.seed, described)


# -- Write the JSON sidecar of an exported file: its coordinate frame and how it was made ---------
#
# Exports are shared with others, so that it holds names and no paths of this machine.

_logger = logging.getLogger("gaussian_wrapping")

VERSION = 1
_PACKAGE = Path(__file__).resolve().parents[3]
_MANIFEST = "blender_manifest.toml"


def sidecar_path(path: Path) -> Path:
    """Return the path of an exported file's sidecar, such as ``auto.glb.json`` of ``auto.glb``."""
    return path.with_name(path.name + ".json")


def write_sidecar(
    path: Path, frame: FileFrame, world_from_scene: Similarity, blender_from_scene: Similarity, *,
    placed: bool, result: Path, contents: dict[str, Any],
) -> None:  # fmt: skip
    """Write the sidecar of ``path``.

    Parameters
    ----------
    path : Path
        The exported file.
    frame : FileFrame
        Frame of its coordinates.
    placed : bool
        Whether the target of ``frame`` is the scene as placed, else the world of the input.
    result : Path
        The result folder of the job; entries missing there are left out.
    contents : dict
        Content of the file: region, level, shading, number of vertices and faces, textures.
    """
    units = _units(result, frame, world_from_scene)
    in_metres = units is not None and units["applied"]
    unit = "metre" if in_metres else "unit of the input"
    values = {
        "version": VERSION, "file": path.name, "format": frame.format, "placed": placed,
        "unit": "metre, as placed in Blender" if placed else unit,
        **frame.to_json(world_from_scene, blender_from_scene),
        **({} if units is None else {"georeference": units}), **contents,
        **_source(result, contents.get("region")), "made_with": _versions(),
    }  # fmt: skip
    write_json(sidecar_path(path), finite_json(values))


def _units(result: Path, frame: FileFrame, world_from_scene: Similarity) -> dict[str, Any] | None:
    """Return the result's entry ``georeference``, with the way there from the file."""
    try:
        record = read_json(result / "scene.json").get("georeference")
    except (OSError, WrapError, AttributeError):
        return None
    metric = metric_from_world(record)
    if metric is None:
        return None
    metric_from_file = metric.after(world_from_scene).after(frame.file_from_scene().inverse())
    applied = bool(record.get("applied"))
    return {**record, "applied": applied, "metric_from_file": metric_from_file.to_json()}


def _source(result: Path, region: Any) -> dict[str, Any]:
    """Return the job and the region's file, as far as they exist."""
    out: dict[str, Any] = {"job": None, "region_body": None, "training": None}
    try:
        job_path, region_path = result.parent / "job.json", result / str(region) / "region.json"
        if job_path.is_file():
            job = read_job(job_path)
            settings = to_json(job.settings)
            settings["regions"] = [_name(r) for r in job.settings.regions]
            settings["start_splat"] = _name(job.settings.start_splat)
            settings["mask_model"] = _name(job.settings.mask_model)
            settings["control_points"] = _name(job.settings.control_points)
            out["job"] = {
                "name": result.parent.name, "command": job.command, "source": _name(job.source),
                "settings": settings,
            }  # fmt: skip
        if region is not None and region_path.is_file():
            out["region_body"] = read_json(region_path)
        figures_path = result / str(region) / "figures.json"
        if region is not None and figures_path.is_file():
            out["training"] = read_json(figures_path).get("training")
    except WrapError as error:
        # The mesh is valid all the same: an incomplete sidecar is better than no export.
        _logger.warning("the sidecar is incomplete: %s", error)
    return out


def _name(text: str) -> str:
    return text if text in AUTOMATIC_REGIONS else Path(text).name


def _versions() -> dict[str, str | None]:
    bpy = sys.modules.get("bpy")
    return {
        "add_on": add_on_version(), "code": code_fingerprint(), "python": platform.python_version(),
        "numpy": np.__version__, "blender": None if bpy is None else str(bpy.app.version_string),
    }  # fmt: skip


@functools.cache
def add_on_version() -> str:
    """Return the version in the manifest; ``"unknown"`` if there is none beside the package."""
    for folder in (_PACKAGE, _PACKAGE.parent):
        path = folder / _MANIFEST
        if path.is_file():
            return str(tomllib.loads(path.read_text(encoding="utf-8")).get("version", "unknown"))
    return "unknown"


@functools.cache
def code_fingerprint() -> str:
    """Return a hash of all code files, 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
        digest.update(path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
