# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface scores: perfect on the truth, closed forms, bias; folders of ground truth."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, MeshingError, ParseError, UsageError
from gaussian_wrapping_addon.core.evaluation import surface_scores
from gaussian_wrapping_addon.core.evaluation.surface_scores import (
    PROTOCOLS,
    SurfaceSamples,
    SurfaceScore,
    Truth,
    face_normals,
    read_truth,
    sample_legacy,
    sample_uniformly,
    score_clouds,
    score_protocols,
    score_surface,
)
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.evaluation.surface_scenes import (
    Mesh,
    ball,
    cameras_around,
    cylinder,
    exact_sphere,
    fanned,
    halves,
    joined,
    moved_camera,
    truth_of,
    without_mesh,
)
from tests.core.evaluation.written_layouts import rotation_about

CAMERAS = cameras_around()
OFFSET = np.array([5e5, 4e6, -300.0])
EMPTY = np.zeros((0, 3)), np.zeros((0, 3), np.int64)


def uniform(mesh: Mesh, truth: Truth, *thresholds: float, count: int = 20_000) -> SurfaceScore:
    return score_protocols(
        *mesh, truth, [], thresholds, count=count, seed=1, protocols=["uniform"]
    )["uniform"]


@pytest.mark.parametrize(
    ("scale", "offset"), [(1e-3, np.zeros(3)), (1.0, np.zeros(3)), (1e3, OFFSET), (1e-3, OFFSET)]
)
def test_the_truth_itself_is_perfect(scale: float, offset: np.ndarray) -> None:
    vertices, faces = joined(ball(3), cylinder([0, 0, 0.9], [0, 0, 2], 0.05))
    mesh = vertices * scale + offset, faces
    truth = truth_of(mesh, seen=np.full(20_000, 2, np.int32), thin=np.ones(20_000, bool))
    rounding = 1e-9 * scale if not offset.any() else 4e-9
    for score in (
        uniform(mesh, truth, rounding, 0.1 * scale),
        score_surface(truth.samples, None, without_mesh(truth), [rounding, 0.1 * scale]),
    ):
        assert score.precision == score.recall == score.f1 == (1.0, 1.0)
        assert score.visible_recall == score.thin_recall == (1.0, 1.0)
        assert score.chamfer_mean <= rounding
        assert score.chamfer_median <= rounding
        # Coordinates of millions move the corners of a face of a few millimetres.
        if not offset.any():
            assert score.normal_consistency == pytest.approx(1.0, abs=1e-12)
            assert score.normal_agreement == 1.0


@pytest.mark.parametrize("shift", [0.02, 0.4])
def test_a_shifted_sphere_has_the_distances_of_theory(shift: float) -> None:
    """Heights on a sphere are even, and r dr = R d dc for r = |x + d|, c the cosine to d: the
    share of points nearer than t is the integral of r dr over R - t .. R + t, over 2 R d = t / d.
    The distances are even between 0 and d: mean and median d / 2."""
    fine, samples = ball(5), exact_sphere(20_000)
    away = np.array([0.0, 0.0, shift])
    limits = np.array([0.1, 0.25, 0.5, 0.75]) * shift
    moved = SurfaceSamples(samples.points + away, samples.normals)
    score = score_surface(moved, (fine[0] + away, fine[1]), Truth(samples, *fine), limits)
    sag = 3e-4
    for distance in (score.accuracy_mean, score.completeness_mean):
        assert distance == pytest.approx(shift / 2, abs=sag)
    for distance in (score.accuracy_median, score.completeness_median):
        assert distance == pytest.approx(shift / 2, abs=2 * sag)
    for got in (score.precision, score.recall, score.f1):
        assert got == pytest.approx(limits / shift, abs=sag / shift + 1e-3)


