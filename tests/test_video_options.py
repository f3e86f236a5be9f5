# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos on the command line: check, refusals within seconds, options that exclude each other."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from gaussian_wrapping_addon.command_line.options import training_settings
from gaussian_wrapping_addon.command_line.parser import build_parser
from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, EXIT_DONE, EXIT_USAGE, UsageError
from tests.core.photos.small_videos import pan, write

BATCH = Path(__file__).resolve().parents[1] / "gaussian_wrapping_addon" / "batch.py"


def batch(*arguments: str | Path) -> tuple[int, str]:
    command = [sys.executable, str(BATCH), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    return done.returncode, done.stdout + done.stderr


def test_options_become_settings() -> None:
    def settings(*arguments: str) -> tuple[int, float]:
        options = build_parser().parse_args(["wrap", "clip.mp4", "--out", "o", *arguments])
        found = training_settings(options)
        return found.video_frames, found.video_fps

    assert settings() == (0, 0.0)
    assert settings("--frames", "60") == (60, 0.0)
    assert settings("--fps", "2.5") == (0, 2.5)
    with pytest.raises(UsageError, match="--fps: not allowed with argument --frames"):
        settings("--frames", "60", "--fps", "2")


def test_check_describes_a_video(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mov", pan(range(30)))
    code, text = batch("check", path)
    assert code == EXIT_DONE
    assert "clip.mov: 1 s, 30 frames, 320 x 240, h264" in text
    assert "The input is of kind: video." in text


@pytest.mark.parametrize("content", [b"", b"this is a text"])
def test_no_video_is_refused_and_nothing_is_left(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "clip.mp4").write_bytes(content)
    code, text = batch("check", tmp_path / "clip.mp4")
    assert (code, "error: clip.mp4 is" in text) == (EXIT_BAD_DATA, True)
    code, text = batch("wrap", tmp_path / "clip.mp4", "--out", tmp_path / "out", "--no-blend")
    assert (code, "error: clip.mp4 is" in text) == (EXIT_BAD_DATA, True)
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


@pytest.mark.parametrize("option", ["--frames", "--fps"])
def test_options_of_videos_are_refused_for_photos(tmp_path: Path, option: str) -> None:
    (tmp_path / "photos").mkdir()
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        Image.new("RGB", (64, 48)).save(tmp_path / "photos" / name)
    code, text = batch(
        "wrap", tmp_path / "photos", "--out", tmp_path / "out", "--no-blend", option, "5"
    )
    assert code == EXIT_USAGE
    assert f"{option} has no effect: photos is no video. Omit it, or give the video." in text


def test_blocks_without_other_computers_are_refused(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        Image.new("RGB", (64, 48)).save(tmp_path / "photos" / name)
    code, text = batch(
        "wrap", tmp_path / "photos", "--out", tmp_path / "out", "--no-blend", "--set", "blocks=2"
    )
    assert code == EXIT_USAGE
    assert "Give --computers as well, or omit it." in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("option", "value"), [("--frames", "2"), ("--fps", "0.01")])
def test_numbers_out_of_range_are_refused(tmp_path: Path, option: str, value: str) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(10)))
    code, text = batch("wrap", path, "--out", tmp_path / "out", "--no-blend", option, value)
    assert code == EXIT_USAGE
    assert f"{option} is out of range. Give 0 (by the motion) or from" in text
