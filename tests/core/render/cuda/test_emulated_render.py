# SPDX-License-Identifier: GPL-3.0-or-later
"""CUDA kernels, emulated on the host, on generic, difficult and extreme scenes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.cuda.device_view import KEPT_BYTES, PASSING_BYTES
from gaussian_wrapping_addon.core.render.cuda.kernels import Kernels
from gaussian_wrapping_addon.core.render.reference import reference_projection, render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.cuda.comparison import (
    IMAGES,
    STATISTICS,
    Outcome,
    assert_bitwise_equal,
    assert_same_gradients,
    assert_same_images,
    assert_same_statistics,
    comparable_weights,
    emulated,
    leaves,
    outcome,
    random_weights,
    relative_l2,
)
from tests.core.render.cuda.emulation import EmulatedKernels
from tests.core.render.depth_scenes import SCENES as HARD_SCENES
from tests.core.render.depth_scenes import assert_depth, doubled, joined
from tests.core.render.depth_scenes import scene as hard_scene
from tests.core.render.first_principles import FirstPrinciples
from tests.core.render.scenes import isotropic, look_at, random_gaussians
from tests.core.render.test_properties import (
    ABSURD,
    PLAIN,
    cameras,
    one_wild,
    steady,
    wild_gaussians,
)

BACKGROUND = (0.2, 0.5, 0.1)


# Several tiles, odd sizes, exactly one tile, less than one tile.
SCENES = [(60, 40, 30), (150, 33, 17), (40, 16, 16), (25, 7, 5)]


def scene(count: int, width: int, height: int):  # type: ignore[no-untyped-def]
    gaussians = random_gaussians(count, seed=count, dtype=torch.float32)
    return gaussians, look_at((2.2, 1.0, 0.8), width=width, height=height, focal=1.1 * width)


FRONT = look_at((0.0, -3.0, 0.0), width=21, height=19, focal=40.0)


def uneven(
    means: list[tuple[float, float, float]], sigmas: list[float], opacities: list[float]
) -> OrientedGaussians:
    """Return turned ellipsoids: round ones have no gradient on their rotation to compare."""
    gaussians = isotropic(means, sigmas, opacities, torch.float32)
    return gaussians.replaced(
        log_scales=gaussians.log_scales + torch.tensor([0.3, 0.0, -0.3]),
        quats=torch.tensor([[0.9, 0.1, -0.2, 0.3]]).repeat(len(means), 1),
    )


def compared(
    kernels: Kernels,
    gaussians: OrientedGaussians,
    camera: Camera = FRONT,
    *,
    tolerance: float = 1e-5,
    **options: object,
) -> Outcome:
    """Compare images and statistics with the CPU kernels', and all with the definition in float64.

    Return what was rendered; all of it is finite.
    """
    chosen = RenderOptions(**{"background": BACKGROUND, **options})  # type: ignore[arg-type]
    weights = comparable_weights(kernels, gaussians, camera, chosen)
    found = outcome(emulated(kernels), gaussians, camera, chosen, weights=weights)
    assert all(torch.isfinite(value).all() for value in found.values())
    cpu = outcome(render, gaussians, camera, chosen, weights=weights)
    assert_same_images(found, cpu)
    if chosen.statistics:
        assert_same_statistics(found, cpu)
    exact = defined(gaussians, camera, chosen, weights)
    assert_same_images(found, exact)
    assert_same_gradients(found, exact, tolerance)
    return found


def defined(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions, weights: dict[str, Tensor]
) -> Outcome:
    plain = dataclasses.replace(options, statistics=False)
    return outcome(render_reference, gaussians, camera, plain, weights=weights, dtype=torch.float64)


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("size", SCENES)
def test_everything_equals_the_definition_and_the_cpu_kernels(
    emulator_library: Path, size: tuple[int, int, int], depth: bool
) -> None:
    kernels = EmulatedKernels(emulator_library)
    found = compared(kernels, *scene(*size), tolerance=1e-4, depth=depth, statistics=True)
    assert bool(found.images["depth"].any()) == depth


def test_screen_gradients_alone_are_those_of_the_cpu(emulator_library: Path) -> None:
    gaussians, camera = scene(150, 33, 17)
    options = RenderOptions(background=BACKGROUND, depth=False, screen_gradients=True)
    weights = random_weights(camera, options)
    kernels = EmulatedKernels(emulator_library)
    found = outcome(emulated(kernels), gaussians, camera, options, weights=weights)
    cpu = outcome(render, gaussians, camera, options, weights=weights)
    assert_same_statistics(found, cpu)
    assert_same_gradients(found, cpu)
    some = found.render.statistics
    assert some is not None
    assert some.grad_px[some.visible].min() > 0
    # The sums of blending weights were not asked for.
    assert len(some.weight_sum) == len(some.weight_max) == 0
    assert some.strongest is None
    every = dataclasses.replace(options, statistics=True)
    whole = outcome(emulated(kernels), gaussians, camera, every, weights=weights)
    for name in ("visible", "radii_px", "grad_px", "grad_abs_px"):
        assert np.array_equal(getattr(some, name), getattr(whole.render.statistics, name)), name


def test_rows_that_overflow_are_dropped_and_large_ones_have_norms(emulator_library: Path) -> None:
    kernels = EmulatedKernels(emulator_library)
    rows = torch.zeros((5, 24))
    rows[0, [0, 1, 22, 23]] = torch.tensor([3.0, -4.0, 6.0, 8.0])
    rows[1, [0, 22]] = 1e25  # its square overflows float32
    rows[2, 0], rows[2, 5] = 1.0, float("nan")
    rows[3, 0], rows[3, 7] = 1.0, float("-inf")
    rows[4, 4], rows[4, 22] = 7.0, 2.0
    kept, (grad_px, grad_abs_px) = rows.clone(), torch.full((2, 5), -1.0)
    kernels.launch_each("finish_params", 5, 1, kept, grad_px, grad_abs_px)
    assert torch.allclose(grad_px, torch.tensor([5.0, 1e25, 0.0, 0.0, 0.0]))
    assert torch.allclose(grad_abs_px, torch.tensor([10.0, 1e25, 0.0, 0.0, 2.0]))
    wanted = rows.clone()
    wanted[2:4], wanted[:, 22:] = 0.0, 0.0
    assert torch.equal(kept, wanted)
    nothing = torch.empty(0)
    kernels.launch_each("finish_params", 5, 0, rows, nothing, nothing)
    assert torch.equal(rows[:, :22], wanted[:, :22])


@pytest.mark.parametrize(("stored", "used"), [(0, None), (1, None), (3, None), (3, 1), (2, 0)])
def test_lower_harmonics_and_their_gradient(
    emulator_library: Path, stored: int, used: int | None
) -> None:
    camera = look_at((2.2, 1.0, 0.8), width=20, height=18, focal=24.0)
    gaussians = random_gaussians(30, seed=9, dtype=torch.float32, sh_degree=stored)
    kernels = EmulatedKernels(emulator_library)
    found = compared(kernels, gaussians, camera, tolerance=3e-5, depth=False, sh_degree=used)
    last = (stored if used is None else used) + 1
    assert not found.gradients["sh"][:, last * last :].any()


def several_tiles(height: int) -> tuple[OrientedGaussians, Camera]:
    gaussians = random_gaussians(120, seed=2, dtype=torch.float32, scale=(0.02, 0.25))
    return gaussians, look_at((2.2, 1.0, 0.8), width=50, height=height, focal=60.0)


def test_the_same_bits_in_every_run_and_any_order_of_threads(emulator_library: Path) -> None:
    gaussians, camera = several_tiles(35)
    options = RenderOptions(statistics=True)
    weights = random_weights(camera, options)
    runs = []
    for backwards in (False, True, False):
        renderer = emulated(EmulatedKernels(emulator_library, backwards=backwards))
        runs.append(outcome(renderer, gaussians, camera, options, weights=weights))
    assert_bitwise_equal(runs[1], runs[0])
    assert_bitwise_equal(runs[2], runs[0])


def test_the_hardwares_approximations_stay_within_tolerance(emulator_library: Path) -> None:
    # exp and quotients disturbed by their documented bounds, signs mixed.
    given = *scene(150, 33, 17), RenderOptions(background=BACKGROUND)
    weights = comparable_weights(EmulatedKernels(emulator_library), *given)
    rough = outcome(emulated(EmulatedKernels(emulator_library, ulp=1.0)), *given, weights=weights)
    exact = defined(*given, weights)
    assert_same_images(rough, exact)
    assert_same_gradients(rough, exact)


def test_bands_change_only_the_order_of_sums(emulator_library: Path) -> None:
    gaussians, camera = several_tiles(70)
    options = RenderOptions(statistics=True)
    weights = random_weights(camera, options)
    kernels = EmulatedKernels(emulator_library)
    whole = outcome(emulated(kernels), gaussians, camera, options, weights=weights)
    kept = 2 * KEPT_BYTES * pair_count(whole)
    banded = outcome(emulated(kernels, kept), gaussians, camera, options, weights=weights)
    assert kept // 2 // PASSING_BYTES < pair_count(whole), "the budget asks for several bands"
    for name, image in whole.images.items():
        assert torch.equal(banded.images[name], image), name
    for name, gradient in whole.gradients.items():
        assert relative_l2(banded.gradients[name], gradient) < 1e-5, name
    assert_same_statistics(banded, whole)
    # Two bytes less, and what has to be kept does not fit; much less, and no row of tiles does.
    for budget, words in ((kept - 2, "tile lists of view"), (2000, "One row of tiles of view")):
        with pytest.raises(ResourceError, match=words):
            emulated(kernels, budget)(gaussians, camera, options)


def pair_count(found: Outcome) -> int:
    """Return how many pairs of Gaussian and tile the view has."""
    return len(found.render.color.grad_fn.view.band_lists[0].gaussian_ids)  # type: ignore[union-attr]


def test_nothing_visible(emulator_library: Path) -> None:
    away = uneven([(0.0, -9.0, 0.0)], [0.1], [0.9])
    for gaussians in (away, away.select(torch.zeros(1, dtype=torch.bool))):
        found = compared(EmulatedKernels(emulator_library), gaussians, statistics=True)
        color = found.images["color"]
        assert torch.equal(color, torch.tensor(BACKGROUND).expand_as(color))
        assert not found.images["alpha"].any()
        assert not found.images["depth"].any()
        assert not any(gradient.any() for gradient in found.gradients.values())
        assert found.render.statistics is not None
        assert (found.render.statistics.strongest == -1).all()


def test_transmittance_on_a_plateau(emulator_library: Path) -> None:
    # Behind the first sheet exactly half of the light is left, up to the second far behind it.
    gaussians = isotropic(
        [(0.0, 0.0, 0.0), (0.0, 2.0, 0.0)], [0.05, 0.05], [0.5, 0.9], torch.float32
    )
    gaussians = gaussians.replaced(
        log_scales=torch.tensor([[2.0, -3.0, 2.0]] * 2), opacity_logits=torch.tensor([0.0, 3.0])
    )
    camera = look_at((0.0, -3.0, 0.0), width=20, height=17, focal=40.0)
    options = RenderOptions()
    with torch.no_grad():
        found = emulated(EmulatedKernels(emulator_library))(gaussians, camera, options)
        exact = render_reference(gaussians, camera, options)
    assert torch.equal(found.depth > 0, exact.depth > 0)
    assert (found.depth > 0).all()
    # Any depth between the sheets has T within rounding of 0.5; none outside of them has.
    assert float(found.depth.min()) > 2.9
    assert float(found.depth.max()) < 5.0 + 3.0 * float(np.exp(-3.0))


def test_opaque_layers_end_the_walk(emulator_library: Path) -> None:
    # Far more pairs than a batch, and all but the first few behind an opaque wall.
    count = 150
    means = [(0.0, 0.01 * i, 0.0) for i in range(count)]
    gaussians = uneven(means, [0.6] * count, [0.9] * count)
    gaussians = gaussians.replaced(log_scales=torch.tensor([[3.0, -2.0, 2.5]] * count))
    # Behind them the light that is left is a difference of nearly equal sums.
    found = compared(EmulatedKernels(emulator_library), gaussians, tolerance=5e-5, statistics=True)
    assert found.render.statistics is not None
    assert (found.render.statistics.weight_sum[-60:] == 0.0).all()
    assert not found.gradients["means"][-60:].any()


def test_values_that_are_not_finite_hide_the_gaussian(emulator_library: Path) -> None:
    gaussians = random_gaussians(8, seed=1, dtype=torch.float32)
    camera = look_at((2.2, 1.0, 0.8), width=18, height=18, focal=24.0)
    rest = gaussians.select(torch.tensor([0, 6, 7]))
    gaussians.means[1, 0] = np.nan
    gaussians.log_scales[2, 1] = np.inf
    gaussians.quats[3] = np.nan
    gaussians.sh[4, 0, 1] = np.nan
    gaussians.orientation[5, 0] = np.inf
    weights = random_weights(camera, RenderOptions())
    device = emulated(EmulatedKernels(emulator_library))
    found, cpu, alone = (
        outcome(renderer, some, camera, RenderOptions(), weights=weights)
        for renderer, some in ((device, gaussians), (render, gaussians), (device, rest))
    )
    assert_same_images(found, cpu)
    for name in IMAGES:
        assert torch.equal(found.images[name], alone.images[name]), name
    hidden = torch.tensor([1, 2, 3, 4, 5])
    for one in (found, cpu):
        for name, gradient in one.gradients.items():
            assert not gradient[hidden].any(), name
    for name, gradient in alone.gradients.items():
        assert torch.equal(found.gradients[name][[0, 6, 7]], gradient), name


@pytest.mark.parametrize("ulp", [0.0, 1.0])
@pytest.mark.parametrize("name", HARD_SCENES)
def test_depth_against_bisection(emulator_library: Path, name: str, ulp: float) -> None:
    gaussians, camera = hard_scene(name)
    with torch.no_grad():
        found = emulated(EmulatedKernels(emulator_library, ulp=ulp))(
            leaves(gaussians, torch.float32), camera, RenderOptions()
        )
    # Disturbed by their documented bounds, quotients alone move a peak by two roundings.
    truth = FirstPrinciples(gaussians, camera).images()
    assert_depth(found.depth.double().numpy(), truth, 3.0 if ulp else 1.0)


def usable_in_float64(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> Tensor:
    """Return (n,) what is not hidden; at the edge of the rule float32 decides otherwise."""
    return reference_projection(doubled(gaussians), camera, options).usable


def rendered(
    library: Path, gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> Outcome:
    """Render and differentiate; everything is finite."""
    found = outcome(
        emulated(EmulatedKernels(library)), gaussians, camera, options,
        weights=random_weights(camera, options),
    )  # fmt: skip
    for name, value in (*found.images.items(), *found.gradients.items()):
        assert torch.isfinite(value).all(), name
    assert found.render.statistics is not None
    for name in STATISTICS:
        assert np.isfinite(getattr(found.render.statistics, name)).all(), name
    return found


@pytest.mark.parametrize("name", ABSURD)
@pytest.mark.parametrize("near_z", [0.2, -1.0])
def test_absurd_values_stay_finite(emulator_library: Path, name: str, near_z: float) -> None:
    gaussians, camera = ABSURD[name]
    both = joined(gaussians, one_wild())
    options = RenderOptions(near_z=near_z, statistics=True)
    found = rendered(emulator_library, both, camera, options)
    if camera is PLAIN:
        # The plain one behind it is not lost.
        assert found.render.statistics is not None
        assert found.render.statistics.visible[1]
        assert found.gradients["means"][1].any()
    usable = usable_in_float64(both, camera, options)
    for name, gradient in found.gradients.items():
        assert not gradient[~usable].any(), name


@steady(100)
@given(
    gaussians=wild_gaussians(),
    camera=cameras(),
    near_z=st.sampled_from([0.2, 0.0, 1e-6, -1.0]),
)
def test_finite_parameters_give_finite_images_and_gradients(
    emulator_library: Path, gaussians: OrientedGaussians, camera: Camera, near_z: float
) -> None:
    options = RenderOptions(near_z=near_z, statistics=True)
    found = rendered(emulator_library, gaussians, camera, options)
    usable = usable_in_float64(gaussians, camera, options)
    assert found.render.statistics is not None
    assert not found.render.statistics.visible[~usable.numpy()].any()
    assert float(found.images["alpha"].min()) >= 0.0
    assert float(found.images["depth"].min()) >= 0.0
