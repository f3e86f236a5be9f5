# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``farm make-certificates`` command; runs in the worker's Python, which has the packages."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from ...farm.addresses import make_certificates
from .run_in_worker import run_command


def main(arguments: list[str]) -> int:
    """Make certificates for ``arguments = [{"folder"} as JSON]``."""

    def work() -> Iterator[str]:
        folder = Path(json.loads(arguments[0])["folder"])
        make_certificates(folder)
        yield f"certificates in {folder}: copy the folder to all computers, show it to nobody else"

    return run_command(work)
