# SPDX-License-Identifier: GPL-3.0-or-later
"""Training runs on a tiny scene: quality, resuming, masks, non-finite values, backdrop."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import Cancelled, DatasetError, UsageError, WrapError
from gaussian_wrapping_addon.core.gaussians.files import write_splat_ply
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians, gaussians_at
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import cpu_backend, iteration, live_view, rounds, trainer
from gaussian_wrapping_addon.core.training.focus import Focus
from gaussian_wrapping_addon.core.training.start import LEAST_REACH
from gaussian_wrapping_addon.core.training.state import TrainingResult, cancellable
from gaussian_wrapping_addon.core.training.trainer import train, with_backdrop
from tests.core.training.small_scene import PhotosInMemory, sphere_gaussians, sphere_scene
from tests.synthetic import look_at

# -- Training runs on a tiny scene: quality, resuming, cancellation, masks, non-finite values -----

SETTINGS = TrainingSettings(
    iterations=40, max_gaussians=400, max_image_px=32, sh_degree=1, densify_every=5,
    wrap_rounds=2, checkpoint_every_s=1e9,
)  # fmt: skip


def assert_same(a: OrientedGaussians, b: OrientedGaussians) -> None:
    for name, tensor in a.tensors():
        assert torch.equal(tensor, getattr(b, name)), name


class StopAt:
    """Progress that cancels once an iteration was reported."""

    def __init__(self, iteration: int) -> None:
        self.iteration, self.reached = iteration, False
        self.events: list[ProgressEvent] = []

    def sink(self, event: ProgressEvent) -> None:
        self.events.append(event)
        self.reached |= event.figures.get("iteration", 0.0) >= self.iteration

    def progress(self) -> Progress:
        return Progress("train", self.sink, lambda: self.reached)


def test_training_learns_the_photos_it_never_saw(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=16, size_px=24)
    settings = dataclasses.replace(SETTINGS, iterations=400, densify_every=20, wrapping="on")
    watch = StopAt(10**9)
    result = train(scene, photos, settings, tmp_path, watch.progress(), seed=1, threads=2)
    assert [f.name for f in result.held_out] == ["000.png", "008.png"]
    assert result.held_out_psnr > 24.0
    assert result.held_out_ssim > 0.85
    assert len(result.gaussians) <= settings.max_gaussians
    assert result.gaussians.sh_degree == settings.sh_degree == 1
    assert all(torch.isfinite(t).all() for _, t in result.gaussians.tensors())
    values = result.to_json()
    json.dumps(values, allow_nan=False)
    assert values["held_out_psnr"] == result.held_out_psnr
    assert "iteration 20/400 · loss 0." in " ".join(e.message for e in watch.events)
    # The oriented normals of what is seen point away from the sphere's middle.
    normals = result.gaussians.normals().numpy()
    means = result.gaussians.means.numpy()
    strong = np.linalg.norm(normals, axis=1) > 0.3
    opaque = result.gaussians.log_opacities().exp().numpy() > 0.5
    outward = (normals * means).sum(1)[strong & opaque] > 0
    assert outward.size > 30
    assert outward.mean() > 0.75


class _LikenessOfSize:
    """Stands for LPIPS."""

    def __init__(self, min_side_px: int) -> None:
        self.min_side_px = min_side_px

    def fits(self, shape: tuple[int, ...]) -> bool:
        return min(shape[:2]) >= self.min_side_px

    def distance(self, image: np.ndarray, photo: np.ndarray) -> float:
        assert image.shape == photo.shape == (24, 24, 3)
        return 0.25


@pytest.mark.parametrize(
    ("found", "value", "note"),
    [
        ((_LikenessOfSize(24), ""), 0.25, ""),
        ((_LikenessOfSize(25), ""), None, live_view.TOO_SMALL),
        ((None, "The weights are not here."), None, "The weights are not here."),
    ],
)
def test_held_out_photos_get_a_likeness_or_the_reason_why_not(
    monkeypatch: pytest.MonkeyPatch, found: tuple, value: float | None, note: str
) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    monkeypatch.setattr(live_view, "lpips_if_ready", lambda: found)
    names = {view: scene.views[view].camera.name for view in (0, 8)}
    figures, said = live_view.held_out_metrics(
        sphere_gaussians(), photos, names, Progress(), threads=1
    )
    values = TrainingResult(sphere_gaussians(), 1, (), tuple(figures), 1.0, (), said).to_json()
    assert len(values["held_out"]) == 2
    assert said == values.get("lpips_note", "") == note
    for entry in values["held_out"]:
        assert set(entry) == {"name", "psnr", "ssim"} | ({"lpips"} if value else set())
        assert entry.get("lpips") == value
    assert values.get("held_out_lpips") == value


@pytest.mark.parametrize(
    ("focus", "changed"),
    [
        (None, {}),
        (  # at 64 px the box has less than the photo, at 24 px with its border all of it
            Focus([Region.box("box", np.full(3, -0.05), np.full(3, 0.1))]),
            {"refine_poses": "on", "coarse_to_fine": "off"},
        ),
    ],
)
def test_killed_and_resumed_is_bit_for_bit_the_same(
    focus: Focus | None, changed: dict[str, str], tmp_path: Path
) -> None:
    scene, photos = sphere_scene(views=9, size_px=24 if focus is None else 64)
    settings = dataclasses.replace(SETTINGS, max_image_px=64, **changed)  # type: ignore[arg-type]
    if focus is not None:
        (box,) = focus.rectangles(photos.camera(0))
        assert box.width * box.height < 0.5 * 64 * 64

    def trained(folder: str, progress: Progress, threads: int, seed: int = 3) -> TrainingResult:
        (tmp_path / folder).mkdir(exist_ok=True)
        return train(
            scene, photos, settings, tmp_path / folder, progress, seed=seed, threads=threads,
            focus=focus,
        )  # fmt: skip

    whole = trained("a", Progress(), 1)
    assert whole.model_selection.chose("region_weight") == (focus is not None)
    for stop in (10, 20, 30):
        with pytest.raises(Cancelled):
            trained("b", StopAt(stop).progress(), 2)
    assert len(list((tmp_path / "b").glob("checkpoint-*.json"))) == 2
    # The newest is broken: the one before it leads to the same end.
    newest = sorted((tmp_path / "b").glob("checkpoint-*.npz"))[-1]
    newest.write_bytes(newest.read_bytes()[:-100])
    resumed = trained("b", Progress(), 2)
    assert_same(whole.gaussians, resumed.gaussians)
    assert whole.held_out == resumed.held_out
    other = trained("c", Progress(), 1, seed=4)
    assert not torch.equal(other.gaussians.means[:50], whole.gaussians.means[:50])


def test_a_checkpoint_of_something_else_is_refused(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    with pytest.raises(Cancelled):
        train(scene, photos, SETTINGS, tmp_path, StopAt(10).progress(), threads=1)
    changed = dataclasses.replace(SETTINGS, iterations=50)
    with pytest.raises(UsageError):
        train(scene, photos, changed, tmp_path, Progress(), threads=1)
    moved = dataclasses.replace(scene, points=scene.points + 0.1)
    with pytest.raises(UsageError):
        train(moved, photos, SETTINGS, tmp_path, Progress(), threads=1)


def test_masked_pixels_teach_nothing(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    mask = np.ones((24, 24), bool)
    mask[:, 14:] = False
    painted = [p.copy() for p in photos.photos]
    for photo in painted:
        photo[:, 14:] = (255, 0, 255)
    settings = dataclasses.replace(SETTINGS, iterations=15, holdout_every=0)
    results = []
    for i, shown in enumerate((photos.photos, painted)):
        (tmp_path / str(i)).mkdir()
        store = PhotosInMemory(scene, shown, [mask] * 9)
        results.append(train(scene, store, settings, tmp_path / str(i), Progress(), threads=1))
    assert results[0].held_out == ()
    assert_same(results[0].gaussians, results[1].gaussians)
    black = PhotosInMemory(scene, painted, [np.zeros((24, 24), bool)] * 9)
    with pytest.raises(DatasetError):
        train(scene, black, settings, tmp_path, Progress(), threads=1)


def test_numbers_that_break_down_are_recovered_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    settings = dataclasses.replace(SETTINGS, iterations=20)
    honest, bad = cpu_backend.color_loss, {7}
    calls = [0]

    def sometimes_nan(*arguments, **named):  # type: ignore[no-untyped-def]
        calls[0] += 1
        loss, gradient, figures = honest(*arguments, **named)
        return (loss * float("nan") if calls[0] in bad else loss), gradient, figures

    monkeypatch.setattr(cpu_backend, "color_loss", sometimes_nan)
    result = train(scene, photos, settings, tmp_path, Progress(), threads=1)
    assert any("went back from iteration 6 to 0" in w.text for w in result.warnings)
    assert all(torch.isfinite(t).all() for _, t in result.gaussians.tensors())
    calls[0], bad = 0, {7, 12}
    (tmp_path / "again").mkdir()
    with pytest.raises(WrapError, match="twice"):
        train(scene, photos, settings, tmp_path / "again", Progress(), threads=1)


def test_a_start_from_an_oriented_splat_keeps_its_orientation(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=9, size_px=32)
    truth = sphere_gaussians(150)
    given = truth.orientation.clone()
    given[::2, 3] *= -1.0  # every other one inwards, which no vote would give
    path = tmp_path / "oriented.ply"
    write_splat_ply(path, truth.replaced(orientation=given), scene.world_from_scene)
    settings = dataclasses.replace(
        SETTINGS, iterations=10, wrapping="on", wrap_rounds=0, full_size="on"
    )
    result = train(scene, photos, settings, tmp_path, Progress(), threads=1, start=path)
    assert len(result.gaussians) == 150
    outward = (result.gaussians.normals().detach() * truth.means).sum(1).numpy()
    assert (outward[::2] < 0).all(), "a few iterations turn no normal over"
    assert (outward[1::2] > 0).all()


def test_training_more_equals_a_longer_run(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    settings = dataclasses.replace(SETTINGS, iterations=25)
    longer = dataclasses.replace(settings, extra_iterations=15)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    whole = train(scene, photos, longer, tmp_path / "a", Progress(), seed=2, threads=1)
    short = train(scene, photos, settings, tmp_path / "b", Progress(), seed=2, threads=2)
    more = train(scene, photos, longer, tmp_path / "b", Progress(), seed=2, threads=2)
    assert (short.iterations, more.iterations) == (25, 40)
    assert not torch.equal(short.gaussians.means[:50], more.gaussians.means[:50])
    assert_same(whole.gaussians, more.gaussians)
    assert whole.held_out == more.held_out


def test_training_more_twice_equals_once(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    settings = dataclasses.replace(SETTINGS, iterations=20)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for extra in (0, 15, 30) if name == "a" else (30,):
            longer = dataclasses.replace(settings, extra_iterations=extra)
            last = train(scene, photos, longer, tmp_path / name, Progress(), seed=2, threads=1)
        if name == "a":
            twice = last.gaussians
    assert_same(twice, last.gaussians)


def test_without_a_dense_start_photos_alone_decide_on_opacities(tmp_path: Path) -> None:
    """Gaussians are not in the right places yet: opaque ones would hide what has to move."""
    scene, photos = sphere_scene(views=9, size_px=24)
    found = []
    for weight in (0.0, 1.0):
        folder = tmp_path / str(weight)
        folder.mkdir()
        settings = dataclasses.replace(SETTINGS, dense_start="off", lambda_opacity=weight)
        found.append(train(scene, photos, settings, folder, Progress(), seed=1, threads=1))
    assert_same(found[0].gaussians, found[1].gaussians)


def test_windows_and_neighbours_resume_bit_for_bit(tmp_path: Path) -> None:
    """Neighbours bring Gaussians that the window has culled: memory of other views is no state."""
    scene, photos = sphere_scene(views=30, size_px=40)
    settings = dataclasses.replace(
        SETTINGS, iterations=60, pixels_per_iteration=450, multi_view="on", overlap_price=1e-3,
        multi_view_pixels=100, max_gaussians=1500, dense_start="off",
    )  # fmt: skip
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    whole = train(scene, photos, settings, tmp_path / "a", Progress(), seed=3, threads=1)
    assert whole.model_selection.chose("multi_view")
    for stop in (30, 40):
        with pytest.raises(Cancelled):
            train(scene, photos, settings, tmp_path / "b", StopAt(stop).progress(), seed=3)
    resumed = train(scene, photos, settings, tmp_path / "b", Progress(), seed=3, threads=2)
    assert_same(whole.gaussians, resumed.gaussians)


def test_the_price_is_asked_of_gaussians_that_this_view_has_placed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that only the neighbour brings have no box here; memory of other views is no state."""
    scene, photos = sphere_scene(views=30, size_px=40)
    settings = dataclasses.replace(
        SETTINGS, iterations=60, pixels_per_iteration=450, multi_view="on", overlap_price=1e-3,
        multi_view_pixels=300, max_gaussians=1500, dense_start="off",
    )  # fmt: skip
    views, brought = [], [0]
    render_view, merge, price = (
        ViewRenderer.render, cpu_backend.merge_gradients, cpu_backend.add_footprint_regulariser,
    )  # fmt: skip

    def rendered(self, *arguments, **named):  # type: ignore[no-untyped-def]
        views.append(render_view(self, *arguments, **named))
        return views[-1]

    def merged(first, second, *arguments, **named):  # type: ignore[no-untyped-def]
        brought[0] += len(np.setdiff1d(second.ids, first.ids))
        return merge(first, second, *arguments, **named)

    def priced(gradients, *arguments):  # type: ignore[no-untyped-def]
        assert np.isin(gradients.ids, views[-1].ids).all()
        return price(gradients, *arguments)

    monkeypatch.setattr(ViewRenderer, "render", rendered)
    monkeypatch.setattr(cpu_backend, "merge_gradients", merged)
    monkeypatch.setattr(cpu_backend, "add_footprint_regulariser", priced)
    train(scene, photos, settings, tmp_path, Progress(), seed=3, threads=1)
    assert brought[0] > 0


