# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel's look at the photos: findings of the worker, a missing package and its button."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from gaussian_wrapping_addon.core.jobs import client as job_client
from gaussian_wrapping_addon.ops import dataset
from gaussian_wrapping_addon.ops.addon import properties_of
from gaussian_wrapping_addon.ui import dataset_panel
from tests.blender.fake_layout import draw
from tests.blender.job_play import play_background

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture(autouse=True)
def stopped() -> Iterator[None]:
    yield
    dataset.stop_check()


def photos(folder: Path) -> Path:
    """Eight photos of noise of many sizes, the fourth of which is blurred."""
    rng = np.random.default_rng(2)
    noise = sum(gaussian_filter(rng.normal(0, 1, (300, 600)), s) * s for s in (0.7, 2, 6))
    wall = 128 + 40 * np.asarray(noise) / np.std(noise)
    folder.mkdir()
    for k in range(8):
        pixels = wall[:, 20 * k : 20 * k + 400]
        pixels = gaussian_filter(pixels, 4) if k == 3 else pixels
        image = Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)).convert("RGB")
        image.save(folder / f"p{k}.jpg", quality=95)
    return folder


def test_findings_of_the_worker_join_those_of_the_check(tmp_path: Path) -> None:
    properties = properties_of(bpy.context.scene)
    properties.source = str(photos(tmp_path / "set"))
    dataset.start_check(bpy.context.scene)
    play_background(lambda: not (dataset.is_checking() or dataset.is_busy()), 60.0)
    texts = draw(dataset_panel.GWRAP_PT_dataset).texts.replace("\n", " ")
    assert "1 photo is much less sharp than the photos beside: p3.jpg." in texts
    assert "Look at these" in texts
    assert "Looking at the photos" not in texts
    assert "gwrap.add_extra" not in draw(dataset_panel.GWRAP_PT_dataset).operators


def test_without_a_worker_the_check_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(job_client.PYTHON_VARIABLE, raising=False)
    monkeypatch.setattr(job_client, "_has_torch", lambda: False)
    properties_of(bpy.context.scene).source = str(photos(tmp_path / "set"))
    dataset.start_check(bpy.context.scene)
    play_background(lambda: not (dataset.is_checking() or dataset.is_busy()), 60.0)
    severities = {f.severity for f in properties_of(bpy.context.scene).findings}
    assert severities == {"fact"}


def test_a_missing_package_gets_its_button() -> None:
    error = {"error": "a.heic: no package.", "hint": "Press Add.", "extras": ["heif"]}
    (row,) = dataset.rows_of([{"message": "photo 1 of 2"}, error])
    assert row == {
        "severity": "error", "message": "a.heic: no package.", "hint": "Press Add.",
        "extra": "heif",
    }  # fmt: skip
    properties = properties_of(bpy.context.scene)
    properties.source = properties.checked_source = "photos"
    for names, count in (("heif", 1), ("heif,raw", 2), ("unknown", 0), ("", 0)):
        properties.findings.clear()
        finding = properties.findings.add()
        for name, text in row.items():
            setattr(finding, name, text)
        finding.extra = names
        layout = draw(dataset_panel.GWRAP_PT_dataset)
        assert layout.operators.count("gwrap.add_extra") == count
    assert "a.heic: no package." in layout.texts
    properties.findings.clear()


def test_a_worker_that_says_nothing_is_told() -> None:
    (row,) = dataset.rows_of([], "It broke")
    assert row["severity"] == "warning"
    assert "It broke" in row["message"]
