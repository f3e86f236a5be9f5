# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the page that shows versions beside each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.zoo.versions import (
    DRAFT,
    EARLIER,
    PAGE,
    STANDARD,
    ratio,
    read_runs,
    record_path,
    write_document,
)
from gaussian_wrapping_addon.core.files import write_json


def record(spent_s: float, seen: float) -> dict[str, Any]:
    return {
        "scene": "zoo-thin-d1-0", "commit": "abc", "preset": "standard", "machine": "a machine",
        "versions": "Python", "threads": 1, "date": "2026-11-24T00:00+00:00", "load_before": 1.5,
        "processor_s": {"train": 0.75 * spent_s, "mesh": 0.25 * spent_s},
        "seen_f1": [seen - 0.1, seen, seen + 0.01], "psnr": 30.0,
    }  # fmt: skip


def write(path: Path, values: dict[str, Any]) -> None:
    path.parent.mkdir(exist_ok=True)
    write_json(path, values)


def test_page_has_ratios_and_their_median(tmp_path: Path) -> None:
    for scene, spent in (("thin-d1", (400.0, 200.0, 60.0)), ("gloss-d1", (400.0, 300.0, 60.0))):
        for column, spent_s in zip((EARLIER, STANDARD, DRAFT), spent, strict=True):
            write(record_path(scene, column, tmp_path), record(spent_s, 0.9))
    page = write_document(tmp_path, tmp_path)
    assert page == tmp_path / PAGE
    text = page.read_text()
    assert "standard takes 0.62 of the processor seconds of earlier, standard" in text
    assert "draft takes 0.25 of the processor seconds of standard" in text
    assert text.count("0.800 / 0.900 / 0.910") == 6


def test_a_scene_without_one_of_two_runs_has_no_ratio(tmp_path: Path) -> None:
    write(record_path("thin-d1", STANDARD, tmp_path), record(100.0, 0.9))
    (mine,) = read_runs(tmp_path).values()
    assert ratio(mine, STANDARD, EARLIER) is None
    assert ratio(mine, STANDARD, STANDARD) == 1.0
    page = write_document(tmp_path, tmp_path)
    assert page is not None
    assert "in the median" not in page.read_text()


def test_no_record_makes_no_page(tmp_path: Path) -> None:
    assert write_document(tmp_path, tmp_path) is None
    assert not list(tmp_path.iterdir())
