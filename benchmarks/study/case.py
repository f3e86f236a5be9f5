# SPDX-License-Identifier: GPL-3.0-or-later
"""One run of a study: what is given to the command line, and nothing that it measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from gaussian_wrapping_addon.core.errors import UsageError

from ..speed_error.plan import Photos

PHOTOS = Photos(40, 640, 480)
"""Of every rendered scene of the studies."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A job through the command line, or another mesh of the training of one."""

    study: str
    """Folder of its record."""
    scene: str
    name: str
    """Cell of the ablation, preset, or mesher."""
    seed: int
    preset: str
    arguments: tuple[str, ...]
    """Of the command line, besides input, folder, preset, seed, region and threads."""
    base: str = ""
    """Identity of the case whose training is meshed again; empty: a job of its own."""
    photos: Photos = PHOTOS

    @property
    def identity(self) -> str:
        """Name of the record and of the folder of the run."""
        return f"{self.scene}-{self.name}-seed{self.seed}"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> Case:
        """Return what :meth:`to_json` wrote."""
        known = {**values, "arguments": tuple(values["arguments"])}
        return Case(**{**known, "photos": Photos(**values["photos"])})


def options(arguments: tuple[str, ...]) -> dict[str, str]:
    """Return the values of a command line by their options.

    Every option of the studies takes one value.
    """
    if len(arguments) % 2 or any(not word.startswith("--") for word in arguments[::2]):
        raise ValueError(f"{arguments} are not pairs of option and value")
    return dict(zip(arguments[::2], arguments[1::2], strict=True))


def named(cases: Sequence[Case], words: Sequence[str]) -> list[Case]:
    """Return the cases of the scenes, names and seeds (``seed1``) that are named.

    Words of one kind are alternatives; of a kind that none names, all count.

    Raises
    ------
    UsageError
        A word names nothing.
    """
    kinds = [
        {word: {c.identity for c in cases if of(c) == word} for word in map(of, cases)}
        for of in (lambda c: c.scene, lambda c: c.name, lambda c: f"seed{c.seed}")
    ]
    known = set().union(*kinds)
    if unknown := sorted(set(words) - known):
        raise UsageError(f"Nothing is called {', '.join(unknown)}.", f"Use {sorted(known)}.")
    kept = {c.identity for c in cases}
    for kind in kinds:
        if set(words) & set(kind):
            kept &= set().union(*(kind[word] for word in words if word in kind))
    return [c for c in cases if c.identity in kept]
