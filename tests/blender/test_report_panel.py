# SPDX-License-Identifier: GPL-3.0-or-later
"""The report's panel in every state, and its operators, which open nothing from elsewhere."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.ops import addon, results
from gaussian_wrapping_addon.ops.report_data import MAX_WARNINGS, figures_of_report, report_of
from gaussian_wrapping_addon.ops.scene_objects import import_result
from gaussian_wrapping_addon.ui.result_panel import _MAX_WARNINGS, GWRAP_PT_report
from tests.blender.fake_layout import FakeLayout, draw
from tests.blender.panel_states import PANELS
from tests.blender.synthetic_result import png_bytes, write_result
from tests.core.evaluation.report.report_examples import REGION, full_region, full_summary

pytestmark = pytest.mark.usefixtures("addon")


def show(folder: Path, report: Any) -> FakeLayout:
    """Import a result with this report and draw the panel."""
    result = write_result(folder)
    if report is None:
        (result / "report.json").unlink()
    else:
        (result / "report.json").write_text(json.dumps(report))
    import_result(result, bpy.context.scene)
    return draw(GWRAP_PT_report)


def rows(layout: FakeLayout) -> dict[str, str]:
    """Return label and value of every row: what is drawn, in pairs."""
    return dict(itertools.pairwise(layout.texts.splitlines()))


def full_report() -> dict[str, Any]:
    return {"version": 1, **full_summary(), "regions": {REGION: full_region()}}


def test_without_a_report(tmp_path: Path) -> None:
    assert draw(GWRAP_PT_report).texts == "No report yet"
    layout = show(tmp_path / "job", None)
    assert layout.texts == "No report yet"
    assert layout.operators == []


def test_full_report(tmp_path: Path) -> None:
    report = full_report()
    report["regions"][REGION]["mesh_rendering"]["exposed_psnr"] = 26.5
    layout = show(tmp_path / "job", report)
    found = rows(layout)
    for name, value in (
        ("Time of Last Job", "3 min 22 s"),
        ("Peak Memory", "3.00 GiB"),
        ("Gaussians", "12,235"),
        ("Held-Out PSNR", "23.0 dB (2 photos)"),
        ("Device", "cuda:1"),
        ("Cameras", "20 s"),
        ("Training", "2 min 20 s"),
        (f"Mesh {REGION}", "30 s"),
        (f"Texture {REGION}", "10 s"),
        ("Faces", "196"),
        ("Closed", "No"),
        ("Texture Coverage", "25.0 %"),
        ("Textured Mesh PSNR", "20.0 dB"),
        ("PSNR, Photo's Exposure", "26.5 dB"),
        ("Photo Not Covered", "25.0 %"),
        ("PSNR, That as Black", "8.0 dB"),
    ):
        assert found[name] == value
    assert not any("vacancy" in value for value in found.values())
    assert "gwrap.read_report" in layout.operators
    assert "gwrap.show_pictures" in layout.operators
    words = " ".join(layout.texts.split())
    assert "Some GPU, kernels compiled by libnvrtc.so.13." in words
    assert "2 of 16 photos could not be placed" in words  # wrapped over lines
    assert "Take more photos with more overlap there" in words
    assert max(len(line) for line in layout.texts.splitlines()) <= 60
    warnings = len(report_of(json.dumps(figures_of_report(full_report()))).warnings)
    assert warnings > _MAX_WARNINGS
    assert f"and {warnings - _MAX_WARNINGS} more in the report" in words


def test_the_reason_for_the_processor_is_shown(tmp_path: Path) -> None:
    report = {**full_report(), "device": "cpu", "device_reason": "There is no GPU here."}
    report["cameras"] = {}
    report["training"] = {"gaussians": 3}
    report["regions"] = {"auto": {"statistics": {"faces": 4, "closed": True}}}
    layout = show(tmp_path / "job", report)
    assert "No warnings" in layout.texts
    assert rows(layout)["Closed"] == "Yes"
    assert rows(layout)["Device"] == "Processor"
    assert "There is no GPU here." in layout.texts
    text = report_of(json.dumps(figures_of_report(report))).as_text()
    assert "Device: There is no GPU here." in text
    assert "Device" not in rows(show(tmp_path / "older", {"wall_seconds": 83.2}))


@pytest.mark.parametrize(
    "report",
    [
        {"wall_seconds": 83.2},
        {"regions": {"auto": {}}, "training": {}, "stages": [{"name": "train"}]},
        {"training": [], "regions": {"auto": 3}, "stages": 5, "warnings": {}, "cameras": "x"},
    ],
)
def test_what_an_older_report_lacks_is_not_measured(tmp_path: Path, report: Any) -> None:
    found = rows(show(tmp_path / "job", report))
    assert found["Held-Out PSNR"] == "not measured"
    assert found["Peak Memory"] == "not measured"
    if "regions" in report:
        for name in ("Faces", "Closed", "Texture Coverage", "Textured Mesh PSNR"):
            assert found[name] == "not measured"
        assert "Photo Not Covered" not in found


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", "{", "[" * 5000, "3", '{"psnr": "x", "regions": {"a": 3}}',
        '{"stages": [[], [1], ["a", {}]], "warnings": [3, null, "w"], "psnr": NaN}',
        '{"gaussians": 1e999, "seconds": true, "regions": {"a": {"closed": 2, "faces": []}}}',
    ],
)  # fmt: skip
def test_edited_figures_are_survived(tmp_path: Path, text: str) -> None:
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    imported.frame[addon.FIGURES] = text
    imported.frame[addon.RESULT] = 5
    imported.meshes[0].data.materials.clear()
    for panel in PANELS:
        draw(panel)
    texts = draw(GWRAP_PT_report).texts
    assert texts
    assert "nan" not in texts.lower().split()
    imported.frame[addon.FIGURES] = 5
    assert draw(GWRAP_PT_report).texts == "No report yet"


def test_what_the_scene_needed_is_shown_with_who_decided(tmp_path: Path) -> None:
    report = full_report()
    report["training"]["decisions"] = [
        {"name": "full_size", "setting": "auto", "chosen": "480 px", "evidence": "a"},
        {"name": "exposure", "setting": "on", "chosen": "on", "evidence": "b"},
        {"name": "of a newer version", "setting": "auto", "chosen": "much", "evidence": "c"},
        "broken",
    ]
    found = rows(show(tmp_path / "job", report))
    assert found["Photo Size"] == "480 px"
    assert found["Exposure"] == "On (set by you)"
    assert found["of a newer version"] == "Much"


def test_figures_kept_in_a_file_are_bounded() -> None:
    report = full_report()
    report["cameras"]["warnings"] = [f"{k} " + "x" * 10_000 for k in range(1000)]
    report["stages"] = report["stages"] * 10_000
    figures = figures_of_report(report)
    assert len(figures["warnings"]) == MAX_WARNINGS
    assert len(json.dumps(figures)) < 50_000


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths that would be opened by the system."""
    paths: list[str] = []

    class Operators:
        def path_open(self, filepath: str) -> None:
            paths.append(filepath)

    class Ops:
        wm = Operators()

    class FakeBpy:
        ops, data = Ops(), bpy.data

    monkeypatch.setattr(results, "bpy", FakeBpy())
    monkeypatch.setattr(addon, "_session", [])
    monkeypatch.setattr(addon, "_stored", lambda: [])
    return paths


