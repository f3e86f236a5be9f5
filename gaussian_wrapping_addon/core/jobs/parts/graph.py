# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of a job, what each needs, and ``parts.json`` (docs/file-formats.md, Parts)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from graphlib import CycleError, TopologicalSorter
from pathlib import Path, PurePosixPath
from typing import Any

from ... import limits
from ...errors import ParseError, UsageError
from ...files import read_json, write_json

VERSION = 1
PARTS_NAME = "parts.json"
KINDS = (
    "cameras", "masks", "coarse", "block", "train", "plan", "points", "gather", "faces", "mesh",
    "texture", "bake", "export",
)  # fmt: skip
"""In the order of a job."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,79}")
"""Of a part: also that of its state file."""
_AGAIN = "Plan the parts again: batch.py parts DIR."


@dataclass(frozen=True)
class Part:
    """What one process does at a time; it can be repeated, with the same result."""

    name: str
    kind: str
    needs: tuple[str, ...]
    """Names of parts that are done before."""
    outputs: tuple[str, ...]
    """Patterns of the files it makes, relative to the job folder; the state of a finished part
    has their names."""
    share: float
    """Of the job's time, estimated."""
    region: str = ""
    """Folder name of its region, if it is of one."""
    tile: int = -1
    """Number of its tile, if it is of one."""
    memory_bytes: int | None = None
    seconds: float | None = None
    """Estimated; ``None`` where nothing is known yet."""
    block: int = -1
    """Number of its block, if it trains one."""

    @property
    def is_one_of_many(self) -> bool:
        """Whether parts of its kind can run side by side with it."""
        return self.tile >= 0 or self.block >= 0


@dataclass(frozen=True)
class PartsGraph:
    """All parts of a job that are known so far."""

    code: str
    """Version of the code that planned: another one must not run the parts."""
    plan: str
    """Hash of what is to be done."""
    source: str
    """Path of the photos relative to the job folder; empty if they are on another drive."""
    parts: tuple[Part, ...]

    def part(self, name: str) -> Part:
        """Return a part by its name.

        Raises
        ------
        UsageError
            There is none of this name.
        """
        for part in self.parts:
            if part.name == name:
                return part
        raise UsageError(f"The job has no part {name}.", f"Its parts are listed in {PARTS_NAME}.")

    def of_region(self, region: str) -> list[Part]:
        """Return the parts of a region, in their order."""
        return [part for part in self.parts if part.region == region]


def write_parts(folder: Path, graph: PartsGraph) -> None:
    """Write ``parts.json`` into a job folder, atomically."""
    write_json(
        folder / PARTS_NAME,
        {
            "version": VERSION,
            "code": graph.code,
            "plan": graph.plan,
            "source": graph.source,
            "parts": [
                {f.name: _json_value(getattr(part, f.name)) for f in fields(Part)}
                for part in graph.parts
            ],
        },
    )


def _json_value(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def read_parts(folder: Path) -> PartsGraph:
    """Read and check ``parts.json`` of a job folder.

    Raises
    ------
    UsageError
        There is none.
    ParseError
        It is damaged, of another version, too large, or its parts do not fit together.
    """
    path = folder / PARTS_NAME
    try:
        values = read_json(path, most_bytes=limits.MAX_PARTS_BYTES)
    except FileNotFoundError:
        raise UsageError(
            f"{folder} has no {PARTS_NAME}: its work is not divided into parts yet.",
            "Divide it: batch.py parts DIR.",
        ) from None
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise ParseError(path, "version", f"it is not {VERSION}.", _AGAIN)
    listed = values.get("parts")
    if not isinstance(listed, list) or not 0 < len(listed) <= limits.MAX_PARTS:
        wanted = f"not a list of 1 to {limits.MAX_PARTS:,} parts."
        raise ParseError(path, "parts", wanted, _AGAIN)
    texts = {}
    for key in ("code", "plan", "source"):
        found = values.get(key)
        if not isinstance(found, str) or len(found) > limits.MAX_NAME_BYTES:
            raise ParseError(path, key, "not a short text.", _AGAIN)
        texts[key] = found
    parts = []
    for number, entry in enumerate(listed):
        try:
            parts.append(_part_of(entry))
        except _WrongEntryError as error:
            where = f"parts[{number}]" + (f".{error.entry}" if error.entry else "")
            raise ParseError(path, where, f"{error}.", _AGAIN) from None
    graph = PartsGraph(texts["code"], texts["plan"], texts["source"], tuple(parts))
    _check_order(path, graph.parts)
    return graph


class _WrongEntryError(ValueError):
    """An entry of a part that is not as it should be."""

    def __init__(self, entry: str, words: str) -> None:
        super().__init__(words)
        self.entry = entry


def _part_of(entry: Any) -> Part:
    if not isinstance(entry, dict) or set(entry) != {f.name for f in fields(Part)}:
        raise _WrongEntryError("", "not the entries of a part")
    for key in ("name", "region"):
        text = entry[key]
        if not isinstance(text, str) or not (
            NAME.fullmatch(text) or (key == "region" and not text)
        ):
            raise _WrongEntryError(key, "not a name of letters, digits, _ and -")
    if entry["kind"] not in KINDS:
        raise _WrongEntryError("kind", "no kind of parts")
    outputs = _texts(entry, "outputs")
    for output in outputs:
        if PurePosixPath(output).is_absolute() or ".." in output or "\\" in output or ":" in output:
            raise _WrongEntryError("outputs", "not inside of the job folder")
    needs = _texts(entry, "needs")
    if len(set(needs)) != len(needs):
        raise _WrongEntryError("needs", "a name is there twice")
    return Part(
        entry["name"], entry["kind"], needs, outputs, _number(entry, "share", 0.0, 1.0),
        entry["region"], int(_number(entry, "tile", -1.0, limits.MAX_TILES)),
        _optional(entry, "memory_bytes", int), _optional(entry, "seconds", float),
        int(_number(entry, "block", -1.0, limits.MAX_BLOCKS)),
    )  # fmt: skip


def _texts(entry: dict[str, Any], key: str) -> tuple[str, ...]:
    values = entry[key]
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise _WrongEntryError(key, "not a list of texts")
    return tuple(values)


def _number(entry: dict[str, Any], key: str, least: float, most: float) -> float:
    value = entry[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise _WrongEntryError(key, f"not a number from {least:g} to {most:g}")
    return float(value)


def _optional(entry: dict[str, Any], key: str, kind: Any) -> Any:
    return None if entry[key] is None else kind(_number(entry, key, 0.0, 1e15))


def _check_order(path: Path, parts: Sequence[Part]) -> None:
    """Raise unless names are unique and each part can be done after what it needs."""
    names = {part.name for part in parts}
    if len({name.lower() for name in names}) != len(parts):  # each has a file
        raise ParseError(path, "parts", "two have the same name, but for case.", _AGAIN)
    for number, part in enumerate(parts):
        unknown = sorted(set(part.needs) - names)
        if unknown:
            where = f"parts[{number}].needs"
            raise ParseError(path, where, f"{unknown[0][:40]!r} is no part.", _AGAIN)
    try:
        TopologicalSorter({part.name: part.needs for part in parts}).prepare()
    except CycleError as error:
        circle = ", ".join(sorted(set(error.args[1]))[:3])
        raise ParseError(path, "parts", f"{circle} wait for each other.", _AGAIN) from None
