# SPDX-License-Identifier: GPL-3.0-or-later
"""Projection of Gaussians onto the screen of a camera, and its analytic gradient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from ...dataset.camera import Camera
from ...errors import UsageError
from ...gaussians.model import GaussianArrays, OrientedGaussians
from ...kernels.parallel import default_threads, even_bounds, run_chunks
from ..types.gradients import VisibleGradients
from ..types.options import RenderOptions
from .harmonics_kernels import MAX_DEGREE
from .projection_backward import backward_range
from .projection_kernels import (
    CAMERA_VALUES,
    PARAM_COLUMNS,
    project_activated_range,
    project_raw_range,
)


@dataclass(frozen=True)
class RawArrays:
    """The raw parameters of :class:`OrientedGaussians` as C-contiguous arrays of one float type.

    float32 and float64 are both read without conversion.
    """

    means: np.ndarray  # (n, 3)
    log_scales: np.ndarray  # (n, 3)
    quats: np.ndarray  # (n, 4)
    opacity_logits: np.ndarray  # (n,)
    sh: np.ndarray  # (n, k, 3)
    orientation: np.ndarray  # (n, 4)
    filter_3d: np.ndarray  # (n,)

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def from_gaussians(cls, gaussians: OrientedGaussians) -> RawArrays:
        """Share the memory of contiguous CPU tensors; copy others."""

        def array(tensor: Tensor) -> np.ndarray:
            return tensor.detach().cpu().contiguous().numpy()

        return cls(**{name: array(tensor) for name, tensor in gaussians.tensors()})

    def arguments(self) -> tuple[np.ndarray, ...]:
        """Return the arrays in the argument order of the kernels."""
        return (
            self.means, self.log_scales, self.quats, self.opacity_logits, self.sh,
            self.orientation, self.filter_3d,
        )  # fmt: skip


@dataclass(frozen=True)
class RawGradients:
    """Gradients of a scalar with respect to :class:`RawArrays` (``filter_3d`` is a constant)."""

    means: np.ndarray  # (n, 3)
    log_scales: np.ndarray  # (n, 3)
    quats: np.ndarray  # (n, 4)
    opacity_logits: np.ndarray  # (n,)
    sh: np.ndarray  # (n, k, 3)
    orientation: np.ndarray  # (n, 4)

    @classmethod
    def zeros(cls, gaussians: RawArrays) -> RawGradients:
        """Return zero gradients of the Gaussians' shapes and float type."""
        names = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
        return cls(**{name: np.zeros_like(getattr(gaussians, name)) for name in names})


@dataclass(frozen=True)
class ScreenGaussians:
    """Gaussians on the screen of one camera; layout in ``docs/architecture.md``.

    Of Gaussians that are not visible only ``visible`` and ``depths`` (inf) are written. Their other
    values are those that the arrays held before, which are finite: 0, or another view's values.
    """

    params: np.ndarray
    """(n, 24) float32; undefined where not visible."""
    boxes: np.ndarray
    """(n, 4) float32: x0 y0 x1 y1 of the ellipse ``alpha >= 1/255``, pixels, rounded outwards;
    undefined where not visible."""
    visible: np.ndarray
    """(n,) bool: the box contains a pixel centre of the image."""
    depths: np.ndarray
    """(n,) float32: distance from the camera to the mean, the sort key of the blending order; inf
    where not visible."""
    skews: np.ndarray
    """(n,) float32: x offset from the box's centre to the ellipse's lowest point (largest y),
    pixels; inf where the ellipse is unbounded and the box is the whole image; undefined where not
    visible."""

    def __len__(self) -> int:
        return len(self.params)

    @classmethod
    def allocate(cls, count: int) -> ScreenGaussians:
        """Return arrays for ``count`` Gaussians, none visible; pass them as ``out`` to reuse."""
        return cls(
            np.zeros((count, PARAM_COLUMNS), np.float32),
            np.zeros((count, 4), np.float32),
            np.zeros(count, np.bool_),
            np.full(count, np.inf, np.float32),
            np.zeros(count, np.float32),
        )

    def arguments(self) -> tuple[np.ndarray, ...]:
        """Return the arrays in the argument order of the kernels."""
        return self.params, self.boxes, self.visible, self.depths, self.skews