def test_legacy_scores_depend_on_tessellation_and_uniform_ones_do_not() -> None:
    upper, lower = halves(ball(4))
    wrong = lower[0] * 1.05, lower[1]
    truth = truth_of(ball(4))
    uniform_, legacy = [], []
    for right in (upper, fanned(upper, 10)):
        scores = score_protocols(
            *joined(right, wrong), truth, [], [0.03], count=20_000, seed=0,
            protocols=["uniform", "legacy"],
        )  # fmt: skip
        for name, figures in (("uniform", uniform_), ("legacy", legacy)):
            score = scores[name]
            figures.append(
                np.array([score.precision[0], score.recall[0], score.f1[0], score.chamfer_mean])
            )
        # Legacy precision is the share of vertices and centres on the half that is right.
        good, bad = len(sample_legacy(*right)), len(sample_legacy(*wrong))
        assert legacy[-1][0] == pytest.approx(good / (good + bad), abs=1e-12)
    areas = [face_normals(*half)[1].sum() for half in (upper, wrong)]
    assert uniform_[0][0] == pytest.approx(areas[0] / sum(areas), abs=1e-3)
    assert (np.abs(uniform_[1] - uniform_[0]) <= 0.005 * uniform_[0]).all()
    change = legacy[1] - legacy[0]
    assert change[0] > 0.4
    assert change[2] > 0.1


def test_uniform_punishes_a_hidden_shell_and_a_scan_does_not() -> None:
    outer = ball(4)
    mesh = joined(outer, (outer[0] * 0.5, outer[1]))
    truth = truth_of(outer)
    scores = score_protocols(*mesh, truth, CAMERAS, [0.05], count=20_000, seed=0)
    assert scores["uniform"].precision[0] == pytest.approx(0.8, abs=1e-3)  # areas 1 and 1/4
    assert scores["uniform"].accuracy_mean == pytest.approx(0.2 * 0.5, abs=2e-3)
    assert scores["scan"].precision == (1.0,)
    assert scores["scan"].recall[0] > 0.999


def test_cameras_that_crowd_do_not_weigh_more_in_a_scan() -> None:
    upper, lower = halves(ball(4))
    mesh = joined(upper, (lower[0] * 1.05, lower[1]))
    truth = truth_of(ball(4), 2000)
    crowd = [camera for camera in CAMERAS if camera.center[2] > 1] * 4
    assert len(crowd) > 12
    few, many = (
        score_protocols(*mesh, truth, cameras, [0.03], protocols=["scan"])["scan"]
        for cameras in (CAMERAS, CAMERAS + crowd)
    )
    assert few.precision[0] == pytest.approx(1 / (1 + 1.05**2), abs=0.02)
    assert many.precision[0] == pytest.approx(few.precision[0], abs=2e-3)


def test_a_scan_of_many_pixels_takes_larger_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, cameras = ball(3), CAMERAS[:4]
    truth = truth_of(mesh, 2000)
    rays = sum(camera.width * camera.height for camera in cameras)
    steps: list[float] = []
    scan = surface_scores.scan_virtually
    monkeypatch.setattr(
        surface_scores, "scan_virtually",
        lambda *given, step_px, **options: steps.append(step_px)
        or scan(*given, step_px=step_px, **options),
    )  # fmt: skip
    for limit in (rays, rays / 4):
        monkeypatch.setattr(surface_scores, "SCAN_RAYS", limit)
        score_protocols(*mesh, truth, cameras, [0.01], protocols=["scan"])
    assert steps == [1.0, 2.0]


def test_a_scan_asks_only_for_what_cameras_see() -> None:
    outer, inner = ball(4), (ball(3)[0] * 0.5, ball(3)[1])
    solid = joined(outer, inner)
    samples = sample_uniformly(*solid, 10_000, seed=0)
    hidden = np.linalg.norm(samples.points, axis=1) < 0.6
    truth = Truth(samples, *solid, seen=np.where(hidden, 1, 5).astype(np.int32))
    scores = score_protocols(*outer, truth, CAMERAS, [0.06], count=10_000, seed=0)
    assert scores["scan"].recall == (1.0,)
    assert scores["scan"].truth_count == (~hidden).sum()
    assert scores["uniform"].recall[0] == pytest.approx((~hidden).mean(), abs=1e-12)
    assert scores["uniform"].visible_recall == (1.0,)
    assert scores["uniform"].visible_count == (~hidden).sum()
    unseen = Truth(samples, *solid, seen=np.ones(10_000, np.int32))
    with pytest.raises(UsageError, match="seen by 2 cameras"):
        score_protocols(*outer, unseen, CAMERAS, [0.06], protocols=["scan"])


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_flipped_mesh_is_perfect_and_consistent_but_does_not_agree(protocol: str) -> None:
    vertices, faces = ball(4)
    truth = truth_of((vertices, faces), 5000)
    both = [
        score_protocols(
            vertices, turned, truth, CAMERAS, [0.06], count=5000, seed=0, protocols=[protocol]
        )[protocol]
        for turned in (faces, faces[:, ::-1])
    ]
    assert [score.normal_agreement for score in both] == [1.0, 0.0]
    assert both[0].normal_consistency == pytest.approx(both[1].normal_consistency, abs=1e-9)
    for score in both:
        assert score.precision == score.recall == score.f1 == (1.0,)
        assert score.accuracy_mean < 1e-15
        assert score.normal_consistency > 0.998


