# SPDX-License-Identifier: GPL-3.0-or-later
"""Start from an existing splat."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..errors import DatasetError
from ..gaussians.files import read_foreign_splat
from ..gaussians.model import OrientedGaussians, mip_filter
from ..limits import POINT_REACH, SCENE_RADIUS
from ..loading.other_inputs import fibonacci_directions
from ..progress import LEFT_OUT_HINT, Progress, ReportWarning
from ..render.reference import harmonics_basis
from ..render.render import render
from ..render.types import RenderOptions
from ..scene.camera import Camera, Similarity, quaternion_from_rotation
from ..scene.scene import PhotoSource, Scene, evenly_spaced, usable_points
from ..settings import TrainingSettings
from .state import cancellable
from .wrapping import orient

# -- Similarity transforms of Gaussians: means, shapes, orientations and harmonics ----------------

_DIRECTIONS = 64
"""Directions for the fit of rotated harmonics; 16 would do, more are better conditioned."""


def transform_gaussians(
    gaussians: OrientedGaussians, target_from_source: Similarity
) -> OrientedGaussians:
    """Transform Gaussians to another frame, float64; they look the same from transformed cameras.

    Lengths of the source (``filter_3d`` too) are in its units.
    """
    wide = {name: t.detach().cpu().double() for name, t in gaussians.tensors()}
    similarity = target_from_source
    rotation = torch.from_numpy(np.array(similarity.rotation, np.float64))
    means = torch.from_numpy(similarity.points(wide["means"].numpy()))
    direction = wide["orientation"][:, :3] @ rotation.T
    return OrientedGaussians(
        means=means,
        log_scales=wide["log_scales"] + math.log(similarity.scale),
        quats=_rotated(wide["quats"], quaternion_from_rotation(similarity.rotation)),
        opacity_logits=wide["opacity_logits"],
        sh=rotate_harmonics(wide["sh"], rotation),
        orientation=torch.cat([direction, wide["orientation"][:, 3:]], dim=1),
        filter_3d=wide["filter_3d"] * similarity.scale,
    )


def within_reach(gaussians: OrientedGaussians) -> tuple[OrientedGaussians, list[ReportWarning]]:
    """Leave out Gaussians of the scene frame that are too far away to be trained.

    Raises
    ------
    DatasetError
        None is left.
    """
    near = usable_points(gaussians.means.detach().numpy())
    if near.all():
        return gaussians, []
    if not near.any():
        raise DatasetError(
            "All Gaussians of the splat are far away from the cameras.",
            "Give the camera poses that the splat was trained with, or wrap the splat alone.",
        )
    text = (
        f"{int((~near).sum())} of {len(near)} Gaussians of the splat were left out: they are "
        f"farther away than {POINT_REACH / SCENE_RADIUS:.0f} scene radii."
    )
    kept = torch.from_numpy(np.flatnonzero(near))
    return gaussians.select(kept), [ReportWarning("gaussians-far-away", text, LEFT_OUT_HINT)]


def _rotated(quats: Tensor, turn: np.ndarray) -> Tensor:
    """Return the (n, 4) products ``turn * quats`` of quaternions w x y z."""
    a, b, c, d = turn.tolist()
    left = quats.new_tensor([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
    return quats @ left.T


def rotate_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Rotate functions on the sphere, given by real spherical harmonics (n, (degree + 1)^2, 3).

    The coefficients, of degree 0 to 3, are fitted to the function in :data:`_DIRECTIONS`
    directions, by least squares for each degree; rotations do not mix degrees, so the fit is exact.
    The result at ``rotation @ d`` equals the input at ``d``.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    if torch.equal(rotation, torch.eye(3, dtype=rotation.dtype)):
        return sh
    before = torch.from_numpy(fibonacci_directions(_DIRECTIONS))  # (m, 3) unit vectors
    after = before @ rotation.double().T
    basis, turned = harmonics_basis(before, degree), harmonics_basis(after, degree)  # (m, k)
    out = sh.double().clone()
    for level in range(1, degree + 1):
        band = slice(level * level, (level + 1) ** 2)
        matrix = torch.linalg.lstsq(turned[:, band], basis[:, band]).solution  # (2l+1, 2l+1)
        out[:, band] = torch.einsum("ij,njc->nic", matrix, sh[:, band].double())
    return out.to(sh.dtype)


def with_degree(gaussians: OrientedGaussians, degree: int) -> OrientedGaussians:
    """Return the Gaussians with harmonics of a degree, truncated or zero-padded."""
    wanted = (degree + 1) ** 2
    sh = gaussians.sh[:, :wanted]
    missing = sh.new_zeros((len(sh), wanted - sh.shape[1], 3))
    return gaussians.replaced(sh=torch.cat([sh, missing], dim=1))


# -- Initialise a training from an existing splat: transform, cap, check against photos, orient

ITERATIONS_SHARE = 0.3
"""Share of the preset's iterations: positions and colours exist, shapes and orientations do not."""

