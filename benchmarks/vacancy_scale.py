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

from gaussian_wrapping_addon.core.field.cuda_vacancy import CudaVacancyField
from gaussian_wrapping_addon.core.field.vacancy import SETTLED, VacancyField, brute_force_vacancy
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
