# SPDX-License-Identifier: GPL-3.0-or-later
"""The benchmark of the kernels runs as a whole on a tiny workload and writes its report."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import pytest
from benchmarks.fma_peak import _chains
from benchmarks.kernel_results import BACKWARD, Result, Workload
from benchmarks.timing import measure

from benchmarks.kernels import PARTS, main, measure_workload, panels, speed_sections
from benchmarks.tables import Table
from benchmarks.zoo.places import FORWARD
from gaussian_wrapping_addon.core.evaluation.report.plot import write_svg


@pytest.fixture(scope="module")
def result() -> Result:
    """One tiny measurement."""
    return measure_workload(Workload(600, 72, 48), threads=2, repeats=2, budget_s=1.0)


def test_speed_of_a_tiny_workload(result: Result, tmp_path: Path) -> None:
    assert Result.from_json(result.to_json()) == result
    words, tables = speed_sections({"here": [result]})
    text = "\n".join([*words, *(table.markdown() for table in tables)])
    assert "600, 72x48" in text
    assert "nan" not in text
    for parts in result.one.values():
        assert parts[FORWARD].repeats == 2
        assert parts[BACKWARD].cpu_ms > 0
    variant = next(iter(result.one))
    assert result.own_evaluations(variant) == result.own[variant] > result.evaluations["useful"]
    write_svg(panels({"here": [result]}, []), tmp_path / "plot.svg")
    assert len(ElementTree.parse(tmp_path / "plot.svg").getroot()) > 10


def test_error_part_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    main(["--quick", "--only", "error", "--out", str(tmp_path)])
    text = (tmp_path / "kernels.md").read_text(encoding="utf-8")
    assert capsys.readouterr().out.strip() == text.strip()
    for title in ("Images and depth", "loss on images", "loss on depth", "hand-written backward"):
        assert title in text
    assert "seed 0" in text
    assert "2000 Gaussians, 80 x 60" in text
    assert not (tmp_path / "kernels.svg").exists()
    assert set(PARTS) == {"speed", "error", "methods"}


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


@pytest.mark.parametrize("lanes", [8, 16])
def test_peak_loop_multiplies_and_adds(lanes: int) -> None:
    # Lane 0 of chain i starts at 0.5, i.e. x -> 0.999 x + 0.001 four times a turn, 12 chains.
    steps = 4 * 5
    wanted = 12 * (1.0 + 0.999**steps * (0.5 - 1.0))
    assert _chains(lanes)(5, 0.5) == pytest.approx(wanted, rel=1e-5)
    assembly = "\n".join(_chains(lanes).inspect_asm().values())
    assert "vfmadd" in assembly or "fmla" in assembly


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
