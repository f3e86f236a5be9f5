# SPDX-License-Identifier: GPL-3.0-or-later
"""One request to a Manager and its answer: bounded in time and size, never elsewhere.

``http.client`` instead of ``urllib.request``: that follows redirects and asks the proxies of the
environment, and its time limit is one for each packet, which a slow sender never reaches.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import ssl
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ...errors import FarmError
from ..address import Address

CONNECT_S = 5.0
ANSWER_S = 15.0
"""For a whole request and its answer."""
MAX_ANSWER_BYTES = 16 * 1024 * 1024
"""The tasks of a job with 10,000 parts take a quarter of it."""

_OK = (200, 202, 204)
_BUSY = 503
_SHOWN_CHARACTERS = 300
_CHECK = "Check the address, and that flamenco-manager is running there."


class NotFoundError(FarmError):
    """The Manager does not know what was asked for."""


@dataclass(frozen=True)
class Answer:
    """What a Manager answered, with a status of success."""

    status: int
    data: bytes


def ask(
    address: Address,
    method: str,
    path: str,
    values: Any = None,
    *,
    deadline_s: float = ANSWER_S,
) -> Answer:
    """Send one request and return the answer.

    Parameters
    ----------
    path : str
        With its leading slash, made of our own words and of checked names only.
    values : JSON values, optional
        The request's body.
    deadline_s : float
        Seconds for the whole of it.

    Raises
    ------
    FarmError
        Nobody answers, not in time, not as HTTP, or with too much; or the Manager refuses.
    NotFoundError
        It answers 404.
    """
    headers = {"Accept": "application/json", "Connection": "close"}
    body = None
    if values is not None:
        body = json.dumps(values, allow_nan=False).encode()
        headers["Content-Type"] = "application/json"
    with _connection(address, deadline_s) as connection:
        connection.request(method, path, body, headers)
        response = connection.getresponse()
        data = response.read(MAX_ANSWER_BYTES + 1)
        status, location = response.status, response.getheader("Location") or ""
    if len(data) > MAX_ANSWER_BYTES:
        size = MAX_ANSWER_BYTES // 1024**2
        raise FarmError(f"{address} answers with more than {size} MB, as no Manager does.", _CHECK)
    if 300 <= status < 400:
        raise FarmError(
            f"{address} sends on to {shown(location) or 'another place'}.",
            "No redirect is followed. Give the Manager's own address.",
        )
    if status not in _OK:
        raise _refusal(address, status, data)
    return Answer(status, data)


def ask_json(
    address: Address,
    method: str,
    path: str,
    values: Any = None,
    *,
    deadline_s: float = ANSWER_S,
) -> dict[str, Any]:
    """Send one request and return the JSON object of the answer; raises as :func:`ask`.

    Raises
    ------
    FarmError
        The answer is no JSON object, such as a page of a proxy.
    """
    answer = ask(address, method, path, values, deadline_s=deadline_s)
    found = _json(answer.data)
    if not isinstance(found, dict):
        page = answer.data.lstrip()[:1] == b"<"
        what = "a web page" if page else "something else than JSON"
        raise FarmError(
            f"{address} answers with {what}, not as a Flamenco Manager does.",
            f"{_CHECK} Another server or a proxy may have answered.",
        )
    return found


def shown(text: Any) -> str:
    """Return text of a Manager as one short line without control characters."""
    words = text if isinstance(text, str) else ""
    line = " ".join("".join(c if c.isprintable() else " " for c in words).split())
    return line[:_SHOWN_CHARACTERS]


def _json(data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def _refusal(address: Address, status: int, data: bytes) -> FarmError:
    found = _json(data)
    words = shown(found.get("message")) if isinstance(found, dict) else ""
    said = f"{address} answers {status}{f': {words}' if words else ''}."
    if status == http.HTTPStatus.NOT_FOUND:
        return NotFoundError(said, _CHECK)
    if status == _BUSY:
        return FarmError(said, "Its database is busy: try again in a minute.")
    return FarmError(said, "See the Manager's own messages in its terminal." if words else _CHECK)


@contextlib.contextmanager
def _connection(address: Address, deadline_s: float) -> Iterator[http.client.HTTPConnection]:
    """Connect; end the connection when the time is over; name the address in all errors."""
    line: list[socket.socket] = []
    late = threading.Event()

    def give_up() -> None:
        late.set()
        for wire in line:
            with contextlib.suppress(OSError):
                # Not SSLSocket.shutdown, which disturbs the thread that reads.
                socket.socket.shutdown(wire, socket.SHUT_RDWR)

    timer = threading.Timer(deadline_s, give_up)
    timer.daemon = True
    connection = http.client.HTTPConnection(address.host, address.port)
    try:
        line.append(socket.create_connection((address.host, address.port), CONNECT_S))
        timer.start()
        line[0].settimeout(deadline_s)
        if address.scheme == "https":
            context = ssl.create_default_context()
            line[0] = context.wrap_socket(
                line[0], server_hostname=address.host, do_handshake_on_connect=False
            )
            line[0].do_handshake()  # type: ignore[attr-defined]
        connection.sock = line[0]
        yield connection
        if late.is_set():
            raise TimeoutError
    except ssl.SSLCertVerificationError as error:
        raise FarmError(
            f"The certificate of {address} is not trusted: {error.verify_message}.",
            "Use a certificate that this computer trusts, or http on a network that you trust.",
        ) from None
    except ssl.SSLError as error:
        hint = "Check whether the Manager takes https; by default it takes http."
        raise FarmError(f"{address} does not answer by https: {error.reason}.", hint) from None
    except socket.gaierror:
        raise FarmError(f"No computer has the name of {address}.", "Check its spelling.") from None
    except (OSError, http.client.HTTPException, ValueError) as error:
        if late.is_set() or isinstance(error, TimeoutError):
            words = f"{address} has not answered within {deadline_s:g} s."
            raise FarmError(words, f"{_CHECK} A firewall may be between.") from None
        if isinstance(error, ConnectionRefusedError):
            raise FarmError(f"Nothing answers at {address}.", _CHECK) from None
        if isinstance(error, http.client.HTTPException | ValueError):
            raise FarmError(f"{address} does not answer as HTTP does.", _CHECK) from None
        reason = error.strerror or str(error)
        raise FarmError(f"{address} cannot be reached: {reason}.", _CHECK) from None
    finally:
        timer.cancel()
        connection.close()
        for wire in line:
            wire.close()
