# SPDX-License-Identifier: GPL-3.0-or-later
"""Addresses of Managers: scheme, computer and port, and nothing else."""

from __future__ import annotations

import pytest

from gaussian_wrapping_addon.core.cluster.addresses import Address
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.farm.address import parse_address

GOOD = {
    "http://farm.local:8080": Address("http", "farm.local", 8080),
    " HTTP://Farm.local:8080/ ": Address("http", "farm.local", 8080),
    "https://10.0.0.2": Address("https", "10.0.0.2", 443),
    "http://10.0.0.2": Address("http", "10.0.0.2", 80),
    "http://[fe80::1]:8080": Address("http", "fe80::1", 8080),
}


@pytest.mark.parametrize("text", GOOD)
def test_addresses_are_read_and_written(text: str) -> None:
    address = parse_address(text)
    assert address == GOOD[text]
    assert parse_address(str(address)) == address


BAD = {
    "": "No address",
    "   ": "No address",
    "farm.local": "is not an address of http",
    "farm.local:8080": "is not an address of http",
    "ftp://farm.local": "is not an address of http",
    "file:///etc/passwd": "is not an address of http",
    "http://": "is not an address of http",
    "http://farm local:8080": "is not an address",
    "http://farm\r\nX-Evil: 1:8080": "is not an address",
    "http://farm.local:99999": "is not an address",
    "http://farm.local:x": "is not an address",
    "http://[::1": "is not an address",
    "http://me:secret@farm.local:8080": "a Manager asks for none",
    "http://me:secret@farm.local:x": "It is not an address",
    "ftp://me:secret@farm.local": "It is not an address of http",
    "http://farm.local:8080/app/jobs": "Give http://farm.local:8080 alone",
    "http://farm.local:8080?x=1": "Give http://farm.local:8080 alone",
    "http://farm.local:8080#x": "Give http://farm.local:8080 alone",
}


@pytest.mark.parametrize("text", BAD)
def test_others_are_refused_with_the_next_step(text: str) -> None:
    with pytest.raises(UsageError, match=BAD[text]) as caught:
        parse_address(text)
    assert "secret" not in str(caught.value)
    assert "http://" in caught.value.hint


@pytest.mark.parametrize(
    ("text", "here"),
    [("http://localhost:8080", True), ("http://127.0.0.1", True), ("http://[::1]:80", True),
     ("http://127.0.0.2:8080", True), ("http://127.evil.example", False),
     ("http://localhost.x", False),
     ("http://farm.local", False), ("http://10.0.0.1", False)],
)  # fmt: skip
def test_this_computer_is_known(text: str, here: bool) -> None:
    assert parse_address(text).is_this_computer is here
