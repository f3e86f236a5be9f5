# SPDX-License-Identifier: GPL-3.0-or-later
"""What one process measures of the kernels on one workload."""

from __future__ import annotations

import dataclasses

from .timing import Timing

FORWARD, ISOSURFACE = "forward", "forward + isosurface"
BACKWARD, BACKWARD_DEPTH = "backward", "backward + isosurface"
PROJECTION, PREPARED = "projection forward", "projection, binning, masks"
PROJECTION_BACKWARD = "projection backward"
ITERATION = "whole iteration"


@dataclasses.dataclass(frozen=True)
class Workload:
    """One scene of the workload and one image size."""

    count: int
    width: int
    height: int
    seed: int = 0

    @property
    def name(self) -> str:
        """Short name for tables."""
        count = f"{self.count // 1000}k" if self.count < 1_000_000 else f"{self.count / 1e6:g}M"
        return f"{count if self.count >= 1000 else self.count}, {self.width}x{self.height}"


@dataclasses.dataclass(frozen=True)
class Result:
    """What one process measured on one workload."""

    workload: Workload
    lanes: int
    """What the renderer would choose here."""
    one: dict[str, dict[str, Timing]]
    """One thread; by variant and part."""
    several: dict[str, dict[str, Timing]]
    """``threads`` threads; empty for one."""
    threads: int
    evaluations: dict[str, int]
    own: dict[str, int]
    """Evaluations of the kernels' variants, from their own masks."""
    peak: float
    """Measured multiply-add peak of one core, flops per second."""
    agreement: dict[str, tuple[float, float]]
    """By yardstick: largest difference of the images, L2-relative difference of the gradients."""

    def clang(self) -> str | None:
        """Return the name of the yardstick that ratios refer to; None without a compiler."""
        return next((name for name in self.one if name.startswith("C++ clang")), None)

    def own_evaluations(self, variant: str) -> int:
        """Return the pixel evaluations of one forward pass of a variant."""
        if variant in self.own:
            return self.own[variant]
        return self.evaluations["rows_16" if self.lanes == 16 else "halves_8"]

    def to_json(self) -> dict:
        """Return plain values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict) -> Result:
        """Read what :meth:`to_json` returned."""

        def timings(tables: dict) -> dict[str, dict[str, Timing]]:
            return {
                variant: {part: Timing(**timing) for part, timing in parts.items()}
                for variant, parts in tables.items()
            }

        return cls(
            Workload(**values["workload"]),
            values["lanes"],
            timings(values["one"]),
            timings(values["several"]),
            values["threads"],
            values["evaluations"],
            values["own"],
            values["peak"],
            {name: tuple(pair) for name, pair in values["agreement"].items()},
        )


def kernel_name(lanes: int) -> str:
    """Return the name of the kernels' variant with runs of ``lanes`` pixels."""
    return f"kernels, {lanes} lanes"
