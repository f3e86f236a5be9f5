# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat files of ours and of other programs: all conventions, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError
from gaussian_wrapping_addon.core.evaluation.layouts import is_cloud
from gaussian_wrapping_addon.core.gaussians.files import (
    SURFEL_THICKNESS,
    ForeignSplat,
    read_foreign_splat,
    read_splat_ply,
    write_splat_ply,
    write_viewer_ply,
)
from gaussian_wrapping_addon.core.gaussians.model import SH_C0, OrientedGaussians
from gaussian_wrapping_addon.core.ply import MAX_HEADER_BYTES, read_ply_header, read_vertices
from gaussian_wrapping_addon.core.scene.camera import Similarity
from tests.core.gaussians.splat_files import permuted, splat_columns, write_ply
from tests.core.render.scenes import random_gaussians

FRAME = Similarity(
    123.5, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5e5, 4e6, 1.5])
)


def written(path: Path, degree: int = 2, count: int = 40) -> Path:
    gaussians = random_gaussians(count, 3, dtype=torch.float32, sh_degree=degree)
    write_splat_ply(path, gaussians, FRAME)
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_native_round_trip_is_exact(tmp_path: Path, degree: int) -> None:
    path = written(tmp_path / "a.ply", degree)
    back = read_splat_ply(path)
    for name, tensor in random_gaussians(40, 3, dtype=torch.float32, sh_degree=degree).tensors():
        assert torch.equal(getattr(back.gaussians, name), tensor), name
    assert back.dropped == 0
    assert back.world_from_scene is not None
    assert np.array_equal(back.world_from_scene.matrix(), FRAME.matrix())


def split(path: Path) -> tuple[list[str], bytes]:
    head, body = path.read_bytes().split(b"end_header\n", 1)
    return head.decode().splitlines(), body


def test_layout_is_that_of_the_original_code(tmp_path: Path) -> None:
    path = written(tmp_path / "a.ply", 1, 5)
    lines, body = split(path)
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert names == [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2",
        *(f"f_rest_{i}" for i in range(9)), "opacity", "scale_0", "scale_1", "scale_2",
        "rot_0", "rot_1", "rot_2", "rot_3", "filter_3D",
        *(f"gaussian_features_{i}" for i in range(4)),
    ]  # fmt: skip
    table = np.frombuffer(body, "<f4").reshape(5, len(names))
    gaussians = random_gaussians(5, 3, dtype=torch.float32, sh_degree=1)
    # Channel by channel: the three red coefficients come first.
    assert np.array_equal(table[:, 9:12], gaussians.sh[:, 1:, 0].numpy())
    assert np.array_equal(table[:, 15:18], gaussians.sh[:, 1:, 2].numpy())
    assert not table[:, 3:6].any()


def test_any_order_doubles_and_extra_properties_are_read(tmp_path: Path) -> None:
    path = written(tmp_path / "a.ply", 1)
    lines, body = split(path)
    names = [line.split()[2] for line in lines if line.startswith("property")]
    table = np.frombuffer(body, "<f4").reshape(40, -1)
    order = np.random.default_rng(0).permutation(len(names)).tolist()
    kind = np.dtype([("more", "u1"), *((names[i], "<f8" if i % 2 else "<f4") for i in order)])
    shuffled = np.zeros(40, kind)
    for i in order:
        shuffled[names[i]] = table[:, i]
    head = "ply\r\nformat binary_little_endian 1.0\r\nobj_info x\r\nelement vertex 40\r\n"
    head += "property uchar more\r\n"
    head += "".join(f"property {'double' if i % 2 else 'float'} {names[i]}\r\n" for i in order)
    other = tmp_path / "b.ply"
    other.write_bytes(head.encode() + b"end_header\r\n" + shuffled.tobytes())
    first, second = read_splat_ply(path), read_splat_ply(other)
    for name, tensor in first.gaussians.tensors():
        assert torch.equal(getattr(second.gaussians, name), tensor), name
    assert second.world_from_scene is None


def test_viewers_file_has_the_filter_baked_in(tmp_path: Path) -> None:
    gaussians = random_gaussians(30, 1, dtype=torch.float32, sh_degree=1, filter_size=0.2)
    path = tmp_path / "v.ply"
    write_viewer_ply(path, gaussians)
    lines, body = split(path)
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert names[-1] == "rot_3"
    assert "filter_3D" not in names
    table = np.frombuffer(body, "<f4").reshape(30, -1).astype(np.float64)
    opacity = 1 / (1 + np.exp(-table[:, names.index("opacity")]))
    scales = np.exp(table[:, names.index("scale_0") : names.index("scale_0") + 3])
    arrays = gaussians.arrays()
    assert np.abs(scales / arrays.scales - 1).max() < 1e-5
    assert np.abs(opacity / np.exp(arrays.log_opacities) - 1).max() < 1e-5


