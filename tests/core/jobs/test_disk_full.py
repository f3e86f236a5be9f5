# SPDX-License-Identifier: GPL-3.0-or-later
"""A full disk at any write: the error names the file, and existing files stay intact."""

from __future__ import annotations

import errno
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core import files
from gaussian_wrapping_addon.core.errors import EXIT_RESOURCES, ResourceError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.mesh.surface_mesh import save_mesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import JobSettings
from gaussian_wrapping_addon.core.texture.file_checks import write_mesh_ply
from gaussian_wrapping_addon.core.texture.files import write_glb, write_textured
from gaussian_wrapping_addon.core.texture.unwrap import charts
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import unwrap
from gaussian_wrapping_addon.core.training.state import load_checkpoint, save_checkpoint
from tests.core.jobs.small_disk import mounted_disk
from tests.core.texture.test_files import UTM, cube
from tests.core.training.test_state import filled

ROOT = Path(__file__).resolve().parents[3]
WORKER = f"""
import sys
sys.path[:0] = [{str(ROOT)!r}]
from gaussian_wrapping_addon.core.jobs import runner, worker
from gaussian_wrapping_addon.core.training.state import save_checkpoint
from tests.core.training.test_state import filled
def run_job(folder, job, event, cancelled):
    kept = folder.stages / "train-a"
    kept.mkdir()
    save_checkpoint(kept, filled(1), "key")
    other = (folder.stages / "other").open("wb", buffering=0)
    try:
        while other.write(bytes(1024)):
            pass
    except OSError:
        pass  # nothing is left on the disk
    save_checkpoint(kept, filled(2), "key")
runner.run_job = run_job
sys.exit(worker.main(sys.argv[1:]))
"""


def test_a_worker_on_a_full_disk_says_which_file_and_keeps_its_checkpoint(
    tmp_path: Path,
) -> None:
    with mounted_disk(tmp_path / "disk") as disk:
        _fill_and_look(disk)


def _fill_and_look(disk: Path) -> None:
    folder = JobFolder(disk)
    folder.create()
    write_job(folder.job_path, JobFile("wrap", "/photos", JobSettings()))
    done = subprocess.run(
        [sys.executable, "-c", WORKER, str(disk), "0"],
        cwd=ROOT, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == EXIT_RESOURCES, done.stderr
    status = folder.read_status()
    assert (status.state, status.exit_code) == ("FAILED", EXIT_RESOURCES)
    assert "checkpoint-000000002.npz" in status.error
    assert "No room" in status.error
    assert "checkpoint is intact" in status.hint
    kept = load_checkpoint(folder.stages / "train-a", "key")
    assert kept is not None
    assert kept.iteration == 1
    assert not list(disk.rglob("*.writing.*"))
    assert not folder.locked()


def test_last_words_need_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = JobFolder(tmp_path)
    running = JobStatus("RUNNING", stage="train", message="x" * 500)
    folder.write_status(running)
    full(monkeypatch)
    with pytest.raises(OSError, match="No space"):
        folder.write_status(running)
    size = folder.status_path.stat().st_size
    monkeypatch.setattr(files.os, "fsync", lambda _: None)
    monkeypatch.setattr(files.os, "replace", refuse)
    folder.write_status(replace(running, state="FAILED", message="", error="No room."))
    assert folder.status_path.stat().st_size == size
    assert read_json(folder.status_path)["error"] == "No room."


def refuse(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def full(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files.os, "fsync", refuse)


WRITERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "status.json": ("status.json", lambda p: write_json(p, {})),
    "checkpoint": ("checkpoint-000000007.npz", lambda p: save_checkpoint(p.parent, filled(), "k")),
    "mesh": ("mesh.npz", lambda p: save_mesh(p, cube().mesh)),
    "ply": ("mesh.ply", lambda p: write_mesh_ply(p, np.eye(3), np.array([[0, 1, 2]]), None)),
    "glb": (
        "a.glb",
        lambda p: write_glb(
            p, cube().mesh.vertices, cube().mesh.faces, cube().corner_uvs, [b""], np.zeros(3)
        ),
    ),
    "textured": ("mesh.npz", lambda p: write_textured(cube(), p.parent, ("glb",), UTM)),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_writer_leaves_the_file_that_was_there(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, write = WRITERS[name]
    path = tmp_path / file
    path.write_text("before")
    full(monkeypatch)
    with pytest.raises((OSError, ResourceError)) as caught:
        write(path)
    cause = caught.value.__cause__ or caught.value
    assert isinstance(cause, OSError)
    assert cause.errno == errno.ENOSPC
    assert cause.filename == str(path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_an_unwrap_without_room_is_not_replaced_by_a_worse_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(charts.np, "savez", refuse)
    with pytest.raises(ResourceError, match="No room"):
        unwrap(cube().mesh, 64, 2, tmp_path, Progress())
    assert list(tmp_path.iterdir()) == []
