# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a ball with a known pattern, baked onto edited, moved and foreign meshes of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.mesh.exchange import FileMesh
from gaussian_wrapping_addon.core.mesh.simplification import decimate
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas
from gaussian_wrapping_addon.core.texture.bake_onto import BakeChoices, bake_onto, welded
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh
from tests.core.texture.texture_scenes import (
    FakePhotos,
    photograph,
    ring,
    scene_of,
    sphere,
    sphere_hit,
    waves,
)

SIZE_PX = 256
SPOT = np.array([1.0, 0.0, 0.3]) / np.linalg.norm([1.0, 0.0, 0.3])
"""Middle of what is edited on the ball."""
SPOT_COSINE = 0.8


def fine_waves(points: np.ndarray) -> np.ndarray:
    """Colours that change as fast as photos show: a wave is ten pixels long."""
    return waves(10.0 * points)


@pytest.fixture(scope="module")
def photos() -> FakePhotos:
    cameras = [*ring(8, 3.0, 1.6), *ring(8, 3.0, -1.6)]
    return photograph(cameras, [(sphere_hit, fine_waves)])


@pytest.fixture(scope="module")
def original(photos: FakePhotos, tmp_path_factory: pytest.TempPathFactory) -> TexturedMesh:
    """The job's own mesh and texture."""
    return texture_mesh(
        sphere(4), scene_of(photos), photos, TextureSettings(size_px=SIZE_PX, gutter_px=4),
        tmp_path_factory.mktemp("original"), Progress(), threads=1,
    )  # fmt: skip


def bake(
    given: FileMesh, photos: FakePhotos, folder: Path, *,
    uvs: str = "auto", faces: int = 0, size_px: int = SIZE_PX, **settings: object,
) -> TexturedMesh:  # fmt: skip
    chosen = TextureSettings(size_px=size_px, gutter_px=4, **settings)  # type: ignore[arg-type]
    return bake_onto(
        given, scene_of(photos), photos, chosen, BakeChoices(uvs, faces), folder, Progress(),
        threads=1,
    )  # fmt: skip


def psnr(textured: TexturedMesh, only: np.ndarray | None = None) -> float:
    """Return the PSNR of texels (around a direction) against what the photos show there."""
    squares = []
    faces = textured.mesh.faces
    for number, maps in enumerate(textured.atlases):
        mine = None if textured.face_atlas is None else textured.face_atlas == number
        raster = raster_atlas(textured.corner_uvs, len(maps.albedo), 1, mine)
        face, pair = raster.face[raster.inside], raster.bary[raster.inside].astype(float)
        weights = np.concatenate([pair, 1.0 - pair.sum(1, keepdims=True)], axis=1)
        points = np.einsum("nc,ncx->nx", weights, textured.mesh.vertices[faces[face]])
        points /= np.linalg.norm(points, axis=1, keepdims=True)  # what the photos show
        error = maps.albedo[raster.inside] - fine_waves(points)
        chosen = slice(None) if only is None else points @ only > SPOT_COSINE
        squares.append((error[chosen] ** 2).mean(axis=1))
    return float(10.0 * np.log10(255.0**2 / np.concatenate(squares).mean()))


def file_mesh(mesh: SurfaceMesh, corner_uvs: np.ndarray | None = None) -> FileMesh:
    return FileMesh(mesh.vertices, mesh.faces.astype(np.int64), corner_uvs)


def sculpted(mesh: SurfaceMesh, depth: float) -> SurfaceMesh:
    """Return a mesh that is smoothed at the spot, and has a dent there."""
    near = np.clip((mesh.vertices @ SPOT - SPOT_COSINE) / (1.0 - SPOT_COSINE), 0.0, 1.0)[:, None]
    lengths = np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    smooth = mesh.vertices * (1.0 + 0.6 * (1.0 / lengths - 1.0) * (near > 0.0))
    return SurfaceMesh(smooth * (1.0 - depth * np.sin(0.5 * np.pi * near) ** 2), mesh.faces)