FILTER_MULTIPLE = 2.0
"""Shortest axis, in standard deviations of the 3D filter: a thinner one would lose its opacity to
the filter (a disc a tenth of the filter thick keeps a tenth of it)."""

HIGHEST_OPACITY = 0.995
LOWEST_OPACITY = 1e-4
"""Opacities are clamped to this range: beyond it, the sigmoid's gradient is too small to train."""

MATCH_VIEWS = 8
"""Number of photos that the splat is compared with."""

MATCH_DB = 12.0
"""Below this PSNR the splat does not match the photos."""

CLEAR_DB = 20.0
"""From this PSNR a splat matches even if a uniform image would match as well."""

_SMALL_DIVISOR = 4


def wrapping_settings(settings: TrainingSettings) -> TrainingSettings:
    """Return the settings of a short training from a splat.

    Density control neither adds nor prunes; depth and normals are trained from the start; the
    wrapping rounds lie between 30 and 70 % of the iterations.
    """
    return dataclasses.replace(
        settings, iterations=max(1, round(ITERATIONS_SHARE * settings.iterations)), growth="off",
        refine_poses="off", full_size="on", prune_share=0.0, depth_from=0.0, densify_from=0.0,
        densify_until=0.0, orient_from=0.0, wrap_from=0.3, wrap_until=0.7,
    )  # fmt: skip


def start_from_splat(
    path: Path, scene: Scene, photos: PhotoSource, view_indices: Sequence[int],
    settings: TrainingSettings, progress: Progress, *, threads: int = 0,
) -> tuple[OrientedGaussians, list[ReportWarning]]:  # fmt: skip
    """Read a splat in the world frame of the photos' cameras and prepare it for training.

    Parameters
    ----------
    path : Path
        3D Gaussian splatting PLY of any program.
    view_indices : sequence of int
        Training views.
    settings : TrainingSettings
        ``max_gaussians`` and ``sh_degree`` are respected.

    Returns
    -------
    gaussians : OrientedGaussians
        float32, scene frame; ``filter_3d`` of the training cameras at full size.
    warnings : list of ReportWarning

    Raises
    ------
    Cancelled
        Before the next view.
    ParseError
        The file is not a splat.
    DatasetError
        The splat does not match the photos.
    """
    splat = read_foreign_splat(path)
    progress.check()
    # Rotations do not mix degrees: truncate before rotating.
    wanted = with_degree(baked(splat.gaussians), settings.sh_degree)
    moved, far = within_reach(transform_gaussians(wanted, scene.world_from_scene.inverse()))
    cameras = [photos.camera(i, 1) for i in view_indices]
    gaussians = fit_filter(moved, cameras, variance_px=settings.filter_variance, threads=threads)
    warnings = [*splat.warnings, *far]
    if len(gaussians) > settings.max_gaussians:
        text = (
            f"The splat has {len(gaussians)} Gaussians; the {settings.max_gaussians} with the "
            "largest contribution to the photos are kept."
        )
        warnings.append(ReportWarning("gaussians-over-cap", text))
        small = [photos.camera(i, _divisor(photos, i)) for i in view_indices]
        weights = _mean_weights(gaussians, small, progress, threads=threads)
        # A stable order makes ties depend on the file alone.
        kept = np.sort(np.argsort(-weights, kind="stable")[: settings.max_gaussians])
        gaussians = gaussians.select(torch.from_numpy(kept))
    matched, unlike = _compare_with_photos(
        gaussians, photos, view_indices, progress, threads=threads
    )
    if unlike:
        raise DatasetError(
            f"The splat {path.name} does not match the photos (PSNR {matched:.1f} dB): its "
            "coordinate frame probably differs from that of the photos' cameras.",
            "Give the photos with the camera poses that the splat was trained with, or wrap the "
            "splat alone, without photos.",
        )
    if not splat.oriented:
        voters = (photos.camera(i, _divisor(photos, i)) for i in view_indices)
        gaussians = orient(gaussians, cancellable(voters, progress), threads=threads)
    return gaussians, warnings


