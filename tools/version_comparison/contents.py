# SPDX-License-Identifier: GPL-3.0-or-later
"""What a file of a result holds, as named items that are equal bit for bit or are not.

Everything that is not compared stands in :data:`LEFT_OUT_FILES`, :data:`LEFT_OUT_CONTENTS` and
:data:`LEFT_OUT_ENTRIES`.
"""

from __future__ import annotations

import fnmatch
import hashlib
import io
import json
import re
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


@dataclass(frozen=True)
class LeftOut:
    """Something that is not compared, and why."""

    pattern: str
    reason: str
    file: str = "*"
    """Pattern of the names of files that it is about."""


LEFT_OUT_FILES = (
    LeftOut("said-*.log", "what a command printed: wording, and times"),
    LeftOut("*/lock.json", "process number; it is there while a worker runs"),
    LeftOut("*/spent.json", "time"),
    LeftOut("*/live-*", "pictures taken at moments of the clock"),
)
"""Patterns of paths below the folder of a case. Of the checkpoints of a stage only the newest is
compared: the one before it, if there is one, is of a moment of the clock."""

LEFT_OUT_CONTENTS = (
    LeftOut("*/log.txt", "wording, and times"),
    LeftOut("*/worker-output.txt", "wording"),
    LeftOut("*/report.md", "wording; its figures are in report.json"),
    LeftOut("*.blend", "Blender writes memory addresses"),
)
"""The same of files that have to be there, whatever they hold."""

LEFT_OUT_ENTRIES = (
    LeftOut(r"(^|\.)(processor_)?seconds(_low|_high|_training|_left)?$", "time"),
    LeftOut(r"(^|\.)seconds\.\w+$", "time"),
    LeftOut(r"(^|\.)(bake_s|wall_seconds|heartbeat_s)$", "time"),
    LeftOut(r"(^|\.)(started|finished)_unix_s$", "date"),
    LeftOut(r"(^|\.)peak_memory_bytes(\.\w+)?$", "memory that was used"),
    LeftOut(r"^(begun_s|token|plan|code)$", "names and times of one run of a part", "*.json"),
    LeftOut(r"(^|\.)(free_memory|photos\.budget)_bytes$", "memory that was free"),
    LeftOut(r"(^|\.)settings(\.training)?\.polish$", "a setting that is gone"),
    LeftOut(r"(^|\.)pid(_started)?$", "process number"),
    LeftOut(r"^machine\.", "the machine"),
    LeftOut(r"^made_with\.code$", "fingerprint of the source code"),
    LeftOut(r"(^|\.)estimate\.speed$", "speed of the machine"),
    LeftOut(r"(^|\.)(evidence|note|lpips_note|unwrap_fallback_reason|device_reason)$", "wording"),
    LeftOut(
        r"(^|\.)(warnings|notes)\[\d+\](\.(stage|code|text|hint|next_step))?$",
        "wording; texts in 0.1.0, codes with text and hint since",
    ),
    LeftOut(r"\.measured$", "new after 0.1.0: whether a decision rests on a measurement"),
    LeftOut(r"^(phase|put_back)$", "new after 0.1.0", "status.json"),
    LeftOut(r"gwrap_stamp$", "dates of files", "*.usdc"),
    LeftOut(r"gwrap_figures$", "times; the figures are those of report.json", "*.usdc"),
    LeftOut(r"^(message|hint|error)$", "wording", "status.json"),
    LeftOut(r"^(fraction|figures\.\w+)$", "what was seen at a moment of the clock", "status.json"),
)
"""Regular expressions of entries of JSON files, such as ``training.held_out[0].psnr``."""

GONE_DECISIONS = ("harmonics", "wrapping")
"""Settled by their settings now, without a record."""


@dataclass(frozen=True)
class Item:
    """One thing that is compared: an array, an image, an entry of a JSON file, bytes."""

    kind: str
    digest: str
    """Equal where the items are; of short values, the value itself."""
    array: np.ndarray | None = None
    """Of arrays and images, to tell how far they are apart."""

    def distance(self, other: Item) -> str:
        """Say how two items differ."""
        a, b = self.array, other.array
        if a is None or b is None:
            return f"{self.digest[:40]} | {other.digest[:40]}"
        if a.shape != b.shape or a.dtype != b.dtype:
            return f"{a.dtype}{list(a.shape)} | {b.dtype}{list(b.shape)}"
        if a.dtype.kind not in "fiub":
            return "other values"
        apart = np.abs(a.astype(np.float64) - b.astype(np.float64))
        return f"{np.count_nonzero(apart)} of {a.size} values, by up to {np.nanmax(apart):.3g}"


@dataclass(frozen=True)
class Contents:
    """Items by name (``file`` or ``file : entry``), and how many were left out."""

    items: dict[str, Item]
    left_out: int


