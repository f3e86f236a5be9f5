# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview picture and points of a running training; metrics of held-out photos.

Nothing here affects a training's result: the renderer is a separate one, no random numbers are
drawn, and the clock only decides when to update.
"""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..files import write_bytes
from ..gaussians.model import OrientedGaussians
from ..gaussians.preview_points import POINTS_FILE, points_file, preview_points
from ..image_metrics import (
    corrected_for_measuring,
    fit_exposure,
    lpips_if_ready,
    psnr,
    score_images,
)
from ..progress import Progress
from ..render.projection import RawArrays
from ..render.types import Renderer, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..scene.scene import PhotoSource, evenly_spaced
from ..settings import TrainingSettings
from .focus import Focus
from .state import HeldOutMetrics

_logger = logging.getLogger(__name__)

PREVIEW_FILE = "preview-training.png"
PIXELS_FILE = "preview-training.npy"
"""The same picture as an (h, w, 3) uint8 array, which needs no decoder."""
PREVIEW_PX = 640
"""Width of the whole picture: photo and render side by side."""

MEASURED_VIEWS = 4
MEASURED_PX = 240
"""Number and longest side of the held-out photos measured during training: about 5 ms each."""

BEST_PSNR = 100.0
"""PSNR of identical images, dB: keeps means finite."""

GAP_PX = 4

TOO_SMALL = "The photos are too small for LPIPS."


def divisor_for(photos: PhotoSource, index: int, longest_px: int) -> int:
    """Return the smallest divisor that brings a photo's long side to at most ``longest_px``."""
    camera = photos.camera(index, 1)
    divisor = -(-max(camera.width, camera.height) // longest_px)
    return max(1, min(divisor, camera.width, camera.height))


def measure_held_out(
    gaussians: OrientedGaussians, photos: PhotoSource, held_out: Sequence[int], *, threads: int,
    renderer: Renderer | None = None, exposed: bool = False,
) -> float:  # fmt: skip
    """Return the mean PSNR of a few held-out photos at a small size, dB.

    NaN without held-out photos, or if masks cover all of them. Depends on the Gaussians and photos
    alone, so it may enter a training's history.

    Parameters
    ----------
    held_out : sequence of int
        Held-out views; :data:`MEASURED_VIEWS` of them, evenly spread, are measured.
    renderer : Renderer, optional
        Renderer to reuse; not one whose last view still awaits its backward pass.
    exposed : bool
        Whether exposures are modelled: renders are brought to those of the photos before they are
        measured (:func:`~.image_metrics.corrected_for_measuring`).
    """
    renderer = renderer or ViewRenderer()
    raw = RawArrays.from_gaussians(gaussians)
    figures = []
    for view in evenly_spaced(held_out, MEASURED_VIEWS):
        divisor = divisor_for(photos, view, MEASURED_PX)
        photo, mask = photos.photo(view, divisor), photos.mask(view, divisor)
        if mask is not None and not mask.any():
            continue
        image = _rendered(renderer, raw, photos, view, divisor, threads)
        if exposed:
            image = corrected_for_measuring(image, photo, mask)
        figures.append(min(psnr(image, photo, mask), BEST_PSNR))
    return float(np.mean(figures)) if figures else float("nan")


def _rendered(
    renderer: Renderer, raw: RawArrays, photos: PhotoSource, view: int, divisor: int, threads: int
) -> np.ndarray:
    options = RenderOptions(depth=False, threads=threads)
    return renderer.render(raw, photos.camera(view, divisor), options).color


class LiveView:
    """Update the preview of a training every few seconds.

    Parameters
    ----------
    held_out : sequence of int
        Held-out views. The middle one is shown, or ``otherwise`` without any.
    folder : Path
        Receives :data:`PREVIEW_FILE`, :data:`PIXELS_FILE` and :data:`~.preview_points.POINTS_FILE`,
        each replaced atomically.
    settings : TrainingSettings
        ``preview_every_s`` is the time between two updates; 0 disables them.
    clock : callable
        Seconds; the first update comes ``preview_every_s`` after the start.
    """

    def __init__(
        self, photos: PhotoSource, held_out: Sequence[int], folder: Path,
        settings: TrainingSettings, threads: int, clock: Callable[[], float] = time.monotonic,
        renderer: Renderer | None = None, otherwise: int = 0,
    ) -> None:  # fmt: skip
        self._photos, self._held_out, self._folder = photos, list(held_out), folder
        self._every_s, self._threads, self._clock = settings.preview_every_s, threads, clock
        self.renderer = renderer or ViewRenderer()
        self._updated_s = clock()
        middle = self._held_out[len(self._held_out) // 2 :]
        self._shown_view = middle[0] if middle else otherwise

    def is_due(self) -> bool:
        """Tell whether :meth:`update` would write anything now."""
        return self._every_s > 0 and self._clock() - self._updated_s >= self._every_s

    def update(
        self, gaussians: OrientedGaussians, iteration: int,
        exposed: bool = False, *, force: bool = False,
    ) -> dict[str, float] | None:  # fmt: skip
        """Write the preview and measure the held-out photos, if due or ``force`` is set.

        Returns
        -------
        dict or None
            ``held_out_psnr`` (dB) and ``held_out_iteration`` for the progress figures, empty
            without held-out photos; ``None`` if no update is due.
        """
        if self._every_s <= 0 or not (force or self.is_due()):
            return None
        figures = {}
        quality = measure_held_out(
            gaussians, self._photos, self._held_out, threads=self._threads, renderer=self.renderer,
            exposed=exposed,
        )  # fmt: skip
        if np.isfinite(quality):
            figures = {"held_out_psnr": quality, "held_out_iteration": float(iteration)}
        self._write(gaussians, exposed)
        # Taken after the work, so that slow updates do not run back to back.
        self._updated_s = self._clock()
        return figures

    def _write(self, gaussians: OrientedGaussians, exposed: bool) -> None:
        divisor = divisor_for(self._photos, self._shown_view, (PREVIEW_PX - GAP_PX) // 2)
        raw = RawArrays.from_gaussians(gaussians)
        view, photo = self._shown_view, self._photos.photo(self._shown_view, divisor)
        image = _rendered(self.renderer, raw, self._photos, view, divisor, self._threads)
        if exposed:  # one for the whole photo: the halves' own, for measuring, would leave a seam
            gain, offset = fit_exposure(image, photo, self._photos.mask(view, divisor))
            image = gain * image + offset
        picture = side_by_side(photo, image)
        try:
            write_bytes(self._folder / PREVIEW_FILE, png(picture))
            write_bytes(self._folder / PIXELS_FILE, npy(picture))
            points = preview_points(raw.means, raw.opacity_logits, raw.sh)
            write_bytes(self._folder / POINTS_FILE, points_file(points))
        except OSError as error:
            # The training goes on without pictures; a full disk is reported by the checkpoints.
            self._every_s = 0.0
            _logger.warning("preview pictures are disabled: %s", error)


def side_by_side(photo: np.ndarray, rendering: np.ndarray) -> np.ndarray:
    """Return (h, 2 w + gap, 3) uint8: the photo left, the rendering (white is 1) right."""
    right = np.rint(255.0 * np.clip(np.nan_to_num(rendering), 0.0, 1.0)).astype(np.uint8)
    gap = np.zeros((photo.shape[0], GAP_PX, 3), np.uint8)
    return np.concatenate([photo, gap, right], axis=1)


def npy(picture: np.ndarray) -> bytes:
    """Return the bytes of a NumPy file of an array."""
    stream = io.BytesIO()
    np.save(stream, picture, allow_pickle=False)
    return stream.getvalue()


def png(picture: np.ndarray) -> bytes:
    """Return the bytes of a PNG file of a (h, w, 3) uint8 picture."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(stream, format="PNG", compress_level=1)
    return stream.getvalue()


def held_out_metrics(
    gaussians: OrientedGaussians, photos: PhotoSource, names: Mapping[int, str], progress: Progress,
    *, threads: int, renderer: Renderer | None = None, exposed: bool = False,
    focus: Focus | None = None,
) -> tuple[list[HeldOutMetrics], str]:  # fmt: skip
    """Return the metrics of held-out photos, given by view and name, and why they have no LPIPS.

    Where exposures are modelled (``exposed``), that of each half of a photo is fitted on the other
    half, as it was never trained.
    """
    figures = []
    lpips, reason = lpips_if_ready() if names else (None, "")
    raw, renderer = RawArrays.from_gaussians(gaussians), renderer or ViewRenderer()
    for view, name in names.items():
        progress.update(1.0, f"measuring {name}")
        photo, mask = photos.photo(view, 1), photos.mask(view, 1)
        if mask is not None and not mask.any():
            continue
        image = _rendered(renderer, raw, photos, view, 1, threads)
        if exposed:
            image = corrected_for_measuring(image, photo, mask)
        scores = score_images(image, photo, mask, lpips=lpips, threads=threads)
        of_regions = None
        if focus is not None:
            shown = focus.shown(photos.camera(view, 1))
            shown = shown if mask is None else shown & mask
            of_regions = min(psnr(image, photo, shown), BEST_PSNR) if shown.any() else None
        figures.append(HeldOutMetrics(name, scores.psnr, scores.ssim, scores.lpips, of_regions))
    if not figures or any(figure.lpips is not None for figure in figures):
        return figures, ""
    return figures, reason or TOO_SMALL
