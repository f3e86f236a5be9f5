# SPDX-License-Identifier: GPL-3.0-or-later
"""Addresses of Dask schedulers: what is encrypted, or stays on this computer, is allowed."""

from __future__ import annotations

import re
import socket

import pytest

from gaussian_wrapping_addon.core.errors import FarmError, SettingError, UsageError
from gaussian_wrapping_addon.core.farm.addresses import Address, check_reachable, scheduler_address
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


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("tls://farm:8786", "tls://0.0.0.0:8786"),
        ("tls://10.0.0.7:1", "tls://0.0.0.0:1"),
        ("tls://[fe80::1]:8786", "tls://[::]:8786"),
        ("tcp://127.0.0.1:8786", "tcp://127.0.0.1:8786"),
        ("tls://localhost:8786", "tls://localhost:8786"),
    ],
)
def test_a_server_that_others_reach_listens_everywhere(text: str, wanted: str) -> None:
    assert str(scheduler_address(text).listening()) == wanted


def test_connections() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = Address("tcp", "127.0.0.1", listener.getsockname()[1])
        check_reachable(address)
    with pytest.raises(FarmError, match=f"Nothing accepts connections at {address}: .*refused"):
        check_reachable(address)


@pytest.mark.parametrize("text", ["everywhere", "tcp://", "Local", " local", "http://x:1"])
def test_jobs_refuse_other_places(text: str) -> None:
    with pytest.raises(SettingError, match="computers is out of range"):
        JobSettings(computers=text).validated()


@pytest.mark.parametrize("count", [0, 65])
def test_jobs_refuse_other_numbers_of_processes(count: int) -> None:
    with pytest.raises(SettingError, match="processes is out of range"):
        JobSettings(processes=count).validated()


def test_no_result_depends_on_where_it_is_made() -> None:
    here, there = JobSettings(), JobSettings(computers="tls://farm:8786", processes=4)
    assert key_values(there) == key_values(here)
