# SPDX-License-Identifier: GPL-3.0-or-later
"""Gradients of the definition in float64, tile by tile, for scenes too large for it as a whole."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians
from gaussian_wrapping_addon.core.render.reference.reference import render_reference
from gaussian_wrapping_addon.core.render.types.images import Render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from .exact import TILE, Tiles, as_float64

IMAGES = ("color", "normal", "geometric_normal", "alpha", "depth")

Weights = dict[str, torch.Tensor]
"""Loss gradient of each image; images that are left out have none."""
Gradients = dict[str, torch.Tensor]


def linear_loss(out: Render, weights: Weights) -> torch.Tensor:
    """Return the sum over images of ``weights * image``, in the float type of the render."""
    losses = [(getattr(out, k) * w.to(getattr(out, k))).sum() for k, w in weights.items()]
    return torch.stack(losses).sum()


def crop(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Return the camera of a part of the image; every pixel keeps its ray."""
    return dataclasses.replace(
        camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top
    )


def exact_gradients(
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions,
    losses: Sequence[Weights],
    tiles: Tiles,
) -> list[Gradients]:
    """Return the gradient of each loss with respect to the trained parameters, in float64.

    Parameters
    ----------
    gaussians : OrientedGaussians
        The values are taken as they are.
    camera : Camera
    options : RenderOptions
    losses : sequence of dict
        For each loss, the weights of the images it is the weighted sum of.
    tiles : Tiles
        From :func:`~benchmarks.exact.exact_tiles`; a Gaussian that is not listed contributes to
        no pixel of the tile by definition.
    """
    wide = as_float64(gaussians)
    totals = [{name: torch.zeros_like(getattr(wide, name)) for name in TRAINED} for _ in losses]
    for tile in range(len(tiles.start) - 1):
        ids = torch.from_numpy(np.sort(tiles.of(tile)))
        if len(ids) == 0:
            continue
        top, left = tile // tiles.tiles_x * TILE, tile % tiles.tiles_x * TILE
        width, height = min(TILE, camera.width - left), min(TILE, camera.height - top)
        chosen = wide.select(ids)
        leaf = chosen.replaced(**{n: getattr(chosen, n).requires_grad_() for n in TRAINED})
        out = render_reference(leaf, crop(camera, left, top, width, height), options)
        leaves = [getattr(leaf, name) for name in TRAINED]
        for weights, total in zip(losses, totals, strict=True):
            part = {k: w[top : top + height, left : left + width] for k, w in weights.items()}
            found = torch.autograd.grad(
                linear_loss(out, part), leaves, retain_graph=True, materialize_grads=True
            )
            for name, gradient in zip(TRAINED, found, strict=True):
                total[name].index_add_(0, ids, gradient)
    return totals
