# SPDX-License-Identifier: GPL-3.0-or-later
"""Addresses of Dask schedulers: which are allowed, standard library only."""

from __future__ import annotations

import ipaddress
import re
import socket
from urllib.parse import SplitResult, urlsplit

from ..errors import UsageError
from ..settings.choices import COMPUTERS
from ..settings.farm import LOCAL


def checked_address(text: str) -> str:
    """Return an address that may be used.

    Raises
    ------
    UsageError
        It is none, or would send names and commands over a network that others can read.
    """
    if text == LOCAL:
        return text
    found = urlsplit(text) if re.fullmatch(COMPUTERS, text) else None
    if found is None or not found.hostname or not _port_of(found):
        raise UsageError(
            f"{text!r} is no address of a Dask scheduler.", "Give local, or tls://HOST:PORT."
        )
    if found.scheme == "tcp" and not _is_loopback(found.hostname):
        raise UsageError(
            f"{text} is not encrypted: whoever reaches that port runs programs there.",
            "Make certificates (batch.py farm make-certificates DIR) and give tls://HOST:PORT.",
        )
    return text


def _port_of(parts: SplitResult) -> int:
    try:
        return parts.port or 0
    except ValueError:
        return 0


def _is_loopback(host: str) -> bool:
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(host, None)}
    except OSError:
        return False
    return bool(found) and all(ipaddress.ip_address(f.split("%")[0]).is_loopback for f in found)
