# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write the files of a tiled mesh (docs/file-formats.md, Tiles); writes are atomic."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...array_file import read_arrays, write_arrays
from ...errors import ParseError
from ...files import read_json, write_json
from ...progress import read_warnings
from ...regions.shapes import Region, Tiling
from ..spacing import Spacing
from ..surface_points import CandidateSurface, Caps, SurfacePoints
from .plan import TilePlan
from .tile import GatheredPoints, TileSurface

LIST_NAME = "tiles.json"
VERSION = 3
_PLAN_ARRAYS = (
    "vertices", "faces", "fillers", "region", "cap_points", "cap_normals", "cap_radii",
    "cap_priority", "spacing_points", "spacing_radii",
)  # fmt: skip
_CLOUD_ARRAYS = ("points", "normals", "kind", "radius", "radii", "notes", "figures")
_SURFACE_ARRAYS = (
    "vertices", "faces", "number", "kind", "into", "level", "border", "solid", "least_height",
    "figures",
)  # fmt: skip
_AGAIN = "Delete this file and resume: it is made again."


def points_path(folder: Path, tile: int) -> Path:
    """Return the file of a tile's points."""
    return folder / f"points-{tile:04d}.npz"


def faces_path(folder: Path, tile: int) -> Path:
    """Return the file of a tile's faces."""
    return folder / f"faces-{tile:04d}.npz"


def gathered_path(folder: Path) -> Path:
    """Return the file of the gathered points."""
    return folder / "points.npz"


def is_planned(folder: Path) -> bool:
    """Return whether a folder holds a plan; one of another version does not count."""
    try:
        values = read_json(folder / LIST_NAME)
    except (OSError, ParseError):
        return False
    return isinstance(values, dict) and values.get("version") == VERSION


def save_plan(folder: Path, plan: TilePlan, noted: dict[str, Any]) -> None:
    """Write a plan, and JSON values noted for whoever joins the tiles; its JSON file comes last."""
    folder.mkdir(parents=True, exist_ok=True)
    write_arrays(
        folder / "plan.npz",
        vertices=plan.surface.vertices, faces=plan.surface.faces, fillers=plan.steiner_points,
        region=plan.region.vertices, cap_points=plan.caps.points, cap_normals=plan.caps.normals,
        cap_radii=plan.caps.radii, cap_priority=plan.caps.priority,
        spacing_points=plan.spacing.points, spacing_radii=plan.spacing.radii,
    )  # fmt: skip
    boxes = [plan.tiling.box(tile) for tile in range(len(plan.tiling))]
    write_json(
        folder / LIST_NAME,
        {
            "version": VERSION, "region": plan.region.name, "noted": noted, "seed": plan.seed,
            "radius": plan.spacing.nominal, "limited": plan.spacing.limited,
            "notes": [note.to_json() for note in plan.notes], "edge_length": plan.edge_length,
            "target": plan.target, "share": plan.share, "sightings": plan.depth_samples,
            "ball": plan.ball_radius, "area": plan.area, "gaussians": plan.surface.gaussians,
            "pivots": plan.surface.pivots, "splits": plan.tiling.to_json(),
            "tiles": [[_finite(low), _finite(high)] for low, high in boxes],
        },
    )  # fmt: skip


def _finite(corner: np.ndarray) -> list[float | None]:
    return [float(x) if np.isfinite(x) else None for x in corner]