def read_contents(root: Path, also_left_out: tuple[LeftOut, ...] = ()) -> Contents:
    """Read everything below a folder.

    Parameters
    ----------
    also_left_out : tuple of LeftOut
        Entries of JSON files, besides :data:`LEFT_OUT_ENTRIES`.
    """
    rules = (*LEFT_OUT_ENTRIES, *also_left_out)
    items: dict[str, Item] = {}
    left_out = 0
    older = {
        path
        for folder in {p.parent for p in root.rglob("checkpoint-*")}
        for suffix in ("json", "npz")
        for path in sorted(folder.glob(f"checkpoint-*.{suffix}"))[:-1]
    }
    usd = _usd_items(sorted(root.rglob("*.usdc")))
    for path in sorted(p for p in root.rglob("*") if p.is_file()):
        name = path.relative_to(root).as_posix()
        if path in older or _matches(name, LEFT_OUT_FILES):
            left_out += 1
            continue
        items[name] = Item("file", "is there")
        if _matches(name, LEFT_OUT_CONTENTS):
            left_out += 1
            continue
        for entry, item in usd.get(path) or _items_of(path):
            if item.kind in ("json", "usd") and _is_left_out(path.name, entry, rules):
                left_out += 1
            else:
                items[f"{name} : {entry}" if entry else f"{name} : content"] = item
    return Contents(items, left_out)


def differences(old: Contents, new: Contents) -> list[tuple[str, str]]:
    """Return name and kind of difference of every item that is not the same in both."""
    found = []
    for name in sorted(set(old.items) | set(new.items)):
        a, b = old.items.get(name), new.items.get(name)
        if a is None or b is None:
            found.append((name, "only in the new version" if a is None else "missing"))
        elif (a.kind, a.digest) != (b.kind, b.digest):
            found.append((name, a.distance(b)))
    return found


def _matches(name: str, rules: tuple[LeftOut, ...]) -> bool:
    return any(fnmatch.fnmatch(name, rule.pattern) for rule in rules)


def _is_left_out(file: str, entry: str, rules: tuple[LeftOut, ...]) -> bool:
    return any(
        fnmatch.fnmatch(file, rule.file) and re.search(rule.pattern, entry) for rule in rules
    )


def _items_of(path: Path) -> Iterator[tuple[str, Item]]:
    data = path.read_bytes()
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            for name in arrays.files:
                values = _json_in(arrays[name])
                if values is None:
                    yield name, _array(arrays[name], "array")
                else:
                    yield from ((e, Item("json", text)) for e, text in _entries(values, name))
    elif suffix in (".png", ".jpg", ".jpeg"):
        with Image.open(io.BytesIO(data)) as image:
            yield f"pixels ({image.mode})", _array(np.asarray(image), "image")
    elif suffix == ".json":
        yield from ((entry, Item("json", text)) for entry, text in _entries(json.loads(data), ""))
    elif suffix == ".glb":
        yield from _glb_items(data)
    elif suffix in (".obj", ".mtl"):
        lines = [line for line in data.splitlines() if not line.startswith(b"#")]
        yield "without comments", _bytes(b"\n".join(lines))
    elif suffix == ".svg":
        drawn = re.sub(rb"<(text|title|desc)\b.*?</\1>", b"", data, flags=re.DOTALL)
        yield "without texts", _bytes(drawn)
    else:
        yield "", _bytes(data)


def _usd_items(paths: list[Path]) -> dict[Path, list[tuple[str, Item]]]:
    """Return the attributes of USD files, read in another process."""
    if not paths:
        return {}
    helper = Path(__file__).with_name("read_usd.py")
    command = [sys.executable, str(helper), *map(str, paths)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    lines = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    return {
        path: [(entry, Item("usd", text)) for entry, text in values.items()]
        for path, values in zip(paths, lines, strict=True)
    }


def _json_in(array: np.ndarray) -> dict[str, Any] | None:
    """Return the JSON object that an array of bytes or a text holds, ``None`` of other arrays."""
    if array.dtype == np.uint8 and array.ndim == 1:
        text = array.tobytes().decode(errors="replace")
    elif array.dtype.kind == "U" and array.ndim == 0:
        text = str(array)
    else:
        return None
    if not text.startswith("{"):
        return None
    try:
        values = json.loads(text)
    except ValueError:
        return None
    return values if isinstance(values, dict) else None


def _array(array: np.ndarray, kind: str) -> Item:
    state = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    state.update(np.ascontiguousarray(array).tobytes())
    return Item(kind, state.hexdigest(), array)


def _bytes(data: bytes) -> Item:
    return Item("bytes", hashlib.sha256(data).hexdigest())


def _entries(value: Any, place: str) -> Iterator[tuple[str, str]]:
    """Yield every leaf of a JSON value with its place; lists and objects give their length."""
    if isinstance(value, dict):
        for key in sorted(value):
            yield from _entries(value[key], f"{place}.{key}" if place else key)
    elif isinstance(value, list):
        value = [one for one in value if not _is_gone(one)]
        yield f"{place}.length", str(len(value))
        for index, one in enumerate(value):
            yield from _entries(one, f"{place}[{index}]")
    else:
        yield place, json.dumps(value)  # floats as repr: as exact as they are


def _is_gone(value: Any) -> bool:
    """Return whether a value is the record of a decision that only the earlier version takes."""
    return isinstance(value, dict) and value.get("name") in GONE_DECISIONS and "chosen" in value


def _glb_items(data: bytes) -> Iterator[tuple[str, Item]]:
    """Yield the entries of a GLB's JSON, without the generator's name, and its binary chunk."""
    at = 12
    while at < len(data):
        length, kind = struct.unpack_from("<II", data, at)
        chunk = data[at + 8 : at + 8 + length]
        at += 8 + length
        if kind == 0x4E4F534A:
            values = json.loads(chunk)
            values.get("asset", {}).pop("generator", None)
            yield from ((f"gltf.{e}", Item("json", text)) for e, text in _entries(values, ""))
        else:
            yield f"chunk {kind:08x}", _bytes(chunk)
