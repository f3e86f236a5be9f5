# SPDX-License-Identifier: GPL-3.0-or-later
"""Addresses of a Flamenco Manager."""

from __future__ import annotations

import re
from urllib.parse import urlsplit

from ..cluster.addresses import Address
from ..errors import UsageError

_HOST = re.compile(r"[A-Za-z0-9._:%-]{1,253}")
_PORTS = {"http": 80, "https": 443}
_EXAMPLE = "Give scheme, computer and port, such as http://flamenco.local:8080."
_SHOWN_CHARACTERS = 100


def parse_address(text: str) -> Address:
    """Return the address of a Flamenco Manager that a user has given.

    Raises
    ------
    UsageError
        It is not http or https, has no host, or more than scheme, host and port.
    """
    shown = "It" if "@" in text else repr(text[:_SHOWN_CHARACTERS])  # no password in messages
    if not text.strip():
        raise UsageError("No address of a Flamenco Manager is given.", _EXAMPLE)
    try:
        parts = urlsplit(text.strip())
        host, port = parts.hostname or "", parts.port
    except ValueError as error:
        raise UsageError(f"{shown} is not an address: {error}.", _EXAMPLE) from None
    if parts.scheme not in _PORTS or not _HOST.fullmatch(host):
        raise UsageError(f"{shown} is not an address of http or https.", _EXAMPLE)
    if parts.username is not None or parts.password is not None:
        raise UsageError("The address has a name or password; a Manager asks for none.", _EXAMPLE)
    address = Address(parts.scheme, host, _PORTS[parts.scheme] if port is None else port)
    if parts.path not in ("", "/") or parts.query or parts.fragment:
        raise UsageError(f"{shown} has more than the address.", f"Give {address} alone.")
    return address