def test_broken_numbers_are_never_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    watch = StopAt(30)
    honest = iteration.Stepper.step

    def breaks(self, state):  # type: ignore[no-untyped-def]
        honest(self, state)
        if state.iteration == 25:
            state.adam.array("means")[3, 1] = np.nan

    monkeypatch.setattr(iteration.Stepper, "step", breaks)
    with pytest.raises(Cancelled):
        train(scene, photos, SETTINGS, tmp_path, watch.progress(), threads=1)
    monkeypatch.setattr(iteration.Stepper, "step", honest)
    for path in tmp_path.glob("checkpoint-*.npz"):
        with np.load(path) as arrays:
            assert all(np.isfinite(arrays[name]).all() for name in arrays.files)
    result = train(scene, photos, SETTINGS, tmp_path, Progress(), threads=1)
    assert all(torch.isfinite(t).all() for _, t in result.gaussians.tensors())


def test_windows_that_a_mask_empties_say_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, photos = sphere_scene(views=9, size_px=40)
    mask = np.zeros((40, 40), bool)
    mask[:12, :12] = True
    store = PhotosInMemory(scene, photos.photos, [mask] * 9)
    settings = dataclasses.replace(
        SETTINGS, iterations=30, pixels_per_iteration=450, holdout_every=0, exposure="off"
    )
    run = trainer._Trainer(scene, store, settings, tmp_path, 0, 1)
    state = run._start(rounds.Rounds(run.stepper, Progress()), "key")
    shown = []
    monkeypatch.setattr(
        run.stepper, "_is_empty", lambda sample: shown.append(sample.shown.pixels) or False
    )
    for _ in range(30):
        run.stepper.step(state)
    assert len(shown) == 30
    assert min(shown) > 0
    assert state.error_average > 0


