# SPDX-License-Identifier: GPL-3.0-or-later
"""One measured run with its scores, and how to read figures out of them."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .plan import Run, Variant


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run measured of itself, and how it was judged."""

    run: Run
    variant: Variant | None
    measured: dict[str, Any]
    scores: dict[str, Any]

    @property
    def report(self) -> dict[str, Any]:
        """The job's own report."""
        return dict(self.measured["report"])

    @property
    def region(self) -> dict[str, Any]:
        """The figures of the region in the job's own report."""
        return dict(self.report["regions"][self.measured["region"]])

    def seconds(self, stage: str) -> float:
        """Return the seconds of the stage whose name begins so, as the job measured them."""
        return math.fsum(
            entry["seconds"] for entry in self.report["stages"] if entry["name"].startswith(stage)
        )

    def processor_s(self, stage: str) -> float:
        """Return the seconds of all cores that the stage's process computed; NaN if unknown.

        Unlike time on the clock it hardly depends on what else the machine does.
        """
        found = [
            entry.get("processor_seconds")
            for entry in self.report["stages"]
            if entry["name"].startswith(stage)
        ]
        return math.fsum(found) if found and None not in found else math.nan

    @property
    def wall_s(self) -> float:
        """Time on the clock of the whole command."""
        return float(self.measured["wall_s"])

    @property
    def memory_gib(self) -> float:
        """Largest resident size of the worker and its largest helper, GiB; NaN if unknown."""
        peaks = self.report["peak_memory_bytes"]
        return max(peaks.values()) / 2**30 if peaks else math.nan

    def surface(self, protocol: str, name: str) -> Any:
        """Return a figure of the surface scores."""
        return self.scores["surface"][protocol][name]

    def f1(self, protocol: str, index: int) -> float:
        """Return the F1 score at a threshold."""
        return float(self.surface(protocol, "f1")[index])

    @property
    def texture_psnr(self) -> float | None:
        """PSNR of the textured mesh at the test views, dB; ``None`` if none shows the surface."""
        value = self.scores["texture"].get("psnr")
        return None if value is None else float(value)

    def share(self, name: str) -> float | None:
        """Return a distance of the uniform protocol, as a share of the diagonal, if any."""
        value = self.surface("uniform", name)
        return None if value is None else float(value) / float(self.scores["diagonal"])


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Everything that a plan gave; all but the results by scene."""

    folders: dict[str, Path]
    """Ground truth."""
    results: list[Result]
    poses: dict[str, dict[str, Any]]
    """Cameras solved from photos alone, of some scenes; see :mod:`.poses`."""
    ceilings: dict[str, dict[str, Any]]
    """Scores of the true surface itself."""
    kernels: dict[str, dict[str, Any]]
    """The vacancy kernel against its definition; see :mod:`.vacancy_kernel`."""


def mean_and_spread(values: Sequence[float]) -> str:
    """Return ``mean ± standard deviation`` (of the sample), in words for a table."""
    if len(values) < 2:
        return f"{values[0]:.3f}"
    return f"{statistics.fmean(values):.3f} ± {statistics.stdev(values):.3f}"


def pick(results: Sequence[Result], keep: Callable[[Result], bool]) -> list[Result]:
    """Return the results that a condition holds for, in the order of their varied parameter."""

    def parameter(result: Result) -> int:
        return result.variant.parameter if result.variant else result.run.parameter

    return sorted((r for r in results if keep(r)), key=parameter)


def plain(results: Sequence[Result], scene: str = "") -> list[Result]:
    """Return the presets as they are, with seed 0, scene by scene (or of one scene)."""
    scenes = list(dict.fromkeys(r.run.scene for r in results))
    kept = [
        r
        for r in results
        if is_plain(r.run) and r.variant is None and (not scene or r.run.scene == scene)
    ]
    return sorted(kept, key=lambda r: scenes.index(r.run.scene))


def is_plain(run: Run) -> bool:
    """Tell whether a run is a preset as it is, with seed 0."""
    return not run.name and run.seed == 0
