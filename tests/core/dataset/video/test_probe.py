# SPDX-License-Identifier: GPL-3.0-or-later
"""A video looked at in a child process: what check and estimate say of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, WorkerError
from gaussian_wrapping_addon.core.jobs.commands.estimate_command import input_facts
from gaussian_wrapping_addon.core.loading import check
from gaussian_wrapping_addon.core.loading.check import Finding, check_input
from gaussian_wrapping_addon.core.photos import video
from gaussian_wrapping_addon.core.photos.video import probe_video, probed
from gaussian_wrapping_addon.core.settings import JobSettings
from tests.core.dataset.video.small_videos import HEIGHT, WIDTH, pan, write


def kinds(findings: list[Finding]) -> list[str]:
    return [finding.severity for finding in findings]


def test_facts_are_those_that_players_show(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(45)), rotation=-90, trc=18)
    found = probe_video(path, sys.executable)
    assert (found.width, found.height, found.frames) == (HEIGHT, WIDTH, 45)
    assert found.duration_s == pytest.approx(1.5)
    assert (found.codec, found.is_hdr, found.is_interlaced) == ("h264", True, False)
    assert probed(path) == found


@pytest.mark.parametrize("worker", ["", sys.executable])
@pytest.mark.parametrize(
    ("content", "words"), [(b"", "is empty"), (b"some text, not a video", "no video")]
)
def test_the_check_refuses_what_is_no_video(
    tmp_path: Path, content: bytes, words: str, worker: str
) -> None:
    (tmp_path / "clip.mkv").write_bytes(content)
    (error,) = [f for f in check_input(tmp_path, worker=worker) if f.severity == "error"]
    assert words in error.message
    assert error.hint


def test_the_check_describes_a_video(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(45)), trc=16)
    without = check_input(path)
    assert kinds(without) == ["fact", "fact"]
    findings = check_input(path, worker=sys.executable)
    assert kinds(findings) == ["fact", "fact", "warning"]
    assert "45 frames, 320 x 240, h264" in findings[0].message
    assert "HDR" in findings[2].message
    shown = ", ".join(finding.short for finding in findings if finding.short)
    assert shown == "2 s of video, cameras to be solved"
    assert [finding.kind for finding in findings if finding.kind] == ["video"]


def test_the_check_refuses_cut_short_and_tiny_videos(tmp_path: Path) -> None:
    whole = write(tmp_path / "clip.mp4", pan(range(30)))
    whole.write_bytes(whole.read_bytes()[:5000])
    short = write(tmp_path / "short.mp4", pan([0, 5]))
    for path, words in ((whole, "cannot be opened as a video"), (short, "has 2 frames")):
        (error,) = [f for f in check_input(path, worker=sys.executable) if f.severity == "error"]
        assert words in error.message
        assert error.hint


def test_a_worker_without_the_decoder_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(_path: Path) -> None:
        raise ModuleNotFoundError("No module named 'av'", name="av")

    monkeypatch.setattr(video, "probed", missing)
    assert video.main(["clip.mp4"]) == WorkerError.exit_code
    (line,) = capsys.readouterr().out.splitlines()
    said = json.loads(line)
    assert "lacks a package" in said["error"]
    assert "Set Up Worker" in said["hint"]
    assert "kind" not in said


def test_a_worker_that_does_not_answer_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(10)))
    with pytest.raises(WorkerError):
        probe_video(path, str(tmp_path / "no" / "python"))

    def broken(*_: object) -> None:
        raise WorkerError("The worker's Python lacks a package.", "Press Set Up Worker.")

    monkeypatch.setattr(check, "probe_video", broken)
    assert kinds(check_input(path, worker="python")) == ["fact", "warning"]


def test_the_estimate_knows_how_many_frames_are_used(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(90)))
    wanted = {
        90: JobSettings(), 12: JobSettings(video_frames=12), 6: JobSettings(video_fps=2.0),
    }  # fmt: skip
    for count, settings in wanted.items():
        facts = input_facts(path, settings)
        assert (facts.photos, facts.long_side_px) == (count, WIDTH)
    (tmp_path / "bad.mp4").write_bytes(b"")
    with pytest.raises(DatasetError, match="is empty"):
        input_facts(tmp_path / "bad.mp4")
