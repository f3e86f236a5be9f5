# SPDX-License-Identifier: GPL-3.0-or-later
"""Oriented Gaussians: parameters, activations, 3D filter, initial values."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .. import limits
from ..compiled import kernel
from ..errors import DatasetError
from ..parallel import default_threads, even_bounds, run_chunks
from ..scene.camera import Camera
from ..scene.scene import Scene, usable_points
from ..settings import TrainingSettings

# -- Oriented Gaussians: trained parameters, activations, and activated arrays for kernels --------


TRAINED = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
"""Tensors of :class:`OrientedGaussians` that receive gradients; ``filter_3d`` is recomputed
instead (docs/method.md, section 1.5)."""


_LEAST_TRANSPARENCY = 1e-12  # of baked opacities


@dataclass(frozen=True)
class GaussianArrays:
    """Activated Gaussians as C-contiguous float64 numpy arrays, mip filter applied.

    Input of all non-differentiable code (fields, pivots, export).
    """

    means: np.ndarray  # (n, 3) scene units
    scales: np.ndarray  # (n, 3) effective standard deviations, scene units
    rotations: np.ndarray  # (n, 3, 3) columns are the Gaussian's axes
    log_opacities: np.ndarray  # (n,) effective, <= 0
    normals: np.ndarray  # (n, 3) learned oriented normals, length in [0, 1)
    sh: np.ndarray  # (n, k, 3) float32 spherical-harmonics coefficients

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class OrientedGaussians:
    """Trained parameters before activation (docs/method.md, section 1.3).

    All tensors share one dtype.

    The activated normal is ``tanh(s) * d / |d|`` for ``orientation = (d, s)``. ``filter_3d`` is a
    constant between recomputations and never receives a gradient (docs/method.md, section 1.5).
    """

    means: Tensor  # (n, 3) scene units
    log_scales: Tensor  # (n, 3) natural log of scene units
    quats: Tensor  # (n, 4) w x y z, not necessarily normalised
    opacity_logits: Tensor  # (n,)
    sh: Tensor  # (n, (degree + 1)^2, 3)
    orientation: Tensor  # (n, 4) direction and sign parameter
    filter_3d: Tensor  # (n,) scene units, >= 0

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Yield every parameter with its name."""
        for item in fields(self):
            yield item.name, getattr(self, item.name)

    def replaced(self, **tensors: Tensor) -> OrientedGaussians:
        """Return a copy with some tensors replaced."""
        return replace(self, **tensors)

    def mapped(self, change: Callable[[Tensor], Tensor]) -> OrientedGaussians:
        """Return a copy with each tensor changed by a function."""
        return OrientedGaussians(**{name: change(value) for name, value in self.tensors()})

    def select(self, index: Tensor) -> OrientedGaussians:
        """Return the Gaussians selected by an index or mask tensor."""
        return self.mapped(lambda value: value[index])

    def joined(self, others: OrientedGaussians) -> OrientedGaussians:
        """Return these Gaussians, then others with as many harmonics."""
        pairs = zip(self.tensors(), others.tensors(), strict=True)
        return self.replaced(**{name: torch.cat([a, b]) for (name, a), (_, b) in pairs})

    def detached(self) -> OrientedGaussians:
        """Return a copy that shares memory and carries no gradient."""
        return self.mapped(Tensor.detach)

    # -- activations ------------------------------------------------------------------------------

    def scales(self) -> Tensor:
        """(n, 3) effective standard deviations ``sqrt(s^2 + f^2)``."""
        filter_sq = self.filter_3d[:, None] ** 2  # (n, 1)
        return torch.sqrt(torch.exp(2.0 * self.log_scales) + filter_sq)

    def log_opacities(self) -> Tensor:
        """(n,) log of the effective opacity, numerically stable (docs/method.md, section 5.4)."""
        loss = self.log_scales - torch.log(self.scales())  # (n, 3), <= 0
        return -torch.nn.functional.softplus(-self.opacity_logits) + loss.sum(1)

    def baked(self, more_log_opacity: Tensor | float = 0.0) -> OrientedGaussians:
        """Return the same Gaussians, float64 and detached, with the filter in their own parameters.

        ``more_log_opacity`` (n,) is added to the logarithms of the opacities, which stay below 1.
        """
        wide = self.mapped(lambda value: value.detach().cpu().double())
        log_opacity = (wide.log_opacities() + more_log_opacity).clamp_max(-_LEAST_TRANSPARENCY)
        # logit = log(a / (1 - a)), from log a without losing a close to 1
        logit = log_opacity - torch.log(-torch.expm1(log_opacity))
        return wide.replaced(
            log_scales=torch.log(wide.scales()), opacity_logits=logit,
            filter_3d=torch.zeros_like(wide.filter_3d),
        )  # fmt: skip

    def rotations(self) -> Tensor:
        """(n, 3, 3) rotation matrices; columns are the axes. A zero quaternion is the identity."""
        norm = self.quats.norm(dim=1, keepdim=True)  # (n, 1)
        unit = self.quats / norm.clamp_min(limits.QUATERNION_MIN_NORM)
        identity = torch.zeros_like(unit)
        identity[:, 0] = 1.0
        unit = torch.where(norm > limits.QUATERNION_MIN_NORM, unit, identity)
        w, x, y, z = unit.unbind(1)
        rows = [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ]  # fmt: skip
        return torch.stack(rows, 1).reshape(-1, 3, 3)

    def normals(self) -> Tensor:
        """(n, 3) learned oriented normals ``tanh(s) d / |d|``; zero where ``d`` is zero."""
        direction, sign = self.orientation[:, :3], self.orientation[:, 3:]
        norm = direction.norm(dim=1, keepdim=True).clamp_min(limits.DIRECTION_MIN_NORM)
        return torch.tanh(sign) * direction / norm

    def arrays(self) -> GaussianArrays:
        """Return the activated arrays; activation is done in float64."""
        with torch.no_grad():
            wide = self.mapped(lambda value: value.detach().cpu().double())
            activated = (
                wide.means, wide.scales(), wide.rotations(), wide.log_opacities(), wide.normals(),
                self.sh.detach().cpu().float(),
            )  # fmt: skip
            return GaussianArrays(*(np.ascontiguousarray(tensor.numpy()) for tensor in activated))


