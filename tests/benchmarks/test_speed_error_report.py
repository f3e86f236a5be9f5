# SPDX-License-Identifier: GPL-3.0-or-later
"""The report on speed against error, made from figures that the test invents."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from benchmarks.speed_error import document
from benchmarks.speed_error.figures import write_plots
from benchmarks.speed_error.plan import MAIN_SCENES, Plan, Run, full_plan, quick_plan
from benchmarks.speed_error.results import Outcome, Result, mean_and_spread, plain
from benchmarks.speed_error.tables import (
    bias_table,
    cost_table,
    image_table,
    kernel_table,
    pose_table,
    seed_table,
    stage_table,
    surface_table,
    varied_tables,
)
from benchmarks.tables import Table

PLANS = (full_plan(), quick_plan())
POSES = {
    "spot": {
        "seconds": 61.0,
        "photos": 40,
        "solved": 39,
        "errors": {
            "center_share_median": 0.0012,
            "center_share_max": 0.01,
            "rotation_degrees_median": 0.031,
            "rotation_degrees_max": 0.4,
        },
    }
}
KERNELS = {
    "spot": {
        "gaussians": 40_000, "cameras": 40, "kernel_us": 2.0, "definition_us": 50_000.0,
        "error_median": 1e-4, "error_max": 1e-2, "same_side": 0.98, "definition_points": 60,
    }
}  # fmt: skip


def result(run: Run, variant: Any, number: int) -> Result:
    """Return invented figures; ``number`` makes them differ."""
    shares = [0.5 + 0.001 * number, 0.7 + 0.001 * number, 0.9]
    surface = {
        "f1": shares, "precision": shares, "recall": shares, "visible_recall": shares,
        "thin_recall": shares if run.scene == "wheel" else None,
        "chamfer_mean": 0.004, "accuracy_median": 0.002, "normal_consistency": 0.93,
    }  # fmt: skip
    report = {
        "stages": [
            {"name": name, "seconds": seconds + number}
            for name, seconds in (("cameras", 1.0), ("train", 60.0), ("mesh-box", 7.0))
        ] + [{"name": "texture-box", "seconds": 9.0}],
        "peak_memory_bytes": {"worker": 3 << 30, "largest_helper": 1 << 30},
        "machine": {"threads": 2},
        "settings": {"training": {"max_gaussians": 40_000 + number, "max_image_px": 480}},
        "regions": {"box": {"statistics": {"closed": number != 3}, "texture": {"coverage": 0.5}}},
    }  # fmt: skip
    scores = {
        "diagonal": 2.0, "thresholds": [0.005, 0.01, 0.02], "vertices": 100 * (number + 1),
        "faces": 200, "texture_side_px": 512, "seconds_scoring": 3.0,
        "surface": {"uniform": surface, "scan": surface, "legacy": surface},
        "texture": {"psnr": 24.0 + number, "ssim": 0.8},
        "gaussians": {"count": 39_000, "psnr": 28.0, "ssim": 0.9, "object_psnr": 27.0},
        "depth": {"median": 0.001, "percentile_95": 0.01, "within": shares},
        "vacancy": {"median": 0.001, "median_offset": None, "within": shares},
    }  # fmt: skip
    measured = {"wall_s": 80.0 + number, "report": report, "region": "box", "command": []}
    return Result(run, variant, measured, scores)


def results(plan: Plan) -> list[Result]:
    found = []
    for run in plan.runs:
        found.append(result(run, None, len(found)))
        found += [result(run, variant, len(found)) for variant in run.variants]
    return found


def test_every_run_has_a_folder_of_its_own() -> None:
    for plan in PLANS:
        names = Counter(run.identity for run in plan.runs)
        assert max(names.values()) == 1, names
        for run in plan.runs:
            variants = Counter((v.name, v.parameter) for v in run.variants)
            assert not variants or max(variants.values()) == 1


def test_the_full_plan_covers_what_the_report_promises() -> None:
    plan = full_plan()
    plains = {(r.scene, r.preset) for r in plan.runs if not r.name and r.seed == 0}
    assert plains >= {(s, p) for s in MAIN_SCENES for p in ("draft", "standard", "fine")}
    for scene in MAIN_SCENES:
        seeds = {r.seed for r in plan.runs if r.scene == scene and not r.name}
        assert len(seeds) == 3
    assert {v.name for r in plan.runs for v in r.variants} == {"points", "texture"}
    assert {r.name for r in plan.runs} == {"", "gaussians", "image"}


@pytest.mark.parametrize("plan", PLANS, ids=["full", "quick"])
def test_tables_hold_one_row_for_what_they_compare(plan: Plan) -> None:
    found = results(plan)
    plains = plain(found)
    for table in (cost_table(found), surface_table(found, {}), image_table(found)):
        assert [row[:2] for row in table.rows] == [(r.run.scene, r.run.preset) for r in plains]
        check(table)
    stages = stage_table(found, POSES)
    check(stages)
    assert next(row[2] for row in stages.rows if row[0] == "spot") == "0.031"
    assert {row[2] for row in stages.rows if row[0] != "spot"} == {None}
    assert "none found" in {row[5] for row in stages.rows}
    true = {"spot": found[0].scores}
    surfaces = surface_table(found, true)
    check(surfaces)
    assert surfaces.rows[0][:3] == ("spot", "true surface", surfaces.rows[1][2])
    thin = surfaces.header.index("thin recall 0.5 %")
    assert {bool(row[thin]) for row in surfaces.rows if row[0] == "wheel"} == {True}
    assert {bool(row[thin]) for row in surfaces.rows if row[0] != "wheel"} == {False}
    check(pose_table(POSES))
    check(kernel_table(KERNELS))
    (spot, *_) = seed_table(found).rows
    assert spot[:2] == ("spot", 3)
    bias = bias_table(found)
    counts = [row[1] for row in bias.rows if row[0] == "spot"]
    assert counts == sorted(counts)
    assert len(counts) == 1 + sum(v.name == "points" for v in plan.runs[0].variants)
    for table in varied_tables(found):
        check(table)
        assert len(table.rows) >= 2


def check(table: Table) -> None:
    """Every row has as many cells as the header, in the rendered table as well."""
    assert table.rows
    assert {len(row) for row in table.rows} == {len(table.header)}
    lines = [line for line in table.markdown().splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {len(table.header) + 1}


def test_an_open_mesh_is_shown_as_such() -> None:
    rows = {row[-1] for row in surface_table(results(quick_plan()), {}).rows}
    assert rows == {"yes"} or rows == {"yes", "NO"}
    broken = result(Run("spot", "draft"), None, 3)
    assert surface_table([broken], {}).rows[0][-1] == "NO"


def test_spread_is_that_of_a_sample() -> None:
    assert mean_and_spread([1.0, 2.0, 3.0]) == "2.000 ± 1.000"
    assert mean_and_spread([1.0]) == "1.000"


def test_plots_show_all_scenes(tmp_path: Path) -> None:
    write_plots(results(full_plan()), tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    words = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert set(MAIN_SCENES) <= set(words)
    assert words.count("standard") == 3 * len(MAIN_SCENES)
    assert "nothing was measured" not in words


def test_the_document_names_machine_seed_and_roles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = quick_plan()
    folders = {}
    for run in plan.runs:
        folder = tmp_path / run.scene
        folder.mkdir(exist_ok=True)
        (folder / "scene.json").write_text('{"role": "test", "description": "a thing"}')
        folders[run.scene] = folder
    drawn: list[str] = []
    monkeypatch.setattr(document, "write_comparison", lambda *a: drawn.append(a[-1].name))
    (tmp_path / "reading.md").write_text("## Reading\n\nSober words.\n")
    facts = {
        "command": "the command", "date": "2026-01-02", "minutes": 12.0, "reused": False,
        "photos": plan.photos, "runs": tmp_path,
    }  # fmt: skip
    document.write_document(tmp_path, Outcome(folders, results(plan), POSES, {}, KERNELS), facts)
    text = (tmp_path / "README.md").read_text(encoding="utf-8")
    for words in ("the command", "2026-01-02", "2 threads", "Seed 0", "Sober words.", "| test "):
        assert words in text
    assert "In short" in text
    assert drawn == [f"scene-{scene}.jpg" for scene in folders]
    for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert name in drawn or (tmp_path / name).is_file(), name
    assert "nan" not in text.lower().split()
