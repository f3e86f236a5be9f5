# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a farm's processes run: addresses of schedulers, SSH hosts, batch systems."""

from __future__ import annotations

import re
import shlex
import shutil
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.errors import FarmError, ParseError, SettingError, UsageError
from gaussian_wrapping_addon.core.farm.addresses import Address, check_reachable, scheduler_address
from gaussian_wrapping_addon.core.farm.hosts import (
    MAX_FILE_BYTES,
    Host,
    Wanted,
    checked_hosts,
    hosts_named,
    make_job,
    read_hosts,
    ssh_command,
    worker_command,
)
from gaussian_wrapping_addon.core.settings import JobSettings, key_values

GOOD = {
    "tls://farm:8786": Address("tls", "farm", 8786),
    " tls://10.0.0.7:1 ": Address("tls", "10.0.0.7", 1),
    "tls://[fe80::1]:65535": Address("tls", "fe80::1", 65535),
    "tls://127.0.0.1:1": Address("tls", "127.0.0.1", 1),
    "tcp://127.0.0.1:9": Address("tcp", "127.0.0.1", 9),
    "tcp://localhost:8786": Address("tcp", "localhost", 8786),
    "tcp://[::1]:8786": Address("tcp", "::1", 8786),
}
OPEN = (
    "tcp://10.0.0.7:8786", "tcp://0.0.0.0:8786", "tcp://[::]:8786", "tcp://farm.local:8786",
    "tcp://localhost.evil:1", "tcp://no.such.computer.invalid:8786",
)  # fmt: skip
BAD = (
    "", "local", "farm:8786", "http://farm:8786", "ucx://farm:8786", "tls://farm", "tls://farm:0",
    "tls://farm:65536", "tcp://farm:99999", "tcp://me:secret@farm:1", "tls://a@farm:8786",
    "tls://farm:8786/x", "tcp://a b:1", "tcp://[:.]:1", "tcp://farm:1\n--x",
)  # fmt: skip


@pytest.mark.parametrize("text", GOOD)
def test_allowed(text: str) -> None:
    address = scheduler_address(text)
    assert address == GOOD[text]
    assert str(address) == text.strip()
    assert JobSettings(computers=str(address)).validated().computers == text.strip()


@pytest.mark.parametrize("text", BAD)
def test_others_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"is no address of a Dask scheduler.*tls://computer:8786"):
        scheduler_address(text)


@pytest.mark.parametrize("text", OPEN)
def test_what_others_can_read_is_refused_without_looking_up_a_name(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: pytest.fail("a name is looked up"))
    with pytest.raises(UsageError) as caught:
        scheduler_address(text)
    assert re.search("is not encrypted.*make-certificates", str(caught.value))


def test_a_server_that_others_reach_listens_everywhere() -> None:
    for text, wanted in (
        ("tls://10.0.0.7:1", "tls://0.0.0.0:1"),
        ("tls://[fe80::1]:8786", "tls://[::]:8786"),
        ("tcp://127.0.0.1:8786", "tcp://127.0.0.1:8786"),
        ("tls://localhost:8786", "tls://localhost:8786"),
    ):
        assert str(scheduler_address(text).listening()) == wanted


def test_connections() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = Address("tcp", "127.0.0.1", listener.getsockname()[1])
        check_reachable(address)
    with pytest.raises(FarmError, match=f"Nothing accepts connections at {address}: .*refused"):
        check_reachable(address)


def test_jobs_refuse_other_places_and_no_result_depends_on_them() -> None:
    for text in ("everywhere", "tcp://", "Local", " local", "http://x:1"):
        with pytest.raises(SettingError, match="computers is out of range"):
            JobSettings(computers=text).validated()
    for count in (0, 65):
        with pytest.raises(SettingError, match="processes is out of range"):
            JobSettings(processes=count).validated()
    here, there = JobSettings(), JobSettings(computers="tls://farm:8786", processes=4)
    assert key_values(there) == key_values(here)


USUAL = Host("", "/mnt/farm", "/home/me/keys", "python3", "/opt/add on/batch.py")
GOOD_NAMES = ("blade", "me@blade-2.farm.local", "10.0.0.7", "ssh://me@blade:2222", "[fe80::1]")
BAD_NAMES = (
    "", "-oProxyCommand=sh", "a b", "a;b", "$(id)", "a`b", "a@-oX=y/z", "me@", "ssh://", "a\nb",
    "a@-b", "-a@b", "ssh://-b", "ssh://-a@b:22",
)  # fmt: skip


def test_names_of_computers() -> None:
    for name in GOOD_NAMES:
        assert hosts_named([name], USUAL) == [replace(USUAL, name=name)]
    for name in BAD_NAMES:
        with pytest.raises(UsageError, match="is no name of a computer"):
            hosts_named([name], USUAL)


def test_a_list_of_computers(tmp_path: Path) -> None:
    path = tmp_path / "hosts.txt"
    path.write_text(
        "# the farm\n\nblade  # usual\n"
        "me@tower shared='/data/my farm' slots=2 python=/opt/py/bin/python3\n"
    )
    first, second = read_hosts(path, USUAL)
    assert first == Host("blade", "/mnt/farm", "/home/me/keys", "python3", "/opt/add on/batch.py")
    assert (second.name, second.shared, second.slots) == ("me@tower", "/data/my farm", 2)
    assert (second.python, second.batch) == ("/opt/py/bin/python3", "/opt/add on/batch.py")


