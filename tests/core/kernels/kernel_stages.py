# SPDX-License-Identifier: GPL-3.0-or-later
"""Run every compiled part on tiny scenes and print a hash of each result.

``python tests/core/kernels/kernel_stages.py STAGE ...`` runs the named stages in the order given,
each on a scene of its own, and prints ``STAGE HASH ...`` lines: a process with a fresh kernel cache
compiles in that order. Functions that compiled code left to be called follow as ``left NAME``.
"""

from __future__ import annotations

import dataclasses
import gc
import hashlib
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numba.core.dispatcher import Dispatcher

from gaussian_wrapping_addon.core.evaluation.photo_views import write_preview
from gaussian_wrapping_addon.core.field.isosurface_projection import project_to_isosurface
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vector_field import VectorField
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions, VisibleGradients
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.settings import TextureSettings, TrainingSettings
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.losses import color_loss, normal_losses
from gaussian_wrapping_addon.core.training.schedule import Schedule
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.field.field_scenes import around_shell, cameras_around, shell_arrays
from tests.core.meshing.meshing_scenes import ShapeField, cube, gaussians_on, settings, some_cameras
from tests.core.meshing.meshing_scenes import sphere as sphere_distance
from tests.core.render.query_autograd import query_depth
from tests.core.texture.texture_scenes import photograph, ring, scene_of, sphere, sphere_hit, waves
from tests.core.training.small_scene import sphere_gaussians, sphere_scene

THREADS = 1
PACKAGE = "gaussian_wrapping_addon"
TRAINING = TrainingSettings(
    iterations=24, max_gaussians=400, max_image_px=64, sh_degree=1, depth_from=0.0,
    densify_every=4, wrap_rounds=2, checkpoint_every_s=1e9,
)  # fmt: skip


def arrays_of(value: Any) -> Iterator[np.ndarray]:
    """Yield all numbers of nested dataclasses, sequences and tensors, in their order."""
    if isinstance(value, torch.Tensor):
        yield value.detach().numpy()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from arrays_of(getattr(value, field.name))
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from arrays_of(item)
    elif isinstance(value, (np.ndarray, np.generic, float, int)):
        yield np.asarray(value)


def digest(*values: Any) -> str:
    """Return a hash of all bits of the numbers in ``values``."""
    state = hashlib.sha256()
    for array in arrays_of(values):
        state.update(f"{array.dtype}{array.shape}".encode())
        state.update(np.ascontiguousarray(array).tobytes())
    return state.hexdigest()[:16]


def one_view() -> str:
    """Images, statistics and gradients of one view, then losses and one optimiser step."""
    scene, photos = sphere_scene(views=3, size_px=40)
    camera, gaussians = scene.views[0].camera, sphere_gaussians()
    options = RenderOptions(depth=True, statistics=True, threads=THREADS)
    adam = Adam(gaussians)
    found = []
    for _ in range(3):
        view = ViewRenderer().render(RawArrays.from_gaussians(adam.gaussians()), camera, options)
        images = (view.color, view.normal, view.geometric_normal, view.alpha, view.depth)
        found.append(digest(images))
        value, by_color, squared = color_loss(view.color, photos.photo(0), None, threads=THREADS)
        other, by_normals = normal_losses(
            view.depth, view.geometric_normal, view.normal, view.alpha, camera, threads=THREADS
        )
        found.append(digest(value, by_color, squared, other, by_normals))
        gradients = view.backward(dataclasses.replace(by_normals, color=by_color))
        found.append(digest(gradients, view.statistics))
        rates = Schedule(TRAINING, 40).rates(0, 1.0)
        adam.step_rows(gradients, rates, sh_degree=1, threads=THREADS)
        found.append(digest([t for _, t in adam.gaussians().tensors()]))
    return " ".join(found)


def losses() -> str:
    """Losses and one optimiser step of any numbers, without a renderer."""
    random = np.random.default_rng(2)
    camera = sphere_scene(views=3, size_px=40)[0].views[0].camera

    def some(*shape: int) -> np.ndarray:
        return random.uniform(0.1, 1.0, shape).astype(np.float32)

    photo = random.integers(0, 256, (40, 40, 3)).astype(np.uint8)
    by_color = color_loss(some(40, 40, 3), photo, None, threads=THREADS)
    images = 3.0 + some(40, 40), some(40, 40, 3), some(40, 40, 3), some(40, 40)
    by_normals = normal_losses(*images, camera, threads=THREADS)
    adam = Adam(sphere_gaussians())
    shapes = {name: tensor.shape[1:] for name, tensor in adam.gaussians().tensors()}
    ids = np.arange(0, 150, 2, dtype=np.int32)
    names = [field.name for field in dataclasses.fields(VisibleGradients)][1:]
    gradients = VisibleGradients(ids, *(some(len(ids), *shapes[name]) for name in names))
    adam.step_rows(gradients, Schedule(TRAINING, 40).rates(0, 1.0), sh_degree=1, threads=THREADS)
    return digest(by_color, by_normals, [t for _, t in adam.gaussians().tensors()])


