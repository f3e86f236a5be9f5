# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory of machines and containers, from the system's files."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import machine

GIB = 2**30
NO_LIMIT = "9223372036854771712\n"


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine of 64 GiB, 40 of them available, with no control groups."""
    write(tmp_path / "proc" / "meminfo", f"MemTotal: 1 kB\nMemAvailable: {40 * 2**20} kB\n")
    monkeypatch.setattr(machine, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(machine, "_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(machine, "_installed_bytes", lambda: 64 * GIB)
    return tmp_path


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def group(folder: Path, names: tuple[str, str, str], values: tuple[str, int, int]) -> None:
    """Write the limit, the use, and how much of it can be dropped, in GiB."""
    write(folder / names[0], values[0])
    write(folder / names[1], f"{values[1] * GIB}\n")
    write(folder / "memory.stat", f"cache 1\n{names[2]} {values[2] * GIB}\n")


V1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
V2 = ("memory.max", "memory.current", "inactive_file")


def test_without_a_container_the_machine_counts(system: Path) -> None:
    assert machine.total_memory_bytes() == 64 * GIB
    assert machine.available_memory_bytes() == 40 * GIB
    write(system / "proc" / "self" / "cgroup", "9:cpu:/\n4:memory:/a/b\n0::/\n")
    group(system / "groups" / "memory" / "a", V1, (NO_LIMIT, 30, 0))
    group(system / "groups", V2, ("max\n", 30, 0))
    assert machine.total_memory_bytes() == 64 * GIB
    assert machine.available_memory_bytes() == 40 * GIB


@pytest.mark.parametrize(
    ("line", "place", "names"),
    [
        ("0::/", "", V2),  # a namespace of its own
        ("0::/user.slice/job", "user.slice/job", V2),
        ("0::/user.slice/job", "user.slice", V2),  # the limit stands above
        ("0::/../outer", "outer", V2),
        ("4:memory:/docker/0123", "memory", V1),  # the path is that outside of the container
        ("4:cpu,memory:/docker/0123", "memory/docker/0123", V1),
    ],
)
def test_a_container_counts(
    line: str, place: str, names: tuple[str, str, str], system: Path
) -> None:
    write(system / "proc" / "self" / "cgroup", f"9:pids:/x\n{line}\n")
    group(system / "groups" / place, names, (f"{8 * GIB}\n", 5, 2))
    assert machine.total_memory_bytes() == 8 * GIB
    assert machine.available_memory_bytes() == (8 - (5 - 2)) * GIB
    group(system / "groups" / place, names, (f"{8 * GIB}\n", 9, 0))
    assert machine.available_memory_bytes() == 0
    group(system / "groups" / place, names, (f"{100 * GIB}\n", 5, 0))
    assert machine.total_memory_bytes() == 64 * GIB
    assert machine.available_memory_bytes() == 40 * GIB


def test_the_smallest_limit_holds(system: Path) -> None:
    write(system / "proc" / "self" / "cgroup", "0::/a/b\n")
    group(system / "groups" / "a", V2, (f"{6 * GIB}\n", 1, 0))
    group(system / "groups" / "a" / "b", V2, (f"{8 * GIB}\n", 7, 0))
    assert machine.total_memory_bytes() == 6 * GIB
    assert machine.available_memory_bytes() == GIB


def test_other_systems_have_no_such_files(system: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (system / "proc" / "meminfo").unlink()
    assert machine.available_memory_bytes() == 64 * GIB
    monkeypatch.setattr(machine, "_installed_bytes", lambda: 0)
    assert machine.available_memory_bytes() == machine.total_memory_bytes() == 0
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert machine.processor_count() == os.cpu_count()


def test_this_machine_is_described() -> None:
    found = machine.describe_machine(3)
    assert found["threads"] == 3
    assert 1 <= machine.processor_count() <= found["cores"]
    assert found["packages"]["numpy"][0].isdigit()
    assert set(found["packages"]) == set(machine.PACKAGES)
    assert 0 < machine.available_memory_bytes() <= machine.total_memory_bytes()
    assert found["processor"]


@pytest.mark.parametrize(
    ("installed", "limit"),
    [
        (64 * GIB, int(0.9 * 64 * GIB)),
        (4 * GIB, 8 * GIB),  # threads of a helper reserve more than they use
        (0, None),
    ],
)
def test_helpers_get_a_share_of_the_memory(
    installed: int, limit: int | None, system: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine, "_installed_bytes", lambda: installed)
    assert machine.helper_memory_limit_bytes() == limit
