# SPDX-License-Identifier: GPL-3.0-or-later
"""Segmentation models of other people (ONNX), and cleaned masks of what they or silhouettes say."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from ..errors import DatasetError
from ..photos.photo_file import large_parts
from ..worker.environment import load_extra
from .mask_folder import check_model_file

# -- From how much of a pixel shows the object to a mask of the photo -----------------------------

THRESHOLD = 0.5
"""Share of a pixel from which it belongs to the object."""
SMALLEST_SHARE = 0.02
"""Parts smaller than this share of the largest are floaters."""
SMALL_HOLE_SHARE = 2e-4
"""Holes up to this share of the photo are thin spots of the model."""
OPEN_SHARE = 0.3
"""Mean share of the object in a larger hole, up to which one sees through it, as under a handle.
Where the model is thin, 0.4 is usual."""
GROWN_SHARE = 0.003
"""Border kept around the object, as a share of the long side: silhouettes of a small model are a
pixel of it inexact, and what a mask cuts off is lost while what it leaves on is not
(docs/method.md, section 12.1)."""


def cleaned(share: np.ndarray, size: tuple[int, int], grown_share: float = 0.0) -> np.ndarray:
    """Return the (h, w) bool mask of a photo, true where it shows the object.

    Parameters
    ----------
    share : (h', w') float
        In [0, 1]; of the whole photo, usually smaller than it.
    size : (int, int)
        Width and height of the photo.
    grown_share : float
        Border kept around the object, as a share of the photo's long side.
    """
    from PIL import Image

    grey = Image.fromarray(np.ascontiguousarray(share, np.float32))
    whole = np.asarray(grey.resize(size, Image.Resampling.BILINEAR))
    kept = _without_thin_spots(large_parts(whole >= THRESHOLD, SMALLEST_SHARE), whole)
    if not grown_share:
        return kept
    radius = max(1, round(grown_share * max(size)))
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return np.asarray(ndimage.binary_dilation(kept, x * x + y * y <= radius * radius))


def _without_thin_spots(mask: np.ndarray, share: np.ndarray) -> np.ndarray:
    holes = ndimage.binary_fill_holes(mask) & ~mask
    label, count = ndimage.label(holes)
    if count == 0:
        return mask
    areas = np.bincount(label.ravel())
    thin = np.bincount(label.ravel(), share.ravel()) > OPEN_SHARE * areas
    return np.asarray(mask | (holes & (thin | (areas <= SMALL_HOLE_SHARE * mask.size))[label]))


def encoded(mask: np.ndarray) -> bytes:
    """Return a (h, w) bool mask as a black and white PNG."""
    from PIL import Image

    stream = io.BytesIO()
    grey = Image.fromarray(np.where(mask, 255, 0).astype(np.uint8))
    grey.save(stream, format="PNG", compress_level=1)
    return stream.getvalue()


# -- Segmentation models of other people: an ONNX file that tells an object from its background
#
# Conventions (docs/file-formats.md): one input ``(1, 3, h, w)`` float, colours normalised in one
# of three ways; the first output ``(1, 1, h, w)`` or ``(1, h, w)``, shares or logits.

USUAL_SIDE_PX = 1024
"""Side of the input where the model leaves it open."""
MOST_SIDE_PX = 4096
RANGES = {
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "half": ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0)),
    "unit": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
}
"""Mean and deviation by the setting ``mask_model_range``."""
RANGE_TOLERANCE = 1e-3
"""By which shares may leave [0, 1] by rounding; what leaves it further is a logit."""
_LARGEST_LOGIT = 60.0
"""Beyond, a share is 0 or 1 in float32."""
_WANTED = "Choose a model for one-channel masks, such as U2-Net, IS-Net or BiRefNet."
_FLOATS = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class SegmentationModel:
    """A model that is ready to run.

    Parameters
    ----------
    path : Path
        The ONNX file.
    color_range : str
        One of ``RANGES``.
    threads : int
        0 uses every core.

    Raises
    ------
    WorkerError
        onnxruntime is not installed; says how to install it.
    DatasetError
        It is not an ONNX file, or its inputs and outputs are not those of such a model.
    ResourceError
        It is too large.
    """

    def __init__(self, path: Path, color_range: str, *, threads: int = 0) -> None:
        check_model_file(path)
        onnxruntime = load_extra("masks", f"The mask model {path.name}")
        onnxruntime.disable_telemetry_events()
        onnxruntime.set_default_logger_severity(4)  # fatal only: errors are raised as well
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # its exceptions share no base of their own
            text = f"{path.name} cannot be read as an ONNX model ({_first_line(error)})."
            raise DatasetError(text, _WANTED) from None
        self._name = path.name
        self._mean, self._deviation = (np.array(v, np.float32) for v in RANGES[color_range])
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or inputs[0].type not in _FLOATS:
            raise self._unfit(f"takes {len(inputs)} inputs, {inputs[0].type if inputs else 'none'}")
        self._input, self._output = inputs[0].name, outputs[0].name
        self._kind = _FLOATS[inputs[0].type]
        self.size = self._size_of(list(inputs[0].shape))

    def _size_of(self, shape: list[Any]) -> tuple[int, int]:
        """Return width and height of the input, from its declared shape."""
        count, channels = (shape[0], shape[1]) if len(shape) == 4 else (None, None)
        if len(shape) != 4 or (channels not in (3, None) and not isinstance(channels, str)):
            raise self._unfit(f"takes {shape}, not (1, 3, height, width)")
        if isinstance(count, int) and count not in (-1, 1):
            raise self._unfit(f"takes {count} photos at once")
        height, width = (v if isinstance(v, int) and v > 0 else USUAL_SIDE_PX for v in shape[2:])
        if max(width, height) > MOST_SIDE_PX:
            raise self._unfit(f"takes photos of {width} x {height} pixels")
        return width, height

    def share(self, color: np.ndarray) -> np.ndarray:
        """Return how much of each pixel is the object, (h', w') float32 in [0, 1].

        ``color``: (h, w, 3) uint8, a photo of any size; it is stretched to the model's, and so is
            the result.
        Raises DatasetError: the model fails, or its output has another shape or is not finite.
        """
        from PIL import Image

        small = Image.fromarray(color).resize(self.size, Image.Resampling.BILINEAR)
        pixels = (np.asarray(small, np.float32) / 255.0 - self._mean) / self._deviation
        planes = np.ascontiguousarray(pixels.transpose(2, 0, 1)[None]).astype(self._kind)
        try:
            found = self._session.run([self._output], {self._input: planes})[0]
        except Exception as error:  # as above
            raise self._unfit(f"fails ({_first_line(error)})") from None
        values = np.asarray(found)
        is_one_channel = values.ndim == 3 or (values.ndim == 4 and values.shape[1] == 1)
        if values.dtype.kind != "f" or not is_one_channel:
            raise self._unfit(f"gives {values.dtype} of shape {values.shape}, not (1, 1, h, w)")
        if values.shape[0] != 1 or 0 in values.shape:
            raise self._unfit(f"gives an output of shape {values.shape}")
        if not np.isfinite(values).all():
            raise self._unfit("gives values that are not finite")
        return as_shares(values.reshape(values.shape[-2:]).astype(np.float32))

    def _unfit(self, what: str) -> DatasetError:
        return DatasetError(f"The mask model {self._name} {what}.", _WANTED)


def as_shares(values: np.ndarray) -> np.ndarray:
    """Return shares in [0, 1] of (h, w) shares or logits: logits leave that range."""
    if values.min() >= -RANGE_TOLERANCE and values.max() <= 1.0 + RANGE_TOLERANCE:
        return np.clip(values, 0.0, 1.0)
    clipped = np.clip(values, -_LARGEST_LOGIT, _LARGEST_LOGIT)
    return (1.0 / (1.0 + np.exp(-clipped))).astype(np.float32)


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:200].rstrip(".") if lines else type(error).__name__
