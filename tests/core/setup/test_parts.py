# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of the set-up: unsuitable Pythons, displayed commands, versions, failed commands."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import ResourceError, UsageError, WorkerError
from gaussian_wrapping_addon.core.jobs import install
from gaussian_wrapping_addon.core.jobs.install import FoundPython, SetupRequest
from gaussian_wrapping_addon.core.worker import environment
from gaussian_wrapping_addon.core.worker.environment import (
    Requirement,
    read_requirements,
)


def fake_python(folder: Path, version: str, name: str = "python3", bits: int = 64) -> str:
    path = folder / name
    is_64_bit = "true" if bits == 64 else "false"
    words = (
        f'{{"version": {version}, "base": "{path}", "is_64_bit": {is_64_bit},'
        ' "venv": true, "pip": true, "ensurepip": true}'
    )
    path.write_text(f"#!/bin/sh\necho '{words}'\n")
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize(
    ("version", "name", "bits", "words"),
    [("[3, 10, 4]", "python3", 64, "3.10.4, which is too old"),
     ("[3, 12, 1]", "python3", 32, "32-bit"), ("no", "python3", 64, "does not run as a Python"),
     ("[3, 11, 1]", "blender-4.3", 64, "is Blender")],
)  # fmt: skip
def test_pythons_that_are_refused(
    tmp_path: Path, version: str, name: str, bits: int, words: str
) -> None:
    path = fake_python(tmp_path, version, name, bits)
    with pytest.raises(UsageError, match=words):
        install.probe(path)
    assert install.find_pythons(paths=[path]) == []
    assert (path in install.candidates(path)) == (name == "python3")


def test_pythons_with_wheels_come_first(tmp_path: Path) -> None:
    paths = [fake_python(tmp_path, f"[3, {n}, 0]", f"python3.{n}") for n in (14, 11, 13, 10)]
    found = install.find_pythons(paths=paths)
    assert [p.version[1] for p in found] == [11, 13, 14], "3.14 last, 3.10 not at all"


def test_the_running_python_is_found() -> None:
    real = install.probe(sys.executable)
    assert real.version == sys.version_info[:3]
    assert real.path in [p.path for p in install.find_pythons(sys.executable)]


def test_the_words_of_the_launcher() -> None:
    text = (
        " -V:3.12 *        C:\\Program Files\\Python312\\python.exe\r\n"
        " -3.11-64    C:\\Users\\Zo\xeb\\Python311\\python.exe\r\nnothing\r\n"
    )
    assert install.paths_of_launcher(text) == [
        "C:\\Program Files\\Python312\\python.exe",
        "C:\\Users\\Zo\xeb\\Python311\\python.exe",
    ]


def test_where_torch_comes_from() -> None:
    for choice, system, index in (
        ("cpu", "Linux", install.CPU_INDEX), ("cuda", "Linux", ""), ("cpu", "Windows", ""),
        ("cuda", "Windows", install.CUDA_INDEX), ("cpu", "Darwin", ""), ("index", "Linux", ""),
    ):  # fmt: skip
        assert install.torch_index(choice, system) == index
    with pytest.raises(UsageError, match="no CUDA"):
        install.torch_index("cuda", "Darwin")


PYTHON = FoundPython("/usr/bin/python3.12", (3, 12, 1))


def test_commands_are_shown_as_they_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install.platform, "system", lambda: "Linux")
    request = SetupRequest("/a b/w", PYTHON.path, "/r.txt", "cpu")
    venv, pip, check = install.all_commands(request, PYTHON)
    assert install.as_line(venv) == "/usr/bin/python3.12 -I -m venv --clear '/a b/w/env'"
    assert pip[:4] == ("/a b/w/env/bin/python", "-I", "-m", "pip")
    assert pip[-4:] == ("--extra-index-url", install.CPU_INDEX, "-r", "/r.txt")
    assert check[-1] == "check"
    offline = SetupRequest("/a b/w", PYTHON.path, "/r.txt", "cpu", "/wheels")
    _, pip, _ = install.all_commands(offline, PYTHON)
    assert {"--isolated", "--no-index", "--find-links", "/wheels"} <= set(pip)
    assert not [word for word in pip if "http" in word]
    plain = replace(PYTHON, has_venv=False)  # Blender's own on Windows
    (pip,) = install.all_commands(SetupRequest("/w", "/p", "/r.txt", "index"), plain)
    assert pip[:4] == (PYTHON.path, "-I", "-m", "pip")
    assert pip[-2:] == ("--target", "/w/env")
    with pytest.raises(UsageError, match=r"neither venv nor pip.*python3\.12-venv"):
        install.all_commands(SetupRequest("/w", "/p", "/r.txt"), replace(plain, pip=()))


