# SPDX-License-Identifier: GPL-3.0-or-later
"""What benchmarks run: photos, jobs through the command line, meshes made from them again."""

from __future__ import annotations

import dataclasses

PRESETS = ("draft", "standard", "fine")
THRESHOLD_SHARES = (0.0025, 0.005, 0.01)
"""Thresholds of precision, recall and F1, as shares of the crop volume's diagonal."""


@dataclasses.dataclass(frozen=True)
class Photos:
    """How a scene is photographed."""

    count: int
    width: int
    height: int


@dataclasses.dataclass(frozen=True)
class Variant:
    """Another mesh or texture from the training of a run."""

    name: str
    arguments: tuple[str, ...]
    parameter: int
    """The value that is varied."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One job through the command line, and the meshes made from its training."""

    scene: str
    preset: str
    seed: int = 0
    name: str = ""
    """What is varied, empty for the plain preset."""
    arguments: tuple[str, ...] = ()
    parameter: int = 0
    variants: tuple[Variant, ...] = ()

    @property
    def identity(self) -> str:
        """Folder name."""
        parts = [self.scene, self.preset, f"seed{self.seed}"]
        if self.name:
            parts.append(f"{self.name}{self.parameter}")
        return "-".join(parts)
