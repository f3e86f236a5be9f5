# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes and positions for depth queries, with reference results from Sigma, mu and rays."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render import reference
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.scenes import look_at, random_gaussians

SHAPES = ("means", "log_scales", "quats", "opacity_logits")
EYE = (2.2, 1.0, 0.8)
# Keyword arguments of random_gaussians, number of Gaussians, camera position.
SCENES = {
    "generic": ({}, 120, EYE),
    "thin": ({"scale": (0.002, 0.4), "opacity": (0.3, 0.97)}, 150, EYE),
    "inside": ({"scale": (0.1, 0.8), "opacity": (0.02, 0.3)}, 25, (0.7, 0.3, 0.2)),
    "opaque": ({"opacity": (0.95, 0.9999)}, 60, EYE),
}


def scene(name: str, seed: int = 3) -> tuple[OrientedGaussians, Camera]:
    """Return float32 Gaussians and a camera of several tiles, the last ones cut."""
    values, count, eye = SCENES[name]
    gaussians = random_gaussians(count, seed=seed, dtype=torch.float32, sh_degree=1, **values)  # type: ignore[arg-type]
    return gaussians, look_at(eye, width=50, height=40, focal=60.0)


def random_positions(camera: Camera, count: int, seed: int = 0) -> np.ndarray:
    """Return (count, 2) float32 positions, a few of them beyond each side of the image."""
    random = np.random.default_rng(seed)
    size = np.array([camera.width, camera.height])
    return (random.uniform(-0.03, 1.03, (count, 2)) * size).astype(np.float32)


def reference_depth_at(
    gaussians: OrientedGaussians, camera: Camera, positions: torch.Tensor, options: RenderOptions
) -> torch.Tensor:
    """Return the depth of ``render_reference`` at (m, 2) positions; 0 where there is none."""
    screen = reference.reference_projection(gaussians, camera, options)
    chosen = torch.nonzero(screen.usable)[:, 0]
    order = chosen[torch.argsort(screen.depths[chosen].float(), stable=True)]
    size = positions.new_tensor([camera.width, camera.height])
    seen = torch.nonzero(((positions >= 0.0) & (positions <= size)).all(1))[:, 0]
    rays = reference._evaluate_rays(screen.params[order], *positions[seen].unbind(1))
    depth = reference._depth(rays, options)
    return positions.new_zeros(len(positions)).index_put((seen,), depth)


class Oracle:
    """Numpy float64 from inverse covariances and world-space rays; bisection of 200 steps."""

    def __init__(self, gaussians: OrientedGaussians, camera: Camera) -> None:
        raw = {name: t.detach().double().numpy() for name, t in gaussians.tensors()}
        self.camera = camera
        variance = np.exp(2.0 * raw["log_scales"])
        blurred = variance + raw["filter_3d"][:, None] ** 2
        opacity = np.sqrt((variance / blurred).prod(1)) / (1.0 + np.exp(-raw["opacity_logits"]))
        turn = Rotation.from_quat(raw["quats"][:, [1, 2, 3, 0]]).as_matrix()
        precision = np.linalg.inv(turn @ (blurred[:, :, None] * turn.transpose(0, 2, 1)))
        gap = raw["means"] - camera.center
        distance = np.linalg.norm(gap, axis=1)
        order = np.lexsort((np.arange(len(gap)), distance.astype(np.float32)))
        order = order[gap[order] @ camera.forward > 0.2]
        self.opacity, self.precision, self.gap = opacity[order], precision[order], gap[order]

    def cast(self, positions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return alpha before its cap (0 where none), peak, sharpness (p, n) and final T (p,)."""
        x, y = positions.astype(np.float64).T
        camera = self.camera
        local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 0.0 * x + 1], 1)
        rays = local @ camera.rotation  # (p, 3), z-depth 1
        turned = np.einsum("nij,pj->pni", self.precision, rays)  # (p, n, 3)
        sharpness = np.einsum("pi,pni->pn", rays, turned)
        peak = np.einsum("ni,pni->pn", self.gap, turned) / sharpness
        miss = peak[:, :, None] * rays[:, None, :] - self.gap  # (p, n, 3)
        smallest = np.einsum("pni,nij,pnj->pn", miss, self.precision, miss, optimize=True)
        raw = self.opacity * np.exp(-0.5 * smallest)
        through = np.ones(len(positions))
        for i in range(raw.shape[1]):
            counts = (raw[:, i] >= 1.0 / 255.0) & (through >= 1e-4)
            raw[:, i] = np.where(counts, raw[:, i], 0.0)
            through *= 1.0 - np.minimum(raw[:, i], 0.99)
        return raw, peak, sharpness, through

    @staticmethod
    def through(hits: tuple[np.ndarray, ...], t: np.ndarray) -> np.ndarray:
        """T (p,) up to z-depth t (p,)."""
        raw, peak, sharpness, _ = hits
        ahead = np.maximum(peak - t[:, None], 0.0)
        density = raw * np.exp(-0.5 * sharpness * ahead * ahead)
        return np.prod(1.0 - np.minimum(density, 0.99), axis=1)

    def depth(self, positions: np.ndarray, limit: float = 0.45) -> np.ndarray:
        """z-depth (p,); 0 where there is none and off the image."""
        size = np.array([self.camera.width, self.camera.height])
        on_image = ((positions >= 0) & (positions <= size)).all(1)
        hits = self.cast(positions)
        low, high = np.zeros(len(positions)), np.full(len(positions), 1e3)
        valid = on_image & (hits[3] <= limit) & (hits[3] < 0.5) & (self.through(hits, low) > 0.5)
        kept = tuple(part[valid] for part in hits)
        low, high = low[valid], high[valid]
        for _ in range(200):
            middle = 0.5 * (low + high)
            clear = self.through(kept, middle) > 0.5
            low, high = np.where(clear, middle, low), np.where(clear, high, middle)
        out = np.zeros(len(positions))
        out[valid] = low
        return out


def assert_depths(found: np.ndarray, wanted: np.ndarray) -> None:
    """Check validity and the error's distribution."""
    # A float32 alpha may fall on the other side of 1/255, a float32 T on that of 0.45.
    assert ((found > 0) != (wanted > 0)).mean() <= 1e-3
    both = (found > 0) & (wanted > 0)
    error = np.abs(found - wanted)[both] / wanted[both]
    assert both.mean() > 0.2
    assert (error < 1e-5).mean() >= 0.999
    assert error.max() < 1e-3
