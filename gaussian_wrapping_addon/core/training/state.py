# SPDX-License-Identifier: GPL-3.0-or-later
"""Training state: everything that the next iteration depends on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from ..gaussians.model import TRAINED, OrientedGaussians
from ..report_warning import ReportWarning, read_warnings
from .appearance.photo_exposure import Exposure
from .density.density_control import DensityStatistics
from .optimizer.adam import Adam
from .poses.camera_poses import CameraPoses
from .selection.growth_selection import ErrorHistory
from .selection.model_selection import ModelSelection

_MOMENTS = ("first", "second")
_STATISTICS = ("gradient", "gradient_abs", "views")


@dataclass(frozen=True)
class Snapshot:
    """A copy of a state to go back to, of which the large part stays where the training runs."""

    adam: Adam
    arrays: dict[str, np.ndarray]
    values: dict[str, Any]


@dataclass
class TrainingState:
    """Parameters, moments, statistics, random generator and view order of a run."""

    adam: Adam
    statistics: DensityStatistics
    random: np.random.Generator
    iteration: int = 0
    """Number of finished iterations."""
    order: list[int] = field(default_factory=list)
    """Views still to come in this epoch, last first."""
    rate_factor: float = 1.0
    """Factor of the learning rates, lowered after a restart from non-finite values."""
    restarts: int = 0
    error_average: float = 0.0
    """Moving average of the mean squared colour error, for the progress message."""
    loss_average: float = 0.0
    degree: int = 0
    """Degree of the harmonics in use."""
    model_selection: ModelSelection = field(default_factory=ModelSelection)
    """Decisions so far; stored under the key ``needs``."""
    exposure: Exposure | None = None
    """Per-photo exposures; ``None`` where they are not modelled."""
    poses: CameraPoses | None = None
    """Refined poses of the cameras; ``None`` where they stay as given."""
    error_history: ErrorHistory = field(default_factory=ErrorHistory)
    """Per-view errors from which growth is decided; stored under the prefix ``visits.``."""
    warnings: list[ReportWarning] = field(default_factory=list)
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0
    """Training time up to the last checkpoint."""

    @classmethod
    def start(cls, gaussians: OrientedGaussians, seed: int) -> TrainingState:
        """Return the state before the first iteration."""
        random = np.random.Generator(np.random.PCG64([seed, 2]))
        return cls(Adam(gaussians), DensityStatistics.zeros(len(gaussians)), random)

    def next_view(self, views: list[int]) -> int:
        """Draw the next view: all views in random order, epoch by epoch.

        See docs/method.md, section 1.4.
        """
        if not self.order:
            self.order = self.random.permutation(views).tolist()
        return self.order.pop()

    def clear_statistics(self) -> None:
        """Reset the statistics, as after a change in the number of Gaussians."""
        self.statistics = self.statistics.cleared(len(self.adam))

    def snapshot(self) -> Snapshot:
        """Return a copy of everything that the next iteration depends on."""
        return Snapshot(self.adam.copy(), self._other_arrays(), self.to_json())

    @classmethod
    def of_snapshot(cls, snapshot: Snapshot) -> TrainingState:
        """Return the state of a snapshot, which can be used again."""
        return cls._of(snapshot.adam.copy(), snapshot.arrays, snapshot.values)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays, by name."""
        adam, arrays = self.adam.on_host(), {}
        for name in adam.values:
            arrays[f"value.{name}"] = adam.array(name).copy()
        for name in TRAINED:
            for kind, moment in zip(_MOMENTS, adam.moments(name), strict=True):
                arrays[f"{kind}.{name}"] = moment.copy()
        arrays["steps"] = adam.steps.copy()
        return arrays | self._other_arrays()

    def _other_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays that are not the optimiser's."""
        arrays = {}
        for name in _STATISTICS:
            arrays[f"statistics.{name}"] = getattr(self.statistics, name).copy()
        if self.exposure is not None:
            arrays |= {f"exposure.{k}": v for k, v in self.exposure.to_arrays().items()}
        if self.poses is not None:
            arrays |= {f"poses.{k}": v for k, v in self.poses.to_arrays().items()}
        return arrays | {f"visits.{k}": v for k, v in self.error_history.to_arrays().items()}

    def to_json(self) -> dict[str, Any]:
        """Return the rest of the state as plain JSON values."""
        values: dict[str, Any] = {
            "random": self.random.bit_generator.state,
            "iteration": self.iteration,
            "order": list(self.order),
            "rate_factor": self.rate_factor,
            "restarts": self.restarts,
            "error_average": self.error_average,
            "loss_average": self.loss_average,
            "history": [dict(entry) for entry in self.history],
            "seconds": self.seconds,
            "degree": self.degree,
            "needs": self.model_selection.to_json(),
            "warnings": [warning.to_json() for warning in self.warnings],
        }
        if self.adam.frozen:
            values["frozen"] = self.adam.frozen
        return values

    @classmethod
    def restore(cls, arrays: dict[str, np.ndarray], values: dict[str, Any]) -> TrainingState:
        """Build from :meth:`to_arrays` and :meth:`to_json`; the arrays are copied.

        Raises
        ------
        KeyError, ValueError, TypeError
            An entry is missing, or entries are inconsistent.
        """
        tensors = {
            name.removeprefix("value."): torch.from_numpy(array.copy())
            for name, array in arrays.items()
            if name.startswith("value.")
        }
        count = len(arrays["steps"])
        adam = Adam(OrientedGaussians(**tensors))
        for name in adam.values:
            _require(adam.array(name), arrays[f"value.{name}"], count)
        for name in TRAINED:
            for kind, moment in zip(_MOMENTS, adam.moments(name), strict=True):
                moment[...] = _require(moment, arrays[f"{kind}.{name}"], count)
        adam.steps = _require(adam.steps, arrays["steps"], count).copy()
        return cls._of(adam, arrays, values)

    @classmethod
    def _of(
        cls, adam: Adam, arrays: dict[str, np.ndarray], values: dict[str, Any]
    ) -> TrainingState:
        """Return the state of an optimiser, other arrays, which are copied, and JSON values."""
        count = len(adam)
        adam.frozen = int(values.get("frozen", 0))
        if not 0 <= adam.frozen <= count:
            raise ValueError(f"{adam.frozen} of {count} Gaussians are frozen")
        statistics = DensityStatistics.zeros(count)
        for name in _STATISTICS:
            old = getattr(statistics, name)
            setattr(statistics, name, _require(old, arrays[f"statistics.{name}"], count).copy())
        state = cls(adam, statistics, np.random.Generator(np.random.PCG64()))
        generator = np.random.PCG64()
        generator.state = values["random"]
        state.random = np.random.Generator(generator)
        state.iteration = int(values["iteration"])
        state.order = [int(i) for i in values["order"]]
        state.rate_factor = float(values["rate_factor"])
        state.restarts = int(values["restarts"])
        state.error_average = float(values["error_average"])
        state.loss_average = float(values["loss_average"])
        state.history = [{k: float(v) for k, v in entry.items()} for entry in values["history"]]
        state.seconds = float(values["seconds"])
        state.degree = int(values["degree"])
        state.model_selection = ModelSelection.from_json(values["needs"])
        state.warnings = list(read_warnings(values["warnings"]))
        exposure = _part(arrays, "exposure.")
        state.exposure = Exposure.restore(exposure) if exposure else None
        poses = _part(arrays, "poses.")
        state.poses = CameraPoses.restore(poses) if poses else None
        state.error_history = ErrorHistory.restore(_part(arrays, "visits."))
        return state


def _part(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names have a prefix, with the prefix removed."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _require(like: np.ndarray, array: np.ndarray, count: int) -> np.ndarray:
    if array.shape != like.shape or array.dtype != like.dtype or len(array) != count:
        raise ValueError(f"an array is {array.dtype} {array.shape}, not {like.dtype} {like.shape}")
    return array
