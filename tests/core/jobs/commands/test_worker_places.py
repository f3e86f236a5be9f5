# SPDX-License-Identifier: GPL-3.0-or-later
"""``farm ssh``, ``slurm`` and ``pbs`` with stand-ins for ``ssh``, ``sbatch`` and ``qsub``.

The stand-ins run what they are given on this computer, as a shell of another computer would; like
the real ``ssh``, one hands on the end of the input.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import EXIT_CANCELLED, EXIT_OTHER, EXIT_USAGE
from gaussian_wrapping_addon.core.farm.addresses import make_certificates
from tests.core.jobs.farm_jobs import kill, wait_until
from tests.core.jobs.test_farm_network import PACKAGE, descendants, free_port
from tests.proofs import first_then_proofs

pytest.importorskip("dask_jobqueue", reason="Dask is not installed: set-up-worker --add farm")


pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="the stand-ins are shell scripts"),
    pytest.mark.timeout(600),
]
WAIT_S = 150.0
SSH = """#!/bin/sh
while [ "$1" != "--" ]; do shift; done
shift; computer=$1; shift
case "$computer" in
  refused) echo "Permission denied (publickey)." >&2; exit 255;;
  hung) echo $$ > "$STUBS/hung.pid"; exec sleep 1000;;
esac
exec sh -c "$*"
"""
SUBMIT = """#!/bin/sh
[ -e "$STUBS/closed" ] && { echo "error: the queue is closed" >&2; exit 1; }
number=$(ls "$STUBS" | grep -c script)
cp "$1" "$STUBS/script-$number"
setsid sh "$STUBS/script-$number" > "$STUBS/log-$number" 2>&1 < /dev/null &
echo $! > "$STUBS/pid-$number"
echo "Submitted batch job $number"
"""
CANCEL = """#!/bin/sh
kill -9 "-$(cat "$STUBS/pid-$1")" && echo "$1" >> "$STUBS/cancelled"
"""


class Running:
    """A command that runs, with all that it has written."""

    def __init__(self, words: list[str], log: Path) -> None:
        self.log = log
        with log.open("w") as stream:
            self.process = subprocess.Popen(
                [sys.executable, str(PACKAGE / "batch.py"), "farm", *words],
                stdout=stream, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip

    def said(self) -> list[str]:
        return self.log.read_text().splitlines()

    def says(self, *texts: str, count: int = 1) -> None:
        """Wait until each text has been said as often."""
        end_s = time.monotonic() + WAIT_S
        while not all(sum(t in line for line in self.said()) >= count for t in texts):
            assert self.process.poll() is None, self.said()
            assert time.monotonic() < end_s, self.said()
            time.sleep(0.1)

    def end(self, number: signal.Signals) -> int:
        self.process.send_signal(number)
        return self.process.wait(30.0)


@pytest.fixture(autouse=True)
def _interruptible() -> Iterator[None]:
    """Let children be interrupted where the tests themselves run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def stubs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put the stand-ins on the path; return where they leave what was done."""
    programs, left = tmp_path / "bin", tmp_path / "left"
    programs.mkdir()
    left.mkdir()
    for name, text in (
        ("ssh", SSH), ("sbatch", SUBMIT), ("scancel", CANCEL), ("qsub", SUBMIT), ("qdel", CANCEL),
    ):  # fmt: skip
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("STUBS", str(left))
    monkeypatch.setenv("DASK_CONFIG", str(tmp_path / "dask"))
    return left


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    started: list[Running] = []

    def start(*words: str) -> Running:
        started.append(Running([*words], tmp_path / f"log-{len(started)}"))
        return started[-1]

    yield start
    for running in started:
        for pid in [*descendants(running.process.pid), running.process.pid]:
            kill(pid)
        running.process.wait()


def workers_of(address: str) -> list[int]:
    """Return the processes that work, or have begun to, for a scheduler."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if address in words and "worker" in words:
            found.append(int(path.parent.name))
    return found


