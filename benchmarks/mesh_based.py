# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh-based rendering of one mesh: a colour field trained on it, compared with the test views.

``python -m benchmarks.mesh_based SCENE OUT.json [--mesh FOLDER --job FOLDER | --file
MESH] [--pixels outline|whole]``; without a mesh, the true surface is judged, which shows what the
measure can reach. The field is trained on the scene's training photos and judged on its test
views, which no job was given (docs/method.md, section 9.3).
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.evaluation.command import read_cameras
from gaussian_wrapping_addon.core.evaluation.layouts import read_mesh
from gaussian_wrapping_addon.core.evaluation.mesh_based_rendering import (
    MeshBasedSettings,
    PhotoView,
    mesh_based_rendering,
)
from gaussian_wrapping_addon.core.evaluation.surface_scores import Truth, read_truth
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.image_metrics import lpips_if_ready
from gaussian_wrapping_addon.core.machine import describe_machine
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene

from .score import stage_folder, test_views, true_mask

PIXELS = ("outline", "whole")
"""What is compared: the thing that is judged, cut out along its true outline, as the meshes of the
studies are cut to a region; or whole photos, as in the paper, whose meshes are of whole scenes."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--mesh", type=Path, help="folder with mesh.npz, in the scene frame")
    parser.add_argument("--job", type=Path, help="folder of the job that made it, for the frame")
    parser.add_argument("--file", type=Path, help="mesh file in world coordinates instead")
    parser.add_argument("--pixels", choices=PIXELS, default=PIXELS[0])
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.mesh is not None and options.job is None:
        parser.error("--mesh needs --job")
    truth = read_truth(options.scene)
    if options.mesh is not None:
        vertices, faces = exported_mesh(options.mesh, options.job)
    elif options.file is not None:
        vertices, faces = read_mesh(options.file)
    else:
        vertices, faces = truth.vertices, truth.faces
    found = judge_mesh(
        vertices, faces, options.scene, truth, pixels=options.pixels, threads=options.threads
    )
    write_json(options.out, found)


def judge_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    scene_folder: Path,
    truth: Truth | None = None,
    *,
    pixels: str = "outline",
    threads: int = 0,
    settings: MeshBasedSettings | None = None,
) -> dict[str, Any]:
    """Return the figures of a mesh as plain JSON values.

    Parameters
    ----------
    vertices, faces : (v, 3), (f, 3)
        World frame.
    scene_folder : Path
        Ground truth (docs/file-formats.md).
    truth : Truth, optional
        Of the scene; read where it is not given.
    pixels : str
        One of :data:`PIXELS`.
    """
    begun_s, busy_s = time.monotonic(), _processor_seconds()
    training = training_views(scene_folder)
    test = test_views(scene_folder, Similarity())
    outlined = (truth or read_truth(scene_folder)) if pixels == "outline" else None
    lpips, reason = lpips_if_ready()
    found = mesh_based_rendering(
        vertices, faces, photo_views(training, outlined, threads),
        photo_views(test, outlined, threads), settings, lpips=lpips, threads=threads,
    )  # fmt: skip
    return {
        **found.to_json(),
        "pixels": pixels,
        "vertices": len(vertices),
        "faces": len(faces),
        "lpips_note": reason,
        "seconds": time.monotonic() - begun_s,
        "processor_seconds": _processor_seconds() - busy_s,
        "machine": describe_machine(threads),
    }


def training_views(scene_folder: Path) -> list[tuple[Camera, np.ndarray]]:
    """Return the training cameras in the world frame with their (h, w, 3) uint8 photos."""
    views = []
    for camera in read_cameras(scene_folder):
        with Image.open(scene_folder / "images" / camera.name) as photo:
            views.append((camera, np.asarray(photo.convert("RGB"))))
    return views


def photo_views(
    views: Sequence[tuple[Camera, np.ndarray]], truth: Truth | None, threads: int
) -> list[PhotoView]:
    """Return the views, with the outline of the true surface where one is given."""
    if truth is None:
        return [PhotoView(camera, photo) for camera, photo in views]
    return [
        PhotoView(
            camera, photo, outline=true_mask(truth.vertices, truth.faces, camera, threads)
        )
        for camera, photo in views
    ]  # fmt: skip


def exported_mesh(folder: Path, job: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh that a job exported for the benchmarks, in the world frame."""
    with np.load(folder / "mesh.npz", allow_pickle=False) as arrays:
        vertices, faces = arrays["vertices"], arrays["faces"]
    world = load_saved_scene(stage_folder(job, "cameras")).world_from_scene
    return world.points(vertices), faces


def _processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