def pack_camera(camera: Camera, near_z: float) -> np.ndarray:
    """Return the (22,) float64 camera vector of the projection kernels."""
    values = np.zeros(CAMERA_VALUES)
    values[0:9] = camera.rotation.reshape(-1)
    values[9:12] = camera.cam_from_world[:, 3]
    values[12:15] = camera.center
    values[15:19] = camera.fx, camera.fy, camera.cx, camera.cy
    values[19:22] = camera.width, camera.height, near_z
    return values


def used_degree(coefficients: int, options: RenderOptions) -> int:
    """Return the degree of the harmonics that a rendering uses.

    Raises
    ------
    UsageError
        If ``coefficients`` is not 1, 4, 9 or 16.
    """
    stored = round(coefficients**0.5) - 1
    if (stored + 1) ** 2 != coefficients or not 0 <= stored <= MAX_DEGREE:
        raise UsageError(
            f"Gaussians hold {coefficients} harmonics coefficients.", "Give 1, 4, 9 or 16."
        )
    return stored if options.sh_degree is None else max(0, min(stored, options.sh_degree))


def project_gaussians(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    out: ScreenGaussians | None = None,
) -> ScreenGaussians:
    """Activate and project raw Gaussians, in float64 (docs/method.md, sections 1.5 and 2.3).

    Parameters
    ----------
    gaussians : RawArrays
        Scene frame, scene units.
    camera : Camera
        In the scene frame.
    options : RenderOptions
        ``near_z``, ``sh_degree`` and ``threads`` are used.
    out : ScreenGaussians, optional
        Output arrays of the same length; then only a few kilobytes are allocated.

    Returns
    -------
    ScreenGaussians
        Not visible are Gaussians nearer than ``near_z``, fainter than 1/255, outside the image,
        between pixel centres, or with non-finite values.
    """
    count = len(gaussians)
    screen = _output(count, out)
    packed = pack_camera(camera, options.near_z)
    degree = used_degree(gaussians.sh.shape[1], options)
    threads = options.threads or default_threads()

    def run(begin: int, end: int) -> None:
        project_raw_range(
            begin,
            end,
            *gaussians.arguments(),
            degree,
            packed,
            *screen.arguments(),
        )

    run_chunks(run, even_bounds(count, threads), threads)
    return screen


def project_arrays(
    arrays: GaussianArrays,
    camera: Camera,
    near_z: float,
    *,
    threads: int = 0,
    out: ScreenGaussians | None = None,
) -> ScreenGaussians:
    """Project activated Gaussians like :func:`project_gaussians`; the colour columns are 0."""
    count = len(arrays)
    screen = _output(count, out)
    packed = pack_camera(camera, near_z)
    threads = threads or default_threads()

    def run(begin: int, end: int) -> None:
        project_activated_range(
            begin,
            end,
            arrays.means,
            arrays.scales,
            arrays.rotations,
            arrays.log_opacities,
            arrays.normals,
            packed,
            *screen.arguments(),
        )

    run_chunks(run, even_bounds(count, threads), threads)
    return screen


def project_backward(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    screen: ScreenGaussians,
    grad_params: np.ndarray,
    grads_out: RawGradients,
) -> None:
    """Add the gradient with respect to the raw parameters to ``grads_out``; computed in float64.

    Parameters
    ----------
    gaussians, camera, options
        Arguments of :func:`project_gaussians`.
    screen : ScreenGaussians
        Its unmodified result; only rows of visible Gaussians are read. A colour of 0 there was
        clamped and has no gradient.
    grad_params : (n, 24) float32 or float64
        Gradient with respect to ``screen.params``. Column 23 is ignored.
    grads_out : RawGradients
        Accumulated into. A direction of length 0 and a degenerate quaternion have gradient 0.
    """
    _backward(gaussians, camera, options, screen, grad_params, None, grads_out)


