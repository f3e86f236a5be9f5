# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes, arrays of stages, textures and exports that are broken or cannot be written."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.core.photos.test_formats import EPS, glb_with_texture
from tests.hostile.case import Build, Case, Group, Needs, Variant
from tests.hostile.inputs import changed, file, folder_of, link, pipe, steps
from tests.hostile.jobs import sphere, trained, with_result

_TEXTURE = "tests/core/texture/test_bad_input.py"
_STAGES = "tests/core/jobs/stages/test_damaged_stages.py"
_AGAIN = "Export the file again"
_GOOD = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def _mesh(name: str, suffix: str, content: bytes | str, says: str) -> Variant:
    build = steps(file(f"mesh.{suffix}", content), file("true.off", _GOOD))
    words = ("evaluate", f"mesh.{suffix}", "--truth", "true.off")
    return Variant(name, build, 3, rf"mesh\.{suffix}, {says}", words)


_GLB = glb_with_texture(EPS)
_CUT = r"whole file: cannot be read as a mesh \(.*it may be truncated.*" + _AGAIN
_NO_FACES = f"faces: there are none, or the file is truncated.*{_AGAIN}"
_MESHES = Case(
    46,
    "Meshes that are none",
    (
        _mesh("no faces", "off", "OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", _NO_FACES),
        _mesh(
            "a vertex NaN",
            "off",
            _GOOD.replace("1 0 0\n0", "nan 0 0\n0"),
            f"vertex 1: is not .*{_AGAIN}",
        ),
        _mesh("an index out of range", "off", _GOOD.replace("3 0 1 2", "3 0 1 9"), _CUT),
        _mesh("0 bytes", "obj", "", _NO_FACES),
        _mesh("words", "obj", "a mesh\n" * 9, _NO_FACES),
        _mesh("a cut GLB", "glb", _GLB[:200], _CUT),
        _mesh("a GLB of zeros", "glb", _GLB[:12] + b"\0" * 999, _CUT),
        _mesh("a GLB with PostScript", "glb", _GLB, f"whole file: .*Ghostscript.*{_AGAIN}"),
        _mesh("a cut STL", "stl", b"x" * 80 + struct.pack("<I", 2**31 - 1) + bytes(50), _NO_FACES),
        _mesh(
            "a PLY of 10¹⁷ faces",
            "ply",
            "ply\nformat ascii 1.0\nelement vertex 3\n"
            "property float x\nproperty float y\nproperty float z\nelement face "
            f"{10**17}\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n",
            _NO_FACES,
        ),
        _mesh("another format", "fbx", "Kaydara", "file name: not a known mesh format.*Use one of"),
        Variant(
            "a named pipe",
            steps(pipe("mesh.off"), file("true.off", _GOOD)),
            3,
            r"mesh\.off, whole file: the file does not exist.*Check the path",
            ("evaluate", "mesh.off", "--truth", "true.off"),
            needs=Needs.POSIX,
        ),
        Variant(
            "no truth",
            file("mesh.off", _GOOD),
            3,
            r"gone\.off does not exist\. Check the path after --truth",
            ("evaluate", "mesh.off", "--truth", "gone.off"),
        ),
    ),
    (f"{_TEXTURE}::test_46_refused", f"{_TEXTURE}::test_46_handled"),
)

_XATLAS = Case(
    47,
    "Meshes on which the unwrapper crashes or takes long",
    (),
    (
        f"{_TEXTURE}::test_47_large",
        f"{_TEXTURE}::test_47_far",
        f"{_TEXTURE}::test_47_refused",
        f"{_TEXTURE}::test_47_time_out",
    ),
)
_TEXTURES = Case(
    48,
    "Faces that no photo sees, photos behind the surface, textures of impossible sizes",
    (),
    (f"{_TEXTURE}::test_48_photos", f"{_TEXTURE}::test_48_sizes", f"{_TEXTURE}::test_48_memory"),
)

_EXPORT = ("export", "out", "--format", "glb", "--out", "new")
_ARRAYS = "out/result/auto/mesh.npz"
_MAKE_AGAIN = r"mesh\.npz, whole file: damaged .*Mesh the region again"


