# SPDX-License-Identifier: GPL-3.0-or-later
"""Optional packages of the worker: installed, added, kept, and errors of missing ones."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import (
    EXIT_BAD_DATA,
    EXIT_DONE,
    EXIT_USAGE,
    MissingExtraError,
    UsageError,
)
from gaussian_wrapping_addon.core.jobs import install
from gaussian_wrapping_addon.core.jobs.install import FoundPython, SetupRequest, SetupTask
from gaussian_wrapping_addon.core.worker import environment
from gaussian_wrapping_addon.core.worker.environment import (
    EXTRAS,
    Extra,
    Requirement,
    read_requirements,
    requirements_file,
)
from tests.core.setup.wheels import write_wheel

PYTHON = FoundPython("/usr/bin/python3.12", (3, 12, 1))
PLAY = Extra("play", (Requirement("gw-delta", "==2.1"),), "gw_delta", "Play", "played files")


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch) -> Extra:
    """An extra of a tiny wheel in the table."""
    monkeypatch.setattr(environment, "EXTRAS", (*EXTRAS, PLAY))
    return PLAY


def finish(request: SetupRequest, *, cancelled: bool = False) -> SetupTask:
    task = SetupTask(request)
    if cancelled:
        task.cancel()
    task.start()
    task.join(100)
    return task


def test_the_table_is_sound() -> None:
    ours = {r.name for r in read_requirements(requirements_file())}
    assert len({extra.name for extra in EXTRAS}) == len(EXTRAS)
    for extra in EXTRAS:
        assert re.fullmatch(r"[a-z]+", extra.name)
        assert all(p.versions.startswith("==") and p.name not in ours for p in extra.packages)
        path = environment.extra_hashes_file(requirements_file(), extra)
        assert path is not None, "run python -m tools.worker_hashes --extras"
        entries = re.split(r"\n(?=\w)", path.read_text().partition("\n\n")[0])
        listed = [e.split(" ")[0] for e in entries if not e.startswith("#")]
        assert listed == [f"{p.name}=={p.versions[2:]}" for p in extra.packages]
        assert all("--hash=sha256:" in e for e in entries if not e.startswith("#"))
        assert path.read_text().count("--hash=sha256:") > 3  # of binary packages, one a system


def test_the_tests_have_the_extras_of_the_table() -> None:
    wanted = read_requirements(requirements_file().with_name("requirements-dev.txt"))
    pinned = {r.name: r.versions for r in wanted}
    for extra in EXTRAS:
        assert {p.name: pinned.get(p.name) for p in extra.packages} == {
            p.name: p.versions for p in extra.packages
        }


def test_names_are_read_in_the_order_of_the_table() -> None:
    for text, names in (("", ()), ("raw, heif", ("heif", "raw")), ("raw,raw,", ("raw",))):
        assert environment.read_extra_names(text) == names
    with pytest.raises(UsageError, match=r"no extra jpeg\. Give .*heif, raw"):
        environment.read_extra_names("heif,jpeg")


def test_extras_are_installed_by_their_hashes() -> None:
    ours = requirements_file()
    request = SetupRequest("/w", "/p", str(ours), "cpu", extras=("heif", "raw"))
    found = install.all_commands(request, PYTHON)
    assert len(install.all_commands(replace(request, extras=()), PYTHON)) == len(found) - 2
    for command, name in zip(found[-3:-1], ("heif", "raw"), strict=True):
        hashes = str(ours.with_name(f"requirements-worker-{name}-hashes.txt"))
        assert command[-4:] == ("--no-deps", "--require-hashes", "-r", hashes)
        assert {"--only-binary", ":all:"} <= set(command)
    assert found[-1][-1] == "check"
    wheels = install.all_commands(replace(request, find_links="/wheels"), PYTHON)
    assert wheels[-2][-6:] == (
        ":all:", "--no-index", "--find-links", "/wheels", "--no-deps", "rawpy==0.28.0",
    )  # fmt: skip


def test_an_extra_is_added_to_what_is_there(quick: SetupRequest, play: Extra) -> None:
    wheels = Path(quick.find_links)
    write_wheel(wheels, "gw_delta", "2.1", "gwnothing")
    write_wheel(wheels, "gw_delta", "2.2")
    adds = replace(quick, python="", extras=("play",), adds=True)
    task = finish(adds)
    assert (task.status.state, task.status.exit_code) == ("FAILED", EXIT_USAGE)
    assert "no complete worker" in task.status.error
    assert not Path(quick.root).exists()

    assert finish(quick).status.state == "DONE"
    environment = quick.environment
    before = {p: p.stat().st_mtime_ns for p in environment.folder.rglob("*") if p.is_file()}
    assert environment.extras() == ()
    assert finish(adds, cancelled=True).status.state == "CANCELLED"
    assert environment.is_ready()
    assert environment.extras() == ()
    task = finish(adds)
    assert task.status.state == "DONE", task.status
    assert environment.extras() == ("play",)
    versions = json.loads(environment.ready_path.read_text())
    assert {versions[name] for name in ("gw_delta", "gwalpha")} == {"2.1", "1.2"}
    after = {p: p.stat().st_mtime_ns for p in environment.folder.rglob("*") if p.is_file()}
    assert {p: after[p] for p in before} == before, "what was there is not touched"
    assert not (environment.root / install.TEMPORARY).exists()

    # A wheel that is missing leaves all as it is; another version replaces the present one.
    (wheels / "gw_delta-2.1-py3-none-any.whl").unlink()
    status = finish(adds).status
    assert (status.state, "gw-delta==2.1" in status.error) == ("FAILED", True)
    assert environment.extras() == ("play",)
    added = environment.root / "added"
    for name in ("gw_delta-2.2.dist-info", "gw_delta", "bin"):
        (added / name).mkdir(parents=True)
    install.place_packages(added, environment.folder)
    there = {p.name for p in environment.folder.glob("gw_delta*")}
    assert there == {"gw_delta", "gw_delta-2.2.dist-info"}
    assert not (environment.folder / "bin").exists()


def test_the_command_line(
    quick: SetupRequest, play: Extra, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to = ["--to", str(tmp_path / "w"), "--dry-run", "--python", sys.executable]
    assert batch.main(["set-up-worker", *to, "--extras", "raw,heif"]) == EXIT_DONE
    out = capsys.readouterr().out
    for name in ("heif", "raw"):
        assert f"requirements-worker-{name}-hashes.txt" in out
    assert batch.main(["set-up-worker", *to, "--add", "raw"]) == EXIT_USAGE
    assert "holds no worker environment. Give --extras instead" in capsys.readouterr().out
    assert batch.main(["set-up-worker", *to, "--extras", "jpeg"]) == EXIT_USAGE
    write_wheel(Path(quick.find_links), "gw_delta", "2.1")
    assert finish(replace(quick, extras=("play",))).status.state == "DONE"
    assert quick.environment.extras() == ("play",)
    here = ["set-up-worker", "--to", quick.root, "--dry-run"]
    assert batch.main([*here, "--add", "raw"]) == EXIT_DONE
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "$ " in line]
    assert "requirements-worker-raw-hashes.txt --no-compile --target" in line
    assert "torch" not in line
    repair = ["--repair", "--requirements", quick.requirements, "--find-links", quick.find_links]
    assert batch.main([*here, *repair]) == EXIT_DONE
    assert "gw-delta==2.1" in capsys.readouterr().out, "what was there comes again"


def test_a_missing_extra_names_files_and_next_step(play: Extra) -> None:
    with pytest.raises(MissingExtraError, match=r"^a\.played and 3 others: ") as caught:
        environment.load_extra("play", "a.played and 3 others")
    for words in ("Press Add Play ", "set-up-worker --add play", "pip install gw-delta==2.1"):
        assert words in caught.value.hint
    assert (caught.value.extras, caught.value.exit_code) == (("play",), EXIT_BAD_DATA)


@pytest.mark.parametrize(
    ("version", "module", "words"),
    [("2.1", "", None), ("2.2", "", "gw-delta is 2.2, not 2.1"),
     ("2.1", "import gwnothing\n", "No module named 'gwnothing'"),
     ("2.1", "raise OSError('bad library')\n", "bad library")],
)  # fmt: skip
def test_a_broken_extra_says_why(tmp_path: Path, version: str, module: str, words: str) -> None:
    """In a process of its own, as modules stay imported."""
    info = tmp_path / f"gw_delta-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: gw-delta\nVersion: {version}\n")
    (tmp_path / "gw_delta.py").write_text(module)
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from tests.core.setup.test_extras import PLAY, environment\n"
        "environment.EXTRAS = (PLAY,)\n"
        "try: print('loaded', environment.load_extra('play', 'x').__name__)\n"
        "except environment.MissingExtraError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False,
        cwd=Path(__file__).resolve().parents[3],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (words or "loaded gw_delta") in done.stdout
