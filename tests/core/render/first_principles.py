# SPDX-License-Identifier: GPL-3.0-or-later
"""The images of oriented Gaussians straight from covariances, means and rays in world space.

Nothing of the package is used but its dataclasses: constants, activations, harmonics, the blending
walk and the crossing are written anew, in numpy float64 or, with ``digits``, in mpmath. Cost is
pixels x Gaussians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np
from scipy.special import sph_harm_y

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.scene.camera import Camera

TRAINED = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
IMAGES = ("color", "normal", "geometric_normal", "alpha", "depth")
_ELEMENTS_PER_CHUNK = 300_000


@dataclass(frozen=True)
class Truth:
    """Images and how far each pixel is from every place where they jump or have a kink."""

    color: np.ndarray  # (h, w, 3)
    normal: np.ndarray  # (h, w, 3)
    geometric_normal: np.ndarray  # (h, w, 3)
    alpha: np.ndarray  # (h, w)
    depth: np.ndarray  # (h, w) z-depth, 0 where there is none
    slope: np.ndarray  # (h, w) -d(log T)/dt at the depth, 0 where there is none
    sharpest: np.ndarray  # (h, w) largest 1 / sigma along the ray of the contributors
    margin: np.ndarray
    """(h, w) smallest relative distance of an alpha to 1/255 and of a transmittance to 1e-4."""
    limit_margin: np.ndarray
    """(h, w) distance of the final transmittance to the depth's limit (and of T(0) to 0.5)."""
    kink: np.ndarray
    """(h, w) smallest relative distance of an alpha, or of a G at the depth, to the cap."""

    def image(self, name: str) -> np.ndarray:
        """Return one of :data:`IMAGES`."""
        return np.asarray(getattr(self, name))


class _Numbers:
    """Element-wise functions of float64, or of mpmath numbers in object arrays."""

    def __init__(self, digits: int) -> None:
        self.digits = digits
        self.dtype = object if digits else np.float64
        self.context = mpmath.MPContext()
        self.context.dps = max(digits, 15)

    def array(self, values: Any) -> np.ndarray:
        values = np.asarray(values)
        if self.digits and values.dtype != object:
            return self._map(self.context.mpf, values.astype(np.float64))
        return values if self.digits else values.astype(np.float64)

    def _map(self, function: Any, values: np.ndarray) -> np.ndarray:
        # frompyfunc unwraps arrays without axes.
        return np.asarray(np.frompyfunc(function, 1, 1)(values), object)

    def exp(self, values: np.ndarray) -> np.ndarray:
        return self._map(self.context.exp, values) if self.digits else np.exp(values)

    def sqrt(self, values: np.ndarray) -> np.ndarray:
        return self._map(self.context.sqrt, values) if self.digits else np.sqrt(values)

    def tanh(self, values: np.ndarray) -> np.ndarray:
        return self._map(self.context.tanh, values) if self.digits else np.tanh(values)

    def constant(self, numerator: int, denominator: int) -> Any:
        return self.context.mpf(numerator) / denominator if self.digits else numerator / denominator

    def harmonic(self, level: int, m: int, direction: np.ndarray) -> np.ndarray:
        """(n,) real harmonic from the complex one of a library; Condon-Shortley phase."""
        size = np.sqrt(2.0) if m else 1.0
        if not self.digits:
            polar = np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), direction[:, 2])
            azimuth = np.arctan2(direction[:, 1], direction[:, 0])
            value = sph_harm_y(level, abs(m), polar, azimuth)
            return size * (value.imag if m < 0 else value.real)
        context = self.context
        size = context.sqrt(2) if m else context.mpf(1)
        rows = []
        for x, y, z in direction:
            if level == 0:
                rows.append(1 / context.sqrt(4 * context.pi))
                continue
            polar = context.atan2(context.sqrt(x * x + y * y), z)
            value = context.spherharm(level, abs(m), polar, context.atan2(y, x))
            rows.append(size * (value.imag if m < 0 else value.real))
        return np.array(rows, object)


