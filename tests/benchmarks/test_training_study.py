# SPDX-License-Identifier: GPL-3.0-or-later
"""The training study, made from figures that the test invents."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from benchmarks import training
from benchmarks.scenes import ALL_KINDS
from benchmarks.speed_error.plan import Photos
from benchmarks.speed_error.results import Result
from benchmarks.speed_error.runs import Settings
from benchmarks.tables import Table
from benchmarks.training_study import carry_out, document
from benchmarks.training_study.acceptance import acceptance_plan, checks
from benchmarks.training_study.carry_out import Measured, Outcome, held_out_scores
from benchmarks.training_study.figures import write_plots
from benchmarks.training_study.plan import (
    AUTO,
    BASELINE,
    MULTI_VIEW,
    ON,
    ORIENTATION,
    ROWS,
    WITH,
    WRAPPING,
    Case,
    Plan,
    full_plan,
    quick_plan,
)
from benchmarks.training_study.tables import (
    ablation_table,
    decision_table,
    needs_table,
    pivot_table,
    preset_table,
    real_table,
)
from gaussian_wrapping_addon.core.errors import WorkerError

PLANS = {"full": full_plan(), "quick": quick_plan(), "acceptance": acceptance_plan()}
LEVELS = {AUTO: 0.96, ON: 0.965, BASELINE: 0.6, MULTI_VIEW: 0.7, ORIENTATION: 0.8, WRAPPING: 0.9}
CHOSEN = {"spot": ("degree 0", "off"), "glossy": ("degree 1", "off")}


def judged(base: float, thin: int) -> dict[str, Any]:
    """Return scores of one protocol; each name has figures of its own."""
    names = ("f1", "precision", "recall", "visible_recall", "thin_recall")
    shares = {n: [base + 0.01 * k + 0.001 * i for i in range(3)] for k, n in enumerate(names)}
    return {**shares, "thin_count": thin, "truth_count": 1000, "visible_count": 900}


def measured(case: Case) -> Measured:
    """Return invented figures of a case."""
    run = case.run
    harmonics, exposure = CHOSEN.get(run.scene, ("degree 2", "on"))
    needs = [
        {"name": "harmonics", "setting": "auto", "chosen": harmonics, "evidence": "a | b"},
        {"name": "exposure", "setting": "auto", "chosen": exposure, "evidence": "2 of 3"},
    ]
    train_s = 40.0 if run.name == AUTO else 80.0
    report = {
        "stages": [
                {"name": "train", "seconds": train_s, "processor_seconds": train_s},
                {"name": "mesh-box", "seconds": 9.0},
            ],
        "peak_memory_bytes": {"worker": 3 * 2**30, "helper": 2**30},
        "machine": {"threads": 2},
        "settings": {"training": {"max_image_px": 640}},
        "training": {
            "gaussians": 7000, "iterations": 1000, "seconds_training": 25.0, "decisions": needs,
            "held_out_psnr": 27.25, "held_out_ssim": 0.93,
        },
        "regions": {"box": {"statistics": {"closed": True, "components": 2}}},
    }  # fmt: skip
    level = LEVELS.get(run.name, 0.8 if run.name == WITH else 0.7)
    scores: dict[str, Any] = held_out_scores(report)
    if case.photos is not None:
        thin = 500 if run.scene in ("wheel", "fence") else 5
        scores = {
            "gaussians": {"count": 7000, "psnr": 30.0 + 4 * level, "ssim": 0.9},
            "surface": {"uniform": judged(level, thin), "scan": judged(level - 0.3, thin)},
            "seconds_scoring": 3.0,
        }
    values = {"wall_s": 10 + train_s, "report": report, "region": "box", "code": "0123456789",
              "load_before": 0.5}  # fmt: skip
    return Measured(case, Result(run, None, values, scores), Path("run"), Path("scene"))


def first_row(table: Table) -> dict[str, Any]:
    return dict(zip(table.header, table.rows[0], strict=True))


def all_of(name: str) -> list[Measured]:
    return [measured(case) for case in PLANS[name].cases]


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_runs_have_folders_of_their_own_and_known_scenes(plan: Plan) -> None:
    places = Counter((case.folder, case.run.identity) for case in plan.cases)
    assert max(places.values()) == 1
    assert all(case.photos is None or case.run.scene in ALL_KINDS for case in plan.cases)
    scenes = {case.run.scene for case in plan.cases if case.run.name == WRAPPING}
    assert set(plan.pivot_scenes) <= scenes


def test_each_row_of_the_ablation_changes_one_setting_of_the_row_before() -> None:
    def settings(words: tuple[str, ...]) -> dict[str, str]:
        return dict(zip(words[::2], words[1::2], strict=True))

    rows = [settings(words) for words in ROWS.values()]
    rows[3]["--wrap-rounds"] = "the preset's"
    for row in rows[:2]:
        row["--wrap-rounds"] = "0"  # without wrapping there are no rounds
    changes = [
        {name for name in after if after[name] != before[name]}
        for before, after in itertools.pairwise(rows)
    ]
    assert changes == [{"--multi-view"}, {"--wrapping"}, {"--wrap-rounds"}]


def test_tables_have_a_row_for_each_run_of_their_part() -> None:
    runs = all_of("full")
    table = ablation_table(runs)
    counts = Counter(row[0] for row in table.rows)
    assert counts == {"wheel": 4, "spot": 4, "fence": 4, "cup_inside": 4, "room": 2}
    assert [row[0] for row in real_table(runs).rows] == ["fox"] * 4 + ["flowerpot"] * 4
    assert [row[1] for row in preset_table(runs).rows] == ["draft", "standard", "fine"]
    assert [row[0] for row in needs_table(runs).rows] == ["spot", "glossy"]
    assert {row[4] for row in decision_table(runs).rows} == {"a / b", "2 of 3"}


def test_headings_stand_over_their_figures() -> None:
    row = first_row(ablation_table(all_of("full")))
    assert (row["scene"], row["losses"]) == ("wheel", "colour, depth-normal")
    assert (row["command s"], row["training s"], row["ms an iteration"]) == ("90", "80", "25")
    assert (row["peak GiB"], row["Gaussians"], row["closed"]) == ("3.00", 7000, "yes")
    assert (row["PSNR dB"], row["SSIM"]) == ("32.40", "0.9000")
    assert [row[f"F1 {s}"] for s in ("0.25 %", "0.5 %", "1 %")] == ["0.600", "0.601", "0.602"]
    assert (row["seen F1 0.5 %"], row["thin recall 0.5 %"]) == ("0.301", "0.641")
    row = first_row(needs_table(all_of("full")))
    assert (row["decided s"], row["everything s"], row["time saved %"]) == ("50", "90", "44")
    assert row["processor saved, training %"] == "50"
    assert (row["F1 0.5 %"], row["F1 lost"], row["PSNR lost dB"]) == ("0.961", "0.005", "0.02")
    assert row["decided"] == "harmonics degree 0, exposure off"
    numbers = {"points": 10, "faces": 4, "seconds": 1.25, "surface": judged(0.5, 500)}
    row = first_row(pivot_table({"wheel": {"2": numbers, "9": numbers}}))
    assert (row["pivots"], row["F1 0.5 %"], row["recall 0.5 %"]) == (2, "0.501", "0.521")
    assert (row["precision 0.5 %"], row["thin recall 0.5 %"]) == ("0.511", "0.541")


def test_targets_are_judged_as_the_figures_say() -> None:
    found = {check.what: check for check in checks(all_of("acceptance"))}
    by_word = {
        "spokes": True,  # 1.001 of 0.9
        "wheel, draft, 640 px: F1 at 0.5 %, wrapping": True,  # 0.801 against 0.701
        "cup_inside, standard, 640 px: F1 at 0.5 %": True,
        "fox, standard (trained at up to 640 px): PSNR": True,
        "fox, standard (trained at up to 640 px): peak memory": True,
        "fox, fine (trained at up to 640 px): time": None,
        "everything on, F1 at 0.5 % lost": True,
        "everything on, processor time of training saved": True,
        "glossy: harmonics": True,
        "spot: harmonics": True,
        "spot: exposure": True,
        "spot_exposure: exposure": True,
    }
    for words, met in by_word.items():
        (check,) = [c for what, c in found.items() if words in what and "cameras see" not in what]
        assert check.met is met, check


def test_missed_targets_are_told() -> None:
    runs = all_of("acceptance")
    for m in runs:
        surfaces = m.result.scores.get("surface", {})
        for name in ("f1", "thin_recall"):
            if surfaces:
                surfaces["uniform"][name] = [0.1, 0.2, 0.3]
        if m.case.run.name == ON and surfaces:
            surfaces["uniform"]["f1"] = [0.2, 0.3, 0.4]
        m.result.measured["wall_s"] = 2000.0
        m.result.report["stages"][0]["processor_seconds"] = 2000.0
        m.result.report["training"]["held_out_psnr"] = 20.0
        m.result.scores["gaussians"]["psnr"] = 31.0 if m.case.run.name == ON else 20.0
        m.result.report["peak_memory_bytes"]["worker"] = 5 * 2**30
        m.result.report["training"]["decisions"].clear()
    targets = [c for c in checks(runs) if c.target]
    assert len(targets) == 18
    assert {c.met for c in targets} == {False}


def test_a_missing_run_leaves_out_its_checks_only() -> None:
    runs = [m for m in all_of("acceptance") if m.case.run.name not in (WITH, ON)]
    words = [check.what for check in checks(runs)]
    assert words
    assert not any("wrapping on against off" in w or "everything on" in w for w in words)


def test_plots_show_every_scene(tmp_path: Path) -> None:
    write_plots(all_of("full"), tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    words = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"wheel", "spot", "fence", "cup_inside", "fox", "flowerpot"} <= set(words)
    assert {"base", "+ views", "+ L_N", "+ wrapping", "standard"} <= set(words)


@pytest.mark.parametrize("page", ["training", "training-acceptance"])
def test_pages_hold_tables_pictures_and_reading(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[str] = []
    monkeypatch.setattr(document, "write_comparison", lambda *a: drawn.append(a[-1].name))
    (tmp_path / f"{page}-reading.md").write_text("2026-01-02\n\n## Reading\n\nSober words.\n")
    full = page == "training"
    runs = all_of("full" if full else "acceptance")
    outcome = Outcome(runs, {}, [("room-draft", "not begun within 40 minutes")], False)
    write = document.write_study if full else document.write_acceptance
    path = write(tmp_path, outcome, {"command": "the command", "date": "2026-01-02"})
    text = path.read_text(encoding="utf-8")
    for words in ("the command", "2026-01-02", "2 threads", "0123456789", "Sober words.",
                  "not begun within 40 minutes", "40 photos of"):  # fmt: skip
        assert words in text
    assert set(re.findall(r"!\[[^]]*\]\(([^)]+\.jpg)\)", text)) == set(drawn)
    assert set(drawn) >= {f"{page}-wheel.jpg", f"{page}-fence.jpg"}
    assert "nan" not in text.lower().split()


def test_time_missing_photos_and_failures_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One failed run and one missing set leave the others; after the limit nothing is begun."""
    cases = PLANS["quick"].cases
    failing = cases[0].run.identity

    def wrap(run: Any, _scene: Path, settings: Settings) -> Path:
        if run.identity == failing:
            raise WorkerError("A run failed with exit code 4: x\nerror: the disk is full\n")
        return settings.folder / run.identity

    monkeypatch.setattr(carry_out, "ensure_scene", lambda name, **_: tmp_path / name)
    monkeypatch.setattr(carry_out, "warm_up", lambda *_: None)
    monkeypatch.setattr(carry_out, "run_wrap", wrap)
    monkeypatch.setattr(carry_out, "measured", lambda _: measured(cases[0]).result.measured)
    monkeypatch.setattr(carry_out, "judged_by", lambda *_: measured(cases[0]).result.scores)
    settings = Settings(tmp_path, 1, False)
    outcome = carry_out.carry_out(PLANS["quick"], settings, None)
    reasons = dict(outcome.missing)
    assert outcome.failed
    assert any("disk is full" in reason for reason in reasons.values())
    assert sum("--data" in reason for reason in reasons.values()) == 4
    assert len(outcome.runs) == len(cases) - 5
    assert set(outcome.pivots) == {"wheel"}
    only = carry_out.carry_out(PLANS["quick"], settings, None, ["on"])
    assert [m.case.run.name for m in only.runs] == [ON]
    assert not only.failed
    late = Plan(cases, (), -1.0)
    none = carry_out.carry_out(late, settings, None)
    assert not none.runs
    assert len(none.missing) == len(cases)


def test_unknown_words_and_parts_without_a_folder_are_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        training.main(["--only", "sopt", "--out", "x"])
    assert "sopt" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        training.main(["--only", "wheel"])
    assert "--out" in capsys.readouterr().err


def test_folders_of_photos_have_names_of_their_own() -> None:
    case = PLANS["full"].cases[0]
    assert case.photos == Photos(40, 288, 216)
    assert case.folder == "40x288x216"
