# SPDX-License-Identifier: GPL-3.0-or-later
"""``farm doctor`` with real workers: good ones, and each that cannot be used; nothing is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, EXIT_DONE, EXIT_OTHER, EXIT_USAGE
from gaussian_wrapping_addon.core.jobs.parts.graph import code_version
from gaussian_wrapping_addon.core.names import SHARED_VARIABLE
from tests.core.jobs.farm_jobs import wait_until
from tests.core.jobs.test_farm_network import (
    PACKAGE,
    Farm,
    descendants,
    end,
    free_port,
    older_package,
)
from tests.proofs import first_then_proofs

pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")


pytestmark = [
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are stopped"),
    pytest.mark.timeout(600),
]
LIMIT_S = 60


@pytest.fixture(autouse=True)
def _interruptible() -> Iterator[None]:
    """Let children be interrupted where the tests themselves run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def farm() -> Iterator[Farm]:
    made = Farm()
    yield made
    made.end()


def stop(process: subprocess.Popen[str]) -> None:
    """Let a worker hang, with all that belongs to it."""
    for pid in [process.pid, *descendants(process.pid)]:
        os.kill(pid, signal.SIGSTOP)


def doctor(folder: Path, address: str, *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, PACKAGE / "batch.py", "farm", "doctor", address, *more],
        capture_output=True, text=True, check=False,
        env={**os.environ, SHARED_VARIABLE: str(folder)},
    )  # fmt: skip


@pytest.mark.proof
def test_each_worker_has_a_line_and_nothing_is_left(farm: Farm, tmp_path: Path) -> None:
    here, seen, other = (tmp_path / name for name in ("here", "seen", "other"))
    here.mkdir()
    other.mkdir()
    seen.symlink_to(here)  # the same folder by another path
    older = older_package(tmp_path)
    address = f"tcp://127.0.0.1:{free_port()}"
    farm.start("scheduler", address, says="listens at")
    nobody = doctor(here, address)
    assert nobody.returncode == EXIT_BAD_DATA
    assert "answers, but has no workers. Start one on each computer" in nobody.stdout
    farm.start("worker", address, "--shared", str(seen), says="works for")
    alone = doctor(here, address)
    assert alone.returncode == EXIT_DONE, alone.stdout
    line, last = alone.stdout.splitlines()
    assert last == "1 of 1 workers can be used"
    for fact in (
        f"{os.uname().nodename} (127.0.0.1:", "): ok; ", f"version {code_version()}",
        f"Python {sys.version.split()[0]}", "torch 2.", "numpy ", " cores, ", " GiB memory, ",
        " GiB free in the shared folder, ", "clock ",
    ):  # fmt: skip
        assert fact in line
    farm.start("worker", address, "--shared", str(other), says="works for")
    farm.start("worker", address, "--shared", str(here), says="works for", package=older)
    stop(farm.start("worker", address, "--shared", str(here), says="works for"))
    begun_s = time.monotonic()
    all_told = doctor(here, address, "--limit", str(LIMIT_S))
    assert time.monotonic() - begun_s < LIMIT_S + 40
    lines = all_told.stdout.splitlines()
    assert all_told.returncode == EXIT_BAD_DATA, all_told.stdout
    assert len(lines) == 5
    assert sum("): ok; " in line for line in lines) == 1
    for told in (
        f" does not see {other}. Mount the shared folder there",
        f"this computer {code_version()}. Install the same version of the add-on",
        f": It does not answer within {LIMIT_S} s. Look at that computer",
        "error: 3 of 4 workers cannot be used as they are.",
    ):
        assert sum(told in line for line in lines) == 1, (told, lines)
    assert [*here.iterdir(), *other.iterdir()] == []


@pytest.mark.parametrize("number", first_then_proofs([signal.SIGINT, signal.SIGKILL]))
def test_a_doctor_that_is_ended_leaves_nothing(
    farm: Farm, tmp_path: Path, number: signal.Signals
) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    farm.start("scheduler", address, says="listens at")
    stop(farm.start("worker", address, "--shared", str(tmp_path), says="works for"))
    command = [sys.executable, str(PACKAGE / "batch.py"), "farm", "doctor", address]
    with subprocess.Popen(
        [*command, "--shared", str(tmp_path)], stdout=subprocess.PIPE, start_new_session=True
    ) as process:
        wait_until(lambda: any(tmp_path.iterdir()), 60.0)
        child, *_ = descendants(process.pid)
        os.kill(process.pid, number)
        process.communicate()
    wait_until(lambda: not any(tmp_path.iterdir()), 15.0)
    wait_until(lambda: not Path(f"/proc/{child}").exists(), 15.0)


@pytest.mark.proof
def test_a_scheduler_that_hangs_is_told(farm: Farm, tmp_path: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    scheduler = farm.start("scheduler", address, says="listens at")
    stop(scheduler)
    found = doctor(tmp_path, address)
    assert found.returncode == EXIT_OTHER
    assert f"error: No Dask scheduler answers at {address}" in found.stdout
    assert list(tmp_path.iterdir()) == []
    end(scheduler)
    found = doctor(tmp_path, address)
    assert found.returncode == EXIT_OTHER
    assert f"Nothing accepts connections at {address}" in found.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["tcp://10.0.0.7:8786", "--shared", "."], "is not encrypted"),
        (["farm:8786", "--shared", "."], "is no address of a Dask scheduler"),
        (["tls://farm:8786"], "No folder is named that all computers share"),
        (["tls://farm:8786", "--shared", ".", "--limit", "0"], "--limit is out of range"),
    ],
)
def test_refusals(
    words: list[str], says: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.delenv(SHARED_VARIABLE, raising=False)
    assert batch.main(["farm", "doctor", *words]) == EXIT_USAGE
    assert says in capsys.readouterr().out
