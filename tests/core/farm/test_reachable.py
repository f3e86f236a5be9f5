# SPDX-License-Identifier: GPL-3.0-or-later
"""Addresses of Dask schedulers, and whether something accepts connections there."""

from __future__ import annotations

import socket

import pytest

from gaussian_wrapping_addon.core.errors import FarmError, SettingError, UsageError
from gaussian_wrapping_addon.core.farm.address import Address
from gaussian_wrapping_addon.core.farm.reachable import check_reachable, scheduler_address
from gaussian_wrapping_addon.core.settings import JobSettings, key_values

GOOD = {
    "tcp://farm.local:8786": Address("tcp", "farm.local", 8786),
    " tls://10.0.0.2:1 ": Address("tls", "10.0.0.2", 1),
    "tcp://[fe80::1]:8786": Address("tcp", "fe80::1", 8786),
}
BAD = (
    "", "local", "farm:8786", "http://farm:8786", "tcp://farm", "tcp://farm:0", "tcp://farm:99999",
    "tcp://me:secret@farm:1", "tcp://farm:1/x", "tcp://a b:1", "tcp://[:.]:1", "tcp://farm:1\n--x",
)  # fmt: skip


@pytest.mark.parametrize("text", GOOD)
def test_addresses_are_read(text: str) -> None:
    address = scheduler_address(text)
    assert address == GOOD[text]
    assert JobSettings(computers=str(address)).validated().computers == text.strip()


@pytest.mark.parametrize("text", BAD)
def test_others_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"is no address of a Dask scheduler.*tcp://computer:8786"):
        scheduler_address(text)


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
    here, there = JobSettings(), JobSettings(computers="tcp://farm:8786", processes=4)
    assert key_values(there) == key_values(here)