@pytest.mark.proof
@pytest.mark.parametrize("number", first_then_proofs([signal.SIGINT, signal.SIGKILL]))
def test_computers_by_ssh_work_and_end_with_the_command(
    stubs: Path, run: Callable[..., Running], tmp_path: Path, number: signal.Signals
) -> None:
    make_certificates(tmp_path / "keys")
    (tmp_path / "my farm").mkdir()
    address = f"tls://127.0.0.1:{free_port()}"
    (tmp_path / "hosts").write_text("second slots=2\nhung\n")
    farm = run(
        "ssh", address, "first", "refused", "--hosts", str(tmp_path / "hosts"), "--certificates",
        str(tmp_path / "keys"), "--shared", str(tmp_path / "my farm"), "--python", sys.executable,
        "--limit", "60",
    )  # fmt: skip
    farm.says(
        f"first: this computer works for {address}", f"second: this computer works for {address}",
        "warning: refused has ended with code 255: Permission denied (publickey). Try: ssh refused",
        "warning: hung does not work 60 s after it was called. Try: ssh hung",
    )  # fmt: skip
    farm.says(" has joined (workers: 2)")
    assert not Path(f"/proc/{int((stubs / 'hung.pid').read_text())}").exists()
    assert len(workers_of(address)) == 2
    told = subprocess.run(
        [sys.executable, str(PACKAGE / "batch.py"), "farm", "doctor", address, "--certificates",
         str(tmp_path / "keys"), "--shared", str(tmp_path / "my farm")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert told.returncode == 0, told.stdout
    assert told.stdout.splitlines()[-1] == "2 of 2 workers can be used"
    code = farm.end(number)
    assert code == (EXIT_CANCELLED if number == signal.SIGINT else -number)
    wait_until(lambda: not workers_of(address), 30.0)


def test_where_no_computer_works_the_command_ends(stubs: Path, run: Callable[..., Running]) -> None:
    farm = run("ssh", f"tcp://127.0.0.1:{free_port()}", "refused")
    assert farm.process.wait(WAIT_S) == EXIT_OTHER
    assert farm.said()[-1].startswith("error: None of the computers works any more.")
    odd = run("ssh", f"tcp://127.0.0.1:{free_port()}", "a", "--python", "no-such-python")
    assert odd.process.wait(WAIT_S) == EXIT_OTHER
    assert any("warning: a has ended with code 127: " in line for line in odd.said())


@pytest.mark.proof
@pytest.mark.parametrize(
    ("system", "number"),
    [("slurm", signal.SIGINT), ("pbs", signal.SIGINT), ("slurm", signal.SIGKILL)],
)
def test_jobs_of_a_cluster_work_and_are_cancelled(
    stubs: Path, run: Callable[..., Running], tmp_path: Path, system: str, number: signal.Signals
) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    farm = run(
        system, address, "--workers", "2", "--cores", "4", "--memory", "8GiB", "--time", "1:00:00",
        "--shared", str(tmp_path), "--directive=--gres=gpu:1",
    )  # fmt: skip
    farm.says(f"job 0 is in the queue of {system}", f"job 1 is in the queue of {system}")
    farm.says(" has joined (workers: ", count=1)
    wait_until(lambda: len(workers_of(address)) == 2, WAIT_S)
    mark = {"slurm": "#SBATCH", "pbs": "#PBS"}[system]
    script = (stubs / "script-1").read_text().splitlines()
    assert f"{mark} --gres=gpu:1" in script
    assert f"farm worker {address} --slots 1 --shared {tmp_path}" in script[-1]
    code = farm.end(number)
    assert code == (EXIT_CANCELLED if number == signal.SIGINT else -number)
    wait_until(lambda: (stubs / "cancelled").exists(), 30.0)
    wait_until(lambda: sorted((stubs / "cancelled").read_text().split()) == ["0", "1"], 30.0)
    wait_until(lambda: not workers_of(address), 30.0)


def test_a_closed_queue_is_told(stubs: Path, run: Callable[..., Running]) -> None:
    (stubs / "closed").touch()
    farm = run(
        "slurm", f"tcp://127.0.0.1:{free_port()}", "--workers", "2", "--cores", "1", "--memory",
        "1GB", "--time", "10",
    )  # fmt: skip
    assert farm.process.wait(WAIT_S) == EXIT_OTHER
    assert farm.said()[-1].startswith("error: sbatch refuses a job: error: the queue is closed.")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("ssh tcp://10.0.0.7:1 a", "is not encrypted"),
        ("ssh tls://10.0.0.7:1 a", "needs certificates"),
        ("ssh tcp://127.0.0.1:1", "No computer is named"),
        ("ssh tcp://127.0.0.1:1 a a", "a is named twice"),
        ("ssh tcp://127.0.0.1:1 a;b", "is no name of a computer"),
        ("ssh tcp://127.0.0.1:1 a --limit 0", "--limit is out of range"),
        ("pbs tcp://127.0.0.1:1 --workers 0 --cores 1 --memory 1GB --time 1", "--workers is out"),
        ("pbs tcp://127.0.0.1:1 --workers 1 --cores 1 --memory 1 --time 1", "is no memory"),
    ],
)
def test_refusals(
    stubs: Path, words: str, says: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.delenv("GW_CERTIFICATES", raising=False)
    assert batch.main(["farm", *words.split()]) == EXIT_USAGE
    assert says in capsys.readouterr().out
