# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of a job, each declared once: default, range, option, panel property, help.

In: values from command line, panel or job file. Out: validated frozen dataclasses.
Standard library only, so that Blender can load it.
"""

from __future__ import annotations

from .declaration import (
    BOUNDARIES,
    CORRELATIONS,
    FIELD_CAMERAS,
    MASK_MODES,
    MAX_LODS,
    MESH_METHODS,
    PIVOT_BOXES,
    PIVOT_COUNTS,
    PIVOT_SAMPLES,
    PRESETS,
    SELECTION_MODES,
    SPACINGS,
    SWITCH,
    TEXTURE_SOURCES,
    UNSEEN,
    UP_AXES,
    UV_CHOICES,
    Declaration,
    declarations,
    from_json,
    key_values,
    to_json,
    with_values,
)
from .job import JobSettings, declared, preset
from .meshing import MeshingSettings
from .texture import TextureSettings
from .training import MODEL_SELECTION, TrainingSettings

__all__ = [
    "BOUNDARIES", "CORRELATIONS", "FIELD_CAMERAS", "MASK_MODES", "MAX_LODS", "MESH_METHODS",
    "MODEL_SELECTION", "PIVOT_BOXES", "PIVOT_COUNTS", "PIVOT_SAMPLES", "PRESETS", "SELECTION_MODES",
    "SPACINGS", "SWITCH", "TEXTURE_SOURCES", "UNSEEN", "UP_AXES", "UV_CHOICES", "Declaration",
    "JobSettings", "MeshingSettings", "TextureSettings", "TrainingSettings", "declarations",
    "declared", "from_json", "key_values", "preset", "to_json", "with_values",
]  # fmt: skip
