# SPDX-License-Identifier: GPL-3.0-or-later
"""Read the files of a finished bake, ``baked/NAME``, validated before they reach Blender."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError, ParseError
from ...core.files import read_json
from ...core.mesh.polygons import POLYGONS_FILE, Polygons, read_polygons
from ...core.mesh.udims import FIRST_UDIM, LAST_UDIM, udim_uvs
from ...core.regular_files import reject_foreign_entries
from ...core.texture.files.file_checks import atlas_file
from ..results.result_files import read_mesh_arrays

_HINT = "Bake the photos again."


@dataclass(frozen=True)
class BakedFiles:
    """A finished bake."""

    name: str
    vertices: np.ndarray
    """(v, 3) float64, scene frame."""
    faces: np.ndarray
    """(f, 3) int32, in the order of the mesh that was handed over."""
    corner_uvs: np.ndarray
    """(f, 3, 2) float32, in UDIM tiles if there are several."""
    udims: tuple[int, ...]
    """Empty for a single texture."""
    albedo: tuple[Path, ...]
    normal_map: tuple[Path, ...]
    """The same, or empty."""
    occlusion: tuple[Path, ...]
    """The same, or empty."""
    has_own_uvs: bool
    """Whether the UVs are those of the mesh that was handed over."""
    has_own_faces: bool
    """Whether the faces are."""
    polygons: Polygons | None
    """Polygons of faces that were made for the bake; ``None`` where the object has them already."""
    coverage: float
    """Share of the texels that photos see."""
    warnings: tuple[str, ...]


def read_baked(folder: Path) -> BakedFiles:
    """Read and check a folder of a bake.

    Raises
    ------
    DatasetError, ParseError
        A file is missing or invalid, or the folder holds links.
    """
    reject_foreign_entries(folder)
    path = folder / "mesh.npz"
    if not path.is_file():
        raise DatasetError(f"{folder} holds no mesh.npz.", _HINT)
    vertices, faces, corner_uvs, face_atlas = read_mesh_arrays(path, repair=False)
    made = folder / POLYGONS_FILE
    polygons = read_polygons(made, len(faces)) if made.is_file() else None
    figures_path = folder / "bake.json"
    values = read_json(figures_path)
    try:
        udims = tuple(int(number) for number in values["udims"])
        texture = values["texture"]
        has_own_faces = int(values["faces_given"]) == len(faces)
        has_own_uvs = texture["unwrap"] == "own"
        coverage = float(texture["coverage"])
        warnings = tuple(str(warning["text"]) for warning in texture["warnings"])
        if not all(FIRST_UDIM <= number <= LAST_UDIM for number in udims):
            raise ValueError("a UDIM number is out of range")
        atlases = 1 if face_atlas is None else int(face_atlas.max()) + 1
        if udims and len(udims) < atlases:
            raise ValueError("there are fewer tiles than textures")
    except (KeyError, TypeError, ValueError) as error:
        raise ParseError(figures_path, "whole file", f"not of a bake ({error}).", _HINT) from None
    albedo, normal_map, occlusion = (
        tuple(folder / atlas_file(name, number, udims) for number in range(max(len(udims), 1)))
        for name in ("albedo", "normal", "occlusion")
    )
    normal_map = normal_map if normal_map[0].is_file() else ()
    occlusion = occlusion if occlusion[0].is_file() else ()
    for image in (*albedo, *normal_map, *occlusion):
        if not image.is_file():
            raise DatasetError(f"{folder} holds no {image.name}.", _HINT)
    if udims:
        corner_uvs = udim_uvs(corner_uvs, face_atlas, udims)
    return BakedFiles(
        folder.name, vertices, faces, corner_uvs, udims, albedo, normal_map, occlusion, has_own_uvs,
        has_own_faces, polygons, coverage, warnings,
    )  # fmt: skip
