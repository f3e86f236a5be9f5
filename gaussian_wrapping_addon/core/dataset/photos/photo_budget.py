# SPDX-License-Identifier: GPL-3.0-or-later
"""How much memory decoded photos may take, and whether all of them fit."""

from __future__ import annotations

from dataclasses import dataclass

from ...limits import (
    MAX_PHOTO_MEMORY_BYTES,
    MIN_PHOTO_MEMORY_BYTES,
    PHOTO_MEMORY_SHARE,
    UNKNOWN_PHOTO_MEMORY_BYTES,
)


def photo_budget_bytes(free_bytes: int) -> int:
    """Return the memory for decoded photos on a machine with so much free; 0 if unknown."""
    if not free_bytes:
        return UNKNOWN_PHOTO_MEMORY_BYTES
    share = int(PHOTO_MEMORY_SHARE * free_bytes)
    return max(MIN_PHOTO_MEMORY_BYTES, min(share, MAX_PHOTO_MEMORY_BYTES))


@dataclass(frozen=True)
class PhotoMemory:
    """Photos of a training, decoded, and the memory for them."""

    photos: int
    all_bytes: int
    """Of all photos and masks at the sizes at which they are trained on."""
    budget_bytes: int

    @property
    def fits(self) -> bool:
        """Whether all stay in memory once they were read."""
        return self.all_bytes <= self.budget_bytes

    @property
    def used_bytes(self) -> int:
        """Memory that decoded photos take at most."""
        return min(self.all_bytes, self.budget_bytes)

    def sentence(self) -> str:
        """Return in a few words where the photos are."""
        size = f"{self.all_bytes / 2**30:.2f} GB"
        if self.fits:
            return f"in memory, {size}"
        each = self.all_bytes / max(1, self.photos) / 2**20
        return (
            f"read on demand: {self.photos} of {each:.1f} MB decoded are {size}, "
            f"{self.budget_bytes / 2**30:.2f} GB of memory are for them"
        )


def photo_memory(photos: int, pixels: float, *, masked: bool, free_bytes: int) -> PhotoMemory:
    """Return what photos take that are read at three sizes, each half of the one before.

    Parameters
    ----------
    pixels : float
        Of a photo at the largest of them.
    masked : bool
    free_bytes : int
        Free memory of the machine; 0 if unknown.
    """
    channels = 4 if masked else 3
    all_bytes = round(photos * pixels * channels * (1 + 1 / 4 + 1 / 16))
    return PhotoMemory(photos, all_bytes, photo_budget_bytes(free_bytes))
