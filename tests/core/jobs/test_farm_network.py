# SPDX-License-Identifier: GPL-3.0-or-later
"""Schedulers and workers started by hand: lost, of another version, on another computer with TLS.

The other computer is a network namespace with its own address, and its own path of the shared
folder.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import EXIT_USAGE, UsageError
from gaussian_wrapping_addon.core.farm.addresses import FOLDER_VARIABLE, make_certificates
from gaussian_wrapping_addon.core.jobs.client import JobClient, prepare_job
from gaussian_wrapping_addon.core.jobs.store.job_file import write_job
from gaussian_wrapping_addon.core.limits import SILENT_S
from gaussian_wrapping_addon.core.names import SHARED_VARIABLE
from tests.core.jobs import farm_jobs
from tests.core.jobs.farm_jobs import (
    kill,
    running,
    same_mesh,
    states,
    tiled_sphere,
    wait,
    wait_until,
)
from tests.proofs import first_then_proofs

pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")
pytestmark = [
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs signals and namespaces"),
    pytest.mark.timeout(1800),
]
PACKAGE = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon"


def listening(pid: int) -> set[str]:
    """Return the addresses, as hexadecimal digits, at which a process accepts connections."""
    own = set()
    for path in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            own.add(os.readlink(path))
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in own:
                found.add(words[1].partition(":")[0])
    return found


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Farm:
    """Commands ``farm ...`` that run until the test ends."""

    def __init__(self) -> None:
        self.started: list[subprocess.Popen[str]] = []

    def start(
        self, *words: str, says: str, before: Sequence[str] = (), package: Path = PACKAGE
    ) -> subprocess.Popen[str]:
        """Start a command and wait until it says that it works."""
        process = subprocess.Popen(
            [*before, sys.executable, str(package / "batch.py"), "farm", *words],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )  # fmt: skip
        self.started.append(process)
        assert process.stdout is not None
        said = ""
        while says not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
        return process

    def end(self) -> None:
        for process in self.started:
            end(process)


def end(process: subprocess.Popen[str]) -> None:
    """Kill a command with its children."""
    for pid in descendants(process.pid):
        kill(pid)
    process.kill()
    process.wait()


def descendants(pid: int) -> list[int]:
    found = [int(p.name) for p in Path("/proc").iterdir() if p.name.isdecimal()]
    children = [child for child in found if farm_jobs.parent_of(child) == pid]
    return [d for child in children for d in [*descendants(child), child]]


def older_package(root: Path) -> Path:
    """Return a copy of the program that is another version."""
    other = root / "older" / PACKAGE.name
    shutil.copytree(PACKAGE, other, ignore=shutil.ignore_patterns("__pycache__"))
    (other / "core" / "limits.py").open("a").write("\n# older\n")
    return other


@pytest.fixture
def farm() -> Iterator[Farm]:
    made = Farm()
    yield made
    made.end()


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> farm_jobs.JobFolder:
    """Mesh the sphere in tiles in one process."""
    folder, job = tiled_sphere(tmp_path_factory.mktemp("alone"), 2)
    assert farm_jobs.run(folder, job).state == "DONE"
    return folder


@pytest.mark.parametrize("host", first_then_proofs(["127.0.0.1", "localhost"]))
def test_who_works_for_a_scheduler_of_this_computer_listens_on_it_alone(
    farm: Farm, host: str
) -> None:
    """What is not encrypted runs the programs of whoever reaches it: no other computer may."""
    address = f"tcp://{host}:{free_port()}"
    processes = [
        farm.start("scheduler", address, says="listens at"),
        farm.start("worker", address, says="works for"),
    ]
    found = {at for p in processes for pid in descendants(p.pid) for at in listening(pid)}
    here = {"0100007F", "00000000000000000000000001000000"}
    assert len(found) >= 1
    assert found <= here


@pytest.mark.proof
def test_a_scheduler_that_is_killed_ends_the_job_with_a_sentence_and_loses_nothing(
    farm: Farm, alone: farm_jobs.JobFolder, tmp_path: Path
) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    scheduler = farm.start("scheduler", address, says="listens at")
    worker = farm.start("worker", address, says="works for")
    folder, job = tiled_sphere(tmp_path, 2, computers=address)
    client = JobClient.start(folder.root, job, python=sys.executable)

    def look() -> None:
        if scheduler.poll() is None and any(
            name.startswith("faces") for name, _ in running(folder)
        ):
            end(scheduler)

    status = wait(client, look)
    assert status.state == "FAILED", status
    assert f"The Dask scheduler at {address} is gone." in status.error
    assert "resume" in status.hint
    wait_until(lambda: not list(running(folder)), 30.0)
    end(worker)
    done = {name: state.token for name, state in states(folder).items() if state.state == "DONE"}
    assert "gather-ball" in done
    farm.start("scheduler", address, says="listens at")
    farm.start("worker", address, says="works for")
    status = wait(JobClient.resume(folder.root, python=sys.executable))
    assert status.state == "DONE", status
    assert same_mesh(folder, alone)
    kept = set(done) - {"cameras"}
    assert {name: states(folder)[name].token for name in kept} == {n: done[n] for n in kept}


@pytest.mark.proof
def test_a_worker_of_another_version_is_told_and_beside_a_right_one_asked_once(
    farm: Farm, alone: farm_jobs.JobFolder, tmp_path: Path
) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    farm.start("scheduler", address, says="listens at")
    farm.start("worker", address, says="works for", package=older_package(tmp_path))
    folder, job = tiled_sphere(tmp_path / "job", 2, computers=address)
    status = farm_jobs.run(folder, job)
    assert status.state == "FAILED"
    assert "Part cameras failed on" in status.error
    assert "version" in status.error
    assert "Install the same version" in status.hint
    assert [state.state for state in states(folder).values()] == []
    farm.start("worker", address, says="works for")
    folder, job = tiled_sphere(tmp_path / "second", 2, computers=address)
    status = farm_jobs.run(folder, job)
    assert status.state == "DONE", status
    assert same_mesh(folder, alone)
    # Parts of two tiles went to both at once, if not the first part did; then it is known.
    assert folder.log_path.read_text().count("ended with code 3 (attempt 1)") == 1
    assert "(attempt 2)" not in folder.log_path.read_text()


@pytest.fixture(scope="module")
def attic() -> list[str]:
    """Return what to put before a command that runs as on another computer, with its own name."""
    words = ["unshare", "--uts", "--pid", "--fork", "--kill-child", "--mount-proc"]
    words += ["sh", "-c", 'hostname attic && exec "$@"', "sh"]
    try:
        tried = subprocess.run([*words, "true"], capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"unshare is missing: {error}")
    if tried.returncode:
        pytest.skip(f"no namespace can be made: {tried.stderr.strip()}")
    return words


def resume_words(folder: farm_jobs.JobFolder) -> list[str]:
    return [sys.executable, str(PACKAGE / "batch.py"), "resume", str(folder.root), "--no-blend"]


@pytest.mark.proof
def test_of_two_clients_on_two_computers_one_is_told_and_one_ends_the_job(
    attic: list[str], alone: farm_jobs.JobFolder, tmp_path: Path
) -> None:
    folder, job = tiled_sphere(tmp_path, 2, computers="local", processes=2)
    said: list[subprocess.CompletedProcess[str]] = []

    def look() -> None:
        if not said and any(name.startswith("points") for name, _ in running(folder)):
            words = [*attic, *resume_words(folder)]
            said.append(subprocess.run(words, capture_output=True, text=True, check=False))

    status = farm_jobs.run(folder, job, look)
    assert status.state == "DONE", status
    (second,) = said
    assert second.returncode == EXIT_USAGE, second
    assert f"A job is running in {folder.root}." in second.stdout + second.stderr
    assert "Traceback" not in second.stdout + second.stderr
    assert same_mesh(folder, alone)


@pytest.mark.proof
def test_a_silent_computer_s_job_is_taken_over_by_another(
    attic: list[str], alone: farm_jobs.JobFolder, tmp_path: Path
) -> None:
    folder, job = tiled_sphere(tmp_path, 2, computers="local", processes=2)
    prepare_job(folder.root, job)
    first = subprocess.Popen(
        [*attic, *resume_words(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip

    def begun() -> bool:
        there = [name for name, state in states(folder).items() if state.host == "attic"]
        return any(name.startswith("points") for name in there)

    try:
        wait_until(begun, farm_jobs.DEADLINE_S)
    finally:
        kill(first.pid)  # its namespace goes with it
        first.wait()
    with pytest.raises(UsageError, match="A job is running in"):
        JobClient.resume(folder.root, python=sys.executable)
    done = {name: state.token for name, state in states(folder).items() if state.state == "DONE"}
    assert "plan-ball" in done
    silent_s = time.time() - SILENT_S - 20.0
    for path in (folder.lock_path, folder.status_path, *(folder.root / "parts").iterdir()):
        os.utime(path, (silent_s, silent_s))
    assert folder.read_status().state == "LOST"
    status = wait(JobClient.resume(folder.root, python=sys.executable))
    assert status.state == "DONE", status
    assert same_mesh(folder, alone)
    kept = set(done) - {"cameras"}
    assert {name: states(folder)[name].token for name in kept} == {n: done[n] for n in kept}


def _namespaces() -> str:
    """Return why no network namespace can be made here; empty if one can."""
    if os.geteuid() != 0:
        return "only root makes network namespaces"
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        return "ip or unshare is not installed"
    tried = subprocess.run(
        ["ip", "netns", "add", "gwrap-try"], capture_output=True, text=True, check=False
    )
    subprocess.run(["ip", "netns", "del", "gwrap-try"], capture_output=True, check=False)
    return "" if tried.returncode == 0 else f"no namespace can be made: {tried.stderr.strip()}"


START = f"""
import sys; sys.path[:0] = {sys.path!r}
from pathlib import Path
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
root, job = map(Path, sys.argv[1:])
JobClient.start(root, read_job(job), python=sys.executable)._process.wait()
"""
"""Starts a job and waits for it, for a namespace of its own."""


class Link:
    """Two network namespaces with a link between them."""

    NAMES = ("gwrap-here", "gwrap-there")
    HERE, THERE = "10.231.7.1", "10.231.7.2"

    def __init__(self) -> None:
        self.remove()
        one, two = self.NAMES
        for words in (
            f"netns add {one}", f"netns add {two}",
            f"link add gwh0 netns {one} type veth peer name gwh1 netns {two}",
            f"-n {one} addr add {self.HERE}/24 dev gwh0",
            f"-n {two} addr add {self.THERE}/24 dev gwh1",
            f"-n {one} link set gwh0 up", f"-n {two} link set gwh1 up",
            f"-n {one} link set lo up", f"-n {two} link set lo up",
        ):  # fmt: skip
            subprocess.run(["ip", *words.split()], check=True, capture_output=True)

    def set(self, state: str) -> None:
        """Cut the link (``down``) or mend it (``up``)."""
        subprocess.run(["ip", "-n", self.NAMES[1], "link", "set", "gwh1", state], check=True)

    def remove(self) -> None:
        for name in self.NAMES:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


@pytest.fixture
def link() -> Iterator[Link]:
    reason = _namespaces()
    if reason:
        pytest.skip(reason)
    made = Link()
    yield made
    made.remove()


@pytest.mark.proof
def test_two_computers_with_tls_other_paths_and_a_cut_link(
    farm: Farm, link: Link, alone: farm_jobs.JobFolder, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    shared, seen = tmp_path / "shared", tmp_path / "mounted elsewhere"
    shared.mkdir()
    seen.mkdir()
    make_certificates(tmp_path / "keys")
    monkeypatch.setenv(SHARED_VARIABLE, str(shared))
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "keys"))
    address = f"tls://{link.HERE}:8786"
    here = ["ip", "netns", "exec", link.NAMES[0]]
    # The other side sees the folder at another path, and not at this one.
    mount = f'mount --bind "{shared}" "{seen}" && mount -t tmpfs none "{shared}" && exec "$@"'
    there = [
        "ip", "netns", "exec", link.NAMES[1], "unshare", "-m", "sh", "-c", mount, "sh",
    ]  # fmt: skip
    farm.start("scheduler", address, says="listens at", before=here)
    farm.start("worker", address, "--shared", str(seen), says="works for", before=there)
    folder, job = tiled_sphere(shared / "ball", 2, computers=address)
    write_job(tmp_path / "job.json", job)
    with subprocess.Popen(
        [*here, sys.executable, "-c", START, str(folder.root), str(tmp_path / "job.json")],
        start_new_session=True,
    ) as driver:
        cut_s = 0.0
        end_s = time.monotonic() + farm_jobs.DEADLINE_S
        while driver.poll() is None:
            assert time.monotonic() < end_s
            begun_faces = any(name.startswith("faces") for name in states(folder))
            if begun_faces and not cut_s:
                cut_s = time.monotonic()
                link.set("down")
            if cut_s and time.monotonic() - cut_s > 5.0:
                link.set("up")
            time.sleep(0.1)
    status = folder.read_status()
    assert cut_s
    assert status.state == "DONE", status
    assert same_mesh(folder, alone)
