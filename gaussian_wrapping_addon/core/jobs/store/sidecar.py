# SPDX-License-Identifier: GPL-3.0-or-later
"""Write the JSON sidecar of an exported file: its coordinate frame and how it was made.

Exports are shared with others, so that it holds names and no paths of this machine.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import platform
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from ...dataset.frames.file_frame import FileFrame
from ...dataset.similarity import Similarity
from ...dataset.units.real_units import metric_from_world
from ...errors import WrapError
from ...files import finite_json, read_json, write_json
from ...names import AUTOMATIC_REGIONS
from ...settings import to_json
from .job_file import read_job

_logger = logging.getLogger("gaussian_wrapping")

VERSION = 1
_PACKAGE = Path(__file__).resolve().parents[3]
_MANIFEST = "blender_manifest.toml"


def sidecar_path(path: Path) -> Path:
    """Return the path of an exported file's sidecar, such as ``auto.glb.json`` of ``auto.glb``."""
    return path.with_name(path.name + ".json")


def write_sidecar(
    path: Path,
    frame: FileFrame,
    world_from_scene: Similarity,
    blender_from_scene: Similarity,
    *,
    placed: bool,
    result: Path,
    contents: dict[str, Any],
) -> None:
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
        "version": VERSION,
        "file": path.name,
        "format": frame.format,
        "placed": placed,
        "unit": "metre, as placed in Blender" if placed else unit,
        **frame.to_json(world_from_scene, blender_from_scene),
        **({} if units is None else {"georeference": units}),
        **contents,
        **_source(result, contents.get("region")),
        "made_with": _versions(),
    }
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
    metric_from_scene = metric.after(world_from_scene)
    metric_from_file = metric_from_scene.after(frame.file_from_scene().inverse())
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
        "add_on": add_on_version(),
        "code": code_fingerprint(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "blender": None if bpy is None else str(bpy.app.version_string),
    }


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