def _arrays(change: Callable[[dict[str, Any]], Any], write: Any = np.savez) -> Build:
    """Return the build of a result whose arrays are changed."""

    def build(folder: Path) -> None:
        with_result(folder)
        with np.load(folder / _ARRAYS, allow_pickle=False) as stored:
            arrays = dict(stored)
        change(arrays)
        write(folder / _ARRAYS, **arrays)

    return build


def _exported(
    name: str, build: Build, says: str, code: int = 3, words: tuple[str, ...] = _EXPORT, **more: Any
) -> Variant:
    return Variant(name, build, code, says, words, **more)


def _nan_vertex(arrays: dict[str, Any]) -> None:
    arrays["vertices"][2, 1] = np.nan


def _no_faces(arrays: dict[str, Any]) -> None:
    arrays["faces"], arrays["corner_uvs"] = arrays["faces"][:0], arrays["corner_uvs"][:0]


def _other_shape(arrays: dict[str, Any]) -> None:
    arrays["vertices"] = arrays["vertices"][:, :2]


def _bad_index(arrays: dict[str, Any]) -> None:
    arrays["faces"] = arrays["faces"] + 1000


def _objects(arrays: dict[str, Any]) -> None:
    arrays["vertices"] = np.array([{"code": 1}], object)


def _terabyte(folder: Path) -> None:
    with_result(folder)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**11, 10)}
    )
    with zipfile.ZipFile(folder / _ARRAYS, "w") as archive:
        archive.writestr("vertices.npy", header.getvalue())


_EXPORTS = Case(
    49,
    "Exports of what is broken, or to where nothing can be written",
    (
        _exported(
            "a vertex NaN",
            _arrays(_nan_vertex),
            "Vertex 2 of mesh auto is not finite. Mesh the region again",
        ),
        _exported(
            "no faces", _arrays(_no_faces), "Mesh auto has no faces. Choose a region with a surface"
        ),
        _exported(
            "an unknown format",
            with_result,
            "--format fbx2 is not known. Use glb, obj",
            2,
            ("export", "out", "--format", "fbx2", "--out", "new"),
        ),
        _exported(
            "a region that is not there",
            with_result,
            "holds no mesh Head. Use auto",
            2,
            (*_EXPORT, "--region", "Head"),
        ),
        _exported(
            "to a file",
            steps(with_result, file("new", "mine")),
            "new is a file. Give a folder for the exports",
            2,
        ),
        _exported(
            "under a file",
            steps(with_result, file("new", "mine")),
            "new/a cannot be written: Not a directory.*Check that the folder exists",
            4,
            ("export", "out", "--format", "glb", "--out", "new/a"),
        ),
        _exported(
            "to a read-only folder",
            steps(with_result, folder_of("new")),
            "cannot be written: .*Check that the folder exists, is not read-only",
            4,
            closed="new",
            needs=Needs.CLOSED_FOLDER,
        ),
        _exported("a job without a result", trained, "holds no mesh. Mesh a region first"),
        _exported(
            "no job",
            folder_of("out"),
            "out holds no job's result. Give the folder of a finished job",
            2,
        ),
    ),
    (
        f"{_TEXTURE}::test_49_refused",
        f"{_TEXTURE}::test_49_names",
        f"{_TEXTURE}::test_49_places",
        "tests/blender/test_export_objects.py::test_what_is_not_finite_is_refused",
        "tests/blender/test_export_objects.py::test_what_cannot_be_done_is_said",
    ),
)

_GAUSSIANS = "out/stages/train-*/gaussians.npz"


def _trained_arrays(change: Callable[[Path], object]) -> Build:
    """Return the build of a finished training whose Gaussians are damaged."""

    def build(folder: Path) -> None:
        sphere(folder)
        (path,) = folder.glob(_GAUSSIANS)
        change(path)

    return build


