# SPDX-License-Identifier: GPL-3.0-or-later
"""The usual alternative: depth maps of the same Gaussians, fused into a signed distance (TSDF).

Open3D's ``ScalableTSDFVolume`` (requirements-benchmarks.txt) fuses them and extracts the surface by
marching cubes; nothing of it is ours.
"""

from __future__ import annotations

import importlib.util

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.meshing.points.candidate_surface import MARGIN_SHARE
from gaussian_wrapping_addon.core.regions.convex_region import Region
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from .trained import Trained

TRUNCATION_VOXELS = 4.0
"""Width of the band on either side: wide enough for the noise of depth maps, and as often used."""

_CUBE_VOXELS = 16
"""The volume is kept in cubes of so many voxels a side."""


def require_open3d() -> None:
    """Raise where Open3D is missing.

    Raises
    ------
    ResourceError
        With the way to get it.
    """
    if importlib.util.find_spec("open3d") is None:
        raise ResourceError(
            "TSDF fusion needs Open3D, which is missing.",
            "Install it: pip install -r requirements-benchmarks.txt.",
        )


def depth_in_region(
    gaussians: OrientedGaussians, camera: Camera, region: Region, threads: int
) -> np.ndarray:
    """Return the z-depth of the 0.5-isosurface, (h, w) float32; 0 outside of the region."""
    options = RenderOptions(threads=threads)
    depth = render(gaussians, camera, options).depth.detach().cpu().numpy()  # (h, w)
    seen = depth > 0
    local = camera.rays()[seen] * depth[seen][:, None]  # (k, 3) camera frame
    points = local @ camera.rotation + camera.center
    within = np.zeros(depth.shape, np.bool_)
    within[seen] = region.contains(points, MARGIN_SHARE * region.diagonal)
    return np.ascontiguousarray(np.where(within, depth, 0.0), np.float32)


def fuse(trained: Trained, voxels: int, *, threads: int) -> tuple[np.ndarray, np.ndarray]:
    """Render depth of every camera, fuse it and return vertices and faces in the region.

    Parameters
    ----------
    voxels : int
        Along the region's diagonal.
    threads : int
        Of the rendering; Open3D takes what it finds.

    Returns
    -------
    vertices : (v, 3) float64
        Scene frame.
    faces : (f, 3) int64
        Those whose centre lies in the region; the surface is open where no camera sees it.
    """
    import open3d

    region = trained.region
    voxel = region.diagonal / voxels
    kinds = open3d.pipelines.integration.TSDFVolumeColorType
    volume = open3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=voxel, sdf_trunc=TRUNCATION_VOXELS * voxel, color_type=kinds.NoColor,
        volume_unit_resolution=_CUBE_VOXELS,
    )  # fmt: skip
    for camera in trained.scene.cameras:
        depth = depth_in_region(trained.gaussians, camera, region, threads)
        if not depth.any():
            continue
        color = np.zeros((*depth.shape, 3), np.uint8)
        images = open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(color), open3d.geometry.Image(depth), depth_scale=1.0,
            depth_trunc=float(depth.max()) * 2, convert_rgb_to_intensity=False,
        )  # fmt: skip
        # Open3D counts pixels from their centres, our cameras from the image's corner.
        intrinsic = open3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5
        )
        pose = np.vstack([camera.cam_from_world, [0.0, 0.0, 0.0, 1.0]])
        volume.integrate(images, intrinsic, pose)
    mesh = volume.extract_triangle_mesh()
    vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
    faces = np.asarray(mesh.triangles, np.int64).reshape(-1, 3)
    faces = faces[region.contains(vertices[faces].mean(1))] if len(faces) else faces
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3)
