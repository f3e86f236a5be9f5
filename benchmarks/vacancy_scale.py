# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy of a million points from fifty cameras: seconds, and error against the definition.

``python -m benchmarks.vacancy_scale``, with ``--device cuda`` on a GPU
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.field.cuda_vacancy import CudaVacancyField
from gaussian_wrapping_addon.core.field.vacancy import SETTLED, VacancyField
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from gaussian_wrapping_addon.core.parallel import default_threads
from gaussian_wrapping_addon.core.scene.camera import Camera

from .workload import DISTANCE, surface_gaussians

_logger = logging.getLogger(__name__)

WIDTH_PX, HEIGHT_PX = 540, 960
NEAR_SHARE = 0.5
"""Share of the points that lie about the Gaussians; the others fill the scene's box."""
NEAR_SPREAD = 0.03
"""Standard deviation of their distance from a mean, scene units: a few thicknesses."""


# -- Numerically stable log G and log(1 - G) ------------------------------------------------------


LOG_HALF = -0.6931471805599453


def log_gaussian(log_alpha: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return ``log G = log alpha - q / 2`` from the squared Mahalanobis distance q."""
    return np.asarray(log_alpha, np.float64) - 0.5 * np.asarray(q, np.float64)


def log_one_minus(log_g: np.ndarray) -> np.ndarray:
    """Return ``log(1 - G)`` of ``log G``: -inf where it is 0 (docs/method.md, section 5.4)."""
    log_g = np.asarray(log_g, np.float64)
    # Both forms are computed and one is chosen: for small G, 1 - G rounds, which log1p avoids; for
    # G near 1, exp(log G) rounds, which expm1 avoids.
    with np.errstate(divide="ignore"):
        near_zero = np.log1p(-np.exp(log_g))
        near_one = np.log(-np.expm1(log_g))
    return np.where(log_g < LOG_HALF, near_zero, near_one)


# -- Vacancy by its definition, every Gaussian at every point; tests compare with it too -----------


PAIRS_PER_BLOCK = 2_000_000


def log_transmittance(arrays: GaussianArrays, center: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the log transmittance between a camera centre and points.

    See docs/method.md, section 5.1. The cost is Gaussians x points.

    Parameters
    ----------
    arrays : GaussianArrays
        All ``m`` Gaussians are included, also those beside or behind the camera (which contribute
        their value at the camera, docs/method.md, section 5.4).
    center : (3,) float64
        Camera centre, scene frame.
    points : (n, 3) float64
        Scene frame.

    Returns
    -------
    (n,) float64
        ``sum_i log(1 - G_i(o + min(t, t*_i) w))``.
    """
    points = np.ascontiguousarray(points, np.float64)
    # L = S^-1 R^T; the difference is taken before whitening, where it is exact.
    whiten = arrays.rotations.transpose(0, 2, 1) / arrays.scales[:, :, None]  # (m, 3, 3)
    offset = np.einsum("mij,mj->mi", whiten, arrays.means - center)  # (m, 3)
    out = np.empty(len(points))
    block = max(1, PAIRS_PER_BLOCK // max(1, len(arrays)))
    for begin in range(0, len(points), block):
        ray = points[begin : begin + block] - center  # (b, 3), the point is at parameter 1
        step = np.einsum("mij,bj->bmi", whiten, ray)  # (b, m, 3)
        length_sq = np.einsum("bmi,bmi->bm", step, step)
        peak = np.einsum("bmi,mi->bm", step, offset) / np.maximum(length_sq, 1e-300)  # (b, m)
        at = np.clip(peak, 0.0, 1.0)
        residual = offset - at[:, :, None] * step  # (b, m, 3)
        q = np.einsum("bmi,bmi->bm", residual, residual)
        out[begin : begin + block] = log_one_minus(log_gaussian(arrays.log_opacities, q)).sum(1)
    return out


def brute_force_vacancy(
    arrays: GaussianArrays,
    cameras: Sequence[Camera],
    points: np.ndarray,
    *,
    near_z: float = limits.NEAR_Z,
) -> tuple[np.ndarray, np.ndarray]:
    """Return vacancy and arg-max camera in float64, without culling, cut-off or early exit.

    Parameters
    ----------
    points : (n, 3) float64
        Scene frame.
    near_z : float
        A camera sees a point that lies in its image and deeper than this (scene units).

    Returns
    -------
    vacancy : (n,) float64
        Largest transmittance over the cameras that see the point; NaN where none does.
    camera : (n,) int32
        The first camera that attains it, or -1.
    """
    points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    best = np.full(len(points), -np.inf)
    camera_index = np.full(len(points), -1, np.int32)
    for index, camera in enumerate(cameras):
        pixels, depth = camera.project(points)
        seen = (depth > near_z) & (pixels >= 0.0).all(1)
        seen &= (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height)
        rows = np.flatnonzero(seen)
        if len(rows) == 0:
            continue
        value = np.exp(log_transmittance(arrays, camera.center, points[rows]))
        better = value > best[rows]
        best[rows[better]] = value[better]
        camera_index[rows[better]] = index
    return np.where(camera_index >= 0, best, np.nan), camera_index


# -- The measurement ---------------------------------------------------------------------------


@dataclass(frozen=True)
class VacancyScale:
    """Figures of one run; all seconds are of the wall clock unless said otherwise."""

    gaussians: int
    cameras: int
    points: int
    threads: int
    device: str
    prepare_s: float
    """Projecting and binning the Gaussians for all cameras, once for all later queries."""
    prepare_cpu_s: float
    values_s: float
    """Vacancy and arg-max camera, the cameras being prepared."""
    values_cpu_s: float
    """The same in processor time: what to compare on a busy machine."""
    sign_s: float
    """Side of 0.5 only."""
    sign_cpu_s: float
    unseen_share: float
    undecided_share: float
    """Share of the points whose vacancy lies between 0.01 and 0.99."""
    sample: int
    """Points also evaluated by the definition in float64."""
    error_median: float
    error_max: float
    """Of the sample's vacancy, where it is below 0.999."""
    same_side_share: float
    """Share of the sample whose sign-only answer is the definition's."""

    @property
    def seconds(self) -> float:
        """Cameras prepared and all points evaluated."""
        return self.prepare_s + self.values_s


def cameras_around(count: int) -> list[Camera]:
    """Return cameras of 540 x 960 pixels, evenly spread over a sphere, that look at the origin."""
    cameras = []
    for i in range(count):
        z = 1.0 - (2.0 * i + 1.0) / count
        turn = math.pi * (1.0 + 5.0**0.5) * (i + 0.5)
        flat = math.sqrt(1.0 - z * z)
        eye = DISTANCE * np.array([math.cos(turn) * flat, math.sin(turn) * flat, z])
        forward = -eye / DISTANCE
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        turned = np.stack([right, np.cross(forward, right), forward])  # (3, 3) rows
        pose = np.concatenate([turned, -(turned @ eye)[:, None]], 1)
        focal = float(HEIGHT_PX)
        cameras.append(
            Camera(
                f"view {i}", WIDTH_PX, HEIGHT_PX, focal, focal, WIDTH_PX / 2, HEIGHT_PX / 2, pose
            )
        )
    return cameras


def query_points(arrays: GaussianArrays, count: int, seed: int = 0) -> np.ndarray:
    """Return (count, 3) points, half of them about the Gaussians and half anywhere in their box."""
    rng = np.random.default_rng(seed)
    near = round(NEAR_SHARE * count)
    about = arrays.means[rng.integers(0, len(arrays), near)]
    about = about + NEAR_SPREAD * rng.normal(size=(near, 3))
    low, high = arrays.means.min(0), arrays.means.max(0)
    points = np.concatenate([about, rng.uniform(low, high, (count - near, 3))])
    return points[rng.permutation(count)]


def measure(
    gaussians: int = 50_000,
    cameras: int = 50,
    points: int = 1_000_000,
    *,
    sample: int = 60,
    threads: int = 0,
    device: str = "cpu",
) -> VacancyScale:
    """Time the vacancy of points near and off a surface, and compare a sample with its definition.

    Parameters
    ----------
    gaussians, cameras, points : int
        Size of the task.
    sample : int
        Points for the definition (about 0.02 s each at 50 000 Gaussians, times the cameras).
    threads : int
        0 uses every core.
    device : str
        ``"cuda"`` evaluates on torch's GPU; the processor still prepares the cameras.
    """
    threads = threads or default_threads()
    arrays = surface_gaussians(gaussians, sh_degree=0).arrays()
    views = cameras_around(cameras)
    asked = query_points(arrays, points)
    # Compiles, and shows both programs a task of the same kind.
    warm = _field(arrays, views[:1], threads, device)
    warm.vacancy(asked[:1000])
    warm.is_empty(asked[:1000])

    field = _field(arrays, views, threads, device)
    prepare_s, prepare_cpu_s, _ = _timed(field.prepare)
    values_s, values_cpu_s, result = _timed(lambda: field.vacancy(asked))
    # A field of its own: its order of cameras must not come from the values.
    signs = _field(arrays, views, threads, device)
    signs.prepare()
    sign_s, sign_cpu_s, empty = _timed(lambda: signs.is_empty(asked))

    between = (result.vacancy > 0.01) & (result.vacancy < 0.99)
    # The definition takes long: mostly points where it says something.
    rows = np.concatenate([np.flatnonzero(between)[: sample - sample // 4], np.arange(sample // 4)])
    exact, _ = brute_force_vacancy(arrays, views, asked[rows])
    exact = np.where(np.isnan(exact), 1.0, exact)
    error = np.abs(result.vacancy[rows] - exact)[result.vacancy[rows] <= SETTLED]
    return VacancyScale(
        gaussians=gaussians,
        cameras=cameras,
        points=points,
        threads=threads,
        device=field.device,
        prepare_s=prepare_s,
        prepare_cpu_s=prepare_cpu_s,
        values_s=values_s,
        values_cpu_s=values_cpu_s,
        sign_s=sign_s,
        sign_cpu_s=sign_cpu_s,
        unseen_share=float((result.camera < 0).mean()),
        undecided_share=float(between.mean()),
        sample=len(rows),
        error_median=float(np.median(error)) if len(error) else 0.0,
        error_max=float(error.max()) if len(error) else 0.0,
        same_side_share=float((empty[rows] == (exact > 0.5)).mean()) if len(rows) else 1.0,
    )


def _field(
    arrays: GaussianArrays, views: Sequence[Camera], threads: int, device: str
) -> VacancyField:
    if device == "cpu":
        return VacancyField(arrays, views, threads=threads)
    return CudaVacancyField(arrays, views, threads=threads, device=device)


def _timed(work: Callable[[], object]) -> tuple[float, float, object]:
    wall, cpu = time.perf_counter(), time.process_time()
    answer = work()
    return time.perf_counter() - wall, time.process_time() - cpu, answer


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and log the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", help="JSON file of the figures")
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--cameras", type=int, default=50)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--sample", type=int, default=60)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--device", default="cpu", help="cpu, or cuda")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    figures = measure(
        options.gaussians,
        options.cameras,
        options.points,
        sample=options.sample,
        threads=options.threads,
        device=options.device,
    )
    if options.out is not None:
        write_json(options.out, {**dataclasses.asdict(figures), "seconds": figures.seconds})
    values = ", ".join(
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in dataclasses.asdict(figures).items()
    )
    _logger.info("%.2f s: %s", figures.seconds, values)


if __name__ == "__main__":
    main()
