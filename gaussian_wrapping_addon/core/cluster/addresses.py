# SPDX-License-Identifier: GPL-3.0-or-later
"""Addresses of Dask schedulers: how they are written, and which are allowed."""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass, replace
from urllib.parse import urlsplit

from ..errors import FarmError, UsageError
from ..settings.choices import COMPUTERS

CONNECT_S = 5.0
_EXAMPLE = "Give one such as tls://computer:8786."
_SHOWN_CHARACTERS = 100


@dataclass(frozen=True)
class Address:
    """Scheme, host and port."""

    scheme: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"

    @property
    def is_this_computer(self) -> bool:
        """Whether requests do not leave this computer; no name is looked up."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def listening(self) -> Address:
        """Return where a server listens that others reach at this address: at all networks."""
        if self.is_this_computer:
            return self
        return replace(self, host="::" if ":" in self.host else "0.0.0.0")  # noqa: S104 - TLS only


def scheduler_address(text: str) -> Address:
    """Return an address of a Dask scheduler that may be used.

    Raises
    ------
    UsageError
        It is none, or would send names and commands over a network that others can read: all but
        the addresses of this computer must be ``tls://``.
    """
    given = text.strip()
    address = _parsed(given) if "://" in given and re.fullmatch(COMPUTERS, given) else None
    if address is None:
        shown = given[:_SHOWN_CHARACTERS]
        raise UsageError(f"{shown!r} is no address of a Dask scheduler.", _EXAMPLE)
    if address.scheme != "tls" and not address.is_this_computer:
        raise UsageError(
            f"{address} is not encrypted: whoever reaches that port runs programs there.",
            "Make certificates (batch.py farm make-certificates DIR) and give tls://HOST:PORT.",
        )
    return address


def _parsed(text: str) -> Address | None:
    try:
        parts = urlsplit(text)
        if parts.hostname and parts.port:
            return Address(parts.scheme, parts.hostname, parts.port)
    except ValueError:  # a port beyond 65535, brackets without an address
        pass
    return None


def check_reachable(address: Address) -> None:
    """Connect to an address and hang up; nothing is sent.

    Raises
    ------
    FarmError
        Nothing accepts connections there.
    """
    try:
        socket.create_connection((address.host, address.port), CONNECT_S).close()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", "") or str(error)
        raise FarmError(
            f"Nothing accepts connections at {address}: {reason}.",
            "Check the address, and that a scheduler runs there: batch.py farm scheduler.",
        ) from None
