# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy field evaluated by CUDA kernels on an NVIDIA GPU."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import DeviceError, ResourceError
from ..gaussians.model import GaussianArrays
from ..progress import Progress
from ..render.cuda.device_view import WARPS
from ..render.cuda.kernels import CameraValues, Kernels, cuda_available, device_kernels
from ..scene.camera import Camera
from .vacancy import POINTS_PER_PASS, TILE_PX, CameraBins, VacancyField

GPU_CACHE_SHARE = 0.25
"""Share of the GPU's free memory for prepared cameras; a pass of 2 million points takes about
0.2 GB in addition."""
POINTS_PER_WARP = 32
CELL_BITS = 8
"""Bits of a point's cell within its tile in the keys of ``locate_points``."""
_BYTES_PER_POINT = 90
"""Of a pass, while it is evaluated: an estimate."""
_BYTES_PER_GAUSSIAN = 120
"""Of the lists of one camera: an estimate."""
_MASK_MODES = {"ignore": 1, "background": 2}


def needed_bytes(gaussians: int) -> int:
    """Return the least GPU memory of a field: one pass of points and the lists of one camera.

    The lists count four times, as cameras are kept in a quarter of the memory that is free.
    """
    lists = round(gaussians * _BYTES_PER_GAUSSIAN / GPU_CACHE_SHARE)
    return POINTS_PER_PASS * _BYTES_PER_POINT + lists


@dataclass(frozen=True)
class _DeviceBins:
    """:class:`CameraBins` on the GPU."""

    rows: Tensor  # (m, 16) float32
    bounds: Tensor  # (m, 8) float32
    tile_start: Tensor  # (tiles + 1,) int64
    tile_ids: Tensor  # (intersections,) int32

    @classmethod
    def of(cls, bins: CameraBins, device: torch.device) -> _DeviceBins:
        arrays = (bins.rows, bins.bounds, bins.tile_start, bins.tile_ids)
        return cls(*(torch.from_numpy(array).to(device) for array in arrays))

    @property
    def size_bytes(self) -> int:
        tensors = (self.rows, self.bounds, self.tile_start, self.tile_ids)
        return sum(t.numel() * t.element_size() for t in tensors)


@dataclass(frozen=True)
class _Query:
    """Points of one pass and their current results, on the GPU."""

    points: Tensor  # (n, 3) float64; NaN outside of the region
    best: Tensor  # (n,) float32
    winner: Tensor  # (n,) int32
    seen: Tensor  # (n,) uint8
    screen: Tensor  # (n, 3) float32, filled for each camera
    keys: Tensor  # (n,) int32, filled for each camera

    @classmethod
    def of(
        cls,
        points: np.ndarray,
        inside: np.ndarray | None,
        best: np.ndarray,
        winner: np.ndarray,
        device: torch.device,
    ) -> _Query:
        if inside is not None:
            points = np.where(inside[:, None], points, np.nan)
        count = len(points)
        return cls(
            torch.tensor(points, device=device),
            torch.tensor(best, device=device),
            torch.tensor(winner, device=device),
            torch.zeros(count, dtype=torch.uint8, device=device),
            torch.empty((count, 3), device=device),
            torch.empty(count, dtype=torch.int32, device=device),
        )

    def read(self, best: np.ndarray, winner: np.ndarray, seen: np.ndarray | None) -> None:
        """Copy the results into arrays."""
        best[:] = self.best.cpu().numpy()
        winner[:] = self.winner.cpu().numpy()
        if seen is not None:
            seen |= self.seen.cpu().numpy() != 0