# -- The 3D smoothing filter: no Gaussian is smaller than the closest camera can resolve ----------


FILTER_VARIANCE_PX = TrainingSettings.filter_variance
"""Default variance of the filter in squared pixels of the closest camera, 0.05. The usual 0.2
(docs/method.md, section 1.5) was found to reduce the opacity of thin parts: a Gaussian as narrow as
0.4 pixels in two directions keeps 44 % of it, and spokes of three pixels stay half transparent;
with this value it keeps 76 %."""
IMAGE_MARGIN = 0.15
"""Share by which the image is enlarged on each side in the visibility test of Gaussians."""


@kernel(fast=False)
def _nearest_depth_rows(begin, end, means, cameras, near_z, out):  # type: ignore[no-untyped-def]
    """out[i] = smallest z-depth over the cameras that see mean i, or inf."""
    for i in range(begin, end):
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        nearest = math.inf
        for c in range(cameras.shape[0]):
            cam = cameras[c]
            depth = cam[6] * x + cam[7] * y + cam[8] * z + cam[11]
            if not depth > near_z or depth >= nearest:
                continue
            u = cam[12] * (cam[0] * x + cam[1] * y + cam[2] * z + cam[9]) / depth + cam[14]
            v = cam[13] * (cam[3] * x + cam[4] * y + cam[5] * z + cam[10]) / depth + cam[15]
            if cam[16] <= u <= cam[17] and cam[18] <= v <= cam[19]:
                nearest = depth
        out[i] = nearest


