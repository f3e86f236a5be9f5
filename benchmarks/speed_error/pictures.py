# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of the report: photo, textured meshes, and where the meshes are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.evaluation.surface.truth import read_truth
from gaussian_wrapping_addon.core.evaluation.views.textured_rendering import (
    BACKGROUND,
    TexturedRenderer,
)
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.mesh.depth_buffer import depth_buffer
from gaussian_wrapping_addon.core.mesh.distance import distances_to_mesh

from .plan import THRESHOLD_SHARES
from .score import read_textured, stage_folder, test_views

WIDTH_PX = 420
VIEW = 1
SUPERSAMPLING = 2
ERROR_COLORS = ((70, 120, 200), (110, 190, 110), (240, 200, 60), (200, 50, 40))
"""Nearer than each threshold of the report, and farther than all."""
NOT_JUDGED = (150, 150, 150)
"""Faces outside of the crop volume."""
LIGHT = np.array([-0.4, -0.5, -0.77])
"""Direction of light in camera coordinates, towards the scene."""
QUALITY = 85


def write_comparison(scene: Path, runs: Sequence[tuple[str, Path]], path: Path) -> None:
    """Write one JPEG: photo and textured meshes above, true surface and errors below.

    Parameters
    ----------
    scene : Path
        Ground truth.
    runs : sequence of (label, folder)
        Finished runs, each with ``mesh/`` and ``out/``.
    path : Path
        Where the picture goes.
    """
    truth = read_truth(scene)
    diagonal = float(read_json(scene / "scene.json")["diagonal"])
    top, bottom = [], []
    for label, folder in runs:
        frame = load_saved_scene(stage_folder(folder / "out", "cameras")).world_from_scene
        camera, photo = test_views(scene, frame.inverse())[VIEW]
        size = (WIDTH_PX, round(WIDTH_PX * camera.height / camera.width))
        textured = read_textured(folder / "mesh")
        if not top:
            top.append(("photo", np.asarray(Image.fromarray(photo).resize(size))))
            true = frame.inverse().points(truth.vertices)
            grey = np.full((len(truth.faces), 3), 200.0)
            bottom.append(("true surface", shade(true, truth.faces, grey, camera, size)))
        top.append((label, TexturedRenderer(textured).render(camera, size).image))
        mesh = textured.mesh
        centres = frame.points(mesh.vertices[mesh.faces].mean(1))
        distance = distances_to_mesh(centres, truth.vertices, truth.faces)[0] / diagonal
        colors = np.array(ERROR_COLORS, float)[np.searchsorted(THRESHOLD_SHARES, distance)]
        if truth.crop is not None:
            colors[~truth.crop.inside(centres)] = NOT_JUDGED
        bottom.append((f"{label}: error", shade(mesh.vertices, mesh.faces, colors, camera, size)))
    rows = [
        np.concatenate([_labelled(image, text) for text, image in row], 1) for row in (top, bottom)
    ]
    Image.fromarray(np.concatenate(rows)).save(path, quality=QUALITY)


def shade(
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    camera: Camera,
    size: tuple[int, int],
) -> np.ndarray:
    """Return (h, w, 3) uint8: the mesh in (f, 3) face colours under one light."""
    width, height = size
    fine = camera.resized(SUPERSAMPLING * width, SUPERSAMPLING * height)
    faces = np.ascontiguousarray(faces, np.int32)
    hit = depth_buffer(vertices, faces, fine, threads=2).face  # (h, w)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    light = (LIGHT / np.linalg.norm(LIGHT)) @ camera.rotation
    bright = 0.45 + 0.55 * np.abs(normals @ light)  # (f,)
    lit = np.vstack([colors * bright[:, None], BACKGROUND])  # the last row serves hit = -1
    image = lit[hit].reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3).mean((1, 3))
    return np.round(image).clip(0, 255).astype(np.uint8)


def _labelled(image: np.ndarray, text: str) -> np.ndarray:
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, 0, 8 + 7 * len(text), 18), fill=(0, 0, 0))
    draw.text((5, 3), text, fill=(255, 255, 255))
    return np.asarray(picture)
