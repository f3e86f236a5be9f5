# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks made: silhouettes of a region, segmentation models."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage

from ..errors import DatasetError
from ..gaussians.model import OrientedGaussians
from ..limits import NEAR_Z
from ..render.projection import RawArrays
from ..render.types import Renderer, RenderOptions
from ..scene.camera import Camera
from ..scene.scene import PhotoSource, Scene
from ..training.start import LEAST_REACH, onto_sphere
from ..worker.environment import load_extra
from .mask_folder import check_model_file

# -- Start points far away wherever a photo has no sparse points: plain walls, sky ----------------
#
# Without them, training explains a plain background by fog around the object, inside the region.


CELL_PX = 8
"""Side of the cells that are looked at, pixels of the photos."""
MOST_POINTS = 8000
LEAST_POINTS = 5000
"""Start points, at least: with fewer, training invents some between the others, near the object."""


def with_background(scene: Scene, photos: PhotoSource, *, seed: int) -> Scene:
    """Return the scene with points on a sphere around everything.

    They are in the direction of pixels drawn by chance, where neither the cell nor its neighbours
    show a sparse point; where that gives too few, of all pixels.

    Parameters
    ----------
    photos : PhotoStore
        Small photos of the scene's views.
    """
    random = np.random.default_rng([seed, 7])
    tried = -(-(MOST_POINTS + LEAST_POINTS) // len(scene.views))  # a photo
    found, colors, is_open = [], [], []
    for index in range(len(scene.views)):
        camera, photo, mask = photos.camera(index), photos.photo(index), photos.mask(index)
        row, column = random.integers(0, [[camera.height], [camera.width]], (2, tried))
        if mask is not None:
            row, column = row[mask[row, column]], column[mask[row, column]]
        rays = camera.rays_at(np.stack([column, row], 1) + 0.5) @ camera.rotation
        found.append(onto_sphere(camera.center, rays, LEAST_REACH) * LEAST_REACH)
        colors.append(photo[row, column])
        is_open.append(~_near_points(camera, scene.points)[row // CELL_PX, column // CELL_PX])
    points, color, opened = (np.concatenate(parts) for parts in (found, colors, is_open))
    order = random.permutation(len(opened))
    order = order[np.argsort(~opened[order], kind="stable")]  # open ones first
    wanted = max(min(MOST_POINTS, int(opened.sum())), LEAST_POINTS - len(scene.points))
    chosen = np.sort(order[:wanted])
    return dataclasses.replace(
        scene,
        points=np.concatenate([scene.points, points[chosen]]),
        point_colors=np.concatenate([scene.point_colors, color[chosen]]),
    )


def _near_points(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return (rows, columns) bool: the cells of a photo with a point, and those around them."""
    _, row, column, _ = camera.shown(points)
    shown = np.zeros((-(-camera.height // CELL_PX) + 2, -(-camera.width // CELL_PX) + 2), bool)
    shown[row // CELL_PX + 1, column // CELL_PX + 1] = True
    wide = shown[:-2] | shown[1:-1] | shown[2:]
    return np.asarray(wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:])


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
    kept = _without_thin_spots(_large_parts(whole >= THRESHOLD), whole)
    if not grown_share:
        return kept
    radius = max(1, round(grown_share * max(size)))
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return np.asarray(ndimage.binary_dilation(kept, x * x + y * y <= radius * radius))


def _large_parts(mask: np.ndarray) -> np.ndarray:
    label, count = ndimage.label(mask)
    if count < 2:
        return mask
    areas = np.bincount(label.ravel())
    areas[0] = 0
    return np.asarray((areas >= SMALLEST_SHARE * areas.max())[label] & mask)


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


# -- Silhouettes of the Gaussians that stand in a region, as photos show them ---------------------


WHITE = 0.5 / (0.5 / math.sqrt(math.pi))
"""Coefficient of the constant harmonic of a Gaussian whose colour is 1; minus that, of colour 0."""
CLEAR_SHARE = 0.5
"""Share of the way from a camera to the regions in which nothing stands."""


def marked(gaussians: OrientedGaussians, inside: np.ndarray) -> RawArrays:
    """Return Gaussians that are white where ``inside`` (n,) bool, and black elsewhere."""
    sign = torch.from_numpy(np.where(inside, WHITE, -WHITE).astype(np.float32))  # (n,)
    sh = sign[:, None, None].expand(-1, 1, 3).contiguous()
    return RawArrays.from_gaussians(gaussians.detached().replaced(sh=sh.to(gaussians.sh.dtype)))


def silhouettes(
    gaussians: OrientedGaussians,
    inside: np.ndarray,
    cameras: Sequence[Camera],
    renderer: Renderer,
    *,
    bounds: np.ndarray | None = None,
    threads: int,
) -> Iterator[np.ndarray]:
    """Yield how much of each pixel shows what is inside, (h, w) float32 in [0, 1] a camera.

    The share is the sum of the blending weights of the Gaussians inside: what stands in front of
    them takes its part of the light, and so does what they let through.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    inside : (n,) bool
        Gaussians that belong to the object.
    cameras : sequence of Camera
        Scene frame; silhouettes have their size.
    bounds : (n, 3), optional
        Corners of the regions, scene frame. What is nearer to a camera than half of the way to
        them hides nothing: a short training leaves fog right before single cameras.
    """
    arrays = marked(gaussians, inside)
    for camera in cameras:
        options = RenderOptions(
            depth=False, sh_degree=0, threads=threads, near_z=_near_z(camera, bounds)
        )
        color = renderer.render(arrays, camera, options).color
        yield np.clip(color[..., 0], 0.0, 1.0)


def _near_z(camera: Camera, bounds: np.ndarray | None) -> float:
    """Return the z-depth from which on Gaussians are rendered."""
    if bounds is None:
        return NEAR_Z
    return max(NEAR_Z, CLEAR_SHARE * float(camera.to_camera(bounds)[:, 2].min()))


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
            raise DatasetError(
                f"{path.name} cannot be read as an ONNX model ({_first_line(error)}).", _WANTED
            ) from None
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

        Parameters
        ----------
        color : (h, w, 3) uint8
            A photo of any size; it is stretched to the model's, and so is the result.

        Raises
        ------
        DatasetError
            The model fails, or its output has another shape or is not finite.
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
        if (
            values.dtype.kind != "f"
            or values.ndim not in (3, 4)
            or (values.ndim == 4 and (values.shape[1] != 1))
        ):
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
