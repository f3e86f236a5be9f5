# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of one atlas: from photos, or from photos rendered of the Gaussians."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ..gaussians.model import OrientedGaussians
from ..render.render import render
from ..render.types import RenderOptions
from ..scene.camera import Camera
from ..scene.scene import PhotoSource
from .bake import AtlasPoints, BakedColors, blocks_of
from .fill import (
    BLEND_TEXELS,
    HarmonicFill,
    dilate,
    fill_background,
    fill_gutters,
    surface_positions,
)
from .photo_samples import SurfaceArrays

# -- Renderings of the Gaussians as a replacement for photos in baking, rendered on demand --------


MIN_ALPHA = 0.5
"""Below this opacity there is no surface to take a colour from."""


class GaussianPhotos:
    """Diffuse colour of Gaussians from the cameras of photos (docs/method.md, section 8.4).

    Only harmonics of degree 0: highlights and other view-dependent effects are left out, and so are
    objects in single photos. The detail is that of the Gaussians. Only the last rendering is
    cached.

    The Gaussians are in the scene frame; cameras and masks are those of ``photos``. The result does
    not depend on the number of threads.
    """

    def __init__(self, gaussians: OrientedGaussians, photos: PhotoSource, *, threads: int) -> None:
        self._gaussians, self._photos = gaussians, photos
        self._options = RenderOptions(depth=False, sh_degree=0, threads=threads)
        self._last_key = (-1, 0)
        self._last: tuple[np.ndarray, np.ndarray] = (np.empty(0), np.empty(0))

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera of a photo at a level."""
        return self._photos.camera(index, divisor)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return the (h, w, 3) uint8 rendering at a level, opaque where not masked."""
        return self._rendered(index, divisor)[0]

    def mask(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w) bool: inside the photo's mask and covered by the Gaussians."""
        covered = self._rendered(index, divisor)[1]
        mask = self._photos.mask(index, divisor)
        return covered if mask is None else covered & mask

    def _rendered(self, index: int, divisor: int) -> tuple[np.ndarray, np.ndarray]:
        if self._last_key != (index, divisor):
            camera = self._photos.camera(index, divisor)
            with torch.no_grad():
                image = render(self._gaussians, camera, self._options)
            alpha = image.alpha.numpy().reshape(camera.height, camera.width, 1)
            color = image.color.numpy() / np.maximum(alpha, MIN_ALPHA)
            pixels = np.rint(255.0 * color.clip(0.0, 1.0)).astype(np.uint8)
            self._last_key = (index, divisor)
            self._last = pixels, alpha[..., 0] >= MIN_ALPHA
        return self._last


# -- Image of one atlas: baked colours, fill of unseen texels, gutters and background -------------
#
# An atlas is completed in two steps, because unseen texels are filled from the seen texels of all
# atlases: :class:`AtlasColors` holds the baked colours and little else; ``finish`` does the rest.


MAX_FILL_SOURCES = 1_000_000
"""Maximum number of seen texels used as sources of the harmonic fill."""
SILHOUETTE_TEXELS = 8
"""Texels seen only at silhouettes take their neighbours' colours within this distance."""
UNRELIABLE_LEVELS = 15.0
"""Colours of grazing or partly occluded views are used if they are this close to their
surroundings, and not at all at twice this: on trained meshes, such views often show an occluder."""


