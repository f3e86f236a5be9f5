# SPDX-License-Identifier: GPL-3.0-or-later
"""Links in a circle and over-long names: the photo is left out and named, the others are used."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.files import resolve_inside
from gaussian_wrapping_addon.core.jobs.store.stage_folder import source_fingerprint
from gaussian_wrapping_addon.core.loading.check import Finding, check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.photos.finder import find_mask
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.dataset.model_writers import (
    ring_model,
    ring_poses,
    write_binary,
    write_photos,
    write_text,
)

needs_links = pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
LONG = f"{'x' * 300}.png"
"""Longer than any file system stores."""


def errors(findings: list[Finding]) -> list[str]:
    return [finding.message for finding in findings if finding.severity == "error"]


def make_circle(path: Path) -> None:
    """Make two links that lead to each other."""
    path.parent.mkdir(parents=True, exist_ok=True)
    other = path.with_name(f"other-{path.stem}")
    path.symlink_to(other)
    other.symlink_to(path)


def write_transforms(root: Path, extra: str) -> None:
    frames = []
    for number, pose in enumerate(ring_poses(6)):
        matrix = np.eye(4)
        matrix[:3] = pose
        world = np.linalg.inv(matrix) @ np.diag([1.0, -1.0, -1.0, 1.0])
        name = extra if number == 5 else f"images/{number}.png"
        frames.append({"file_path": name, "transform_matrix": world.tolist()})
        if number < 5:
            (root / "images").mkdir(parents=True, exist_ok=True)
            pixels = np.random.default_rng(number).integers(0, 255, (48, 64, 3))
            Image.fromarray(pixels.astype(np.uint8)).save(root / name)
    values = {"fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    (root / "transforms.json").write_text(json.dumps({**values, "frames": frames}))


@needs_links
@pytest.mark.parametrize("kind", ["photos", "transforms", "colmap"])
def test_links_in_a_circle_among_photos_are_left_out(tmp_path: Path, kind: str) -> None:
    model = ring_model(6)
    make_circle(tmp_path / "images" / "p05.png")
    if kind == "transforms":
        write_transforms(tmp_path, "images/p05.png")
    else:
        rest = ring_model(6)
        rest.images.pop()
        write_photos(rest, tmp_path / "images")
    if kind == "colmap":
        write_binary(model, tmp_path / "sparse" / "0")
    findings = check_input(tmp_path)
    assert errors(findings) == []
    assert any("p05.png" in finding.message for finding in findings)
    assert not any("p05" in name for name, _, _ in source_fingerprint(tmp_path))
    assert resolve_inside(tmp_path, "images/p05.png") in (None, tmp_path / "images" / "p05.png")


@pytest.mark.parametrize("kind", ["transforms", "binary", "text"])
@pytest.mark.parametrize("name", [LONG, f"{'x' * 2000}.png", f"{'y/' * 400}{'x' * 300}.png"])
def test_an_over_long_name_is_left_out_and_named(tmp_path: Path, kind: str, name: str) -> None:
    model = ring_model(6)
    if kind == "transforms":
        write_transforms(tmp_path, name)
    else:
        rest = ring_model(6)
        rest.images.pop()
        write_photos(rest, tmp_path / "images")
        model.images[-1].name = name
        write = write_binary if kind == "binary" else write_text
        write(model, tmp_path / "sparse" / "0")
    findings = check_input(tmp_path)
    assert errors(findings) == []
    assert any(name[:60] in finding.message for finding in findings)
    assert len(load_scene(tmp_path, tmp_path / "work", Progress()).views) == 5


def test_a_name_that_only_its_mask_makes_too_long_has_no_mask(tmp_path: Path) -> None:
    """``x.png`` of 253 characters is stored, its mask ``x.png.png`` cannot be."""
    name = f"{'x' * 249}.png"
    (tmp_path / name).write_bytes(b"")
    assert find_mask([tmp_path / "masks"], name) is None
    (tmp_path / "masks").mkdir()
    assert find_mask([tmp_path / "masks"], name) is None
    (tmp_path / "masks" / name).write_bytes(b"")
    assert find_mask([tmp_path / "masks"], name) == tmp_path / "masks" / name
