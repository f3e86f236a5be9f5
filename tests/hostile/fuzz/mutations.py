# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes by chance to the bytes, the numbers and the JSON values of a good file."""

from __future__ import annotations

import copy
import json
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

Random = np.random.Generator
Mutation = Callable[[bytes, Random], bytes]

_MOST_CHANGES = 4
_LONGEST_CUT = 64
_NUMBERS = (
    "0", "-1", "-0.0", "1e308", "-1e308", "1e-320", "nan", "inf", "-inf", "NaN", "-nan(ind)",
    "2147483647", "2147483648", "4294967295", "9223372036854775807", "9223372036854775808",
    "18446744073709551616", "1" + "0" * 400, "0x10", "1_000", "1,5", "١", "1e5", "", "true",
)  # fmt: skip
"""Texts in place of a number."""
_WORDS = (
    struct.pack("<Q", 2**64 - 1), struct.pack("<Q", 2**63), struct.pack("<Q", 2**31),
    struct.pack("<i", -1), struct.pack("<I", 2**31), bytes(8), struct.pack("<d", np.nan),
    struct.pack("<d", np.inf), struct.pack("<d", 1e308), struct.pack("<d", -1e308),
    struct.pack("<f", np.nan), struct.pack("<f", 3e38), struct.pack("<d", 5e-324),
)  # fmt: skip
"""Bytes in place of a number."""
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**400, 0.5, 1e308, -1e308, 1e-320,
    float("nan"), float("inf"), "", "a", "x" * 5000, "\x1b[2J\n", "\ud800", "../../etc", "/",
    "a\0b",
    [], {}, [[]], [1, 2, 3], {"a": 1}, [[0.0] * 4] * 4, [None] * 3,
)  # fmt: skip
"""JSON values in place of others."""
_NAMES = ("", "a", "x" * 5000, "\x1b[2J\n", "\ud800", "scale", "version", "0")
"""Keys in place of others."""
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)
_DEEP = 5000


def _times(random: Random) -> range:
    return range(int(random.integers(1, _MOST_CHANGES + 1)))


def flipped(data: bytes, random: Random) -> bytes:
    """Turn some bits, or give some bytes other values."""
    out = bytearray(data)
    for _ in _times(random):
        if out:
            at = int(random.integers(len(out)))
            out[at] = (
                out[at] ^ (1 << int(random.integers(8)))
                if random.random() < 0.5
                else int(random.integers(256))
            )
    return bytes(out)


def cut(data: bytes, random: Random) -> bytes:
    """Cut the end off."""
    return data[: int(random.integers(len(data) + 1))]


def spliced(data: bytes, random: Random) -> bytes:
    """Remove, repeat or insert a piece."""
    if not data:
        return data
    at, begin = (int(random.integers(len(data))) for _ in range(2))
    piece = data[begin : begin + int(random.integers(1, _LONGEST_CUT))]
    kind = int(random.integers(3))
    if kind == 0:
        return data[:at] + data[at + len(piece) :]
    if kind == 1:
        return data[:at] + piece + data[at:]
    return data[:at] + bytes(random.integers(0, 256, len(piece)).astype(np.uint8)) + data[at:]


def renumbered(data: bytes, random: Random) -> bytes:
    """Put extreme numbers, as bytes, at places that are aligned or not."""
    out = bytearray(data)
    for _ in _times(random):
        word = _WORDS[int(random.integers(len(_WORDS)))]
        if len(out) > len(word):
            at = int(random.integers(len(out) - len(word)))
            out[at : at + len(word)] = word
    return bytes(out)


def rewritten(data: bytes, random: Random) -> bytes:
    """Put extreme numbers, as text, in place of numbers of a text file."""
    for _ in _times(random):
        found = list(_NUMBER.finditer(data))
        if not found:
            return data
        number = found[int(random.integers(len(found)))]
        text = _NUMBERS[int(random.integers(len(_NUMBERS)))].encode()
        data = data[: number.start()] + text + data[number.end() :]
    return data


def relined(data: bytes, random: Random) -> bytes:
    """Remove, repeat, swap or empty lines of a text file."""
    lines = data.split(b"\n")
    for _ in _times(random):
        at, other = (int(random.integers(len(lines))) for _ in range(2))
        kind = int(random.integers(4))
        if kind == 0 and len(lines) > 1:
            del lines[at]
        elif kind == 1:
            lines.insert(at, lines[other])
        elif kind == 2:
            lines[at], lines[other] = lines[other], lines[at]
        else:
            lines[at] = b" ".join(lines[at].split()[: int(random.integers(5))])
    return b"\n".join(lines)


def revalued(data: bytes, random: Random) -> bytes:
    """Remove, rename, repeat or replace values of a JSON file, or nest one deeply."""
    values = json.loads(data)
    for _ in _times(random):
        places = list(_places(values))
        if not places:
            break
        holder, key = places[int(random.integers(len(places)))]
        kind = int(random.integers(5))
        if kind == 0:
            del holder[key]
        elif kind == 1 and isinstance(holder, dict):
            holder[_NAMES[int(random.integers(len(_NAMES)))]] = holder.pop(key)
        elif kind == 2 and isinstance(holder, list):
            holder.append(copy.deepcopy(holder[key]))
        else:
            holder[key] = copy.deepcopy(_VALUES[int(random.integers(len(_VALUES)))])
    text = json.dumps(values)
    if random.random() < 0.02:
        text = text.replace(":", ":" + "[" * _DEEP, 1)
    if random.random() < 0.05 and text.startswith("{"):
        text = text[:-1] + ", " + text[1:]  # every key twice
    return text.encode()


def _places(values: Any) -> Any:
    """Yield each container of a JSON value with each of its keys."""
    waiting = [values]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict | list):
            for key in list(one) if isinstance(one, dict) else range(len(one)):
                yield one, key
                waiting.append(one[key])


BYTES: tuple[Mutation, ...] = (flipped, cut, spliced, renumbered)
TEXT: tuple[Mutation, ...] = (flipped, cut, spliced, rewritten, rewritten, relined)
JSON: tuple[Mutation, ...] = (flipped, cut, spliced, rewritten, revalued, revalued, revalued)
