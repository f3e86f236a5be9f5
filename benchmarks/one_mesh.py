# SPDX-License-Identifier: GPL-3.0-or-later
"""One mesh of a training in a process of its own: by this program, or by TSDF fusion."""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.errors import MeshingError, ResourceError
from gaussian_wrapping_addon.core.field.samples import sample_depth_maps
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vector_field import VectorField
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh, save_mesh
from gaussian_wrapping_addon.core.meshing.clean_up import clean_up
from gaussian_wrapping_addon.core.meshing.pivot_meshing import mesh_by_pivots
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import MARGIN_SHARE, Field
from gaussian_wrapping_addon.core.parallel import default_threads
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.scene_regions import automatic_region, read_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.scene.scene import Scene, load_saved_scene
from gaussian_wrapping_addon.core.settings import MeshingSettings
from gaussian_wrapping_addon.core.worker.helper_process import largest_helper_bytes, own_peak_bytes

from .field_errors import field_gaussians
from .meshing_runs import FUSION, MEASURED, MESH, METHODS, PAM, TETRAHEDRA, Method
from .score import mesh_scene, stage_folder


@dataclasses.dataclass(frozen=True)
class Trained:
    """What a mesh is made of; scene frame."""

    scene: Scene
    """With the views only whose cameras the job's meshes are made from."""
    gaussians: OrientedGaussians
    region: Region


def open_trained(scene_folder: Path, job: Path) -> Trained:
    """Read a finished job; the region is that of the scene's folder, else the automatic one."""
    scene = load_saved_scene(stage_folder(job, "cameras"))
    gaussians = field_gaussians(stage_folder(job, "train") / "gaussians.npz")
    path = scene_folder / "region.json"
    if path.is_file():
        region = read_region(path).transformed(scene.world_from_scene.inverse())
    else:
        region = automatic_region(scene)
    return Trained(mesh_scene(job, scene), gaussians, region)


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


def make_mesh(trained: Trained, method: Method, *, threads: int, seed: int = 0) -> SurfaceMesh:
    """Return the mesh of a method, scene frame.

    Raises
    ------
    MeshingError
        There is no surface.
    ResourceError
        TSDF fusion was asked for and Open3D is missing.
    """
    if method.name == FUSION:
        vertices, faces = fuse(trained, method.size, threads=threads)
        if len(faces) == 0:
            raise MeshingError("The depth maps show no surface.", "Look at the training.")
        return SurfaceMesh(vertices, faces.astype(np.int32))
    arrays, cameras, region = trained.gaussians.arrays(), trained.scene.cameras, trained.region
    vacancy = VacancyField(arrays, cameras, threads=threads)
    depth_samples = sample_depth_maps(
        trained.gaussians, cameras, lambda p: region.contains(p, 0.0), Progress(), threads=threads
    )
    if method.name == TETRAHEDRA:
        settings = MeshingSettings(method="pivots", pivots=method.size)
        return mesh_by_pivots(
            vacancy,
            arrays,
            cameras,
            region,
            settings,
            Progress(),
            seed=seed,
            depth_samples=depth_samples,
        )
    settings = MeshingSettings(points=method.size, spacing=method.name)
    mesh = mesh_region(
        Field(vacancy, VectorField(arrays, threads=threads), threads),
        arrays,
        cameras,
        region,
        settings,
        Progress(),
        seed=seed,
        depth_samples=depth_samples,
    )
    return clean_up(mesh, region, settings, vacancy, Progress()).mesh


def cpu_seconds() -> float:
    """Return the processor time of this process and its ended children; NaN where unknown."""
    try:
        import resource
    except ImportError:
        return float("nan")
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    usages = [resource.getrusage(kind) for kind in kinds]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def measure(trained: Trained, method: Method, folder: Path, *, threads: int) -> dict[str, Any]:
    """Make a mesh, save it, and return seconds and memory."""
    if method.name == FUSION:
        require_open3d()
        import open3d  # noqa: F401  importing it takes seconds that fusion does not

    before_bytes = own_peak_bytes()
    wall_s, cpu_s = time.monotonic(), cpu_seconds()
    mesh = make_mesh(trained, method, threads=threads)
    wall_s, cpu_s = time.monotonic() - wall_s, cpu_seconds() - cpu_s
    own, helper = own_peak_bytes(), largest_helper_bytes()
    folder.mkdir(parents=True, exist_ok=True)
    save_mesh(folder / MESH, mesh)
    return {
        "method": method.name,
        "size": method.size,
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "peak_bytes": own + helper,
        "helper_bytes": helper,
        "before_bytes": before_bytes,
        "gaussians": len(trained.gaussians),
        "cameras": len(trained.scene.cameras),
        "provenance": mesh.provenance if method.name in PAM else {},
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the mesh and write ``mesh.npz`` and ``measured.json`` into the folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("job", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--method", choices=METHODS, required=True)
    parser.add_argument("--size", type=int, required=True)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args(arguments)
    trained = open_trained(options.scene, options.job)
    method = Method(options.method, options.size)
    threads = options.threads or default_threads()
    figures = measure(trained, method, options.folder, threads=threads)
    write_json(options.folder / MEASURED, figures)


if __name__ == "__main__":
    main()