def test_moved_uvs_of_its_own_show_the_same_texture(
    photos: FakePhotos, original: TexturedMesh, tmp_path: Path
) -> None:
    """The UVs are mirrored and turned; the faces keep their order and the UVs their bits."""
    own = np.stack([original.corner_uvs[..., 1], original.corner_uvs[..., 0]], axis=-1)
    baked = bake(file_mesh(original.mesh, own), photos, tmp_path)
    assert baked.statistics["unwrap"] == "own"
    assert baked.udims == ()
    assert np.array_equal(baked.corner_uvs, own)
    shown = baked.mesh.vertices[baked.mesh.faces]
    assert np.array_equal(shown, original.mesh.vertices[original.mesh.faces])
    assert psnr(baked) > psnr(original) - 0.5
    # The texture is the original's, mirrored at the diagonal.
    owned = raster_atlas(original.corner_uvs, SIZE_PX, 1).inside
    mirrored = baked.albedo[::-1].transpose(1, 0, 2)[::-1]
    step = np.abs(mirrored.astype(int) - original.albedo)[owned]
    assert np.percentile(step, 99) <= 6


@pytest.fixture(scope="module")
def rough(photos: FakePhotos, tmp_path_factory: pytest.TempPathFactory) -> TexturedMesh:
    """A mesh as training leaves it: off the true surface by a third of a pixel."""
    ball = sphere(4)
    noise = np.random.default_rng(0).normal(size=(len(ball.vertices), 1))
    rough = SurfaceMesh(ball.vertices * (1.0 + 0.005 * noise), ball.faces)
    return texture_mesh(
        rough, scene_of(photos), photos, TextureSettings(size_px=512, gutter_px=4),
        tmp_path_factory.mktemp("rough"), Progress(), threads=1,
    )  # fmt: skip


@pytest.mark.parametrize("faces", [0, 3000])
def test_an_edited_spot_is_as_good_as_the_original(
    faces: int, photos: FakePhotos, rough: TexturedMesh, tmp_path: Path
) -> None:
    """Smoothed and dented at a spot, second decimated, with UVs of another program."""
    edited = sculpted(rough.mesh, 0.003)
    if faces:
        fewer = decimate(edited.vertices, edited.faces, faces, Progress())
        edited = SurfaceMesh(fewer.vertices, fewer.faces.astype(np.int32))
    baked = bake(file_mesh(edited, cube_uvs(edited)), photos, tmp_path, size_px=512)
    assert baked.statistics["unwrap"] == "own"
    assert baked.statistics["texels_used"] < 1.1 * rough.statistics["texels_used"]
    assert psnr(baked, SPOT) > psnr(rough, SPOT) - 0.5
    assert psnr(baked) > psnr(rough) - 0.5


