# SPDX-License-Identifier: GPL-3.0-or-later
"""Certificates of a farm: made whole, private, and good for a connection between two sides."""

from __future__ import annotations

import os
import socket
import ssl
import threading
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import ResourceError, UsageError
from gaussian_wrapping_addon.core.farm import addresses
from gaussian_wrapping_addon.core.farm.addresses import (
    CA_NAME,
    CERTIFICATE_NAME,
    FOLDER_VARIABLE,
    KEY_NAME,
    checked_folder,
    make_certificates,
)

pytest.importorskip("cryptography", reason="the extra farm is not installed")


def context(folder: Path, purpose: ssl.Purpose) -> ssl.SSLContext:
    """Return the context of one side, as Dask makes it."""
    made = ssl.create_default_context(purpose=purpose, cafile=str(folder / CA_NAME))
    made.check_hostname = False
    made.verify_mode = ssl.CERT_REQUIRED
    made.load_cert_chain(folder / CERTIFICATE_NAME, folder / KEY_NAME)
    return made


def shake_hands(server: Path, client: Path) -> None:
    """Connect a client to a server with their own certificates."""
    here, there = socket.socketpair()
    here.settimeout(10.0)
    there.settimeout(10.0)

    def serve() -> None:
        try:
            with context(server, ssl.Purpose.CLIENT_AUTH).wrap_socket(
                here, server_side=True
            ) as end:
                end.sendall(b"hello")
        except (ssl.SSLError, OSError):
            here.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with context(client, ssl.Purpose.SERVER_AUTH).wrap_socket(there) as end:
            assert end.recv(5) == b"hello"
    finally:
        there.close()
        thread.join()


def test_the_computers_of_a_farm_know_each_other_and_nobody_else(tmp_path: Path) -> None:
    make_certificates(tmp_path / "ours")
    make_certificates(tmp_path / "theirs")
    shake_hands(tmp_path / "ours", tmp_path / "ours")
    with pytest.raises((ssl.SSLError, OSError, AssertionError)):
        shake_hands(tmp_path / "ours", tmp_path / "theirs")


@pytest.mark.skipif(os.name == "nt", reason="Windows has other permissions")
def test_the_key_is_for_its_owner_and_stays_and_that_of_the_authority_is_gone(
    tmp_path: Path,
) -> None:
    make_certificates(tmp_path / "keys")
    files = {path: path.read_text() for path in (tmp_path / "keys").iterdir()}
    assert {path.name for path in files} == {CA_NAME, CERTIFICATE_NAME, KEY_NAME}
    assert {path.stat().st_mode & 0o777 for path in files} == {0o600}
    assert sum("PRIVATE KEY" in text for text in files.values()) == 1
    with pytest.raises(UsageError, match="already"):
        make_certificates(tmp_path / "keys")
    assert {path: path.read_text() for path in files} == files
    (tmp_path / "file").write_text("")
    with pytest.raises(ResourceError):
        make_certificates(tmp_path / "file" / "keys")


def test_the_folder_is_given_or_that_of_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    with pytest.raises(UsageError, match="needs certificates"):
        checked_folder("")
    with pytest.raises(UsageError, match=r"holds no ca\.pem"):
        checked_folder(str(tmp_path))
    make_certificates(tmp_path)
    assert checked_folder(str(tmp_path)) == tmp_path
    monkeypatch.setenv(addresses.FOLDER_VARIABLE, str(tmp_path))
    assert checked_folder("") == tmp_path


@pytest.mark.parametrize("name", [CA_NAME, CERTIFICATE_NAME, KEY_NAME])
@pytest.mark.parametrize("how", ["garbage", "empty", "cut", "of another farm"])
def test_files_that_are_damaged_or_mixed_up_are_told_as_such(
    tmp_path: Path, name: str, how: str
) -> None:
    """Dask would say that nobody answers, or that it cannot listen."""
    keys, others = tmp_path / "keys", tmp_path / "others"
    make_certificates(keys)
    make_certificates(others)
    whole = (keys / name).read_bytes()
    (keys / name).write_bytes(
        {
            "garbage": b"garbage\n", "empty": b"", "cut": whole[: len(whole) // 2],
            "of another farm": (others / name).read_bytes(),
        }[how]
    )  # fmt: skip
    if (how, name) == ("of another farm", CA_NAME):
        assert checked_folder(str(keys)) == keys, "only the other side can tell"
        return
    with pytest.raises(UsageError, match="cannot be used"):
        checked_folder(str(keys))