@pytest.mark.parametrize("torch", ["cpu", "cuda", "index"])
@pytest.mark.parametrize("has_venv", [True, False])
def test_files_are_installed_by_their_hashes(
    monkeypatch: pytest.MonkeyPatch, torch: str, has_venv: bool
) -> None:
    monkeypatch.setattr(install.platform, "system", lambda: "Linux")
    ours = environment.requirements_file()
    hashes = str(ours.with_name(environment.HASHES_NAME))
    python = replace(PYTHON, has_venv=has_venv)
    found = install.all_commands(SetupRequest("/w", "/p", str(ours), torch), python)
    first, second = (c for c in found if "install" in c)
    assert first[first.index("--require-hashes") :][:3] == ("--require-hashes", "-r", hashes)
    assert not [word for word in first if "index" in word]
    (wanted,) = (r for r in read_requirements(ours) if r.name == "torch")
    assert f"torch{wanted.versions}" in second
    assert ("--no-deps" in second) == (torch == "cpu")
    assert all(("--target" in c) != has_venv for c in (first, second))
    wheels = SetupRequest("/w", "/p", str(ours), torch, "/wheels")
    assert not [c for c in install.all_commands(wheels, python) if "--require-hashes" in c]


def test_the_list_with_hashes_is_that_of_our_requirements() -> None:
    ours = environment.requirements_file()
    text = ours.with_name(environment.HASHES_NAME).read_text()
    first = re.search(r"^[\w-]+==", text, re.MULTILINE)
    assert first is not None
    entries = re.split(r"\n(?=\w)", text[first.start() :].strip())
    pinned: dict[str, list[str]] = {}
    for entry in entries:
        name, version = re.match(r"([\w-]+)==(\S+)", entry).groups()  # type: ignore[union-attr]
        pinned.setdefault(name, []).append(version)
        assert len(re.findall(r"--hash=sha256:[0-9a-f]{64}\b", entry)) >= 1, name
    wanted = read_requirements(ours)
    assert {r.name for r in wanted} - set(pinned) == {"torch"}
    assert all(r.versions for r in wanted)
    for requirement in wanted:
        assert all(requirement.allows(v) for v in pinned.get(requirement.name, []))


@pytest.mark.parametrize(
    ("versions", "version", "answer"),
    [("==2.13.0", "2.13.0+cpu", True), ("==2.13.0", "2.13", True), ("==2.13.0", "2.13.1", False),
     (">=1.26,<3", "1.26.4", True), (">=1.26,<3", "3.0.0", False), (">=1.26,<3", "1.9", False),
     ("!=1.5", "1.5", False), ("", "9", True)],
)  # fmt: skip
def test_versions(versions: str, version: str, answer: bool) -> None:
    assert Requirement("x", versions).allows(version) is answer


def test_lists_that_are_refused(tmp_path: Path) -> None:
    (tmp_path / "r.txt").write_text("# nothing\n")
    for name in ("r.txt", "none.txt"):
        with pytest.raises(UsageError, match=r"names no package|cannot be read"):
            read_requirements(tmp_path / name)


@pytest.mark.parametrize(
    ("words", "kind", "text"),
    [
        ("ERROR: No matching distribution found for xatlas==0.0.11",
         ResourceError, "xatlas==0.0.11"),
        ("WARNING: NewConnectionError\nERROR: No matching distribution found for torch",
         ResourceError, "cannot be reached"),
        ("ERROR: [Errno 28] No space left on device", ResourceError, "disk is full"),
        ("        Expected     or " + 64 * "0" + "\n             Got        " + 64 * "a" + "\n",
         ResourceError, "not the published one"),
        ("ERROR: odd\nlast", WorkerError, "ERROR: odd"),
    ],
)  # fmt: skip
def test_failures_get_their_type(words: str, kind: type, text: str) -> None:
    error = install.error_from_output(1, words.splitlines())
    assert type(error) is kind
    assert text in error.message
    assert error.hint
