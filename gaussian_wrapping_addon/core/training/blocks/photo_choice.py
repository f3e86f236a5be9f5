# SPDX-License-Identifier: GPL-3.0-or-later
"""What photos show of the coarse Gaussians, and which of them a block needs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ...dataset.photo_source import PhotoSource
from ...gaussians.model import OrientedGaussians
from ...progress import Progress
from ...render.projection.projection import RawArrays
from ...render.types.options import RenderOptions
from ...render.types.renderer import Renderer
from ..live_view import divisor_for

LONGEST_PX = 144
"""Long side of the views that are rendered: shares of an image need no detail."""


class Visibility:
    """Renders what each photo shows of some Gaussians, small.

    Parameters
    ----------
    gaussians : OrientedGaussians
    photos : PhotoSource
    views : sequence of int
    renderer : Renderer
        Overwrites its last view.
    threads : int
    """

    def __init__(
        self,
        gaussians: OrientedGaussians,
        photos: PhotoSource,
        views: Sequence[int],
        renderer: Renderer,
        threads: int,
    ) -> None:
        self._raw, self._photos, self._views = RawArrays.from_gaussians(gaussians), photos, views
        self._renderer = renderer
        self._options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)

    def weights(self, progress: Progress, doing: str) -> Iterator[np.ndarray]:
        """Yield, view by view, the share of the image that each Gaussian fills, (n,) float64.

        Raises
        ------
        Cancelled
            Before the next view.
        """
        for number, view in enumerate(self._views):
            progress.update(number / len(self._views), f"{doing}, photo {number + 1}")
            camera = self._photos.camera(view, divisor_for(self._photos, view, LONGEST_PX))
            found = self._renderer.render(self._raw, camera, self._options).statistics
            assert found is not None
            yield found.weight_sum.astype(np.float64) / (camera.width * camera.height)


def chosen_photos(shown: np.ndarray, coverage: float) -> np.ndarray:
    """Choose the photos of each block: the fewest that together show most of what it trains.

    A photo that no block would choose belongs to that of which it shows most.

    Parameters
    ----------
    shown : (photos, blocks) float64
        Weight of each block's cell and margin in each photo, at least 0.
    coverage : float
        Share of a block's weights over all photos that the chosen ones hold at least.

    Returns
    -------
    (photos, blocks) bool
    """
    chosen = np.zeros(shown.shape, np.bool_)
    for block, weights in enumerate(shown.T):
        order = np.argsort(-weights, kind="stable")
        before = np.cumsum(weights[order]) - weights[order]  # held by those that show more
        needed = (before < coverage * weights.sum()) & (weights[order] > 0.0)
        chosen[order[needed], block] = True
    left = ~chosen.any(1)
    chosen[left, np.argmax(shown[left], axis=1)] = True
    return chosen