def mip_filter(
    means: np.ndarray, cameras: Sequence[Camera], *, variance_px: float = FILTER_VARIANCE_PX,
    threads: int = 0,
) -> np.ndarray:  # fmt: skip
    """Return the filter's standard deviation of each Gaussian (docs/method.md, section 1.5).

    ``f = z_min / focal_max * sqrt(variance_px)``, with ``z_min`` the smallest z-depth, from
    ``limits.NEAR_Z`` on, over the training cameras (at the training resolution) whose image,
    enlarged by 15 % on each side, contains the mean; the variance is in squared pixels of the
    closest camera. Means (n, 3), result (n,) float64, scene units. Gaussians that no camera sees
    get the largest value of the others.
    """
    if len(cameras) == 0 or len(means) == 0:
        return np.zeros(len(means))
    packed = np.array([_pack(camera) for camera in cameras])
    points = np.ascontiguousarray(means, np.float64)
    depth = np.empty(len(points))
    threads = threads or default_threads()

    def run(begin: int, end: int) -> None:
        _nearest_depth_rows(begin, end, points, packed, limits.NEAR_Z, depth)

    run_chunks(run, even_bounds(len(points), threads), threads)
    seen = np.isfinite(depth)
    depth[~seen] = depth[seen].max() if seen.any() else limits.NEAR_Z
    focal_px = max(max(camera.fx, camera.fy) for camera in cameras)
    return depth / focal_px * math.sqrt(variance_px)


def _pack(camera: Camera) -> list[float]:
    wide, high = IMAGE_MARGIN * camera.width, IMAGE_MARGIN * camera.height
    return [
        *camera.rotation.reshape(-1).tolist(), *camera.cam_from_world[:, 3].tolist(),
        camera.fx, camera.fy, camera.cx, camera.cy,
        -wide, camera.width + wide, -high, camera.height + high,
    ]  # fmt: skip


# -- Opacity that the photos' blur took from thin parts (docs/method.md, section 5.7) -------------


LEAST_WIDTH_SHARE, MOST_OPACITY = 0.3, 0.99
"""Least share of a Gaussian's width that counts as its own: no opacity rises by more than 3.3; and
that to which it rises at most."""


def without_blur(
    gaussians: OrientedGaussians, variance_px: float, filter_variance_px: float
) -> OrientedGaussians:
    """Return Gaussians with the opacity that lens and pixels took from what is thin, float32.

    A photo shows a rod wider and fainter than it is, and so Gaussians learn it. Across the rod blur
    keeps the product of opacity and width, hence ``a' = a s / sqrt(s^2 - b^2)``, with ``s`` the
    middle one of the three standard deviations: of a rod the wide one of the two that are narrow;
    parts of a surface are wide in two directions, and keep their opacity. The width stays what
    photos show: a mesh resolves no less than their pixels.

    Parameters
    ----------
    variance_px : float
        Variance ``b^2`` of the blur in squared pixels of the closest camera; 0 changes nothing.
    filter_variance_px : float
        That of the Gaussians' 3D filter, which knows the size of these pixels; 0 changes nothing.
    """
    if variance_px <= 0.0 or filter_variance_px <= 0.0:
        return gaussians
    wide = gaussians.mapped(lambda value: value.detach().cpu().double())
    square = wide.scales().sort(1).values[:, 1] ** 2  # (n,)
    blur = wide.filter_3d**2 * (variance_px / filter_variance_px)
    own = torch.maximum(square - blur, LEAST_WIDTH_SHARE**2 * square)
    room = (math.log(MOST_OPACITY) - wide.log_opacities()).clamp_min(0.0)
    return wide.baked(torch.minimum(0.5 * torch.log(square / own), room)).mapped(Tensor.float)


# -- Initial Gaussians: from sparse points, and along camera rays if these are few ----------------
#
# The start from an existing splat is in ``core/training/splat_start.py``.


_logger = logging.getLogger(__name__)

PhotoLoader = Callable[[int], tuple[Camera, np.ndarray, np.ndarray | None]]
"""Returns camera, (h, w, 3) uint8 photo and (h, w) bool mask or ``None``, at a small size."""

INITIAL_OPACITY = 0.1
SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""
MIN_START_POINTS = 5000
"""With fewer sparse points, more are added until there are this many."""
MIN_SPACING_SQ = 1e-7
"""Squared distances between neighbours are clamped to this (docs/method.md, section 1.3)."""
MAX_SPACING_SHARE = 0.1
"""Largest size of an initial Gaussian relative to its distance to the nearest camera."""
_DEPTH_NEIGHBOURS = 4
_DEPTH_JITTER = 0.05
"""Relative standard deviation of added points around the depth of the nearest sparse points."""
_DEPTH_TRIALS = 8


