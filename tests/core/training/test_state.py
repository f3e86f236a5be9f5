# SPDX-License-Identifier: GPL-3.0-or-later
"""State, checkpoints, cancellation."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import Cancelled, ParseError, UsageError
from gaussian_wrapping_addon.core.gaussians.model import TRAINED
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import trainer
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.density import needed_by_a_view
from gaussian_wrapping_addon.core.training.state import (
    CancellablePhotos,
    TrainingState,
    cancellable,
    fingerprint,
    load_checkpoint,
    remove_checkpoints,
    save_checkpoint,
)
from gaussian_wrapping_addon.core.training.wrapping import (
    WrapView,
    normal_errors,
    start_orientation,
)
from tests.core.render.scenes import random_gaussians
from tests.core.training.small_scene import sphere_gaussians, sphere_scene

# -- Checkpoints: round trip, number kept, broken files and files of another run ------------------


def filled(iteration: int = 7) -> TrainingState:
    state = TrainingState.start(random_gaussians(30, 1, dtype=torch.float32), 5)
    random = np.random.default_rng(iteration)
    for name in TRAINED:
        for moment in state.adam.moments(name):
            moment[...] = random.uniform(size=moment.shape)
    state.adam.steps[:] = np.arange(30)
    state.statistics.gradient[:] = 0.5
    state.statistics.views[:] = 3
    state.iteration = iteration
    state.next_view(list(range(9)))
    state.history = [{"iteration": 1.0, "loss": 0.25}]
    state.error_average, state.loss_average, state.seconds = 0.1, 0.2, 12.5
    state.rate_factor, state.restarts = 0.5, 1
    return state


def test_round_trip_is_exact_down_to_the_next_random_numbers(tmp_path: Path) -> None:
    state = filled()
    save_checkpoint(tmp_path, state, "key")
    back = load_checkpoint(tmp_path, "key")
    assert back is not None
    before, after = state.to_arrays(), back.to_arrays()
    assert before.keys() == after.keys()
    for name, array in before.items():
        assert array.dtype == after[name].dtype
        assert np.array_equal(array, after[name]), name
    assert state.to_json() == back.to_json()
    views = list(range(9))
    assert [state.next_view(views) for _ in range(30)] == [back.next_view(views) for _ in range(30)]
    assert np.array_equal(state.random.normal(size=9), back.random.normal(size=9))


def test_the_last_two_stay_and_none_is_no_error(tmp_path: Path) -> None:
    assert load_checkpoint(tmp_path, "key") is None
    for iteration in (5, 20, 100):
        save_checkpoint(tmp_path, filled(iteration), "key")
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == [
        "checkpoint-000000020.json", "checkpoint-000000020.npz",
        "checkpoint-000000100.json", "checkpoint-000000100.npz",
    ]  # fmt: skip
    found = load_checkpoint(tmp_path, "key")
    assert found is not None
    assert found.iteration == 100
    remove_checkpoints(tmp_path)
    assert list(tmp_path.iterdir()) == []


def rewritten(path: Path, arrays: dict[str, np.ndarray], *, compressed: bool = False) -> None:
    """Replace the npz and make the hash fit, as someone with bad intentions would."""
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)
    path.with_suffix(".npz").write_bytes(stream.getvalue())
    values = json.loads(path.read_text())
    values["sha256"] = hashlib.sha256(stream.getvalue()).hexdigest()
    path.write_text(json.dumps(values))


def break_npz_cut(path: Path) -> None:
    npz = path.with_suffix(".npz")
    npz.write_bytes(npz.read_bytes()[:-50])


def break_npz_missing(path: Path) -> None:
    path.with_suffix(".npz").unlink()


def break_npz_empty(path: Path) -> None:
    path.with_suffix(".npz").write_bytes(b"")


def break_json_cut(path: Path) -> None:
    path.write_text(path.read_text()[:200])


def break_json_list(path: Path) -> None:
    path.write_text("[]")


def break_version(path: Path) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), "version": 99}))


def break_state(path: Path) -> None:
    values = json.loads(path.read_text())
    del values["state"]["random"]["state"]
    path.write_text(json.dumps(values))


def break_shapes(path: Path) -> None:
    rewritten(path, {**filled().to_arrays(), "first.quats": np.zeros((29, 4), np.float32)})


def break_missing_array(path: Path) -> None:
    arrays = filled().to_arrays()
    del arrays["value.sh"]
    rewritten(path, arrays)


def break_object_array(path: Path) -> None:
    rewritten(path, {**filled().to_arrays(), "steps": np.array([{}] * 30, object)})


def break_bomb(path: Path) -> None:
    rewritten(path, {**filled().to_arrays(), "more": np.zeros(10**6)}, compressed=True)


BREAKAGES = [value for name, value in sorted(globals().items()) if name.startswith("break_")]


@pytest.mark.parametrize("breakage", BREAKAGES, ids=lambda f: f.__name__)
def test_a_broken_newest_falls_back_and_a_broken_only_one_is_refused(
    tmp_path: Path, breakage
) -> None:  # type: ignore[no-untyped-def]
    first = save_checkpoint(tmp_path, filled(10), "key")
    second = save_checkpoint(tmp_path, filled(20), "key")
    breakage(second)
    found = load_checkpoint(tmp_path, "key")
    assert found is not None
    assert found.iteration == 10
    breakage(first)
    with pytest.raises(ParseError) as caught:
        load_checkpoint(tmp_path, "key")
    assert "checkpoint-" in str(caught.value)
    assert caught.value.hint


def test_another_key_is_refused(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, filled(), "key")
    with pytest.raises(UsageError):
        load_checkpoint(tmp_path, "other")


def test_the_fingerprint_tells_inputs_apart() -> None:
    import dataclasses

    scene, _ = sphere_scene(views=9, size_px=24)
    settings = TrainingSettings()
    same = fingerprint(scene, dataclasses.replace(settings, checkpoint_every_s=1.0), 0)
    assert fingerprint(scene, settings, 0) == same
    view = scene.views[2]
    bent = dataclasses.replace(view.camera, fx=view.camera.fx * (1 + 1e-12))
    views = [*scene.views[:2], dataclasses.replace(view, camera=bent), *scene.views[3:]]
    others = {
        fingerprint(scene, settings, 1),
        fingerprint(scene, dataclasses.replace(settings, lambda_normal=0.05), 0),
        fingerprint(dataclasses.replace(scene, views=tuple(views)), settings, 0),
        fingerprint(dataclasses.replace(scene, views=scene.views[:-1]), settings, 0),
        fingerprint(dataclasses.replace(scene, points=scene.points[:-1]), settings, 0),
    }
    assert len(others) == 5
    assert same not in others


# -- Cancellation is checked in every loop over views before the next view is rendered ------------

VIEWS = 5
SMALL = TrainingSettings(iterations=10, max_gaussians=200, wrap_rounds=1)


def vote(adam: Adam, views: object) -> None:
    start_orientation(adam, views, threads=1)


def look_at_normals(adam: Adam, views: object) -> None:
    normal_errors(adam.gaussians(), views, threads=1)


def look_at_contributions(adam: Adam, views: object) -> None:
    needed_by_a_view(adam.gaussians().detached(), views, ViewRenderer(), 0.1, threads=1)


@pytest.mark.parametrize("loop", [vote, look_at_normals, look_at_contributions])
@pytest.mark.parametrize("after", [0, 1, 3])
def test_no_view_is_rendered_after_the_request(
    monkeypatch: pytest.MonkeyPatch, loop: Callable[[Adam, object], None], after: int
) -> None:
    _, photos = sphere_scene()
    adam = Adam(sphere_gaussians(40).replaced(orientation=torch.zeros(40, 4)))
    before = {name: adam.array(name).copy() for name in adam.values}
    rendered: list[int] = []
    honest = ViewRenderer.render
    monkeypatch.setattr(
        ViewRenderer, "render", lambda *a, **o: rendered.append(1) or honest(*a, **o)
    )
    progress = Progress(is_cancelled=lambda: len(rendered) >= after)
    views = (WrapView(photos.camera(i), None) for i in range(VIEWS))
    with pytest.raises(Cancelled):
        loop(adam, cancellable(views, progress))
    assert len(rendered) == after
    assert all((before[name] == adam.array(name)).all() for name in before)


def test_without_a_request_every_item_comes_once() -> None:
    assert list(cancellable(range(VIEWS), Progress())) == list(range(VIEWS))
    assert list(cancellable(np.arange(0), Progress())) == []


@pytest.mark.parametrize("fetched", [1, 7, 20])
def test_looking_at_photos_before_the_first_iteration_can_be_cancelled(
    tmp_path: Path, fetched: int
) -> None:
    scene, photos = sphere_scene()
    seen = [0]

    class Counted(CancellablePhotos):
        def photo(self, index: int, divisor: int = 1) -> np.ndarray:
            seen[0] += 1
            return super().photo(index, divisor)

    progress = Progress(is_cancelled=lambda: seen[0] >= fetched)
    with pytest.raises(Cancelled):
        trainer.train(scene, Counted(photos, Progress()), SMALL, tmp_path, progress, threads=1)
    assert seen[0] <= fetched + 1
