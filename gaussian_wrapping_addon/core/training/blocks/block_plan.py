# SPDX-License-Identifier: GPL-3.0-or-later
"""The plan of a training in blocks: cells, photos of each, what it trains and what stands still."""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...regions.tiling import Tiling
from ..initialisation.handover import Handover
from ..selection.model_selection import ModelSelection
from .coarse_training import CoarseTraining


@dataclass(frozen=True, eq=False)
class Block:
    """One part of a training. Rows are those of the coarse training's Gaussians."""

    views: tuple[int, ...]
    """Training views, in increasing order."""
    trained: np.ndarray
    """(t,) int32 increasing: in the cell or its margin, and shown by these views."""
    still: np.ndarray
    """(s,) int32 increasing: rendered as they are, because these views show them."""
    max_gaussians: int
    """Largest number of those that are trained."""
    pixels: int
    """Of its photos together, which its time is in proportion to."""


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """How a coarse training is continued in blocks."""

    coarse: CoarseTraining
    tiling: Tiling
    """Cells of the blocks, half-open boxes that partition space, scene frame."""
    margins: np.ndarray
    """(blocks, 3) float64: how far outside of its cell a block trains, scene units."""
    blocks: tuple[Block, ...]
    views: tuple[int, ...]
    """All training views."""
    begin: float
    """Share of the schedule at which blocks begin."""
    full_size: bool
    """Whether photos are trained on at their full size, not at half of it."""

    def kept(self, index: int) -> np.ndarray:
        """Return the rows in a block's cell that it does not train, (k,) int64 increasing."""
        owner = self.tiling.owner(self.coarse.gaussians.means.double().numpy())
        return np.setdiff1d(np.flatnonzero(owner == index), self.blocks[index].trained)

    def near_border(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Tell which of (n, 3) points lie at most so far from another cell than theirs, (n,) bool.

        ``reach`` is in scene units, along each axis.
        """
        cells = sum(
            self.tiling.within(index, points, reach).astype(np.int64)
            for index in range(len(self.blocks))
        )
        return np.asarray(cells > 1)

    @functools.cached_property
    def digest(self) -> str:
        """Hash of all of it."""
        digest = hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode())
        for name, array in sorted(self.to_arrays().items()):
            digest.update(f"{name} {array.dtype} {array.shape} ".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def handover(self, part: str, **further: Any) -> Handover:
        """Return a handover of what all parts take over alike.

        Parameters
        ----------
        part : str
            Names the part among those of the plan.
        **further
            The other fields of :class:`~..initialisation.handover.Handover`.
        """
        # Growth ended, or did not, at the size of the coarse photos: each block decides that anew.
        lasting = tuple(d for d in self.coarse.model_selection if d.name != "growth")
        return Handover(
            degree=self.coarse.gaussians.sh_degree,
            model_selection=ModelSelection(lasting),
            exposure=self.coarse.exposure,
            filter_views=self.views,
            digest=f"{self.digest} {part}",
            **further,
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values of all but the arrays."""
        return {
            "splits": self.tiling.to_json(),
            "views": list(self.views),
            "begin": self.begin,
            "full_size": self.full_size,
            "key": self.coarse.key,
            "decisions": self.coarse.model_selection.to_json(),
            "blocks": [
                {
                    "views": list(block.views),
                    "max_gaussians": block.max_gaussians,
                    "pixels": block.pixels,
                }
                for block in self.blocks
            ],
        }

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays, by name."""
        coarse = self.coarse
        arrays = {f"gaussians.{n}": t.detach().numpy() for n, t in coarse.gaussians.tensors()}
        arrays["margins"] = self.margins
        if coarse.exposure is not None:
            arrays |= {f"exposure.{n}": array for n, array in coarse.exposure.to_arrays().items()}
        if coarse.poses is not None:
            arrays["poses"] = coarse.poses
        for index, block in enumerate(self.blocks):
            arrays |= {f"trained.{index}": block.trained, f"still.{index}": block.still}
        return arrays
