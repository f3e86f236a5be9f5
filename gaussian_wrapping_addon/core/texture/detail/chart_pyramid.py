# SPDX-License-Identifier: GPL-3.0-or-later
"""Image pyramid of a texture whose averages never mix two charts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...mesh.face_graph import face_graph, uv_charts
from ...mesh.textured_mesh import TexturedMesh
from ..atlas.atlas_raster import raster_atlas

MIN_WEIGHT = 0.25
"""A look-up uses a level if this share of its four texels, by weight, belongs to the chart."""


@dataclass(frozen=True)
class ChartPyramid:
    """Levels of a texture, each of half the side; every texel has the colour of a single chart."""

    face_charts: np.ndarray
    """(f,) int32 chart of each face."""
    colors: list[np.ndarray]
    """(h, w, 3) of each level; the finest uint8, the others float32."""
    charts: list[np.ndarray]
    """(h, w) int32 of each level: the chart of the averaged texels, -1 for none."""

    def sample_level(self, uv: np.ndarray, face: np.ndarray, level: int) -> np.ndarray:
        """Return (n, 3) uint8 colours at UVs.

        Bilinear among texels of the face's chart; if a level has too few of them, as in charts
        narrower than its texels, the next finer one is used. The finest uses all four texels: the
        gutter beyond a chart's border has its colours.

        Parameters
        ----------
        uv : (n, 2) float64
            v upwards.
        face : (n,) int
        level : int
            0 for the texture itself.
        """
        charts = self.face_charts[face]
        result = np.zeros((len(uv), 3), np.uint8)
        left = np.arange(len(uv))
        for number in range(min(level, len(self.colors) - 1), -1, -1):
            color, weight = self._bilinear(uv[left], charts[left], number)
            good = weight >= MIN_WEIGHT if number else np.ones(len(left), np.bool_)
            result[left[good]] = np.rint(color[good])
            left = left[~good]
            if len(left) == 0:
                break
        return result

    def _bilinear(
        self, uv: np.ndarray, charts: np.ndarray, level: int
    ) -> tuple[np.ndarray, np.ndarray]:
        image, owner = self.colors[level], self.charts[level]
        height, width = owner.shape
        # Scale from the finest level: odd sides are rounded up by each halving.
        fine_height, fine_width = self.charts[0].shape
        x = (uv[:, 0] * fine_width / 2**level - 0.5).clip(0.0, width - 1.0)
        y = ((1.0 - uv[:, 1]) * fine_height / 2**level - 0.5).clip(0.0, height - 1.0)
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        across, down = x - column, y - row
        total, color = np.zeros(len(uv)), np.zeros((len(uv), 3))
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            at = np.minimum(row + dy, height - 1), np.minimum(column + dx, width - 1)
            weight = (across if dx else 1.0 - across) * (down if dy else 1.0 - down)
            if level:
                weight = weight * (owner[at] == charts)
            total += weight
            color += weight[:, None] * image[at]
        return color / np.maximum(total, 1e-12)[:, None], total


def chart_pyramid(
    textured: TexturedMesh, levels: int, threads: int, atlas: int = 0
) -> ChartPyramid:
    """Return the pyramid of one atlas.

    Parameters
    ----------
    textured : TexturedMesh
    levels : int
        Maximum number of levels in addition to the finest.
    """
    mesh = textured.mesh
    corner_uvs = np.asarray(textured.corner_uvs)
    face_charts = uv_charts(face_graph(mesh.vertices, mesh.faces), mesh.faces, corner_uvs)
    albedo = textured.atlases[atlas].albedo
    mine = textured.atlas_of_faces == atlas
    raster = raster_atlas(corner_uvs, albedo.shape[0], threads, mine)
    owner = np.where(raster.face >= 0, face_charts[raster.face], -1).astype(np.int32)
    colors, charts = [albedo], [owner]
    weight = (owner >= 0).astype(np.float32)
    for _ in range(levels):
        if max(charts[-1].shape) == 1:
            break
        color, owner, weight = _halved(colors[-1], charts[-1], weight)
        colors.append(color)
        charts.append(owner)
    return ChartPyramid(face_charts, colors, charts)


def _halved(
    image: np.ndarray, owner: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average those of 2 x 2 texels in the chart that has most texels of the finest level there."""
    odd = ((0, owner.shape[0] % 2), (0, owner.shape[1] % 2))
    owner = np.pad(owner, odd, constant_values=-1)
    weight = np.pad(weight, odd)
    image = np.pad(image, (*odd, (0, 0)))
    offsets = [np.s_[dy::2, dx::2] for dy in (0, 1) for dx in (0, 1)]
    best = np.full(owner[offsets[0]].shape, -1, np.int32)
    most = np.zeros(best.shape, np.float32)
    for offset in offsets:
        support = sum(weight[p] * (owner[p] == owner[offset]) for p in offsets)
        better = support > most
        best[better], most[better] = owner[offset][better], support[better]
    color = np.zeros((*best.shape, 3), np.float32)
    for offset in offsets:
        color += (weight[offset] * (owner[offset] == best))[..., None] * image[offset]
    color /= np.maximum(most, 1.0)[..., None]
    return color, best, most
