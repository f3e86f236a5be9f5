# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job bakes the photos onto: the entry ``bake`` of the job file.

Standard library only.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from typing import Any

from ...errors import DatasetError, UsageError
from ...export_formats import RESULT_FORMATS
from ...names import file_stem
from ...settings import UP_AXES, UV_CHOICES, JobSettings, TextureSettings, from_json, to_json

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

        Raises
        ------
        UsageError
            A choice is unknown or out of range, or contradicts another one.
        DatasetError
            A file does not exist.
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
            raise UsageError("Baking makes no levels of detail.", "Leave out --lods.")
        JobSettings(texture=self.texture).validated()
        return replace(self, name=file_stem(self.name, 0))

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return to_json(self)

    @classmethod
    def from_json(cls, values: Any) -> BakeRequest:
        """Build from :meth:`to_json`'s values.

        Raises
        ------
        UsageError
            An entry is missing, unknown, of the wrong type or out of range.
        """
        try:
            request: BakeRequest = from_json(cls, values, "bake")
        except TypeError:
            raise UsageError("job.json: bake names no mesh.", "Start the bake again.") from None
        return request
