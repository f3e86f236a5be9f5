# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounded JSON, atomic writes, and names that stay inside their folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.files import (
    finite_json,
    read_json,
    remove_partial_files,
    resolve_inside,
    write_json,
)


def test_what_is_not_finite_becomes_null(tmp_path: Path) -> None:
    values = {"a": (1.5, float("nan"), [float("-inf"), True, "x"]), 3: {"b": float("inf")}}
    write_json(tmp_path / "a.json", finite_json(values))
    expected = {"a": [1.5, None, [None, True, "x"]], "3": {"b": None}}
    assert finite_json(values) == read_json(tmp_path / "a.json") == expected


@pytest.mark.parametrize(
    "text",
    ['{"a": NaN}', '{"a": Infinity}', '{"a": ', "", "\x00", "[" * 100_000, '{"a": 1}}'],
)
def test_bad_json_is_refused_with_the_file_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "odd.json"
    path.write_text(text)
    with pytest.raises(ParseError, match=r"odd\.json"):
        read_json(path)


def test_deep_nesting_within_the_parser_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "deep.json"
    path.write_text("[" * 40 + "]" * 40)
    with pytest.raises(ParseError, match="deeply"):
        read_json(path)


def test_a_file_over_the_size_limit_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MAX_JSON_BYTES", 10)
    path = tmp_path / "big.json"
    path.write_text("[1, 2, 3, 4, 5, 6]")
    with pytest.raises(ParseError, match="too many"):
        read_json(path)


def test_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "bom.json"
    path.write_bytes(b"\xef\xbb\xbf[1]")
    assert read_json(path) == [1]


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"x": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"x": float("nan")})
    assert read_json(path) == {"x": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def killed_while_writing(path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write as a process that is killed before it replaces the file; return what it leaves."""
    with monkeypatch.context() as killed:
        for call in (os.replace, Path.unlink):
            owner = os if call is os.replace else Path
            killed.setattr(owner, call.__name__, lambda *_, **__: None)
        write_json(path, {"x": 1})
    (left,) = path.parent.glob(f"{path.name}.writing.*")
    return left


def test_what_killed_processes_left_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "job" / "stages").mkdir(parents=True)
    old = killed_while_writing(tmp_path / "job" / "stages" / "done.json", monkeypatch)
    fresh = killed_while_writing(tmp_path / "job" / "status.json", monkeypatch)
    outside = killed_while_writing(tmp_path / "other.json", monkeypatch)
    mine = tmp_path / "job" / "a.writing.me"
    mine.touch()
    for path in (old, outside, mine):
        os.utime(path, (1.0, 1.0))
    if os.name != "nt":
        (tmp_path / "job" / "link").symlink_to(tmp_path)
    remove_partial_files(tmp_path / "job")
    assert [path.exists() for path in (old, fresh, outside, mine)] == [False, True, True, True]


@pytest.mark.parametrize(
    "name",
    [
        "../a.jpg", "a/../../b.jpg", "/etc/passwd", "C:\\x.png", "C:/x.png", "\\\\srv\\x", "a\0b",
        "CON.png", "sub/aux.jpg", "", "x" * 4000, "..\\a.jpg",
    ],
)  # fmt: skip
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    assert resolve_inside(tmp_path, name) is None


@pytest.mark.parametrize(
    "name", ["a.jpg", "sub/b c.jpg", "sub\\d.jpg", "ünï%20'\"é.png", "..a.jpg"]
)
def test_ordinary_names_are_accepted(tmp_path: Path, name: str) -> None:
    path = resolve_inside(tmp_path, name)
    assert path is not None
    assert path.is_relative_to(tmp_path)


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    inside = tmp_path / "in"
    inside.mkdir()
    (tmp_path / "secret.jpg").write_text("x")
    os.symlink(tmp_path / "secret.jpg", inside / "photo.jpg")
    assert resolve_inside(inside, "photo.jpg") is None