def test_tilted_planes_have_the_cosine_of_their_angle_and_unknown_normals_do_not_count() -> None:
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    angle = np.radians(10)
    tilted = rotation_about([1, 0, 0], 10).dot(square.T).T
    score = uniform((tilted, faces), truth_of((square, faces), 1000), 1.0, count=1000)
    assert score.normal_consistency == pytest.approx(np.cos(angle), abs=1e-12)
    assert score.normal_agreement == 1.0
    known = sample_uniformly(*ball(3), 1000, seed=0)
    for share, expected in ((np.zeros(1000), 0.0), (np.arange(1000) % 2, 1.0)):
        truth = Truth(dataclasses.replace(known, normals=known.normals * share[:, None]))
        score = score_surface(known, None, truth, [0.1])
        assert score.normal_consistency == pytest.approx(expected)
        assert score.normal_agreement == expected


def test_a_missing_wire_costs_thin_recall() -> None:
    body, wire = ball(4), cylinder([1.5, 0, -1], [1.5, 0, 1], 0.01)
    whole = joined(body, wire)
    samples = sample_uniformly(*whole, 20_000, seed=0)
    thin = samples.points[:, 0] > 1.2
    hidden = thin & (samples.points[:, 2] < 0)
    seen = np.where(hidden, 0, 3).astype(np.int32)
    truth = Truth(samples, *whole, thin=thin, seen=seen)
    assert thin.sum() > 150
    complete, without = uniform(whole, truth, 0.05), uniform(body, truth, 0.05, 0.6)
    assert complete.thin_recall == complete.recall == (1.0,)
    assert without.thin_count == (thin & ~hidden).sum()
    assert without.thin_recall is not None
    assert without.thin_recall[0] == 0.0
    # Nearest to the sphere, the wire is 0.49 away; at height 1 it is 0.79 away.
    near = np.linalg.norm(samples.points[thin & ~hidden], axis=1) < 1.6
    assert without.thin_recall[1] == pytest.approx(near.mean(), abs=0.02)
    assert without.recall[0] == pytest.approx(1 - thin.mean(), abs=1e-12)
    assert without.precision[0] == 1.0
    assert uniform(body, dataclasses.replace(truth, thin=hidden), 0.05).thin_recall is None
    assert uniform(body, dataclasses.replace(truth, thin=None), 0.05).thin_recall is None


