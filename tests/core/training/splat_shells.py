# SPDX-License-Identifier: GPL-3.0-or-later
"""A splat whose surface is known: flat Gaussians on an ellipsoid."""

from __future__ import annotations

import math

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import SH_C0, OrientedGaussians
from gaussian_wrapping_addon.core.loading.other_inputs import fibonacci_directions

AXES = (1.0, 0.8, 0.6)
"""Half axes of the ellipsoid."""

THICKNESS = 0.01


def shell_of_discs(
    count: int, *, sh_degree: int = 0, thickness: float = THICKNESS
) -> tuple[OrientedGaussians, np.ndarray]:
    """Return opaque discs on the ellipsoid, float32, without orientation, and outward normals."""
    unit = fibonacci_directions(count)
    means = unit * AXES
    normals = unit / AXES
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    width = 1.4 * math.sqrt(4 * math.pi / count)  # of neighbours' distance: no gaps between discs
    quats = np.zeros((count, 4))
    for i, normal in enumerate(normals):  # turns z to the normal
        half = np.array([1.0 + normal[2], -normal[1], normal[0], 0.0])
        quats[i] = half / np.linalg.norm(half)
    random = np.random.default_rng(0)
    sh = random.normal(size=(count, (sh_degree + 1) ** 2, 3)) * 0.02
    color = 0.5 + 0.3 * np.sin(5.0 * means + np.array([0.0, 1.0, 2.0]))
    sh[:, 0] = (color - 0.5) / SH_C0
    values = {
        "means": means,
        "log_scales": np.tile(np.log([0.5 * width, 0.5 * width, thickness]), (count, 1)),
        "quats": quats,
        "opacity_logits": np.full(count, 3.0),
        "sh": sh,
        "orientation": np.zeros((count, 4)),
        "filter_3d": np.zeros(count),
    }
    made = {name: torch.from_numpy(value.astype(np.float32)) for name, value in values.items()}
    return OrientedGaussians(**made), normals