def _halve(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def _compressed(path: Path) -> None:
    np.savez_compressed(path, means=np.zeros((10_000_000, 3), np.float32))


def _pickled(path: Path) -> None:
    np.savez(path, means=np.array([{"code": 1}], object))


def _without(path: Path) -> None:
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    np.savez(path, **{name: array for name, array in arrays.items() if name != "means"})


def _disagreeing(path: Path) -> None:
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    np.savez(path, **{**arrays, "means": arrays["means"][:7]})


def _scene_entry(change: Callable[[dict[str, Any]], object]) -> Build:
    """Return the build of a finished training whose cameras are changed."""

    def build(folder: Path) -> None:
        sphere(folder)
        (path,) = folder.glob("out/stages/cameras-*/scene.json")
        values = json.loads(path.read_text())
        change(values)
        path.write_text(json.dumps(values))

    return build


_ESTIMATE = ("estimate-mesh", "--out", "out")
_RESUME = r"gaussians\.npz, whole file: .*Delete the folder and run the job again"


def _estimated(name: str, change: Callable[[Path], object], says: str = _RESUME) -> Variant:
    return Variant(name, _trained_arrays(change), 3, says, _ESTIMATE)


_CHECKPOINTS = Case(
    34,
    "Arrays of a training that are cut, made up, or do not fit together",
    (
        _estimated("cut", _halve),
        _estimated("0 bytes", lambda path: os.truncate(path, 0)),
        _estimated("missing", lambda path: path.unlink()),
        _estimated("compressed 100 MB of zeros", _compressed),
        _estimated("Python objects", _pickled),
        _estimated("without positions", _without),
        Variant(
            "a photo of 5000 characters",
            _scene_entry(lambda scene: scene["views"][0].update(photo="x" * 5000)),
            3,
            r"Photo .*xxx.* no longer exists.*Put it back, or start the job anew",
            _ESTIMATE,
        ),
        Variant(
            "a camera without size",
            _scene_entry(lambda scene: scene["views"][0]["camera"].update(width=-1)),
            3,
            r"scene\.json, views: not as expected \(the size or the focal length is out of range",
            _ESTIMATE,
        ),
        Variant(
            "a camera of words",
            _scene_entry(lambda scene: scene["views"][0]["camera"].update(fx="wide")),
            3,
            r"scene\.json, views: not as expected \(could not convert string to float",
            _ESTIMATE,
        ),
        _estimated(
            "of other lengths",
            _disagreeing,
            r"gaussians\.npz, log_scales: wrong shape .*Delete the folder",
        ),
    ),
    (
        f"{_STAGES}::test_a_damaged_training_is_trained_again",
        "tests/core/test_array_file.py::test_a_damaged_file_is_a_typed_error",
    ),
)

_RESULTS = Case(
    58,
    "Results whose arrays or maps are cut or made up",
    (
        _exported(
            "cut", steps(with_result, changed(_ARRAYS, lambda d: d[: len(d) // 2])), _MAKE_AGAIN
        ),
        _exported("0 bytes", steps(with_result, file(_ARRAYS)), _MAKE_AGAIN),
        _exported(
            "a link",
            steps(with_result, link(_ARRAYS, "../../../../beside/profile")),
            r"mesh\.npz.* is a link",
            needs=Needs.POSIX,
        ),
        _exported("says a terabyte", _terabyte, _MAKE_AGAIN),
        _exported("Python objects", _arrays(_objects), _MAKE_AGAIN),
        _exported(
            "two coordinates",
            _arrays(_other_shape),
            r"mesh\.npz, whole file: not a mesh file .*Mesh the region",
        ),
        _exported(
            "indices out of range",
            _arrays(_bad_index),
            "A face of mesh auto refers to a vertex that .*Mesh the region again",
        ),
        _exported(
            "no image as its texture",
            steps(with_result, file("out/result/auto/albedo.png", "x")),
            r"albedo\.png, whole file: not an image .*Mesh the region again",
        ),
        _exported(
            "scene.json cut",
            steps(with_result, file("out/result/scene.json", '{"wor')),
            r"scene\.json, line 1: not JSON",
        ),
        _exported(
            "scene.json a list",
            steps(with_result, file("out/result/scene.json", "[]")),
            r"scene\.json, world_from_scene: not a transform\. Run the job again",
        ),
        _exported(
            "placement.json cut",
            steps(with_result, file("out/result/placement.json", "{")),
            r"placement\.json, whole file: not JSON.*Delete the file",
            words=(*_EXPORT, "--placed"),
        ),
    ),
    (
        f"{_STAGES}::test_damaged_cameras_are_loaded_again",
        f"{_STAGES}::test_a_damaged_mesh_is_made_again",
        f"{_STAGES}::test_a_damaged_textured_mesh_is_made_again",
        "tests/blender/test_import_result.py::test_damaged_results_are_refused_and_change_nothing",
    ),
)

GROUP = Group("Meshes and results", (_CHECKPOINTS, _MESHES, _XATLAS, _TEXTURES, _EXPORTS, _RESULTS))
