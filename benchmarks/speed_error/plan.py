# SPDX-License-Identifier: GPL-3.0-or-later
"""What the report measures: scenes, presets, seeds, and what is varied."""

from __future__ import annotations

import dataclasses

MAIN_SCENES = ("spot", "wheel", "room", "glossy")
OTHER_SCENES = ("cup", "fence", "spot_exposure", "spot_far")
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


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that is measured."""

    photos: Photos
    runs: tuple[Run, ...]
    pose_scenes: tuple[str, ...]


def _meshes(points: tuple[int, ...]) -> tuple[Variant, ...]:
    return tuple(Variant("points", ("--points", str(n)), n) for n in points)


def _textures(sides: tuple[int, ...]) -> tuple[Variant, ...]:
    return tuple(Variant("texture", ("--texture-size", str(n)), n) for n in sides)


def _counts(scene: str, counts: tuple[int, ...]) -> list[Run]:
    return [Run(scene, "draft", 0, "gaussians", ("--max-gaussians", str(n)), n) for n in counts]


def _sizes(scene: str, sides: tuple[int, ...]) -> list[Run]:
    return [Run(scene, "draft", 0, "image", ("--max-image-px", str(n)), n) for n in sides]


def full_plan() -> Plan:
    """Return the plan of the committed report.

    The photos are small so that three presets of four scenes fit into an hour and a half on two
    cores; a preset's own image size is larger and takes no part.
    """
    drafts = [
        Run(
            scene,
            "draft",
            variants=(*_meshes((1500, 6000, 96_000)), *_textures((256, 512, 2048, 4096)))
            if scene == "spot"
            else _meshes((1500, 6000, 96_000))
            if scene == "wheel"
            else (),
        )
        for scene in MAIN_SCENES
    ]
    higher = [Run(scene, preset) for preset in PRESETS[1:] for scene in MAIN_SCENES]
    others = [Run(scene, "draft") for scene in OTHER_SCENES]
    seeds = [Run(scene, "draft", seed) for scene in ("spot", "wheel") for seed in (1, 2)]
    varied = [*_counts("spot", (5000, 15_000)), *_sizes("spot", (96, 144))]
    runs = (*drafts, *higher, *seeds, *others, *varied)
    return Plan(Photos(40, 288, 216), runs, ("spot", "room"))


def quick_plan() -> Plan:
    """Return a plan that takes minutes: Draft alone, fewer and smaller photos."""
    drafts = [
        Run(
            scene,
            "draft",
            variants=(*_meshes((2000,)), *_textures((256,))) if scene == "spot" else (),
        )
        for scene in MAIN_SCENES
    ]
    runs = (
        *drafts,
        *(Run("spot", "draft", seed) for seed in (1, 2)),
        *_counts("spot", (10_000,)),
        *_sizes("spot", (96,)),
    )
    return Plan(Photos(24, 192, 144), runs, ("spot",))