def cube_uvs(mesh: SurfaceMesh) -> np.ndarray:
    """Return UVs of another program: six squares, a face in that of the axis it points along."""
    points = mesh.vertices[mesh.faces]
    middle = points.mean(axis=1)
    axis = np.abs(middle).argmax(axis=1)
    rows = np.arange(len(points))
    side = 2 * axis + (middle[rows, axis] > 0.0)
    others = np.stack([(axis + 1) % 3, (axis + 2) % 3], axis=1)
    flat = np.take_along_axis(points, others[:, None, :], axis=2)
    flat = flat / np.abs(points[rows, :, axis])[..., None] / 1.5  # within -1 to 1
    cell = np.stack([side % 3, side // 3], axis=1)[:, None]
    return (cell + 0.5 + 0.5 * flat) / [3.0, 2.0]


def test_a_foreign_mesh_without_uvs_gets_both(photos: FakePhotos, tmp_path: Path) -> None:
    """Its file repeats the vertices for each face: they are welded, so that charts hold many."""
    shape = trimesh.creation.uv_sphere(radius=1.0, count=[24, 32])
    loose = FileMesh(
        shape.vertices[shape.faces].reshape(-1, 3), np.arange(3 * len(shape.faces)).reshape(-1, 3)
    )
    assert len(welded(loose).vertices) == len(np.unique(shape.vertices, axis=0))
    baked = bake(loose, photos, tmp_path)
    assert baked.statistics["unwrap"] == "xatlas"
    assert baked.statistics["charts"] < 60
    assert baked.statistics["texels_overlapping"] == 0
    assert psnr(baked) > 36.0


def test_new_uvs_replace_bad_ones_only_when_asked(photos: FakePhotos, tmp_path: Path) -> None:
    ball = sphere(3)
    bad = np.full((len(ball.faces), 3, 2), 0.5)
    with pytest.raises(MeshingError, match="no area"):
        bake(file_mesh(ball, bad), photos, tmp_path)
    baked = bake(file_mesh(ball, bad), photos, tmp_path, uvs="new")
    assert baked.statistics["unwrap"] == "xatlas"
    with pytest.raises(MeshingError, match="has no UVs"):
        bake(file_mesh(ball), photos, tmp_path, uvs="own")


def test_tiles_get_a_texture_each(
    photos: FakePhotos, original: TexturedMesh, tmp_path: Path
) -> None:
    upper = original.mesh.vertices[original.mesh.faces].mean(axis=1)[:, 2] > 0.0
    uvs = original.corner_uvs + np.where(upper, 2.0, 0.0)[:, None, None] * [1.0, 0.5]
    baked = bake(file_mesh(original.mesh, uvs), photos, tmp_path)
    assert baked.udims == (1001, 1013)
    assert len(baked.atlases) == 2
    assert baked.face_atlas is not None
    assert np.array_equal(baked.face_atlas == 1, upper)
    assert np.array_equal(baked.corner_uvs, original.corner_uvs)
    assert psnr(baked) > psnr(original) - 0.5


def test_overlaps_are_counted_in_a_warning(photos: FakePhotos, tmp_path: Path) -> None:
    """Both halves of the ball share the same part of the texture."""
    ball = sphere(3)
    uvs = 0.5 + 0.45 * ball.vertices[ball.faces][..., :2]
    baked = bake(file_mesh(ball, uvs), photos, tmp_path)
    codes = [warning["code"] for warning in baked.statistics["warnings"]]
    assert "uv-overlap" in codes
    assert baked.statistics["texels_overlapping"] > 0.5 * baked.statistics["texels_used"]


def test_fewer_faces_keep_their_detail_as_a_normal_map(photos: FakePhotos, tmp_path: Path) -> None:
    baked = bake(file_mesh(sphere(4)), photos, tmp_path, faces=400)
    assert abs(len(baked.mesh.faces) - 400) <= 8
    assert baked.statistics["normal_map"]["dense_faces"] == 5120
    flat = np.abs(baked.normal_map.astype(int) - (128, 128, 255)).max(axis=2)
    assert flat.max() > 2
    assert psnr(baked) > 30.0


def test_meshes_that_photos_do_not_fit_are_refused_or_warned_of(
    photos: FakePhotos, tmp_path: Path
) -> None:
    ball = sphere(2)

    def warned(vertices: np.ndarray, faces: np.ndarray) -> dict[str, str]:
        baked = bake(file_mesh(SurfaceMesh(vertices, faces)), photos, tmp_path)
        (warning,) = baked.statistics["warnings"]
        return warning

    with pytest.raises(MeshingError, match="No photo sees the mesh") as caught:
        warned(ball.vertices + np.array([0.0, 0.0, 50.0]), ball.faces)
    assert "normals" in caught.value.hint
    # Photos would see through the front of a mesh inside out, and paint the back.
    turned = ball.faces[:, ::-1].copy()
    with pytest.raises(MeshingError, match="point inwards"):
        warned(ball.vertices, turned)
    turned[1:] = ball.faces[1:]
    warning = warned(ball.vertices, turned)
    assert warning["code"] == "uneven-winding"
    assert "At 3 edges" in warning["text"]
    # A mesh in another unit, or at another place, that photos happen to show.
    assert warned(0.02 * ball.vertices, ball.faces)["code"] == "hardly-seen"


def test_automatic_size_follows_the_area_of_the_uvs(photos: FakePhotos, tmp_path: Path) -> None:
    """UVs that use a sixteenth of the texture need four times its side."""
    ball = sphere(3)
    sizes = [
        bake(file_mesh(ball, scale * cube_uvs(ball)), photos, tmp_path, size_px=0).statistics
        for scale in (1.0, 0.25)
    ]
    assert sizes[1]["size_px"] == 4 * sizes[0]["size_px"]
