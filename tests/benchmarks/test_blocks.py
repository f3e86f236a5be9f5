# SPDX-License-Identifier: GPL-3.0-or-later
"""The street that blocks are measured on, how results are judged, and laws of cost."""

from __future__ import annotations

import copy
import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.blocks import judging, record, road
from benchmarks.blocks.comparison import COARSE, JOINED, MESH, WHOLE, Comparison
from benchmarks.blocks.document import curve_table, page, road_table, surface_table, write_document
from benchmarks.blocks.judging import ALL, ELSEWHERE, NEAR, near_border
from benchmarks.blocks.paper_plan import PowerLaw, costs, peaks, plan_table
from benchmarks.blocks.street import (
    STEP_M,
    face_points,
    length_m,
    make_scene,
    seen_points,
    shown_in,
    street,
)
from benchmarks.blocks.street_mesh import street_bounds
from benchmarks.camera_solving.ray_caster import Boxes, render
from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.evaluation.surface.scores import score_surface
from gaussian_wrapping_addon.core.mesh.distance import distances_to_mesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.training.blocks.block_settings import BlockSettings
from tests.core.training.blocks.row_scene import row_scene, two_blocks


def test_a_street_is_as_long_as_it_has_photos() -> None:
    short, long = street(20), street(40)
    assert (len(short.cameras), len(long.cameras)) == (20, 40)
    assert length_m(40) == 2 * length_m(20) == 20 * STEP_M
    for place, count in ((short, 20), (long, 40)):
        x = np.array([camera.center[0] for camera in place.cameras])
        assert np.allclose(np.sort(np.diff(x[: count // 2])), STEP_M, atol=0.31)
        assert (np.diff(x[count // 2 :]) < 0).all()  # the way back
        assert x.min() > -0.2
        assert x.max() < length_m(count) + 0.2
        for camera in place.cameras:  # nobody walks through a house
            inside = (camera.center > place.boxes.lower[1:]) & (
                camera.center < place.boxes.upper[1:]
            )
            assert not inside.all(1).any()
    houses = [len(place.boxes.lower) - 1 for place in (short, long)]
    assert houses[1] == 2 * houses[0]


def test_points_lie_where_their_photos_show_their_colour() -> None:
    place = street(12)
    cameras = [c.resized(160, 120) for c in place.cameras]
    images = [render(place.boxes, camera) for camera in cameras]
    found = seen_points(place.boxes, cameras, images, 1500)
    assert len(found.points) > 100
    assert (np.bincount(found.point_ids) >= 2).all()
    assert (np.diff(found.point_ids) >= 0).all()
    errors = []
    for point, view, pixel in zip(found.point_ids, found.camera_ids, found.pixels, strict=True):
        at, depth = cameras[view].project(found.points[point][None])
        assert depth[0] > 0
        assert np.allclose(at[0], pixel)
        column, row = pixel.astype(int)
        errors.append(np.abs(images[view][row, column].astype(int) - found.colors[point]).mean())
    # Textures are finer than pixels here and there; what hides a point looks nothing like it.
    assert np.median(errors) < 12.0


def test_a_box_hides_what_is_behind_it() -> None:
    place = street(12)
    camera = place.cameras[0]
    points, _ = face_points(place.boxes, 4000)
    eye, forward = camera.center, camera.rotation[2]
    rows, pixels = shown_in(place.boxes, camera, points)
    assert (((points[rows] - eye) @ forward) > 2.0).sum() > 5
    assert np.allclose(camera.project(points[rows])[0], pixels)
    near, _ = shown_in(place.boxes, camera, points, 8.0)
    deep = camera.to_camera(points[rows])[:, 2]
    assert np.array_equal(near, rows[deep <= 8.0])
    assert 0 < len(near) < len(rows)
    boxes = dataclasses.replace(
        place.boxes,
        lower=np.concatenate([place.boxes.lower, [eye + forward - 0.9]]),
        upper=np.concatenate([place.boxes.upper, [eye + forward + 0.9]]),
        face_looks=np.concatenate([place.boxes.face_looks, [[0] * 6]]),
    )
    rows, _ = shown_in(boxes, camera, points)
    assert not ((points[rows] - eye) @ forward > 2.0).any()


def test_the_scene_is_a_project_that_loads(tmp_path: Path) -> None:
    source = make_scene(tmp_path, 8, 64, 1)
    assert make_scene(tmp_path, 8, 64, 1) == source
    scene = load_scene(source, tmp_path / "work", Progress(), threads=1)
    assert len(scene.views) == 8
    assert {(view.camera.width, view.camera.height) for view in scene.views} == {(64, 48)}
    assert len(scene.points) > 20
    # Views are judged by the street's cameras of the same number.
    for view, camera in zip(scene.views, street(8).cameras, strict=True):
        assert view.camera.name == camera.name


def test_pixels_near_a_border_show_surface_that_is() -> None:
    plan, (scene, _) = two_blocks(), row_scene()
    (_, axis, at), = plan.tiling.splits  # fmt: skip
    camera = scene.views[12].camera
    plane = np.full((camera.height, camera.width), 4.0)  # a wall through the row
    plane[:4] = 0.0
    near = near_border(plan, camera, plane, 0.5).reshape(plane.shape)
    assert not near[:4].any()
    rays = camera.rays() * 4.0
    x = camera.center[axis] + (rays @ camera.rotation)[..., axis]
    assert np.array_equal(near[4:], np.abs(x - at)[4:] <= 0.5)
    assert near.any()


def test_bands_reach_half_of_the_margin_across_borders_alone() -> None:
    plan = two_blocks()
    (_, axis, _), = plan.tiling.splits  # fmt: skip
    assert judging.band_reach(plan) == 0.5 * plan.margins[:, axis].min() > 0.0


def test_places_divide_the_street() -> None:
    plan, (scene, _) = two_blocks(), row_scene()
    parts = judging.places(scene, plan, 40)
    points = np.random.default_rng(0).uniform(*street_bounds(40), (4000, 3))
    inside = {name: part.inside(points) for name, part in parts.items()}
    assert np.array_equal(inside[ALL], inside[NEAR] | inside[ELSEWHERE])
    assert not (inside[NEAR] & inside[ELSEWHERE]).any()
    near = plan.near_border(
        scene.world_from_scene.inverse().points(points), judging.band_reach(plan)
    )
    assert np.array_equal(inside[NEAR], near & inside[ALL])
    assert not inside[ALL].all()


def test_faces_of_boxes_are_triangles_that_their_points_lie_on() -> None:
    boxes = Boxes(
        np.array([[-9.0, -9.0, 0.0], [0.0, 1.0, 0.0]]),
        np.array([[9.0, 9.0, 9.0], [2.0, 2.0, 3.0]]), np.arange(12).reshape(2, 6),
    )  # fmt: skip
    vertices, faces = judging.box_triangles(boxes)
    assert faces.shape == (24, 3)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    volumes = (a * cross).sum(1) / 6  # of tetrahedra to the origin
    assert math.isclose(volumes[:12].sum(), -(18.0 * 18.0 * 9.0))  # seen from inside
    assert math.isclose(volumes[12:].sum(), 2.0 * 1.0 * 3.0)
    points, normals = face_points(boxes, 500)
    found, *_ = distances_to_mesh(points, vertices, faces)
    assert np.abs(found).max() < 1e-9
    assert np.array_equal(np.abs(normals).sum(1), np.ones(500))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    return Comparison.of_street(
        tmp_path_factory.mktemp("blocks"), Path("photos"), 24, BlockSettings(2)
    )


def test_iterations_and_gaussians_are_in_proportion_to_photos(small: Comparison) -> None:
    twice = Comparison.of_street(small.folder, small.source, 48, BlockSettings(2))
    assert twice.settings.iterations == 2 * small.settings.iterations
    assert twice.settings.max_gaussians == 2 * small.settings.max_gaussians
    assert dataclasses.replace(
        twice.settings, iterations=small.settings.iterations,
        max_gaussians=small.settings.max_gaussians,
    ) == small.settings  # fmt: skip
    assert small.block_names == ["block-0", "block-1"]


def test_the_true_surface_is_perfect_and_a_shifted_one_is_not(small: Comparison) -> None:
    views = tuple(range(1, 24))
    truth, hidden = judging.true_surface(small, views)
    assert len(truth.samples) > 1000
    assert len(hidden) > 1000
    low, high = street_bounds(24)
    for points in (truth.samples.points, hidden):
        assert (points >= low).all()
        assert (points <= high).all()
    crop = judging.Place(lambda points: ((points > low + 0.3) & (points < high - 0.3)).all(1))
    cameras = [street(24).cameras[view] for view in views]
    vertices, faces = truth.mesh  # type: ignore[misc]
    judged = dataclasses.replace(truth, crop=crop)
    for shift, least, most in ((0.0, 1.0, 1.0), (0.15, 0.0, 0.4)):
        mesh = (vertices + np.array([0.0, 0.0, shift]), faces)
        samples = judging.scanned(mesh, cameras, crop, 1)
        nearest = [np.inf] * len(samples)
        for camera in cameras:
            depth = camera.to_camera(samples.points)[:, 2]
            nearest = np.where(depth > 0, np.minimum(nearest, depth), nearest)
        assert np.max(nearest) <= judging.NEAR_M + 0.2
        ground = np.abs(samples.normals[:, 2]) > 0.9
        score = score_surface(samples.kept(ground), mesh, judged, (0.1,))
        assert least <= score.precision[0] <= most


def _figures(processor_s: float, gib: float, **further: Any) -> dict[str, Any]:
    return {
        "processor_s": processor_s, "wall_s": processor_s, "peak_bytes": gib * 2**30, "threads": 2,
        "gaussians": 10, **further,
    }  # fmt: skip


def _record(photos: int, blocks: int, **further: Any) -> dict[str, Any]:
    """Whole: photos ^ 1.5; coarse: photos; a block: 100 s; joining: photos / 4."""
    steps = {
        WHOLE: _figures(photos**1.5, photos / 100),
        COARSE: _figures(float(photos), 1.0 + photos / 1000, photos=[photos // blocks] * blocks),
        JOINED: _figures(photos / 4, 1.0),
        **{f"block-{k}": _figures(100.0, 2.0) for k in range(blocks)},
    }
    stages = (WHOLE, COARSE, "block-0", JOINED)
    walls = {name: {"wall_s": 10.0, "machine_s": 1e5} for name in stages}
    score = {"f1": [0.5, 0.75, 0.875], "precision": [0.5] * 3, "recall": [0.5] * 3}
    worse = {**score, "f1": [0.5, 0.625, 0.875]}
    return {
        "photos": photos, "blocks": blocks, "margin": 0.2, "polish": 0.1,
        "iterations": 6 * photos, "max_gaussians": 200 * photos, "match_px": 320, "edge_m": 0.35,
        "max_image_px": 640, "dense_start": "auto",
        "band_m": 2.5, "machine": "a machine", "versions": "versions", "code": "abc",
        "date": "2026-01-01T00:00", "steps": steps, "walls": walls,
        "psnr": {name: {ALL: 20.0, NEAR: None, ELSEWHERE: 20.0} for name in (WHOLE, JOINED)},
        "surface": {WHOLE: {ALL: score}, JOINED: {ALL: worse}}, **further,
    }  # fmt: skip


def test_a_power_law_is_found_again() -> None:
    law = PowerLaw.of([50, 100, 400], [3.0 * n**1.25 for n in (50, 100, 400)])
    assert math.isclose(law.exponent, 1.25)
    assert math.isclose(law.at(10_000), 3.0 * 10_000**1.25)


def test_costs_and_memory_of_both_ways() -> None:
    found = _record(400, 4)
    assert costs(found) == {
        WHOLE: 8000.0, COARSE: 400.0, "blocks": 400.0, JOINED: 100.0, "together": 900.0,
    }  # fmt: skip
    assert peaks(found) == {
        WHOLE: 4 * 2**30, COARSE: 1.4 * 2**30, JOINED: 2**30, "blocks": 2 * 2**30,
    }  # fmt: skip


def test_a_plan_on_paper_adds_up() -> None:
    records = [_record(100, 1), _record(200, 2), _record(400, 4)]
    rows = {row[0]: row[1:] for row in plan_table(records[-1], records, 10_000, 32).rows}
    coarse_h = 10_000 / 3600
    assert rows["coarse training, plan"] == (
        "1 process", round(coarse_h, 2), round(coarse_h / 2, 2), 11.0,
    )  # fmt: skip
    # 100 blocks on 64 processors: two rounds.
    assert rows["100 blocks"] == ("64 processes, 2 rounds", 2.78, round(200 / 3600, 2), 2.0)
    assert rows["joining, polish"][2] == round(coarse_h / 8, 2)
    assert rows["together"][2] == round((5000 + 200 + 1250) / 3600, 2)
    assert rows["one training instead"][2:] == (round(1e6 / 7200, 2), 100.0)
    assert "mesh in tiles" not in rows
    records[-1]["steps"][f"{MESH}{JOINED}"] = _figures(800.0, 1.0)
    rows = {row[0]: row[1:] for row in plan_table(records[-1], records, 10_000, 32).rows}
    # The mesh is of 40 m of 200.
    assert rows["mesh in tiles"] == ("64 processes", 27.78, round(100_000 / 64 / 3600, 2), None)


def test_the_curve_states_its_exponents() -> None:
    row = curve_table([_record(100, 1), _record(200, 2), _record(400, 4)]).rows[-1]
    assert row[2:6] == ("1.50", "1.00", "1.00", "1.00")
    assert row[7:9] == ("1.00", "0.00")


def test_the_page_says_what_the_records_say(tmp_path: Path) -> None:
    records = {f"street-{n}": _record(n, max(1, n // 100)) for n in (50, 100)}
    wide = copy.deepcopy(records["street-100"])
    wide["margin"] = 0.4
    records["street-100-wide"] = wide
    text = page(records)
    assert "| street-100-wide |" in text
    assert "10000 photos on 32 machines" in text
    assert "a machine, 2 cores; versions" in text
    (tmp_path / "blocks-reading.md").write_text("What it means.")
    path = write_document(tmp_path, records)
    assert path is not None
    assert "What it means." in path.read_text()
    assert write_document(tmp_path, {}) is None
    rows = surface_table({"street-100": wide}).rows
    assert rows[-1][2:6] == ("**blocks less one training**", "+0.000", "-0.125", "+0.000")


def test_wall_times_of_both_ways() -> None:
    one, blocks = road_table(_record(400, 4)).rows
    assert one[1:4] == (10, 8000, 4000)
    assert blocks[1:4] == (30, 900, 450)
    assert blocks[4] == "100%"  # of 3e5 processor seconds, all but 900


def test_records_are_found_again(tmp_path: Path) -> None:
    for photos, label in ((400, ""), (50, ""), (50, "wide")):
        record.write_record(_record(photos, 1), label, tmp_path)
    found = record.read_records(tmp_path)
    assert list(found) == ["street-50", "street-50-wide", "street-400"]
    assert found["street-400"]["photos"] == 400
    assert record.labelled(found, "wide") == [found["street-50-wide"]]
    assert record.labelled(found, "") == [found["street-50"], found["street-400"]]


def test_blocks_run_two_at_a_time_and_nothing_runs_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = Comparison.of_street(tmp_path, tmp_path, 24, BlockSettings(3))
    ran: list[tuple[list[str], int]] = []

    def run(command: Any, names: list[str], threads: int, say: Any) -> None:
        ran.append((list(names), threads))
        for name in names:
            comparison.figures_path(name).parent.mkdir()
            comparison.figures_path(name).write_text("{}")

    monkeypatch.setattr(road, "_run", run)
    road.walk(comparison, ["module"], [JOINED], str)
    blocks = ["block-0", "block-1", "block-2"]
    assert ran == [
        ([WHOLE], 2), ([COARSE], 2), (blocks, 1), ([JOINED], 2), ([f"{MESH}{JOINED}"], 2),
    ]  # fmt: skip
    assert (tmp_path / "block-0" / road.WALLS).is_file()
    ran.clear()
    road.walk(comparison, ["module"], [JOINED], str)
    assert ran == []


def test_a_step_that_fails_ends_the_others(tmp_path: Path) -> None:
    said: list[str] = []
    with pytest.raises(road.StepFailed):
        road._run(["no_such_module_of_ours"], ["block-0", "block-1"], 1, lambda w: said.append(w))
    assert said[:2] == ["block-0 begins", "block-1 begins"]
