# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos by name and first bytes; the one of a folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError
from gaussian_wrapping_addon.core.loading.source_kind import source_kind
from gaussian_wrapping_addon.core.photos.video import container_of
from tests.core.dataset.video.small_videos import pan, write


@pytest.mark.parametrize(
    ("name", "codec", "container"),
    [
        ("a.mp4", "libx264", "mov"), ("a.mov", "mpeg4", "mov"), ("a.mkv", "libx264", "matroska"),
        ("a.webm", "libvpx", "matroska"), ("a.avi", "mpeg4", "avi"),
    ],
)  # fmt: skip
def test_containers_by_their_first_bytes(
    tmp_path: Path, name: str, codec: str, container: str
) -> None:
    path = write(tmp_path / name, pan([0, 2, 4]), codec=codec)
    assert container_of(path) == container
    (tmp_path / "other.mp4").write_bytes(path.read_bytes())
    assert container_of(tmp_path / "other.mp4") == container


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"#EXTM3U\n#EXT-X-VERSION:3\nfile:///etc/passwd\n", "no video that can be read"),
        (b"ffconcat version 1.0\nfile /etc/passwd\n", "no video that can be read"),
        (b"hello, this is text", "no video that can be read"),
        (b"\xff\xd8\xff\xe0 jpeg", "no video that can be read"),
    ],
)
def test_what_is_no_video_is_refused_by_name(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=rf"^clip\.mp4 .*{words}|^clip\.mp4 is {words}") as told:
        container_of(path)
    assert told.value.hint


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_a_named_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "clip.mp4")
    with pytest.raises(ParseError):
        container_of(tmp_path / "clip.mp4")


def test_a_folder_with_one_video_and_no_photos_is_that_video(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("by hand")
    (tmp_path / ".hidden.mp4").write_bytes(b"resource fork")
    (tmp_path / "clip.MP4").write_bytes(b"not looked into")
    kind = source_kind(tmp_path)
    assert (kind.kind, kind.video) == ("video", tmp_path / "clip.MP4")
    assert source_kind(tmp_path / "clip.MP4").video == tmp_path / "clip.MP4"
    (tmp_path / "second.mov").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"no photos, but 2 videos: clip\.MP4, second\.mov"):
        source_kind(tmp_path)
    (tmp_path / "photo.jpg").write_bytes(b"")
    assert source_kind(tmp_path).kind == "photos"
