# SPDX-License-Identifier: GPL-3.0-or-later
"""Addresses of schedulers, and the certificates of tls:// ones."""

from __future__ import annotations

import datetime
import ipaddress
import os
import re
import socket
import ssl
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

from ..errors import FarmError, UsageError, unwritable_error
from ..settings.declaration import COMPUTERS
from ..worker.environment import load_extra

# -- Addresses of Dask schedulers: how they are written, and which are allowed --------------------

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

    Raises UsageError: it is none, or would send names and commands over a network that others can
    read: all but the addresses of this computer must be ``tls://``.
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

    Raises FarmError: nothing accepts connections there.
    """
    try:
        socket.create_connection((address.host, address.port), CONNECT_S).close()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", "") or str(error)
        raise FarmError(
            f"Nothing accepts connections at {address}: {reason}.",
            "Check the address, and that a scheduler runs there: batch.py farm scheduler.",
        ) from None


# -- Certificates by which the computers of a farm know each other and encrypt what they say ------
#
# One authority signs one certificate for all: who holds the folder belongs to the farm.

CA_NAME, CERTIFICATE_NAME, KEY_NAME = "ca.pem", "farm.pem", "farm-key.pem"
FOLDER_VARIABLE = "GW_CERTIFICATES"
VALID_DAYS = 825
_SECRET = 0o600


def checked_folder(folder: str) -> Path:
    """Return the folder of the certificates; that of the environment where none is given.

    Raises UsageError: none is named, or files are missing in it or damaged.
    """
    named = folder or os.environ.get(FOLDER_VARIABLE, "")
    if not named:
        raise UsageError(
            "An address with tls:// needs certificates.",
            f"Give their folder (--certificates, or {FOLDER_VARIABLE}); batch.py farm "
            "make-certificates DIR makes some.",
        )
    path = Path(named)
    missing = [n for n in (CA_NAME, CERTIFICATE_NAME, KEY_NAME) if not (path / n).is_file()]
    if missing:
        raise UsageError(
            f"{path} holds no {missing[0]}.",
            "Make certificates with batch.py farm make-certificates DIR, and copy the folder to "
            "all computers.",
        )
    try:
        # As Dask does later, where an error looks like one of the network.
        context = ssl.create_default_context(cafile=str(path / CA_NAME))
        context.load_cert_chain(path / CERTIFICATE_NAME, path / KEY_NAME, password=_no_password)
    except (OSError, ValueError) as error:  # SSLError is one
        said = getattr(error, "reason", None) or getattr(error, "strerror", None)
        raise UsageError(
            f"The certificates in {path} cannot be used: {said or error}.",
            "Copy the folder again, whole, from the computer where it was made.",
        ) from None
    return path


def _no_password() -> str:
    raise ValueError("the key has a password")


def make_certificates(folder: Path) -> None:
    """Make an authority and a certificate; the authority's key is not kept.

    Raises MissingExtraError; UsageError: there are some already: computers that have them would be
    left behind; ResourceError: the folder cannot be written.
    """
    load_extra("farm", "Certificates")
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    names = (CA_NAME, CERTIFICATE_NAME, KEY_NAME)
    there = [name for name in names if (folder / name).exists()]
    if there:
        raise UsageError(f"{folder} has {there[0]} already.", "Give another folder.")
    now = datetime.datetime.now(datetime.UTC)

    def certificate(
        name: str, key: ec.EllipticCurvePrivateKey, issuer: str,
        issuer_key: ec.EllipticCurvePrivateKey, is_authority: bool,
    ) -> x509.Certificate:  # fmt: skip
        def named(text: str) -> x509.Name:
            return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])

        return (
            x509.CertificateBuilder()
            .subject_name(named(name))
            .issuer_name(named(issuer))
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))  # clocks differ
            .not_valid_after(now + datetime.timedelta(days=VALID_DAYS))
            .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
            .add_extension(
                x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False
            )
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key()),
                critical=False,
            )
            .sign(issuer_key, hashes.SHA256())
        )

    ca_key, key = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    authority = "Gaussian Wrapping farm"
    pem = serialization.Encoding.PEM
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    ca = certificate(authority, ca_key, authority, ca_key, True).public_bytes(pem)
    own = certificate("farm", key, authority, ca_key, False).public_bytes(pem)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in zip(names, (ca, own, secret), strict=True):
            number = os.open(folder / name, os.O_CREAT | os.O_EXCL | os.O_WRONLY, _SECRET)
            with os.fdopen(number, "wb") as stream:
                stream.write(data)
    except OSError as error:
        raise unwritable_error(folder, error) from None
