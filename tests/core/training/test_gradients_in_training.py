# SPDX-License-Identifier: GPL-3.0-or-later
"""Every iteration of a training on a device has the loss and the gradients of the processor's.

Both start each iteration from the processor's state, which goes on alone: what rounding does to the
next iterations is not compared here.

Two things change the gradients of the Gaussians on a pixel by more than rounding does, though both
sides are right. Where two views agree to :data:`ROUNDING_PX`, the direction of the reprojection
error, and with it the gradient of its length, is rounding: gradients of such iterations are not
compared, but losses are. And rounding may decide about a threshold (1/255 of opacity, a confirmed
depth 3 % away): one such iteration of a training is excused."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.gaussians.model import TRAINED
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthPrior
from gaussian_wrapping_addon.core.training import multi_view
from gaussian_wrapping_addon.core.training.backend import Backend
from gaussian_wrapping_addon.core.training.camera_poses import CameraPoses, PosedPhotos
from gaussian_wrapping_addon.core.training.cpu_backend import CpuBackend
from gaussian_wrapping_addon.core.training.exposure import Exposure
from gaussian_wrapping_addon.core.training.iteration import Stepper
from gaussian_wrapping_addon.core.training.model_selection import Decision, ModelSelection
from gaussian_wrapping_addon.core.training.multi_view import find_neighbours
from gaussian_wrapping_addon.core.training.rounds import Rounds
from gaussian_wrapping_addon.core.training.schedule import Schedule
from gaussian_wrapping_addon.core.training.state import TrainingState
from tests.core.device_kernels import DEVICES
from tests.core.training.device_training import backend_of, perturbed_sphere
from tests.core.training.small_scene import RADIUS, PhotosInMemory, sphere_scene

ITERATIONS, VIEWS = 16, 30

SETTINGS = TrainingSettings(
    iterations=ITERATIONS, max_gaussians=160, max_image_px=32, sh_degree=1, densify_every=4,
    wrap_rounds=2, multi_view="on", multi_view_pixels=150, multi_view_until=1.0, depth_from=0.1,
    orient_from=0.3, wrap_from=0.5, wrap_until=0.7, degree_every=0.2,
    harmonics="on", wrapping="on", growth="on", exposure="off", refine_poses="off",
    dense_start="off",
)  # fmt: skip

GRADIENTS, LOSS = 1e-4, 1e-5
"""Largest difference of a tensor's gradient (of all Gaussians), and of a loss, as a share."""

ROUNDING_PX = 1e-5
"""Float32 depths give reprojection errors to a few millionths of a pixel."""

SEED = 5


@dataclass(frozen=True)
class Case:
    """What is trained with."""

    settings: TrainingSettings
    size_px: int = 24
    masks: bool = False
    exposure: bool = False
    poses: bool = False
    priors: bool = False


CASES = {
    "views": Case(SETTINGS),
    "masks": Case(
        dataclasses.replace(SETTINGS, mask_mode="ignore"), masks=True, exposure=True, poses=True
    ),
    "background": Case(
        dataclasses.replace(SETTINGS, mask_mode="background", growth="on"),
        masks=True, exposure=True, priors=True,
    ),
    "windows": Case(
        dataclasses.replace(SETTINGS, pixels_per_iteration=1500, growth="on"),
        size_px=64, masks=True, poses=True,
    ),
}  # fmt: skip


def sphere_prior(photos: PhotosInMemory, view: int) -> DepthPrior:
    """Return the depth of the sphere as a view confirms it, and a few per cent too far."""
    camera = photos.camera(view)
    rays = camera.rays()  # (h, w, 3), z = 1
    middle = camera.cam_from_world[:, 3]  # of the sphere, in the camera's frame
    along, squares = rays @ middle, (rays * rays).sum(2)
    root = along**2 - squares * (middle @ middle - RADIUS**2)
    depth = (along - np.sqrt(np.maximum(root, 0.0))) / squares
    depth = np.where(root > 0.05, 1.004 * depth, 0.0).astype(np.float32)
    return DepthPrior(
        camera, depth, (depth > 0).astype(np.float32), depth.copy(), np.zeros_like(depth)
    )


