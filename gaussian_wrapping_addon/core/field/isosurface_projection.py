# SPDX-License-Identifier: GPL-3.0-or-later
"""Points moved onto the isosurface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

import numpy as np

from .. import limits
from ..progress import Progress
from ..scene.camera import Camera
from .vacancy import SETTLED, VacancyResult
from .vector_field import MIN_SLOPE, VectorFieldResult

# -- Residuals of vertices with respect to the isosurface, in vacancy -----------------------------


def isosurface_residuals(vacancy: Any, points: np.ndarray) -> dict[str, Any]:
    """Measure ``|v - 0.5|`` at (n, 3) scene points of the isosurface; empty without points.

    ``vacancy`` has ``vacancy(points)``. The keys ``level_error_*`` are those of reports.
    """
    if len(points) == 0:
        return {}
    away = np.abs(vacancy.vacancy(points).filled.astype(np.float64) - limits.ISO_LEVEL)
    return {
        "level_error_mean": float(away.mean()),
        "level_error_median": float(np.median(away)),
        "level_error_p95": float(np.quantile(away, 0.95)),
        "level_error_p99": float(np.quantile(away, 0.99)),
        "level_error_max": float(away.max()),
    }


# -- Project points onto the surface ``vacancy = 0.5`` by safeguarded Newton and bracketing -------


TOLERANCE = 0.01
"""Largest residual of a point on the surface: about the error of the field due to truncated tails
of Gaussians."""
TARGET_RESIDUAL = 0.002
"""Residual at which iterations stop, where the field is smooth enough. Bracketing ends anywhere
below it, so it bounds the median of any scene. On trained scenes the median is 0.0003 to 0.0004,
for an eighth to a sixth more evaluations than with 0.005 (0.0009 to 0.0012)."""
MAX_ROUNDS = 40
MAX_TRAVEL_SIGMAS = 16.0
MAX_HALVINGS = 1
MAX_NEWTON_STEPS = 3
"""Where Newton does not converge quickly, V differs from the slope (it does not depend on the
camera), and a search for a bracket is faster: with four halvings and unlimited steps more points
ran out of rounds. The exact gradient of the arg-max camera saved 3 % of the evaluations and took
longer than that to compute."""
MAX_STEP_SIGMAS = 1.0
MAX_INWARD_MARCH = 8
BRACKET_END_SIGMAS = 1e-3
"""Brackets this short are not shortened further (docs/method.md, section 5.6)."""
SLOPE_RATIO = 4.0
"""Largest factor by which the slope |V| is corrected from the last Newton step."""
RESOLVED = (1e-4, SETTLED)
"""Outside this range vacancy is not resolved, so that there is no slope for Newton."""


class ProjectionStatus(IntEnum):
    """Outcome for a point."""

    CONVERGED = 0
    """Newton steps reached the tolerance."""
    BISECTED = 1
    """A bracket was found and shortened to the tolerance."""
    DROPPED = 2
    """Not on the surface: no camera sees the point, there is no crossing in its neighbourhood, or
    vacancy is discontinuous there."""


@dataclass(frozen=True)
class ProjectionResult:
    """Projected points with status and residual."""

    points: np.ndarray
    """(n, 3) float64 scene frame: the evaluated position of smallest residual."""
    vacancy: np.ndarray
    """(n,) float32 there."""
    status: np.ndarray
    """(n,) uint8, :class:`ProjectionStatus`."""
    residual: np.ndarray
    """(n,) float32 ``|vacancy - 0.5|`` there."""
    camera: np.ndarray
    """(n,) int32: the camera that sees the point best, or -1."""
    vacancy_evaluations: int
    """Total number of points evaluated."""

    @property
    def on_surface(self) -> np.ndarray:
        """(n,) bool: not dropped."""
        return self.status != ProjectionStatus.DROPPED


class HasVacancy(Protocol):
    """Interface of a vacancy field."""

    @property
    def cameras(self) -> Sequence[Camera]:
        """Cameras by the indices that ``vacancy`` returns."""

    def vacancy(self, points: np.ndarray) -> VacancyResult:
        """Evaluate at (n, 3) points."""


class HasVectors(Protocol):
    """Interface of a vector field."""

    def evaluate(self, points: np.ndarray) -> VectorFieldResult:
        """Evaluate at (n, 3) points."""


_NEWTON, _MARCH, _BRACKET = 0, 1, 2


def project_to_isosurface(
    points: np.ndarray,
    vacancy_field: HasVacancy,
    vector_field: HasVectors,
    progress: Progress | None = None,
    *,
    tolerance: float = TOLERANCE,
    max_steps: int = MAX_ROUNDS,
) -> ProjectionResult:
    """Project (n, 3) scene points onto the surface ``vacancy = 0.5`` (docs/method.md, section 5.6).

    Newton steps on ``log v`` along V, at most one local sigma long, are taken while they reduce
    ``|v - 0.5|`` and are halved once where they do not. As soon as a bracket, two points on
    opposite sides, is known, it is shortened (false position, every third time bisection) until the
    tolerance is reached. Where Newton fails or the field is flat, a bracket is searched along the
    outward direction of the vector field (from occupied points outwards, by doubling distances;
    from empty ones inwards, by steps of one sigma), and if that fails along the ray to the camera
    that sees the point best, on which transmittance must rise to 1. All lengths are in local
    sigmas, so the result scales with the scene.

    ``tolerance`` is the largest ``|v - 0.5|`` of accepted points, sensibly 1e-3 to 2e-2; iterations
    continue to :data:`TARGET_RESIDUAL` where possible. Points still active after ``max_steps``
    batches of vacancy evaluations are dropped.
    """
    progress = progress or Progress()
    points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    centers = np.array([camera.center for camera in vacancy_field.cameras]).reshape(-1, 3)
    vectors = vector_field.evaluate(points)
    evaluated = vacancy_field.vacancy(points)
    search = _Search(points, evaluated, vectors, centers, tolerance)
    rounds, evaluations = 1, len(points)
    while len(search.rows) and rounds < max_steps:
        share = 1.0 - len(search.rows) / max(1, len(points))
        progress.update(share, "Projecting points onto the surface")
        trial = search.next_trials()
        if len(trial) == 0:
            break
        evaluated = vacancy_field.vacancy(trial)
        rounds, evaluations = rounds + 1, evaluations + len(trial)
        accepted = search.update(trial, evaluated)
        if len(accepted):
            fresh = vector_field.evaluate(search.x[accepted])
            search.V[accepted], search.outward[accepted] = fresh.V, fresh.outward
    progress.update(1.0, "Projected points onto the surface")
    return search.result(evaluations)


class _Search:
    """State of every point (full-length arrays) and ``rows``, the active points."""

    def __init__(
        self,
        points: np.ndarray,
        first: VacancyResult,
        vectors: VectorFieldResult,
        centers: np.ndarray,
        tolerance: float,
    ) -> None:
        n = len(points)
        self.centers = centers
        self.tolerance = tolerance
        self.target = min(TARGET_RESIDUAL, tolerance)
        self.sigma = vectors.sigma_local
        self.max_travel = MAX_TRAVEL_SIGMAS * self.sigma
        self.start = points
        # Newton's current point, from which the march starts.
        self.x = points.copy()
        self.v = first.vacancy.astype(np.float64)
        self.V = vectors.V.copy()
        self.outward = vectors.outward.copy()
        self.camera = first.camera.copy()
        self.slope = np.ones(n)  # ratio of the true slope to |V|, from the last step
        self.halvings = np.zeros(n, np.int64)
        self.steps = np.zeros(n, np.int64)
        # The march's last point and its direction.
        self.marched = np.zeros(n, np.int64)
        self.along_ray = np.zeros(n, bool)
        self.march_x = np.zeros((n, 3))
        self.march_v = np.zeros(n)
        self.direction = np.zeros((n, 3))
        # The bracket's occupied and empty end, and v - 0.5 there, weighted by the Illinois rule.
        self.ends = np.zeros((n, 2, 3))
        self.weights = np.zeros((n, 2))
        self.cuts = np.zeros(n, np.int64)
        self.last_side = np.full(n, -1, np.int64)

        self.best_x = points.copy()
        self.best_v = self.v.copy()
        self.best_camera = first.camera.copy()
        self.phase = np.full(n, _NEWTON, np.int8)
        self.status = np.full(n, ProjectionStatus.DROPPED, np.uint8)
        seen = first.camera >= 0
        done = seen & (np.abs(self.v - limits.ISO_LEVEL) <= self.target)
        self.status[done] = ProjectionStatus.CONVERGED
        # Unseen points have no vacancy; without Gaussians there is no length scale.
        self.rows = np.flatnonzero(seen & ~done & (self.sigma > 0.0))

    def result(self, evaluations: int) -> ProjectionResult:
        """Return the best position of every point."""
        residual = np.abs(self.best_v - limits.ISO_LEVEL)
        close = (self.status == ProjectionStatus.DROPPED) & (residual <= self.tolerance)
        close &= self.best_camera >= 0
        newton = self.phase == _NEWTON
        self.status[close & newton] = ProjectionStatus.CONVERGED
        self.status[close & ~newton] = ProjectionStatus.BISECTED
        return ProjectionResult(
            self.best_x, self.best_v.astype(np.float32), self.status, residual.astype(np.float32),
            self.best_camera, evaluations,
        )  # fmt: skip

    # -- next positions ---------------------------------------------------------------------------

    def next_trials(self) -> np.ndarray:
        """Return the next trial position of each row; drop rows without one."""
        rows = self.rows
        newton = rows[self.phase[rows] == _NEWTON]
        length = np.linalg.norm(self.V[newton], axis=1)
        flat = ~(length * self.sigma[newton] > MIN_SLOPE) | ~np.isfinite(length)
        flat |= (self.v[newton] < RESOLVED[0]) | (self.v[newton] > RESOLVED[1])
        flat |= self.halvings[newton] > MAX_HALVINGS
        flat |= self.steps[newton] >= MAX_NEWTON_STEPS
        self._begin_march(newton[flat])

        trial = np.empty((len(rows), 3))
        alive = np.ones(len(rows), bool)
        phase = self.phase[rows]
        trial[phase == _NEWTON] = self._newton(rows[phase == _NEWTON])
        trial[phase == _BRACKET], alive[phase == _BRACKET] = self._false_position(
            rows[phase == _BRACKET]
        )
        march = np.flatnonzero(phase == _MARCH)
        trial[march] = self._march(rows[march])
        exhausted = self._is_exhausted(rows[march], trial[march])
        again = march[exhausted & ~self.along_ray[rows[march]]]
        self._begin_march(rows[again], along_ray=True)
        trial[again] = self._march(rows[again])
        alive[march] = ~self._is_exhausted(rows[march], trial[march])
        alive &= self._travel(rows, trial) <= self.max_travel[rows]
        self.rows = rows[alive]
        return trial[alive]

    def _travel(self, rows: np.ndarray, trial: np.ndarray) -> np.ndarray:
        return np.linalg.norm(trial - self.start[rows], axis=1)

    def _is_exhausted(self, rows: np.ndarray, trial: np.ndarray) -> np.ndarray:
        inward = self.v[rows] > limits.ISO_LEVEL
        too_far = self._travel(rows, trial) > self.max_travel[rows]
        too_far |= inward & (self.marched[rows] > MAX_INWARD_MARCH)
        # Outwards, the last step ends at the limit itself.
        before = np.where(self.marched[rows] > 1, 2.0 ** (self.marched[rows] - 2), 0.0)
        return too_far | (~inward & (before >= self._remaining_sigmas(rows)))

    def _remaining_sigmas(self, rows: np.ndarray) -> np.ndarray:
        """Return the length, in sigmas, that a march from the current point may go."""
        gone = self._travel(rows, self.x[rows])
        return (1.0 - 1e-9) * (self.max_travel[rows] - gone) / self.sigma[rows]

    def _newton(self, rows: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(self.V[rows], axis=1)  # > 0
        step = np.log(limits.ISO_LEVEL / self.v[rows]) / (length * self.slope[rows])
        limit = MAX_STEP_SIGMAS * self.sigma[rows]
        step = np.clip(step, -limit, limit) * 0.5 ** self.halvings[rows]
        return self.x[rows] + (step / length)[:, None] * self.V[rows]

    def _begin_march(self, rows: np.ndarray, along_ray: bool = False) -> None:
        self.phase[rows] = _MARCH
        self.marched[rows] = 0
        self.march_x[rows] = self.x[rows]
        self.march_v[rows] = self.v[rows]
        to_camera = self.centers[self.camera[rows]] - self.x[rows]
        to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-300)
        known = (self.outward[rows] != 0.0).any(1) & (not along_ray)
        outward = np.where(known[:, None], self.outward[rows], to_camera)
        self.along_ray[rows] = ~known
        occupied = self.v[rows] < limits.ISO_LEVEL
        self.direction[rows] = np.where(occupied[:, None], outward, -outward)

    def _march(self, rows: np.ndarray) -> np.ndarray:
        self.marched[rows] += 1
        count = self.marched[rows]
        # Inwards, longer steps could miss a thin wall.
        occupied = self.v[rows] < limits.ISO_LEVEL
        outward = np.minimum(2.0 ** (count - 1), self._remaining_sigmas(rows))
        reach = np.where(occupied, outward, count) * self.sigma[rows]
        return self.x[rows] + reach[:, None] * self.direction[rows]

    def _false_position(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.cuts[rows] += 1
        at = self.weights[rows, 0] / (self.weights[rows, 0] - self.weights[rows, 1])
        at = np.where(self.cuts[rows] % 3 == 0, 0.5, np.clip(at, 0.02, 0.98))
        occupied, empty = self.ends[rows, 0], self.ends[rows, 1]
        span = np.linalg.norm(empty - occupied, axis=1)
        trial = occupied + at[:, None] * (empty - occupied)
        return trial, span > BRACKET_END_SIGMAS * self.sigma[rows]

    # -- evaluated positions ----------------------------------------------------------------------

    def update(self, trial: np.ndarray, evaluated: VacancyResult) -> np.ndarray:
        """Update the state by the vacancy of the trials; return rows where Newton advanced."""
        rows = self.rows
        v = evaluated.vacancy.astype(np.float64)
        seen = evaluated.camera >= 0
        error = np.abs(v - limits.ISO_LEVEL)
        better = seen & (error < np.abs(self.best_v[rows] - limits.ISO_LEVEL))
        self.best_x[rows[better]] = trial[better]
        self.best_v[rows[better]] = v[better]
        self.best_camera[rows[better]] = evaluated.camera[better]

        done = seen & (error <= self.target)
        newton = self.phase[rows] == _NEWTON
        march = self.phase[rows] == _MARCH
        cut = self.phase[rows] == _BRACKET
        self.status[rows[done & newton]] = ProjectionStatus.CONVERGED
        self.status[rows[done & ~newton]] = ProjectionStatus.BISECTED

        crossed = (v > limits.ISO_LEVEL) != (self.v[rows] > limits.ISO_LEVEL)
        # A long march may cross the surface into unseen space; a Newton step is halved there.
        crossed &= seen | march
        opened = newton & crossed & ~done
        self._open_bracket(rows[opened], self.x, self.v, trial[opened], v[opened])
        opened = march & crossed & ~done
        self._open_bracket(rows[opened], self.march_x, self.march_v, trial[opened], v[opened])

        # A smaller residual on the same side: Newton continues there with the corrected slope.
        taken = newton & better & ~crossed & ~done
        now = rows[taken]
        expected = np.einsum("ni,ni->n", self.V[now], trial[taken] - self.x[now])
        shown = np.log(v[taken] / self.v[now]) / np.where(expected == 0.0, 1.0, expected)
        shown = np.where(np.isfinite(shown), shown, 1.0)
        self.slope[now] = np.clip(shown, 1.0 / SLOPE_RATIO, SLOPE_RATIO)
        self.x[now], self.v[now], self.camera[now] = trial[taken], v[taken], evaluated.camera[taken]
        self.halvings[now] = 0
        self.steps[now] += 1
        self.halvings[rows[newton & ~taken & ~crossed & ~done]] += 1

        on = march & ~crossed & ~done
        self.march_x[rows[on]], self.march_v[rows[on]] = trial[on], v[on]
        self._shorten(rows[cut & ~done], trial[cut & ~done], v[cut & ~done])
        self.rows = rows[~done]
        return now

    def _open_bracket(
        self, rows: np.ndarray, from_x: np.ndarray, from_v: np.ndarray, x: np.ndarray, v: np.ndarray
    ) -> None:
        self.phase[rows] = _BRACKET
        side = (v > limits.ISO_LEVEL).astype(np.int64)
        self.ends[rows, side] = x
        self.weights[rows, side] = v - limits.ISO_LEVEL
        self.ends[rows, 1 - side] = from_x[rows]
        self.weights[rows, 1 - side] = from_v[rows] - limits.ISO_LEVEL

    def _shorten(self, rows: np.ndarray, x: np.ndarray, v: np.ndarray) -> None:
        side = (v > limits.ISO_LEVEL).astype(np.int64)
        self.ends[rows, side] = x
        self.weights[rows, side] = v - limits.ISO_LEVEL
        # Illinois rule: halve the weight of an end retained twice, or it would stay for ever.
        again = side == self.last_side[rows]
        self.weights[rows[again], 1 - side[again]] *= 0.5
        self.last_side[rows] = side
