# SPDX-License-Identifier: GPL-3.0-or-later
"""Terminals that lack characters, pipes that are closed and disks that are full."""

from __future__ import annotations

import errno
import logging
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from gaussian_wrapping_addon.core.jobs import worker

BATCH = Path(__file__).resolve().parents[1] / "gaussian_wrapping_addon" / "batch.py"
NOISE = (b"Traceback", b"Logging error", b"Exception ignored", b"Error:")


def run(
    *words: str, stdout: int = subprocess.PIPE, encoding: str = "utf-8", cwd: Path
) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, str(BATCH), *words],
        cwd=cwd,
        stdout=stdout,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"},
        check=False,
    )


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder whose photos are none; their names need Unicode."""
    folder = tmp_path / "Fotos β·"
    folder.mkdir()
    for number in range(4):
        (folder / f"Küche · {number}.png").write_bytes(b"none")
    return folder


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
@pytest.mark.parametrize("words", [["check"], ["wrap", "--help"], ["--help"]])
def test_characters_that_a_terminal_lacks_are_written_as_codes(
    photos: Path, encoding: str, words: list[str]
) -> None:
    given = [*words, str(photos)] if words == ["check"] else words
    ended = run(*given, encoding=encoding, cwd=photos.parent)
    assert ended.returncode == (3 if words == ["check"] else 0)
    assert not any(noise in ended.stderr for noise in NOISE), ended.stderr.decode()
    if words == ["check"]:
        expected = {"ascii": rb"K\xfcche \xb7 0.png", "cp1252": "Küche · 0.png".encode("cp1252"),
                    "utf-8": "Küche · 0.png".encode()}  # fmt: skip
        assert expected[encoding] in ended.stdout


@pytest.mark.parametrize("words", [["check"], ["--help"], ["dance"]])
def test_a_closed_pipe_is_no_failure_of_the_command(photos: Path, words: list[str]) -> None:
    """As under ``| head -1``: what the command does goes on, without a word."""
    reading, writing = os.pipe()
    os.close(reading)
    given = [*words, str(photos)] if words == ["check"] else words
    ended = run(*given, stdout=writing, cwd=photos.parent)
    os.close(writing)
    assert ended.returncode == {"check": 3, "--help": 0, "dance": 2}[words[0]]
    assert ended.stderr == b""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize("words", [["--help"], ["cancel", "job"], ["check", "."]])
def test_output_that_cannot_be_written_is_code_4(tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "job").mkdir()
    for name in (".gaussian-wrapping-job", "job.json"):
        (tmp_path / "job" / name).touch()
    with Path("/dev/full").open("wb") as full:
        ended = run(*words, stdout=full.fileno(), cwd=tmp_path)
    # A command that fails keeps its own code.
    assert ended.returncode == (3 if words[0] == "check" else 4)
    assert ended.stderr.startswith(b"error: The output cannot be written: No space left")
    assert not any(noise in ended.stderr for noise in NOISE), ended.stderr.decode()
    assert len(ended.stderr.splitlines()) == 1


@pytest.mark.skipif(os.name == "nt", reason="shells of Windows cannot close a stream")
def test_without_a_terminal_nothing_is_said(photos: Path) -> None:
    words = [sys.executable, str(BATCH), "check", str(photos)]
    ended = subprocess.run(["sh", "-c", '"$@" >&- 2>&-', "sh", *words], check=False)
    assert ended.returncode == 3


def test_a_log_on_a_full_disk_is_silent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The worker ends with a typed error of its own."""

    def full(_text: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    handler = worker._log_to(tmp_path / "log.txt")
    try:
        with monkeypatch.context() as patched:
            patched.setattr(handler, "stream", SimpleNamespace(write=full, flush=lambda: None))
            logging.getLogger("anybody").error("lost")
        logging.getLogger("anybody").error("kept")
    finally:
        logging.getLogger().removeHandler(handler)
        handler.close()
    assert capfd.readouterr().err == ""
    assert [line.split()[-1] for line in (tmp_path / "log.txt").open()] == ["kept"]