def test_senseless_gaussians_are_dropped_and_counted(tmp_path: Path) -> None:
    gaussians = random_gaussians(20, 3, dtype=torch.float32)
    gaussians.means[1, 0] = np.nan
    gaussians.opacity_logits[2] = np.inf
    gaussians.quats[3] = 0.0
    gaussians.log_scales[4, 2] = 80.0
    write_splat_ply(tmp_path / "a.ply", gaussians, FRAME)
    back = read_splat_ply(tmp_path / "a.ply")
    assert back.dropped == 4
    assert torch.equal(back.gaussians.means[1:], gaussians.means[5:])
    gaussians.means[:] = np.inf
    write_splat_ply(tmp_path / "b.ply", gaussians, FRAME)
    with pytest.raises(ParseError):
        read_splat_ply(tmp_path / "b.ply")


def test_files_cut_anywhere_are_refused(tmp_path: Path) -> None:
    data = written(tmp_path / "a.ply", 0, 3).read_bytes()
    cut = tmp_path / "cut.ply"
    for length in range(len(data)):
        cut.write_bytes(data[:length])
        with pytest.raises(ParseError):
            read_splat_ply(cut)
    cut.write_bytes(data + b"garbage")
    assert len(read_splat_ply(cut).gaussians) == 3


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("ply", "plx"),
        ("binary_little_endian", "ascii"),
        ("binary_little_endian", "binary_big_endian"),
        ("element vertex 40", f"element vertex {2**31 - 1}"),
        ("element vertex 40", f"element vertex {10**18}"),
        ("element vertex 40", "element vertex -4"),
        ("element vertex 40", "element vertex"),
        ("element vertex 40", "element vertex 40\nelement face 2"),
        ("element vertex 40", "element chunk 40"),
        ("property float x", "property list uchar int x"),
        ("property float x", "property float y"),
        ("property float f_dc_0", "property float other"),
        ("property float f_rest_8", "property float other"),
        ("property float filter_3D", "property float other"),
        ("comment world_from_scene {", "comment world_from_scene ["),
        ("element vertex 40", "surprise\nelement vertex 40"),
        ("comment", "comment " + 70_000 * "x" + "\ncomment"),
    ],
)
def test_headers_that_lie_are_refused(tmp_path: Path, old: str, new: str) -> None:
    path = written(tmp_path / "a.ply", 1)
    head, body = path.read_bytes().split(b"end_header\n", 1)
    assert old.encode() in head
    path.write_bytes(head.replace(old.encode(), new.encode(), 1) + b"end_header\n" + body)
    with pytest.raises(ParseError) as caught:
        read_splat_ply(path)
    assert "a.ply" in str(caught.value)
    assert caught.value.hint


def test_no_gaussians_cannot_be_read_back(tmp_path: Path) -> None:
    path = written(tmp_path / "a.ply", 0, 1)
    data = path.read_bytes().replace(b"element vertex 1", b"element vertex 0")
    path.write_bytes(data)
    with pytest.raises(ParseError):
        read_splat_ply(path)


COUNT = 30


def example(degree: int = 3) -> OrientedGaussians:
    made = random_gaussians(COUNT, 3, dtype=torch.float32, sh_degree=degree, filter_size=0.0)
    return made.replaced(orientation=torch.zeros(COUNT, 4))


def assert_same(found: ForeignSplat, wanted: OrientedGaussians) -> None:
    for name, tensor in wanted.tensors():
        assert torch.equal(getattr(found.gaussians, name).to(tensor.dtype), tensor), name


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("normals", [True, False])
def test_inria_and_gsplat_files_are_read_exactly(
    tmp_path: Path, degree: int, normals: bool
) -> None:
    wanted = example(degree)
    path = write_ply(tmp_path / "a.ply", splat_columns(wanted, normals=normals))
    found = read_foreign_splat(path)
    assert_same(found, wanted)
    assert found.gaussians.means.dtype == torch.float32
    assert (found.dropped, found.warnings, found.oriented) == (0, (), False)
    assert found.facts["splat_degree"] == degree


