# SPDX-License-Identifier: GPL-3.0-or-later
"""Stands for a Flamenco Manager: answers as its public description (OpenAPI) says.

No part of Flamenco is run. What its real answers hold beyond the description is not known here.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.cluster.addresses import Address
from gaussian_wrapping_addon.core.farm.address import parse_address
from gaussian_wrapping_addon.core.farm.flamenco.manager import Manager, platform
from gaussian_wrapping_addon.core.farm.flamenco.submission import Choices, Farm

JOB = "0a5b5b6e-11c5-4a1c-8c5e-2d4d9a3a2b10"
TASK = "7c1f0c3e-7d1b-4c34-9f58-0c2f1f1f{:04x}"
TAG = "4312d68c-ea6d-4566-9bf6-e9f09be48ceb"

CHOICES = Choices()
FARM = Farm(
    Manager(parse_address("http://127.0.0.1:1")),
    "3.8",
    "etag",
    "",
    Path("/farm"),
    "{gw_shared}",
    (),
)
"""As a Manager describes itself, for what asks none."""

Reply = tuple[int, dict[str, str], bytes]


class StubManager:
    """Jobs of a Manager in memory, and what to answer."""

    def __init__(self) -> None:
        self.version: Any = {
            "version": "3.8.2", "shortversion": "3.8.2", "name": "Stub", "git": "v3.8.2",
        }  # fmt: skip
        setting = {"key": "script_version", "type": "int32", "default": 1}
        self.job_type: Any = {
            "name": "gaussian-wrapping", "label": "Gaussian Wrapping", "settings": [setting],
            "etag": "abc123",
        }  # fmt: skip
        self.variables: dict[str, Any] = {
            name: {"value": value, "is_twoway": name == "gw_shared"}
            for name, value in (
                ("gw_shared", "/farm"), ("gw_python", "/gw/python"), ("gw_batch", "/gw/batch.py"),
            )
        }  # fmt: skip
        self.tags: Any = {"tags": [{"id": TAG, "name": "big", "description": ""}]}
        self.status = "queued"
        self.known = True
        self.tasks: list[dict[str, Any]] = []
        self.logs: dict[str, str] = {}
        self.submitted: list[dict[str, Any]] = []
        self.asked: list[tuple[str, str]] = []
        self.changes: list[dict[str, Any]] = []
        self.instead: Callable[[str, str], Reply | None] = lambda _method, _path: None
        """Replaces the answer to a request."""

    def reply(self, method: str, path: str, body: Any) -> Reply:
        self.asked.append((method, path))
        found = self.instead(method, path)
        return found if found is not None else self._reply(method, path, body)

    def _reply(self, method: str, path: str, body: Any) -> Reply:
        inner = path.removeprefix("/api/v3")
        if (method, inner) == ("GET", "/version"):
            return as_json(self.version)
        if (method, inner) == ("GET", "/jobs/type/gaussian-wrapping"):
            return as_json(self.job_type) if self.job_type else error(404, "no such job type known")
        if method == "GET" and inner in (
            f"/configuration/variables/users/{platform()}",
            f"/configuration/variables/workers/{platform()}",
        ):
            return as_json(self.variables)
        if (method, inner) == ("GET", "/worker-mgt/tags"):
            return as_json(self.tags)
        if (method, inner) == ("POST", "/jobs"):
            return self._submit(body)
        if inner.startswith(f"/jobs/{JOB}") and self.known:
            return self._of_job(method, inner.removeprefix(f"/jobs/{JOB}"), body)
        if method == "GET" and inner.startswith("/tasks/"):
            return self._of_task(*inner.removeprefix("/tasks/").split("/"))
        return error(404, "no such thing")

    def _submit(self, body: Any) -> Reply:
        if body.get("type_etag") != self.job_type["etag"]:
            return error(412, "rejecting job because its settings are outdated")
        self.submitted.append(body)
        parts = json.loads(body["settings"]["parts"])["parts"]
        self.tasks = [
            {
                "id": TASK.format(k), "name": part["name"], "status": "queued", "priority": 50,
                "task_type": "misc", "updated": "2026-11-26T10:00:00Z",
            }
            for k, part in enumerate(parts)
        ]  # fmt: skip
        return as_json(body | {"id": JOB, "status": self.status, "activity": ""})

    def _of_job(self, method: str, rest: str, body: Any) -> Reply:
        if (method, rest) == ("GET", ""):
            return as_json({"id": JOB, "status": self.status, "name": "castle"})
        if (method, rest) == ("GET", "/tasks"):
            return as_json({"tasks": self.tasks})
        if (method, rest) == ("POST", "/setstatus"):
            self.changes.append(body)
            return 204, {}, b""
        return error(404, "no such thing")

    def _of_task(self, task: str, rest: str = "") -> Reply:
        if rest == "logtail":
            text = self.logs.get(task, "")
            return (200, {"Content-Type": "text/plain"}, text.encode()) if text else (204, {}, b"")
        worker = {"id": TAG, "name": "blade-3", "address": "10.0.0.3"}
        return as_json({"id": task, "worker": worker})

    def fail(self, name: str, log: str, status: str = "failed") -> None:
        """Let a task have failed."""
        (task,) = (t for t in self.tasks if t["name"] == name)
        task["status"] = status
        self.logs[task["id"]] = log


def as_json(values: Any) -> Reply:
    return 200, {"Content-Type": "application/json"}, json.dumps(values).encode()


def error(status: int, message: str) -> Reply:
    body = json.dumps({"code": status, "message": message}).encode()
    return status, {"Content-Type": "application/json"}, body


@contextmanager
def serving(stub: StubManager) -> Iterator[Address]:
    """Serve a stub on this computer."""

    class Handler(BaseHTTPRequestHandler):
        def _answer(self) -> None:
            length = int(self.headers.get("Content-Length") or 0)
            text = self.rfile.read(length)
            status, headers, data = stub.reply(
                self.command, self.path, json.loads(text) if text else None
            )
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            if status != 204:
                self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        do_GET = do_POST = _answer  # noqa: N815 - of the base class

        def log_message(self, *_arguments: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield parse_address(f"http://127.0.0.1:{server.server_address[1]}")
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
