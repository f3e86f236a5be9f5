# SPDX-License-Identifier: GPL-3.0-or-later
"""The ablation: its cells, its tables and its page, made from figures that the test invents."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from benchmarks import ablation as document
from benchmarks import ablation as tables
from benchmarks.ablation import (
    CELLS,
    CLONES,
    FIXED,
    OFF,
    ON,
    ORIENTED,
    PARTS,
    PLAIN,
    SCENES,
    SEEDS,
    Cell,
    cell_table,
    differences,
    fixed_options,
    part_table,
    plan,
    settings_table,
    write_plot,
)
from benchmarks.scenes.cache import ALL_KINDS
from benchmarks.study import Record, f1_middle, options, thin
from benchmarks.tables import Table
from gaussian_wrapping_addon.core.settings import MODEL_SELECTION
from tests.benchmarks.invented_records import invented

CASES = plan()
GAINS = {OFF: 0.0, ON: 0.04}, {PLAIN: 0.0, ORIENTED: 0.01, CLONES: -0.02}


def level(cell: Cell, seed: int) -> float:
    return 0.7 + GAINS[0][cell.multi_view] + GAINS[1][cell.wrapping] + 0.001 * seed


def measured(scenes: tuple[str, ...] = SCENES, seeds: tuple[int, ...] = SEEDS) -> dict[str, Record]:
    """Return invented records in which every part gains what :data:`GAINS` says."""
    cases = [(c, s, k) for k in seeds for s in scenes for c in CELLS]
    return {
        cell.case(scene, seed).identity: invented(cell.case(scene, seed), level(cell, seed))
        for cell, scene, seed in cases
    }


def rows(table: Table) -> list[dict[str, Any]]:
    return [dict(zip(table.header, row, strict=True)) for row in table.rows]


def test_the_plan_is_a_whole_factorial_seed_by_seed() -> None:
    assert len({case.identity for case in CASES}) == len(CASES) == 6 * len(SCENES) * len(SEEDS)
    assert set(SCENES) <= set(ALL_KINDS)
    first = CASES[: 6 * len(SCENES)]
    assert {case.seed for case in first} == {0}
    assert Counter(case.scene for case in first) == dict.fromkeys(SCENES, 6)
    assert {(c.multi_view, c.wrapping) for c in CELLS} == {
        (views, level) for views in (OFF, ON) for level in (PLAIN, ORIENTED, CLONES)
    }


def test_cells_differ_by_what_their_names_say_and_by_nothing_else() -> None:
    for cell in CELLS:
        given = options(cell.case("wheel", 0).arguments)
        assert {n: given[n] for n in options(FIXED)} == options(FIXED)
        assert given["--multi-view"] == cell.multi_view
        assert given["--wrapping"] == (OFF if cell.wrapping == PLAIN else ON)
        assert (int(given["--wrap-rounds"]) > 0) == (cell.wrapping == CLONES)
        assert set(given) == {*options(FIXED), "--multi-view", "--wrapping", "--wrap-rounds"}


def test_nothing_is_left_to_a_decision() -> None:
    for case in CASES[:6]:
        given = options(case.arguments)
        assert given["--dense-start"] == "off"  # and without one, poses are never refined
        for name in sorted({*MODEL_SELECTION} - {"refine_poses"}):
            assert given[f"--{name.replace('_', '-')}"] in ("on", "off"), name
        assert given["--holdout"] == "0"


def test_captions_say_the_arguments_of_the_runs(tmp_path: Path) -> None:
    text = document.write_document(tmp_path, measured(), CASES).read_text(encoding="utf-8")
    for name, value in options(FIXED).items():
        assert f"`{name} {value}`" in text
    assert "`--harmonics off`" in text
    # With other arguments the page says the others.
    words = {"off": "on", "1000": "777"}
    changed = [
        dataclasses.replace(c, arguments=tuple(words.get(word, word) for word in c.arguments))
        for c in CASES
    ]
    text = document.write_document(tmp_path, measured(), changed).read_text(encoding="utf-8")
    assert "`--harmonics on`" in text
    assert "`--iterations 777`" in text
    varied = rows(settings_table(CASES))
    for cell, row in zip(CELLS, varied, strict=True):
        given = options(cell.case("wheel", 0).arguments)
        shown = {n.strip("`"): v for n, v in row.items() if n.startswith("`")}
        assert shown == {n: given[n] for n in shown}
        assert set(shown) | set(fixed_options(CASES)) == set(given)


def test_parts_are_pairs_that_differ_by_one_option() -> None:
    for part in PARTS:
        for without, with_it in part.pairs:
            a, b = (options(c.case("spot", 1).arguments) for c in (without, with_it))
            changed = {n for n in a if a[n] != b[n]}
            assert len(changed) == 1, (part.name, changed)
    assert [len(part.pairs) for part in PARTS] == [3, 2, 2]


def test_differences_are_paired_by_scene_and_seed() -> None:
    records = measured()
    gains = (0.04, 0.01, -0.03)
    for part, gain in zip(PARTS, gains, strict=True):
        found = differences(records, part, f1_middle, "fence")
        assert len(found) == len(part.pairs) * len(SEEDS)
        assert found == pytest.approx([gain] * len(found))
        assert len(differences(records, part, f1_middle)) == len(found) * len(SCENES)
    del records[Cell(ON, CLONES).case("fence", 1).identity]
    assert len(differences(records, PARTS[0], f1_middle, "fence")) == 8
    assert len(differences(records, PARTS[2], f1_middle, "fence")) == 5


def test_only_clear_differences_are_judged() -> None:
    found = rows(part_table(measured(("wheel",))))
    assert [r["added"] for r in found if r["scene"] == "wheel"] == [p.name for p in PARTS]
    views, oriented, clones = found[:3]
    assert (views["F1 0.5 %"], views["pairs"]) == ("**+0.040 ± 0.000 better**", 9)
    assert (clones["F1 0.5 %"], clones["pairs"]) == ("**-0.030 ± 0.000 worse**", 6)
    # The normal error falls where the cosine rises: less is better.
    assert oriented["normal error"] == "**-0.010 ± 0.000 better**"
    alone = rows(part_table(measured(("wheel",), (0,))))
    assert alone[0]["F1 0.5 %"] == "+0.040 ± 0.000"


def test_cells_show_mean_and_spread_of_their_seeds() -> None:
    found = rows(cell_table(measured(("wheel",))))
    assert len(found) == 6
    assert (found[0]["seeds"], found[0]["F1 0.5 %"]) == (3, "0.702 ± 0.001")
    assert found[0]["thin recall 0.5 %"] == "0.742 ± 0.001"
    assert found[0]["normal error"] == "0.239 ± 0.001"
    assert found[0]["Gaussians"] == "7000 ± 0"
    assert "MBR dB" not in found[0]
    one = rows(cell_table(measured(("wheel",), (0,))))
    assert one[0]["F1 0.5 %"] == "0.701"


def test_figures_that_were_not_measured_are_left_out() -> None:
    records = measured(("spot",), (0,))
    for record in records.values():
        record.scores["surface"]["uniform"]["thin_count"] = 5
    assert all(thin(r) is None for r in records.values())
    assert "thin recall 0.5 %" not in cell_table(records).header
    first = next(iter(records))
    records[first] = invented(records[first].case, 0.7, mbr={"psnr": 21.5})
    found = rows(cell_table(records))
    assert [r["MBR dB"] for r in found] == ["21.50", None, None, None, None, None]
    assert any("mesh-based rendering" in note for note in cell_table(records).notes)


def test_an_open_mesh_is_shown_as_such() -> None:
    records = measured(("wheel",), (0, 1))
    name = CELLS[0].case("wheel", 1).identity
    records[name].mesh["closed"] = False
    assert [r["closed"] for r in rows(cell_table(records))][:2] == ["NO (1 of 2)", "yes"]


def test_the_page_of_few_runs_says_so(tmp_path: Path) -> None:
    records = dict(list(measured().items())[:4])
    path = document.write_document(tmp_path, records, CASES)
    text = path.read_text(encoding="utf-8")
    for words in (
        "86 of 90 planned runs are not made yet",
        "The orientation loss does not gain",
        "six cells, not eight",
    ):
        assert words.replace("\n", " ") in text.replace("\n", " ")
    assert "nan" not in text.lower().split()
    for table in (tables.cell_table(records), tables.part_table(records)):
        lines = [line for line in table.markdown().splitlines() if line.startswith("|")]
        assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {len(table.header) + 1}
    words = [t.text for t in ElementTree.parse(tmp_path / document.PLOT).getroot().iter()]
    assert "wheel" in words
    assert not {"spot", "single runs"} & set(words)


def test_the_plot_joins_means_and_shows_every_run(tmp_path: Path) -> None:
    write_plot(measured(("wheel", "spot")), tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    words = Counter(text.text for text in root.iter("{http://www.w3.org/2000/svg}text"))
    assert (words["wheel"], words["spot"], words["single runs"]) == (1, 1, 2)
    assert words["with multi-view terms"] == words["without multi-view terms"] == 2
    assert words["+ clones"] == 4
    dots = len(list(root.iter("{http://www.w3.org/2000/svg}circle")))
    assert dots == 2 * (6 + 6 * len(SEEDS) + 3)  # means, runs, legend
