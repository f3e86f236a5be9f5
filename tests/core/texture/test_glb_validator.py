# SPDX-License-Identifier: GPL-3.0-or-later
"""The Khronos glTF validator finds nothing in our files: no error, warning or hint.

``tools/gltf_validator.sh`` fetches it; ``GLTF_VALIDATOR`` may name its package folder instead.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.texture.files import write_glb, write_textured
from tests.core.texture.detail_scenes import bumpy_ball, flat_uvs
from tests.core.texture.test_files import UTM, cube

HERE = Path(__file__).parent
PACKAGE = Path(
    os.environ.get(
        "GLTF_VALIDATOR",
        HERE.parents[2] / ".cache" / "gltf-validator" / "node_modules" / "gltf-validator",
    )
)


def reports(files: list[Path]) -> list[dict[str, Any]]:
    """What the validator says of each file; skips where there is none."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node on the path")
    if not (PACKAGE / "package.json").is_file():
        pytest.skip("needs the Khronos validator: run tools/gltf_validator.sh")
    command = [node, HERE / "validate_gltf.cjs", PACKAGE, *files]
    done = subprocess.run(command, capture_output=True, check=True, timeout=60)
    return json.loads(done.stdout)


def problems(report: dict[str, Any]) -> list[str]:
    """Every message, in words."""
    assert report["info"]["version"] == "2.0"
    assert not report["issues"]["truncated"]
    return [
        f"{m['code']} {m.get('pointer', '')}: {m['message']}" for m in report["issues"]["messages"]
    ]


def with_maps() -> TexturedMesh:
    generator = np.random.default_rng(4)
    return replace(
        cube(),
        normal_map=np.full((32, 32, 3), (128, 128, 255), np.uint8),
        occlusion=generator.integers(0, 256, (16, 16), dtype=np.uint8),
    )


def odd() -> TexturedMesh:
    """UVs on the atlas's border and beyond, by rounding; a face without area; a lone vertex."""
    mesh = cube()
    uvs = mesh.corner_uvs.copy()
    uvs[0] = [[0, 0], [1, 0], [np.nextafter(np.float32(1), np.float32(2)), 1]]
    vertices = np.concatenate([mesh.mesh.vertices, [[9.0, 9, 9], mesh.mesh.vertices[0]]])
    flat = np.array([[0, 0, 0], [1, len(vertices) - 1, 0]], np.int32)
    faces = np.concatenate([mesh.mesh.faces, flat])
    uvs = np.concatenate([uvs, np.zeros((2, 3, 2), np.float32)])
    return replace(mesh, mesh=replace(mesh.mesh, vertices=vertices, faces=faces), corner_uvs=uvs)


def mapped_ball() -> TexturedMesh:
    """A curved mesh of charts, some mirrored, with a normal map."""
    ball = bumpy_ball(8)
    uvs = flat_uvs(ball)
    uvs[::7, :, 0] = 1.0 - uvs[::7, :, 0]
    return replace(with_maps(), mesh=ball, corner_uvs=uvs)


def several(make: Callable[[], TexturedMesh]) -> TexturedMesh:
    """The same with every other face in a second atlas."""
    mesh = make()
    first = mesh.atlases[0]
    owner = (np.arange(len(mesh.mesh.faces)) % 2).astype(np.uint8)
    return replace(mesh, face_atlas=owner, further=(first,))


MAKERS: dict[str, tuple[Callable[[], TexturedMesh], Similarity]] = {
    "plain": (cube, Similarity()),
    "maps": (with_maps, Similarity()),
    "ball": (mapped_ball, Similarity()),
    "far": (with_maps, UTM),
    "tiny": (cube, Similarity(1e-6)),
    "huge": (cube, Similarity(1e7)),
    "odd": (odd, Similarity()),
    "two": (lambda: several(cube), Similarity()),
    "two maps": (lambda: several(mapped_ball), UTM),
}


def test_the_khronos_validator_finds_nothing(tmp_path: Path) -> None:
    files = {}
    for name, (make, frame) in MAKERS.items():
        write_textured(make(), tmp_path / name, ("glb",), frame)
        files[name] = tmp_path / name / "mesh.glb"
    png = (tmp_path / "plain" / "albedo.png").read_bytes()
    for shading in ("lit", "unlit"):
        mesh = with_maps()
        files[shading] = tmp_path / f"{shading}.glb"
        write_glb(
            files[shading], mesh.mesh.vertices, mesh.mesh.faces, mesh.corner_uvs, [png],
            np.zeros(3), normal_png=[png], shading=shading,
        )  # fmt: skip
    said = dict(zip(files, reports(list(files.values())), strict=True))
    assert {name: problems(report) for name, report in said.items() if problems(report)} == {}
    assert all(
        r["info"]["totalTriangleCount"] == 12
        for n, r in said.items()
        if n not in ("odd", "ball", "two maps")
    )
    assert said["plain"]["info"]["extensionsUsed"] == ["KHR_materials_unlit"]
    assert said["maps"]["info"]["extensionsUsed"] == ["KHR_materials_specular"]
    unlit = said["unlit"]["info"]
    assert unlit["extensionsUsed"] == ["KHR_materials_unlit"]
    assert len(unlit["resources"]) == 2  # nobody would look at the normal map
    assert said["lit"]["info"]["extensionsUsed"] == ["KHR_materials_specular"]
    assert len(said["maps"]["info"]["resources"]) == 4  # the buffer and three images
    two = said["two maps"]["info"]
    assert len(two["resources"]) == 7
    assert two["drawCallCount"] == two["materialCount"] == 2
    assert two["totalTriangleCount"] == said["ball"]["info"]["totalTriangleCount"]


def test_the_validator_would_find_something(tmp_path: Path) -> None:
    write_textured(cube(), tmp_path, ("glb",), Similarity())
    data = (tmp_path / "mesh.glb").read_bytes()
    spoiled = tmp_path / "spoiled.glb"
    spoiled.write_bytes(data.replace(b'"wrapS":33071', b'"wrapS":33070'))
    assert spoiled.read_bytes() != data
    (report,) = reports([spoiled])
    assert [p.split()[0] for p in problems(report)] == ["VALUE_NOT_IN_LIST"]
