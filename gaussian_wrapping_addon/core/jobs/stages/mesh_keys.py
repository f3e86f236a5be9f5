# SPDX-License-Identifier: GPL-3.0-or-later
"""Keys and folder names of a job's mesh stages."""

from __future__ import annotations

from ...settings import key_values
from ..store.job_file import JobFile, region_name
from ..store.job_folder import JobFolder
from ..store.stage_folder import STAGE_VERSIONS, read_done, stage_key


def mesh_key(job: JobFile, request: str, name: str, trained_key: str) -> str:
    """Return the key of a region's mesh stage: the hash of everything its mesh depends on."""
    body = job.region_bodies.get(request)
    return stage_key(
        STAGE_VERSIONS["mesh"], trained_key, request if body is None else body, name,
        key_values(job.meshing_of(request)), job.settings.seed,
    )  # fmt: skip


def mesh_stages(folder: JobFolder, job: JobFile) -> set[str]:
    """Return the names of the job's mesh stages in a folder, existing or not."""
    finished = [p for p in folder.stages.glob("train-*") if read_done(p) is not None]
    trained = [path.name.partition("-")[2] for path in finished]
    names = {r: region_name(r, job.region_bodies.get(r)) for r in job.settings.regions}
    return {
        f"mesh-{name}-{mesh_key(job, request, name, key)}"
        for request, name in names.items()
        for key in trained
    }
