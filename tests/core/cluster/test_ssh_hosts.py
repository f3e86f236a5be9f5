# SPDX-License-Identifier: GPL-3.0-or-later
"""Computers by SSH: how they are named, and what is run on them."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import ParseError, UsageError
from gaussian_wrapping_addon.core.farm.hosts import (
    MAX_FILE_BYTES,
    Host,
    checked_hosts,
    hosts_named,
    read_hosts,
    ssh_command,
    worker_command,
)

USUAL = Host("", "/mnt/farm", "/home/me/keys", "python3", "/opt/add on/batch.py")


@pytest.mark.parametrize(
    "name",
    ["blade", "me@blade-2.farm.local", "10.0.0.7", "ssh://me@blade:2222", "[fe80::1]", "a_b"],
)
def test_names_of_computers(name: str) -> None:
    assert hosts_named([name], USUAL) == [Host(name, *list(vars(USUAL).values())[1:])]


@pytest.mark.parametrize(
    "name",
    [
        "",
        "-oProxyCommand=sh",
        "a b",
        "a;b",
        "$(id)",
        "a`b",
        "a@-oX=y/z",
        "me@",
        "ssh://",
        "a\nb",
        "a@-b",
        "-a@b",
        "ssh://-b",
        "ssh://-a@b:22",
    ],
)
def test_other_names_are_refused(name: str) -> None:
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


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a\n-b\n", "line 2: '-b' is no name"),
        ("a share=/x", "line 1: 'share=/x' is unknown"),
        ("a b", "line 1: 'b' is unknown"),
        ("a slots=0", "line 1: slots is not from 1 to 64"),
        ("a slots=x", "line 1: slots is not"),
        ("a shared='/x", "line 1: No closing quotation"),
        (b"\xff\xfe", "it is not text"),
        ("#" * (MAX_FILE_BYTES + 1), "whole file"),
    ],
)
def test_bad_lists_are_refused(text: str | bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "hosts.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
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
