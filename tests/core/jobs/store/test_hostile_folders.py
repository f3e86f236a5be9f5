# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders and inputs from elsewhere: nothing is written or deleted outside."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, UsageError, WrapError
from gaussian_wrapping_addon.core.jobs import client as client_module
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.commands.export_files import result_of
from gaussian_wrapping_addon.core.jobs.store import job_folder
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, start_fingerprint, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.jobs.store.rollback import (
    EARLIER,
    NEW,
    new_result,
    recover,
    roll_back,
)
from gaussian_wrapping_addon.core.jobs.store.rollback import NAME as FINISHED
from gaussian_wrapping_addon.core.jobs.store.stage_folder import source_fingerprint
from gaussian_wrapping_addon.core.ply import read_ply_header
from gaussian_wrapping_addon.core.regions.files import parse_region_file, region_to_json
from gaussian_wrapping_addon.core.regions.scene_regions import parse_region
from gaussian_wrapping_addon.core.settings import JobSettings
from gaussian_wrapping_addon.core.worker.helper_process import child_command

pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    (tmp_path / "photos").mkdir()
    folder = JobFolder(tmp_path / "out")
    folder.create()
    write_job(folder.job_path, make_job("wrap", tmp_path / "photos", JobSettings()))
    return folder


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A folder of somebody's work beside the job folder."""
    place = tmp_path / "outside"
    (place / "album").mkdir(parents=True)
    (place / "profile").write_text("alias ls='ls -l'\n")
    (place / "album" / "photo.jpg").write_bytes(b"photo")
    return place


def content(place: Path) -> dict[str, bytes | None]:
    return {
        path.relative_to(place).as_posix(): path.read_bytes() if path.is_file() else None
        for path in sorted(place.rglob("*"))
    }


def start(folder: JobFolder) -> None:
    job = make_job("wrap", folder.root.parent / "photos", JobSettings())
    JobClient.start(folder.root, job, python=sys.executable).wait(60)


def resume(folder: JobFolder) -> None:
    JobClient.resume(folder.root, python=sys.executable).wait(60)


def work(folder: JobFolder) -> None:
    """Run the worker, whoever started it."""
    command = child_command("jobs.worker", str(folder.root), "0")
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if ended.returncode:
        raise DatasetError(ended.stdout)


@pytest.mark.parametrize("use", [start, resume, work])
@pytest.mark.parametrize("name", ["log.txt", "worker-output.txt", "status.json", "result/x.txt"])
def test_a_job_whose_files_are_links_is_refused(
    folder: JobFolder, outside: Path, use: Callable[[JobFolder], None], name: str
) -> None:
    path = folder.root / name
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(outside / "profile")
    before = content(outside)
    with pytest.raises(WrapError, match="is a link"):
        use(folder)
    assert content(outside) == before
    assert path.is_symlink()


@pytest.mark.parametrize(
    "name", ["stages", "result", "result/.earlier", "stages/train-a", "result/scene.json"]
)
def test_a_job_whose_folders_are_links_is_refused(
    folder: JobFolder, outside: Path, name: str
) -> None:
    path = folder.root / name
    if name == "stages":
        path.rmdir()
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(outside / "profile" if path.suffix == ".json" else outside)
    before = content(outside)
    with pytest.raises(DatasetError, match=f"{path.name} is a link"):
        resume(folder)
    if "scene" in name:
        with pytest.raises(DatasetError, match=r"scene\.json is a link"):
            result_of(folder.root)
    assert content(outside) == before


@pytest.mark.parametrize("name", [EARLIER, NEW, NEW + EARLIER])
def test_the_swap_deletes_and_moves_nothing_behind_a_link(
    folder: JobFolder, outside: Path, name: str
) -> None:
    folder.result.mkdir()
    (folder.result / "profile").write_text("mine")
    (folder.result / name).symlink_to(outside)
    before = content(outside)
    recover(folder.result)
    assert (folder.result / "profile").read_text() == "mine"
    with new_result(folder.result) as new:
        (new / "photo.jpg").write_bytes(b"new")
    assert content(outside) == before
    assert content(folder.result) == {"photo.jpg": b"new", "profile": b"mine"}


@pytest.mark.parametrize("name", ["stages", "result", "stages/mesh-album"])
def test_rolling_back_deletes_nothing_behind_a_link(
    folder: JobFolder, outside: Path, name: str
) -> None:
    (outside / "mesh-of-mine").mkdir()
    (outside / "mesh-of-mine" / "work").write_text("a year")
    (outside / ".earlier").mkdir()
    (outside / ".earlier" / "profile").write_text("")
    job_folder.write_json(
        folder.root / FINISHED,
        {"job": make_job("wrap", folder.root.parent, JobSettings()).to_json(),
         "status": {"state": "DONE"}, "stages": []},
    )  # fmt: skip
    path = folder.root / name
    shutil.rmtree(folder.stages) if name == "stages" else None
    path.symlink_to(outside)
    before = content(outside)
    roll_back(folder)
    assert content(outside) == before


@pytest.mark.parametrize("name", ["cancel", ".gaussian-wrapping-job"])
def test_an_empty_file_is_not_made_behind_a_link(
    folder: JobFolder, outside: Path, name: str
) -> None:
    (folder.root / name).unlink(missing_ok=True)
    (folder.root / name).symlink_to(outside / "new")
    before = content(outside)
    with pytest.raises(ParseError, match="is a link"):
        (JobClient(folder, None).cancel if name == "cancel" else folder.create)()
    assert content(outside) == before


