# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos as a camera on automatic takes them: exposure and white balance vary."""

from __future__ import annotations

import numpy as np

LARGEST_GAIN = 1.35
"""Exposures vary between 1 / this and this."""

WHITE_BALANCE = 0.05
"""Red and blue vary by at most this share against green."""


def draw_gains(count: int, seed: int) -> np.ndarray:
    """Return (count, 3) linear gains of red, green, blue."""
    random = np.random.default_rng([seed, 3])
    exposure = np.exp(random.uniform(-1, 1, count) * np.log(LARGEST_GAIN))
    balance = 1.0 + WHITE_BALANCE * random.uniform(-1, 1, (count, 2))
    return exposure[:, None] * np.stack([balance[:, 0], np.ones(count), balance[:, 1]], 1)


def expose(photo: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return the photo (h, w, 3) uint8 sRGB with its linear light times ``gains`` (3,)."""
    coded = np.arange(256) / 255.0
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    result = np.empty_like(photo)
    for channel in range(3):
        light = np.minimum(linear * gains[channel], 1.0)
        back = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
        table = np.rint(back * 255).astype(np.uint8)  # (256,)
        result[..., channel] = table[photo[..., channel]]
    return result