@pytest.mark.parametrize("encoding", ["<", ">", "ascii"])
def test_any_order_types_and_extras_change_nothing(tmp_path: Path, encoding: str) -> None:
    wanted = example()
    columns = splat_columns(wanted)
    random = np.random.default_rng(5)
    columns["segment"] = random.integers(0, 255, COUNT)
    columns["confidence"] = random.normal(size=COUNT)
    kinds = {"segment": "u1", **dict.fromkeys(("x", "y", "z", "confidence", "rot_2"), "f8")}
    faces = "element camera 2\nproperty float focal\nproperty list uchar int ids"
    path = write_ply(
        tmp_path / "a.ply", columns, encoding=encoding, kinds=kinds, order=permuted(columns),
        after=(faces, b"12 3 1 2 3\n" * 2),
    )  # fmt: skip
    assert path.read_bytes().count(b"\nproperty ") == len(columns) + 2
    assert_same(read_foreign_splat(path), wanted)


def test_doubles_keep_their_digits(tmp_path: Path) -> None:
    columns = splat_columns(example())
    columns["x"] = columns["x"].astype(np.float64) + 4.5e6
    path = write_ply(tmp_path / "a.ply", columns, kinds=dict.fromkeys("xyz", "f8"))
    found = read_foreign_splat(path).gaussians
    assert found.means.dtype == torch.float64
    assert np.array_equal(found.means[:, 0].numpy(), columns["x"])


def test_the_viewers_file_is_read_to_the_last_bit(tmp_path: Path) -> None:
    filtered = random_gaussians(COUNT, 1, dtype=torch.float32, sh_degree=2, filter_size=0.2)
    path = tmp_path / "v.ply"
    write_viewer_ply(path, filtered)
    table = np.frombuffer(path.read_bytes().split(b"end_header\n", 1)[1], "<f4").reshape(COUNT, -1)
    found = read_foreign_splat(path).gaussians
    for name in ("means", "quats", "sh"):
        assert torch.equal(getattr(found, name), getattr(filtered, name)), name
    first = 6 + 27  # positions, normals, harmonics
    assert np.array_equal(found.opacity_logits.numpy(), table[:, first])
    assert np.array_equal(found.log_scales.numpy(), table[:, first + 1 : first + 4])
    np.testing.assert_allclose(found.scales(), filtered.scales(), rtol=1e-5)
    np.testing.assert_allclose(found.log_opacities(), filtered.log_opacities(), atol=1e-5)


def test_our_own_file_keeps_filter_and_orientation(tmp_path: Path) -> None:
    wanted = random_gaussians(COUNT, 1, dtype=torch.float32, sh_degree=1, filter_size=0.2)
    write_splat_ply(tmp_path / "n.ply", wanted, Similarity())
    found = read_foreign_splat(tmp_path / "n.ply")
    assert_same(found, wanted)
    assert found.oriented


def test_degree_4_is_cut_and_said(tmp_path: Path) -> None:
    gaussians = example(3)
    more = torch.cat([gaussians.sh, torch.full((COUNT, 9, 3), 7.0)], dim=1)
    path = write_ply(tmp_path / "a.ply", splat_columns(gaussians.replaced(sh=more)))
    found = read_foreign_splat(path)
    assert torch.equal(found.gaussians.sh, gaussians.sh)
    assert "degree 4" in found.warnings[0].text


def test_surfels_get_a_thin_third_axis(tmp_path: Path) -> None:
    columns = splat_columns(example(0))
    del columns["scale_2"]
    found = read_foreign_splat(write_ply(tmp_path / "a.ply", columns)).gaussians
    scales = torch.exp(found.log_scales.double())
    shorter = scales[:, :2].amin(1)
    np.testing.assert_allclose(scales[:, 2], SURFEL_THICKNESS * shorter, rtol=1e-6)
    assert bool((found.log_scales.argmin(1) == 2).all())


def test_plain_colours_stand_for_the_constant_harmonic(tmp_path: Path) -> None:
    columns = splat_columns(example(0))
    for i, name in enumerate(("red", "green", "blue")):
        del columns[f"f_dc_{i}"]
        columns[name] = np.arange(COUNT) * (i + 1)
    kinds = dict.fromkeys(("red", "green", "blue"), "u1")
    found = read_foreign_splat(write_ply(tmp_path / "a.ply", columns, kinds=kinds)).gaussians
    color = 0.5 + SH_C0 * found.sh[:, 0].numpy()
    np.testing.assert_allclose(255 * color[:, 2], columns["blue"], atol=1e-4)


