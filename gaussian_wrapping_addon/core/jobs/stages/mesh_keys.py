# SPDX-License-Identifier: GPL-3.0-or-later
"""Keys of a job's mesh stages."""

from __future__ import annotations

from ...settings import key_values
from ..store.job_file import JobFile
from ..store.stage_folder import STAGE_VERSIONS, stage_key


def mesh_key(job: JobFile, request: str, name: str, trained_key: str) -> str:
    """Return the key of a region's mesh stage: the hash of everything its mesh depends on."""
    body = job.region_bodies.get(request)
    return stage_key(
        STAGE_VERSIONS["mesh"], trained_key, request if body is None else body, name,
        key_values(job.meshing_of(request)), job.settings.seed,
    )  # fmt: skip
