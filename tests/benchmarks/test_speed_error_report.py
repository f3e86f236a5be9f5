# SPDX-License-Identifier: GPL-3.0-or-later
"""The report on speed against error, made from figures that the test invents."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from benchmarks import speed_vs_error
from benchmarks import speed_vs_error as document
from benchmarks.alpha_shape import alpha_shape
from benchmarks.runs import PRESETS
from benchmarks.scenes.cache import ALL_KINDS
from benchmarks.speed_vs_error import (
    ALPHA,
    LABELS,
    MESHED_PRESETS,
    MESHERS,
    NINE,
    SCENES,
    alpha_case,
    mesher_case,
    mesher_table,
    preset_case,
    preset_table,
    spent_s,
    study_plan,
    write_plot,
)
from benchmarks.study import Case, Record, options
from benchmarks.tables import Table
from tests.benchmarks.invented_records import invented

CASES = study_plan()


def trivial(scene: str) -> Record:
    """Return an invented record of an alpha shape, which has no Gaussians."""
    made = invented(alpha_case(scene), 0.4, load_before=None, memory_gib=None)
    made.mesh.update(closed=None, components=None)
    made.processor_s.clear()
    made.processor_s["mesh"] = 0.25
    return Record(**{**vars(made), "scores": {"surface": made.scores["surface"]}})


def all_records() -> dict[str, Record]:
    return {c.identity: trivial(c.scene) if c.name == ALPHA else invented(c) for c in CASES}


def rows(table: Table) -> list[dict[str, Any]]:
    return [dict(zip(table.header, row, strict=True)) for row in table.rows]


def check(table: Table) -> None:
    """Every row has as many cells as the header, in the rendered table as well."""
    assert table.rows
    assert len(set(table.header)) == len(table.header)
    lines = [line for line in table.markdown().splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {len(table.header) + 1}


def test_the_plan_covers_what_the_report_promises() -> None:
    assert len({case.identity for case in CASES}) == len(CASES)
    assert set(SCENES) <= set(ALL_KINDS)
    plain = {(c.scene, c.preset) for c in CASES if not c.base and c.preset}
    assert plain == {(s, p) for s in SCENES for p in PRESETS}
    assert Counter(c.base for c in CASES if c.base) == {
        preset_case(s, p).identity: len(MESHERS) for s in SCENES for p in MESHED_PRESETS
    }
    assert [c.scene for c in CASES if c.name == ALPHA] == list(SCENES)


def test_presets_are_as_they_are() -> None:
    assert all(preset_case(s, p).arguments == () for s in SCENES for p in PRESETS)


def test_a_mesh_is_made_after_its_training() -> None:
    made: set[str] = set()
    for case in CASES:
        assert not case.base or case.base in made
        made.add(case.identity)


def test_meshers_are_given_as_they_are_called() -> None:
    given = {m: options(mesher_case("spot", "draft", m).arguments) for m in MESHERS}
    assert given["uniform"]["--spacing"] == "uniform"
    for name, count in (("pivots2", "2"), ("pivots9", "9")):
        assert (given[name]["--method"], given[name]["--pivots"]) == ("pivots", count)
        assert given[name]["--pivot-samples"] == "none"
        assert f"{count} pivots" in LABELS[name]


def test_presets_stand_below_the_trivial_surface() -> None:
    table = preset_table(all_records())
    check(table)
    found = rows(table)
    assert [(r["scene"], r["preset"]) for r in found] == [
        (s, p) for s in SCENES for p in ("alpha shape", *PRESETS)
    ]
    assert found[0]["processor s"] == "0.2"
    assert (found[0]["training"], found[0]["test views dB"], found[0]["closed"]) == (None,) * 3


def test_headings_stand_over_their_figures() -> None:
    found = rows(preset_table({c.identity: invented(c) for c in [preset_case("wheel", "draft")]}))
    assert len(found) == 1
    row = found[0]
    assert (row["processor s"], row["training"], row["mesh"], row["texture"]) == (
        "90", "60", "20", "9.0",
    )  # fmt: skip
    assert [row[f"F1 {s}"] for s in ("0.25 %", "0.5 %", "1 %")] == ["0.700", "0.701", "0.702"]
    assert row["seen F1 0.5 %"] == "0.801"
    assert row["thin recall 0.5 %"] == "0.741"
    assert row["normal error"] == "0.240"
    assert (row["test views dB"], row["textured mesh dB"]) == ("28.00", "24.00")
    assert (row["Gaussians"], row["vertices"], row["peak GiB"]) == (7000, 1000, "1.25")
    assert "MBR dB" not in row


def test_mesh_based_rendering_has_a_column_where_it_was_measured() -> None:
    records = all_records()
    name = preset_case("spot", MESHED_PRESETS[0]).identity
    records[name] = invented(records[name].case, mbr={"psnr": 22.25})
    for table in (preset_table(records), mesher_table(records)):
        check(table)
        values = [r["MBR dB"] for r in rows(table)]
        assert Counter(values) == {"22.25": 1, None: len(values) - 1}


def test_meshers_of_a_training_stand_together() -> None:
    table = mesher_table(all_records())
    check(table)
    assert [(r["scene"], r["training"], r["mesher"]) for r in rows(table)] == [
        (s, p, LABELS[m]) for s in SCENES for p in MESHED_PRESETS for m in ("adaptive", *MESHERS)
    ]
    only = {c.identity: invented(c) for c in CASES if not c.base and c.name != ALPHA}
    assert mesher_table(only).rows == []


def test_thin_parts_and_open_meshes_are_shown_as_they_are() -> None:
    case, other = preset_case("spot", "draft"), preset_case("spot", "standard")
    made = invented(case)
    made.scores["surface"]["uniform"]["thin_count"] = 5
    made.mesh["closed"] = False
    row, full = rows(preset_table({case.identity: made, other.identity: invented(other)}))
    assert (row["thin recall 0.5 %"], row["closed"]) == (None, "NO")
    assert full["thin recall 0.5 %"] is not None


def test_a_further_mesh_costs_its_training_too() -> None:
    records = all_records()
    further = records[mesher_case("spot", "standard", NINE).identity]
    further.processor_s.clear()
    further.processor_s.update(mesh=7.0, texture=2.0)  # its own job trained nothing
    assert spent_s(further, records) == 1.0 + 60.0 + 7.0
    assert spent_s(records[preset_case("spot", "standard").identity], records) == 81.0
    assert spent_s(records[alpha_case("spot").identity], records) == 0.25


def test_the_plot_shows_all_scenes_presets_and_meshers(tmp_path: Path) -> None:
    write_plot(all_records(), tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    words = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    for name in (*SCENES, *LABELS.values()):
        assert name in words
    assert words.count("fine") == len(SCENES)
    assert "no data" not in words


def test_the_page_is_written_from_records_alone(tmp_path: Path) -> None:
    (tmp_path / document.picture("spot")).write_bytes(b"")
    found = {n: r for n, r in all_records().items() if r.case.scene == "spot"}
    text = document.write_document(tmp_path, found, CASES).read_text(encoding="utf-8")
    for words in (
        "How to read this", "a processor, 1 thread a run", "2026-01-02", "are not made yet",
        "## Protocol", "measured at 0123456789",
    ):  # fmt: skip
        assert words in text
    assert re.findall(r"!\[[^]]*\]\(([^)]+)\)", text) == [document.PLOT, "scene-spot.jpg"]
    assert "nan" not in text.lower().split()


def test_alpha_shapes_have_their_own_maker(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str]] = []

    def maker(name: str) -> Any:
        return lambda case, **_: asked.append((name, case.identity))

    monkeypatch.setattr(speed_vs_error, "make_alpha", maker("alpha"))
    monkeypatch.setattr(speed_vs_error, "make", maker("job"))
    cases: list[Case] = [alpha_case("spot"), preset_case("spot", "fine")]
    for case in cases:
        speed_vs_error.make_one(case, threads=1)
    assert asked == [("alpha", "spot-alpha-seed0"), ("job", "spot-fine-seed0")]


def test_an_alpha_shape_bounds_what_it_fills() -> None:
    """A filled grid: closed, outward, of the grid's volume; no face where alpha is too small."""
    side = np.linspace(0.0, 1.0, 6)
    grid = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    grid += np.random.default_rng(0).uniform(-1e-4, 1e-4, grid.shape)  # no five on a sphere
    vertices, faces = alpha_shape(grid, 0.2)
    corners = vertices[faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx(1.0, abs=0.01)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    assert len(alpha_shape(grid, 0.05)[1]) == 0
    assert len(alpha_shape(grid[:2], 10.0)[1]) == 0
