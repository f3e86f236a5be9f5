# SPDX-License-Identifier: GPL-3.0-or-later
"""``parts.json``: what is written is read, and what does not fit together is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import ParseError, UsageError
from gaussian_wrapping_addon.core.jobs.parts.graph import (
    PARTS_NAME,
    Part,
    PartsGraph,
    read_parts,
    write_parts,
)

GRAPH = PartsGraph(
    "0123456789ab", "ba9876543210", "../photos",
    (
        Part("cameras", "cameras", (), ("stages/cameras-*/scene.json",), 0.12),
        Part("train", "train", ("cameras",), ("stages/train-*/gaussians.npz",), 0.6),
        Part("plan-a_1", "plan", ("train",), (), 0.1, "a_1"),
        Part("points-a_1-0000", "points", ("plan-a_1",), (), 0.1, "a_1", 0, 7 << 30, 12.5),
    ),
)  # fmt: skip


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_parts(tmp_path, GRAPH)
    assert read_parts(tmp_path) == GRAPH
    assert [part.name for part in GRAPH.of_region("a_1")] == ["plan-a_1", "points-a_1-0000"]
    assert GRAPH.part("train").needs == ("cameras",)
    with pytest.raises(UsageError, match="no part faces-9"):
        GRAPH.part("faces-9")


def _set(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(values: dict[str, Any]) -> None:
        *where, last = [int(w) if w.isdigit() else w for w in path.split(".")]
        target: Any = values
        for key in where:
            target = target[key]
        target[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_set("version", 2), "version: it is not 1"),
        (_set("parts", []), "not a list of 1 to"),
        (_set("parts", "all"), "not a list of 1 to"),
        (_set("code", 7), "code: not a short text"),
        (_set("plan", None), "plan: not a short text"),
        (_set("parts.0.name", "../cameras"), r"parts\[0\]"),
        (_set("parts.0.name", ""), r"parts\[0\]"),
        (_set("parts.0.kind", "mine"), r"parts\[0\]"),
        (_set("parts.0.outputs", ["/etc/passwd"]), r"parts\[0\]"),
        (_set("parts.0.outputs", ["a/../../b"]), r"parts\[0\]"),
        (_set("parts.0.outputs", ["C:x"]), r"parts\[0\]"),
        (_set("parts.0.needs", "train"), r"parts\[0\]"),
        (_set("parts.0.needs", ["train"]), "cameras, train wait for each other"),
        (_set("parts.0.needs", ["cameras"]), "cameras wait for each other"),
        (_set("parts.1.needs", ["camera"]), r"parts\[1\]\.needs: 'camera' is no part"),
        (_set("parts.1.name", "cameras"), "two have the same name, but for case"),
        (_set("parts.1.share", -0.1), r"parts\[1\]"),
        (_set("parts.1.share", True), r"parts\[1\]"),
        (_set("parts.1.tile", 1e9), r"parts\[1\]"),
        (_set("parts.1.block", 1e9), r"parts\[1\]\.block"),
        (_set("parts.1.block", True), r"parts\[1\]\.block"),
        (_set("parts.3.region", "a/b"), r"parts\[3\]"),
        (_set("parts.3.seconds", "long"), r"parts\[3\]"),
        (lambda values: values["parts"][2].pop("share"), r"parts\[2\]"),
        (lambda values: values["parts"][2].update(run="rm"), r"parts\[2\]"),
        (lambda values: values["parts"].append(5), r"parts\[4\]"),
    ],
)
def test_what_does_not_fit_is_refused(
    change: Callable[[dict[str, Any]], None], said: str, tmp_path: Path
) -> None:
    write_parts(tmp_path, GRAPH)
    values = json.loads((tmp_path / PARTS_NAME).read_text())
    change(values)
    (tmp_path / PARTS_NAME).write_text(json.dumps(values))
    with pytest.raises(ParseError, match=said) as caught:
        read_parts(tmp_path)
    assert "parts.json" in caught.value.message
    assert caught.value.hint


def test_a_list_that_is_missing_cut_or_too_long_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match=r"has no parts\.json"):
        read_parts(tmp_path)
    write_parts(tmp_path, GRAPH)
    text = (tmp_path / PARTS_NAME).read_text()
    (tmp_path / PARTS_NAME).write_text(text[:100])
    with pytest.raises(ParseError):
        read_parts(tmp_path)
    monkeypatch.setattr(limits, "MAX_PARTS", 3)
    (tmp_path / PARTS_NAME).write_text(text)
    with pytest.raises(ParseError, match="not a list of 1 to 3 parts"):
        read_parts(tmp_path)
