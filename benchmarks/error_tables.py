# SPDX-License-Identifier: GPL-3.0-or-later
"""Tables of errors: whole renderings on generic and hard scenes, and each hand-written backward."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection.projection import (
    RawArrays,
    RawGradients,
    project_backward,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.raster.blend import (
    Images,
    RenderBuffers,
    blend,
    blend_backward,
)
from gaussian_wrapping_addon.core.render.reference import reference
from gaussian_wrapping_addon.core.render.reference.reference_projection import reference_projection
from gaussian_wrapping_addon.core.render.render import project_view, render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from .exact import as_float64, exact_images
from .exact_gradients import TRAINED
from .hard_scenes import HardScene
from .scene_errors import (
    LOSSES,
    SceneErrors,
    gradient_error,
    leaves,
    loss_weights,
    scene_errors,
)
from .tables import Cell, Table
from .training_step import loss_gradients, noisy_photo
from .workload import surface_gaussians, view

_GROUPS = {
    "u v": slice(0, 2),
    "qa qb qc": slice(2, 5),
    "px py": slice(5, 7),
    "r s t": slice(7, 10),
    "z": slice(10, 11),
    "opacity": slice(11, 12),
    "a0": slice(12, 13),
    "features": slice(13, 22),
}
_TARGET = 1e-4
_IMAGE_NOTE = (
    "Largest absolute error of colour, normals and alpha; *off*: pixels where it exceeds 1e-5, "
    "because rounding decided a threshold (alpha >= 1/255, T >= 1e-4) the other way. Depth: pixels "
    "that have one in float64, pixels where only one of the two has, share of the others whose "
    "relative error against the bisection is below 1e-5, and the largest. *Step x slope*: the last "
    "bit of a float32 depth times -d(log T)/dt at the crossing, in the median; where it nears 1, "
    "float32 cannot hold the depth to within the thickness of the Gaussians, and the depth's "
    "gradient, which is taken at the rounded depth, is lost."
)
_BACKWARD_NOTE = (
    "Blending and depth: autograd of the torch reference on the same float32 rows of params. "
    "Projection (with harmonics and mip filter): autograd of the reference projection. Losses: the "
    "same formula in float64."
)


def generic(count: int, seed: int) -> OrientedGaussians:
    """Return the workload's Gaussians with a mip filter of about their thickness."""
    gaussians = surface_gaussians(count, seed)
    return gaussians.replaced(filter_3d=torch.full((count,), 0.003))


def covering(count: int, seed: int) -> OrientedGaussians:
    """Return the same, but large enough for about 1500 to cover the image."""
    gaussians = generic(count, seed)
    return gaussians.replaced(log_scales=gaussians.log_scales + 1.3)


def generic_errors(sizes: list[tuple[int, int, int]], seed: int) -> list[SceneErrors]:
    """Return the errors of ``(count, width, height)`` workloads; gradients of all pixels."""
    return [
        scene_errors(
            f"{count} Gaussians, {width} x {height}",
            generic(count, seed),
            view(width, height),
            RenderOptions(background=(0.2, 0.5, 0.1)),
            render,
            seed=seed,
        )
        for count, width, height in sizes
    ]


def hard_errors(scenes: list[HardScene]) -> list[SceneErrors]:
    """Return the errors of the hard scenes."""
    return [
        scene_errors(
            f"{scene.case}: {scene.name}",
            scene.gaussians,
            scene.camera,
            scene.options,
            render,
            seed=scene.seed,
        )
        for scene in scenes
    ]


def image_table(errors: list[SceneErrors]) -> Table:
    """Return images and depth of all scenes."""
    rows: list[tuple[Cell, ...]] = []
    for e in errors:
        has_depth = e.depth_valid > 0
        rows.append(
            (
                e.name,
                e.pixels,
                e.image_max,
                e.image_off,
                e.depth_valid,
                e.depth_differs,
                f"{100 * e.depth_within:.3f}" if has_depth else "",
                e.depth_max if has_depth else None,
                e.depth_step if has_depth else None,
            )
        )
    return Table(
        "Images and depth against float64",
        (
            "scene",
            "pixels",
            "largest error",
            "pixels off",
            "with depth",
            "differ",
            "% below 1e-5",
            "largest rel.",
            "step x slope",
        ),
        rows,
        (_IMAGE_NOTE,),
    )


def gradient_tables(generic: list[SceneErrors], hard: list[SceneErrors]) -> list[Table]:
    """Return one table a loss: L2-relative error and, after the slash, the largest error."""
    tables = []
    for loss in LOSSES:
        chosen = [*generic, *hard]
        if loss == "images, all pixels":
            chosen = [e for e in chosen if e.image_off]
        elif loss == "depth, all pixels":
            chosen = generic
        rows: list[tuple[Cell, ...]] = []
        worse = []
        for e in chosen:
            found = e.gradients[loss]
            if all(math.isnan(found[group].l2) for group in TRAINED):
                continue
            cells = [
                "-" if math.isnan(f.l2) else f"{f.l2:.1e} / {f.largest:.1e}"
                for f in (found[group] for group in TRAINED)
            ]
            rows.append((e.name, *cells))
            if any(f.l2 > _TARGET for f in found.values()):
                step = f" (step x slope {e.depth_step:.1e})" if "depth" in loss else ""
                worse.append(e.name + step)
        note = f"Every group of every scene listed is below {_TARGET:.0e}."
        if worse:
            note = f"Some group is above {_TARGET:.0e} in: {'; '.join(worse)}."
        if rows:
            header = ("scene", *TRAINED)
            tables.append(Table(f"Gradients of the loss on {loss}", header, rows, (note,)))
    explained = (
        "Length of the error over the length of the float64 gradient / largest error over the "
        "largest value; random weights on every value of the images named. -: the gradient is 0, "
        "by definition or by symmetry."
    )
    tables[0] = dataclasses.replace(tables[0], notes=(explained, *tables[0].notes))
    return tables


