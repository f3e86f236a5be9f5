# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading of the spacing measurement."""

from __future__ import annotations

import math

import pytest

from benchmarks.meshing_tables import vertex_ratio


def mesh(spacing: str, vertices: int, error: float) -> dict[str, object]:
    return {"spacing": spacing, "vertices": vertices, "mean": error}


def test_ratio_is_of_vertices_at_equal_error() -> None:
    uniform = [mesh("uniform", n, 8.0 / n) for n in (1000, 2000, 4000)]
    adaptive = [mesh("adaptive", n, 3.2 / n) for n in (500, 1000, 8000)]
    assert vertex_ratio([*adaptive, *uniform], "mean") == pytest.approx([0.4, 0.4, 0.4])


def test_no_ratio_where_more_vertices_do_not_help() -> None:
    meshes = [mesh("uniform", 1000, 0.1), mesh("uniform", 2000, 0.1), mesh("adaptive", 900, 0.05)]
    assert vertex_ratio(meshes, "mean") == [math.inf]
