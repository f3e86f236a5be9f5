# SPDX-License-Identifier: GPL-3.0-or-later
"""Exports of a result: coordinates map back to the world, and invalid data writes no file."""

from __future__ import annotations

import errno
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from gaussian_wrapping_addon.core.errors import (
    DatasetError,
    MeshingError,
    ParseError,
    ResourceError,
    UsageError,
)
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.gaussians.files import (
    read_foreign_splat,
    standard_names,
    write_splat_ply,
)
from gaussian_wrapping_addon.core.jobs.commands.export_files import (
    SPLAT_NAME,
    ExportRequest,
    export_files,
    frames_of,
    main,
    result_of,
)
from gaussian_wrapping_addon.core.jobs.store.job_file import (
    JobFile,
    code_fingerprint,
    sidecar_path,
    write_job,
)
from gaussian_wrapping_addon.core.names import file_stem, file_stems
from gaussian_wrapping_addon.core.ply import read_ply_header
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.frames import FileFrame
from gaussian_wrapping_addon.core.scene.placement import write_placement
from gaussian_wrapping_addon.core.settings import JobSettings
from gaussian_wrapping_addon.core.texture.files import write_textured
from tests.core.jobs.finished_sphere import write_cube
from tests.core.render.scenes import front_camera, random_gaussians
from tests.core.texture.test_files import UTM, cube
from tests.core.texture.test_glb_validator import with_maps

COS, SIN = np.cos(0.4), np.sin(0.4)
PLACEMENT = Similarity(
    0.25, np.array([[COS, 0, SIN], [0, 1, 0], [-SIN, 0, COS]]), np.array([0.5, -1.0, 2.0])
)
NEAR = Similarity(2.0, UTM.rotation, np.array([1.0, 2.0, 3.0]))


def write_result(job: Path, world_from_scene: Similarity = UTM) -> Path:
    """A result with region ``auto``, a level below it, and a placement."""
    result = job / "result"
    result.mkdir(parents=True)
    (result / "scene.json").write_text(
        json.dumps({"version": 1, "world_from_scene": world_from_scene.to_json()})
    )
    write_textured(with_maps(), result / "auto", (), world_from_scene)
    level = cube()
    smaller = replace(level.mesh, vertices=0.9 * level.mesh.vertices)
    write_textured(replace(level, mesh=smaller), result / "auto" / "lod1", (), world_from_scene)
    (result / "auto" / "region.json").write_text('{"version": 1, "vertices": []}')
    (result / "auto" / "figures.json").write_text('{"training": "abc"}')
    write_placement(result / "placement.json", PLACEMENT, world_from_scene)
    region = "/home/me/secret/Head.json"
    settings = replace(JobSettings(), regions=("auto", region))
    body = read_json(write_cube(job.parent / "Head.json"))
    write_job(job / "job.json", JobFile("wrap", "/home/me/photos", settings, {region: body}))
    return result


def exported(request: ExportRequest) -> dict[str, Path]:
    return {path.name: path for path in export_files(request)}


def sidecar(path: Path) -> dict:
    return json.loads(sidecar_path(path).read_text())


def similarity(values: dict, name: str) -> Similarity:
    return Similarity.from_json(values[name])


