# SPDX-License-Identifier: GPL-3.0-or-later
"""Oriented Gaussians: trained parameters, activations, and activated arrays for kernels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from .. import tolerances

TRAINED = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
"""Tensors of :class:`OrientedGaussians` that receive gradients; ``filter_3d`` is recomputed
instead (docs/method.md, section 1.5)."""


@dataclass(frozen=True)
class GaussianArrays:
    """Activated Gaussians as C-contiguous float64 numpy arrays, mip filter applied.

    Input of all non-differentiable code (fields, pivots, export).
    """

    means: np.ndarray  # (n, 3) scene units
    scales: np.ndarray  # (n, 3) effective standard deviations, scene units
    rotations: np.ndarray  # (n, 3, 3) columns are the Gaussian's axes
    log_opacities: np.ndarray  # (n,) effective, <= 0
    normals: np.ndarray  # (n, 3) learned oriented normals, length in [0, 1)
    sh: np.ndarray  # (n, k, 3) float32 spherical-harmonics coefficients

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class OrientedGaussians:
    """Trained parameters before activation (docs/method.md, section 1.3).

    All tensors share one dtype.

    The activated normal is ``tanh(s) * d / |d|`` for ``orientation = (d, s)``. ``filter_3d`` is a
    constant between recomputations and never receives a gradient (docs/method.md, section 1.5).
    """

    means: Tensor  # (n, 3) scene units
    log_scales: Tensor  # (n, 3) natural log of scene units
    quats: Tensor  # (n, 4) w x y z, not necessarily normalised
    opacity_logits: Tensor  # (n,)
    sh: Tensor  # (n, (degree + 1)^2, 3)
    orientation: Tensor  # (n, 4) direction and sign parameter
    filter_3d: Tensor  # (n,) scene units, >= 0

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Yield every parameter with its name."""
        for item in fields(self):
            yield item.name, getattr(self, item.name)

    def replaced(self, **tensors: Tensor) -> OrientedGaussians:
        """Return a copy with some tensors replaced."""
        return replace(self, **tensors)

    def select(self, index: Tensor) -> OrientedGaussians:
        """Return the Gaussians selected by an index or mask tensor."""
        return OrientedGaussians(**{name: value[index] for name, value in self.tensors()})

    def joined(self, others: OrientedGaussians) -> OrientedGaussians:
        """Return these Gaussians, then others with as many harmonics."""
        pairs = zip(self.tensors(), others.tensors(), strict=True)
        return self.replaced(**{name: torch.cat([a, b]) for (name, a), (_, b) in pairs})

    def detached(self) -> OrientedGaussians:
        """Return a copy that shares memory and carries no gradient."""
        return OrientedGaussians(**{name: value.detach() for name, value in self.tensors()})

    # -- activations ------------------------------------------------------------------------------

    def scales(self) -> Tensor:
        """(n, 3) effective standard deviations ``sqrt(s^2 + f^2)``."""
        filter_sq = self.filter_3d[:, None] ** 2  # (n, 1)
        return torch.sqrt(torch.exp(2.0 * self.log_scales) + filter_sq)

    def log_opacities(self) -> Tensor:
        """(n,) log of the effective opacity, numerically stable (docs/method.md, section 5.4)."""
        loss = self.log_scales - torch.log(self.scales())  # (n, 3), <= 0
        return -torch.nn.functional.softplus(-self.opacity_logits) + loss.sum(1)

    def rotations(self) -> Tensor:
        """(n, 3, 3) rotation matrices; columns are the axes. A zero quaternion is the identity."""
        norm = self.quats.norm(dim=1, keepdim=True)  # (n, 1)
        unit = self.quats / norm.clamp_min(tolerances.QUATERNION_MIN_NORM)
        identity = torch.zeros_like(unit)
        identity[:, 0] = 1.0
        unit = torch.where(norm > tolerances.QUATERNION_MIN_NORM, unit, identity)
        w, x, y, z = unit.unbind(1)
        rows = [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ]  # fmt: skip
        return torch.stack(rows, 1).reshape(-1, 3, 3)

    def normals(self) -> Tensor:
        """(n, 3) learned oriented normals ``tanh(s) d / |d|``; zero where ``d`` is zero."""
        direction, sign = self.orientation[:, :3], self.orientation[:, 3:]
        norm = direction.norm(dim=1, keepdim=True).clamp_min(tolerances.DIRECTION_MIN_NORM)
        return torch.tanh(sign) * direction / norm

    def arrays(self) -> GaussianArrays:
        """Return the activated arrays; activation is done in float64."""
        with torch.no_grad():
            wide = OrientedGaussians(
                **{name: value.detach().cpu().double() for name, value in self.tensors()}
            )
            return GaussianArrays(
                np.ascontiguousarray(wide.means.numpy()),
                np.ascontiguousarray(wide.scales().numpy()),
                np.ascontiguousarray(wide.rotations().numpy()),
                np.ascontiguousarray(wide.log_opacities().numpy()),
                np.ascontiguousarray(wide.normals().numpy()),
                np.ascontiguousarray(self.sh.detach().cpu().float().numpy()),
            )
