# SPDX-License-Identifier: GPL-3.0-or-later
"""CUDA kernels, emulated on the host: difficult isosurface depths and extreme parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera

from ..depth_scenes import SCENES, assert_depth, doubled, joined, scene
from ..first_principles import FirstPrinciples
from ..test_properties import ABSURD, PLAIN, cameras, one_wild, steady, wild_gaussians
from .comparison import STATISTICS, Outcome, emulated, leaves, outcome, random_weights
from .emulation import EmulatedKernels


@pytest.mark.parametrize("ulp", [0.0, 1.0])
@pytest.mark.parametrize("name", SCENES)
def test_depth_against_bisection(emulator_library: Path, name: str, ulp: float) -> None:
    gaussians, camera = scene(name)
    with torch.no_grad():
        found = emulated(EmulatedKernels(emulator_library, ulp=ulp))(
            leaves(gaussians, torch.float32), camera, RenderOptions()
        )
    # Disturbed by their documented bounds, quotients alone move a peak by two roundings.
    truth = FirstPrinciples(gaussians, camera).images()
    assert_depth(found.depth.double().numpy(), truth, 3.0 if ulp else 1.0)


def usable_in_float64(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> torch.Tensor:
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
