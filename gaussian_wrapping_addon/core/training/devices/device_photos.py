# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos and masks kept on a device, so that an iteration sends none that it has."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch
from torch import Tensor

from ...dataset.photo_source import PhotoSource
from .backend import Shown, counts_of
from .windows import Window


class DevicePhotos:
    """The photos used last, up to a number of bytes.

    Parameters
    ----------
    device : torch.device
    limit_bytes : int
        Device memory; the photo in use is kept whatever its size.
    """

    def __init__(self, device: torch.device, limit_bytes: int) -> None:
        self.device, self.limit_bytes = device, limit_bytes
        self._held: OrderedDict[tuple[int, int], tuple[Tensor, Tensor | None]] = OrderedDict()
        self.bytes_held = 0
        self._source: PhotoSource | None = None

    def shown(self, photos: PhotoSource, view: int, divisor: int, window: Window | None) -> Shown:
        """Return a photo and its mask, whole or a window, as contiguous tensors."""
        photo, mask = self._get(photos, view, divisor)
        flat = None if mask is None else photos.mask(view, divisor)
        if window is not None:
            rows = slice(window.top, window.top + window.height)
            columns = slice(window.left, window.left + window.width)
            photo = photo[rows, columns].contiguous()
            mask = None if mask is None else mask[rows, columns].contiguous()
            flat = None if flat is None else flat[rows, columns]
        return Shown(photo, mask, *counts_of(flat, *photo.shape[:2]))

    def clear(self) -> None:
        """Drop all photos."""
        self._held.clear()
        self.bytes_held = 0

    def _get(self, photos: PhotoSource, view: int, divisor: int) -> tuple[Tensor, Tensor | None]:
        if photos is not self._source:
            self.clear()
            self._source = photos
        key = (view, divisor)
        held = self._held.get(key)
        if held is not None:
            self._held.move_to_end(key)
            return held
        photo, mask = photos.photo(view, divisor), photos.mask(view, divisor)
        held = (self._sent(photo), None if mask is None else self._sent(mask))
        self._held[key] = held
        self.bytes_held += _bytes(held)
        while self.bytes_held > self.limit_bytes and len(self._held) > 1:
            _, old = self._held.popitem(last=False)
            self.bytes_held -= _bytes(old)
        return held

    def _sent(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.array(array)).to(self.device)


def _bytes(held: tuple[Tensor, Tensor | None]) -> int:
    return sum(tensor.numel() for tensor in held if tensor is not None)