def autograd() -> str:
    """The differentiable entry, without depth."""
    camera, gaussians = sphere_scene(views=3, size_px=40)[0].views[1].camera, sphere_gaussians()
    leaves = [t.requires_grad_() for _, t in gaussians.tensors()]
    image = render(gaussians, camera, RenderOptions(depth=False, threads=THREADS))
    (image.color.square().sum() + image.normal.sum() + image.alpha.sum()).backward()
    return digest(image.color, image.normal, image.alpha, [t.grad for t in leaves])


def query() -> str:
    """Depth at sub-pixel positions, and its gradients."""
    camera, gaussians = sphere_scene(views=3, size_px=40)[0].views[1].camera, sphere_gaussians()
    leaves = [t.requires_grad_() for _, t in gaussians.tensors()]
    random = np.random.default_rng(1)
    positions = torch.from_numpy(random.uniform(10, 30, (60, 2)).astype(np.float32))
    found = query_depth(gaussians, camera, positions, RenderOptions(threads=THREADS))
    depth = found if isinstance(found, torch.Tensor) else found.depth
    depth.square().sum().backward()
    return digest(depth, [t.grad for t in leaves])


def training() -> str:
    """A whole training with depth from the start, densifying, wrapping rounds and measuring."""
    scene, photos = sphere_scene(views=9, size_px=32)
    with tempfile.TemporaryDirectory() as folder:
        result = train(scene, photos, TRAINING, Path(folder), Progress(), seed=1, threads=THREADS)
    return digest([t for _, t in result.gaussians.tensors()], result.history, result.held_out)


def fields() -> str:
    """Vacancy, vector field and points projected onto the isosurface."""
    arrays, points = shell_arrays(0.7), around_shell(400, 0.01)
    vacancy = VacancyField(arrays, cameras_around(4), threads=THREADS)
    vectors = VectorField(arrays, threads=THREADS)
    found = project_to_isosurface(points, vacancy, vectors)
    return " ".join(digest(v) for v in (vacancy.vacancy(points), vectors.evaluate(points), found))


def meshing() -> str:
    """A mesh of a ball."""
    distance, region = sphere_distance(), cube(1.3)
    field = ShapeField(distance, 0.02)
    mesh = mesh_region(
        Field(field, field, THREADS),
        gaussians_on(distance, region, 800, 0.02),
        some_cameras(),
        region,
        settings(300, 0.01),
        Progress(),
        seed=0,
    )
    return digest(mesh.vertices, mesh.faces)


def texture() -> str:
    """The texture of a ball, and its preview."""
    photos = photograph(ring(4, 3.5, 1.0), [(sphere_hit, waves)])
    with tempfile.TemporaryDirectory() as folder:
        textured = texture_mesh(
            sphere(), scene_of(photos), photos, TextureSettings(size_px=64, gutter_px=2),
            Path(folder), Progress(), threads=THREADS,
        )  # fmt: skip
        picture = Path(folder) / "preview.png"
        write_preview(textured, scene_of(photos), photos, picture, threads=THREADS)
        pixels = np.frombuffer(picture.read_bytes(), np.uint8)
    return digest(textured.albedo, textured.corner_uvs, pixels)


STAGES: dict[str, Callable[[], str]] = {
    f.__name__: f for f in (one_view, losses, autograd, query, training, fields, meshing, texture)
}


def left_functions() -> list[str]:
    """Return functions of the package, not their own, that kernels compiled here can be asked for.

    LLVM left them uninlined in a kernel's machine code; another kernel may hold another version.
    """
    found = set()
    for dispatcher in [thing for thing in gc.get_objects() if isinstance(thing, Dispatcher)]:
        own = dispatcher.py_func.__name__
        for compiled in dispatcher.overloads.values():
            names = (function.name for function in compiled.library.get_defined_functions())
            found |= {name for name in names if PACKAGE in name and own not in name}
    return sorted(found)


if __name__ == "__main__":
    for stage in sys.argv[1:]:
        sys.stdout.write(f"{stage} {STAGES[stage]()}\n")
    for name in left_functions():
        sys.stdout.write(f"left {name}\n")