def test_bad_lists_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "hosts.txt"
    for text, says in (
        (b"a\n-b\n", "line 2: '-b' is no name"),
        (b"a share=/x", "line 1: 'share=/x' is unknown"),
        (b"a b", "line 1: 'b' is unknown"),
        (b"a slots=0", "line 1: slots is not from 1 to 64"),
        (b"a slots=x", "line 1: slots is not"),
        (b"a shared='/x", "line 1: No closing quotation"),
        (b"\xff\xfe", "it is not text"),
        (b"#" * (MAX_FILE_BYTES + 1), "whole file"),
    ):
        path.write_bytes(text)
        with pytest.raises(ParseError) as caught:
            read_hosts(path, USUAL)
        assert says in str(caught.value)


def test_none_or_the_same_twice_is_refused() -> None:
    with pytest.raises(UsageError, match="No computer is named"):
        checked_hosts([])
    with pytest.raises(UsageError, match="b is named twice"):
        checked_hosts(hosts_named(["a", "b", "b"], USUAL))
    with pytest.raises(UsageError, match="1001 computers are too many"):
        checked_hosts(hosts_named([f"a{k}" for k in range(1001)], USUAL))


def test_what_is_run_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _name: "/usr/bin/ssh")
    (host,) = hosts_named(["me@blade"], USUAL)
    command = ssh_command(host, "tls://one:8786")
    assert command[0] == "/usr/bin/ssh"
    assert "BatchMode=yes" in command
    assert command[-3:-1] == ["--", "me@blade"], "what follows is no option of ssh"
    assert shlex.split(command[-1]) == [
        "exec", "python3", "/opt/add on/batch.py", "farm", "worker", "tls://one:8786", "--slots",
        "1", "--end-with-input", "--certificates", "/home/me/keys", "--shared", "/mnt/farm",
    ]  # fmt: skip
    open_one = worker_command(Host("a", "", "", "p;q", "b"), "tcp://127.0.0.1:1")
    assert shlex.split(open_one) == [
        "p;q", "b", "farm", "worker", "tcp://127.0.0.1:1", "--slots", "1",
    ]  # fmt: skip
    assert "'p;q'" in open_one
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    with pytest.raises(UsageError, match="There is no ssh"):
        ssh_command(host, "tls://one:8786")


SLURM = Wanted("slurm", 8, "32GB", "04:00:00", "gpu", "lab-7", ("--gres=gpu:1",))


@pytest.mark.parametrize(
    ("changes", "head"),
    [
        ({}, ["#SBATCH -J gaussian-wrapping", "#SBATCH -p gpu", "#SBATCH -A lab-7", "#SBATCH -n 1",
              "#SBATCH --cpus-per-task=8", "#SBATCH --mem=30G", "#SBATCH -t 04:00:00",
              "#SBATCH --gres=gpu:1"]),
        ({"system": "pbs", "directives": ("-m n",)},
         ["#PBS -N gaussian-wrapping", "#PBS -q gpu", "#PBS -A lab-7",
          "#PBS -l select=1:ncpus=8:mem=30GB", "#PBS -l walltime=04:00:00", "#PBS -m n"]),
    ],
)  # fmt: skip
def test_the_script_of_a_job(
    changes: dict[str, Any], head: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("dask_jobqueue", reason="set-up-worker --add farm")
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    wanted = replace(SLURM, **changes).validated()
    job = make_job(wanted, "tls://head:8786", "worker-0", "python3 batch.py farm worker")
    lines = [line for line in job.job_script().splitlines() if line]
    assert lines == ["#!/usr/bin/env bash", *head, "exec python3 batch.py farm worker"]
    without = ("scancel", "qdel")
    monkeypatch.setattr(shutil, "which", lambda name: None if name in without else name)
    with pytest.raises(UsageError, match=r"There is no (scancel|qdel) on this computer"):
        make_job(wanted, "tls://head:8786", "worker-0", "true")


def test_what_cannot_stand_in_a_script() -> None:
    assert SLURM.validated() is SLURM
    for time in ("30", "12:00:00", "2-12:00:00", "240:00:00"):
        assert replace(SLURM, time=time).validated().time == time
    for change, says in (
        ({"system": "sge"}, "is no batch system"),
        ({"cores": 0}, "--cores is out of range"),
        ({"memory": "32"}, "is no memory"),
        ({"memory": "32GB\nrm"}, "is no memory"),
        ({"time": "soon"}, "is no time"),
        ({"time": "1:00\n"}, "is no time"),
        ({"queue": "a b"}, "is no name of a queue"),
        ({"account": "a\nb"}, "is no name of a queue"),
        ({"directives": ("--a\nrm -r /",)}, "has a line break"),
        ({"directives": ("x" * 501,)}, "has a line break"),
        ({"logs": "/tmp/a\nrm -r x"}, "--logs has a line break"),
    ):
        with pytest.raises(UsageError) as caught:
            replace(SLURM, **change).validated()
        assert says in str(caught.value)