def test_senseless_foreign_gaussians_are_dropped_and_counted(tmp_path: Path) -> None:
    columns = {name: np.array(column) for name, column in splat_columns(example(1)).items()}
    for row, (name, value) in enumerate(
        [("x", np.nan), ("opacity", np.inf), ("scale_1", 80.0), ("f_rest_4", -np.inf)]
    ):
        columns[name][row] = value
    for i in range(4):
        columns[f"rot_{i}"][4] = 0.0
    found = read_foreign_splat(write_ply(tmp_path / "a.ply", columns))
    assert found.dropped == 5
    assert torch.equal(found.gaussians.means, example(1).means[5:])
    assert "5 of 30" in found.warnings[0].text
    columns["y"][:] = np.nan
    with pytest.raises(ParseError):
        read_foreign_splat(write_ply(tmp_path / "b.ply", columns))


def test_extreme_quaternions_keep_their_rotation(tmp_path: Path) -> None:
    wanted = example(0)
    columns = splat_columns(wanted.replaced(quats=wanted.quats * 1e30))
    found = read_foreign_splat(write_ply(tmp_path / "a.ply", columns)).gaussians
    np.testing.assert_allclose(found.rotations(), wanted.rotations(), atol=1e-5)


def test_plain_opacities_and_scales_are_pointed_out(tmp_path: Path) -> None:
    columns = splat_columns(example(0))
    columns["opacity"] = 1 / (1 + np.exp(-columns["opacity"]))
    for i in range(3):
        columns[f"scale_{i}"] = np.exp(columns[f"scale_{i}"])
    (warning,) = read_foreign_splat(write_ply(tmp_path / "a.ply", columns)).warnings
    assert "logits" in warning.text


@pytest.mark.parametrize("name", ["x", "f_dc_1", "opacity", "scale_0", "rot_3"])
def test_a_missing_property_is_named(tmp_path: Path, name: str) -> None:
    columns = splat_columns(example(1))
    del columns[name]
    with pytest.raises(ParseError, match=rf"\b{name}\b") as caught:
        read_foreign_splat(write_ply(tmp_path / "a.ply", columns))
    assert "rot_0..3" in caught.value.hint


def test_numbers_of_harmonics_that_fit_no_degree_are_refused(tmp_path: Path) -> None:
    columns = splat_columns(example(2))
    del columns["f_rest_23"]
    with pytest.raises(ParseError, match="23 f_rest"):
        read_foreign_splat(write_ply(tmp_path / "a.ply", columns))


def test_meshes_and_clouds_are_named(tmp_path: Path) -> None:
    points = {axis: np.arange(3.0) for axis in "xyz"}
    with pytest.raises(ParseError, match="a point cloud"):
        read_foreign_splat(write_ply(tmp_path / "cloud.ply", points))
    faces = "element face 1\nproperty list uchar int vertex_indices"
    mesh = write_ply(tmp_path / "mesh.ply", points, after=(faces, b"\3" + 12 * b"\0"))
    with pytest.raises(ParseError, match="a mesh"):
        read_foreign_splat(mesh)


@pytest.mark.parametrize("suffix", [".spz", ".splat", ".ksplat", ".sog"])
def test_other_formats_are_named_with_the_next_step(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"NGSP")
    with pytest.raises(DatasetError, match="not supported") as caught:
        read_foreign_splat(path)
    assert "uncompressed PLY" in caught.value.hint


def test_compressed_plys_are_named(tmp_path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n"
    head += "element vertex 1\nproperty uint packed_position\nend_header\n"
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + bytes(8))
    with pytest.raises(ParseError, match="compressed"):
        read_foreign_splat(path)


@pytest.mark.parametrize("encoding", ["<", "ascii"])
def test_foreign_files_cut_anywhere_are_refused(tmp_path: Path, encoding: str) -> None:
    columns = {name: column[:2] for name, column in splat_columns(example(0)).items()}
    data = write_ply(tmp_path / "a.ply", columns, encoding=encoding).read_bytes()
    cut = tmp_path / "cut.ply"
    # The last digits of an ASCII number can be missing without a trace.
    last = len(data) if encoding == "<" else data.rstrip().rindex(b" ")
    for length in range(0, last, 7):
        cut.write_bytes(data[:length])
        with pytest.raises(ParseError):
            read_foreign_splat(cut)


