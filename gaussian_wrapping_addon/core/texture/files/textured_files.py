# SPDX-License-Identifier: GPL-3.0-or-later
"""Write textured meshes: arrays for Blender, PLY, OBJ, GLB, and their coordinate frames.

| file | coordinates |
|---|---|
| ``mesh.npz`` | scene frame, float64 |
| ``mesh.ply`` | world, double |
| ``mesh.obj`` | world minus ``offset``, world axes |
| ``mesh.glb`` | world minus ``offset``, rotated from Z up to Y up (x, z, -y), float32 |

``offset`` is 0 unless the mesh is so far from the origin that float32 precision would be visible;
it is written to ``transform.json`` and into the GLB's node.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...dataset.frames.file_frame import file_offset
from ...dataset.similarity import Similarity
from ...errors import UsageError
from ...export_formats import RESULT_FORMATS
from ...files import write_bytes, write_json
from ...mesh.tangent_frame import shading_normals
from ...mesh.textured_mesh import TexturedMesh
from ...mesh.udims import udim_uvs
from .file_checks import atlas_file, validate_for_export, write_errors
from .glb import glb_bytes
from .mesh_ply import vertex_colors, write_mesh_ply
from .shading import OBJ_SHININESS, SPECULAR_LEVEL


def write_obj(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uvs: np.ndarray,
    image_name: str | Sequence[str],
    normal_name: str | Sequence[str] | None = None,
    face_atlas: np.ndarray | None = None,
) -> None:
    """Write an OBJ and its ``.mtl``, which refers to an image in the same folder.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int32
    corner_uvs : (f, 3, 2) float32
        v upwards, as in OBJ.
    image_name : str or sequence of str
        One per atlas; without spaces, which OBJ readers handle differently.
    normal_name : the same, optional
        A normal map, written as ``map_Bump``, as Blender writes and reads it.
    face_atlas : (f,) int, optional
        Atlas of each face, if there are several; each has its own material.
    """
    validate_for_export(vertices, faces, corner_uvs)
    names = [image_name] if isinstance(image_name, str) else list(image_name)
    bumps = [normal_name] if isinstance(normal_name, str) else list(normal_name or ())
    for name in names:
        if any(c.isspace() for c in name + path.name):
            raise UsageError(f"OBJ files cannot refer to {name!r}.", "Use a name without spaces.")
    uvs, corner = np.unique(corner_uvs.reshape(-1, 2), axis=0, return_inverse=True)
    corner = corner.reshape(-1, 3) + 1
    owner = np.asarray(faces) + 1
    table = np.stack([owner, corner, owner], axis=2).reshape(-1, 9)
    text = io.StringIO()
    text.write(f"mtllib {path.stem}.mtl\no {path.stem}\n")
    np.savetxt(text, vertices, fmt="v %.9g %.9g %.9g")
    np.savetxt(text, uvs, fmt="vt %.7f %.7f")
    # Without normals, readers shade faces flat, which does not match the normal map.
    np.savetxt(text, shading_normals(vertices, faces), fmt="vn %.6f %.6f %.6f")
    atlas = np.zeros(len(table), np.uint8) if face_atlas is None else face_atlas
    shine = " ".join([str(SPECULAR_LEVEL)] * 3)
    material = ""
    for number, name in enumerate(names):
        called = Path(atlas_file("albedo", number)).stem
        text.write(f"usemtl {called}\n")
        np.savetxt(text, table[atlas == number], fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
        material += f"newmtl {called}\nNs {OBJ_SHININESS:.6g}\nKa 1 1 1\nKd 1 1 1\nKs {shine}\n"
        material += f"Ni 1.5\nd 1\nillum 2\nmap_Kd {name}\n"
        if bumps:
            material += f"map_Bump -bm 1 {bumps[number]}\n"
    with write_errors(path):
        write_bytes(path.with_suffix(".mtl"), material.encode())
        write_bytes(path, text.getvalue().encode())


def write_glb(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uvs: np.ndarray,
    png: bytes | Sequence[bytes],
    offset: np.ndarray,
    *,
    normal_png: bytes | Sequence[bytes] | None = None,
    occlusion_png: bytes | Sequence[bytes] | None = None,
    shading: str = "auto",
    face_atlas: np.ndarray | None = None,
) -> None:
    """Write a binary glTF with the images inside; see :func:`.glb.glb_bytes`."""
    validate_for_export(vertices, faces, corner_uvs)
    with write_errors(path):
        data = glb_bytes(
            vertices, faces, corner_uvs, png, offset,
            normal_png=normal_png, occlusion_png=occlusion_png, shading=shading,
            face_atlas=face_atlas,
        )  # fmt: skip
        write_bytes(path, data)


def write_textured(
    textured: TexturedMesh,
    folder: Path,
    formats: tuple[str, ...],
    world_from_scene: Similarity,
    offset: np.ndarray | None = None,
) -> None:
    """Write ``mesh.npz``, ``albedo.png``, ``mesh.ply``, ``transform.json`` and further formats.

    ``normal.png`` and ``occlusion.png`` are written if the mesh has these maps; further atlases
    are ``albedo-2.png`` and on, or ``albedo.1001.png`` and on if the mesh has UDIM tiles. Then the
    UVs of the OBJ lie in their tiles; those of the other files lie in [0, 1].

    Parameters
    ----------
    textured : TexturedMesh
        Scene frame.
    folder : Path
        Created if missing.
    formats : tuple of str
        Elements of :data:`RESULT_FORMATS`; ``"ply"`` is always written.
    world_from_scene : Similarity
        Transform to the world frame of the input.
    offset : (3,) float64, optional
        Offset subtracted in the files, to align several of them; by default
        :func:`file_offset`.

    Raises
    ------
    MeshingError
        The mesh is empty or not finite.
    UsageError
        Unknown format.
    ResourceError
        The folder cannot be written.
    """
    unknown = sorted(set(formats) - set(RESULT_FORMATS))
    if unknown:
        raise UsageError(
            f"Unknown export format {unknown[0]!r}.", f"Use {', '.join(RESULT_FORMATS)}."
        )
    mesh = textured.mesh
    validate_for_export(mesh.vertices, mesh.faces, textured.corner_uvs)
    world = world_from_scene.points(mesh.vertices)
    offset = file_offset(world) if offset is None else offset
    atlases, face_atlas, udims = textured.atlases, textured.face_atlas, textured.udims
    images = {
        "albedo": [a.albedo for a in atlases],
        "normal": [a.normal_map for a in atlases if a.normal_map is not None],
        "occlusion": [a.occlusion for a in atlases if a.occlusion is not None],
    }
    pngs = {name: [png_bytes(image) for image in several] for name, several in images.items()}
    arrays = {} if face_atlas is None else {"face_atlas": np.asarray(face_atlas, np.uint8)}
    if udims:
        arrays["udims"] = np.asarray(udims, np.int32)
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        stream = io.BytesIO()
        np.savez(
            stream,
            vertices=np.asarray(mesh.vertices, np.float64),
            faces=np.asarray(mesh.faces, np.int32),
            corner_uvs=np.asarray(textured.corner_uvs, np.float32),
            **arrays,
        )
        write_bytes(folder / "mesh.npz", stream.getvalue())
        for name, several in pngs.items():
            for number, data in enumerate(several):
                write_bytes(folder / atlas_file(name, number, udims), data)
        write_json(
            folder / "transform.json",
            {
                "version": 1,
                "offset": offset.tolist(),
                "world_from_scene": world_from_scene.to_json(),
                "frames": {
                    "mesh.npz": "scene",
                    "mesh.ply": "world",
                    "mesh.obj": "world = file + offset",
                    "mesh.glb": "world = (x, -z, y) of the file + offset",
                },
            },
        )
    colors = vertex_colors(
        len(world), mesh.faces, textured.corner_uvs, images["albedo"], face_atlas
    )
    write_mesh_ply(folder / "mesh.ply", world, mesh.faces, colors)
    local = world - offset
    if "obj" in formats:
        write_obj(
            folder / "mesh.obj",
            local,
            mesh.faces,
            udim_uvs(textured.corner_uvs, face_atlas, udims) if udims else textured.corner_uvs,
            [atlas_file("albedo", number, udims) for number in range(len(atlases))],
            [atlas_file("normal", number, udims) for number in range(len(images["normal"]))],
            face_atlas,
        )
    if "glb" in formats:
        write_glb(
            folder / "mesh.glb",
            local,
            mesh.faces,
            textured.corner_uvs,
            pngs["albedo"],
            offset,
            normal_png=pngs["normal"] or None,
            occlusion_png=pngs["occlusion"] or None,
            face_atlas=face_atlas,
        )


def png_bytes(image: np.ndarray) -> bytes:
    """Encode (h, w, 3) or grey (h, w) uint8 as PNG."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="PNG", compress_level=4)
    return stream.getvalue()
