# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes of the zoo with photos as a camera takes them: soft, noisy, compressed."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import uuid
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from .cache import ensure_zoo_scene, scene_folder
from .catalogue import zoo_scene

_SOFTNESS_PX = (0.3, 0.6)
"""Range of the standard deviation of the Gaussian that lens and sensor make of a point."""
_NOISE_LEVELS = (0.7, 2.5)
"""Range of the standard deviation of the noise at :data:`_MIDDLE`, of each channel."""
_MIDDLE, _NOISE_IN_THE_DARK = 128.0, 0.3
"""Grey level at which noise is as drawn, and share of its power that does not come from light."""
_QUALITIES = (85, 96)
"""Least quality of the JPEG files, and one more than the largest."""


def taken_folder(name: str, root: Path | None = None) -> Path:
    """Return where a scene with photos as taken is kept; its hash covers this module, too."""
    source = Path(__file__).read_bytes().replace(b"\r\n", b"\n")
    clean = scene_folder(name, root)
    return clean.with_name(f"{clean.name}-taken-{hashlib.sha256(source).hexdigest()[:8]}")


def ensure_taken_scene(name: str, threads: int = 1, root: Path | None = None) -> Path:
    """Return the folder of a scene with photos as taken; make it where it does not exist yet.

    Test views, truth and cameras are those of :func:`ensure_zoo_scene`, whose errors it raises.
    """
    target = taken_folder(name, root)
    if target.is_dir():
        return target
    clean = ensure_zoo_scene(name, threads, root)
    partial = target.with_name(f"{target.name}.making.{uuid.uuid4().hex[:8]}")
    try:
        shutil.copytree(clean, partial)
        random = np.random.default_rng([zoo_scene(name).seed, 3])
        softness, noise = random.uniform(*_SOFTNESS_PX), random.uniform(*_NOISE_LEVELS)
        quality = int(random.integers(*_QUALITIES))
        for path in sorted((partial / "images").iterdir()):
            with Image.open(path) as image:
                photo = np.asarray(image.convert("RGB"))
            Image.fromarray(taken(photo, softness, noise, quality, random)).save(path)
        try:
            os.rename(partial, target)
        except OSError:
            if not target.is_dir():  # else another process was first: the same photos
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def taken(
    photo: np.ndarray, softness_px: float, noise: float, quality: int, random: np.random.Generator
) -> np.ndarray:
    """Return a photo (h, w, 3) uint8 as a camera takes it.

    Parameters
    ----------
    softness_px : float
        Standard deviation of a point.
    noise : float
        Standard deviation in the middle between black and white, grey levels of each channel.
    quality : int
        Of the JPEG.
    """
    soft = ndimage.gaussian_filter(photo.astype(np.float32), (softness_px, softness_px, 0))
    power = _NOISE_IN_THE_DARK + (1.0 - _NOISE_IN_THE_DARK) * soft / _MIDDLE
    noisy = soft + noise * np.sqrt(power) * random.normal(size=photo.shape)
    return compressed(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), quality)


def compressed(photo: np.ndarray, quality: int) -> np.ndarray:
    """Return what a JPEG of a quality leaves of a photo."""
    file = io.BytesIO()
    Image.fromarray(photo).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))
