# SPDX-License-Identifier: GPL-3.0-or-later
"""The reference renderer against the definition evaluated from Sigma, mu and metric rays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.scenes import look_at, random_gaussians

NEAR_Z = 0.2


class Definition:
    """Numpy only: inverse covariances, world-space rays, walks in Python."""

    def __init__(self, gaussians: OrientedGaussians, camera: Camera) -> None:
        raw = {name: tensor.double().numpy() for name, tensor in gaussians.tensors()}
        self.camera = camera
        self.eye = -camera.cam_from_world[:, :3].T @ camera.cam_from_world[:, 3]
        variance = np.exp(raw["log_scales"]) ** 2
        blurred = variance + raw["filter_3d"][:, None] ** 2
        self.opacity = np.sqrt(np.prod(variance / blurred, axis=1)) / (
            1.0 + np.exp(-raw["opacity_logits"])
        )
        self.means = raw["means"]
        turn = Rotation.from_quat(raw["quats"][:, [1, 2, 3, 0]]).as_matrix()
        self.precision = np.linalg.inv(turn @ (blurred[:, :, None] * turn.transpose(0, 2, 1)))
        direction = raw["orientation"][:, :3]
        self.normals = (
            np.tanh(raw["orientation"][:, 3:])
            * direction
            / np.linalg.norm(direction, axis=1, keepdims=True)
        )
        offset = self.means - self.eye
        distance = np.linalg.norm(offset, axis=1)
        self.colors = self._colors(raw["sh"], offset / distance[:, None])
        slope = -np.einsum("nij,nj->ni", self.precision, offset)
        self.geometric = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        z = offset @ camera.cam_from_world[2, :3]
        order = np.lexsort((np.arange(len(z)), distance.astype(np.float32)))
        self.order = [i for i in order if z[i] > NEAR_Z]

    @staticmethod
    def _colors(sh: np.ndarray, direction: np.ndarray) -> np.ndarray:
        polar = np.arccos(direction[:, 2])
        azimuth = np.arctan2(direction[:, 1], direction[:, 0])
        value = np.full((len(sh), 3), 0.5)
        column = 0
        for level in range(round(sh.shape[1] ** 0.5)):
            for m in range(-level, level + 1):
                harmonic = sph_harm_y(level, abs(m), polar, azimuth)
                part = harmonic.imag if m < 0 else harmonic.real
                value += (part * (np.sqrt(2.0) if m else 1.0))[:, None] * sh[:, column]
                column += 1
        return np.maximum(value, 0.0)

    def pixel(self, row: int, column: int, limit: float = 0.45) -> np.ndarray:
        """Return colour, normals, alpha and depth of one pixel, (11,)."""
        camera = self.camera
        local = np.array(
            [
                (column + 0.5 - camera.cx) / camera.fx,
                (row + 0.5 - camera.cy) / camera.fy,
                1.0,
            ]
        )
        ray = camera.cam_from_world[:, :3].T @ local
        stretch = np.linalg.norm(ray)
        ray /= stretch  # metric
        out = np.zeros(11)
        through = 1.0
        hits = []
        for i in self.order:
            gap = self.means[i] - self.eye
            steep = ray @ self.precision[i] @ ray
            peak = ray @ self.precision[i] @ gap / steep
            miss = peak * ray - gap
            smallest = miss @ self.precision[i] @ miss
            alpha = min(0.99, self.opacity[i] * np.exp(-0.5 * smallest))
            if alpha < 1.0 / 255.0 or through < 1e-4:
                continue
            weight = alpha * through
            out[0:3] += weight * self.colors[i]
            out[3:6] += weight * self.normals[i]
            out[6:9] += weight * self.geometric[i]
            through *= 1.0 - alpha
            hits.append(i)
        out[9] = 1.0 - through
        if through <= limit:
            out[10] = self._crossing(ray, hits) / stretch
        return out

    def transmittance(self, ray: np.ndarray, hits: list[int], t: float) -> float:
        """T at metric distance t: every G at the nearer of t and its own peak."""
        product = 1.0
        for i in hits:
            gap = self.means[i] - self.eye
            steep = ray @ self.precision[i] @ ray
            peak = ray @ self.precision[i] @ gap / steep
            away = min(t, peak) * ray - gap
            g = self.opacity[i] * np.exp(-0.5 * (away @ self.precision[i] @ away))
            product *= 1.0 - min(0.99, g)
        return product

    def _crossing(self, ray: np.ndarray, hits: list[int]) -> float:
        far = 100.0
        if self.transmittance(ray, hits, 0.0) <= 0.5 or self.transmittance(ray, hits, far) >= 0.5:
            return 0.0
        return float(
            brentq(
                lambda t: self.transmittance(ray, hits, t) - 0.5, 0.0, far, xtol=1e-13, rtol=1e-14
            )
        )


def images(gaussians: OrientedGaussians, camera: Camera, **options: object) -> np.ndarray:
    with torch.no_grad():
        view = render_reference(gaussians, camera, RenderOptions(**options))  # type: ignore[arg-type]
    parts = [view.color, view.normal, view.geometric_normal, view.alpha[..., None]]
    return torch.cat([*parts, view.depth[..., None]], 2).numpy()


@pytest.mark.parametrize(
    ("seed", "degree", "eye"),
    [(0, 0, (2.0, 0.6, 0.9)), (1, 3, (-0.4, -2.5, 0.7)), (2, 2, (0.6, 0.5, -0.2))],
)
def test_every_channel_is_the_definition(
    seed: int, degree: int, eye: tuple[float, float, float]
) -> None:
    gaussians = random_gaussians(40, seed, sh_degree=degree, opacity=(0.05, 0.999))
    camera = look_at(eye, width=17, height=13, focal=19.0)
    got = images(gaussians, camera)
    wanted_at = Definition(gaussians, camera)
    wanted = np.stack(
        [
            np.stack([wanted_at.pixel(row, column) for column in range(camera.width)])
            for row in range(camera.height)
        ]
    )
    assert (wanted[..., 10] > 0).mean() > 0.2
    np.testing.assert_allclose(got[..., :10], wanted[..., :10], atol=1e-11, rtol=0)
    np.testing.assert_array_equal(got[..., 10] > 0, wanted[..., 10] > 0)
    np.testing.assert_allclose(got[..., 10], wanted[..., 10], atol=1e-10, rtol=0)


def test_depth_validity_follows_the_option() -> None:
    gaussians = random_gaussians(25, 5, opacity=(0.3, 0.9))
    camera = look_at((2.4, 0.2, 0.4), width=16, height=12, focal=20.0)
    view = images(gaussians, camera)
    strict = images(gaussians, camera, depth_valid_transmittance=0.2)
    loose = images(gaussians, camera, depth_valid_transmittance=0.9)
    np.testing.assert_array_equal(strict[..., 10] > 0, view[..., 9] >= 0.8)
    np.testing.assert_array_equal(loose[..., 10] > 0, view[..., 9] > 0.5)
    assert (loose[..., 10] > 0).sum() > (strict[..., 10] > 0).sum() > 0
    both = strict[..., 10] > 0
    np.testing.assert_array_equal(strict[both], loose[both])
    assert not images(gaussians, camera, depth=False)[..., 10].any()


def test_background_fills_what_is_left() -> None:
    gaussians = random_gaussians(10, 3)
    camera = look_at((2.4, 0.2, 0.4), width=16, height=12, focal=20.0)
    black = images(gaussians, camera)
    bright = images(gaussians, camera, background=(1.0, 0.25, 0.5))
    left = 1.0 - black[..., 9:10]
    np.testing.assert_allclose(
        bright[..., :3], black[..., :3] + left * [1.0, 0.25, 0.5], atol=1e-14
    )
    np.testing.assert_array_equal(bright[..., 3:], black[..., 3:])


def test_chunks_and_order_of_storage_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians = random_gaussians(30, 4)
    camera = look_at((2.4, 0.2, 0.4), width=11, height=9, focal=13.0)
    whole = images(gaussians, camera)
    shuffled = gaussians.select(torch.randperm(30, generator=torch.manual_seed(0)))
    np.testing.assert_allclose(images(shuffled, camera), whole, atol=1e-13)
    monkeypatch.setattr("gaussian_wrapping_addon.core.render.reference._ELEMENTS_PER_CHUNK", 1000)
    np.testing.assert_allclose(images(gaussians, camera), whole, atol=1e-13)


def test_empty_scene_is_the_background() -> None:
    view = images(random_gaussians(0), look_at((2.0, 0.0, 0.0)), background=(0.1, 0.2, 0.3))
    np.testing.assert_array_equal(view[..., :3], np.broadcast_to([0.1, 0.2, 0.3], (30, 40, 3)))
    assert not view[..., 3:].any()


def test_float32_stays_close_to_float64() -> None:
    gaussians = random_gaussians(30, 6, opacity=(0.2, 0.9))
    camera = look_at((2.2, 0.8, 0.3), width=20, height=16, focal=24.0)
    wide = images(gaussians, camera)
    narrow = random_gaussians(30, 6, opacity=(0.2, 0.9), dtype=torch.float32)
    got = images(narrow, camera)
    assert got.dtype == np.float32
    # A contributor at the 1/255 threshold may switch: at most one weight of that size.
    assert np.abs(got[..., :10] - wide[..., :10]).max() < 2.0 / 255.0
    assert np.quantile(np.abs(got[..., :10] - wide[..., :10]), 0.99) < 1e-5


def test_statistics_are_refused() -> None:
    with pytest.raises(UsageError, match="statistics"):
        render_reference(
            random_gaussians(3), look_at((2.0, 0.0, 0.0)), RenderOptions(statistics=True)
        )
