# SPDX-License-Identifier: GPL-3.0-or-later
"""Table of export formats for jobs, command line and Blender.

Standard library only, so that the command line's help needs no numpy.
"""

from __future__ import annotations

from dataclasses import dataclass

SHADINGS = ("auto", "lit", "unlit")


@dataclass(frozen=True)
class ExportFormat:
    """Names, writer and capabilities of an export format."""

    name: str
    """Identifier in options and job files."""
    label: str
    """Label in Blender's panel."""
    help: str
    """Content, for the panel's tooltip."""
    suffix: str
    needs_blender: bool = False
    """Whether only Blender's exporter writes it; the worker writes the others."""
    in_jobs: bool = True
    """Whether a job can write it with its result (``--export``)."""
    of_mesh: bool = True
    """Whether it contains a mesh; otherwise the Gaussians."""
    textures: str = "beside"
    """``"inside"`` the file, ``"beside"`` it, ``"either"`` (an option), or ``"none"``."""
    packed_suffix: str = ""
    """Suffix of a file with packed textures, if it differs from ``suffix``."""
    y_up: bool = False
    """Whether its up axis is Y; otherwise Z."""
    doubles: bool = False
    """Whether coordinates are double precision and need no offset."""
    unlit: str = "lit"
    """Export of an unlit material in Blender: ``"keep"``, ``"emission"`` or ``"lit"``."""

    def file_suffix(self, *, pack: bool) -> str:
        """Return the suffix of a file, with textures packed into it or not."""
        return (self.packed_suffix if pack else "") or self.suffix


EXPORT_FORMATS = {
    format.name: format
    for format in (
        ExportFormat(
            "glb", "glTF Binary (.glb)", "Textures inside; lit or unlit as the material is",
            ".glb", textures="inside", y_up=True, unlit="keep",
        ),
        ExportFormat("obj", "OBJ (.obj)", "Textures beside the file", ".obj", y_up=True),
        ExportFormat(
            "ply", "PLY (.ply)", "Double precision and vertex colours, no texture",
            ".ply", textures="none", doubles=True,
        ),
        ExportFormat(
            "splat", "Gaussians (.ply)", "Gaussians for splat viewers",
            ".ply", in_jobs=False, of_mesh=False, textures="none",
        ),
        ExportFormat(
            "usd", "USD (.usdc)", "Textures beside the file, or inside as .usdz",
            ".usdc", needs_blender=True, textures="either", packed_suffix=".usdz",
            unlit="emission",
        ),
        ExportFormat(
            "fbx", "FBX (.fbx)", "Textures beside the file, or inside",
            ".fbx", needs_blender=True, in_jobs=False, textures="either", y_up=True,
        ),
    )
}  # fmt: skip
"""Every format, by name."""

WORKER_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if not f.needs_blender)
BLENDER_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if f.needs_blender)
JOB_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if f.in_jobs)
MESH_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if f.of_mesh)
"""Formats of **Export Meshes** in Blender."""
RESULT_FORMATS = tuple(name for name in JOB_FORMATS if name in WORKER_FORMATS)
"""Formats that the worker writes to a result."""
PACKABLE_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if f.textures == "either")
