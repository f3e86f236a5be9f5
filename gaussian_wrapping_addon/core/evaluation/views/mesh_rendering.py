# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh-based rendering: compare renderings of the textured mesh with photos.

Unlike :mod:`.mesh_based_rendering`, no colour field is trained on the mesh: the mesh is evaluated
with its final texture (docs/method.md, section 9.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dataset.camera import Camera
from ...errors import UsageError
from ...imaging.lpips import Lpips, lpips_ready
from ...imaging.view_metrics import PSNR_CAP_DB, ViewScores, has_windows, psnr, score_images
from ...kernels.parallel import default_threads
from ...mesh.textured_mesh import TexturedMesh
from .textured_rendering import TexturedRenderer

OnView = Callable[[str, np.ndarray, np.ndarray], None]


@dataclass(frozen=True)
class MeshView:
    """Figures of one photo."""

    name: str
    """Name of the camera."""
    scores: ViewScores
    covered: float
    """Share of the candidate pixels (of the mask, or of the whole photo without one) that the mesh
    covers wholly."""
    uncovered: float
    """Share of the candidate pixels in which no ray meets a face."""
    whole_psnr: float
    """PSNR over all candidate pixels, black where no face covers them, dB."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; ``lpips`` only if measured."""
        return {
            "name": self.name,
            **self.scores.to_json(),
            "covered": self.covered,
            "uncovered": self.uncovered,
            "whole_psnr": self.whole_psnr,
        }


@dataclass(frozen=True)
class MeshRenderingScore:
    """Figures of all photos; means are over photos with equal weights."""

    views: tuple[MeshView, ...]
    pixels: str
    """``"mask"``: pixels of the given masks; ``"covered"``: pixels that the mesh covers wholly."""
    left_out: int
    """Photos without a valid pixel, or without one on which an SSIM window can be centred."""
    lpips_note: str = ""
    """Why LPIPS is missing."""

    @property
    def psnr(self) -> float | None:
        """Mean PSNR, dB; ``None`` without any view."""
        return _mean([view.scores.psnr for view in self.views])

    @property
    def ssim(self) -> float | None:
        """Mean SSIM; ``None`` without any view."""
        return _mean([view.scores.ssim for view in self.views])

    @property
    def lpips(self) -> float | None:
        """Mean LPIPS of the views with a value; ``None`` without any."""
        return _mean([v.scores.lpips for v in self.views if v.scores.lpips is not None])

    @property
    def covered(self) -> float | None:
        """Mean covered share; ``None`` without any view."""
        return _mean([view.covered for view in self.views])

    @property
    def uncovered(self) -> float | None:
        """Mean uncovered share; ``None`` without any view."""
        return _mean([view.uncovered for view in self.views])

    @property
    def whole_psnr(self) -> float | None:
        """Mean PSNR that counts uncovered pixels as black, dB; ``None`` without any view."""
        return _mean([view.whole_psnr for view in self.views])

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; unmeasured values are absent, and no value is infinite."""
        names = ("psnr", "ssim", "lpips", "covered", "uncovered", "whole_psnr")
        means = {name: getattr(self, name) for name in names}
        values: dict[str, Any] = {
            "views": [view.to_json() for view in self.views],
            **{name: value for name, value in means.items() if value is not None},
            "pixels": self.pixels,
            "left_out": self.left_out,
        }
        if self.lpips_note:
            values["lpips_note"] = self.lpips_note
        return values


def render_views(
    textured: TexturedMesh,
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray],
    *,
    masks: Sequence[np.ndarray] | None = None,
    counted: Sequence[np.ndarray | None] | None = None,
    lpips: Lpips | None = None,
    threads: int = 0,
    on_view: OnView | None = None,
) -> MeshRenderingScore:
    """Render the mesh from each camera and compare with its photo.

    PSNR, SSIM and LPIPS are those of :func:`~...imaging.view_metrics.score_images` over the valid
    pixels. The rendering is unlit, two-sided and antialiased with ``SUPERSAMPLING`` squared rays
    per pixel.

    Parameters
    ----------
    textured : TexturedMesh
        Scene frame.
    cameras : sequence of Camera
        In the mesh's frame (see ``Camera.moved``), each of the size of its photo.
    images : sequence of (h, w, 3) uint8, or floats whose white is 1
        The photos.
    masks : sequence of (h, w) bool, optional
        Valid pixels, such as true silhouettes. Pixels that the mesh leaves uncovered have the
        background colour and are compared too: a hole is an error. Without masks, the pixels that
        the mesh covers wholly are compared: holes and missing parts cost nothing, and occluders in
        front of the mesh in the photo are errors.
    counted : sequence of ((h, w) bool or None), optional
        Candidate pixels of each photo, such as the photo's own mask.
    lpips : Lpips, optional
    threads : int
        0 uses every core; the result does not depend on it, except for the last digits of LPIPS.
    on_view : callable, optional
        Called with name, photo and rendering of each view compared.

    Raises
    ------
    UsageError
        A photo or mask differs in size from its camera, or their numbers differ.
    """
    threads = threads or default_threads()
    renderer = TexturedRenderer(textured, threads=threads)
    views: list[MeshView] = []
    left_out = 0
    for camera, photo, mask, may_count in zip(
        cameras,
        _one_each(images, cameras, "photos"),
        _one_each(masks, cameras, "masks"),
        _one_each(counted, cameras, "masks"),
        strict=True,
    ):
        _check_sizes(camera, photo, mask, may_count)
        view = renderer.render(camera)
        candidates = np.ones(view.covered.shape, np.bool_)
        for part in (mask, may_count):
            if part is not None:
                candidates &= part
        judged = candidates & view.covered if mask is None else candidates
        if not has_windows(judged.shape, judged):
            left_out += 1
            continue
        scores = score_images(view.image, photo, judged, lpips=lpips, threads=threads)
        count = np.count_nonzero(candidates)
        views.append(
            MeshView(
                camera.name,
                scores,
                np.count_nonzero(view.covered & candidates) / count,
                np.count_nonzero((view.coverage == 0.0) & candidates) / count,
                min(psnr(view.on_black(), photo, candidates), PSNR_CAP_DB),
            )
        )
        if on_view is not None:
            on_view(camera.name, photo, view.image)
    pixels = "covered" if masks is None else "mask"
    return MeshRenderingScore(tuple(views), pixels, left_out, _note(lpips, views))


def _one_each(given: Sequence[Any] | None, cameras: Sequence[Camera], what: str) -> Sequence[Any]:
    if given is None:
        return [None] * len(cameras)
    if len(given) != len(cameras):
        raise UsageError(
            f"{len(given)} {what} for {len(cameras)} cameras.", f"Give {what}, one for each camera."
        )
    return given


def _check_sizes(camera: Camera, *pictures: np.ndarray | None) -> None:
    for picture in pictures:
        if picture is not None and picture.shape[:2] != (camera.height, camera.width):
            raise UsageError(
                f"{camera.name}: a picture of {picture.shape[:2]} pixels (height, width) for a "
                f"camera of {(camera.height, camera.width)}.",
                "Resize the camera or the picture.",
            )


def _note(lpips: Lpips | None, views: list[MeshView]) -> str:
    if lpips is None:
        ready, reason = lpips_ready()
        return "LPIPS was not requested." if ready else reason
    if views and all(view.scores.lpips is None for view in views):
        return "The pictures are too small for LPIPS."
    return ""


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