class FirstPrinciples:
    """A view of some Gaussians.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Any float type; the values are taken exactly.
    camera : Camera
    near_z, background, limit
        As in the renderer's options; ``limit`` is the largest final transmittance with a depth.
    digits : int
        0 computes in float64, else with so many decimal digits.
    """

    def __init__(
        self,
        gaussians: OrientedGaussians,
        camera: Camera,
        *,
        near_z: float = 0.2,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        limit: float = 0.45,
        digits: int = 0,
    ) -> None:
        self.numbers = _Numbers(digits)
        self.camera, self.near_z, self.limit = camera, near_z, limit
        self.background = np.asarray(background, np.float64)
        self.values = {
            name: self.numbers.array(tensor.detach().double().numpy())
            for name, tensor in gaussians.tensors()
        }
        self.cap = self.numbers.constant(99, 100)
        self.least = self.numbers.constant(1, 255)
        self._activate(self.values)

    # -- Gaussians --------------------------------------------------------------------------------

    def _activate(self, raw: Mapping[str, np.ndarray]) -> None:
        """From raw parameters to opacity, inverse covariance and colours in blending order."""
        numbers, camera = self.numbers, self.camera
        rotation = numbers.array(camera.cam_from_world[:, :3])
        self.turn = rotation
        self.eye = -_apply(rotation.T, numbers.array(camera.cam_from_world[:, 3]))
        gap = raw["means"] - self.eye  # (n, 3)
        distance = numbers.sqrt((gap * gap).sum(-1))  # (n,)
        z = (gap * rotation[2]).sum(-1)
        rank = np.lexsort((np.arange(len(z)), distance.astype(np.float64).astype(np.float32)))
        order = np.array([i for i in rank if z[i] > self.near_z], np.int64)
        raw = {name: value[order] for name, value in raw.items()}
        self.order, self.gap, distance = order, gap[order], distance[order]

        variance = numbers.exp(2 * raw["log_scales"])  # (n, 3)
        blurred = variance + raw["filter_3d"][:, None] ** 2
        kept = numbers.sqrt((variance / blurred).prod(-1)) if len(order) else distance
        self.opacity = kept / (1 + numbers.exp(-raw["opacity_logits"]))
        axes = _rotations(raw["quats"])  # (n, 3, 3) columns
        covariance = (axes[:, :, None, :] * axes[:, None, :, :] * blurred[:, None, None, :]).sum(-1)
        self.precision = _inverse(covariance)

        direction = raw["orientation"][:, :3]
        length = numbers.sqrt((direction * direction).sum(-1))
        length = np.where((length > 0).astype(bool), length, 1)
        self.normals = (
            numbers.tanh(raw["orientation"][:, 3:]) * direction / length[:, None]
        )  # (n, 3)
        slope = -_apply(self.precision, self.gap)
        self.geometric = slope / numbers.sqrt((slope * slope).sum(-1))[:, None]
        self.colors = self._colors(raw["sh"], self.gap / distance[:, None])

    def _colors(self, sh: np.ndarray, direction: np.ndarray) -> np.ndarray:
        value = self.numbers.array(np.full((len(sh), 3), 0.5))
        column = 0
        for level in range(round(sh.shape[1] ** 0.5)):
            for m in range(-level, level + 1):
                value = value + self.numbers.harmonic(level, m, direction)[:, None] * sh[:, column]
                column += 1
        return np.maximum(value, 0)

    # -- rays -------------------------------------------------------------------------------------

    def images(self, start: np.ndarray | None = None) -> Truth:
        """Return every image; with ``start (h, w)`` the depth is one Newton step from there."""
        camera = self.camera
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        truth = self.at(
            np.stack([x.ravel(), y.ravel()], 1), None if start is None else start.ravel()
        )
        shape = (camera.height, camera.width)
        return Truth(**{k: v.reshape(shape + v.shape[1:]) for k, v in vars(truth).items()})

    def at(self, positions: np.ndarray, start: np.ndarray | None = None) -> Truth:
        """Return (m, ...) what is seen at (m, 2) positions in pixels, on the image or not."""
        count = len(positions)
        size = max(1, _ELEMENTS_PER_CHUNK // max(len(self.order), 1))
        chunks = [
            self._pixels(
                self._rays(positions[first : first + size]),
                None if start is None else start[first : first + size],
            )
            for first in range(0, count, size)
        ]
        return Truth(
            **{name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
        )

    def _rays(self, positions: np.ndarray) -> np.ndarray:
        """(p, 3) world directions whose component along the optical axis is 1."""
        camera, array = self.camera, self.numbers.array
        x = (array(positions[:, 0]) - array(camera.cx)) / array(camera.fx)
        y = (array(positions[:, 1]) - array(camera.cy)) / array(camera.fy)
        return x[:, None] * self.turn[0] + y[:, None] * self.turn[1] + self.turn[2]

    def _pixels(self, rays: np.ndarray, start: np.ndarray | None) -> dict[str, np.ndarray]:
        numbers = self.numbers
        pulled = _apply(self.precision[None], rays[:, None])  # (p, n, 3) Sigma^-1 r
        steep = (pulled * rays[:, None]).sum(-1)  # (p, n) 1 / variance along the ray
        peak = (pulled * self.gap).sum(-1) / steep  # (p, n) t*
        alpha = self._opacity_at(peak, rays[:, None], slice(None))
        capped = np.minimum(alpha, self.cap)
        seen = (capped >= self.least).astype(bool)
        one = numbers.array(np.ones((len(rays), 1)))
        # A Gaussian that is too late would only darken what comes behind it, which is later still.
        through = np.cumprod(np.concatenate([one, np.where(seen, 1 - capped, 1)], 1), 1)
        late = (through[:, :-1] < 1e-4).astype(bool)
        used = seen & ~late
        before = through[:, :-1]
        weight = np.where(used, capped * before, 0)  # (p, n)
        final = np.where(used, 1 - capped, 1).prod(-1) if len(self.order) else one[:, 0]
        background = numbers.array(self.background)
        depth, slope, clear = self._crossings(rays, peak, steep, used, final, start)
        near = np.where(used | (~late & ~seen), abs(alpha / self.least - 1), np.inf)
        near = np.concatenate([near, abs(through[:, :-1] / numbers.constant(1, 10_000) - 1)], 1)
        at_depth = self._opacity_at(np.minimum(depth[:, None], peak), rays[:, None], slice(None))
        kinks = np.where(
            used, np.minimum(abs(alpha / self.cap - 1), abs(at_depth / self.cap - 1)), 1
        )
        sharp = np.where(used, steep, 0)
        limit = np.minimum(abs(final - self.limit), abs(final - 0.5))
        return {
            "color": (weight[..., None] * self.colors).sum(1) + final[:, None] * background,
            "normal": (weight[..., None] * self.normals).sum(1),
            "geometric_normal": (weight[..., None] * self.geometric).sum(1),
            "alpha": 1 - final,
            "depth": depth,
            "slope": slope,
            "sharpest": numbers.sqrt(sharp.max(-1, initial=0)),
            "margin": near.min(-1, initial=1.0).astype(np.float64),
            "limit_margin": np.minimum(limit, clear).astype(np.float64),
            "kink": kinks.min(-1, initial=1.0).astype(np.float64),
        }

    def _opacity_at(self, t: np.ndarray, rays: np.ndarray, pick: Any) -> np.ndarray:
        """(p, n) opacity times the Gaussian at z-depths ``t`` of the rays."""
        away = t[..., None] * rays - self.gap[pick]
        pulled = _apply(self.precision[pick], away)
        return self.opacity[pick] * self.numbers.exp(-(pulled * away).sum(-1) / 2)

    # -- depth ------------------------------------------------------------------------------------

    def _crossings(
        self,
        rays: np.ndarray,
        peak: np.ndarray,
        steep: np.ndarray,
        used: np.ndarray,
        final: np.ndarray,
        start: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(p,) crossing of 0.5, slope of -log T there, and |T(0) - 0.5|."""
        numbers = self.numbers
        depth, slope = numbers.array(np.zeros(len(rays))), numbers.array(np.zeros(len(rays)))
        clear = np.ones(len(rays))
        deep = np.nonzero((final <= self.limit) & (final < 0.5))[0]
        if len(deep) == 0:
            return depth, slope, clear
        # Each pixel's contributors to the front; the rest is masked.
        count = int(used[deep].sum(1).max())
        pick = np.argsort(~used[deep], axis=1, kind="stable")[:, :count]  # (q, c)
        mask = np.take_along_axis(used[deep], pick, 1)
        peak = np.take_along_axis(peak[deep], pick, 1)
        steep = np.take_along_axis(steep[deep], pick, 1)
        rays = rays[deep][:, None]  # (q, 1, 3)

        def density(t: np.ndarray) -> np.ndarray:
            """(q, c) G at z-depths (q,)."""
            g = self._opacity_at(np.minimum(t[:, None], peak), rays, pick)
            return np.where(mask, np.minimum(g, self.cap), 0)

        def transmittance(t: np.ndarray) -> np.ndarray:
            return (1 - density(t)).prod(-1)

        low = numbers.array(np.zeros(len(deep)))
        high = np.where(mask, peak, 0).max(-1)
        at_camera = transmittance(low)
        clear[deep] = abs(at_camera - numbers.constant(1, 2)).astype(np.float64)
        valid = (at_camera > 0.5).astype(bool)
        if start is None:
            for _ in range(int(3.4 * max(numbers.digits, 17))):
                middle = (low + high) / 2
                above = (transmittance(middle) > 0.5).astype(bool)
                low, high = np.where(above, middle, low), np.where(above, high, middle)
            found = (low + high) / 2
        else:
            found = start[deep]
        g = density(found)
        ahead = np.maximum(peak - found[:, None], 0)
        free = (g < self.cap).astype(bool)
        falls = np.where(free, g / (1 - g) * steep * ahead, 0).sum(-1)
        if start is not None:
            product = transmittance(found)
            # log(2 T) to second order: T is within rounding of 0.5 or a tiny step away.
            found = found + (2 * product - 1) / np.where((falls > 0).astype(bool), falls, 1)
        depth[deep[valid]] = found[valid]
        slope[deep[valid]] = falls[valid]
        return depth, slope, clear

    # -- gradients --------------------------------------------------------------------------------

    def gradients(
        self, losses: Sequence[Mapping[str, np.ndarray]], names: tuple[str, ...] = TRAINED
    ) -> list[dict[str, np.ndarray]]:
        """Differentiate every ``sum(weights * images)`` by differences far below any rounding.

        Parameters
        ----------
        losses : each the weights of some of :data:`IMAGES`
        names : parameters

        Returns
        -------
        for each loss, float64 arrays of the parameters' shapes
        """
        assert self.numbers.digits >= 40, "differences need digits"
        step = self.numbers.context.mpf(10) ** -(self.numbers.digits // 3)
        base = self.images()

        def values() -> list[Any]:
            truth = self.images(base.depth)
            return [sum((w * truth.image(k)).sum() for k, w in loss.items()) for loss in losses]

        out: list[dict[str, np.ndarray]] = [{} for _ in losses]
        try:
            settled = values()
            for name in names:
                shape = self.values[name].shape
                slopes = [np.zeros(shape) for _ in losses]
                for at in np.ndindex(shape):
                    moved = self.values[name].copy()
                    moved[at] += step
                    self._activate({**self.values, name: moved})
                    for slope, new, old in zip(slopes, values(), settled, strict=True):
                        slope[at] = float((new - old) / step)
                for found, slope in zip(out, slopes, strict=True):
                    found[name] = slope
        finally:
            self._activate(self.values)
        return out


def _apply(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Multiply (..., 3, 3) with (..., 3)."""
    return np.asarray((matrices * vectors[..., None, :]).sum(-1))


def _rotations(quats: np.ndarray) -> np.ndarray:
    """(n, 3, 3) images of the unit vectors under q v q* / |q|^2; the identity for q = 0."""
    w, u = quats[:, 0], quats[:, 1:]
    size = w * w + (u * u).sum(-1)  # (n,)
    columns = []
    for axis in range(3):
        e = np.zeros(3)
        e[axis] = 1.0
        cross = np.stack(
            [u[:, 1] * e[2] - u[:, 2] * e[1], u[:, 2] * e[0] - u[:, 0] * e[2],
             u[:, 0] * e[1] - u[:, 1] * e[0]], 1)  # fmt: skip
        turned = (
            2 * u[:, axis][:, None] * u
            + (w * w - (u * u).sum(-1))[:, None] * e
            + 2 * w[:, None] * cross
        )
        safe = np.where((size > 0).astype(bool), size, 1)
        columns.append(np.where((size > 0).astype(bool)[:, None], turned / safe[:, None], e))
    return np.stack(columns, -1)


def _inverse(m: np.ndarray) -> np.ndarray:
    """(n, 3, 3) inverses of symmetric matrices by cofactors."""
    out = np.empty_like(m)
    for i in range(3):
        for j in range(3):
            r, s = (j + 1) % 3, (j + 2) % 3
            c, d = (i + 1) % 3, (i + 2) % 3
            out[:, i, j] = m[:, r, c] * m[:, s, d] - m[:, r, d] * m[:, s, c]
    determinant = (m[:, 0, :] * out[:, :, 0]).sum(-1)
    return out / determinant[:, None, None]
