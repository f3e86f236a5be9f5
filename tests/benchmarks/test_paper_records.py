# SPDX-License-Identifier: GPL-3.0-or-later
"""Records of the paper's figures, the page that is written from them, slices, equal counts."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.paper import document
from benchmarks.paper.meshers import METHODS, at_equal_count
from benchmarks.paper.pictures import dots
from benchmarks.paper.records import (
    ATTENUATION,
    FOLDER,
    MESHERS,
    PLUG_IN,
    read_record,
    rounded,
    write_record,
)
from benchmarks.paper.slices import Plane, inside_segments, level_segments, mesh_segments
from benchmarks.paper.trainings import (
    FULL,
    ITERATIONS,
    LONGER,
    OFF,
    PLAIN,
    trainings,
)
from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from tests.core.meshing.meshing_scenes import cube

PAGE = Path(__file__).parents[2] / "docs" / "benchmarks" / "paper-figures.md"


def ball(rings: int = 24, around: int = 48) -> SurfaceMesh:
    """Return a closed unit sphere."""
    polar = np.pi * np.arange(1, rings) / rings
    turn = 2 * np.pi * np.arange(around) / around
    grid = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.repeat(np.cos(polar)[:, None], around, 1),
        ],
        -1,
    ).reshape(-1, 3)
    vertices = np.concatenate([grid, [[0, 0, 1], [0, 0, -1]]])
    faces = []
    for j in range(around):
        k = (j + 1) % around
        faces.append((len(grid), j, k))
        for i in range(rings - 2):
            a, b = i * around + j, i * around + k
            faces += [(a, a + around, b), (b, a + around, b + around)]
        last = (rings - 2) * around
        faces.append((last + j, len(grid) + 1, last + k))
    return SurfaceMesh(vertices, np.array(faces, np.int32))


class InBox:
    """As much of a training as decimation asks for."""

    region = cube(1.5)


@pytest.mark.parametrize("triangles", [1000, 400])
def test_equal_counts_are_exact(triangles: int) -> None:
    mesh = at_equal_count(ball(), InBox, triangles)  # type: ignore[arg-type]
    assert len(mesh.faces) == triangles
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1.0).max() < 0.05


def test_too_few_triangles_are_refused() -> None:
    with pytest.raises(MeshingError, match="triangles"):
        at_equal_count(ball(), InBox, 10_000)  # type: ignore[arg-type]


def test_record_comes_back_as_it_was_rounded(tmp_path: Path) -> None:
    values = {"a": [1.23456789, np.float32(0.5), 7], "b": {"c": math.nan, "d": "x"}, "e": True}
    write_record("one", values, tmp_path)
    assert read_record("one", tmp_path) == rounded(values)
    assert rounded(values) == {"a": [1.23457, 0.5, 7], "b": {"c": None, "d": "x"}, "e": True}
    assert read_record("other", tmp_path) is None


@pytest.mark.parametrize("name", [PLUG_IN, ATTENUATION, MESHERS])
def test_committed_record_is_as_it_was_written(name: str) -> None:
    record = read_record(name)
    assert record is not None
    assert rounded(record) == record
    assert {"command", "date", "machine", "code"} <= set(record["origin"])


def test_committed_page_is_what_the_records_give(tmp_path: Path) -> None:
    """All but the hand-written reading, which lies beside the page."""
    reading = PAGE.with_name("paper-figures-reading.md")
    (tmp_path / reading.name).write_bytes(reading.read_bytes())
    assert document.write_page(tmp_path, FOLDER).read_bytes() == PAGE.read_bytes()


def test_pictures_of_the_page_exist_and_are_small() -> None:
    names = re.findall(r"!\[[^]]*\]\(([^)]+)\)", PAGE.read_text(encoding="utf-8"))
    assert names
    for name in names:
        assert PAGE.with_name(name).stat().st_size < 260_000, name


def test_meshers_record_compares_equal_counts() -> None:
    record: dict[str, Any] = read_record(MESHERS) or {}
    assert [row["method"] for row in record["rows"]] == list(METHODS)
    assert {row["equal"]["faces"] for row in record["rows"]} == {record["triangles"]}


def test_residual_falls_with_every_round() -> None:
    record: dict[str, Any] = read_record(MESHERS) or {}
    median = {step["step"]: step["median"] for step in record["steps"]}
    rounds = [value for step, value in median.items() if step.startswith("after")]
    assert len(rounds) >= 3
    assert rounds == sorted(rounds, reverse=True)
    assert rounds[0] < median["samples of it"]


def test_plain_training_has_nothing_of_the_method() -> None:
    kinds = trainings()
    plain, full = kinds[PLAIN].settings, kinds[FULL].settings
    assert {name: getattr(plain, name) for name in OFF} == OFF
    assert plain.iterations == full.iterations == ITERATIONS
    assert kinds[LONGER].iterations == 1.3 * ITERATIONS
    differing = {
        name for name, value in vars(plain).items() if value != getattr(full, name)
    }  # fmt: skip
    assert differing == set(OFF)


def test_section_of_a_ball_is_its_circle() -> None:
    mesh = ball(60, 120)
    plane = Plane(
        "middle", np.array([0.1, 0.0, 0.003]), np.array([1.0, 0, 0]), np.array([0.0, 1, 0]), 1.5
    )
    side = 200
    cut = plane.pixels(mesh_segments(plane, mesh.vertices, mesh.faces), side)
    inside = inside_segments(cut, side)
    away = np.linalg.norm(plane.points(side) * [1, 1, 0], axis=2)
    sure = np.abs(away - 1.0) > 0.02
    np.testing.assert_array_equal(inside[sure], (away < 1.0)[sure])


def test_level_lies_where_the_value_is() -> None:
    y, x = np.mgrid[:80, :60] + 0.5
    segments = level_segments(np.hypot(x - 30, y - 40) / 40)  # 0.5 at a radius of 20
    radius = np.hypot(segments[:, :, 0] - 30, segments[:, :, 1] - 40)
    assert np.abs(radius - 20).max() < 0.05
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * 20, rel=1e-2)


def test_dots_are_closed_and_face_outward() -> None:
    points = np.array([[1.0, 2.0, 3.0], [-1.0, 0.0, 0.5]])
    vertices, faces, colors = dots(points, 0.1, np.eye(3)[:2])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    center = points[np.arange(len(faces)) // 8]
    assert (np.einsum("nd,nd->n", np.cross(b - a, c - a), a - center) > 0).all()
    assert len(colors) == len(vertices)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
