# SPDX-License-Identifier: GPL-3.0-or-later
"""The meshing study: its plan, targets and page, from figures that the test invents."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from benchmarks import meshing
from benchmarks import meshing_runs as carry_out
from benchmarks.meshing import write_document
from benchmarks.meshing_runs import (
    ADAPTIVE,
    FUSION,
    LARGE_POINTS,
    METHODS,
    PAM,
    SPACING_SCENES,
    TETRAHEDRA,
    UNIFORM,
    Made,
    Method,
    Outcome,
    Plan,
    Subject,
    full_plan,
    quick_plan,
)
from benchmarks.meshing_tables import (
    checks,
    cost_table,
    isosurface_table,
    solid_table,
    truth_table,
    write_plots,
)
from benchmarks.provenance import code_of_tree
from benchmarks.runs import Settings
from benchmarks.scenes.cache import ALL_KINDS
from benchmarks.tables import Table
from gaussian_wrapping_addon.core.errors import WorkerError

PLANS = {"full": full_plan(), "quick": quick_plan()}
EULER = {"spot": 2, "wheel": -82, "fence": -56}
VACANCY = {
    "points": 10**6, "cameras": 50, "gaussians": 50_000, "threads": 2, "seconds": 9.0,
    "prepare_cpu_s": 1.0, "values_cpu_s": 15.0, "error_max": 1e-6, "same_side_share": 1.0,
}  # fmt: skip


def made(subject: Subject, method: Method) -> Made:
    """Return invented figures: adaptive meshes need a quarter of the vertices of uniform ones."""
    vertices = {TETRAHEDRA: 5000 * method.size, FUSION: method.size**2}.get(
        method.name, method.size
    )
    error = {ADAPTIVE: 2.5, UNIFORM: 10.0}.get(method.name, 20.0) / vertices
    pam = method.name in PAM
    level = {f"level_error_{n}": v for n, v in (("median", 1e-4), ("p95", 1e-3), ("p99", 0.01))}
    distance = {
        "mean": error, "p99": 4 * error, "max": 9 * error, "reference_mean": 1.5 * error,
        "reference_p99": 5 * error, "reference_max": 8 * error, "hausdorff": 9 * error,
    }  # fmt: skip
    euler = EULER.get(subject.name, 2)
    defects = ["edges have one face only: 7"] if method.name == FUSION else []
    check = {"good": not defects, "euler": euler, "part_count": 1, "defects": defects}
    scores: dict[str, Any] = {
        "level": level, "distance": distance, "check": check, "seconds_scoring": 2.0,
        "trimesh_good": method.name != FUSION, "reference_vertices": subject.reference_points,
    }  # fmt: skip
    if subject.photos is not None:
        uniform = {"f1": [0.7, 0.8, 0.9], "precision": [0.71, 0.81, 0.91], "truth_count": 1000,
                   "recall": [0.72, 0.82, 0.92], "thin_recall": [0.73, 0.83, 0.93],
                   "thin_count": 500}  # fmt: skip
        scores["truth"] = {"uniform": uniform, "diagonal": 2.0, "euler": euler}
    figures = {
        "vertices": vertices, "faces": 2 * vertices, "wall_s": 1e-4 * vertices + 5.0,
        "cpu_s": 1.5e-4 * vertices + 5.0, "peak_bytes": 1_500_000_000, "before_bytes": 300_000_000,
        "provenance": dict(level) if pam else {}, "code": "0123456789", "load_before": 0.5,
    }  # fmt: skip
    return Made(subject, method, figures, scores)


def outcome_of(plan: Plan) -> Outcome:
    run = {
        "wall_s": 90.0, "region": "box", "code": "abc0123456",
        "report": {
            "training": {"gaussians": 7000, "iterations": 1500, "held_out_psnr": 27.25},
            "regions": {"box": {"check": {"good": True}, "statistics": {"faces": 40_000}}},
        },
    }  # fmt: skip
    meshes = [made(s, m) for s in plan.subjects for m in s.methods]
    missing = [("banana, tsdf-300", "not begun within 40 minutes")]
    return Outcome(meshes, {s.name: run for s in plan.subjects}, VACANCY, missing, False)


def changed(outcome: Outcome, figures: dict[str, Any], scores: dict[str, Any]) -> Outcome:
    meshes = [
        dataclasses.replace(m, figures=m.figures | figures, scores=m.scores | scores)
        for m in outcome.made
    ]
    return dataclasses.replace(outcome, made=meshes)


def first_row(table: Table) -> dict[str, Any]:
    return dict(zip(table.header, table.rows[0], strict=True))


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_plan_has_every_method_once_for_each_scene(plan: Plan) -> None:
    for subject in plan.subjects:
        assert len(set(subject.methods)) == len(subject.methods)
        assert {m.name for m in subject.methods} == set(METHODS)
        assert {m.size for m in subject.methods if m.name == TETRAHEDRA} == {2, 9}
        sizes = {n: {m.size for m in subject.methods if m.name == n} for n in PAM}
        assert sizes[UNIFORM] == sizes[ADAPTIVE]
        if subject.photos is not None:
            assert subject.name in ALL_KINDS
        if subject.name in SPACING_SCENES:
            # A doubled resolution is among the uniform meshes.
            assert any(4 * size in sizes[UNIFORM] for size in sizes[UNIFORM])
    places = [(s.folder, s.run.identity) for s in plan.subjects]
    assert len(set(places)) == len(places)


def test_full_plan_has_the_scenes_of_the_targets() -> None:
    names = {s.name: s for s in PLANS["full"].subjects}
    rendered = {"spot", "wheel", "torus", "fence", "room", "cup_inside"}
    assert set(names) == rendered | {"fox", "flowerpot", "banana"}
    assert {m.name for m in names["fox"].methods if m.size == LARGE_POINTS} == set(PAM)
    assert PLANS["full"].words >= {"vacancy", "fox", "tsdf", "uniform-6000"}


def test_targets_are_met_by_figures_that_meet_them() -> None:
    found = [c for c in checks(outcome_of(PLANS["full"])) if c.target]
    assert {c.met for c in found} == {True}
    words = " ".join(c.what for c in found)
    for part in ("meshes of the jobs", "marching tetrahedra: closed", "PAM adaptive: closed",
                 "vertices put on the isosurface", "all vertices", "spot: vertices of adaptive",
                 "wheel: vertices of adaptive", "room: vertices of adaptive",
                 "vacancy of 1000000 points", "fox, PAM adaptive, 200000 vertices: time",
                 "peak memory", "spot: time at twice the resolution", "fence: Euler"):  # fmt: skip
        assert part in words
    (ratio,) = [c for c in found if c.what.startswith("spot: vertices") and "to the" in c.what]
    assert ratio.figure == "0.25, 0.25, 0.25"
    (grown,) = [c for c in found if c.what.startswith("spot: time at twice")]
    assert (grown.target[:18], grown.figure[:4]) == ("at most 4.00 times", "1.32")


def test_fusion_that_leaves_holes_misses_no_target() -> None:
    (check,) = [c for c in checks(outcome_of(PLANS["quick"])) if "TSDF" in c.what]
    assert (check.target, check.met) == ("", None)
    assert check.figure == "0 of 1; not: spot 100"


def test_missed_targets_are_told() -> None:
    outcome = outcome_of(PLANS["full"])
    bad = {f"level_error_{n}": 0.3 for n in ("median", "p95", "p99")}
    broken = {"good": False, "euler": 0, "part_count": 3, "defects": ["edges have one face: 2"]}
    worse = changed(
        outcome,
        {"wall_s": 500.0, "peak_bytes": 5e9, "provenance": bad},
        {"level": bad, "check": broken},
    )
    for m in worse.made:
        if m.method.name == ADAPTIVE:
            for name in ("mean", "reference_mean", "p99"):
                m.scores["distance"][name] = 10.0 / m.figures["vertices"]  # as uniform ones
        if m.method.name == UNIFORM:
            m.figures["wall_s"] = float(m.figures["vertices"]) ** 1.2
    for run in worse.trainings.values():
        run["report"]["regions"]["box"]["check"]["good"] = False
    worse = dataclasses.replace(worse, vacancy={**VACANCY, "seconds": 13.0})
    found = [c for c in checks(worse) if c.target]
    assert len(found) == len([c for c in checks(outcome_of(PLANS["full"])) if c.target])
    assert {c.what for c in found if c.met} == set()


def test_a_mesh_of_too_few_vertices_is_not_the_large_one() -> None:
    outcome = outcome_of(PLANS["full"])
    for m in outcome.made:
        if m.method.size == LARGE_POINTS:
            m.figures["vertices"] = 90_000
    large = [c for c in checks(outcome) if c.what.startswith("fox, PAM")]
    assert len(large) == 4
    assert {c.met for c in large} == {False}
    assert all("fewer vertices" in c.figure for c in large)


def test_a_missing_mesh_leaves_out_its_checks_only() -> None:
    outcome = outcome_of(PLANS["full"])
    kept = [m for m in outcome.made if m.method.name != ADAPTIVE]
    found = checks(Outcome(kept, {}, None, [], False))
    assert found
    words = " ".join(c.what for c in found)
    assert "adaptive" not in words
    assert "vacancy of" not in words
    assert not checks(Outcome([], {}, None, [], False))


def test_headings_stand_over_their_figures() -> None:
    meshes = outcome_of(PLANS["full"]).made
    row = first_row(cost_table(meshes))
    assert (row["scene"], row["method"], row["size"]) == ("spot", "marching tetrahedra", "2 pivots")
    assert (row["vertices"], row["faces"], row["s"], row["processor s"]) == (
        10_000, 20_000, "6.0", "6.5",
    )  # fmt: skip
    assert (row["peak GB"], row["GB before"]) == ("1.50", "0.30")
    row = first_row(isosurface_table(meshes))
    levels = [row[rf"\|v - 0.5\| {name}"] for name in ("median", "p95", "p99")]
    assert levels == ["1.0e-04", "1.0e-03", "1.0e-02"]
    shown = [row[n] for n in ("mean %", "99 % of it", "mean from it %", "Hausdorff %")]
    assert shown == ["0.2000", "0.8000", "0.3000", "1.8000"]
    table = isosurface_table(meshes)
    assert "with 192000 points" in table.notes[0]
    rows = [dict(zip(table.header, r, strict=True)) for r in table.rows]
    unjudged = {(r["scene"], r["size"]) for r in rows if r["mean %"] is None}
    assert unjudged == {("fox", "200000 points")}
    row = first_row(truth_table(meshes))
    assert [row[f"F1 {s}"] for s in ("0.25 %", "0.5 %", "1 %")] == ["0.700", "0.800", "0.900"]
    assert [row[f"{n} 0.5 %"] for n in ("precision", "recall", "thin recall")] == [
        "0.810", "0.820", "0.830",
    ]  # fmt: skip
    rows = [dict(zip(t.header, r, strict=True)) for t in [solid_table(meshes)] for r in t.rows]
    fused = [r for r in rows if r["method"] == "TSDF fusion"]
    assert {r["closed"] for r in fused} == {"NO"}
    assert "edges have one face only: 7; trimesh" in fused[0]["defects"]
    fence = [r for r in rows if r["scene"] == "fence"]
    assert {(r["Euler"], r["truth's"]) for r in fence} == {(-56, "-56")}
    assert {r["truth's"] for r in rows if r["scene"] == "fox"} == {""}


def test_plots_show_every_method(tmp_path: Path) -> None:
    write_plots(outcome_of(PLANS["full"]).made, tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    words = {text.text for text in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"marching tetrahedra", "PAM uniform", "PAM adaptive", "TSDF fusion"} <= words
    assert {"spot: time against isosurface", "room: time against truth"} <= words
    write_plots([], tmp_path / "none.svg")
    assert not (tmp_path / "none.svg").exists()


FACTS = {
    "command": "the command", "date": "2026-01-02", "threads": 2, "machine": "a processor",
    "versions": "Python 3",
}  # fmt: skip


def test_page_holds_targets_plots_and_tables(tmp_path: Path) -> None:
    text = write_document(tmp_path, outcome_of(PLANS["full"]), FACTS).read_text(encoding="utf-8")
    for words in ("the command", "2026-01-02", "2 threads", "0123456789", "abc0123456",
                  "a processor", "### Targets", "![Plots](meshing.svg)", "40 photos of",
                  "Real photos", "not begun within 40 minutes", "### Trainings",
                  "27.25"):  # fmt: skip
        assert words in text
    assert "nan" not in text.lower().split()
    assert (tmp_path / "meshing.svg").is_file()


def test_page_of_a_part_alone(tmp_path: Path) -> None:
    text = write_document(tmp_path, Outcome([], {}, VACANCY, [], False), FACTS).read_text()
    assert "vacancy of 1000000 points" in text
    assert "![Plots]" not in text


def test_the_page_can_be_written_again_from_the_record(tmp_path: Path) -> None:
    plan = PLANS["full"]
    outcome = outcome_of(plan)
    meshing.keep(tmp_path / "a.json", outcome, FACTS, code_of_tree())
    found, facts = meshing.kept(tmp_path / "a.json", plan)
    assert (found.made, found.trainings, found.vacancy) == (
        outcome.made, outcome.trainings, outcome.vacancy,
    )  # fmt: skip
    assert found.missing == outcome.missing
    assert (facts["command"], facts["threads"]) == ("the command", 2)


def test_time_missing_photos_and_failures_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A failed method and missing sets leave the others; after the limit nothing is begun."""
    plan = PLANS["full"]
    example = outcome_of(plan)
    rendered = [subject for subject in plan.subjects if subject.photos is not None]
    fusions = sum(m.name == FUSION for subject in rendered for m in subject.methods)
    meshes = sum(len(subject.methods) for subject in rendered) - fusions
    asked: list[str] = []

    def judged_by(module: str, arguments: list[str], path: Path, _: Settings) -> dict[str, Any]:
        asked.append(module.rsplit(".", 1)[1])
        if module.endswith("one_mesh"):
            (path.parent).mkdir(parents=True, exist_ok=True)
            if arguments[4] == FUSION:
                raise WorkerError("failed: x\nResourceError: Open3D is missing\n")
            return example.made[0].figures
        return VACANCY if module.endswith("vacancy_scale") else example.made[0].scores

    trained = itertools.count()
    monkeypatch.setattr(carry_out, "judged_by", judged_by)
    monkeypatch.setattr(carry_out, "ensure_scene", lambda name, **_: tmp_path / name)
    monkeypatch.setattr(
        carry_out, "run_wrap",
        lambda run, _s, settings: (next(trained), settings.folder / run.identity)[1],
    )  # fmt: skip
    monkeypatch.setattr(carry_out, "measured", lambda _: example.trainings["spot"])
    settings = Settings(tmp_path, 1, False)
    outcome = carry_out.carry_out(plan, settings, None)
    reasons = dict(outcome.missing)
    assert outcome.failed
    assert sum("Open3D is missing" in reason for reason in reasons.values()) == fusions
    assert sum("--data" in reason for reason in reasons.values()) == 3
    assert len(outcome.made) == meshes
    assert next(trained) == len(rendered)
    assert asked.count("vacancy_scale") == 1
    # Each method once to compile, a reference a scene, and the meshes themselves.
    assert asked.count("meshing_judge") == meshes
    only = carry_out.carry_out(plan, settings, None, ["uniform-6000"])
    assert {(m.method.name, m.method.size) for m in only.made} == {(UNIFORM, 6000)}
    assert len(only.made) == len(SPACING_SCENES)
    assert not only.failed
    none = carry_out.carry_out(dataclasses.replace(plan, minutes=-1.0), settings, None)
    assert not none.made
    assert none.vacancy is None
    assert len(none.missing) == 1 + sum(len(s.methods) for s in plan.subjects)


def test_unknown_words_and_parts_without_a_folder_are_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        meshing.main(["--only", "sopt", "--out", "x"])
    assert "sopt" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        meshing.main(["--only", "wheel"])
    assert "--out" in capsys.readouterr().err
