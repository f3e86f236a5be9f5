# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat files: round trip, viewer variant, and files whose header does not match the content."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.gaussians.files import (
    read_splat_ply,
    write_splat_ply,
    write_viewer_ply,
)
from gaussian_wrapping_addon.core.scene.camera import Similarity
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
