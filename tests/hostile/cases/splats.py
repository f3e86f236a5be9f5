# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussian splats: headers that lie, values that are none, other files under the same name."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from tests.hostile.case import Build, Case, Group, Needs, Variant, Way
from tests.hostile.inputs import file, link, pipe

_EXPECTED = "A 3D Gaussian splat has x, y, z"
_FOREIGN = "tests/core/gaussians/test_files.py"
_WORDS = ("check", "set.ply")
Columns = dict[str, np.ndarray]


@cache
def _columns() -> Columns:
    """Return the columns of 200 Gaussians on a sphere."""
    random = np.random.default_rng(4)
    points = random.normal(size=(200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    columns = {axis: points[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"f_dc_{i}": random.uniform(-1, 1, 200) for i in range(3)}
    columns["opacity"] = np.full(200, 3.0)
    columns |= {f"scale_{i}": np.full(200, -2.5) for i in range(3)}
    columns |= {f"rot_{i}": np.full(200, float(i == 0)) for i in range(4)}
    return columns


def splat(
    change: Callable[[Columns], None] = lambda columns: None,
    *,
    format: str = "binary_little_endian",
    edit: Callable[[bytes], bytes] = lambda data: data,
) -> Build:
    """Return the build of a splat whose columns are changed, then its bytes."""

    def build(folder: Path) -> None:
        columns = {name: column.copy() for name, column in _columns().items()}
        change(columns)
        table = np.stack(list(columns.values()), axis=1)
        head = f"ply\nformat {format} 1.0\ncomment a splat\nelement vertex {len(table)}\n"
        head += "".join(f"property float {name}\n" for name in columns) + "end_header\n"
        if format == "ascii":
            body = "".join(" ".join(map(repr, row)) + "\n" for row in table.tolist()).encode()
        else:
            body = table.astype("<f4" if "little" in format else ">f4").tobytes()
        (folder / "set.ply").write_bytes(edit(head.encode() + body))

    return build


def _replaced(old: str, new: str) -> Build:
    return splat(edit=lambda data: data.replace(old.encode(), new.encode(), 1))


def _bad(name: str, build: Build, says: str, code: int = 3) -> Variant:
    return Variant(name, build, code, says, _WORDS)


_FACT = "200 Gaussians with harmonics of degree 0"


def _without(*names: str) -> Build:
    return splat(lambda columns: [columns.pop(name) for name in names] and None)


def _with(**more: float) -> Build:
    return splat(lambda columns: columns.update({n: np.full(200, v) for n, v in more.items()}))


_HEADERS = Case(
    31,
    "Splat PLY: encodings, headers, counts",
    (
        _bad("ASCII", splat(format="ascii"), _FACT, 0),
        _bad("big endian", splat(format="binary_big_endian"), _FACT, 0),
        _bad(
            "CR and LF in the header",
            splat(edit=lambda data: data.replace(b"\n", b"\r\n", data.index(b"end_header") and 17)),
            _FACT,
            0,
        ),
        _bad(
            "header without end",
            _replaced("end_header", "no_end"),
            rf"set\.ply, header: does not end within 65536 bytes.*{_EXPECTED}",
        ),
        _bad(
            "a comment of 10 MB",
            _replaced("a splat", "x" * 10_000_000),
            rf"set\.ply, header: does not end within 65536 bytes.*{_EXPECTED}",
        ),
        _bad(
            "count 2³¹ − 1",
            _replaced("vertex 200", f"vertex {2**31 - 1}"),
            r"set\.ply, header: 2147483647 vertices; at most 20000000 are read.*Export or download",
        ),
        _bad(
            "count 10¹⁸",
            _replaced("vertex 200", f"vertex {10**18}"),
            rf"set\.ply, line 4: an element without a count.*{_EXPECTED}",
        ),
        _bad(
            "negative count",
            _replaced("vertex 200", "vertex -5"),
            rf"set\.ply, line 4: an element without a count.*{_EXPECTED}",
        ),
        _bad(
            "count 0",
            splat(
                lambda columns: [columns.update({n: c[:0]}) for n, c in columns.items()] and None
            ),
            r"set\.ply holds no Gaussians.*Export the splat again",
        ),
        _bad(
            "a list among the properties",
            _replaced("property float opacity", "property list uchar int opacity"),
            r"set\.ply, header: vertices with a list property.*Export or download",
        ),
        _bad(
            "a property twice",
            _replaced("property float y", "property float x"),
            rf"set\.ply, line 6: property x comes twice.*{_EXPECTED}",
        ),
        _bad(
            "no f_dc_0",
            _without("f_dc_0"),
            rf"set\.ply, header: not a splat but a point cloud: property f_dc_0.*{_EXPECTED}",
        ),
        _bad(
            "f_rest of no degree",
            _with(f_rest_0=0.0, f_rest_1=0.0),
            r"set\.ply, header: 2 f_rest properties fit no degree.*Export the splat again",
        ),
        _bad("more properties", _with(segment=1.0, confidence=0.5), _FACT, 0),
        _bad(
            "body cut",
            splat(edit=lambda data: data[:-40]),
            r"set\.ply, byte \d+: cut off: the header declares \d+ bytes.*Export or download",
        ),
        _bad("an unknown line", _replaced("comment a", "remark a"), rf"line 3: .*{_EXPECTED}"),
        _bad(
            "an unknown type", _replaced("float y", "half y"), rf"set\.ply, line 6: .*{_EXPECTED}"
        ),
        _bad("no format", _replaced("format bin", "comment bin"), rf"the format line.*{_EXPECTED}"),
        _bad("0 bytes", file("set.ply"), rf"set\.ply, byte 0: not a PLY file.*{_EXPECTED}"),
    ),
    (f"{_FOREIGN}::test_foreign_files_cut_anywhere_are_refused",),
)


def _rows(**values: float) -> Build:
    """Give some of the first Gaussians impossible values."""

    def change(columns: Columns) -> None:
        for row, (name, value) in enumerate(values.items()):
            columns[name][row] = value

    return splat(change)


def _zero_quaternion(columns: Columns) -> None:
    for number in range(4):
        columns[f"rot_{number}"][0] = 0.0


def _vast_text(data: bytes) -> bytes:
    """Write 1e300 as the first number, and an empty line behind the first Gaussian."""
    head, body = data.split(b"end_header\n")
    lines = body.split(b"\n")
    lines[0] = b"1e300 " + lines[0].split(b" ", 1)[1]
    return head + b"end_header\n" + b"\n".join([lines[0], b"", *lines[1:]])


def _start(name: str, build: Build, says: str, code: int = 0) -> Variant:
    return Variant(name, build, code, says, ("wrap", "set.ply"), way=Way.LOADING, writes=("out",))


_DROPPED = "of 200 Gaussians .*"
_VALUES = Case(
    32,
    "Splat PLY: values",
    (
        _start("position NaN", _rows(x=np.nan), f"1 {_DROPPED}"),
        _start("position Inf", _rows(x=np.inf), f"1 {_DROPPED}"),
        _start("1e300 in text", splat(format="ascii", edit=_vast_text), f"1 {_DROPPED}"),
        _start("quaternion 0", splat(_zero_quaternion), f"1 {_DROPPED}"),
        _start("log-scale 80", _rows(scale_1=80.0), f"1 {_DROPPED}"),
        _start("opacity ±Inf", _rows(opacity=np.inf, f_dc_0=-np.inf), f"2 {_DROPPED}"),
        _start(
            "all of them NaN",
            splat(lambda columns: columns.update(x=np.full(200, np.nan))),
            r"set\.ply, body: none of the 200 Gaussians has valid values.*Export the splat again",
            3,
        ),
        _start(
            "all of them transparent",
            splat(lambda columns: columns.update(opacity=np.full(200, -50.0))),
            "All Gaussians of the splat are transparent.*Check that opacities are stored as logits",
            3,
        ),
    ),
    (f"{_FOREIGN}::test_senseless_foreign_gaussians_are_dropped_and_counted",),
)

_TRIANGLE = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
_CHUNKS = (
    "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n"
    "element vertex 1\nproperty uint packed_position\nend_header\n"
)
_UNPACK = "export it as an uncompressed PLY"


def _other(suffix: str, name: str) -> Variant:
    return Variant(
        suffix,
        file(f"set.{suffix}", b"NGSP"),
        3,
        rf"set\.{suffix} is a splat in {name} format, which is not supported.*{_UNPACK}",
        ("check", f"set.{suffix}"),
    )


_OTHER = Case(
    33,
    "Other files given as a splat",
    (
        _bad(
            "a mesh", file("set.ply", _TRIANGLE), rf"header: not a splat but a mesh: .*{_EXPECTED}"
        ),
        _bad(
            "a point cloud",
            file("set.ply", _TRIANGLE.replace("face 1", "more 0").replace("vertex_indices", "i")),
            rf"header: not a splat but a point cloud: .*{_EXPECTED}",
        ),
        _bad(
            "a compressed PLY",
            file("set.ply", _CHUNKS.encode() + bytes(8)),
            rf"a compressed splat PLY is not supported.*{_UNPACK}",
        ),
        _other("spz", "SPZ"),
        _other("sog", "SOG"),
        _other("ksplat", "KSPLAT"),
        _other("splat", r"antimatter15 \.splat"),
        Variant(
            "a splat given as a true surface",
            splat(),
            3,
            r"set\.ply, .*(face|cloud|none).*Export",
            ("evaluate", "set.ply", "--truth", "set.ply"),
        ),
        Variant(
            "a named pipe as the start",
            pipe("set.ply"),
            3,
            r"The start splat set\.ply does not exist\. Check the path",
            ("wrap", "/dev", "--set", "start_splat=set.ply", "--out", "out", "--no-blend"),
            needs=Needs.POSIX,
        ),
        Variant(
            "/dev/zero as the input",
            link("set.ply", "/dev/zero"),
            3,
            "zero is neither a file nor a folder.*Give a folder of photos",
            _WORDS,
            needs=Needs.POSIX,
        ),
    ),
    ("tests/core/jobs/store/test_hostile_folders.py::test_devices_and_pipes_are_no_splats",),
)

_FAR = Case(
    67,
    "A splat whose first Gaussian lies at 1e30",
    (
        _start("the first at 1e30", _rows(x=1e30), r"200 Gaussians reach 1\.\d+ from their middle"),
        _start("the first at −3e38", _rows(x=-3e38), r"200 Gaussians reach 1\.\d+ from"),
    ),
    (
        (
            "tests/core/loading/test_splat_cameras.py::"
            "test_one_gaussian_as_far_away_as_numbers_go_changes_nothing"
        ),
    ),
)

GROUP = Group("Splats", (_HEADERS, _VALUES, _OTHER, _FAR))
