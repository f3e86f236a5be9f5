# SPDX-License-Identifier: GPL-3.0-or-later
"""A texture spread over several atlases is as good as one: colours, packing, files, levels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("embreex")

from benchmarks.known_texture import (
    RenderedPhotos,
    SolidTexture,
    cameras_around,
    photograph,
    photos_that_see,
    psnr,
    spot,
    true_albedo,
)
from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import EXIT_RESOURCES, ResourceError
from gaussian_wrapping_addon.core.evaluation.mesh_rendering import TexturedRenderer
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas
from gaussian_wrapping_addon.core.texture.files import write_textured
from gaussian_wrapping_addon.core.texture.levels_of_detail import levels_of_detail
from gaussian_wrapping_addon.core.texture.size import (
    fit_into_memory,
    plan_textures,
    texture_memory_bytes,
)
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh
from gaussian_wrapping_addon.core.texture.unwrap import charts
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import unwrap
from tests.core.texture.detail_scenes import grid
from tests.core.texture.test_files import read_glb
from tests.proofs import first_then_proofs

SIDES = {1: 512, 2: 362, 3: 296}
"""About as many texels in all."""


@pytest.fixture(scope="module")
def pattern() -> SolidTexture:
    return SolidTexture()


@pytest.fixture(scope="module")
def photos(pattern: SolidTexture) -> RenderedPhotos:
    return photograph(spot(), pattern, cameras_around(16, 400, 300), 2)


class Bakes(dict[int, TexturedMesh]):
    """Spot by number of atlases, baked when it is first asked for."""

    def __init__(self, photos: RenderedPhotos, folder: Path) -> None:
        super().__init__()
        self._photos, self._folder = photos, folder

    def __missing__(self, atlases: int) -> TexturedMesh:
        settings = TextureSettings(SIDES[atlases], max_atlases=atlases)
        self[atlases] = texture_mesh(
            spot(), self._photos.scene(), self._photos, settings, self._folder, Progress(),
            threads=2,
        )  # fmt: skip
        return self[atlases]


@pytest.fixture(scope="module")
def baked(photos: RenderedPhotos, tmp_path_factory: pytest.TempPathFactory) -> Bakes:
    return Bakes(photos, tmp_path_factory.mktemp("atlases"))


def each_alone(textured: TexturedMesh) -> list[TexturedMesh]:
    """One textured mesh for each atlas, of its faces."""
    return [
        TexturedMesh(
            SurfaceMesh(textured.mesh.vertices, textured.mesh.faces[mine]),
            textured.corner_uvs[mine], maps.albedo, views=maps.views,
        )
        for number, maps in enumerate(textured.atlases)
        for mine in [textured.atlas_of_faces == number]
    ]  # fmt: skip


@pytest.mark.parametrize("atlases", first_then_proofs([2, 3]))
def test_several_atlases_bring_the_texture_back_as_one_does(
    atlases: int,
    baked: Bakes,
    photos: RenderedPhotos,
    pattern: SolidTexture,
) -> None:
    found = {}
    for count in (1, atlases):
        errors, texels = [], 0
        assert baked[count].statistics["atlases"] == len(baked[count].atlases) == count
        assert baked[count].statistics["texels_overlapping"] == 0
        for one in each_alone(baked[count]):
            truth, known = true_albedo(one, pattern)
            errors.append((one.albedo - truth)[known & (one.views > 0)])
            texels += int(known.sum())
        found[count] = psnr(np.concatenate(errors)), texels
    assert found[atlases][0] > found[1][0] - 0.7
    # Nor does the surface lose texels by being spread.
    assert found[atlases][1] > 0.8 * found[1][1]
    # Other faces may hide a part of the mesh: photos see the whole.
    for number, maps in enumerate(baked[atlases].atlases):
        assert np.mean(maps.views > 0) > 0.2, number


@pytest.mark.parametrize("atlases", first_then_proofs([2, 3]))
def test_what_two_photos_show_is_baked(atlases: int, baked: Bakes, photos: RenderedPhotos) -> None:
    textured = baked[atlases]
    for number, maps in enumerate(textured.atlases):
        mine = textured.atlas_of_faces == number
        # The judge needs the whole mesh: other atlases' faces get UVs without area.
        uvs = np.where(mine[:, None, None], textured.corner_uvs, np.float32(0))
        texels = np.flatnonzero(raster_atlas(uvs, SIDES[atlases], 2, mine).inside)
        whole = TexturedMesh(textured.mesh, uvs, maps.albedo)
        often = photos_that_see(whole, photos.cameras, texels) >= 2
        assert often.mean() > 0.8
        assert (maps.views.ravel()[texels[often]] > 0).all()


@pytest.mark.parametrize("atlases", first_then_proofs([2, 3]))
def test_the_mesh_stays_whole_and_looks_the_same(
    atlases: int, baked: Bakes, photos: RenderedPhotos
) -> None:
    one, several = baked[1], baked[atlases]
    assert (several.mesh.faces == one.mesh.faces).all()
    solid = trimesh.Trimesh(several.mesh.vertices, several.mesh.faces, process=False)
    assert solid.is_watertight
    camera = photos.cameras[3]
    pictures = [TexturedRenderer(t, threads=2).render(camera) for t in (one, several)]
    assert (pictures[0].coverage == pictures[1].coverage).all()
    inside = pictures[0].covered
    difference = pictures[0].image[inside].astype(float) - pictures[1].image[inside]
    assert psnr(difference) > 32.0


def test_charts_of_one_sheet_are_cut_to_fill_several_atlases(tmp_path: Path) -> None:
    """A sheet is one chart; two atlases must hold more texels of it than one."""
    mesh = grid(24, lambda xy: 0.04 * np.sin(4.5 * xy[:, 0]))
    texels = {}
    for atlases in (1, 2, 4):
        found = unwrap(mesh, 256, 2, tmp_path, Progress(), atlases=atlases)
        assert (found.method, found.atlases) == ("xatlas", atlases)
        rasters = [found.raster(256, 2, number) for number in range(atlases)]
        assert [raster.overlaps for raster in rasters] == [0] * atlases
        texels[atlases] = sum(int(raster.inside.sum()) for raster in rasters)
    assert texels[2] > 1.2 * texels[1]
    assert texels[4] > 2.0 * texels[1]


def test_the_fallback_unwrap_spreads_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(charts, "CHARTS_HELPER", "texture.no_such_helper")
    found = unwrap(spot(), 256, 2, tmp_path, Progress(), atlases=3)
    assert (found.method, found.atlases) == ("box", 3)
    assert [found.raster(256, 2, number).overlaps for number in range(3)] == [0, 0, 0]


def test_levels_of_detail_and_files(baked: Bakes, tmp_path: Path) -> None:
    textured = baked[2]
    settings = TextureSettings(lods=1, normal_map="on")
    (level,) = levels_of_detail(textured, None, settings, tmp_path, Progress(), threads=2)
    assert len(level.atlases) == 2
    assert level.atlases[1].normal_map is not None
    near = TexturedRenderer(textured, threads=2), TexturedRenderer(level, threads=2)
    camera = cameras_around(3, 96, 72)[1]
    pictures = [renderer.render(camera) for renderer in near]
    both = pictures[0].covered & pictures[1].covered
    error = pictures[0].image[both].astype(float) - pictures[1].image[both]
    assert psnr(error) > 20.0
    write_textured(level, tmp_path / "out", ("glb", "obj"), Similarity())
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"albedo.png", "albedo-2.png", "normal.png", "normal-2.png"} <= names
    with np.load(tmp_path / "out" / "mesh.npz", allow_pickle=False) as arrays:
        assert (arrays["face_atlas"] == level.face_atlas).all()
    document, _ = read_glb(tmp_path / "out" / "mesh.glb")
    assert [m["name"] for m in document["materials"]] == ["albedo", "albedo-2"]
    textures = [
        m["pbrMetallicRoughness"]["baseColorTexture"]["index"] for m in document["materials"]
    ]
    assert [document["images"][k]["name"] for k in textures] == ["albedo", "albedo-2"]
    assert len(document["meshes"][0]["primitives"]) == 2
    for name in ("mesh.glb", "mesh.obj"):
        read = trimesh.load(tmp_path / "out" / name, process=False)
        # Readers may give the parts in any order; materials have the names of their images.
        parts = sorted(read.geometry.values(), key=lambda part: part.visual.material.name)
        assert [part.visual.material.name for part in parts] == ["albedo", "albedo-2"]
        assert sum(len(part.faces) for part in parts) == len(level.mesh.faces)
        for part, maps in zip(parts, level.atlases, strict=True):
            material = part.visual.material
            image = getattr(material, "baseColorTexture", None) or material.image
            assert (np.asarray(image.convert("RGB")) == maps.albedo).all()


@pytest.mark.parametrize(
    ("wanted", "size_px", "max_atlases", "made"),
    [
        (1000.0, 0, 0, (1024, 1)),
        (8193.0, 0, 0, (4096, limits.MAX_AUTOMATIC_ATLASES)),
        (9000.0, 8192, 0, (8192, 2)),
        (9000.0, 2048, 0, (2048, 1)),
        (9000.0, 2048, 16, (2048, 16)),
        (3000.0, 2048, 4, (2048, 3)),
        (7000.0, 0, 8, (4096, 3)),
    ],
)
def test_as_many_textures_as_the_photos_ask_for(
    wanted: float, size_px: int, max_atlases: int, made: tuple[int, int]
) -> None:
    assert plan_textures(wanted, size_px, max_atlases) == made


def test_memory_is_judged_before() -> None:
    enough = texture_memory_bytes(4096, 2, 300_000)
    assert fit_into_memory(4096, 2, 300_000, enough, may_lower=True) == (4096, 2, None)
    assert fit_into_memory(8192, 4, 300_000, 0, may_lower=False) == (8192, 4, None)
    size_px, atlases, warning = fit_into_memory(4096, 2, 300_000, enough - 1, may_lower=True)
    assert (size_px, atlases) == (4096, 1)
    assert "4096" in warning.text
    with pytest.raises(ResourceError, match="8192") as refused:
        fit_into_memory(8192, 1, 300_000, enough, may_lower=False)
    assert refused.value.exit_code == EXIT_RESOURCES == 4
    assert "4096" in refused.value.hint
    with pytest.raises(ResourceError):
        fit_into_memory(256, 1, 300_000, 10**6, may_lower=True)


def test_too_little_memory_makes_a_smaller_texture_and_says_so(
    photos: RenderedPhotos, tmp_path: Path
) -> None:
    free = texture_memory_bytes(256, 1, len(spot().faces))
    textured = texture_mesh(
        spot(), photos.scene(), photos, TextureSettings(), tmp_path, Progress(),
        threads=2, free_bytes=free,
    )  # fmt: skip
    assert textured.statistics["size_px"] == 256
    assert "256" in textured.statistics["warnings"][0]["text"]
    with pytest.raises(ResourceError):
        texture_mesh(
            spot(), photos.scene(), photos, TextureSettings(1024), tmp_path, Progress(),
            threads=2, free_bytes=free,
        )  # fmt: skip
    assert not list(tmp_path.iterdir())
