# SPDX-License-Identifier: GPL-3.0-or-later
"""A job on a Dask cluster whose shared folder has no room: one sentence, and nothing is left."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from tests.core.jobs import farm_jobs
from tests.core.jobs.farm_jobs import running, same_mesh, tiled_sphere, wait_until
from tests.core.jobs.small_disk import fill, mounted_disk

pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")
pytestmark = [
    pytest.mark.proof,
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="processes are killed by a signal"),
    pytest.mark.timeout(1800),
]


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> JobFolder:
    """Mesh the sphere in tiles in one process."""
    folder, job = tiled_sphere(tmp_path_factory.mktemp("alone"))
    assert farm_jobs.run(folder, job).state == "DONE"
    return folder


@pytest.mark.parametrize("kind", ["points", "texture"])
def test_a_shared_folder_without_room_ends_the_job_in_one_sentence(
    kind: str, ball: JobFolder, tmp_path: Path
) -> None:
    with mounted_disk(tmp_path / "disk") as disk:
        _fill_and_resume(kind, ball, disk)


def _fill_and_resume(kind: str, ball: JobFolder, disk: Path) -> None:
    folder, job = tiled_sphere(disk, computers="local", processes=2)
    filler = disk / "filler"

    def look() -> None:
        if filler.exists() or any(name.startswith(kind) for name, _ in running(folder)):
            fill(filler)  # again, as something may have been removed

    status = farm_jobs.run(folder, job, look)
    assert status.state == "FAILED", status
    assert "No room" in status.error, status
    assert "Make room on that disk" in status.hint, status
    wait_until(lambda: not list(running(folder)))
    assert not folder.locked()
    assert not list(folder.root.rglob("*.writing.*"))
    filler.unlink()
    status = farm_jobs.run(folder, job)
    assert status.state == "DONE", status
    assert same_mesh(folder, ball)
