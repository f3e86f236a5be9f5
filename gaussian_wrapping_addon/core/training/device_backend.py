# SPDX-License-Identifier: GPL-3.0-or-later
"""An iteration on a GPU, and the choice of a backend."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..devices.checks import is_device_failure
from ..errors import WrapError
from ..render.cuda.device_renderer import DeviceRenderer, free_budget_bytes
from ..render.cuda.device_view import IMAGES, DeviceView
from ..render.cuda.kernels import Kernels, device_kernels
from ..render.types import ImageGradients, RenderOptions
from ..scene.camera import Camera
from ..scene.scene import PhotoSource
from ..stereo.depth_maps import DepthPrior
from .adam import Adam
from .backend import Backend, Shown, Window, counts_of
from .camera_poses import LEFT
from .cpu_backend import CpuBackend
from .density import DensityStatistics, DeviceDensityStatistics
from .device_adam import DeviceAdam
from .device_losses import (
    device_color_loss,
    device_multi_view_losses,
    device_normal_losses,
    device_prior_loss,
)
from .exposure import PIVOT, Exposure
from .losses import FAINT, SURE
from .multi_view import MultiViewOptions, PhotoView

# -- Photos and masks kept on a device, so that an iteration sends none that it has ---------------


class DevicePhotos:
    """The photos used last, up to a number of bytes.

    Parameters
    ----------
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


# -- The backend of a GPU: tensors, and the CUDA kernels of ``core/render/cuda`` ------------------
#
# Nothing of the size of an image or of the Gaussians leaves the device in an iteration. It runs
# on the host's memory as well, with kernels that are emulated there, which is how it is tested
# without a GPU.

PHOTO_SHARE = 0.2
"""Share of the free device memory in which photos are kept."""

BUDGET_RENDERS = 100
"""Renders after which the free memory is asked for again."""

Gradients = dict[str, Tensor]


