# SPDX-License-Identifier: GPL-3.0-or-later
"""Servers that are no Managers: each error names the address and the next step, within seconds."""

from __future__ import annotations

import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.cluster.addresses import Address
from gaussian_wrapping_addon.core.errors import FarmError
from gaussian_wrapping_addon.core.farm.flamenco import exchange
from gaussian_wrapping_addon.core.farm.flamenco.exchange import NotFoundError, ask, ask_json, shown
from tests.core.farm.flamenco.stub_manager import StubManager, as_json, error, serving

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"


@pytest.fixture
def stub() -> StubManager:
    return StubManager()


@pytest.fixture
def address(stub: StubManager) -> Iterator[Address]:
    with serving(stub) as found:
        yield found


def raw_server(talk: Callable[[socket.socket], None]) -> tuple[Address, Callable[[], None]]:
    """Serve one connection with bare bytes; return its address and what ends it."""
    listener = socket.create_server(("127.0.0.1", 0))
    over = threading.Event()

    def serve() -> None:
        try:
            wire, _ = listener.accept()
        except OSError:
            return
        with wire:
            wire.settimeout(10.0)
            try:
                wire.recv(65536)
                talk(wire)
                over.wait(10.0)
            except OSError:
                pass

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()

    def end() -> None:
        over.set()
        listener.close()
        thread.join(10.0)
        assert not thread.is_alive()

    return Address("http", "127.0.0.1", listener.getsockname()[1]), end


def test_requests_and_answers(stub: StubManager, address: Address) -> None:
    bodies = []

    def reply(method: str, path: str, body: object) -> exchange.Answer:
        bodies.append((method, path, body))
        return as_json({"x": [1]})  # type: ignore[return-value]

    stub.reply = reply  # type: ignore[assignment,method-assign]
    assert ask_json(address, "GET", "/a") == {"x": [1]}
    assert ask_json(address, "POST", "/b", {"ü": None}) == {"x": [1]}
    assert bodies == [("GET", "/a", None), ("POST", "/b", {"ü": None})]


def test_nobody_answers() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    words = rf"Nothing answers at http://127\.0\.0\.1:{port}\..*flamenco-manager is running"
    with pytest.raises(FarmError, match=words):
        ask(Address("http", "127.0.0.1", port), "GET", "/")


def test_no_such_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(*_arguments: object) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "create_connection", nowhere)
    with pytest.raises(FarmError, match=r"No computer has the name of http://farm\.invalid:80\."):
        ask(Address("http", "farm.invalid", 80), "GET", "/")


def _drip(wire: socket.socket) -> None:
    for _ in range(200):
        wire.sendall(b"H")
        time.sleep(0.02)


def _drip_body(wire: socket.socket) -> None:
    wire.sendall(HEAD + b"Content-Length: 100000\r\n\r\n")
    for _ in range(200):
        wire.sendall(b" ")
        time.sleep(0.02)


def _headers_for_ever(wire: socket.socket) -> None:
    wire.sendall(b"HTTP/1.1 200 OK\r\n")
    for _ in range(200):
        wire.sendall(b"X-A: b\r\n")
        time.sleep(0.02)


SLOW = {
    "silent": lambda _wire: None,
    "letter by letter": _drip,
    "its body byte by byte": _drip_body,
    "headers without end": _headers_for_ever,
}


@pytest.mark.parametrize("name", SLOW)
def test_slow_servers_are_given_up(name: str) -> None:
    address, end = raw_server(SLOW[name])
    begun_s = time.monotonic()
    try:
        with pytest.raises(FarmError, match=rf"{address} has not answered within 0\.5 s.*firewall"):
            ask(address, "GET", "/", deadline_s=0.5)
        assert time.monotonic() - begun_s < 3.0
    finally:
        end()


NO_HTTP = {
    "nothing": b"",
    "another protocol": b"SSH-2.0-OpenSSH_9.2\r\n",
    "a line without end": b"HTTP/1.1 200 " + b"x" * 70_000 + b"\r\n\r\n",
    "a hundred headers": b"HTTP/1.1 200 OK\r\n" + b"X-A: b\r\n" * 200 + b"\r\n",
}


@pytest.mark.parametrize("name", NO_HTTP)
def test_what_is_no_http_is_said(name: str) -> None:
    def talk(wire: socket.socket) -> None:
        wire.sendall(NO_HTTP[name])
        wire.shutdown(socket.SHUT_WR)

    address, end = raw_server(talk)
    try:
        with pytest.raises(FarmError, match=rf"{address} does not answer as HTTP does\."):
            ask(address, "GET", "/", deadline_s=5.0)
    finally:
        end()