def backward_table(seed: int) -> Table:
    """Return the error of every hand-written backward alone, fed with the same float32 values."""
    rows: list[tuple[Cell, ...]] = []
    gaussians = covering(1500, seed)
    # No 8-bit value: a pixel that equals the photo has no L1 gradient.
    camera, options = view(60, 44), RenderOptions(background=(0.201, 0.502, 0.103))
    rows += _blending_rows(gaussians, camera, options, seed)
    rows += _projection_rows(gaussians, camera, options, seed)
    rows += _loss_rows(gaussians, camera, options, seed)
    return Table(
        "Each hand-written backward alone, float32 against float64",
        ("backward", "gradient on", "L2-relative", "largest"),
        rows,
        (f"{len(gaussians)} Gaussians, {camera.width} x {camera.height}. {_BACKWARD_NOTE}",),
    )


def _blending_rows(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions, seed: int
) -> list[tuple[Cell, ...]]:
    prepared = project_view(RawArrays.from_gaussians(gaussians), camera, options)
    images = Images.allocate(camera, options)
    blend(prepared, images, RenderBuffers())
    order = np.flatnonzero(prepared.screen.visible)
    order = order[np.argsort(prepared.screen.depths[order], kind="stable")]
    exact = exact_images(gaussians, camera, options)
    everywhere = np.ones(exact.alpha.shape, np.bool_)
    weights = loss_weights(exact, images.depth.astype(np.float64), everywhere, seed)
    shape = (camera.height, camera.width)
    widths = {"color": 3, "normal": 3, "geometric_normal": 3, "alpha": 1, "depth": 1}
    rows: list[tuple[Cell, ...]] = []
    for name, loss in (("blending", "images"), ("isosurface depth", "depth")):
        incoming = [
            np.ascontiguousarray(
                weights[loss].get(key, torch.zeros((*shape, width))[..., : 3 if width > 1 else 1])
            ).reshape(*shape, *([width] if width > 1 else []))
            for key, width in widths.items()
        ]
        found, _, _ = blend_backward(prepared, images, incoming, RenderBuffers(), absolute=False)
        params = torch.tensor(prepared.screen.params[order], dtype=torch.float64)
        params.requires_grad_()
        background = torch.tensor(options.background, dtype=torch.float64)
        # As in the definition, but of rows of params instead of Gaussians.
        image = reference._render_rows(params, background, camera, options, 0, camera.height)
        flat = np.concatenate([grad.reshape(len(image), -1) for grad in incoming], 1)
        (wanted,) = torch.autograd.grad((image * torch.from_numpy(flat).double()).sum(), params)
        zero = 1e-12 * float(wanted.norm())
        for group, columns in _GROUPS.items():
            error = gradient_error(found[order][:, columns], wanted[:, columns], zero)
            if not math.isnan(error.l2):
                rows.append((name, group, error.l2, error.largest))
    return rows


def _projection_rows(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions, seed: int
) -> list[tuple[Cell, ...]]:
    raw = RawArrays.from_gaussians(gaussians)
    screen = project_gaussians(raw, camera, options)
    wide = leaves(as_float64(gaussians), torch.float64)
    exact = reference_projection(wide, camera, options).params
    # Each column counts alike: the rows of params have values from 1e-6 to 1e6.
    seen = torch.from_numpy(screen.visible)
    scale = exact.detach()[seen].abs().median(0).values.clamp_min(1e-12)
    generator = torch.Generator().manual_seed(seed)
    incoming = torch.randn(exact.shape, generator=generator, dtype=torch.float64) / scale
    incoming[:, 22:] = 0.0
    incoming[~seen] = 0.0
    incoming = incoming.float()
    found = RawGradients.zeros(raw)
    project_backward(raw, camera, options, screen, incoming.numpy(), found)
    wanted = torch.autograd.grad(
        (exact * incoming.double()).sum(), [getattr(wide, name) for name in TRAINED]
    )
    rows: list[tuple[Cell, ...]] = []
    for name, gradient in zip(TRAINED, wanted, strict=True):
        error = gradient_error(getattr(found, name), gradient)
        rows.append(("projection", name, error.l2, error.largest))
    return rows


def _loss_rows(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions, seed: int
) -> list[tuple[Cell, ...]]:
    with torch.no_grad():
        out = render(gaussians, camera, options)
    photo = noisy_photo(out.color.numpy(), seed)
    found = loss_gradients(out, camera, photo, torch.float32)
    rows: list[tuple[Cell, ...]] = []
    for (name, group), wanted in loss_gradients(out, camera, photo, torch.float64).items():
        error = gradient_error(found[name, group], wanted)
        rows.append((name, group, error.l2, error.largest))
    return rows