def baked(gaussians: OrientedGaussians) -> OrientedGaussians:
    """Bake the 3D filter into scales and opacities; return float64 Gaussians with a filter of 0."""
    wide = OrientedGaussians(**{n: t.detach().double() for n, t in gaussians.tensors()})
    if not wide.filter_3d.any():
        return wide
    return wide.replaced(
        log_scales=torch.log(wide.scales()),
        opacity_logits=_logit(torch.exp(wide.log_opacities())),
        filter_3d=torch.zeros_like(wide.filter_3d),
    )


def fit_filter(
    gaussians: OrientedGaussians,
    cameras: Sequence[Camera],
    *,
    variance_px: float = TrainingSettings.filter_variance,
    threads: int = 0,
) -> OrientedGaussians:
    """Return Gaussians that look with the cameras' 3D filter like the given ones without, float32.

    Where that is impossible (an axis shorter than :data:`FILTER_MULTIPLE` filters, a thin and
    opaque Gaussian), the axis gets that length and the opacity the highest possible value. The
    Gaussians given, scene frame, have a filter of 0; the cameras are those of training at full
    size, and ``variance_px`` is the variance of their filter, squared pixels.
    """
    wide = {name: t.detach().double() for name, t in gaussians.tensors()}
    means = wide["means"].numpy()
    widths = mip_filter(means, cameras, variance_px=variance_px, threads=threads)  # (n,)
    width = torch.from_numpy(widths)
    least = (FILTER_MULTIPLE * width)[:, None]
    wanted = torch.maximum(torch.exp(wide["log_scales"]), least)  # (n, 3) effective
    raw = torch.sqrt(wanted**2 - width[:, None] ** 2)
    kept = (raw / wanted).prod(dim=1)  # (n,) share of the opacity left by the filter
    wide["log_scales"] = torch.log(raw)
    wide["opacity_logits"] = _logit(torch.sigmoid(wide["opacity_logits"]) / kept)
    wide["filter_3d"] = width
    # Files hold quaternions of any length; the learning rate of rotations assumes length 1.
    wide["quats"] = torch.nn.functional.normalize(wide["quats"], dim=1)
    return OrientedGaussians(**{name: t.float() for name, t in wide.items()})


def _logit(opacity: torch.Tensor) -> torch.Tensor:
    clamped = opacity.clamp(LOWEST_OPACITY, HIGHEST_OPACITY)
    return torch.log(clamped) - torch.log1p(-clamped)


def _divisor(photos: PhotoSource, index: int) -> int:
    """Return the divisor of a small image that still has a few tiles."""
    camera = photos.camera(index, 1)
    return _SMALL_DIVISOR if min(camera.width, camera.height) >= 32 * _SMALL_DIVISOR else 1


def _mean_weights(
    gaussians: OrientedGaussians, cameras: Sequence[Camera], progress: Progress, *, threads: int
) -> np.ndarray:
    """Return (n,) summed shares of the views' pixels that each Gaussian contributes."""
    options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)
    total = np.zeros(len(gaussians))
    for camera in cameras:
        progress.check()
        with torch.no_grad():
            statistics = render(gaussians, camera, options).statistics
        assert statistics is not None
        total += statistics.weight_sum / (camera.width * camera.height)
    return total


def _compare_with_photos(
    gaussians: OrientedGaussians, photos: PhotoSource, view_indices: Sequence[int],
    progress: Progress, *, threads: int,
) -> tuple[float, bool]:  # fmt: skip
    """Return the median PSNR against some photos, dB, and whether the splat does not match them.

    It does not if the PSNR is below :data:`MATCH_DB`, or, below :data:`CLEAR_DB`, if it is no
    better than that of each photo's mean colour: before a black background any small object is
    close to any photo.
    """
    options = RenderOptions(depth=False, threads=threads)
    errors, spreads = [], []
    for index in evenly_spaced(view_indices, MATCH_VIEWS):
        progress.check()
        divisor = _divisor(photos, index)
        with torch.no_grad():
            image = render(gaussians, photos.camera(index, divisor), options).color.numpy()
        photo = photos.photo(index, divisor) / 255.0
        mask = photos.mask(index, divisor)
        counted = np.ones(photo.shape[:2], np.bool_) if mask is None else mask
        if not counted.any():
            continue
        pixels = photo[counted]  # (m, 3)
        errors.append(float(((np.clip(image[counted], 0.0, 1.0) - pixels) ** 2).mean()))
        spreads.append(float(pixels.var(axis=0).mean()))
    if not errors:
        raise DatasetError("The masks cover all photos completely.", "Check the masks.")
    psnr = -10.0 * math.log10(max(float(np.median(errors)), 1e-10))
    explains_nothing = float(np.median(np.array(errors) - np.array(spreads))) >= 0.0
    return psnr, psnr < MATCH_DB or (psnr < CLEAR_DB and explains_nothing)
