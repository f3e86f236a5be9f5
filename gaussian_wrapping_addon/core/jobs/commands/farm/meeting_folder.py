# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder in the shared folder in which this computer and workers leave each other a file.

All files of the check lie in it, so that nothing is left once it is removed: a worker that comes
too late has no place to write to.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import shutil
import time
from pathlib import Path
from typing import Any

from ....cluster.dask_tasks import request_of
from ....errors import UsageError, unwritable_error
from ....files import real_path
from .findings import MODULE

_logger = logging.getLogger(__name__)

SEEN_S = 10.0
"""Longest time until a file that a worker has written is seen here."""
FROM_HERE_NAME = "here.txt"
_POLL_S = 0.2
_MAX_BYTES = 100
_REMOVALS = 5
"""Network file systems keep the name of a file that another computer has open for a moment."""


class MeetingFolder:
    """Made with ``with``, which removes it again.

    Parameters
    ----------
    shared : Path
        The shared folder or one in it, which a job could lie in.
    """

    def __init__(self, shared: Path) -> None:
        self.shared = real_path(shared)
        self.root = self.shared / f"gwrap-doctor-{secrets.token_hex(6)}"
        self.token = secrets.token_hex(16)

    def __enter__(self) -> MeetingFolder:
        if not self.shared.is_dir():
            raise UsageError(
                f"{self.shared} is not a folder.", "Mount the shared folder, or name it."
            )
        try:
            self.root.mkdir()
            (self.root / FROM_HERE_NAME).write_text(self.token, encoding="ascii")
        except OSError as error:
            self.remove()
            raise unwritable_error(self.shared, error) from None
        return self

    def __exit__(self, *_error: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the folder with what lies in it."""
        for _ in range(_REMOVALS):
            shutil.rmtree(self.root, ignore_errors=True)
            if not self.root.exists():
                return
            time.sleep(_POLL_S)
        _logger.warning("%s could not be removed", self.root)

    def requests(self, number: int, deadline_s: float) -> list[dict[str, Any]]:
        """Return what the worker of a number is asked: as a job asks, then without the folder."""
        arguments = {"token": FROM_HERE_NAME, "reply": _reply(number), "deadline_s": deadline_s}
        seen = request_of(self.root, MODULE, arguments, None)
        unseen = {**seen, "arguments": {**arguments, "token": ""}, "folder": ".",
                  "is_shared": False}  # fmt: skip
        return [seen, unseen]

    def unnamed(self, text: str) -> str:
        """Return a text of a worker with the shared folder in place of this one."""
        for separator in "/\\":
            text = text.replace(f"{separator}{self.root.name}", "")
        return text

    async def sees(self, reply: str) -> bool:
        """Return whether a worker's file is here with this text, waiting for it a while."""
        until_s = time.monotonic() + SEEN_S
        while True:
            if any(_text(path) == reply for path in self.root.glob("worker-*.txt")):
                return True
            if time.monotonic() >= until_s:
                return False
            await asyncio.sleep(_POLL_S)


def _reply(number: int) -> str:
    return f"worker-{number}.txt"


def _text(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return stream.read(_MAX_BYTES).decode(errors="replace")
    except OSError:
        return ""
