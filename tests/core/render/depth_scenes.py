# SPDX-License-Identifier: GPL-3.0-or-later
"""Views that are difficult for an isosurface depth solver, and error measures of its depths."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import narrowed
from tests.core.render.first_principles import Truth
from tests.core.render.scenes import (
    coloured,
    front_camera,
    isotropic,
    look_at,
    one_gaussian,
    random_gaussians,
)


def joined(*parts: OrientedGaussians) -> OrientedGaussians:
    """Return the Gaussians of all parts."""
    tensors = zip(*(part.tensors() for part in parts), strict=True)
    return OrientedGaussians(
        **{same[0][0]: torch.cat([value for _, value in same]) for same in tensors}
    )


def doubled(gaussians: OrientedGaussians) -> OrientedGaussians:
    """Return the same values in float64."""
    return gaussians.replaced(**{name: value.double() for name, value in gaussians.tensors()})


def ball_before_disc(thickness: float) -> OrientedGaussians:
    """A ball of sigma 0.4 at depth 3.5, a disc at depth 5 behind it, a cloud at depth 6."""
    disc = one_gaussian((1.5, thickness, 1.5), 0.95, (0.0, 1.0, 0.0))
    return joined(
        disc, coloured(isotropic([(-0.3, -0.5, 0.0), (0.0, 2.0, 0.0)], [0.4, 0.8], [0.9] * 2))
    )


def ball_around_disc(thickness: float) -> OrientedGaussians:
    """A ball in which the crossing lies, and a faint disc in it, behind the crossing."""
    disc = one_gaussian((1.5, thickness, 1.5), 0.5, (0.0, -0.05, 0.0))
    return joined(disc, coloured(isotropic([(0.0, 0.0, 0.0)], [0.4], [0.97])))


def sheets_before_ball(thickness: float, *opacities: float) -> OrientedGaussians:
    """Sheets, each steep but too faint to reach the level, half a unit apart; then a ball."""
    sheets = [
        one_gaussian((3.0, thickness, 3.0), opacity, (0.0, 0.5 * i, 0.0))
        for i, opacity in enumerate(opacities)
    ]
    return joined(*sheets, coloured(isotropic([(0.0, 3.0, 0.0)], [0.5], [0.95])))


def layers(sigma: float) -> OrientedGaussians:
    """Four overlapping balls, a few sigma from first to last."""
    random = np.random.default_rng(3)
    means = [tuple(row) for row in random.uniform(-2 * sigma, 2 * sigma, (4, 3))]
    return coloured(isotropic(means, [sigma] * 4, [0.3, 0.9, 0.7, 0.6]))


def plateau(opacity: float) -> OrientedGaussians:
    """A layer of some opacity, three units before another one."""
    return coloured(isotropic([(0.0, 0.0, 0.0), (0.0, 3.0, 0.0)], [0.05] * 2, [opacity, 0.9]))


WIDE, CLOSE = front_camera(8, 7, focal=12.0), front_camera(3, 2, focal=4e4)
SIDE = look_at((2.2, 1.0, 0.8), width=24, height=18, focal=26.0)
SCENES: dict[str, tuple[Callable[[], OrientedGaussians], Camera]] = {
    "flat discs": (
        lambda: random_gaussians(500, 45, scale=(0.001, 0.3), filter_size=0.0005),
        look_at((-1.5, 1.4, 1.8), width=24, height=18, focal=26.0),
    ),
    "mixed sizes": (
        lambda: random_gaussians(400, 49, scale=(0.003, 1.0), opacity=(0.02, 0.999)),
        SIDE,
    ),
    "a plateau just below half": (lambda: plateau(0.501), CLOSE),
    "a plateau just above half": (lambda: plateau(0.499), CLOSE),
    "a plateau 2e-5 above half": (lambda: plateau(0.49998), CLOSE),
}
for exponent in range(2, 8):
    SCENES[f"a disc of 1e-{exponent} behind a ball"] = (
        lambda exponent=exponent: ball_before_disc(10.0**-exponent), WIDE)  # type: ignore[misc]  # fmt: skip
    SCENES[f"a disc of 1e-{exponent} within a ball"] = (
        lambda exponent=exponent: ball_around_disc(10.0**-exponent), WIDE)  # type: ignore[misc]  # fmt: skip
    SCENES[f"sheets of 1e-{exponent} before a ball"] = (
        lambda exponent=exponent: sheets_before_ball(10.0**-exponent, 0.3, 0.25), WIDE)  # type: ignore[misc]  # fmt: skip
    SCENES[f"sheets of 1e-{exponent} of which the second closes"] = (
        lambda exponent=exponent: sheets_before_ball(10.0**-exponent, 0.3, 0.6), WIDE)  # type: ignore[misc]  # fmt: skip
for distance in (1.0, 1e3, 1e5):
    SCENES[f"layers of 1e-4 in a distance of {distance:g}"] = (
        lambda: layers(1e-4), front_camera(focal=1.5e4 * distance, distance=distance))  # fmt: skip


def scene(name: str) -> tuple[OrientedGaussians, Camera]:
    """Return a scene with values that float32 holds."""
    make, camera = SCENES[name]
    return narrowed(make()), camera


def assert_depth(found: np.ndarray, truth: Truth, rounding: float = 1.0) -> None:
    """Assert depths where there are some, exact to what float32 holds.

    99.9 % are exact to 1e-5 and all where log T is not flat: its error stays at the rounding of a
    product, or at that of a float32 depth in shares of the thinnest sigma; ``rounding`` times
    those where operations are not exact to their last digit.
    """
    sure = (truth.margin > 1e-5) & (truth.limit_margin > 1e-6)
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(found[sure] > 0, truth.depth[sure] > 0)
    has = sure & (truth.depth > 0)
    assert has.any()
    error = abs(found - truth.depth)[has] / truth.depth[has]
    assert float((error < 1e-5 * rounding).mean()) >= 0.999, error.max()
    residual = error * truth.depth[has] * truth.slope[has]
    bound = 2e-5 + 2e-7 * truth.depth[has] * truth.sharpest[has]
    assert (residual < rounding * bound).all(), (residual / bound).max()