def load_plan(folder: Path) -> tuple[TilePlan, dict[str, Any]]:
    """Read a plan and what was noted with it.

    Raises ParseError: the JSON file has another version, or a file is damaged.
    """
    path = folder / LIST_NAME
    try:
        values = read_json(path)
        if values["version"] != VERSION:
            raise ParseError(path, "version", "is not known.", "Mesh the region again.")
        arrays = read_arrays(folder / "plan.npz", _PLAN_ARRAYS, hint="Mesh the region again.")
        plan = TilePlan(
            Region(str(values["region"]), arrays["region"]),
            CandidateSurface(
                arrays["vertices"], arrays["faces"], int(values["gaussians"]), int(values["pivots"])
            ),
            float(values["area"]),
            Spacing(
                arrays["spacing_points"], arrays["spacing_radii"], float(values["radius"]),
                float(values["limited"]),
            ),
            Tiling.from_json(values["splits"]),
            arrays["fillers"],
            float(values["ball"]),
            Caps(*(arrays[f"cap_{name}"] for name in ("points", "normals", "radii", "priority"))),
            int(values["seed"]), read_warnings(values["notes"]), float(values["edge_length"]),
            int(values["target"]), float(values["share"]), int(values["sightings"]),
        )  # fmt: skip
        return plan, dict(values["noted"])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ParseError(path, "whole file", f"{error}.", "Mesh the region again.") from None


def save_points(path: Path, cloud: SurfacePoints) -> None:
    """Write the points of a tile."""
    write_arrays(path, **_of_cloud(cloud))


def load_points(path: Path) -> SurfacePoints:
    """Read the points of a tile; :class:`ParseError` where the file is damaged."""
    return _cloud_of(path, read_arrays(path, _CLOUD_ARRAYS, hint=_AGAIN))


def save_gathered(path: Path, gathered: GatheredPoints) -> None:
    """Write the points of all tiles."""
    write_arrays(path, shifted=gathered.shifted, inner=gathered.inner, **_of_cloud(gathered.cloud))


def load_gathered(path: Path) -> GatheredPoints:
    """Read the points of all tiles; :class:`ParseError` where the file is damaged."""
    arrays = read_arrays(path, (*_CLOUD_ARRAYS, "shifted", "inner"), hint=_AGAIN)
    return GatheredPoints(_cloud_of(path, arrays), arrays["shifted"], arrays["inner"])


def load_point_figures(path: Path) -> dict[str, Any]:
    """Read only what was counted of the points of all tiles; :class:`ParseError` as above."""
    arrays = read_arrays(path, ("figures",), hint=_AGAIN)
    with _damaged(path):
        return dict(json.loads(str(arrays["figures"])))


def save_surface(path: Path, surface: TileSurface) -> None:
    """Write the surface of a tile."""
    values = {name: getattr(surface, name) for name in _SURFACE_ARRAYS}
    values["least_height"] = np.array(surface.least_height)
    values["figures"] = np.array(json.dumps(surface.figures))
    write_arrays(path, **values)


def load_surface(path: Path) -> TileSurface:
    """Read the surface of a tile; :class:`ParseError` where the file is damaged."""
    arrays: dict[str, Any] = read_arrays(path, _SURFACE_ARRAYS, hint=_AGAIN)
    with _damaged(path):
        arrays["least_height"] = float(arrays["least_height"])
        arrays["figures"] = json.loads(str(arrays["figures"]))
    return TileSurface(**arrays)


def _of_cloud(cloud: SurfacePoints) -> dict[str, np.ndarray]:
    return {
        "points": cloud.points, "normals": cloud.normals, "kind": cloud.kind,
        "radius": np.array(cloud.radius), "radii": cloud.radii,
        "notes": np.array(json.dumps([note.to_json() for note in cloud.notes])),
        "figures": np.array(json.dumps(cloud.figures)),
    }  # fmt: skip


def _cloud_of(path: Path, arrays: dict[str, np.ndarray]) -> SurfacePoints:
    with _damaged(path):
        return SurfacePoints(
            arrays["points"], arrays["normals"], arrays["kind"], arrays["radii"],
            float(arrays["radius"]), read_warnings(json.loads(str(arrays["notes"]))),
            json.loads(str(arrays["figures"])),
        )  # fmt: skip


@contextlib.contextmanager
def _damaged(path: Path) -> Iterator[None]:
    try:
        yield
    except (TypeError, ValueError) as error:
        raise ParseError(path, "whole file", f"{error}.", _AGAIN) from None
