# SPDX-License-Identifier: GPL-3.0-or-later
"""Addresses of Dask schedulers: what is encrypted, or stays on this computer, is allowed."""

from __future__ import annotations

import re

import pytest

from gaussian_wrapping_addon.core.cluster.addresses import checked_address
from gaussian_wrapping_addon.core.errors import UsageError


@pytest.mark.parametrize(
    "text",
    ["local", "tls://farm:8786", "tls://10.0.0.7:1", "tls://[fe80::1]:65535", "tcp://127.0.0.1:9",
     "tcp://localhost:8786", "tcp://[::1]:8786"],
)  # fmt: skip
def test_allowed(text: str) -> None:
    assert checked_address(text) == text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("tcp://10.0.0.7:8786", "is not encrypted.*make-certificates"),
        ("tcp://0.0.0.0:8786", "is not encrypted"),
        ("tcp://no.such.computer.invalid:8786", "is not encrypted"),
        ("", "is no address"),
        ("tls://farm", "is no address"),
        ("tls://farm:0", "is no address"),
        ("tls://farm:65536", "is no address"),
        ("tls://farm:8786/x", "is no address"),
        ("tls://a@farm:8786", "is no address"),
        ("http://farm:8786", "is no address"),
        ("ucx://farm:8786", "is no address"),
    ],
)
def test_refused(text: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        checked_address(text)
    assert re.search(says, str(caught.value))
