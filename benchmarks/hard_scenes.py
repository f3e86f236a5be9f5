# SPDX-License-Identifier: GPL-3.0-or-later
"""The scenes that must stay right: extreme opacities, sizes, shapes and places."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.types.options import RenderOptions


@dataclasses.dataclass(frozen=True)
class HardScene:
    """One scene, with values that float32 holds exactly."""

    name: str
    case: int
    """Number of the hard case."""
    gaussians: OrientedGaussians
    """float32."""
    camera: Camera
    options: RenderOptions
    seed: int


def front_camera(
    width: int = 16, height: int = 16, focal: float = 30.0, distance: float = 4.0
) -> Camera:
    """Return a camera on the -y axis, Z up, that sees the origin through a corner of pixels."""
    pose = np.array(
        [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, distance]]
    )  # x right, y down, z forward
    return Camera("front", width, height, focal, focal, width / 2, height / 2, pose)


def _gaussians(
    means: Sequence[Sequence[float]] | np.ndarray,
    scales: np.ndarray | float,
    opacity: np.ndarray | float,
    seed: int,
    *,
    quats: np.ndarray | None = None,
    logits: np.ndarray | None = None,
) -> OrientedGaussians:
    """Return float32 Gaussians with coloured harmonics of degree 2 and learned normals."""
    random = np.random.default_rng(seed)
    means = np.asarray(means, np.float64)  # (n, 3)
    count = len(means)
    opacity = np.broadcast_to(np.asarray(opacity, np.float64), (count,))
    scales = np.broadcast_to(np.asarray(scales, np.float64), (count, 3))
    if quats is None:
        quats = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    if logits is None:
        logits = np.log(opacity) - np.log1p(-opacity)
    values = [
        means,
        np.log(scales),
        quats,
        logits,
        random.normal(scale=0.3, size=(count, 9, 3)),
        random.normal(size=(count, 4)),
        np.zeros(count),
    ]
    return OrientedGaussians(*(torch.tensor(np.asarray(v), dtype=torch.float32) for v in values))


def _cloud(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means, scales and quaternions of anisotropic Gaussians around the origin."""
    random = np.random.default_rng(seed)
    scales = np.exp(random.uniform(math.log(0.04), math.log(0.4), (count, 3)))
    return random.uniform(-0.8, 0.8, (count, 3)), scales, random.normal(size=(count, 4))


def _turn(angle: float, count: int = 1) -> np.ndarray:
    """Return quaternions of a turn about Z."""
    return np.tile([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)], (count, 1))


def hard_scenes() -> list[HardScene]:
    """Return the hard cases 1 to 5 and 7; the same list on every machine."""
    scenes: list[HardScene] = []
    tinted = RenderOptions(background=(0.2, 0.5, 0.1))

    def add(
        case: int,
        name: str,
        gaussians: OrientedGaussians,
        camera: Camera,
        options: RenderOptions = tinted,
    ) -> None:
        scenes.append(HardScene(name, case, gaussians, camera, options, case))

    means, scales, quats = _cloud(40, 1)
    wide = front_camera(40, 30, 40.0)
    for logit in (20.0, -20.0):
        logits = np.full(40, logit)
        if logit < 0:
            logits[::2] = 1.0  # the others alone would leave the image empty
        add(
            1,
            f"opacity logits {logit:+.0f}",
            _gaussians(means, scales, 0.5, 1, quats=quats, logits=logits),
            wide,
        )

    random = np.random.default_rng(3)
    tiny = random.uniform(-5e-4, 5e-4, (30, 3))
    faint = random.uniform(0.3, 0.9, 30)
    for distance in (1e3, 1e5):
        add(
            2,
            f"sigma 1e-4 at distance {distance:.0e}",
            _gaussians(tiny, 1e-4, faint, 2),
            front_camera(20, 20, 1.5e4 * distance, distance),
        )

    # What is a millionth as thick as wide is seen close enough for its thickness to be a pixel.
    shapes = [
        ("disc 1e-6 : 1, edge-on", (1e-6, 0.5, 0.5), 0.0, 4e6),
        ("disc 1e-6 : 1, grazing", (1e-6, 0.5, 0.5), 0.02, 40.0),
        ("disc 1e-6 : 1, facing", (1e-6, 0.5, 0.5), math.pi / 2, 40.0),
        ("needle 1e-6 : 1, oblique", (1e-6, 1.0, 1e-6), 0.7, 4e6),
        ("needle along the ray", (0.02, 1.0, 0.02), 0.0, 400.0),
    ]
    for name, shape, angle, focal in shapes:
        gaussians = _gaussians([(0.0, 0.0, 0.0)], np.array([shape]), 0.9, 3, quats=_turn(angle))
        add(3, name, gaussians, front_camera(21, 19, focal))
    thin_scales = np.concatenate([np.full((30, 1), 1e-6), np.full((30, 2), 0.3)], 1)
    thin = _gaussians(means[:30], thin_scales, 0.6, 3, quats=quats[:30])
    add(3, "30 discs 3e-6 : 1, any way", thin, front_camera(40, 30, 40.0))

    around = [(0.0, -3.4, 0.0), (0.3, -2.0, 0.2), (0.0, 5.0, 0.0)]
    huge = np.array([1.5, 2.5, 30.0])[:, None] * np.ones(3)
    add(4, "camera inside Gaussians", _gaussians(around, huge, [0.3, 0.6, 0.7], 4), front_camera())
    near = random.uniform(-0.3, 0.3, (20, 3)) + np.array([0.0, -3.7, 0.0])
    add(4, "across the near plane", _gaussians(near, 0.25, 0.3, 4), front_camera(24, 20))
    everywhere = _gaussians(means[:12], 200.0, random.uniform(0.02, 0.2, 12), 4)
    add(4, "larger than the scene", everywhere, front_camera(24, 20))
    # On oblique rays the peak of a Gaussian that is flat towards the camera lies behind it.
    slanted = _gaussians(
        [(0.0, -3.7, 0.0)], np.array([[0.02, 3.0, 3.0]]), 0.8, 4, quats=_turn(-1.2)
    )
    add(4, "peak behind the camera", slanted, front_camera(24, 20, 8.0))

    positions = np.linspace(-0.5, 0.5, 10_000)
    layers = np.stack([np.zeros(10_000), positions, np.zeros(10_000)], 1)
    add(5, "10 000 faint layers", _gaussians(layers, 1.0, 0.006, 5), front_camera(4, 3, 60.0))
    add(
        5,
        "two opaque layers",
        _gaussians([(0, 0, 0), (0, 1, 0)], 0.1, 0.999, 5),
        front_camera(),
    )
    add(5, "identical depths", _gaussians(np.zeros((6, 3)), 0.3, 0.5, 5), front_camera())

    plateau = _gaussians([(0, 0, 0), (0, 3, 0)], 0.05, [0.5, 0.9], 7)
    add(7, "plateau at exactly 0.5", plateau, front_camera(2, 2, 4000.0))
    lenient = RenderOptions(background=(0.2, 0.5, 0.1), depth_valid_transmittance=0.5)
    add(7, "final T in (0.45, 0.5)", _gaussians([(0, 0, 0)], 0.3, 0.53, 7), front_camera(), lenient)
    anything = RenderOptions(depth_valid_transmittance=1.0)
    add(7, "never reaches 0.5", _gaussians([(0, 0, 0)], 0.3, 0.4, 7), front_camera(), anything)
    add(7, "in the first Gaussian", _gaussians([(0, 0, 0)], 0.3, 0.95, 7), front_camera())
    return scenes
