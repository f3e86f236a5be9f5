# SPDX-License-Identifier: GPL-3.0-or-later
"""A whole wrap on a Dask cluster: workers are killed while they make cameras and masks.

The small scene has photos with cameras; its photos are masked, it is trained and meshed in tiles.
"""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.settings import (
    JobSettings,
    MeshingSettings,
    TextureSettings,
    TrainingSettings,
)
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tests.core.jobs import farm_jobs
from tests.core.jobs.farm_jobs import kill, parent_of, running
from tests.core.jobs.finished_sphere import write_cube
from tests.synthetic import write_ball_scene
from tools.version_comparison.contents import differences, read_contents

pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")
pytestmark = [
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="processes are killed by a signal"),
    pytest.mark.timeout(1800),
]

KILLED = ("cameras", "masks")
"""Kinds of parts; tests/core/jobs/test_farm_jobs.py and test_farm_blocks.py have the others."""


def small_wrap(root: Path, **changes: object) -> JobFile:
    """Return the job that wraps a small scene with masks and in two tiles."""
    photos = root / "photos"
    if not photos.is_dir():
        write_ball_scene(photos, photos=12, width=64, height=48)
    settings = JobSettings(
        training=TrainingSettings(
            iterations=120, max_gaussians=1500, max_image_px=64
        ),
        meshing=MeshingSettings(points=300, tiles="2"), texture=TextureSettings(size_px=64),
        regions=(str(write_cube(root / "ball.json", 1.3)),), make_masks="region",
        export=("ply", "glb"), threads=1, **changes,
    )  # fmt: skip
    return make_job("wrap", photos, settings)


@pytest.mark.proof
def test_dask_workers_are_killed_in_the_parts_before_training(tmp_path: Path) -> None:
    alone, farmed = JobFolder(tmp_path / "alone"), JobFolder(tmp_path / "farmed")
    assert farm_jobs.run(alone, small_wrap(tmp_path)).state == "DONE"
    killed: dict[str, tuple[int, int]] = {}

    def look() -> None:
        for name, state in running(farmed):
            kind = name.partition("-")[0]
            if kind in KILLED and kind not in killed:
                killed[kind] = (parent_of(state.pid), state.pid)
                kill(parent_of(state.pid))

    job = small_wrap(tmp_path, computers="local", processes=2)
    status = farm_jobs.run(farmed, job, look)
    assert status.state == "DONE", status
    assert set(killed) == set(KILLED)
    assert not any(process_alive(pid, 0) for pair in killed.values() for pid in pair)
    assert not list(running(farmed))
    made = read_contents(alone.result)
    found = differences(made, read_contents(farmed.result))
    # Only statistics of the mesh say how many processes there were.
    statistics = ("report.json :", "report.md :", "ball/figures.json : provenance.")
    assert [name for name, _ in found if not name.startswith(statistics)] == []
    assert [name for name in made.items if name.endswith(".ply : content")]
