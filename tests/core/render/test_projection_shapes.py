# SPDX-License-Identifier: GPL-3.0-or-later
"""Projection of thin, long, far and tiny Gaussians against arithmetic of 60 digits."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import RawArrays, RawGradients, project_backward
from gaussian_wrapping_addon.core.scene.camera import Camera

from .exact_projection import EXACT_COLUMNS, exact_columns, exact_gradient, exact_values
from .first_principles import TRAINED
from .projections import AXIS, OPTIONS, project, single

EDGE_ON = {"log_scales": [0.0, 0.0, np.log(1e-6)], "quats": [1.0, 1.0, 0.0, 0.0]}
HARD_SHAPES: list[dict[str, object]] = [
    {},
    {"log_scales": [0.0, -0.5, np.log(1e-6)], "quats": [0.9, 0.1, 0.3, -0.2]},
    {"log_scales": [np.log(1e-6), np.log(2e-6), -1.0], "quats": [0.2, 0.5, 0.7, -0.6]},
    {"log_scales": [np.log(1e-6), np.log(2e-6), -1.0], "quats": [1.0, 0.0, 0.0, 0.0]},
    EDGE_ON,
    EDGE_ON | {"means": [0.0, 0.0, 3.0]},
    {"log_scales": [np.log(1e-4)] * 3, "means": [0.0, 0.0, 1e3]},
    {"log_scales": [np.log(3e-4), np.log(1e-4), np.log(1e-4)], "means": [50.0, 9.0, 1e3]},
    {"log_scales": [4.0, 3.0, 2.0], "means": [4.0, 3.0, 20.0], "quats": [0.9, 0.1, 0.3, 0.1]},
]


def wide_camera(gaussians: OrientedGaussians) -> Camera:
    """AXIS moved so that a pixel centre lies on the first mean."""
    u = AXIS.fx * float(gaussians.means[0, 0] / gaussians.means[0, 2])
    v = AXIS.fy * float(gaussians.means[0, 1] / gaussians.means[0, 2])
    return dataclasses.replace(AXIS, cx=32.5 - u, cy=23.5 - v)


@pytest.mark.parametrize("changes", HARD_SHAPES)
def test_hard_shapes_against_sixty_digits(changes: dict[str, object]) -> None:
    gaussians = single(**changes)
    camera = wide_camera(gaussians)
    screen = project(gaussians, camera)
    assert screen.visible.all()
    wanted = np.array([float(v) for v in exact_columns(exact_values(gaussians), camera)])
    got = screen.params[0, EXACT_COLUMNS].astype(np.float64)
    size = np.abs(wanted)
    for block in ((2, 5), (5, 7), (7, 10), (12, 15)):
        size[slice(*block)] = size[slice(*block)].max()
    slack = np.full(len(size), 1e-9)
    # A rounding of the axes by eps turns the gradient of an edge-on disc by eps (1e6)^2.
    slack[[5, 6, 12, 13, 14]] += 1e-15 * np.exp(2.0 * np.ptp(gaussians.log_scales.numpy()))
    assert (np.abs(got - wanted) <= 1e-7 * size + slack).all()
    assert np.isfinite(screen.boxes).all()

    raw = RawArrays.from_gaussians(gaussians)
    grads = RawGradients.zeros(raw)
    project_backward(raw, camera, OPTIONS, screen, np.ones((1, 24)), grads)
    assert all(np.isfinite(getattr(grads, name)).all() for name in TRAINED)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("changes", HARD_SHAPES)
def test_gradients_of_hard_shapes_against_sixty_digits(
    changes: dict[str, object], dtype: torch.dtype
) -> None:
    gaussians = single(**changes)
    camera = wide_camera(gaussians)
    gaussians = OrientedGaussians(**{name: t.to(dtype) for name, t in gaussians.tensors()})
    exact = exact_values(gaussians)
    # Every column counts: weights are those that make the columns' shares of the sum alike.
    columns = np.abs(np.array([float(v) for v in exact_columns(exact, camera)]))
    weights = np.random.default_rng(3).uniform(0.5, 1.5, len(columns)) / (columns + 1e-6)
    weights = weights.astype(np.float32).astype(np.float64)
    raw = RawArrays.from_gaussians(gaussians)
    grad_params = np.zeros((1, 24), raw.means.dtype)
    grad_params[0, EXACT_COLUMNS] = weights
    screen = project(gaussians, camera)
    assert screen.visible.all()
    grads = RawGradients.zeros(raw)
    project_backward(raw, camera, OPTIONS, screen, grad_params, grads)
    wanted = exact_gradient(exact, camera, weights)
    rounding = 2.0**-24 if dtype == torch.float32 else 0.0
    whole = np.linalg.norm(np.concatenate(list(wanted.values())))
    for name, value in wanted.items():
        error = np.linalg.norm(getattr(grads, name)[0] - value)
        assert error <= (1e-13 + rounding) * np.linalg.norm(value) + 1e-13 * whole, name


def test_zero_quaternion_is_the_identity_and_gets_no_gradient() -> None:
    scales = {"log_scales": [-1.0, -2.0, -3.0]}
    zero, unit = single(quats=[0.0] * 4, **scales), single(quats=[1.0, 0.0, 0.0, 0.0], **scales)
    np.testing.assert_array_equal(project(zero, AXIS).params, project(unit, AXIS).params)
    raw = RawArrays.from_gaussians(zero)
    grads = RawGradients.zeros(raw)
    project_backward(raw, AXIS, OPTIONS, project(zero, AXIS), np.ones((1, 24)), grads)
    assert not grads.quats.any()
    assert np.isfinite(grads.log_scales).all()