def test_opening_the_report(tmp_path: Path, opened: list[str]) -> None:
    result = write_result(tmp_path / "job")
    assert not bpy.ops.gwrap.read_report.poll()
    import_result(result, bpy.context.scene)
    with pytest.raises(RuntimeError, match="not been used on this computer"):
        bpy.ops.gwrap.read_report()
    addon.remember(result.parent)
    with pytest.raises(RuntimeError, match=r"no report\.md"):
        bpy.ops.gwrap.read_report()
    elsewhere = tmp_path / "elsewhere.md"
    elsewhere.write_text("x")
    (result / "report.md").symlink_to(elsewhere)
    with pytest.raises(RuntimeError, match=r"no report\.md"):
        bpy.ops.gwrap.read_report()
    assert opened == []
    (result / "report.md").unlink()
    (result / "report.md").write_text("# Report")
    assert bpy.ops.gwrap.read_report() == {"FINISHED"}
    assert opened == [str(result / "report.md")]


def test_showing_pictures(tmp_path: Path, opened: list[str]) -> None:
    result = write_result(tmp_path / "job")
    import_result(result, bpy.context.scene)
    addon.remember(result.parent)
    with pytest.raises(RuntimeError, match="no pictures"):
        bpy.ops.gwrap.show_pictures()
    names = ("report/held-out-0.jpg", "auto/comparison-1.jpg", "preview.png")
    for name in names:
        (result / name).parent.mkdir(exist_ok=True)
        (result / name).write_bytes(png_bytes(np.zeros((3, 4, 3), np.uint8)))
    assert bpy.ops.gwrap.show_pictures() == {"FINISHED"}
    shown = [i for i in bpy.data.images if Path(i.filepath).name in {Path(n).name for n in names}]
    assert len(shown) == 3
    assert all(tuple(image.size) == (4, 3) for image in shown)
    (result / names[0]).write_bytes(png_bytes(np.zeros((5, 7, 3), np.uint8)))
    assert bpy.ops.gwrap.show_pictures() == {"FINISHED"}
    assert sorted(tuple(image.size) for image in shown) == [(4, 3), (4, 3), (7, 5)]
