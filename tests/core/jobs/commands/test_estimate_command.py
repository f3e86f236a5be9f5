# SPDX-License-Identifier: GPL-3.0-or-later
"""The facts that the command ``estimate`` reads from an input."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.gaussians.files import write_splat_ply
from gaussian_wrapping_addon.core.jobs.commands import estimate_command
from gaussian_wrapping_addon.core.jobs.commands.estimate_command import input_facts
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job
from gaussian_wrapping_addon.core.loading.other_inputs import FAR_VIEWS, NEAR_VIEWS, PHOTO_SIDE_PX
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.settings import JobSettings
from tests.core.training.small_scene import sphere_gaussians


def test_a_folder_of_photos(tmp_path: Path) -> None:
    with pytest.raises(DatasetError):
        input_facts(tmp_path)
    for index, size in enumerate(((40, 30), (60, 20), (40, 30))):
        Image.new("RGB", size).save(tmp_path / f"{index}.png")
    facts = input_facts(tmp_path)
    assert (facts.photos, facts.pixels, facts.long_side_px) == (3, 1200.0, 60)
    assert (facts.points, facts.masked) == (0, False)


def test_a_splat_is_looked_at_from_made_up_views(tmp_path: Path) -> None:
    path = tmp_path / "some.ply"
    write_splat_ply(path, sphere_gaussians(120), Similarity())
    facts = input_facts(path)
    assert facts.photos == FAR_VIEWS + NEAR_VIEWS
    assert (facts.points, facts.long_side_px) == (120, PHOTO_SIDE_PX)


def test_what_comes_after_the_training_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not as a tenth of it: more than twice that in all jobs measured."""
    for index in range(3):
        Image.new("RGB", (40, 30)).save(tmp_path / f"{index}.png")
    name = "gaussian_wrapping_addon.core.training.estimate.renderer_is_compiled"
    monkeypatch.setattr(name, lambda: False)
    lines = estimate_command._estimate(make_job("wrap", tmp_path, JobSettings()))
    (line,) = [line for line in lines if line.startswith("mesh and texture")]
    assert line == "mesh and texture: 20 to 90 % more"
    assert "photos: in memory, 0.00 GB" in lines
