# SPDX-License-Identifier: GPL-3.0-or-later
"""Lists of parts and records of farms that no job writes, and addresses that lead nowhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job, write_job
from gaussian_wrapping_addon.core.settings import with_values
from tests.hostile.case import Build, Case, Group, Needs, Variant
from tests.hostile.inputs import file, json_file, link, nothing, pipe, steps
from tests.hostile.jobs import JOB, begun

_CORE = "tests/core/farm"
_FLAMENCO = f"{_CORE}/flamenco"
_NOWHERE = "http://127.0.0.1:9"
_VAST = b" " * (limits.MAX_PARTS_BYTES + 1)
_AGAIN = r"batch\.py parts DIR"


def _submit(address: str = _NOWHERE, *more: str) -> tuple[str, ...]:
    return ("farm", "submit", "out", "--flamenco", address, *more)


def _parts(name: str, values: Any, says: str) -> Variant:
    build = steps(begun, json_file("out/parts.json", values))
    return Variant(name, build, 3, rf"parts\.json, {says}.*{_AGAIN}", _submit())


def _listed(*parts: Any) -> dict[str, Any]:
    return {"version": 1, "code": "x", "plan": "y", "source": "", "parts": list(parts)}


def _part(name: Any, *needs: Any) -> dict[str, Any]:
    return {
        "name": name, "kind": "points", "needs": list(needs), "outputs": [], "share": 0.1,
        "region": "", "tile": -1, "memory_bytes": None, "seconds": None, "block": -1,
    }  # fmt: skip


def _instead(build: Build, name: str, says: str) -> Variant:
    return Variant(name, steps(begun, build), 3, says, _submit(), needs=Needs.POSIX)


_LISTS = Case(
    73,
    "Lists of the parts of a job",
    (
        Variant(
            "not JSON", steps(begun, file("out/parts.json", "{")), 3,
            r"parts\.json, line 1: not JSON", _submit(),
        ),
        Variant(
            "vast", steps(begun, file("out/parts.json", _VAST)), 3,
            r"parts\.json, whole file: more than", _submit(),
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
        f"{_CORE}/test_part_states.py::test_damaged_states_count_as_left",
        f"{_CORE}/test_part_states.py::test_odd_entries_do_no_harm",
        f"{_FLAMENCO}/test_job_type.py::test_damage_is_refused_with_words",
    ),
)  # fmt: skip


def _in_one_piece(folder: Path) -> None:
    """Make a job whose region is meshed in one piece."""
    begun(folder)
    path = folder / JOB / "job.json"
    job = read_job(path)
    write_job(path, replace(job, settings=with_values(job.settings, {"meshing.tiles": "off"})))


_WHOLE = _in_one_piece


def _address(name: str, address: str, says: str, code: int = 2) -> Variant:
    return Variant(name, _WHOLE, code, says, _submit(address))


def _record(name: str, text: str) -> Variant:
    build = steps(begun, file("out/flamenco.json", text))
    says = r"flamenco\.json, .*Delete it, then submit again|flamenco\.json, line 1: not JSON"
    return Variant(name, build, 3, says, ("farm", "status", "out"))


_HERE = "tcp://127.0.0.1:9"
_SIZE = ("--workers", "1", "--cores", "1", "--memory", "1GB", "--time", "1")


def _hosts(name: str, build: Build, says: str) -> Variant:
    return Variant(name, build, 3, f"hosts, {says}", ("farm", "ssh", _HERE, "--hosts", "hosts"))


_MANAGERS = Case(
    74,
    "Addresses and records of farms",
    (
        _address("no scheme", "localhost:8080", "is not an address of http or https.*such as http://"),
        _address("a file", "file:///etc/passwd", "is not an address of http or https"),
        _address("a line break", "http://x\r\nY: z", "is not an address"),
        _address("a password", "http://me:secret@x", "a Manager asks for none"),
        _address("a page of it", "http://x:8080/app/jobs", "Give http://x:8080 alone"),
        _address("nobody there", _NOWHERE, f"Nothing answers at {_NOWHERE}.*running there", 1),
        Variant(
            "a priority of 101", _WHOLE, 2, "priority 101 is out of range.*from 0 to 100",
            _submit(_NOWHERE, "--priority", "101"),
        ),
        Variant("a folder that is no job", nothing, 2, "out holds no job", _submit()),
        Variant(
            "a job that was not submitted", begun, 2,
            "out was not submitted to Flamenco.*farm submit", ("farm", "cancel", "out"),
        ),
        _record("a record of a file", '{"version": 1, "address": "file:///x", "job": "1"}'),
        _record("a record with a path", '{"version": 1, "address": "http://x", "job": "../x"}'),
        _record("a record that is cut", '{"version"'),
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
        f"{_FLAMENCO}/test_exchange.py::*",
        f"{_FLAMENCO}/test_manager.py::test_ids_of_others_are_not_put_into_paths",
        "tests/blender/test_computers.py::test_a_folder_from_elsewhere_is_not_touched",
    ),
)  # fmt: skip

GROUP = Group("Farms", (_LISTS, _MANAGERS))
