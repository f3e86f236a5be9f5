# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiny ONNX files, written byte by byte: the format is protobuf, a few numbered fields."""

from __future__ import annotations

import struct
from pathlib import Path

FLOAT, DOUBLE = 1, 11
"""Element types of ONNX."""
Shape = tuple[int | str, ...]


def _varint(value: int) -> bytes:
    out = bytearray()
    value &= (1 << 64) - 1
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _field(number: int, value: int | str | bytes | float) -> bytes:
    if isinstance(value, float):
        return _varint(number << 3 | 5) + struct.pack("<f", value)
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _attribute(name: str, value: int | float | list[int]) -> bytes:
    if isinstance(value, list):
        return _field(1, name) + b"".join(_field(8, v) for v in value) + _field(20, 7)
    if isinstance(value, float):
        return _field(1, name) + _field(2, value) + _field(20, 1)
    return _field(1, name) + _field(3, value) + _field(20, 2)


def node(op: str, inputs: list[str], output: str, **attributes: int | float | list[int]) -> bytes:
    """Return a node of the graph."""
    parts = [_field(1, name) for name in inputs] + [_field(2, output), _field(4, op)]
    return b"".join(parts + [_field(5, _attribute(k, v)) for k, v in attributes.items()])


def _value(name: str, shape: Shape, kind: int) -> bytes:
    dims = b"".join(_field(1, _field(1, d) if isinstance(d, int) else _field(2, d)) for d in shape)
    tensor = _field(1, kind) + _field(2, dims)
    return _field(1, name) + _field(2, _field(1, tensor))


def model_bytes(
    nodes: list[bytes],
    takes: Shape,
    gives: Shape,
    *,
    kind: int = FLOAT,
    more_inputs: tuple[str, ...] = (),
) -> bytes:
    """Return a model with the input ``x`` and the output ``y``."""
    graph = b"".join(_field(1, one) for one in nodes) + _field(2, "graph")
    graph += _field(11, _value("x", takes, kind))
    graph += b"".join(_field(11, _value(name, takes, kind)) for name in more_inputs)
    graph += _field(12, _value("y", gives, kind))
    opset = _field(1, "") + _field(2, 13)
    return _field(1, 8) + _field(8, opset) + _field(7, graph)


def brightness(size: int | str = 32, *, logits: bool = False) -> bytes:
    """Return a model whose shares are the mean of the channels; or logits with 0 at one half."""
    mean = node("ReduceMean", ["x"], "mean" if logits else "y", axes=[1], keepdims=1)
    nodes = [mean]
    if logits:
        nodes += [
            node("Constant", [], "half", value_float=0.5),
            node("Sub", ["mean", "half"], "less"),
            node("Constant", [], "gain", value_float=40.0),
            node("Mul", ["less", "gain"], "y"),
        ]
    return model_bytes(nodes, (1, 3, size, size), (1, 1, size, size))


def not_a_number() -> bytes:
    """Return a model that gives roots of negative numbers."""
    nodes = [
        node("ReduceMean", ["x"], "mean", axes=[1], keepdims=1),
        node("Constant", [], "two", value_float=2.0),
        node("Sub", ["mean", "two"], "less"),
        node("Sqrt", ["less"], "y"),
    ]
    return model_bytes(nodes, (1, 3, 16, 16), (1, 1, 16, 16))


def same_shape(takes: Shape, *, kind: int = FLOAT) -> bytes:
    """Return a model that gives what it takes."""
    return model_bytes([node("Identity", ["x"], "y")], takes, takes, kind=kind)


def two_inputs() -> bytes:
    """Return a model that wants another image besides the photo."""
    add = node("Add", ["x", "z"], "y")
    return model_bytes([add], (1, 3, 16, 16), (1, 3, 16, 16), more_inputs=("z",))


def written(path: Path, data: bytes) -> Path:
    """Write a model and return its path."""
    path.write_bytes(data)
    return path