def test_a_count_beyond_the_file_allocates_nothing(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "a.ply", splat_columns(example(0)))
    data = path.read_bytes()
    for count in (COUNT + 1, 19_999_999, 2**31 - 1, 10**17):
        path.write_bytes(data.replace(b"vertex 30", b"vertex %d" % count))
        with pytest.raises(ParseError):
            read_foreign_splat(path)


@pytest.mark.parametrize("degree", [0, 3])
def test_an_empty_splat_is_refused(tmp_path: Path, degree: int) -> None:
    path = write_ply(tmp_path / "a.ply", splat_columns(example(degree)))
    header, body = path.read_bytes().split(b"end_header\n", 1)
    assert body
    path.write_bytes(header.replace(b"vertex 30", b"vertex 0") + b"end_header\n")
    with pytest.raises(DatasetError, match=r"^a\.ply holds no Gaussians\.") as raised:
        read_foreign_splat(path)
    assert raised.value.hint == "Export the splat again."


def test_flat_needles_stay_renderable(tmp_path: Path) -> None:
    columns = splat_columns(example(0))
    columns["scale_1"] = np.full(COUNT, -39.0)
    found = read_foreign_splat(write_ply(tmp_path / "a.ply", columns)).gaussians
    spread = found.log_scales.amax(1) - found.log_scales.amin(1)
    assert float(spread.max()) <= -math.log(1e-5) + 1e-4


HEADER = """ply
format binary_big_endian 1.0
comment two words
obj_info nothing
element vertex 2
property short x
property double y
element face 1
property list uchar int vertex_indices
end_header
"""


BODY = np.array([(1, 2.5), (-3, 4.0)], [("x", ">i2"), ("y", ">f8")]).tobytes() + b"rest"


def header_written(path: Path, header: str, body: bytes = BODY) -> Path:
    path.write_bytes(header.encode() + body)
    return path


@pytest.mark.parametrize("end", ["\n", "\r\n", " \n", "\t\r\n"])
def test_headers_are_read_whatever_ends_their_lines(end: str, tmp_path: Path) -> None:
    path = header_written(tmp_path / "a.ply", HEADER.replace("\n", end))
    header = read_ply_header(path, "Again.")
    assert header.encoding == ">"
    assert header.comments == ("two words",)
    assert [(e.name, e.count, e.names) for e in header.elements] == [
        ("vertex", 2, ("x", "y")),
        ("face", 1, ("vertex_indices",)),
    ]
    assert (header.count("vertex"), header.count("face"), header.count("edge")) == (2, 1, 0)
    rows = read_vertices(path, header, "Again.")
    np.testing.assert_array_equal(rows["x"], [1, -3])
    np.testing.assert_array_equal(rows["y"], [2.5, 4.0])
    with pytest.raises(ParseError, match="2 vertices; at most 1"):
        read_vertices(path, header, "Again.", 1)


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("ply\n", "plyx\n", "byte 0"),
        ("ply\n", " ply\n", "byte 0"),
        ("format binary_big_endian 1.0\n", "", "header"),
        ("binary_big_endian", "binary", "line 2"),
        ("end_header", "the end", "header"),
        ("obj_info nothing", "c" * MAX_HEADER_BYTES, "header"),
        ("vertex 2", "vertex two", "line 5"),
        ("vertex 2", "vertex " + 19 * "9", "line 5"),
        ("element vertex 2\n", "", "line 5"),
        ("short x", "half x", "line 6"),
        ("double y", "double x", "line 7"),
        ("list uchar int", "list uchar", "line 9"),
    ],
)
def test_broken_headers_name_their_line(old: str, new: str, place: str, tmp_path: Path) -> None:
    assert old in HEADER
    path = header_written(tmp_path / "a.ply", HEADER.replace(old, new, 1))
    with pytest.raises(ParseError) as caught:
        read_ply_header(path, "Again.")
    assert (caught.value.location, caught.value.hint) == (place, "Again.")
    with pytest.raises(ParseError):
        is_cloud(path)


def test_a_ply_without_faces_is_a_cloud(tmp_path: Path) -> None:
    assert not is_cloud(header_written(tmp_path / "a.ply", HEADER))
    assert is_cloud(header_written(tmp_path / "b.ply", HEADER.replace("face 1", "face 0")))
    assert is_cloud(header_written(tmp_path / "c.ply", HEADER.replace("t face", "t edge")))
    assert not is_cloud(header_written(tmp_path / "d.obj", ""))
    with pytest.raises(ParseError, match=r"none\.ply, whole file: cannot be read"):
        is_cloud(tmp_path / "none.ply")
