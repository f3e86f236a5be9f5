# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of photo sets, and what it keeps of a job's report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.photo_sets import (
    PAGE,
    kept_of,
    main,
    read_runs,
    record_path,
    spent_s,
    write_document,
)
from gaussian_wrapping_addon.core.files import write_json


def report(held_out: float | None) -> dict[str, Any]:
    return {
        "stages": [
            {"name": "cameras", "processor_seconds": 10.0, "seconds": 70.0},
            {"name": "train", "processor_seconds": 100.0, "seconds": 110.0},
            {"name": "mesh-region", "processor_seconds": 20.0, "seconds": 21.0},
            {"name": "texture-region", "processor_seconds": 5.0, "seconds": 6.0},
        ],
        "cameras": {"views": 14, "facts": {"mean_reprojection_error_px": 0.25}},
        "training": {
            "held_out_psnr": held_out, "held_out_ssim": held_out and 0.9, "gaussians": 1000,
            "decisions": [{"name": "growth", "chosen": "off"}],
        },
        "regions": {
            "whole": {
                "statistics": {"faces": 40, "closed": True, "components": 1},
                "texture": {"coverage": 0.875},
                "mesh_rendering": {"psnr": 26.5, "ssim": 0.95, "covered": 0.4}
                if held_out
                else {"note": "nothing was held out"},
            }
        },
        "warnings": [{"code": "photos-left-out"}],
    }  # fmt: skip


def record(name: str, held_out: float | None, date: str = "2026-11-25T10:00") -> dict[str, Any]:
    return {
        "set": name, "photos": 16, "preset": "draft", "commit": "abc", "machine": "a machine",
        "versions": "Python", "threads": 1, "date": date, "load_before": 0.5,
        **kept_of(report(held_out)),
    }  # fmt: skip


def test_what_is_kept_of_a_report() -> None:
    kept = kept_of(report(25.0))
    assert kept["processor_s"] == {"cameras": 10.0, "train": 100.0, "mesh": 20.0, "texture": 5.0}
    assert kept["clock_s"]["cameras"] == 70.0
    assert spent_s(kept) == 125.0
    assert (kept["placed"], kept["reprojection_px"], kept["held_out_psnr"]) == (14, 0.25, 25.0)
    assert (kept["mesh_psnr"], kept["covered"], kept["coverage"]) == (26.5, 0.4, 0.875)
    assert kept["decisions"] == {"growth": "off"}
    assert kept["warnings"] == ["photos-left-out"]


def test_page_has_a_row_for_each_set_and_version(tmp_path: Path) -> None:
    made = [record("fox", 27.25), record("bananas", 24.75, "2026-11-26T10:00")]
    made += [record("bananas", None, "2026-11-25T09:00")]
    for number, one in enumerate(made):
        path = record_path(one["set"], "draft", str(number), tmp_path)
        path.parent.mkdir(exist_ok=True)
        write_json(path, one)
    assert [(r["set"], r["held_out_psnr"]) for r in read_runs(tmp_path)] == [
        ("bananas", None), ("bananas", 24.75), ("fox", 27.25),
    ]  # fmt: skip
    page = write_document(tmp_path, tmp_path)
    assert page == tmp_path / PAGE
    text = page.read_text()
    assert "2026-11-25 to 2026-11-26" in text
    (fox,) = [line for line in text.splitlines() if line.startswith("| fox")]
    for cell in ("14 of 16", "0.25", "27.25", "26.50", "40", "yes", "70", "125"):
        assert f" {cell} " in fox


def test_no_record_makes_no_page(tmp_path: Path) -> None:
    assert write_document(tmp_path, tmp_path) is None


def test_sets_must_be_said(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([])
    assert "FOLDER" in capsys.readouterr().err
