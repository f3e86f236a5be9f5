# SPDX-License-Identifier: GPL-3.0-or-later
"""The address of a Dask scheduler, and whether something accepts connections there."""

from __future__ import annotations

import re
import socket
from urllib.parse import urlsplit

from ..errors import FarmError, UsageError
from ..settings.choices import COMPUTERS
from .address import Address

CONNECT_S = 5.0
_EXAMPLE = "Give one such as tcp://computer:8786."
_SHOWN_CHARACTERS = 100


def scheduler_address(text: str) -> Address:
    """Return the address of a Dask scheduler: ``tcp://HOST:PORT`` or ``tls://HOST:PORT``.

    Raises
    ------
    UsageError
        It is none.
    """
    given = text.strip()
    if "://" in given and re.fullmatch(COMPUTERS, given):
        try:
            parts = urlsplit(given)
            if parts.hostname and parts.port:
                return Address(parts.scheme, parts.hostname, parts.port)
        except ValueError:  # a port beyond 65535, brackets without an address
            pass
    raise UsageError(f"{given[:_SHOWN_CHARACTERS]!r} is no address of a Dask scheduler.", _EXAMPLE)


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
            "Check the address, and that dask scheduler is running there.",
        ) from None
