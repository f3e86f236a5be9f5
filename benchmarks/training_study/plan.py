# SPDX-License-Identifier: GPL-3.0-or-later
"""What the training study measures: rows of the ablation, presets, needs, real photos."""

from __future__ import annotations

import dataclasses

from ..speed_error.plan import PRESETS, Photos, Run

ABLATION, PRESET, NEEDS, REAL = "ablation", "presets", "needs", "real"

_FIXED = ("--harmonics", "off", "--exposure", "off")
"""What no row of the ablation varies."""

BASELINE, MULTI_VIEW, ORIENTATION, WRAPPING = "baseline", "multi-view", "orientation", "wrapping"
AUTO, ON = "", "on"
WITH, WITHOUT = "wrapping-on", "wrapping-off"

ROWS = {
    BASELINE: (*_FIXED, "--multi-view", "off", "--wrapping", "off"),
    MULTI_VIEW: (*_FIXED, "--multi-view", "on", "--wrapping", "off"),
    ORIENTATION: (*_FIXED, "--multi-view", "on", "--wrapping", "on", "--wrap-rounds", "0"),
    WRAPPING: (*_FIXED, "--multi-view", "on", "--wrapping", "on"),
}
"""Of the ablation, each with all that stands above it."""

LABELS = {
    BASELINE: "colour, depth-normal",
    MULTI_VIEW: "+ multi-view",
    ORIENTATION: "+ orientation (L_N)",
    WRAPPING: "+ wrapping rounds",
    AUTO: "needs decide",
    ON: "everything on",
    WITH: "wrapping on",
    WITHOUT: "wrapping off",
}

EVERYTHING_ON = tuple(
    word
    for name in ("multi-view", "wrapping", "harmonics", "exposure", "growth", "full-size")
    for word in (f"--{name}", "on")
)

REAL_SETS = ("fox", "flowerpot")
ABLATION_SCENES = ("wheel", "spot", "fence", "cup_inside")
NEEDS_SCENES = ("spot", "glossy")


@dataclasses.dataclass(frozen=True)
class Case:
    """One run and the parts of the report that show it."""

    parts: tuple[str, ...]
    run: Run
    photos: Photos | None
    """``None``: real photos, as they are."""

    @property
    def label(self) -> str:
        """Words for tables."""
        return LABELS[self.run.name]

    @property
    def words(self) -> set[str]:
        """What ``--only`` may name."""
        return {*self.parts, self.run.scene, self.run.preset, self.run.name or "auto"}

    @property
    def folder(self) -> str:
        """Name of the folder of runs on photos of this size."""
        if self.photos is None:
            return "real"
        return f"{self.photos.count}x{self.photos.width}x{self.photos.height}"


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that is measured, the most important first: time may not suffice for all."""

    cases: tuple[Case, ...]
    pivot_scenes: tuple[str, ...]
    """Scenes whose full row of the ablation is meshed from two and from nine pivots."""
    minutes: float
    """No run is begun after this; 0: there is no limit."""


def ablation(scene: str, photos: Photos | None, arguments: tuple[str, ...]) -> list[Case]:
    """Return all rows of one scene."""
    parts = (ABLATION,) if photos is not None else (REAL,)
    return [
        Case(parts, Run(scene, "draft", 0, name, (*row, *arguments)), photos)
        for name, row in ROWS.items()
    ]


def decided(
    scene: str, preset: str, photos: Photos | None, *parts: str, arguments: tuple[str, ...] = ()
) -> Case:
    """Return a run that lets the photos decide."""
    return Case(parts, Run(scene, preset, 0, AUTO, arguments), photos)


def everything(
    scene: str, preset: str, photos: Photos | None, *parts: str, arguments: tuple[str, ...] = ()
) -> Case:
    """Return a run with everything on."""
    return Case(parts, Run(scene, preset, 0, ON, (*EVERYTHING_ON, *arguments)), photos)


def full_plan() -> Plan:
    """Return the plan of the committed report: about 40 minutes on two cores.

    The ablation has two thirds of Draft's iterations, on small photos, so that four rows of four
    scenes fit; real photos are trained on at 240 pixels.
    """
    small = Photos(40, 288, 216)
    fewer = ("--iterations", "1000")
    real = ("--iterations", "700", "--max-image-px", "240")
    wheel, spot, fence, cup = (ablation(scene, small, fewer) for scene in ABLATION_SCENES)
    needs = [
        case
        for scene in NEEDS_SCENES
        for case in (
            decided(scene, "draft", small, NEEDS, *((PRESET,) if scene == "spot" else ())),
            everything(scene, "draft", small, NEEDS),
        )
    ]
    higher = [decided("spot", preset, small, PRESET) for preset in PRESETS[1:]]
    fox, pot = (ablation(name, None, real) for name in REAL_SETS)
    room = [
        Case((ABLATION,), Run("room", "draft", 0, name, (*ROWS[name], *fewer)), small)
        for name in (BASELINE, WRAPPING)
    ]
    cases = (*wheel, *needs, *spot, *fence, *fox, *cup, *higher, *pot, *room)
    return Plan(cases, ("spot", "wheel", "fence"), 40.0)


def quick_plan() -> Plan:
    """Return a plan of less than ten minutes: it shows that all works, not how well."""
    small = Photos(24, 192, 144)
    few = ("--iterations", "400", "--max-gaussians", "10000")
    cases = (
        *ablation("wheel", small, few),
        decided("spot", "draft", small, PRESET, NEEDS, arguments=few),
        everything("spot", "draft", small, NEEDS, arguments=few),
        *ablation("spot", small, few),
        *ablation("fox", None, (*few, "--max-image-px", "160")),
    )
    return Plan(cases, ("wheel",), 10.0)
