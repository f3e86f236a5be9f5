# SPDX-License-Identifier: GPL-3.0-or-later
"""The report on speed against error, made from figures that the test invents."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from benchmarks import speed_vs_error
from benchmarks.speed_error import document
from benchmarks.speed_error.figures import write_plots
from benchmarks.speed_error.plan import MAIN_SCENES, Plan, Run, full_plan, quick_plan
from benchmarks.speed_error.results import Outcome, Result, mean_and_spread, plain
from benchmarks.speed_error.runs import Settings
from benchmarks.speed_error.tables import (
    cost_table,
    image_table,
    kernel_table,
    pose_table,
    stage_table,
    surface_table,
)
from benchmarks.speed_error.varied_tables import (
    gaussian_table,
    image_size_table,
    mesh_table,
    seed_table,
    texture_table,
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


def surface(base: float, thin_count: int) -> dict[str, Any]:
    """Return surface scores in which no two figures are equal."""
    names = ("f1", "precision", "recall", "visible_recall", "thin_recall")
    values: dict[str, Any] = {
        name: [base + 0.01 * k + 0.001 * i for i in range(3)] for k, name in enumerate(names)
    }
    return values | {
        "chamfer_mean": 0.004, "accuracy_median": 0.002, "normal_consistency": base + 0.06,
        "thin_count": thin_count, "truth_count": 1000,
    }  # fmt: skip


def result(run: Run, variant: Any, number: int) -> Result:
    """Return invented figures; ``number`` makes runs differ."""
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
    thin = 500 if run.scene == "wheel" else 5
    scores = {
        "diagonal": 2.0, "thresholds": [0.005, 0.01, 0.02], "vertices": 100 * (number + 1),
        "faces": 200, "texture_side_px": 512, "seconds_scoring": 3.0,
        "surface": {
            "uniform": surface(0.7, thin), "scan": surface(0.8, thin), "legacy": surface(0.5, thin),
        },
        "texture": {"psnr": 24.0, "ssim": 0.81, "lpips_note": "no weights"},
        "gaussians": {"count": 39_000, "psnr": 28.0, "ssim": 0.91, "object_psnr": 27.0},
        "depth": {"median": 0.001, "percentile_95": 0.01, "within": [0.61, 0.62, 0.63]},
        "vacancy": {"median": 0.003, "median_offset": None, "within": [0.64, 0.65, 0.66]},
    }  # fmt: skip
    measured = {
        "wall_s": 80.0 + number, "report": report, "region": "box", "command": [],
        "code": "0123456789", "load_before": 0.25,
    }  # fmt: skip
    return Result(run, variant, measured, scores)


def results(plan: Plan) -> list[Result]:
    found = []
    for run in plan.runs:
        found.append(result(run, None, len(found)))
        found += [result(run, variant, len(found)) for variant in run.variants]
    return found


def first_row(table: Table) -> dict[str, Any]:
    return dict(zip(table.header, table.rows[0], strict=True))


def check(table: Table) -> None:
    """Every row has as many cells as the header, in the rendered table as well."""
    assert table.rows
    assert {len(row) for row in table.rows} == {len(table.header)}
    assert len(set(table.header)) == len(table.header)
    lines = [line for line in table.markdown().splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {len(table.header) + 1}


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
    seeds = Counter(r.scene for r in plan.runs if not r.name and r.preset == "draft")
    assert sum(count == 3 for count in seeds.values()) >= 2
    assert {v.name for r in plan.runs for v in r.variants} == {"points", "texture"}
    assert {r.name for r in plan.runs} == {"", "gaussians", "image"}


@pytest.mark.parametrize("plan", PLANS, ids=["full", "quick"])
def test_tables_hold_one_row_for_what_they_compare(plan: Plan) -> None:
    found = results(plan)
    plains = plain(found)
    for table in (
        cost_table(found), surface_table(found, {}), image_table(found), stage_table(found, POSES),
    ):  # fmt: skip
        assert [row[:2] for row in table.rows] == [(r.run.scene, r.run.preset) for r in plains]
        check(table)
    check(pose_table(POSES))
    check(kernel_table(KERNELS))
    assert first_row(seed_table(found))["seeds"] == 3
    meshes = mesh_table(found)
    counts = [row[1] for row in meshes.rows if row[0] == "spot"]
    assert counts == sorted(counts)
    assert len(counts) == 1 + sum(v.name == "points" for v in plan.runs[0].variants)
    for table in (gaussian_table(found), image_size_table(found, 288), texture_table(found)):
        check(table)
        assert len(table.rows) >= 2
    assert first_row(image_size_table(found, 288))["long side px"] == 288


def test_headings_stand_over_their_figures() -> None:
    found = [result(Run("wheel", "draft"), None, 0)]
    row = first_row(surface_table(found, {}))
    assert [row[f"F1 {s}"] for s in ("0.25 %", "0.5 %", "1 %")] == ["0.700", "0.701", "0.702"]
    assert row["scan F1 0.5 %"] == "0.801"
    assert row["precision 0.5 %"] == "0.711"
    assert row["visible recall 0.5 %"] == "0.731"
    assert row["thin recall 0.5 %"] == "0.741"
    assert row["Chamfer %"] == "0.200"
    assert row["normals"] == "0.760"
    row = first_row(stage_table(found, {}))
    assert row["depth error, median %"] == "0.100"
    assert row["depth in 0.5 %"] == "0.620"
    assert row["vacancy offset, median %"] == "none found"
    assert row["its size, median %"] == "0.300"
    assert row["vacancy in 0.5 %"] == "0.650"
    assert row["mesh to truth, median %"] == "0.100"
    assert row["truth to mesh in 0.5 %"] == "0.721"
    assert row["texture's loss dB"] == "3.00"
    row = first_row(image_table(found))
    assert row["Gaussians, whole photo: PSNR dB"] == "28.00"
    assert row["Gaussians, on the surface: PSNR dB"] == "27.00"
    assert row["textured mesh, on the surface: PSNR dB"] == "24.00"
    assert row["SSIM of that"] == "0.8100"
    assert "LPIPS of that" not in row
    row = first_row(cost_table(found))
    assert (row["train s"], row["texture s"]) == ("60.0", "9.0")
    assert (row["whole command s"], row["peak memory GiB"]) == ("80", "3.00")
    row = first_row(mesh_table(results(full_plan())))
    assert row["legacy F1 0.5 %"] == "0.501"
    assert row["F1 0.5 %"] == "0.701"


def test_the_true_surface_stands_before_the_meshes() -> None:
    found = [result(Run("spot", "draft"), None, 0)]
    table = surface_table(found, {"spot": found[0].scores})
    check(table)
    assert [row[:2] for row in table.rows] == [("spot", "true surface"), ("spot", "draft")]


def test_thin_parts_are_shown_where_there_are_any() -> None:
    column = "thin recall 0.5 %"
    shown = first_row(surface_table([result(Run("wheel", "draft"), None, 0)], {}))
    hidden = first_row(surface_table([result(Run("spot", "draft"), None, 0)], {}))
    assert (shown[column], hidden[column]) == ("0.741", None)


def test_an_open_mesh_is_shown_as_such() -> None:
    closed = surface_table([result(Run("spot", "draft"), None, 0)], {})
    broken = surface_table([result(Run("spot", "draft"), None, 3)], {})
    assert (first_row(closed)["closed"], first_row(broken)["closed"]) == ("yes", "NO")


def test_a_texture_that_no_view_shows_has_no_figure() -> None:
    found = result(Run("spot", "draft"), None, 0)
    found.scores["texture"] = {"views": [], "left_out": 8}
    assert first_row(image_table([found]))["textured mesh, on the surface: PSNR dB"] is None
    assert first_row(stage_table([found], {}))["texture's loss dB"] is None


def test_spread_is_that_of_a_sample() -> None:
    assert mean_and_spread([1.0, 2.0, 3.0]) == "2.000 ± 1.000"
    assert mean_and_spread([1.0]) == "1.000"


def test_plots_show_all_scenes(tmp_path: Path) -> None:
    write_plots(results(full_plan()), 288, tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    words = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert set(MAIN_SCENES) <= set(words)
    assert words.count("standard") == 3 * len(MAIN_SCENES)
    assert "no data" not in words


def write_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reading: str = ""
) -> tuple[str, list[str]]:
    """Write a report of invented figures; return its text and the names of its pictures."""
    plan = quick_plan()
    folders = {}
    for run in plan.runs:
        folder = tmp_path / run.scene
        folder.mkdir(exist_ok=True)
        (folder / "scene.json").write_text('{"role": "test", "description": "a thing"}')
        folders[run.scene] = folder
    drawn: list[str] = []
    monkeypatch.setattr(document, "write_comparison", lambda *a: drawn.append(a[-1].name))
    if reading:
        (tmp_path / "reading.md").write_text(reading)
    facts = {
        "command": "the command", "date": "2026-01-02", "photos": plan.photos, "runs": tmp_path,
    }  # fmt: skip
    outcome = Outcome(folders, results(plan), POSES, {}, KERNELS)
    document.write_document(tmp_path, outcome, facts)
    return (tmp_path / "README.md").read_text(encoding="utf-8"), drawn


def test_the_document_names_machine_seed_and_roles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading = "2026-01-02\n\n## Reading\n\nSober words.\n"
    text, drawn = write_report(tmp_path, monkeypatch, reading)
    for words in ("the command", "2026-01-02", "2 threads", "Seed 0", "0123456789", "| test "):
        assert words in text
    assert "Sober words." in text
    assert "Written for" not in text
    assert "load average before a run: 0.2" in text
    assert drawn == [f"scene-{scene}.jpg" for scene in MAIN_SCENES]
    for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert name in drawn or (tmp_path / name).is_file(), name
    assert "nan" not in text.lower().split()


def test_an_older_reading_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text, _ = write_report(tmp_path, monkeypatch, "2025-12-31\n\n## Reading\n\nOld words.\n")
    assert "Written for the figures of 2025-12-31." in text


def test_a_plan_is_carried_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every run, variant, ceiling, pose and kernel is asked for once, with its own files."""
    plan = quick_plan()
    asked: list[tuple[str, ...]] = []

    def judged(module: str, arguments: list[str], path: Path, settings: Settings) -> dict[str, Any]:
        asked.append((module, *arguments))
        assert str(path) in arguments or str(path.parent) in arguments
        return {"seconds": 1.0, **result(plan.runs[0], None, 0).scores}

    monkeypatch.setattr(speed_vs_error, "ensure_scene", lambda name, **_: tmp_path / name)
    monkeypatch.setattr(speed_vs_error, "warm_up", lambda *_: None)
    monkeypatch.setattr(
        speed_vs_error, "run_wrap", lambda run, _scene, settings: settings.folder / run.identity
    )
    monkeypatch.setattr(
        speed_vs_error,
        "run_variant",
        lambda variant, base, *_: base / f"{variant.name}{variant.parameter}",
    )
    monkeypatch.setattr(
        speed_vs_error, "measured", lambda _: result(plan.runs[0], None, 0).measured
    )
    monkeypatch.setattr(speed_vs_error, "judged_by", judged)
    outcome = speed_vs_error.carry_out(plan, Settings(tmp_path, 1, False))
    variants = sum(len(run.variants) for run in plan.runs)
    assert len(outcome.results) == len(plan.runs) + variants
    scored = [a for a in asked if a[0] == "score"]
    assert sum("--stages" in a for a in scored) == len(plan.runs)
    assert sum("--mesh" not in a for a in scored) == len(MAIN_SCENES) == len(outcome.ceilings)
    assert set(outcome.poses) == set(outcome.kernels) == set(plan.pose_scenes)
    assert len(set(asked)) == len(asked)


def test_unknown_scenes_and_parts_without_a_folder_are_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        speed_vs_error.main(["--scenes", "sopt", "--out", "x"])
    assert "unknown scenes ['sopt']" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        speed_vs_error.main(["--scenes", "spot"])
    assert "--out" in capsys.readouterr().err
