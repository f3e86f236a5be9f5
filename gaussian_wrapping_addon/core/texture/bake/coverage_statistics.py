# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture coverage statistics, accumulated over atlases."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...settings import TextureSettings
from ..unwrap.unwrap import Unwrap
from .bake import BakedColors
from .photo_samples import SurfacePoints


class CoverageStatistics:
    """Counts of texels and faces over the atlases of one mesh.

    Parameters
    ----------
    faces : int
        Number of faces of the mesh.
    """

    def __init__(self, faces: int) -> None:
        self._with_texel = np.zeros(faces, np.bool_)
        self._face_seen = np.zeros(faces, np.bool_)
        self._used = self._seen = self._silhouettes = self._unreliable = self._overlaps = 0
        self._views = self._rejected = 0
        self._baked: BakedColors | None = None

    def add(self, points: SurfacePoints, baked: BakedColors, overlaps: int) -> None:
        """Add one atlas, in which ``overlaps`` texels are used twice."""
        seen = baked.views > 0
        self._with_texel[points.face] = True
        self._face_seen[points.face[seen]] = True
        self._used += len(points)
        self._seen += int(seen.sum())
        self._silhouettes += int((baked.reliable & ~baked.clear).sum())
        self._unreliable += int((seen & ~baked.reliable).sum())
        self._overlaps += overlaps
        self._views += int(baked.views.sum(dtype=np.int64))
        self._rejected += baked.rejected
        self._baked = baked

    def statistics(
        self, size_px: int, settings: TextureSettings, unwrapped: Unwrap, areas: np.ndarray
    ) -> dict[str, Any]:
        """Return plain JSON values over all atlases.

        Parameters
        ----------
        size_px : int
            Side of each atlas.
        settings : TextureSettings
        unwrapped : Unwrap
        areas : (f,) float64
            Face areas.
        """
        baked = self._baked
        assert baked is not None  # a mesh has at least one atlas
        with_texel, face_seen = self._with_texel, self._face_seen
        used, seen = self._used, self._seen
        area_with_texel = float(areas[with_texel].sum())
        return {
            "size_px": size_px,
            "size_automatic": settings.size_px == 0,
            "atlases": unwrapped.atlases,
            "unwrap": unwrapped.method,
            "unwrap_fallback_reason": unwrapped.reason,
            "charts": int(unwrapped.charts.max()) + 1,
            "gutter_px": round(unwrapped.gutter_px, 2),
            "utilisation": used / (unwrapped.atlases * size_px**2),
            "texels_used": used,
            "texels_seen": seen,
            "texels_filled": used - seen,
            "texels_seen_at_outlines_only": self._silhouettes,
            "texels_seen_badly": self._unreliable,
            "texels_overlapping": self._overlaps,
            "coverage": seen / max(used, 1),
            "faces_seen_share": float(face_seen.sum()) / max(int(with_texel.sum()), 1),
            # Over faces with a texel: visibility of the others is unknown.
            "area_seen_share": float(areas[face_seen].sum()) / area_with_texel
            if area_with_texel
            else 0.0,
            "area_without_texel_share": float(areas[~with_texel].sum() / areas.sum()),
            "faces_without_texel": int((~with_texel).sum()),
            "views_per_seen_texel": self._views / seen if seen else 0.0,
            "views_rejected_share": self._rejected / max(self._views + self._rejected, 1),
            "photos_used": baked.photos_used,
            "exposure_spread": baked.gain_spread,
            "exposure_corrected": baked.gains_applied,
            "brightness_spread_within_photos": baked.low_frequency_spread,
            "brightness_evened_within_photos": baked.low_frequency_applied,
        }