def dense(gradients: Any, count: int) -> dict[str, np.ndarray]:
    """Return the gradients of a backend as copies, with a row for every Gaussian."""
    found = {}
    for name in TRAINED:
        if isinstance(gradients, dict):
            if name in gradients:
                found[name] = gradients[name].cpu().numpy().copy()
            continue
        given = getattr(gradients, name)
        found[name] = np.zeros((count, *given.shape[1:]), np.float32)
        found[name][gradients.ids] = given
    return found


class Run:
    """A training on one backend; keeps what its last iteration computed."""

    def __init__(self, case: Case, backend: Backend) -> None:
        scene, photos = sphere_scene(views=VIEWS, size_px=case.size_px)
        if case.masks:
            mask = np.zeros((case.size_px, case.size_px), bool)
            mask[2:, 3:-2] = True  # in every photo, and through the sphere
            mask[case.size_px // 2 :, case.size_px // 2 :] = False
            photos = PhotosInMemory(scene, photos.photos, [mask] * VIEWS)
        settings, self.views = case.settings, list(range(1, VIEWS))
        schedule = Schedule(settings, case.size_px)
        near = find_neighbours([photos.camera(v) for v in self.views], points=scene.points)
        numbers = np.array(self.views)
        neighbours = {v: numbers[found] for v, found in zip(self.views, near, strict=True)}
        assert all(len(found) for found in neighbours.values())
        self.backend, self.posed, self.case = backend, PosedPhotos(photos), case
        self.stepper = Stepper(self.posed, schedule, self.views, neighbours, backend, 1)
        if case.priors:
            self.stepper.priors = {v: sphere_prior(photos, v) for v in self.views}
        self.rounds = Rounds(self.stepper, Progress())
        self.gradients: dict[str, np.ndarray] = {}
        self.by_pose: Any = None
        self._watch()

    def _watch(self) -> None:
        add_priors, merged, numbers = (
            self.backend.add_priors, self.backend.merged, self.backend.numbers
        )  # fmt: skip

        def add(image: Any, gradients: Any, adam: Any, *weights: float) -> None:
            add_priors(image, gradients, adam, *weights)
            self.gradients = dense(gradients, len(adam))  # of this iteration; the first of them

        def merge(gradients: Any, other: Any, count: int) -> Any:
            for name, rows in dense(other, count).items():
                self.gradients[f"other {name}"] = rows
            return merged(gradients, other, count)

        def read(*values: Any) -> list[np.ndarray]:
            found = numbers(*values)
            self.by_pose = found[2] if len(found) > 2 else None
            return found

        self.backend.add_priors = add  # type: ignore[method-assign]
        self.backend.merged, self.backend.numbers = merge, read  # type: ignore[method-assign]

    def start(self, seed: int) -> TrainingState:
        """Return a state of which no value is one at which a derivative jumps."""
        state = TrainingState.start(perturbed_sphere(120, seed), seed)
        selection = ModelSelection((Decision.by_settings("multi_view", "on"),))
        if self.case.priors:
            selection = selection.with_decision(Decision.by_settings("dense_start", "on"))
        state.model_selection = selection
        if self.case.exposure:
            gains = 0.1 * np.random.default_rng(seed).normal(size=(VIEWS, 3))
            state.exposure = Exposure(VIEWS, self.views, gains)
        if self.case.poses:
            given = [view.camera.cam_from_world for view in sphere_scene(VIEWS)[0].views]
            state.poses = CameraPoses(np.array(given), self.views)
        self.adopt(state)
        self.rounds.filter(state)
        return state

    def adopt(self, state: TrainingState) -> TrainingState:
        """Take a state over."""
        state.adam = self.backend.adopted(state.adam)
        state.statistics = self.backend.adopted_statistics(state.statistics)
        self.posed.poses = state.poses
        return state


def both_states(cpu: Run, other: Run, seed: int) -> Iterator[tuple[TrainingState, TrainingState]]:
    """Yield the states of both runs after each iteration that both begin in the same state."""
    state = cpu.start(seed)
    for _ in range(ITERATIONS):
        cpu.rounds.before_step(state)
        state.loss_average = state.error_average = 0.0  # the averages are this iteration's then
        twin = other.adopt(TrainingState.of_snapshot(state.snapshot()))
        cpu.stepper.step(state)
        other.stepper.step(twin)
        yield state, twin
        cpu.rounds.after_step(state)


def apart(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the L2 norm of the difference as a share of that of the wanted."""
    norm = float(np.linalg.norm(wanted.astype(np.float64)))
    difference = float(np.linalg.norm(found.astype(np.float64) - wanted))
    return difference / norm if norm else difference


def watched_noises(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return a list that receives the smallest reprojection error of each multi-view term."""
    found: list[float] = []
    honest = multi_view.return_range

    def watched(begin: int, end: int, *arguments: Any) -> None:
        honest(begin, end, *arguments)
        found.append(float(arguments[8][begin:end].min(initial=np.inf)))

    monkeypatch.setattr(multi_view, "return_range", watched)
    return found


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("device", DEVICES)
def test_each_iteration_has_the_gradients_of_the_processors(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, device: str, name: str
) -> None:
    cpu, other = Run(CASES[name], CpuBackend(1)), Run(CASES[name], backend_of(device, request))
    noises = watched_noises(monkeypatch)
    over, compared, trained, counts = [], 0, set(), set()
    for wanted, found in both_states(cpu, other, seed=SEED):
        assert found.random.bit_generator.state == wanted.random.bit_generator.state
        assert found.order == wanted.order
        assert np.array_equal(found.statistics.views, wanted.statistics.views)
        for name in cpu.gradients.keys() - other.gradients.keys():
            assert not np.any(cpu.gradients[name]), name
        trained |= {name for name, rows in cpu.gradients.items() if np.any(rows)}
        counts.add(len(wanted.adam))
        losses = {
            name: apart(np.array(getattr(found, name)), np.array(getattr(wanted, name)))
            for name in ("loss_average", "error_average")
        }
        gaps = gradient_gaps(other, cpu, found, wanted)
        by_rounding = min(noises, default=np.inf) < ROUNDING_PX
        noises.clear()
        compared += not by_rounding
        if max(losses.values()) > LOSS or (max(gaps.values()) > GRADIENTS and not by_rounding):
            over.append({**losses, **gaps})
    assert {n for n in trained if not n.startswith("other")} == set(TRAINED)
    assert {n for n in trained if n.startswith("other")} == {
        f"other {n}" for n in ("means", "log_scales", "quats", "opacity_logits")
    }
    assert len(counts) >= 3, "density control and wrapping are part of it"
    assert compared >= ITERATIONS // 2
    assert len(over) <= 1, over


def gradient_gaps(
    other: Run, cpu: Run, found: TrainingState, wanted: TrainingState
) -> dict[str, float]:
    """Return how far gradients, on whatever is trained, and density statistics are apart."""
    gaps = {k: apart(rows, cpu.gradients[k]) for k, rows in other.gradients.items()}
    for name in ("gradient", "gradient_abs"):
        gaps[name] = apart(getattr(found.statistics, name), getattr(wanted.statistics, name))
    if wanted.exposure is not None and found.exposure is not None:
        gaps["exposure"] = apart(found.exposure.gradient, wanted.exposure.gradient)
    assert (cpu.by_pose is None) == (other.by_pose is None)
    if cpu.by_pose is not None:
        gaps["pose"] = apart(other.by_pose, cpu.by_pose)
    return gaps