@pytest.mark.parametrize("placed", [False, True])
@pytest.mark.parametrize("world_from_scene", [UTM, NEAR, Similarity(1e-4), Similarity(1e5)])
def test_files_lead_back_to_the_world(
    tmp_path: Path, placed: bool, world_from_scene: Similarity
) -> None:
    result = write_result(tmp_path / "job", world_from_scene)
    request = ExportRequest(
        result, tmp_path / "out", ("glb", "obj", "ply"), placed=placed, levels=True
    )
    found = exported(request)
    assert sorted(found) == [
        f"{stem}.{f}" for stem in ("auto-lod1", "auto") for f in ("glb", "obj", "ply")
    ]
    for name, path in found.items():
        values = sidecar(path)
        scale = 0.9 if "lod1" in name else 1.0
        scene = scale * cube().mesh.vertices
        world = world_from_scene.points(scene)
        size = np.ptp(world, axis=0).max()
        read = trimesh.load(path, force="mesh", process=False)
        back = similarity(values, "world_from_file").points(read.vertices)
        distance = np.linalg.norm(back[:, None] - world[None], axis=2)
        # Roundings of the far coordinates themselves, and of single precision or nine digits.
        rounding = 4 * np.abs(world).max() * np.finfo(float).eps
        allowed = rounding + size * (1e-14 if name.endswith("ply") else 3e-6 if placed else 1e-5)
        assert distance.min(axis=1).max() < allowed
        assert distance.min(axis=0).max() < allowed
        # And by the other two ways.
        in_scene = similarity(values, "scene_from_file").points(read.vertices)
        in_blender = similarity(values, "blender_from_file").points(read.vertices)
        assert np.abs(PLACEMENT.points(in_scene) - in_blender).max() < 1e-9
        if placed:
            assert values["offset"] == [0, 0, 0]
            turned = in_blender @ FileFrame(path.suffix[1:], PLACEMENT).turn.T
            assert np.abs(turned - read.vertices).max() < 1e-9
        assert (values["placed"], values["format"]) == (placed, path.suffix[1:])
        # Levels lie over each other, also far away.
        whole = sidecar(found[name.replace("-lod1", "")])
        assert values["offset"] == whole["offset"]
    if world_from_scene is UTM and not placed:
        assert np.abs(sidecar(found["auto.glb"])["offset"]).max() > 1e6