@pytest.mark.parametrize("stated", [True, False])
def test_huge_answers_are_not_read_whole(stated: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange, "MAX_ANSWER_BYTES", 2 * 1024**2)
    sent = []

    def talk(wire: socket.socket) -> None:
        length = b"Content-Length: 100000000000\r\n" if stated else b""
        wire.sendall(HEAD + length + b"\r\n")
        for _ in range(1000):
            sent.append(wire.send(b" " * 65536))

    address, end = raw_server(talk)
    try:
        with pytest.raises(FarmError, match=f"{address} answers with more than 2 MB"):
            ask(address, "GET", "/")
    finally:
        end()
    assert sum(sent) < 32 * 1024**2


def test_an_interrupted_answer_is_no_json() -> None:
    def talk(wire: socket.socket) -> None:
        wire.sendall(HEAD + b'Content-Length: 100\r\n\r\n{"x": ')
        wire.shutdown(socket.SHUT_WR)

    address, end = raw_server(talk)
    try:
        with pytest.raises(FarmError, match=f"{address} answers with something else than JSON"):
            ask_json(address, "GET", "/")
    finally:
        end()


ODD = {
    b"<!DOCTYPE html><title>Proxy</title>": "a web page",
    b"  <html>": "a web page",
    b"hello": "something else than JSON",
    b"": "something else than JSON",
    b"[1]": "something else than JSON",
    b"[" * 200_000: "something else than JSON",
    b"\xff\xfe": "something else than JSON",
    b'{"x": ' + b"9" * 10_000 + b"}": "something else than JSON",
}


@pytest.mark.parametrize("data", ODD, ids=range(len(ODD)))
def test_answers_that_are_no_objects(stub: StubManager, address: Address, data: bytes) -> None:
    stub.instead = lambda _method, _path: (200, {"Content-Type": "text/html"}, data)
    words = f"{address} answers with {ODD[data]}, not as a Flamenco Manager does.*proxy"
    with pytest.raises(FarmError, match=words):
        ask_json(address, "GET", "/")


def test_no_redirect_is_followed(stub: StubManager, address: Address) -> None:
    stub.instead = lambda _method, _path: (302, {"Location": "http://evil.example/\x07x"}, b"")
    words = rf"{address} sends on to http://evil\.example/ x\..*Give the Manager's own address"
    with pytest.raises(FarmError, match=words):
        ask(address, "GET", "/")
    assert len(stub.asked) == 1


@pytest.mark.parametrize("status", [400, 403, 412, 500, 503, 407])
def test_refusals_give_the_managers_words(stub: StubManager, address: Address, status: int) -> None:
    message = "no\x1b[31m good\n" + "x" * 1000
    stub.instead = lambda _method, _path: error(status, message)
    with pytest.raises(FarmError) as caught:
        ask(address, "GET", "/")
    said = caught.value.message
    assert said.startswith(f"{address} answers {status}: no [31m good xxx")
    assert len(said) < 400
    assert said.isprintable()
    assert ("busy" in caught.value.hint) == (status == 503)


def test_404_is_told_apart(stub: StubManager, address: Address) -> None:
    stub.instead = lambda _method, _path: (404, {}, b"<html>")
    with pytest.raises(NotFoundError, match=rf"{address} answers 404\."):
        ask(address, "GET", "/")


def test_proxies_of_the_environment_are_not_asked(
    stub: StubManager, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    assert ask_json(address, "GET", "/api/v3/version")["name"] == "Stub"


def test_https_needs_a_trusted_certificate(tmp_path: Path) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    try:
        subprocess.run(
            ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj",
             "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
             "-keyout", str(key), "-out", str(certificate)],
            check=True, capture_output=True,
        )  # fmt: skip
    except FileNotFoundError:
        pytest.skip("openssl, which makes certificates, is not installed")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    answer = HEAD + b"Content-Length: 2\r\n\r\n{}"

    def served() -> Address:
        listener = socket.create_server(("127.0.0.1", 0))

        def serve() -> None:
            with listener, listener.accept()[0] as wire:
                try:
                    with context.wrap_socket(wire, server_side=True) as safe:
                        safe.recv(65536)
                        safe.sendall(answer)
                except OSError:
                    pass

        threading.Thread(target=serve, daemon=True).start()
        return Address("https", "127.0.0.1", listener.getsockname()[1])

    with pytest.raises(FarmError, match=r"certificate of https://127\.0\.0\.1:\d+ is not trusted"):
        ask_json(served(), "GET", "/")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SSL_CERT_FILE", str(certificate))
        assert ask_json(served(), "GET", "/") == {}


def test_https_to_a_server_of_http(address: Address) -> None:
    with pytest.raises(FarmError, match="by default it takes http"):
        ask(Address("https", address.host, address.port), "GET", "/", deadline_s=5.0)


def test_text_of_others_is_one_short_line() -> None:
    assert shown("a\r\n\tb\x1b[0m\u202e c") == "a b [0m c"
    assert shown(None) == shown(7) == ""
    assert len(shown("x" * 10_000)) == 300