def initial_gaussians(
    scene: Scene, view_indices: list[int], load_photo: PhotoLoader, *, max_gaussians: int,
    sh_degree: int, seed: int,
) -> OrientedGaussians:  # fmt: skip
    """Return the Gaussians that training starts from (docs/method.md, section 1.3).

    One per sparse point within ``limits.POINT_REACH``: round, as large as the mean distance to
    its three nearest neighbours, opacity 0.1, orientation zero. Where there are fewer than
    :data:`MIN_START_POINTS`, random pixels are lifted to the depth of the nearest sparse points;
    where there are none, to a random depth, keeping the positions that most cameras see. Of more
    points than ``max_gaussians``, a random subset is used. float32, with ``filter_3d`` zero.

    Parameters
    ----------
    view_indices : list of int
        Views to use (without held-out ones).
    load_photo : callable
        Only called if points are few.

    Raises
    ------
    DatasetError
        If there is no view, or points are few and the masks exclude all pixels.
    """
    if not view_indices:
        raise DatasetError("There is no view to train on.", "Add photos.")
    random = np.random.default_rng([seed, 1])
    points = np.asarray(scene.points, np.float64).reshape(-1, 3)
    usable = usable_points(points)
    if not usable.all():
        _logger.warning(
            "%d of %d sparse points are not finite or too far away: no Gaussian starts there",
            int((~usable).sum()), len(usable),
        )  # fmt: skip
    points = points[usable]
    colors = np.asarray(scene.point_colors).reshape(-1, 3)[usable] / 255.0
    cameras = [scene.views[i].camera for i in view_indices]
    if len(points) > max_gaussians:
        chosen = np.sort(random.choice(len(points), max_gaussians, replace=False))
        points, colors = points[chosen], colors[chosen]
    wanted = min(MIN_START_POINTS, max_gaussians) - len(points)
    if wanted > 0:
        more, more_colors = _points_along_rays(points, wanted, view_indices, load_photo, random)
        points, colors = np.concatenate([points, more]), np.concatenate([colors, more_colors])
    return gaussians_at(points, colors, point_spacing(points, cameras), sh_degree)


def point_spacing(points: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """(n,) RMS distance to the three nearest neighbours, capped by the distance to the cameras."""
    neighbours = min(3, len(points) - 1)
    if neighbours > 0:
        distance, _ = cKDTree(points).query(points, k=neighbours + 1)
        mean_sq = np.maximum((distance[:, 1:] ** 2).mean(axis=1), MIN_SPACING_SQ)
    else:
        mean_sq = np.full(len(points), math.inf)
    centers = np.stack([camera.center for camera in cameras])
    to_camera, _ = cKDTree(centers).query(points)
    cap = np.maximum(MAX_SPACING_SHARE * to_camera, math.sqrt(MIN_SPACING_SQ))
    return np.minimum(np.sqrt(mean_sq), cap)


def gaussians_at(
    points: np.ndarray, colors: np.ndarray, sizes: np.ndarray, sh_degree: int, *,
    normals: np.ndarray | None = None, flatness: np.ndarray | float = 1.0,
    opacities: np.ndarray | float = INITIAL_OPACITY,
) -> OrientedGaussians:  # fmt: skip
    """Return Gaussians at points, round or flat across normals, without orientation.

    Colours are (n, 3) in [0, 1], sizes (n,) standard deviations along the surface. The third axis
    points along the unit normal; the standard deviation there is ``flatness`` times the size.
    """
    count = len(points)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colors - 0.5) / SH_C0
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)) if normals is None else _turning_z_to(normals)
    log_scales = np.repeat(np.log(sizes)[:, None], 3, axis=1)  # (n, 3)
    log_scales[:, 2] += np.log(flatness)
    opacities = np.broadcast_to(opacities, count)
    arrays = (
        points, log_scales, quats, np.log(opacities / (1.0 - opacities)), sh, np.zeros((count, 4)),
        np.zeros(count),
    )  # fmt: skip
    return OrientedGaussians(*(torch.from_numpy(array.astype(np.float32)) for array in arrays))