def test_a_sidecar_says_of_what_and_no_path(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    (path,) = exported(ExportRequest(result, tmp_path / "out", ("obj",))).values()
    values, text = sidecar(path), sidecar_path(path).read_text()
    assert "/home/me" not in text
    assert str(tmp_path) not in text
    assert values["job"]["name"] == "job"
    assert values["job"]["source"] == "photos"
    assert values["job"]["settings"]["regions"] == ["auto", "Head.json"]
    assert values["region"] == "auto"
    assert values["region_body"] == {"version": 1, "vertices": []}
    assert values["training"] == "abc"
    assert (values["vertices"], values["faces"], values["level"]) == (8, 12, 0)
    assert (values["up"], values["front"]) == ("+Y", "+Z")
    assert values["made_with"]["add_on"] == "0.1.0"
    assert values["made_with"]["code"] == code_fingerprint()
    assert values["textures"] == ["auto-albedo.png", "auto-normal.png"]
    material = path.with_suffix(".mtl").read_text()
    for name in values["textures"]:
        assert f" {name}\n" in material
        original = result / "auto" / name.removeprefix("auto-")
        assert (tmp_path / "out" / name).read_bytes() == original.read_bytes()


@pytest.mark.parametrize("shading", ["auto", "lit", "unlit"])
def test_shading_of_glb(tmp_path: Path, shading: str) -> None:
    result = write_result(tmp_path / "job")
    request = ExportRequest(result, tmp_path / "out", ("glb",), levels=True, shading=shading)
    for name, path in exported(request).items():
        has_maps = name == "auto.glb"
        wanted = shading if shading != "auto" else ("lit" if has_maps else "unlit")
        assert sidecar(path)["shading"] == wanted
        data = path.read_bytes()
        assert (b"KHR_materials_unlit" in data) == (wanted == "unlit")
        assert (b'"normalTexture"' in data) == (has_maps and wanted == "lit")


def test_a_result_that_was_never_placed(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job", NEAR)
    (result / "placement.json").unlink()
    assert frames_of(result)[1].to_json() == Similarity().to_json()
    (path,) = exported(ExportRequest(result, tmp_path / "out", ("ply",), placed=True)).values()
    read = trimesh.load(path, force="mesh", process=False)
    assert np.array_equal(read.vertices, cube().mesh.vertices)
    # Of other cameras: as never placed.
    write_placement(result / "placement.json", PLACEMENT, UTM)
    assert frames_of(result)[1].to_json() == Similarity().to_json()


def test_what_is_not_finite_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    mesh = cube()
    for key, at in (("vertices", (2, 0)), ("corner_uvs", (3, 1, 0))):
        arrays = {
            "vertices": mesh.mesh.vertices.copy(), "faces": mesh.mesh.faces,
            "corner_uvs": mesh.corner_uvs.copy(),
        }  # fmt: skip
        arrays[key][at] = np.nan if key == "vertices" else np.inf
        np.savez(result / "auto" / "mesh.npz", **arrays)
        for name in ("glb", "obj", "ply"):
            with pytest.raises(MeshingError, match=r"mesh auto.* not finite"):
                exported(ExportRequest(result, tmp_path / "out", (name,)))
    gaussians = random_gaussians(20, 3, dtype=torch.float32)
    gaussians.means[0], gaussians.means[1] = 3e38, -3e38
    write_splat_ply(result / "gaussians.ply", gaussians, UTM)
    with pytest.raises(MeshingError, match="Gaussian 0"):  # in the world's unit: beyond float32
        exported(ExportRequest(result, tmp_path / "out", ("splat",)))
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_exported_is_said(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    good = ExportRequest(result, tmp_path / "out", ("glb",))
    with pytest.raises(UsageError, match="'fbx' cannot be exported"):
        exported(replace(good, formats=("glb", "fbx")))
    with pytest.raises(UsageError, match="shiny"):
        exported(replace(good, shading="shiny"))
    with pytest.raises(UsageError, match="no mesh nose"):
        exported(replace(good, regions=("nose",)))
    with pytest.raises(DatasetError, match=r"no gaussians\.ply"):
        exported(replace(good, formats=("glb", "splat")))
    assert not (tmp_path / "out").exists(), "half is easily taken for all"
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="is a file"):
        exported(replace(good, out=tmp_path / "file"))
    with pytest.raises(ResourceError, match="cannot be written"):
        exported(replace(good, out=tmp_path / "file" / "out"))
    (result / "auto" / "albedo.png").write_text("no image")
    with pytest.raises(ParseError, match=r"albedo\.png"):
        exported(good)
    mesh = result / "auto" / "mesh.npz"
    data = bytearray(mesh.read_bytes())
    data[len(data) // 2] ^= 1
    mesh.write_bytes(data)
    with pytest.raises(ParseError, match=r"mesh\.npz.*damaged"):
        exported(good)
    mesh.write_text("no mesh")
    with pytest.raises(ParseError, match=r"mesh\.npz"):
        exported(good)
    with pytest.raises(UsageError, match="holds no job's result"):
        result_of(tmp_path)
    assert result_of(tmp_path / "job") == result_of(result) == result.resolve()


@pytest.mark.parametrize(
    ("format", "map_name"), [("glb", "normal"), ("glb", "occlusion"), ("obj", "normal")]
)
def test_a_broken_or_missing_map_is_not_handed_on(
    tmp_path: Path, format: str, map_name: str
) -> None:
    result = write_result(tmp_path / "job")
    request = ExportRequest(result, tmp_path / "out", (format,))
    path = result / "auto" / f"{map_name}.png"
    whole = path.read_bytes() if path.is_file() else b""
    path.write_text("no image")
    with pytest.raises(ParseError, match=rf"{map_name}\.png"):
        exported(request)
    assert not (tmp_path / "out" / f"auto.{format}").exists()
    path.write_bytes(whole) if whole else path.unlink()
    with np.load(result / "auto" / "mesh.npz") as arrays:
        mesh = dict(arrays)
    mesh["face_atlas"] = (np.arange(len(mesh["faces"])) % 2).astype(np.uint8)
    np.savez(result / "auto" / "mesh.npz", **mesh)
    shutil.copy(result / "auto" / "albedo.png", result / "auto" / "albedo-2.png")
    with pytest.raises(ParseError, match=r"normal-2\.png"):
        exported(request)


@pytest.mark.parametrize("format", ["glb", "obj"])
def test_a_full_disk_leaves_no_cut_file(
    tmp_path: Path, format: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = write_result(tmp_path / "job")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(ResourceError, match=r"No room is left.*auto"):
        exported(ExportRequest(result, tmp_path / "out", (format,)))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("region", "level", "wanted"),
    [
        ("My Head", 2, "My_Head-lod2"),
        ("...", 0, "mesh"),
        ("é/b", 0, "é_b"),
        ("COM1.old", 1, "mesh_COM1.old-lod1"),
        ("console", 0, "console"),
    ],
)
def test_names_of_files(region: str, level: int, wanted: str) -> None:
    assert file_stem(region, level) == wanted


def test_no_two_meshes_have_one_name() -> None:
    meshes = [
        ("Head", 0), ("head", 0), ("a b", 0), ("a_b", 0), ("auto", 0), ("auto", 1),
        ("auto-lod1", 0), ("Gaussians.Splat", 0), ("x" * 300, 0), ("x" * 301, 0), ("é" * 150, 0),
    ]  # fmt: skip
    stems = file_stems(meshes)
    assert len({stem.casefold() for stem in stems.values()} | {"gaussians.splat"}) == 12
    assert stems["auto", 0] == "auto"
    assert all(len(f"{stem}-occlusion.png.json.writing.12345678".encode()) < 255
               for stem in stems.values())  # fmt: skip
    # Which others there are changes no name of those that would be alike.
    assert file_stems([("a b", 0), ("a_b", 0)])["a b", 0] == stems["a b", 0]


def test_exports_of_regions_with_one_name_do_not_replace_each_other(tmp_path: Path) -> None:
    """Folders of a result may be renamed; regions may be exported one by one."""
    result = write_result(tmp_path / "job")
    names = ("a b", "a_b", "A_B", "auto-lod1")
    for name in names:
        shutil.copytree(result / "auto", result / name)
    out = tmp_path / "out"
    whole = ExportRequest(result, out, ("glb", "obj"), levels=True)
    written = [p for name in names for p in export_files(replace(whole, regions=(name,)))]
    written += export_files(replace(whole, regions=("auto",)))
    assert len(written) == 2 * 2 * 5
    assert len({str(path).casefold() for path in written}) == len(written)
    assert {sidecar(path)["region"] for path in written} == {*names, "auto"}
    assert sorted(export_files(whole)) == sorted(written)


@pytest.mark.parametrize("placed", [False, True])
def test_another_reader_sees_the_same_splat(tmp_path: Path, placed: bool) -> None:
    """Standard properties alone, read without our filter, rendered from the moved camera."""
    result = write_result(tmp_path / "job", NEAR)
    gaussians = random_gaussians(60, 5, dtype=torch.float32, sh_degree=2, filter_size=0.1)
    write_splat_ply(result / "gaussians.ply", gaussians, NEAR)
    (path,) = exported(ExportRequest(result, tmp_path / "out", ("splat",), placed=placed)).values()
    assert path.name == SPLAT_NAME
    properties = [n for n, _ in read_ply_header(path, "").elements[0].properties]
    assert properties == standard_names(9)
    found = read_foreign_splat(path).gaussians
    assert not found.filter_3d.any()
    camera = front_camera(96, 80, focal=110.0)
    file_from_scene = similarity(sidecar(path), "scene_from_file").inverse()
    rotation = camera.cam_from_world[:, :3] @ file_from_scene.rotation.T
    move = file_from_scene.scale * camera.cam_from_world[:, 3] - rotation @ (
        file_from_scene.translation
    )
    moved = replace(camera, cam_from_world=np.concatenate([rotation, move[:, None]], axis=1))
    options = RenderOptions(depth=False, sh_degree=2, threads=1)
    wanted = render(gaussians, camera, options).color.numpy()
    seen = render(found, moved, options).color.numpy()
    without = render(gaussians.replaced(filter_3d=0 * gaussians.filter_3d), camera, options)

    def psnr(image: np.ndarray) -> float:
        return float(-10 * np.log10(((image - wanted) ** 2).mean()))

    assert wanted.std() > 0.05
    assert psnr(seen) > 50
    assert psnr(without.color.numpy()) < 40  # the filter matters here


def test_the_child_speaks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = write_result(tmp_path / "job")
    request = {
        "result": str(result), "out": str(tmp_path / "out"), "formats": ["ply"], "placed": False,
        "regions": [], "levels": False, "shading": "auto",
    }  # fmt: skip
    assert main([json.dumps(request)]) == 0
    assert main([json.dumps({**request, "regions": ["nose"]})]) == 2
    first, second = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert first["line"].endswith("auto.ply")
    assert "nose" in second["error"]
    assert second["hint"] == "Use auto."
