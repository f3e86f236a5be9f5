# SPDX-License-Identifier: GPL-3.0-or-later
"""Which job of which Manager a job folder was submitted as: ``flamenco.json`` in the folder."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from ... import limits
from ...errors import ParseError, UsageError, unwritable_error
from ...files import read_json, write_json
from ..address import Address, parse_address

RECORD_FILE = "flamenco.json"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class JobRecord:
    """A submitted job."""

    address: Address
    job: str
    """Its id there."""


def write_record(root: Path, record: JobRecord) -> None:
    """Write the record into a job folder.

    Raises
    ------
    ResourceError
        It cannot be written.
    """
    values = {
        "version": FORMAT_VERSION,
        "address": str(record.address),
        "job": record.job,
        "submitted_s": time.time(),
    }
    try:
        write_json(root / RECORD_FILE, values)
    except OSError as error:
        raise unwritable_error(root / RECORD_FILE, error) from None


def read_record(root: Path) -> JobRecord | None:
    """Return the record of a job folder; None where it was never submitted.

    Raises
    ------
    ParseError
        It is damaged.
    """
    path = root / RECORD_FILE
    try:
        values = read_json(path, most_bytes=limits.MAX_STATUS_BYTES)
    except FileNotFoundError:
        return None
    if isinstance(values, dict) and values.get("version") == FORMAT_VERSION:
        try:
            return JobRecord(parse_address(str(values.get("address"))), _id(values.get("job")))
        except (UsageError, ValueError):
            pass
    raise ParseError(
        path, "whole file", "it names no job of a Manager.", "Delete it, then submit again."
    )


def submitted(root: Path) -> JobRecord:
    """Return the record of a job folder that was submitted.

    Raises
    ------
    UsageError
        It was not.
    """
    record = read_record(root)
    if record is None:
        raise UsageError(
            f"{root} was not submitted to Flamenco.", "Submit it: batch.py farm submit DIR."
        )
    return record


def _id(text: object) -> str:
    return str(UUID(text if isinstance(text, str) else ""))