def _turning_z_to(normals: np.ndarray) -> np.ndarray:
    """Return (n, 4) unit quaternions w x y z that turn the z axis to unit vectors."""
    quats = np.zeros((len(normals), 4))
    quats[:, 0] = 1.0 + normals[:, 2]
    quats[:, 1], quats[:, 2] = -normals[:, 1], normals[:, 0]
    opposite = quats[:, 0] < 1e-6
    quats[opposite] = (0.0, 1.0, 0.0, 0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _points_along_rays(
    points: np.ndarray, wanted: int, view_indices: list[int], load_photo: PhotoLoader,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return ``wanted`` additional points with colours in [0, 1], from pixels of the photos."""
    views, cameras = [], []
    for index in view_indices:  # twice, as hundreds of photos do not fit into memory
        camera, _, mask = load_photo(index)
        if mask is None or mask.any():
            views.append(index)
            cameras.append(camera)
    if not views:
        raise DatasetError("The masks exclude all pixels of all photos.", "Check the masks.")
    share = np.full(len(views), wanted // len(views))
    share[: wanted - int(share.sum())] += 1
    found_points, found_colors = [], []
    for index, count in zip(views, share.tolist(), strict=True):
        if count == 0:
            continue
        camera, photo, mask = load_photo(index)
        pixel_count = photo.shape[0] * photo.shape[1]
        allowed = np.arange(pixel_count) if mask is None else np.flatnonzero(mask)
        row, column = np.divmod(random.choice(allowed, count), photo.shape[1])  # (count,)
        pixels = np.stack([column, row], axis=1) + random.uniform(size=(count, 2))
        depth = _depth_near_points(points, camera, pixels, random)
        if depth is None:
            depth = _most_seen_depth(camera, pixels, cameras, random)
        local = camera.rays_at(pixels) * depth[:, None]
        found_points.append(local @ camera.rotation + camera.center)
        found_colors.append(photo[row, column] / 255.0)
    return np.concatenate(found_points), np.concatenate(found_colors)


def _depth_near_points(
    points: np.ndarray, camera: Camera, pixels: np.ndarray, random: np.random.Generator
) -> np.ndarray | None:
    """(m,) depth of one of the sparse points nearest in the image; ``None`` without points."""
    if len(points) == 0:
        return None
    where, depth, inside = _seen_by(camera, points)
    if inside.sum() < _DEPTH_NEIGHBOURS:
        return None
    _, nearest = cKDTree(where[inside]).query(pixels, k=_DEPTH_NEIGHBOURS)
    pick = random.integers(0, _DEPTH_NEIGHBOURS, len(pixels))
    chosen = depth[inside][nearest[np.arange(len(pixels)), pick]]
    jitter = 1.0 + _DEPTH_JITTER * random.normal(size=len(pixels))
    return np.maximum(chosen * jitter, limits.NEAR_Z)


def _seen_by(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels (n, 2), depths (n,), and which points lie in the frame, (n,) bool."""
    where, depth = camera.project(points)
    inside = (depth > limits.NEAR_Z) & (where >= 0).all(axis=1)
    return where, depth, inside & (where[:, 0] < camera.width) & (where[:, 1] < camera.height)


def _most_seen_depth(
    camera: Camera, pixels: np.ndarray, cameras: list[Camera], random: np.random.Generator
) -> np.ndarray:
    """(m,) out of several random depths, that of the position most cameras see."""
    near, far = 0.1 * limits.SCENE_RADIUS, 4.0 * limits.SCENE_RADIUS
    best = np.zeros(len(pixels))
    most = np.full(len(pixels), -1)
    rays = camera.rays_at(pixels)
    for _ in range(_DEPTH_TRIALS):
        # Uniform in inverse depth, which matches the depth resolution of the photos.
        depth = 1.0 / random.uniform(1.0 / far, 1.0 / near, len(pixels))
        positions = (rays * depth[:, None]) @ camera.rotation + camera.center
        seen = np.zeros(len(pixels), int)
        for other in cameras:
            seen += _seen_by(other, positions)[2]
        better = seen > most
        best[better], most[better] = depth[better], seen[better]
    return best
