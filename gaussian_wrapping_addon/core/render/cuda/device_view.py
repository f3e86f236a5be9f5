# SPDX-License-Identifier: GPL-3.0-or-later
"""One view rendered on a device: images, statistics and gradients as tensors that stay there."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from ... import tolerances
from ...dataset.camera import Camera
from ...errors import ResourceError, UsageError
from ...gaussians.model import TRAINED, OrientedGaussians
from ..types.options import RenderOptions
from .kernels import Kernels
from .tile_lists import (
    ROW_VALUES,
    WARPS,
    Band,
    DeviceScreen,
    RawTensors,
    bin_bands,
    project,
)

IMAGES = ("color", "normal", "geometric_normal", "alpha", "depth")


@dataclass(frozen=True)
class DeviceImages:
    """Images that the kernels write, float32."""

    color: Tensor  # (h, w, 3)
    normal: Tensor  # (h, w, 3)
    geometric_normal: Tensor  # (h, w, 3)
    alpha: Tensor  # (h, w)
    depth: Tensor  # (h, w)
    slope: Tensor  # (h, w); (0,) without depth
    strongest: Tensor  # (h, w) int32; (0,) without statistics

    @classmethod
    def allocate(cls, camera: Camera, options: RenderOptions, device: torch.device) -> DeviceImages:
        """Return images for the kernels to fill; depth is 0 unless it is solved."""
        shape = (camera.height, camera.width)
        return cls(
            torch.empty((*shape, 3), device=device),
            torch.empty((*shape, 3), device=device),
            torch.empty((*shape, 3), device=device),
            torch.empty(shape, device=device),
            torch.zeros(shape, device=device),
            torch.empty(shape if options.depth else (0,), device=device),
            torch.empty(shape if options.statistics else (0,), dtype=torch.int32, device=device),
        )


@dataclass
class DeviceStatistics:
    """:class:`~..types.images.RenderStatistics` as tensors; the weights are (0,) if not asked for.

    ``grad_px`` and ``grad_abs_px`` are filled by the backward pass.
    """

    reached: Tensor  # (n,) bool: has a tile in the image
    weight_sum: Tensor  # (n,) or (0,)
    weight_max: Tensor  # (n,) or (0,)
    grad_px: Tensor  # (n,) or (0,)
    grad_abs_px: Tensor  # (n,) or (0,)

    @classmethod
    def zeros(cls, count: int, options: RenderOptions, device: torch.device) -> DeviceStatistics:
        """Return statistics of ``count`` Gaussians before the first band."""
        weighed = count if options.statistics else 0
        gathered = count if options.gathers_statistics else 0
        return cls(
            torch.zeros(count, dtype=torch.bool, device=device),
            torch.zeros(weighed, device=device),
            torch.zeros(weighed, device=device),
            torch.zeros(gathered, device=device),
            torch.zeros(gathered, device=device),
        )


class DeviceView:
    """A rendered view, and what its backward pass needs.

    Parameters
    ----------
    kernels : Kernels
        Of the tensors' device.
    gaussians : OrientedGaussians
        float32 tensors on one device, scene frame. They must not change before :meth:`backward`.
    camera : Camera
        Scene frame.
    options : RenderOptions
        ``threads`` and ``budget_bytes``, which is for the CPU's lists, are not used.
    budget_bytes : int
        Device memory for tile intersections.

    Raises
    ------
    UsageError
        If a tensor is not float32 or on another device.
    ResourceError
        If the device memory does not suffice.
    """

    def __init__(
        self,
        kernels: Kernels,
        gaussians: OrientedGaussians,
        camera: Camera,
        options: RenderOptions,
        budget_bytes: int,
    ) -> None:
        device = gaussians.means.device
        for name, tensor in gaussians.tensors():
            if tensor.dtype != torch.float32 or tensor.device != device:
                raise UsageError(
                    f"{name} of the Gaussians is {tensor.dtype} on {tensor.device}.",
                    f"Give float32 on {device}.",
                )
        self._kernels, self.camera, self.options = kernels, camera, options
        with translated_out_of_memory(camera):
            self._raw = RawTensors.of(gaussians, camera, options)
            self.screen: DeviceScreen = project(kernels, self._raw)
            self.images = DeviceImages.allocate(camera, options, device)
            self.statistics = DeviceStatistics.zeros(len(gaussians), options, device)
            self.band_lists: list[Band] = []
            """What the bands of tile rows in which the image was rendered hold."""
            for band in bin_bands(kernels, self.screen, camera, budget_bytes):
                self._blend(band)
                self.band_lists.append(band)

    color = property(lambda self: self.images.color)
    normal = property(lambda self: self.images.normal)
    geometric_normal = property(lambda self: self.images.geometric_normal)
    alpha = property(lambda self: self.images.alpha)
    depth = property(lambda self: self.images.depth)

    def __len__(self) -> int:
        return len(self.screen.params)

    def radii_px(self) -> Tensor:
        """Return (n,) half of the longer side of each screen box, 0 for Gaussians not seen."""
        sides = (self.screen.boxes[:, 2:] - self.screen.boxes[:, :2]).amax(1)  # (n,)
        return torch.where(self.statistics.reached, 0.5 * sides, 0.0)

    def _blend(self, band: Band) -> None:
        kernels, screen, images, sums = self._kernels, self.screen, self.images, self.statistics
        weighed = self.options.statistics
        weights = screen.params.new_zeros((len(band.gaussian_ids) if weighed else 0, 2))
        kernels.launch(
            "forward_tiles_weights" if weighed else "forward_tiles",
            band.tiles,
            screen.params,
            screen.boxes,
            screen.skews,
            band.start,
            band.gaussian_ids,
            band.intersection_slots,
            *self._geometry(band),
            *(float(value) for value in self.options.background),
            images.color,
            images.normal,
            images.geometric_normal,
            images.alpha,
            band.masks,
            weights,
            images.strongest,
        )
        sums.reached.logical_or_(band.intersection_offsets.diff() > 0)
        if weighed:
            kernels.launch_each(
                "sum_weights",
                len(screen.params),
                weights,
                band.intersection_offsets,
                sums.weight_sum,
                sums.weight_max,
            )
        if self.options.depth:
            kernels.launch(
                "isosurface_tiles",
                band.tiles,
                screen.params,
                band.start,
                band.gaussian_ids,
                band.masks,
                *self._geometry(band),
                float(self.options.depth_valid_transmittance),
                images.alpha,
                images.depth,
                images.slope,
            )

    def params_gradient(self, incoming: list[Tensor | None]) -> Tensor:
        """Return the (n, 24) gradient on the screen params.

        Parameters
        ----------
        incoming : list of tensors
            Contiguous gradients on the five images in the order of :data:`IMAGES`; ``None`` for
            zeros.
        """
        outputs = [getattr(self.images, name) for name in IMAGES]
        with_depth = self.options.depth and incoming[4] is not None
        gathers = self.options.gathers_statistics
        name = "backward_tiles" + ("_depth" if with_depth else "")
        name += "_absolute" if gathers else ""
        given = [
            torch.zeros_like(output) if grad is None else grad
            for output, grad in zip(outputs, incoming, strict=True)
        ]
        params, kernels = self.screen.params, self._kernels
        grad_params = torch.zeros_like(params)  # (n, 24)
        for band in self.band_lists:
            rows = params.new_empty((len(band.gaussian_ids), ROW_VALUES))
            kernels.launch(
                name,
                band.tiles,
                params,
                band.start,
                band.gaussian_ids,
                band.intersection_slots,
                band.masks,
                *self._geometry(band),
                *outputs,
                self.images.slope,
                *given,
                rows,
            )
            blocks = -(-len(params) // WARPS)
            kernels.launch(
                "sum_pairs", blocks, len(params), rows, band.intersection_offsets, grad_params
            )
        kernels.launch_each(
            "finish_params",
            len(params),
            int(gathers),
            grad_params,
            self.statistics.grad_px,
            self.statistics.grad_abs_px,
        )
        return grad_params

    def backward(self, incoming: list[Tensor | None]) -> dict[str, Tensor]:
        """Return the gradients of the trained tensors, rows of 0 for Gaussians not seen.

        Parameters
        ----------
        incoming : list of tensors
            As for :meth:`params_gradient`.
        """
        with translated_out_of_memory(self.camera):
            grad_params = self.params_gradient(incoming)
            return self.gaussian_gradients(grad_params)

    def gaussian_gradients(self, grad_params: Tensor) -> dict[str, Tensor]:
        """Return the gradients of the trained tensors from those of the screen params (n, 24)."""
        raw = self._raw
        found = {name: torch.zeros_like(getattr(raw.gaussians, name)) for name in TRAINED}
        self._kernels.launch_each(
            "project_backward",
            len(grad_params),
            *raw.arguments(),
            self.screen.visible,
            grad_params,
            *found.values(),
        )
        return found

    def _geometry(self, band: Band) -> tuple[int, int, int, int]:
        """Return tiles per row, the band's first tile row, and the image size in pixels."""
        camera = self.camera
        tiles_x = -(-camera.width // tolerances.TILE_PX)
        return tiles_x, band.first_row, camera.width, camera.height


@contextlib.contextmanager
def translated_out_of_memory(camera: Camera) -> Iterator[None]:
    """Translate torch's out-of-memory error into a ``ResourceError``."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise ResourceError(
            f"GPU memory does not suffice for view {camera.name!r}: {error}.",
            "Use smaller images or fewer Gaussians, or render on the CPU.",
        ) from None
