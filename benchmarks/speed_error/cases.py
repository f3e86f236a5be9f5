# SPDX-License-Identifier: GPL-3.0-or-later
"""The runs of the report: presets as they are, meshers on their trainings, and what is trivial."""

from __future__ import annotations

from ..study.case import Case
from .plan import PRESETS

STUDY = "speed"
SCENES = ("wheel", "spot", "fence", "room")
MESHED_PRESETS = ("standard",)
"""Whose trainings every mesher gets: differences between meshers hardly depend on the training
(docs/benchmarks/meshing.md)."""
ALPHA = "alpha"
"""The alpha shape of the sparse points: what is there before anything is trained."""

ADAPTIVE, UNIFORM, TWO, NINE = "adaptive", "uniform", "pivots2", "pivots9"
_CHEAP_TEXTURE = ("--texture-size", "64")
"""The textures of further meshes are not looked at."""
MESHERS = {
    UNIFORM: ("--spacing", "uniform", *_CHEAP_TEXTURE),
    TWO: ("--method", "pivots", "--pivots", "2", "--pivot-samples", "none", *_CHEAP_TEXTURE),
    NINE: ("--method", "pivots", "--pivots", "9", "--pivot-samples", "none", *_CHEAP_TEXTURE),
}
"""Besides the default, which is that of the presets: primal adaptive meshing, adaptive spacing."""

LABELS = {
    ALPHA: "alpha shape of the sparse points",
    ADAPTIVE: "primal adaptive, adaptive spacing (default)",
    UNIFORM: "primal adaptive, uniform spacing",
    TWO: "marching tetrahedra, 2 pivots",
    NINE: "marching tetrahedra, 9 pivots",
}


def preset_case(scene: str, preset: str) -> Case:
    """Return the run of a preset as it is."""
    return Case(STUDY, scene, preset, 0, preset, ())


def mesher_case(scene: str, preset: str, mesher: str) -> Case:
    """Return another mesh of a preset's training."""
    base = preset_case(scene, preset)
    return Case(STUDY, scene, f"{preset}_{mesher}", 0, preset, MESHERS[mesher], base.identity)


def alpha_case(scene: str) -> Case:
    """Return the alpha shape of a scene's sparse points."""
    return Case(STUDY, scene, ALPHA, 0, "", ())


def study_plan() -> list[Case]:
    """Return all runs in the order in which they are made."""
    cheap = [alpha_case(scene) for scene in SCENES]
    trained = []
    for preset in PRESETS:
        for scene in SCENES:
            trained.append(preset_case(scene, preset))
            if preset in MESHED_PRESETS:
                trained += [mesher_case(scene, preset, mesher) for mesher in MESHERS]
    return [*cheap, *trained]
