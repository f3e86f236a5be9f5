# SPDX-License-Identifier: GPL-3.0-or-later
"""Plots: positions on linear and logarithmic axes."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from benchmarks.plots import Panel, Series, write_svg

SPACE = "{http://www.w3.org/2000/svg}"


def places_of(root: ElementTree.Element) -> np.ndarray:
    """Return the (n, 2) corners of the only line."""
    (line,) = root.findall(f"{SPACE}polyline")
    return np.array([pair.split(",") for pair in line.get("points", "").split()], float)


def test_plot_places_points_on_logarithmic_axes(tmp_path: Path) -> None:
    points = [(1.0, 10.0), (10.0, 100.0), (100.0, 1000.0), (0.0, 5.0)]
    write_svg([Panel("t", "x & y", "y", [Series("a < b", points)])], tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    space = "{http://www.w3.org/2000/svg}"
    (line,) = root.findall(f"{space}polyline")
    places = np.array([pair.split(",") for pair in line.get("points", "").split()], float)
    assert len(places) == 3  # 0 has no logarithm
    assert np.allclose(np.diff(places, 2, axis=0), 0.0, atol=0.11)
    assert places[0, 0] < places[2, 0]
    assert places[0, 1] > places[2, 1]
    assert "a < b" in [text.text for text in root.findall(f"{space}text")]


@pytest.mark.parametrize("log", [False, True])
def test_linear_axes_keep_ratios_and_show_negative_values(tmp_path: Path, log: bool) -> None:
    points = [(0.0, -2.0), (1.0, 0.0), (3.0, 4.0), (float("nan"), 1.0)]
    panel = Panel("t", "x", "y", [Series("s", points)], x_log=log, y_log=log)
    write_svg([panel], tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    if log:
        assert root.findall(f"{SPACE}polyline") == []  # one point has logarithms: no line
        assert len(root.findall(f"{SPACE}circle")) == 2
        return
    places = places_of(root)
    assert places.shape == (3, 2)
    steps = np.diff(places, axis=0)
    assert np.allclose(steps[1] / steps[0], 2.0, atol=0.01)


def test_rows_of_panels_and_words_beside_points(tmp_path: Path) -> None:
    series = Series("s", [(1.0, 1.0), (2.0, 0.0), (3.0, 3.0)], labels=("one", "gone", "three"))
    panel = Panel("t", "x", "y", [series])
    write_svg([panel] * 3, tmp_path / "p.svg", columns=2)
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    words = [text.text for text in root.findall(f"{SPACE}text")]
    assert words.count("one") == words.count("three") == 3
    assert "gone" not in words
    assert float(root.get("height", 0)) == 2 * 360
    assert float(root.get("width", 0)) == 2 * 460


def test_a_panel_without_points_says_so(tmp_path: Path) -> None:
    write_svg([Panel("t", "x", "y", [Series("s", [(0.0, 1.0)])])], tmp_path / "p.svg")
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    assert "no data" in [text.text for text in root.findall(f"{SPACE}text")]