@pytest.mark.parametrize("where", ["_prune", "_wrap"])
def test_a_round_that_is_cancelled_half_way_is_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    settings = dataclasses.replace(SETTINGS, wrapping="on", prune_share=0.05)
    whole = train(scene, photos, settings, tmp_path / "a", Progress(), seed=1, threads=1)
    honest, calls = getattr(rounds.Rounds, where), [0]

    def cut(self, state):  # type: ignore[no-untyped-def]
        calls[0] += 1
        if calls[0] == 2:
            raise Cancelled()
        return honest(self, state)

    monkeypatch.setattr(rounds.Rounds, where, cut)
    with pytest.raises(Cancelled):
        train(scene, photos, settings, tmp_path / "b", Progress(), seed=1, threads=1)
    resumed = train(scene, photos, settings, tmp_path / "b", Progress(), seed=1, threads=1)
    assert calls[0] > 2
    assert_same(whole.gaussians, resumed.gaussians)


def test_every_decision_is_written_down_and_can_be_overridden(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    names = {"full_size", "exposure", "multi_view", "dense_start", "refine_poses"}
    parts = {*names, "growth", "harmonics", "wrapping"}
    settings = dataclasses.replace(SETTINGS, densify_until=0.9)
    result = train(scene, photos, settings, tmp_path, Progress(), threads=1)
    assert {d.name for d in result.model_selection} == names
    assert all(d.evidence and d.setting == "auto" for d in result.model_selection)
    for word, degree in (("on", 1), ("off", 0)):
        (tmp_path / word).mkdir()
        asked = dataclasses.replace(settings, **dict.fromkeys(parts, word))
        result = train(scene, photos, asked, tmp_path / word, Progress(), threads=1)
        assert {d.name for d in result.model_selection} == names
        assert all(d.setting == word for d in result.model_selection)
        assert result.gaussians.sh_degree == degree
        assert result.exposure_fitted == (word == "on")
        lengths = np.linalg.norm(result.gaussians.normals().numpy(), axis=1)
        assert (lengths.max() > 0) == (word == "on")


def test_masks_can_mean_that_nothing_is_there(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    mask = np.zeros((24, 24), bool)
    mask[4:20, 4:20] = True
    store = PhotosInMemory(scene, photos.photos, [mask] * 9)
    clear = {}
    for mode in ("ignore", "background"):
        (tmp_path / mode).mkdir()
        settings = dataclasses.replace(
            SETTINGS, iterations=150, mask_mode=mode, exposure="off", holdout_every=0
        )
        result = train(scene, store, settings, tmp_path / mode, Progress(), threads=1)
        alpha = render(result.gaussians, store.camera(0), RenderOptions(threads=1)).alpha.numpy()
        clear[mode] = float(alpha[~mask].mean())
    assert clear["background"] < 0.5 * clear["ignore"]
    assert clear["background"] < 0.25


# -- A sphere behind everything, in the photos' colours, where no photo sees through --------------

WIDTH, HEIGHT = 72, 48
WALL_X, HALF_SIDE = 6.0, 4.0
COLOR = np.array([0.7, 0.5, 0.2])
DEGREE = 1


def camera(at: tuple[float, ...], to: tuple[float, ...], focal_px: float = 90.0) -> Camera:
    return look_at(np.array(at), np.array(to), "view", WIDTH, HEIGHT, focal_px)


AT_WALL = [camera((0, y, 0.3), (WALL_X, y, 0.0)) for y in (-1.0, 0.0, 1.0)]
PAST_WALL = camera((0, 6.0, 0.0), (WALL_X, 6.0, 0.1))
"""In a direction in which the others see the wall, from a place beyond its border."""
INTO_NOTHING = camera((0, 0, 0), (-WALL_X, 0.0, 0.1))


class Photos:
    """The cameras of a photo source; the photos themselves are not needed."""

    def __init__(self, cameras: list[Camera]) -> None:
        self.cameras = cameras

    def camera(self, index: int, divisor: int = 1) -> Camera:
        assert divisor == 1  # small enough
        return self.cameras[index]


def wall() -> OrientedGaussians:
    """Return two opaque layers of flat Gaussians of one colour."""
    across = np.arange(-HALF_SIDE, HALF_SIDE, 0.2)
    y, z, x = (axis.reshape(-1) for axis in np.meshgrid(across, across, [WALL_X, WALL_X + 0.1]))
    points, count = np.stack([x, y, z], 1), len(x)
    return gaussians_at(
        points, np.tile(COLOR, (count, 1)), np.full(count, 0.16), DEGREE,
        normals=np.tile([-1.0, 0, 0], (count, 1)), flatness=0.1, opacities=0.95,
    )  # fmt: skip


def backed(cameras: list[Camera]) -> OrientedGaussians:
    return with_backdrop(wall(), Photos(cameras), range(len(cameras)), threads=1)


def rendered(gaussians: OrientedGaussians, view: Camera) -> np.ndarray:
    raw, options = RawArrays.from_gaussians(gaussians), RenderOptions(depth=False, threads=1)
    return ViewRenderer().render(raw, view, options).color.copy()


def test_beyond_the_border_lie_the_colours_of_the_wall() -> None:
    middle = np.s_[16:32, 24:48]
    assert np.abs(rendered(wall(), PAST_WALL)[middle]).max() < 0.01
    found = rendered(backed(AT_WALL), PAST_WALL)[middle]
    np.testing.assert_allclose(found, np.broadcast_to(COLOR, found.shape), atol=0.08)


def test_training_views_stay_as_they_are() -> None:
    before, after = wall(), backed(AT_WALL)
    for view in AT_WALL:
        change = np.abs(rendered(after, view) - rendered(before, view))
        assert change.max() < 0.5 / 255


def test_the_trained_gaussians_come_first_unchanged() -> None:
    before, after = wall(), backed(AT_WALL)
    assert len(after) > len(before)
    assert after.sh_degree == DEGREE
    for (name, old), (_, new) in zip(before.tensors(), after.tensors(), strict=True):
        assert (new[: len(old)] == old).all(), name
    assert (after.means[len(before) :].norm(dim=1) > 0.99 * LEAST_REACH).all()


def test_where_a_photo_sees_through_it_stays_open() -> None:
    after = backed([*AT_WALL, INTO_NOTHING])
    assert rendered(after, INTO_NOTHING)[20:28, 32:40].max() < 0.02
    # Without this photo, the same directions are unknown and filled.
    assert rendered(backed(AT_WALL), INTO_NOTHING)[20:28, 32:40].min() > 0.1


def test_photos_of_nothing_give_no_colours() -> None:
    for cameras in ([], [INTO_NOTHING]):
        assert len(backed(cameras)) == len(wall())


def test_it_can_be_cancelled() -> None:
    views = cancellable(range(3), Progress(is_cancelled=lambda: True))
    with pytest.raises(Cancelled):
        with_backdrop(wall(), Photos(AT_WALL), views, threads=1)