@pytest.fixture
def within_3_s() -> Iterator[None]:
    """Fail, rather than hang, if a pipe is opened and nobody writes to it."""

    def fail(_number: int, _frame: object) -> None:
        raise AssertionError("it hangs")

    earlier = signal.signal(signal.SIGALRM, fail)
    signal.setitimer(signal.ITIMER_REAL, 3.0)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, earlier)


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


def link_to_zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


def make_socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # the address of a socket is short
    try:
        socket.socket(socket.AF_UNIX).bind(path.name)
    finally:
        os.chdir(here)


def make_large(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(limits.MAX_JSON_BYTES + 1)  # a sparse file


@pytest.mark.usefixtures("within_3_s")
@pytest.mark.parametrize("make", [make_pipe, link_to_zero, make_socket, make_large])
@pytest.mark.parametrize("name", ["status.json", "lock.json", FINISHED, "worker-output.txt"])
def test_looking_at_a_job_neither_waits_nor_fills_the_memory(
    folder: JobFolder, name: str, make: Callable[[Path], None]
) -> None:
    make(folder.root / name)
    begun_s = time.monotonic()
    client = JobClient.attach(folder.root)
    assert client.poll().state in ("NEW", "FAILED")
    assert not folder.locked()
    roll_back(folder)
    client.output_tail()
    assert time.monotonic() - begun_s < 1.0


@pytest.mark.usefixtures("within_3_s")
@pytest.mark.parametrize("make", [make_pipe, link_to_zero, make_socket, make_large])
def test_a_job_file_that_is_none_is_refused_and_such_a_lock_replaced(
    folder: JobFolder, make: Callable[[Path], None]
) -> None:
    folder.job_path.unlink()
    make(folder.job_path)
    with pytest.raises(WrapError, match=r"job\.json"):
        client_module.read_job(folder.job_path)
    make(folder.lock_path)
    folder.lock()
    assert folder.lock_path.is_file()
    assert folder.locked()


def test_a_job_folder_may_be_reached_through_a_link(folder: JobFolder, tmp_path: Path) -> None:
    """As below /tmp on macOS, or in a home folder on another disk."""
    (tmp_path / "elsewhere").symlink_to(folder.root.parent)
    (tmp_path / "direct").symlink_to(folder.root)
    for root in (tmp_path / "elsewhere" / "out", tmp_path / "direct"):
        JobFolder(root).create()
        JobFolder(root).check_entries()
        JobFolder(root).write_status(JobStatus("DONE"))
        assert JobClient.attach(root).poll().state == "DONE"


def test_names_cannot_forge_lines_of_the_log(tmp_path: Path) -> None:
    code = (
        "import logging, sys\n"
        f"sys.path[:0] = {sys.path!r}\n"
        "from pathlib import Path\n"
        "from gaussian_wrapping_addon.core.jobs import worker\n"
        "worker._log_to(Path(sys.argv[1]))\n"
        "name = 'box\\ncurl evil | sh\\r\\x1b]0;x\\x07\\u2028\\u202e\\ud800'\n"
        "logging.warning('region %s', name)\n"
        "try:\n    raise ValueError(name)\nexcept ValueError:\n    logging.exception('odd')\n"
    )
    (tmp_path / "log.txt").write_text("earlier\n")
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "log.txt")], check=True)
    text = (tmp_path / "log.txt").read_text(encoding="utf-8")
    first, *lines = text.splitlines()
    assert first == "earlier", "what was there stays"
    assert r"box\ncurl evil | sh\r\x1b]0;x\x07\u2028\u202e\ud800" in lines[0]
    assert all(line.startswith("| ") for line in lines[2:])
    assert any("curl evil" in line for line in lines[2:])
    assert not set("\x1b\x07\r\u202e") & set(text)


def test_a_whole_disk_is_no_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="cannot be the source"):
        make_job("wrap", Path(tmp_path.anchor), JobSettings())
    monkeypatch.setattr(limits, "MAX_SOURCE_FILES", 3)
    for number in range(3):
        (tmp_path / f"{number}.bak").touch()
    assert source_fingerprint(tmp_path)
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "4.bak").touch()
    with pytest.raises(DatasetError, match="more than 3 files"):
        source_fingerprint(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="Windows has neither")
def test_devices_and_pipes_are_no_splats(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    for path in (Path("/dev/zero"), tmp_path / "pipe.ply"):
        with pytest.raises(DatasetError, match="not a regular file"):
            start_fingerprint(str(path))
        with pytest.raises(ParseError, match="not a regular file"):
            read_ply_header(path, "")
    with pytest.raises(DatasetError, match="cannot be read"):
        start_fingerprint(str(tmp_path / "none.ply"))


def test_what_a_region_file_passes_is_a_region(tmp_path: Path) -> None:
    """Far from the origin a body is flat by rounding alone: said when the file is read."""
    random = np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        offset = random.normal(size=3) * 10.0 ** random.integers(-3, 11)
        size = np.abs(offset).max() * 10.0 ** random.uniform(-16.5, -12.0)
        body = region_to_json("x", offset + size * random.normal(size=(8, 3)))
        try:
            parse_region_file(body, tmp_path / "x.json")
        except ParseError:
            refused += 1
        else:
            assert parse_region(body, tmp_path / "x.json").volume > 0.0
    assert 5 < refused < 290
