# SPDX-License-Identifier: GPL-3.0-or-later
"""LPIPS, a learned perceptual distance between images, if its weights are installed.

The network is that of Zhang et al., "The Unreasonable Effectiveness of Deep Features as a
Perceptual Metric" (CVPR 2018), variant AlexNet, version 0.1. Nothing is ever downloaded: the
package ``lpips`` would download a missing backbone and needs torchvision, so only its file of
linear heads is read.
"""

from __future__ import annotations

import importlib.util
import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import ParseError, ResourceError, UsageError, WrapError
from .image_values import as_unit_floats, check_sizes

if TYPE_CHECKING:
    import torch

_logger = logging.getLogger(__name__)

WEIGHTS_VARIABLE = "GAUSSIAN_WRAPPING_LPIPS"
"""Files, or folders that contain them, separated as in PATH; searched first."""
BACKBONE_PATTERN = "alexnet-owt-*.pth"
"""Name of torchvision's AlexNet weights in torch's hub cache."""
HEADS_PATTERN = "alex.pth"
MAX_FILE_BYTES = 1 << 30
"""The backbone, including its unused classifier, is a quarter of this."""

MIN_SIDE_PX = 31
"""For smaller images, the last layers of AlexNet have no pixel."""

# Convolutions of torchvision's AlexNet: index in ``features``, channels in, channels out, kernel,
# stride, padding, whether preceded by 3 x 3 max pooling with stride 2. Each is followed by a ReLU.
_LAYERS = (
    (0, 3, 64, 11, 4, 2, False),
    (3, 64, 192, 5, 1, 2, True),
    (6, 192, 384, 3, 1, 1, True),
    (8, 384, 256, 3, 1, 1, False),
    (10, 256, 256, 3, 1, 1, False),
)
_MEAN, _SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet colours, white = 1."""
_LENGTH_FLOOR = 1e-10


def lpips_ready() -> tuple[bool, str]:
    """Return whether both weight files are installed; if not, the reason and the next step."""
    try:
        _find_files()
    except ResourceError as error:
        return False, str(error)
    return True, ""


def lpips_if_ready() -> tuple[Lpips | None, str]:
    """Return the metric, or ``None`` and the reason (missing or damaged weights).

    For metrics that accompany other work: a damaged weight file is logged and named in the reason,
    without aborting that work.
    """
    try:
        return Lpips.load(), ""
    except ResourceError as error:
        return None, str(error)
    except WrapError as error:
        _logger.warning("LPIPS is not measured: %s", error)
        return None, str(error)


@dataclass(frozen=True)
class Lpips:
    """The metric with its weights; float32, on the CPU."""

    filters: tuple[torch.Tensor, ...]
    """(out, in, k, k) of each convolution."""
    biases: tuple[torch.Tensor, ...]
    """(out,) of each convolution."""
    heads: tuple[torch.Tensor, ...]
    """(1, out, 1, 1), non-negative: weight of each channel."""

    @classmethod
    def load(cls) -> Lpips:
        """Read the weights.

        Raises
        ------
        ResourceError
            If a file is missing: see :func:`lpips_ready`.
        ParseError
            If a file is damaged or has other content.
        """
        backbone_path, heads_path = _find_files()
        backbone, heads = _read_state(backbone_path), _read_state(heads_path)
        filters, biases, importances = [], [], []
        for layer, (index, inwards, outwards, side, *_) in enumerate(_LAYERS):
            name = f"features.{index}"
            shape = (outwards, inwards, side, side)
            filters.append(_tensor(backbone, backbone_path, f"{name}.weight", shape))
            biases.append(_tensor(backbone, backbone_path, f"{name}.bias", (outwards,)))
            name = f"lin{layer}.model.1.weight"
            head = _tensor(heads, heads_path, name, (1, outwards, 1, 1))
            if bool((head < 0).any()):
                raise ParseError(heads_path, name, "a weight is negative.", _REPLACE)
            importances.append(head)
        return cls(tuple(filters), tuple(biases), tuple(importances))

    @staticmethod
    def fits(shape: tuple[int, ...]) -> bool:
        """Return whether images of this shape are large enough for the network."""
        return min(shape[:2]) >= MIN_SIDE_PX

    def distance(self, image: np.ndarray, photo: np.ndarray) -> float:
        """Return the distance: 0 for equal images, about 0.7 for unrelated ones.

        At each layer, the features of a pixel are scaled to unit length; the squared differences
        are weighted by channel, summed, and averaged over the pixels; layers are added (equation 1
        of the paper).

        Parameters
        ----------
        image, photo : (h, w, 3)
            sRGB, uint8 or floats with white = 1; clamped to [0, 1] as by a display.

        Raises
        ------
        UsageError
            If the shapes differ or a side is below :data:`MIN_SIDE_PX`.
        """
        import torch

        pair = [np.clip(as_unit_floats(x), 0.0, 1.0) for x in (image, photo)]
        check_sizes(pair[0], pair[1], None)
        if not self.fits(pair[0].shape):
            raise UsageError(
                f"LPIPS needs images of at least {MIN_SIDE_PX} pixels per side.",
                "Compare larger images.",
            )
        mean, spread = np.array(_MEAN, np.float32), np.array(_SPREAD, np.float32)
        scaled = (np.stack(pair) - mean) / spread  # (2, h, w, 3)
        features = torch.from_numpy(np.ascontiguousarray(scaled.transpose(0, 3, 1, 2)))
        total = 0.0
        with torch.inference_mode():
            for layer, (*_, stride, padding, pooled) in enumerate(_LAYERS):
                if pooled:
                    features = torch.nn.functional.max_pool2d(features, 3, 2)
                features = torch.nn.functional.conv2d(
                    features, self.filters[layer], self.biases[layer], stride, padding
                ).relu()
                length = (features**2).sum(1, keepdim=True).sqrt() + _LENGTH_FLOOR
                unit = features / length  # (2, c, h', w')
                weighted = (unit[0] - unit[1]) ** 2 * self.heads[layer][0]  # (c, h', w')
                total += float(weighted.sum(0).mean(dtype=torch.float64))
        return total


_REPLACE = "Replace the file, or remove it to do without LPIPS."


def _find_files() -> tuple[Path, Path]:
    """Return the files of the backbone and of the heads."""
    import torch

    given = [Path(p) for p in os.environ.get(WEIGHTS_VARIABLE, "").split(os.pathsep) if p]
    cache = Path(torch.hub.get_dir()) / "checkpoints"
    package = importlib.util.find_spec("lpips")
    package_folder = Path(package.origin).parent if package and package.origin else None
    weights = [] if package_folder is None else [package_folder / "weights" / "v0.1"]
    backbone = _first_file([*given, cache], BACKBONE_PATTERN)
    heads = _first_file([*given, *weights], HEADS_PATTERN)
    missing = []
    if backbone is None:
        missing.append(f"AlexNet's weights ({BACKBONE_PATTERN}) are not in torch's hub cache")
    if heads is None:
        missing.append(f"the linear heads ({HEADS_PATTERN}) of the package lpips are not installed")
    if backbone is None or heads is None:
        raise ResourceError(
            f"LPIPS is not measured: {', and '.join(missing)}.",
            f"Put the files in a folder and name it in {WEIGHTS_VARIABLE}; nothing is downloaded.",
        )
    return backbone, heads


def _first_file(folders: list[Path], pattern: str) -> Path | None:
    for path in folders:
        files = sorted(path.glob(pattern)) if path.is_dir() else [path]
        for file in files:
            if file.is_file() and file.match(pattern):
                return file
    return None


def _read_state(path: Path) -> dict[str, Any]:
    import torch

    size_bytes = path.stat().st_size
    if size_bytes > MAX_FILE_BYTES:
        raise ParseError(path, "whole file", f"{size_bytes} bytes are too many.", _REPLACE)
    try:
        # Only tensors and plain containers: with weights_only no code in the file can run.
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch can raise almost anything for a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ParseError(path, "whole file", f"not weights: {reason}", _REPLACE) from error
    if not isinstance(state, dict):
        raise ParseError(path, "whole file", "contains no named weights.", _REPLACE)
    return state


def _tensor(state: dict[str, Any], path: Path, name: str, shape: tuple[int, ...]) -> torch.Tensor:
    import torch

    value = state.get(name)
    if not isinstance(value, torch.Tensor) or tuple(value.shape) != shape:
        raise ParseError(path, name, f"no weights of the shape {shape}.", _REPLACE)
    value = value.to(torch.float32)
    if not bool(torch.isfinite(value).all()):
        raise ParseError(path, name, "weights are not finite.", _REPLACE)
    return value