class CudaVacancyField(VacancyField):
    """:class:`VacancyField` with vacancy, occupancy and transmittance evaluated on a GPU.

    Definition, cut-offs, rules for unseen and masked points and the order of cameras are the same;
    values differ by float32 rounding, and by 1/255 of one Gaussian where rounding decides whether
    the ray lies inside the rim of its footprint. Results are the same in every run and do not
    depend on how points are split into calls, except where vacancy exceeds 0.999. The processor
    prepares the cameras.

    ``device`` is torch's: ``"cuda"`` selects its current GPU, whose kernels are the default.
    ``device_cache_bytes`` is GPU memory for prepared cameras, by default a quarter of the free
    memory; other cameras are transferred in each call. Other arguments as for
    :class:`VacancyField`.

    Raises
    ------
    UsageError
        As for :class:`VacancyField`.
    DeviceError
        There is no GPU, or its compiler or driver is missing or fails.
    """

    def __init__(
        self,
        arrays: GaussianArrays,
        cameras: Sequence[Camera],
        *,
        device: str | torch.device = "cuda",
        kernels: Kernels | None = None,
        device_cache_bytes: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(arrays, cameras, **options)
        self._torch_device = torch.device(device)
        if kernels is None:
            usable, reason = cuda_available(self._torch_device.index)
            if not usable:
                raise DeviceError(reason, "Evaluate vacancy on the processor.")
            index = self._torch_device.index
            index = torch.cuda.current_device() if index is None else index
            self._torch_device = torch.device("cuda", index)
            kernels = device_kernels(index)
        self.device = str(self._torch_device)
        self._kernels = kernels
        self._device_cache: dict[int, _DeviceBins] = {}
        self._device_masks: dict[int, Tensor] = {}
        if device_cache_bytes is None:
            device_cache_bytes = int(
                GPU_CACHE_SHARE * torch.cuda.mem_get_info(self._torch_device)[0]
            )
        self._device_cache_left = device_cache_bytes

    def prepare(self, progress: Progress | None = None) -> None:
        """Project and bin the Gaussians for all cameras now, and transfer them to the GPU."""
        progress = progress or Progress()
        with self._on_device():
            for done, index in enumerate(self.evaluation_order().tolist()):
                progress.update(done / len(self.cameras), "Preparing cameras")
                self._device_bins(index)

    # -- inside -----------------------------------------------------------------------------------

    def _raise_best(
        self,
        points: np.ndarray,
        settled: float,
        best: np.ndarray,
        winner: np.ndarray,
        seen: np.ndarray | None,
        progress: Progress,
    ) -> None:
        order = self.evaluation_order()
        with self._on_device():
            query = _Query.of(points, self._in_region(points), best, winner, self._torch_device)
            for done, index in enumerate(order.tolist()):
                self._evaluate_query(index, query, settled)
                progress.update((done + 1) / len(order), "Evaluating transmittance per camera")
            query.read(best, winner, seen)

    def _evaluate_camera(
        self,
        index: int,
        points: np.ndarray,
        inside: np.ndarray | None,
        settled: float,
        best: np.ndarray,
        winner: np.ndarray,
        seen: np.ndarray | None = None,
    ) -> None:
        with self._on_device():
            query = _Query.of(points, inside, best, winner, self._torch_device)
            self._evaluate_query(index, query, settled)
            query.read(best, winner, seen)

    def _evaluate_query(self, index: int, query: _Query, settled: float) -> None:
        """Raise the best values of the query's points by one camera."""
        view = self._screens[index]
        self._kernels.launch_each(
            "locate_points", len(query.points), query.points, CameraValues.of(view.packed),
            settled, TILE_PX, view.tiles_x, view.tiles_y, *self._mask_arguments(index), index,
            query.best, query.winner, query.seen, query.screen, query.keys,
        )  # fmt: skip
        keys, order = torch.sort(query.keys, stable=True)  # (n,)
        edges = torch.arange(view.tiles + 1, dtype=torch.int32, device=keys.device) << CELL_BITS
        point_start = torch.searchsorted(keys, edges)  # (tiles + 1,) int64
        group_start = torch.zeros_like(point_start)
        groups_in_tile = (point_start.diff() + (POINTS_PER_WARP - 1)) // POINTS_PER_WARP
        group_start[1:] = groups_in_tile.cumsum(0)
        groups = int(group_start[-1])  # synchronises with the GPU
        if groups == 0:
            return
        bins = self._device_bins(index)
        assert bins is not None, "a camera that sees a point of the region sees the region"
        self._kernels.launch(
            "transmittance_tiles", -(-groups // WARPS), view.tiles, index, group_start,
            point_start, order, query.screen, bins.rows, bins.bounds, bins.tile_start,
            bins.tile_ids, query.best, query.winner,
        )  # fmt: skip

    def _mask_arguments(self, index: int) -> tuple[Tensor, int, int, int]:
        """Return the camera's mask, its mode (0: none), its width and height."""
        mask = self._masks[index]
        if mask is None:
            return torch.empty(0, dtype=torch.uint8, device=self._torch_device), 0, 0, 0
        sent = self._device_masks.get(index)
        if sent is None:
            sent = torch.tensor(mask.unpacked().view(np.uint8), device=self._torch_device)
            if sent.numel() <= self._device_cache_left:
                self._device_masks[index] = sent
                self._device_cache_left -= sent.numel()
        height, width = mask.shape
        return sent, _MASK_MODES[self._mask_mode], width, height

    def _device_bins(self, index: int) -> _DeviceBins | None:
        if index in self._device_cache:
            return self._device_cache[index]
        bins = self._bins(index)
        if bins is None:
            return None
        sent = _DeviceBins.of(bins, self._torch_device)
        if sent.size_bytes <= self._device_cache_left:
            self._device_cache[index] = sent
            self._device_cache_left -= sent.size_bytes
        return sent

    @contextlib.contextmanager
    def _on_device(self) -> Iterator[None]:
        """Convert torch's out-of-memory error to :class:`ResourceError`."""
        try:
            yield
        except torch.OutOfMemoryError as error:
            raise ResourceError(
                f"The GPU has too little memory for the vacancy field of {len(self.arrays)} "
                f"Gaussians: {error}.",
                "Close other programs that use the GPU, or mesh on the processor (--device cpu).",
            ) from None