def allocate_visible(gaussians: RawArrays, count: int) -> VisibleGradients:
    """Return arrays for the gradients of up to ``count`` visible Gaussians."""
    coefficients = gaussians.sh.shape[1]
    return VisibleGradients(
        np.zeros(count, np.int32),
        np.zeros((count, 3), np.float32),
        np.zeros((count, 3), np.float32),
        np.zeros((count, 4), np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, coefficients, 3), np.float32),
        np.zeros((count, 4), np.float32),
    )


def project_backward_visible(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    screen: ScreenGaussians,
    grad_params: np.ndarray,
    ids: np.ndarray,
    out: VisibleGradients | None = None,
) -> VisibleGradients:
    """Write the gradient with respect to the raw parameters of some Gaussians, one row each.

    Parameters
    ----------
    gaussians, camera, options
        Arguments of :func:`project_gaussians`.
    screen : ScreenGaussians
        Its unmodified result.
    grad_params : (n, 24) float32 or float64
        Gradient with respect to ``screen.params``; only the rows ``ids`` are read.
    ids : (v,) int32
        Indices of Gaussians, increasing. Those that are not visible get rows of 0.
    out : VisibleGradients, optional
        Arrays of at least v rows (:func:`allocate_visible`); overwritten.

    Returns
    -------
    VisibleGradients
        Views of the first v rows of ``out``. Coefficients above the degree used get 0.

    Raises
    ------
    UsageError
        If ``out`` has fewer than v rows or another number of harmonics coefficients.
    """
    count = len(ids)
    if out is None:
        out = allocate_visible(gaussians, count)
    if len(out.means) < count or out.sh.shape[1] != gaussians.sh.shape[1]:
        raise UsageError(
            f"The scratch holds {len(out.means)} rows of {out.sh.shape[1]} coefficients, not "
            f"{count} of {gaussians.sh.shape[1]}.",
            "Allocate it anew.",
        )
    part = VisibleGradients(
        ids,
        out.means[:count],
        out.log_scales[:count],
        out.quats[:count],
        out.opacity_logits[:count],
        out.sh[:count],
        out.orientation[:count],
    )
    _backward(gaussians, camera, options, screen, grad_params, ids, part)
    return part


_NO_IDS = np.zeros(0, np.int32)


def _backward(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    screen: ScreenGaussians,
    grad_params: np.ndarray,
    ids: np.ndarray | None,
    grads_out: RawGradients | VisibleGradients,
) -> None:
    """Run the backward kernel: write the rows of ``ids``, or add to those of all Gaussians."""
    count = len(gaussians) if ids is None else len(ids)
    packed = pack_camera(camera, options.near_z)
    degree = used_degree(gaussians.sh.shape[1], options)
    threads = options.threads or default_threads()

    def run(begin: int, end: int) -> None:
        backward_range(
            begin,
            end,
            _NO_IDS if ids is None else ids,
            ids is not None,
            *gaussians.arguments(),
            degree,
            packed,
            screen.params,
            screen.visible,
            grad_params,
            grads_out.means,
            grads_out.log_scales,
            grads_out.quats,
            grads_out.opacity_logits,
            grads_out.sh,
            grads_out.orientation,
        )

    run_chunks(run, even_bounds(count, threads), threads)


def _output(count: int, out: ScreenGaussians | None) -> ScreenGaussians:
    if out is None:
        return ScreenGaussians.allocate(count)
    if len(out) != count:
        raise UsageError(f"The output holds {len(out)} rows, not {count}.", "Allocate it anew.")
    return out