def test_the_crop_chooses_what_is_judged_not_what_it_is_measured_against() -> None:
    mesh = ball(4)
    upper, lower = halves(mesh)
    crop = Region.box("top", [-2, -2, 0.3], [2, 2, 2])
    cropped = dataclasses.replace(truth_of(mesh), crop=crop)
    score = uniform(joined(upper, (lower[0] * 1.4, lower[1])), cropped, 1e-9)
    assert score.precision == score.recall == (1.0,)
    # A zone's area goes with its height: 0.7 of 2.
    assert score.truth_count == pytest.approx(20_000 * 0.35, rel=0.01)
    assert score.predicted_count == pytest.approx(20_000 * 0.7 / (1 + 1.4**2), rel=0.02)
    # The surface just beyond the boundary still finds the truth.
    shifted = uniform((mesh[0] - np.array([0, 0, 0.02]), mesh[1]), cropped, 0.0205)
    assert shifted.precision == shifted.recall == (1.0,)
    # Also where the truth is a cloud: no sample inside is farther from it than in the whole.
    cloud = exact_sphere(5000)
    guess = exact_sphere(4000)
    whole = score_surface(guess.kept(guess.points[:, 2] >= 0.3), None, Truth(cloud), [0.1])
    part = score_surface(guess, None, Truth(cloud, crop=crop), [0.1])
    assert part.predicted_count == whole.predicted_count < 4000
    assert part.accuracy_mean == whole.accuracy_mean
    outside = dataclasses.replace(cropped, crop=Region.box("off", [5] * 3, [6] * 3))
    with pytest.raises(UsageError, match="inside the crop"):
        uniform(mesh, outside, 0.01)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_nothing_scores_nothing_and_never_nan(protocol: str) -> None:
    crop = Region.box("around", [0.5] * 3, [2] * 3)
    labels = {"thin": np.ones(500, bool), "seen": np.full(500, 2, np.int32), "crop": crop}
    truth = truth_of(ball(3), 500, **labels)
    no_faces, no_area = EMPTY, (np.zeros((3, 3)), np.array([[0, 1, 2]]))
    for mesh in (no_faces, no_area, (ball(1)[0] * 0.1 + 9, ball(1)[1])):
        score = score_protocols(
            *mesh, truth, CAMERAS[:2], [0.1, 5.0], count=100, seed=0, protocols=[protocol]
        )[protocol]
        assert score.precision == score.recall == score.f1 == (0.0, 0.0)
        assert score.visible_recall == score.thin_recall == (0.0, 0.0)
        assert score.chamfer_mean == score.accuracy_median == score.completeness_mean == math.inf
        assert score.normal_consistency == score.normal_agreement == 0.0
        values = json.loads(json.dumps(score.to_json(), allow_nan=False))
        assert (values["chamfer_mean"], values["f1"]) == (None, [0.0, 0.0])
        assert values["predicted_count"] == 0 < values["truth_count"]


def test_scores_are_the_same_in_every_frame() -> None:
    mesh, guess, cameras = ball(3), (ball(3)[0] * 1.02 + 0.01, ball(3)[1]), CAMERAS[:4]

    def scores(offset: np.ndarray, threads: int) -> dict[str, SurfaceScore]:
        return score_protocols(
            guess[0] + offset, guess[1], truth_of((mesh[0] + offset, mesh[1]), 5000),
            [moved_camera(camera, offset) for camera in cameras],
            [0.02, 0.05], count=5000, threads=threads,
        )  # fmt: skip

    here, there = scores(np.zeros(3), 1), scores(OFFSET, 2)
    assert 0.1 < here["uniform"].f1[0] < 0.9
    for protocol in PROTOCOLS:
        one, other = here[protocol].to_json(), there[protocol].to_json()
        for name, value in one.items():
            if value is not None and not name.endswith("_count"):
                assert np.allclose(other[name], value, rtol=0, atol=1e-3), (protocol, name)
    assert here == scores(np.zeros(3), 3)


def test_what_cannot_be_scored_is_refused() -> None:
    mesh, truth = ball(2), truth_of(ball(2), 100)
    for thresholds in ([], [0.0], [0.1, -1.0], [np.nan], [np.inf]):
        with pytest.raises(UsageError, match="Thresholds"):
            uniform(mesh, truth, *thresholds)
    with pytest.raises(UsageError, match="unknown"):
        score_protocols(*mesh, truth, [], [0.1], protocols=["best"])
    with pytest.raises(UsageError, match="needs cameras"):
        score_protocols(*mesh, truth, [], [0.1], protocols=["scan"])
    broken = mesh[0].copy()
    broken[0] = np.nan
    for protocol in PROTOCOLS:
        with pytest.raises(MeshingError, match="not finite"):
            score_protocols(broken, mesh[1], truth, CAMERAS, [0.1], protocols=[protocol])


def test_clouds_are_scored_after_thinning() -> None:
    points = exact_sphere(20_000).points
    for offset in (np.zeros(3), OFFSET):
        same = score_clouds(points + offset, points + offset, 0.02, voxel=0.01)
        assert (same.precision, same.recall, same.f1) == (1.0, 1.0, 1.0)
        assert same.accuracy_mean == same.completeness_mean == 0.0
    # A thousandfold heap of errors in one cell counts as one point.
    heap = np.concatenate([points, np.tile([[3.0, 0, 0]], (20_000, 1))])
    raw = score_clouds(heap, points, 0.02, voxel=None)
    assert (raw.precision, raw.recall) == (0.5, 1.0)
    thinned = score_clouds(heap, points, 0.02, voxel=0.01)
    assert thinned.predicted_count == pytest.approx(thinned.truth_count + 1, rel=0.01)
    assert thinned.precision > 0.999
    half = score_clouds(points[points[:, 2] > 0], points, 1e-6, voxel=None)
    assert (half.precision, half.recall, half.f1) == (1.0, 0.5, pytest.approx(2 / 3))
    nothing = score_clouds(points[:0], points, 0.02, voxel=0.01)
    assert (nothing.precision, nothing.recall, nothing.f1) == (0.0, 0.0, 0.0)
    assert nothing.to_json()["accuracy_mean"] is None
    for guess, true, limit, voxel in (
        (points, points[:0], 0.02, 0.01),
        (points, points, 0.0, 0.01),
        (points, points, 0.02, 0.0),
        (points * np.nan, points, 0.02, None),
    ):
        with pytest.raises(UsageError):
            score_clouds(guess, true, limit, voxel=voxel)


