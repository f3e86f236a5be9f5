# SPDX-License-Identifier: GPL-3.0-or-later
"""Lists of parts that no job writes, and addresses that lead nowhere."""

from __future__ import annotations

from typing import Any

from gaussian_wrapping_addon.core import limits
from tests.hostile.case import Build, Case, Group, Needs, Variant
from tests.hostile.inputs import file, json_file, link, nothing, pipe, steps
from tests.hostile.jobs import begun

_VAST = b" " * (limits.MAX_PARTS_BYTES + 1)
_AGAIN = r"batch\.py parts DIR"
_LOOK = ("run-part", "out", "cameras")


def _parts(name: str, values: Any, says: str) -> Variant:
    build = steps(begun, json_file("out/parts.json", values))
    return Variant(name, build, 1, rf"parts\.json, {says}.*{_AGAIN}", _LOOK)


def _listed(*parts: Any) -> dict[str, Any]:
    return {"version": 1, "code": "x", "plan": "y", "source": "", "parts": list(parts)}


def _part(name: Any, *needs: Any) -> dict[str, Any]:
    return {
        "name": name, "kind": "points", "needs": list(needs), "outputs": [], "share": 0.1,
        "region": "", "tile": -1, "memory_bytes": None, "seconds": None, "block": -1,
    }  # fmt: skip


def _instead(build: Build, name: str, says: str) -> Variant:
    return Variant(name, steps(begun, build), 1, says, _LOOK, needs=Needs.POSIX)


_LISTS = Case(
    73,
    "Lists of the parts of a job",
    (
        Variant(
            "not JSON", steps(begun, file("out/parts.json", "{")), 1,
            r"parts\.json, line 1: not JSON", _LOOK,
        ),
        Variant(
            "vast", steps(begun, file("out/parts.json", _VAST)), 1,
            r"parts\.json, whole file: more than", _LOOK,
        ),
        _parts("a list", [], "version: it is not 1"),
        _parts("no parts", _listed(), "parts: not a list of 1 to 50,000 parts"),
        _parts("an option as a name", _listed(_part("--device")), r"parts\[0\]\.name: not a name"),
        _parts("a path as a name", _listed(_part("../../x")), r"parts\[0\]\.name: not a name"),
        _parts(
            "a name twice", _listed(_part("a"), _part("A")),
            "parts: two have the same name, but for case",
        ),
        _parts("an unknown need", _listed(_part("a", "b")), r"parts\[0\]\.needs: 'b' is no part"),
        _parts(
            "a circle", _listed(_part("a", "b"), _part("b", "a")),
            "parts: a, b wait for each other",
        ),
        _instead(link("out/parts.json", "/dev/zero"), "/dev/zero", r"parts\.json is a link"),
        _instead(pipe("out/parts.json"), "a pipe", r"parts\.json is a named pipe"),
    ),
    (
        "tests/core/jobs/parts/test_graph.py::test_what_does_not_fit_is_refused",
        "tests/core/jobs/parts/test_graph.py::test_damaged_states_count_as_left",
        "tests/core/jobs/parts/test_graph.py::test_odd_entries_do_no_harm",
    ),
)  # fmt: skip


_HERE = "tcp://127.0.0.1:9"
_SIZE = ("--workers", "1", "--cores", "1", "--memory", "1GB", "--time", "1")


def _hosts(name: str, build: Build, says: str) -> Variant:
    return Variant(name, build, 3, f"hosts, {says}", ("farm", "ssh", _HERE, "--hosts", "hosts"))


_COMPUTERS = Case(
    74,
    "Addresses and lists of computers",
    (
        Variant(
            "a scheduler that others can read", nothing, 2, "is not encrypted.*make-certificates",
            ("farm", "doctor", "tcp://10.0.0.7:8786", "--shared", "."),
        ),
        Variant(
            "a scheduler with a path", nothing, 2, "is no address of a Dask scheduler",
            ("farm", "doctor", "tls://farm:8786/../x", "--shared", "."),
        ),
        _hosts("an option as a computer", file("hosts", "-oProxyCommand=touch$IFS\n"), "line 1:"),
        _hosts("a command as a computer", file("hosts", "\na;touch x\n"), "line 2:"),
        _hosts("a vast list of computers", file("hosts", b"#" * (1 << 20) + b"#"), "whole file:"),
        _hosts("computers in bytes", file("hosts", b"\xff\xfe"), "whole file: it is not text"),
        Variant(
            "a pipe as a list of computers", pipe("hosts"), 3,
            "hosts, whole file: it is a named pipe",
            ("farm", "ssh", _HERE, "--hosts", "hosts"), needs=Needs.POSIX,
        ),
        Variant(
            "a directive of two lines", nothing, 2, "A directive has a line break",
            ("farm", "slurm", _HERE, *_SIZE, "--directive=-x\nrm -r x"),
        ),
    ),
    (
        "tests/blender/test_computers.py::test_a_folder_from_elsewhere_is_not_touched",
    ),
)  # fmt: skip

GROUP = Group("Farms", (_LISTS, _COMPUTERS))
