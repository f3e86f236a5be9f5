# SPDX-License-Identifier: GPL-3.0-or-later
"""The benchmark of the kernels runs as a whole on a tiny workload and writes its page."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks import kernels
from benchmarks.kernels import RASTER, WHOLE, measure, measure_workload, thread_table
from benchmarks.provenance import code_of_tree, read_figures, write_figures
from benchmarks.tables import Table


def test_a_tiny_workload_becomes_a_page(tmp_path: Path) -> None:
    rows = [measure_workload((600, 72, 48), threads, 2, 1.0) for threads in (1, 2)]
    write_figures(tmp_path / "a.json", {"lanes": 8, "rows": rows}, 2, code_of_tree())
    text = kernels.write_document(read_figures(tmp_path / "a.json"), tmp_path).read_text()
    assert "600, 72x48" in text
    assert "nan" not in text
    for part in ("raster backward, isosurface", "L1 + SSIM", f"{WHOLE}, depth", f"{RASTER}, col"):
        assert part in text
    assert all(t["cpu_ms"] >= 0.0 and t["repeats"] == 2 for t in rows[0]["parts"].values())
    table = thread_table(rows)
    assert [row[1] for row in table.rows] == [1, 2]
    assert table.rows[0][3] == "1.00"  # one thread over itself


def test_one_scene_is_printed_alone(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--print", "300/40x30", "--threads", "1", "--repeats", "1"]
    assert kernels.main(words) == 0
    assert "300, 40x30" in capsys.readouterr().out


def test_measure_takes_turns_and_warms_up() -> None:
    calls: list[str] = []
    parts = [(name, lambda name=name: calls.append(name)) for name in "ab"]
    timings = measure(parts, 3)
    assert calls == list("abababab")
    assert timings["a"].repeats == 3
    assert 0 <= timings["b"].cpu_ms < 1000


def test_measure_stops_at_its_budget() -> None:
    timings = measure([("a", lambda: sum(range(1000)))], 50, budget_s=0.0, at_least=2)
    assert timings["a"].repeats == 2


def test_table_is_markdown() -> None:
    table = Table(
        "Title", ("name", "value"), [("a", 1.5), ("bc", math.nan), ("d", None)], ("note",)
    )
    lines = table.markdown().splitlines()
    assert lines[0] == "### Title"
    assert lines[2] == "| name | value |"
    assert lines[3] == "|:-----|------:|"
    assert lines[4] == "| a    |  1.50 |"
    assert lines[5] == "| bc   |   nan |"
    assert lines[-1] == "note"
    assert len({len(line) for line in lines[2:7]}) == 1