def write(folder: Path, **changes: np.ndarray | None) -> dict[str, np.ndarray]:
    """Write a truth with changed entries, or without some."""
    vertices, faces = ball(2)
    samples = sample_uniformly(vertices, faces, 300, seed=0)
    values = {
        "vertices": vertices, "faces": faces.astype(np.int32),
        "points": samples.points.astype(np.float32), "normals": samples.normals,
        "thin": samples.points[:, 2] > 0.5, "seen": (np.arange(300) % 4).astype(np.int32),
        **changes,
    }  # fmt: skip
    values = {name: value for name, value in values.items() if value is not None}
    np.savez(folder / "truth.npz", **values)
    write_region(folder / "crop.json", Region.box("crop", [-2, -2, 0], [2, 2, 2]))
    return values


def test_a_folder_is_read_as_written(tmp_path: Path) -> None:
    values = write(tmp_path)
    truth = read_truth(tmp_path)
    assert (truth.mesh[0] == values["vertices"]).all()
    assert (truth.mesh[1] == values["faces"]).all()
    assert (truth.samples.points == values["points"]).all()
    assert truth.samples.points.dtype == truth.samples.normals.dtype == np.float64
    assert (truth.judged() == (values["points"][:, 2] >= 0)).all()
    assert (truth.visible() == (values["seen"] >= 2)).all()
    part = truth.kept(truth.thin)
    assert len(part.samples) == values["thin"].sum()
    assert (part.seen == values["seen"][values["thin"]]).all()


def test_a_wrong_entry_is_named(tmp_path: Path) -> None:
    for name, value in (
        ("thin", None),
        ("points", np.zeros((300, 2))),
        ("points", np.full((300, 3), np.nan)),
        ("points", np.zeros((0, 3))),
        ("faces", np.full((1, 3), 10_000)),
        ("faces", np.full((1, 3), -1)),
        ("faces", np.zeros((1, 3))),
        ("seen", np.zeros(299, np.int32)),
        ("vertices", np.full((3, 3), "a")),
        ("thin", np.array([{}] * 300, object)),
    ):
        write(tmp_path, **{name: value})
        with pytest.raises(ParseError) as caught:
            read_truth(tmp_path)
        assert caught.value.path.name == "truth.npz"
        told = f"{caught.value.location} {caught.value.message}"
        assert name in told or "ground truth" in str(caught.value) or value.dtype == object
        assert caught.value.hint


def test_broken_and_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ParseError, match=r"truth\.npz"):
        read_truth(tmp_path)
    write(tmp_path)
    (tmp_path / "crop.json").unlink()
    with pytest.raises(ParseError, match=r"crop\.json"):
        read_truth(tmp_path)
    whole = (tmp_path / "truth.npz").read_bytes()
    for broken in (b"", whole[: len(whole) // 2], whole[:300] + bytes(2000) + whole[2300:]):
        (tmp_path / "truth.npz").write_bytes(broken)
        with pytest.raises(ParseError, match=r"truth\.npz"):
            read_truth(tmp_path)
    samples = SurfaceSamples(np.zeros((4, 3)), np.zeros((4, 3)))
    for values, words in (
        ({"samples": samples, "vertices": np.zeros((3, 3))}, "not both"),
        ({"samples": SurfaceSamples.empty()}, "no samples"),
        ({"samples": samples, "seen": np.zeros(3, bool)}, "seen"),
    ):
        with pytest.raises(DatasetError, match=words):
            Truth(**values)
    assert Truth(samples).judged().all()
    assert Truth(samples).visible().all()
