# SPDX-License-Identifier: GPL-3.0-or-later
"""The cells of the ablation: multi-view terms times orientation and clones, everything else fixed.

Clones of opposite orientation flip what orientation has found; without orientation there is nothing
to flip. So the second factor has three levels, and there are six cells, not eight.
"""

from __future__ import annotations

import dataclasses

from ..study.case import Case

STUDY = "ablation"
SCENES = ("wheel", "spot", "fence", "cup", "room")
SEEDS = (0, 1, 2)
PRESET = "draft"

FIXED = (
    "--iterations", "1000", "--max-gaussians", "20000", "--max-image-px", "640", "--holdout", "0",
    "--harmonics", "off", "--exposure", "off", "--growth", "on", "--full-size", "on",
    "--spacing", "uniform", "--points", "12000", "--texture-size", "64", "--dense-start", "off",
)  # fmt: skip
"""What no cell varies. The paper starts from sparse points. Records made before there was another
start name `--dense-start off`, too."""

OFF, ON = "off", "on"
PLAIN, ORIENTED, CLONES = "plain", "oriented", "clones"

MULTI_VIEW = {OFF: ("--multi-view", "off"), ON: ("--multi-view", "on")}
WRAPPING = {
    PLAIN: ("--wrapping", "off", "--wrap-rounds", "0"),
    ORIENTED: ("--wrapping", "on", "--wrap-rounds", "0"),
    CLONES: ("--wrapping", "on", "--wrap-rounds", "2"),
}
"""Growth leaves room below the cap for the clones of ``--wrap-rounds``. So the number is given in
every cell: all of them may end with as many Gaussians."""

LABELS = {
    PLAIN: "no orientation",
    ORIENTED: "orientation loss",
    CLONES: "orientation and clones",
}


@dataclasses.dataclass(frozen=True)
class Cell:
    """One combination of the two factors."""

    multi_view: str
    wrapping: str

    @property
    def name(self) -> str:
        """In identities."""
        return f"{'views' if self.multi_view == ON else 'alone'}_{self.wrapping}"

    @property
    def label(self) -> str:
        """Words for tables."""
        return LABELS[self.wrapping]

    @property
    def varied(self) -> tuple[str, ...]:
        """The arguments that make the cell."""
        return (*MULTI_VIEW[self.multi_view], *WRAPPING[self.wrapping])

    def case(self, scene: str, seed: int) -> Case:
        """Return the run of this cell on a scene."""
        return Case(STUDY, scene, self.name, seed, PRESET, (*FIXED, *self.varied))


CELLS = tuple(Cell(views, level) for views in MULTI_VIEW for level in WRAPPING)


def plan() -> list[Case]:
    """Return all runs in the order in which they are made: each seed is a whole factorial."""
    return [cell.case(scene, seed) for seed in SEEDS for scene in SCENES for cell in CELLS]