class DeviceBackend(Backend):
    """Runs on a device such as "cuda:0"; methods as in :class:`.Backend`.

    ``free_bytes`` returns the device memory that tile intersections may take now, ``photo_bytes``
    is that for photos.
    """

    def __init__(
        self, name: str, kernels: Kernels, device: torch.device, free_bytes: Callable[[], int],
        photo_bytes: int,
    ) -> None:  # fmt: skip
        self.name, self.kernels, self.device = name, kernels, device
        self._free_bytes, self._budget, self._renders = free_bytes, 0, 0
        self.budget_share = 1.0
        """Factor on the memory for tile intersections, lowered after it did not suffice."""
        self.renderer = DeviceRenderer(kernels, device, self._budget_bytes)
        self._photos, self._prior_bytes = DevicePhotos(device, photo_bytes), photo_bytes // 4
        self._priors: dict[int, tuple[DepthPrior, tuple[Tensor, Tensor, Camera]]] = {}
        self._exposed: tuple[Exposure, int, Tensor] | None = None

    @classmethod
    def of_gpu(cls, index: int) -> DeviceBackend:
        """Return the backend of a GPU.

        Raises
        ------
        DeviceError
            If the compiler or the driver is missing or fails.
        """
        device = torch.device("cuda", index)
        kernels = device_kernels(index)
        free, _ = torch.cuda.mem_get_info(device)
        return cls(
            f"cuda:{index}", kernels, device, lambda: free_budget_bytes(device),
            int(PHOTO_SHARE * free),
        )  # fmt: skip

    def _budget_bytes(self) -> int:
        if self._renders % BUDGET_RENDERS == 0:
            self._budget = int(self.budget_share * self._free_bytes())
        self._renders += 1
        return self._budget

    def adopted(self, adam: Adam) -> DeviceAdam:
        if isinstance(adam, DeviceAdam) and adam.device == self.device:
            return adam
        return DeviceAdam(adam, self.kernels, self.device)

    def adopted_statistics(self, statistics: DensityStatistics) -> DeviceDensityStatistics:
        if isinstance(statistics, DeviceDensityStatistics) and statistics.device == self.device:
            return statistics
        return DeviceDensityStatistics(statistics, self.device)

    def shown(self, photos: PhotoSource, view: int, divisor: int, window: Window | None) -> Shown:
        return self._photos.shown(photos, view, divisor, window)

    def render(self, adam: Adam, camera: Camera, options: RenderOptions) -> DeviceView:
        assert isinstance(adam, DeviceAdam)
        self.renderer.release()  # rounds are over
        return DeviceView(self.kernels, adam.on_device(), camera, options, self._budget_bytes())

    def compare_colors(
        self, image: DeviceView, shown: Shown, lambda_dssim: float, *,
        exposure: tuple[Exposure, int] | None, background: np.ndarray | None, over_emptiness: bool,
    ) -> tuple[Tensor, ImageGradients, Tensor]:  # fmt: skip
        color, mask = image.color, shown.mask
        photo = shown.photo.to(torch.float32).mul_(1.0 / 255.0)
        counts = (shown.pixels, shown.windows)
        cover = image.alpha[..., None] if over_emptiness else 1.0  # (h, w, 1)
        if exposure is not None:
            gains, offsets = (self._sent(f) for f in exposure[0].factors(exposure[1], np.float32))
            color = color * gains + offsets * cover
        if background is not None:
            behind = self._sent(background)
            color = color + (1.0 - image.alpha[..., None]) * behind
            if mask is not None:
                photo = torch.where(mask[..., None], photo, behind)
            height, width = image.alpha.shape
            mask = None
            counts = counts_of(None, height, width)
        value, by_color, squared = device_color_loss(
            self.kernels, color.contiguous(), photo, mask, lambda_dssim=lambda_dssim, counts=counts
        )
        by_alpha = None if background is None else -(by_color @ self._sent(background))
        if exposure is not None:
            by_gain = (by_color * image.color).sum((0, 1))  # (3,)
            by_offset = (by_color * cover).sum((0, 1))
            summed = torch.cat([gains * (by_gain - PIVOT * by_offset), by_offset])
            self._exposed = (*exposure, summed)
            if by_alpha is not None and over_emptiness:
                by_alpha = by_alpha + by_color @ offsets
            by_color = by_color * gains
        return value, ImageGradients(color=by_color, alpha=by_alpha), squared

    def normal_losses(
        self, image: DeviceView, camera: Camera, shown: Shown, *, lambda_depth_normal: float,
        lambda_normal: float,
    ) -> tuple[Tensor, ImageGradients]:  # fmt: skip
        return device_normal_losses(
            self.kernels, image.depth, image.geometric_normal, image.normal, image.alpha, camera,
            shown.mask, lambda_depth_normal=lambda_depth_normal, lambda_normal=lambda_normal,
            pixels=shown.pixels,
        )  # fmt: skip

    def prior_loss(
        self, image: DeviceView, camera: Camera, prior: DepthPrior, shown: Shown, weight: float
    ) -> tuple[Tensor, ImageGradients]:
        held = self._priors.get(id(prior))
        if held is None or held[0] is not prior:
            sent = (self._sent(prior.depth), self._sent(prior.confidence), prior.camera)
            # Where they take too much, all others are given up first.
            if sum(8 * kept.depth.size for kept, _ in self._priors.values()) > self._prior_bytes:
                self._priors.clear()
            held = self._priors[id(prior)] = (prior, sent)
        return device_prior_loss(
            self.kernels, image.depth, camera, held[1], shown.mask,
            weight=weight, pixels=shown.pixels,
        )  # fmt: skip

    def compare_views(
        self, image: DeviceView, adam: Adam, camera: Camera, shown: Shown, other_camera: Camera,
        other: Shown, options: MultiViewOptions, random: np.random.Generator,
    ) -> tuple[Tensor, ImageGradients, Gradients | None]:  # fmt: skip
        assert isinstance(adam, DeviceAdam)
        found = device_multi_view_losses(
            self.kernels, image, adam.on_device(), PhotoView(camera, shown.photo, shown.mask),
            PhotoView(other_camera, other.photo, other.mask), options, random,
        )  # fmt: skip
        return found.value, found.gradients, found.other

    def backward(self, image: DeviceView, gradients: ImageGradients) -> Gradients:
        """Return the gradients on all Gaussians, 0 for those not seen."""
        incoming: list[Any] = [getattr(gradients, name) for name in IMAGES]
        return image.backward([None if g is None else g.contiguous() for g in incoming])

    def add_priors(
        self, image: DeviceView, gradients: Gradients, adam: Adam, price: float,
        opacity_weight: float,
    ) -> None:  # fmt: skip
        if price <= 0.0 and opacity_weight <= 0.0:
            return
        assert isinstance(adam, DeviceAdam)
        gaussians = adam.on_device()
        height, width = image.alpha.shape
        boxes = image.screen.boxes  # (n, 4); those of Gaussians not seen were never written
        wide, high = (
            boxes[:, axis + 2].clamp(0.0, limit) - boxes[:, axis].clamp(0.0, limit)
            for axis, limit in enumerate((width, height))
        )
        area = torch.where(image.statistics.reached, wide * high, 0.0)
        shares = area / float(width * height)
        if price > 0.0:
            squares = torch.exp(2.0 * gaussians.log_scales)  # (n, 3)
            squares *= (2.0 * price * shares / squares.sum(1))[:, None]
            # A scale too large for float32 belongs to no Gaussian that is seen.
            gradients["log_scales"] += torch.where(shares[:, None] > 0.0, squares, 0.0)
        if opacity_weight > 0.0:
            by_logits = gradients["opacity_logits"]
            # The optimizer takes a 0 for a Gaussian not seen.
            asked = shares * (by_logits != 0.0)
            opacity = torch.sigmoid(gaussians.opacity_logits)
            ramp = ((opacity - FAINT) / (SURE - FAINT)).clamp(0.0, 1.0)
            by_logits -= 4.0 * opacity_weight * asked * ramp * opacity * (1.0 - opacity)

    def pose_gradient(self, camera: Camera, gradients: Gradients, adam: Adam) -> Tensor:
        assert isinstance(adam, DeviceAdam)
        gaussians = adam.on_device()
        pose = torch.from_numpy(np.array(camera.cam_from_world, np.float64)).to(self.device)
        rotation, translation = pose[:, :3], pose[:, 3]
        by_means = gradients["means"].double()  # (n, 3)
        force = by_means.sum(0)
        outer = gaussians.means.double().T @ by_means
        local = rotation @ outer @ rotation.T + torch.outer(translation, rotation @ force)
        odd = local - local.T
        torque = torch.stack([odd[1, 2], odd[2, 0], odd[0, 1]])
        turned = gradients["quats"].double().T @ gaussians.quats.double()  # (4, 4)
        left = torch.from_numpy(LEFT).to(self.device)  # (3, 4, 4)
        torque = torque + rotation @ (0.5 * (left * turned).sum((1, 2)))
        return torch.cat([torque, rotation @ force])

    def merged(self, gradients: Gradients, other: Gradients, count: int) -> Gradients:
        """Add the second gradients to the first."""
        for name, tensor in other.items():
            gradients[name] += tensor
        return gradients

    def add_statistics(
        self, statistics: DensityStatistics, image: DeviceView, width: int, height: int,
        part: float,
    ) -> None:  # fmt: skip
        assert isinstance(statistics, DeviceDensityStatistics)
        statistics.add_view(image, width, height, part)

    def step(
        self, adam: Adam, gradients: Gradients, rates: Mapping[str, np.ndarray], sh_degree: int
    ) -> None:
        assert isinstance(adam, DeviceAdam)
        adam.step_all(gradients, rates, sh_degree=sh_degree)

    def numbers(self, *values: Any) -> list[np.ndarray]:
        """Return the values as numpy arrays, in one copy; completes the exposure's gradient."""
        tensors = [torch.as_tensor(v, device=self.device).double().reshape(-1) for v in values]
        if self._exposed is not None:
            tensors.append(self._exposed[2].double())
        flat = torch.cat(tensors).cpu().numpy()
        parts = np.split(flat, np.cumsum([len(tensor) for tensor in tensors])[:-1])
        if self._exposed is not None:
            self._exposed[0].gradient[:] = parts.pop()
            self._exposed = None
        return [part if np.ndim(v) else part[0] for part, v in zip(parts, values, strict=True)]

    def use_less_memory(self) -> bool:
        """Halve the memory for tile intersections and give up the photos kept, once."""
        if self.budget_share < 1.0:
            return False
        self.budget_share = 0.5
        self._photos.limit_bytes = 0
        self._photos.clear()
        self._priors.clear()
        self._prior_bytes = 0
        self.release()
        return True

    def release(self) -> None:
        """Free the device memory of what rounds rendered, and what torch keeps for later."""
        self.renderer.release()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        self._renders = 0

    def _sent(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.array(array, np.float32)).to(self.device, non_blocking=True)


# -- The backend of a chosen device ---------------------------------------------------------------

_logger = logging.getLogger(__name__)


def chosen_backend(device: str, threads: int, *, or_processor: bool = False) -> Backend:
    """Return the backend of "cpu", or of a GPU such as "cuda:0".

    Where the GPU fails, ``or_processor`` returns the processor's, and logs why.

    Raises
    ------
    DeviceError
        If the GPU's compiler or driver is missing or fails.
    """
    if device == "cpu":
        return CpuBackend(threads)
    try:
        return DeviceBackend.of_gpu(int(device.partition(":")[2] or 0))
    except (WrapError, RuntimeError) as error:
        if not (or_processor and is_device_failure(error)):
            raise
        _logger.warning("%s failed (%s): training on the processor", device, error)
        return CpuBackend(threads)