class AtlasColors:
    """Colours of one atlas, before the fill of unseen texels is known.

    At most ``known_points`` of the seen texels are kept as sources of the fill.
    """

    def __init__(
        self, atlas: AtlasPoints, baked: BakedColors, known_points: int, surface: SurfaceArrays
    ) -> None:
        texels, seen = atlas.texels, baked.reliable
        size_px = len(atlas.chart)
        self.image = np.zeros((size_px, size_px, 3), np.uint8)
        pixels = self.image.reshape(-1, 3)
        ring = np.full((size_px, size_px), -1, np.int16)
        flat_ring = ring.reshape(-1)
        # Seen only at silhouettes: use the cleaner colours of neighbours, if there are any.
        for rows in blocks_of(len(texels)):
            pixels[texels[rows]] = baked.colors[rows]
            flat_ring[texels[rows][seen[rows] & baked.clear[rows]]] = 0
        dilate(self.image, ring, atlas.chart, SILHOUETTE_TEXELS, inside=True)
        trusted = seen.copy()
        for rows in blocks_of(len(texels)):
            trusted[rows] &= flat_ring[texels[rows]] >= 0
            flat_ring[texels[rows]] = np.where(seen[rows], 0, -1)
        known = np.flatnonzero(trusted if trusted.any() else seen)
        known = known[:: max(1, len(known) // known_points)]
        if not seen.all():
            dilate(self.image, ring, atlas.chart, BLEND_TEXELS, inside=True)
        self.known = surface_positions(atlas.points.part(known), surface)
        """(n, 3) float64 positions of seen texels."""
        self.known_colors = pixels[texels[known]]
        """(n, 3) uint8 colours of these texels."""
        unseen = np.flatnonzero(~seen)
        self._unseen = texels[unseen]
        self._unseen_points = atlas.points.part(unseen)
        self._unseen_ring = flat_ring[self._unseen]
        unreliable = np.flatnonzero((baked.views > 0) & ~seen)
        self._unreliable, self._unreliable_colors = texels[unreliable], baked.colors[unreliable]
        self._unreliable_ring = flat_ring[self._unreliable]
        self._owned = atlas.chart >= 0

    def unseen(self, surface: SurfaceArrays) -> Iterator[np.ndarray]:
        """Yield (m, 3) float64 positions of unseen texels, in blocks."""
        for rows in blocks_of(len(self._unseen)):
            yield surface_positions(self._unseen_points.part(rows), surface)

    def finish(self, fill: HarmonicFill, surface: SurfaceArrays, gutter_px: int) -> np.ndarray:
        """Fill unseen texels, gutters and background; return the (h, w, 3) uint8 image."""
        pixels = self.image.reshape(-1, 3)
        for rows, positions in zip(blocks_of(len(self._unseen)), self.unseen(surface), strict=True):
            far = fill.at(positions)
            near = pixels[self._unseen[rows]]
            share = _fill_weight(self._unseen_ring[rows])
            pixels[self._unseen[rows]] = np.rint(near + share * (far - near)).astype(np.uint8)
        for rows in blocks_of(len(self._unreliable)):
            around = pixels[self._unreliable[rows]].astype(np.float32)
            shown = self._unreliable_colors[rows]
            off = np.abs(shown - around).max(axis=1, initial=0.0)
            near_enough = (2.0 - off / UNRELIABLE_LEVELS).clip(0.0, 1.0)[:, None]
            # No step at the sure ones.
            share = _fill_weight(self._unreliable_ring[rows]) * near_enough
            mixed = np.rint(around + share * (shown - around))
            pixels[self._unreliable[rows]] = mixed.astype(np.uint8)
        fill_background(self.image, fill_gutters(self.image, self._owned, gutter_px))
        return self.image


def _fill_weight(ring: np.ndarray) -> np.ndarray:
    """Return (n, 1) float32 weights of the fill, from 0 at seen texels to 1 beyond their rings."""
    number = ring.astype(np.float32)
    share = np.where(number < 0, np.float32(1.0), number / np.float32(BLEND_TEXELS + 1.0))
    return share[:, None]


def fill_harmonically(atlases: list[AtlasColors], surface: SurfaceArrays) -> HarmonicFill:
    """Return the harmonic fill from the seen texels of all atlases."""

    def queries() -> Iterator[np.ndarray]:
        for atlas in atlases:
            yield from atlas.unseen(surface)

    known = np.concatenate([atlas.known for atlas in atlases])
    return HarmonicFill(known, np.concatenate([a.known_colors for a in atlases]), queries)
