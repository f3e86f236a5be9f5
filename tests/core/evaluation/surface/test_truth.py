# SPDX-License-Identifier: GPL-3.0-or-later
"""Ground-truth folders: read as written; errors state the invalid entry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError
from gaussian_wrapping_addon.core.evaluation.surface_scores import (
    SurfaceSamples,
    Truth,
    read_truth,
    sample_uniformly,
)
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.evaluation.surface.surface_scenes import ball


def arrays() -> dict[str, np.ndarray]:
    vertices, faces = ball(2)
    samples = sample_uniformly(vertices, faces, 300, seed=0)
    return {
        "vertices": vertices,
        "faces": faces.astype(np.int32),
        "points": samples.points.astype(np.float32),
        "normals": samples.normals,
        "thin": samples.points[:, 2] > 0.5,
        "seen": (np.arange(300) % 4).astype(np.int32),
    }


def write(folder: Path, values: dict[str, np.ndarray]) -> None:
    np.savez(folder / "truth.npz", **values)
    write_region(folder / "crop.json", Region.box("crop", [-2, -2, 0], [2, 2, 2]))


def test_a_folder_is_read_as_written(tmp_path: Path) -> None:
    values = arrays()
    write(tmp_path, values)
    truth = read_truth(tmp_path)
    assert truth.mesh is not None
    assert (truth.mesh[0] == values["vertices"]).all()
    assert (truth.mesh[1] == values["faces"]).all()
    assert (truth.samples.points == values["points"]).all()
    assert truth.samples.points.dtype == truth.samples.normals.dtype == np.float64
    assert truth.thin is not None
    assert truth.seen is not None
    assert (truth.judged() == (values["points"][:, 2] >= 0)).all()
    assert (truth.visible() == (values["seen"] >= 2)).all()
    assert (truth.visible(1) == (values["seen"] >= 1)).all()
    part = truth.kept(truth.thin)
    assert len(part.samples) == values["thin"].sum()
    assert part.seen is not None
    assert (part.seen == values["seen"][values["thin"]]).all()


def changed(name: str, value: np.ndarray | None) -> dict[str, np.ndarray]:
    values = arrays()
    if value is None:
        del values[name]
    else:
        values[name] = value
    return values


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("thin", None),
        ("vertices", None),
        ("points", np.zeros((300, 2))),
        ("points", np.full((300, 3), np.nan)),
        ("points", np.zeros((0, 3))),
        ("normals", np.zeros((299, 3))),
        ("faces", np.full((1, 3), 10_000)),
        ("faces", np.full((1, 3), -1)),
        ("faces", np.zeros((1, 3))),
        ("thin", np.zeros(300)),
        ("seen", np.zeros(299, np.int32)),
        ("vertices", np.full((3, 3), "a")),
    ],
)
def test_a_wrong_entry_is_named(tmp_path: Path, name: str, value: np.ndarray | None) -> None:
    write(tmp_path, changed(name, value))
    with pytest.raises(ParseError) as caught:
        read_truth(tmp_path)
    assert caught.value.path.name == "truth.npz"
    assert name in f"{caught.value.location} {caught.value.message}" or "ground truth" in str(
        caught.value
    )
    assert caught.value.hint


def test_broken_and_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ParseError, match=r"truth\.npz"):
        read_truth(tmp_path)
    write(tmp_path, arrays())
    (tmp_path / "crop.json").unlink()
    with pytest.raises(ParseError, match=r"crop\.json"):
        read_truth(tmp_path)
    whole = (tmp_path / "truth.npz").read_bytes()
    for broken in (
        b"",
        b"text",
        whole[: len(whole) // 2],
        whole[:300] + bytes(2000) + whole[2300:],
    ):
        (tmp_path / "truth.npz").write_bytes(broken)
        with pytest.raises(ParseError, match=r"truth\.npz"):
            read_truth(tmp_path)
    np.savez(tmp_path / "truth.npz", **{**arrays(), "thin": np.array([{}] * 300, object)})
    with pytest.raises(ParseError, match=r"truth\.npz"):
        read_truth(tmp_path)


def test_a_truth_must_be_whole() -> None:
    samples = SurfaceSamples(np.zeros((4, 3)), np.zeros((4, 3)))
    with pytest.raises(DatasetError, match="not both"):
        Truth(samples, np.zeros((3, 3)))
    with pytest.raises(DatasetError, match="no samples"):
        Truth(SurfaceSamples.empty())
    with pytest.raises(DatasetError, match="seen"):
        Truth(samples, seen=np.zeros(3, bool))
    assert Truth(samples).judged().all()
    assert Truth(samples).visible().all()
