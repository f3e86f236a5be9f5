# SPDX-License-Identifier: GPL-3.0-or-later
"""What a report warns of, with the stage and the next step."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.evaluation.report.figures import (
    FEW_HELD_OUT,
    TEXELLESS_SHARE,
    collect_warnings,
    escaped,
)
from gaussian_wrapping_addon.core.evaluation.report.report import headline, report_markdown
from gaussian_wrapping_addon.core.progress import ReportWarning, read_warnings
from tests.core.evaluation.report.report_examples import (
    REGION,
    full_region,
    full_summary,
    section,
    write,
)


def test_every_warning_is_listed_with_stage_and_next_step(tmp_path: Path) -> None:
    report, text = write(tmp_path)
    warnings = section(text, "## Warnings")
    entries = [line for line in warnings.splitlines() if line.startswith("- ")]
    expected = [
        ("cameras", "2 of 16 photos could not be placed"),
        ("cameras", "reprojection error of the cameras is 3.50 px"),
        ("training", "numbers were not finite"),
        ("training", "Only 2 photos held out: too few for a reliable mean"),
        ("training", "more than twice the error"),
        (f"mesh {REGION}", "The edge length was raised to 0.02."),
        (f"mesh {REGION}", "not closed (4 open edges)"),
        (f"mesh {REGION}", "do not lie on the reconstructed surface"),
        (f"mesh {REGION}", "3 faces with zero area"),
        (f"texture {REGION}", "the rest is filled in"),
        (f"texture {REGION}", "the unwrapper crashed"),
        (f"texture {REGION}", "5 faces smaller than a texel"),
        (f"texture {REGION}", "2 texels belong to two faces"),
    ]
    assert len(entries) == len(expected)
    for entry, (stage, words) in zip(entries, expected, strict=True):
        assert entry.startswith(f"- **{escaped(stage)}**: ")
        assert escaped(words) in entry
        assert ("*Next step:*" in entry) == ("edge length was raised" not in entry)
    assert [w["stage"] for w in report["warnings"]] == [stage for stage, _ in expected]
    summary = section(text, "## Summary")
    assert all(escaped(w["text"]) in summary for w in report["warnings"])
    for warning, line in zip(report["warnings"], headline(report)[3:], strict=True):
        assert line == f"warning ({warning['stage']}): {warning['text']}"


def test_texts_of_version_0_1_0_are_read_with_their_hints(tmp_path: Path) -> None:
    """``report.json`` and ``done.json`` held plain texts then; old stages are used again."""
    summary, region = full_summary(), full_region()
    whole = write(tmp_path, copy.deepcopy(summary), {REGION: copy.deepcopy(region)})[0]
    for place in (summary["cameras"], summary["training"]):
        place["warnings"] = [warning["text"] for warning in place["warnings"]]
    region["provenance"]["notes"] = [n["text"] for n in region["provenance"]["notes"]]
    report, text = write(tmp_path, summary, {REGION: region})
    stated = "2 of 16 photos could not be placed and are not used: a|b.jpg, c.jpg."
    hint = "Take more photos with more overlap there, or remove blurred ones."
    assert report["warnings"][0] == {"stage": "cameras", "code": "", "text": stated, "hint": hint}
    assert [w["text"] for w in report["warnings"]] == [w["text"] for w in whole["warnings"]]
    line = next(x for x in text.splitlines() if escaped(stated) in x and x.startswith("- "))
    assert escaped(hint) in line


def test_warnings_of_stages_are_written_as_they_were_made(tmp_path: Path) -> None:
    report, _ = write(tmp_path)
    made = report["cameras"]["warnings"][0]
    assert made == {
        "code": "photos-not-placed",
        "text": "2 of 16 photos could not be placed and are not used: a|b.jpg, c.jpg.",
        "hint": "Take more photos with more overlap there.",
    }
    assert report["warnings"][0] == {"stage": "cameras", **made}
    assert all(warning["code"] for warning in report["warnings"])


@pytest.mark.parametrize(
    "values",
    [None, "text", {"text": "a"}, [None, 3, [], {}, {"text": 3}, {"code": "a", "hint": "b"}]],
)
def test_what_is_no_warning_is_passed_over(values: Any) -> None:
    assert read_warnings(values) == ()
    assert read_warnings([{"text": "a", "code": 3, "hint": None}]) == (ReportWarning("", "a"),)


def good() -> dict[str, Any]:
    """A report without anything to warn about."""
    report = {**full_summary(), "regions": {REGION: full_region()}}
    report["cameras"]["warnings"] = report["training"]["warnings"] = []
    report["cameras"]["facts"]["mean_reprojection_error_px"] = 0.5
    photo = {"name": "x.jpg", "psnr": 29.0, "ssim": 0.9}
    report["training"].update(held_out=[photo] * FEW_HELD_OUT, held_out_psnr=29.0)
    region = report["regions"][REGION]
    region["statistics"].update(closed=True, boundary_edges=0)
    region["provenance"].update(notes=[], degenerate_faces_left=0, level_error_p99=0.01)
    region["texture"].update(
        coverage=0.9, unwrap_fallback_reason="", texels_overlapping=0, faces_without_texel=5,
        area_without_texel_share=0.9 * TEXELLESS_SHARE,
    )  # fmt: skip
    return report


def test_nothing_is_judged_where_nothing_is_wrong(tmp_path: Path) -> None:
    assert collect_warnings(good()) == []
    assert "No stage reported a warning" in section(
        report_markdown(good(), tmp_path), "## Warnings"
    )


def test_a_boundary_that_is_open_by_request_is_no_defect(tmp_path: Path) -> None:
    report = good()
    region = report["regions"][REGION]
    region["statistics"].update(closed=False, boundary_edges=4)
    region["provenance"].update(boundary="open")
    assert collect_warnings(report) == []
    text = report_markdown(report, tmp_path)
    assert "open by request at the region boundary" in text
    assert "not closed" not in text


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("cameras", "facts", "mean_reprojection_error_px"), 2.01, "reprojection error"),
        (("training", "held_out_psnr"), 23.9, "twice the error"),
        (("training", "held_out"), [], "No photo was held out"),
        (("regions", REGION, "texture", "coverage"), 0.499, "filled in"),
        (("regions", REGION, "texture", "coverage"), 0.0, "plain grey"),
        (
            ("regions", REGION, "provenance", "level_error_p99"),
            0.251,
            "not lie on the reconstructed surface",
        ),
    ],
)
def test_each_judgement_stands_alone(path: tuple[str, ...], value: Any, words: str) -> None:
    report = good()
    place = report
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    (warning,) = collect_warnings(report)
    assert words in warning.text
    assert warning.hint
    assert warning.code
