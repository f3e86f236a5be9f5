# SPDX-License-Identifier: GPL-3.0-or-later
"""True meshes of glossy scenes of the zoo, textured from their photos, beside test views."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.evaluation.surface.truth import read_truth
from gaussian_wrapping_addon.core.limits import MAX_IMAGE_SIDE_PX
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh

from ..speed_error.score import test_views
from ..zoo.cache import ensure_zoo_scene
from .compared import compared

SCENES = ("gloss-d1", "gloss-d2", "gloss-d3")


def glossy_figures(name: str, picture: Path, threads: int) -> dict[str, Any]:
    """Texture the true mesh of a scene from its photos, and compare with its test views.

    Parameters
    ----------
    name : str
        Of a scene of the zoo; its photos are rendered where they are missing.
    picture : Path
        Gets the test view of median PSNR, left, and the rendering, right.

    Returns
    -------
    dict
        What :func:`.compared.compared` returns, ``photos`` and ``size_px``.
    """
    folder = ensure_zoo_scene(name, threads)
    truth = read_truth(folder).mesh
    assert truth is not None
    vertices, faces = truth
    with tempfile.TemporaryDirectory() as work:
        scene = load_scene(folder, Path(work), Progress())
        to_scene = scene.world_from_scene.inverse()
        mesh = SurfaceMesh(to_scene.points(vertices), np.asarray(faces, np.int32))
        textured = texture_mesh(
            mesh, scene, PhotoStore(scene, MAX_IMAGE_SIDE_PX), TextureSettings(), Path(work),
            Progress(), threads=threads,
        )  # fmt: skip
    views = test_views(folder, to_scene)
    cameras, photos = zip(*views, strict=True)
    return {
        "photos": len(scene.views),
        "size_px": textured.statistics["size_px"],
        **compared(textured, cameras, photos, picture, threads),
    }
