# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering without autograd: images in reused memory, gradients of the seen Gaussians only."""

from __future__ import annotations

import numpy as np

from ..dataset.camera import Camera
from ..errors import UsageError
from .array_store import ArrayStore
from .blend import Images, RenderBuffers, ScreenView, blend, blend_backward
from .projection import RawArrays, RawGradients, project_backward
from .types import ImageGradients, RenderOptions, RenderStatistics, VisibleGradients


class ViewPass:
    """One rendered view. Its arrays are valid until its renderer renders again.

    Attributes
    ----------
    color, normal, geometric_normal : (h, w, 3) float32
    alpha, depth : (h, w) float32
        The images of :class:`Render`. They must not be written to before :meth:`backward`.
    statistics : RenderStatistics or None
        With ``options.statistics`` or ``options.screen_gradients``; ``grad_px`` and
        ``grad_abs_px`` are filled by :meth:`backward`.
    """

    def __init__(
        self,
        store: ArrayStore,
        buffers: RenderBuffers,
        view: ScreenView,
        images: Images,
        statistics: RenderStatistics | None,
    ) -> None:
        self._store, self._buffers, self._view, self._images = store, buffers, view, images
        self.color, self.normal, self.geometric_normal = (
            images.color,
            images.normal,
            images.geometric,
        )
        self.alpha, self.depth = images.alpha, images.depth
        self.statistics = statistics

    def backward(self, grads: ImageGradients) -> VisibleGradients:
        """Return the gradient with respect to the raw parameters of the seen Gaussians.

        Parameters
        ----------
        grads : ImageGradients
            C-contiguous float32 arrays of the images' shapes.

        Returns
        -------
        VisibleGradients
            Rows for every Gaussian that reaches a tile of the image, valid until the renderer is
            used again.

        Raises
        ------
        UsageError
            If the shape of a gradient is not that of its image.
        """
        view = self._view
        incoming = self._incoming(grads)
        grad_params, grad_px, grad_abs_px = blend_backward(
            view, self._images, incoming, self._buffers, absolute=self.statistics is not None
        )
        if self.statistics is not None:
            self.statistics.grad_px[:] = grad_px
            self.statistics.grad_abs_px[:] = grad_abs_px
        raw = RawGradients.zeros(view.gaussians)
        project_backward(view.gaussians, view.camera, view.options, view.screen, grad_params, raw)
        ids = np.nonzero(np.diff(view.lists.pair_offsets) > 0)[0].astype(np.int32)
        return VisibleGradients(
            ids,
            raw.means[ids],
            raw.log_scales[ids],
            raw.quats[ids],
            raw.opacity_logits[ids],
            raw.sh[ids],
            raw.orientation[ids],
        )

    def _incoming(self, grads: ImageGradients) -> list[np.ndarray]:
        """Return the five gradients, zeros where there is none."""
        incoming = []
        for name in ("color", "normal", "geometric_normal", "alpha", "depth"):
            image, grad = getattr(self, name), getattr(grads, name)
            if grad is None:
                grad = self._store.zeros(f"zero {image.ndim}", image.shape, np.float32)
            elif grad.shape != image.shape:
                raise UsageError(
                    f"The gradient of {name} is {grad.shape}, the image {image.shape}.",
                    "Give one value per value of the image.",
                )
            incoming.append(np.ascontiguousarray(grad, np.float32))
        return incoming


class ViewRenderer:
    """Renders one view after the other in the same memory; for one thread at a time."""

    def __init__(self) -> None:
        self._store = ArrayStore()
        self._buffers = RenderBuffers()

    def render(
        self, gaussians: RawArrays, camera: Camera, options: RenderOptions | None = None
    ) -> ViewPass:
        """Render like :func:`~.render.render`, without autograd.

        The parameters must stay as they are until :meth:`ViewPass.backward` has run. What the
        previous call returned is overwritten.

        Raises
        ------
        ResourceError
            If the tile lists or the contributor lists grow beyond what can be addressed.
        """
        from .render import _empty_statistics, _fill_statistics, project_view

        options = options or RenderOptions()
        view = project_view(gaussians, camera, options)
        images = Images.allocate(camera, options)
        pair_weights = blend(view, images, self._buffers)
        statistics = _empty_statistics(len(gaussians)) if options.gathers_statistics else None
        if statistics is not None:
            _fill_statistics(statistics, view, images, pair_weights)
        return ViewPass(self._store, self._buffers, view, images, statistics)
