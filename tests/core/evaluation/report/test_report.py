# SPDX-License-Identifier: GPL-3.0-or-later
"""The report holds what was measured, warned of and decided, and nothing else."""

from __future__ import annotations

import copy
import json
import math
import re
import urllib.parse
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.evaluation.report.figures import (
    FEW_HELD_OUT,
    NOT_MEASURED,
    TEXELLESS_SHARE,
    collect_warnings,
    duration,
    escaped,
    figure_rows,
    number,
    percent,
)
from gaussian_wrapping_addon.core.evaluation.report.report import (
    estimate_lines,
    headline,
    report_markdown,
    selection_lines,
)
from gaussian_wrapping_addon.core.files import finite_json
from gaussian_wrapping_addon.core.progress import ReportWarning, read_warnings
from gaussian_wrapping_addon.core.settings import JobSettings, TrainingSettings, to_json
from gaussian_wrapping_addon.core.training.model_selection import Decision, ModelSelection, decide
from tests.core.evaluation.report.report_examples import (
    PICTURES,
    REGION,
    full_region,
    full_summary,
    section,
    write,
    write_pictures,
)

LINK = re.compile(r"!\[[^\n]*?\]\(([^)\s]+)\)")
WRONG_NUMBER = re.compile(r"\b(nan|inf|infinity|none)\b", re.IGNORECASE)


def row(text: str, name: str) -> str:
    """Return the figure beside a name in a table of two columns."""
    (found,) = re.findall(rf"^\| {re.escape(name)} \| (.*) \|$", text, re.MULTILINE)
    return found


def cells(line: str) -> list[str]:
    """Split a table row at the bars that are not escaped."""
    return re.split(r"(?<!\\)\|", line)[1:-1]


def tables(text: str) -> list[list[str]]:
    found: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.startswith("|"):
            found[-1].append(line)
        elif found[-1]:
            found.append([])
    return [t for t in found if t]


def leaves(values: Any, path: tuple = ()) -> list[tuple]:
    if isinstance(values, dict):
        return [p for k, v in values.items() for p in leaves(v, (*path, k))]
    if isinstance(values, list):
        return [p for k, v in enumerate(values) for p in leaves(v, (*path, k))]
    return [path]


def test_figures_are_where_a_person_looks_for_them(tmp_path: Path) -> None:
    _, text = write(tmp_path)
    summary = section(text, "## Summary")
    for words in (
        "Photos used: 14. Gaussians trained on them: 12,235 (preset draft).",
        "196 faces, not closed",
        "3 min 22 s",  # 201.5 s
        "typical error of 7.1 % of full brightness",  # 10 ** (-23 / 20)
        "photos saw 25.0 % of the texture",
        f'The textured mesh of "{escaped(REGION)}": 20.0 dB (2 photos, over the pixels the mesh',
        "covers: 62.5 % of the photo; no face covers 25.0 % of the photo, and with these pixels",
        "counted as black it is 8.0 dB; the texture compared was baked without the held-out photos",
    ):
        assert words in summary, words
    stages = section(text, "## Time and memory")
    assert "| photos and cameras (earlier run) | 20.0 s | 10.0 % |" in stages
    assert f'| mesh of region "{escaped(REGION)}" | 30.0 s | 15.0 % |' in stages
    assert "main process: 3.00 GiB" in stages
    assert "512 MiB" in stages
    training = section(text, "## Training")
    assert "| **mean** | 23.00 dB | 7.1 % | 0.6000 |" in training
    assert "| p\\|q.jpg | 20.00 dB | 10.0 % | 0.5000 |" in training
    assert "LPIPS is not measured: AlexNet's weights are not here." in training
    region = section(text, f"## Region {escaped(REGION)}")
    for name, figure in (
        ("Faces", "196 faces"),
        ("Closed", "not closed, 4 open edges"),
        ("Size (x, y, z)", "1 x 2 x 3.5 world units"),
        ("Edge length, median", "0.03 world units"),
        ("Residual, 99th percentile", "0.31 of vacancy"),
        ("Size", "512 x 512 texels, chosen from the resolution of the photos"),
        ("Texel density", "8.8 texels per world unit"),
        ("Coverage: seen by photos", "25.0 %"),
        ("Area of faces smaller than a texel", "2.0 %"),
    ):
        assert row(region, name) == figure
    assert "| **mean** | 20.00 dB | 0.5000 | 62.5 % |" in region
    assert f"LPIPS was {NOT_MEASURED}: its weights are not here." in region
    machine = section(text, "## Machine, versions, seed")
    for words in ("Some CPU", "numpy 1.26.4", "seed: 7", "2026-11-21"):
        assert words in machine


def test_what_a_region_went_through_is_told(tmp_path: Path) -> None:
    region = full_region()
    region["check"] = {"good": False, "defects": ["edges have one face only: 4"]}
    region["texture"].update(atlases=3, size_automatic=False)
    region["provenance"].update(
        removed_solids=2, removed_cavities=1, removed_area_share=0.03, faces_before_clean_up=9000,
        target_faces=196, smooth_steps=3, removed_open_pieces=2, removed_open_area_share=0.01,
        tiles=3, tile_processes=2, field_evaluations=4000, unseen_evaluations=50, unseen="occupied",
    )  # fmt: skip
    _, text = write(tmp_path, None, {REGION: region})
    told = section(text, f"## Region {escaped(REGION)}")
    for name, figure in (
        ("Check of the mesh (closed, manifold)", "edges have one face only: 4"),
        ("Small components removed", "2 floaters, 1 small cavity: 3.0 % of the area"),
        ("Small open components removed", "2 small pieces: 1.0 % of the area"),
        ("Smoothed", "3 steps"),
        ("Faces before decimation", "9,000 faces"),
        ("Target number of faces", "196 faces"),
        ("Tiles", "3 tiles, by 2 processes"),
        ("Seen by no camera", "1.2 % of the points evaluated, treated as occupied"),
        ("Size", "3 textures of 512 x 512 texels"),
    ):
        assert row(told, name) == figure
    assert "edges have one face only: 4" in section(text, "## Warnings")
    region["check"] = {"good": True, "defects": []}
    found = collect_warnings({"regions": {REGION: region}})
    assert not [w for w in found if "check of the final mesh" in w.text]
    assert "| no defect |" in write(tmp_path, None, {REGION: region})[1]
    told = section(write(tmp_path)[1], f"## Region {escaped(REGION)}")
    for absent in ("| Tiles |", "Seen by no camera", "before decimation"):
        assert absent not in told


def test_pictures_are_linked_exactly_where_they_are(tmp_path: Path) -> None:
    _, text = write(tmp_path)
    assert LINK.findall(text) == []
    assert "no pictures of the held-out photos" in text
    write_pictures(tmp_path)
    _, text = write(tmp_path)
    links = [urllib.parse.unquote(link) for link in LINK.findall(text)]
    assert sorted(links) == sorted(PICTURES)
    assert r"*p\|q.jpg, 18.5 dB. Left: the photo. Right: the textured mesh.*" in text
    summary = full_summary()
    summary["training"]["pictures"] = [{"file": "../../secret.jpg", "name": "x", "psnr": 1.0}]
    (tmp_path.parent / "secret.jpg").write_bytes(b"x")
    _, text = write(tmp_path, summary)
    assert "secret" not in section(text, "## Training")


def test_uncovered_pixels_are_told_where_they_were_measured(tmp_path: Path) -> None:
    """Reports of version 0.1.0 hold neither share nor second PSNR, and none is made up."""
    region = full_region()
    report, text = write(tmp_path, full_summary(), {REGION: region})
    told = "PSNR 20.00 dB where it covers the photos (25.0 % of them uncovered; 8.00 dB"
    assert any(told in line for line in headline(report))
    assert "| 62.5 % | 25.0 % | 8.00 dB |" in text
    rendering = region["mesh_rendering"]
    for figures in (rendering, *rendering["views"]):
        del figures["uncovered"], figures["whole_psnr"]
    report, text = write(tmp_path, full_summary(), {REGION: region})
    assert any(line.endswith("textured mesh PSNR 20.00 dB") for line in headline(report))
    assert "| 0.5000 | 62.5 % |" in text
    for made_up in ("no face covers", "black where"):
        assert made_up not in text


def test_the_mesh_in_the_exposure_of_each_photo_is_told(tmp_path: Path) -> None:
    region = full_region()
    for figures in (region["mesh_rendering"], *region["mesh_rendering"]["views"]):
        figures["exposed_psnr"] = 26.5
    report, text = write(tmp_path, full_summary(), {REGION: region})
    told = "PSNR 20.00 dB (26.50 dB in the exposure of each photo) where it covers the photos"
    assert any(told in line for line in headline(report))
    assert "62.5 % of the photo, and 26.5 dB over them in the exposure of each photo" in text
    assert "The PSNR with uncovered pixels black counts every pixel" in text
    assert "| 62.5 % | 25.0 % | 8.00 dB | 26.50 dB |" in text


@pytest.mark.parametrize("perceptual", [False, True])
def test_tables_are_well_formed_with_perceptual_figures_or_without(
    tmp_path: Path, perceptual: bool
) -> None:
    summary, region = full_summary(), full_region()
    summary["training"].pop("lpips_note")
    if perceptual:
        for figure, value in zip(summary["training"]["held_out"], (0.25, 0.35), strict=True):
            figure["lpips"] = value
        summary["training"]["held_out_lpips"] = 0.3
        region["mesh_rendering"]["views"][1]["lpips"] = 0.35
    _, text = write(tmp_path, summary, {REGION: region})
    found = tables(text)
    assert len(found) == 7
    for lines in found:
        assert len({len(cells(line)) for line in lines}) == 1, lines
        assert all(set(c.strip()) <= {"-", ":"} and "---" in c for c in cells(lines[1]))
        assert len(lines) > 2
    training = section(text, "## Training")
    assert ("LPIPS (perceptual distance) was not measured." in training) != perceptual
    assert ("| p\\|q.jpg | 20.00 dB | 10.0 % | 0.5000 | 0.2500 |" in training) == perceptual
    assert ("| **mean** | 23.00 dB | 7.1 % | 0.6000 | 0.3000 |" in training) == perceptual
    # Markup of outside names is shown, not obeyed.
    assert text.splitlines()[0] == r"# Report: a\|b &lt;i&gt;\*photos\*&lt;/i&gt;"


def test_every_number_of_the_table_has_a_unit() -> None:
    report = {"version": 1, **full_summary(), "regions": {REGION: full_region()}}
    report["settings"] = to_json(JobSettings())
    rows = figure_rows(report)
    units = {name: unit for name, value, unit in rows}
    assert all(unit for _, value, unit in rows if re.fullmatch(r"[\d,]+(\.\d+)?(e[+-]\d+)?", value))
    for words, unit in (
        ("training, held out psnr", "dB"),
        ("peak memory bytes, worker", "bytes"),
        ("stem 1, statistics, area", "square scene units"),
        ("stem 1, world, size, 0", "world units"),
        ("stem 1, provenance, level error p99", "of vacancy"),
        ("started unix s", "s since 1970"),
    ):
        (found,) = [u for name, u in units.items() if name.endswith(words)]
        assert found == unit, words
    report["training"]["brightness"] = 3.5
    unknown = [row for row in figure_rows(report) if row not in rows]
    assert unknown == [("training, brightness", "3.5", "")]


@pytest.mark.parametrize("value", [None, "x"])
def test_one_bad_figure_never_breaks_a_report(tmp_path: Path, value: Any) -> None:
    whole = {**full_summary(), "regions": {REGION: full_region()}}
    for path in leaves(whole):
        report = copy.deepcopy(whole)
        place: Any = report
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        if path[:2] == ("training", "pictures"):
            continue
        values = finite_json(report)
        text = report_markdown(values, tmp_path)
        body = text[: text.index("<details>")].replace("none ran", "").replace("black is none", "")
        assert WRONG_NUMBER.search(body) is None, path
        assert headline(values)
        json.dumps([w.to_json() for w in collect_warnings(values)], allow_nan=False)
        for lines in tables(text):
            assert len({len(cells(line)) for line in lines}) == 1


def test_files_hold_no_number_that_is_not_finite(tmp_path: Path) -> None:
    summary, region = full_summary(), full_region()
    summary["training"]["held_out_psnr"] = math.nan
    region["world"]["edge_mean"] = math.inf
    values, text = write(tmp_path, summary, {REGION: region})
    assert values["training"]["held_out_psnr"] is None
    assert row(text, "Edge length, mean") == NOT_MEASURED


@pytest.mark.parametrize("report", [{}, {"regions": {"a": {}}}, {"training": 3, "stages": {}}])
def test_what_an_old_report_lacks_is_not_measured(tmp_path: Path, report: dict[str, Any]) -> None:
    text = report_markdown(report, tmp_path)
    assert re.search(r"(?<![\d.,])0(\.0+)? (%|dB|faces|Gaussians|s)\b", text) is None
    assert "not measured" in section(text, "## Training")
    assert all("not measured" in line for line in headline(report))
    if report.get("regions"):
        region = section(text, "## Region a")
        for name in ("Faces", "Residual, median", "Size (x, y, z)", "Texel density", "Size"):
            assert row(region, name) == NOT_MEASURED
        assert "reproduces photos was not measured" in region


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (number(0.00012345, "dB"), "1.234e-04 dB"),
        (number(1234567), "1,234,567"),
        (number(True), NOT_MEASURED),
        (number(math.nan, "s"), NOT_MEASURED),
        (number(10**400), NOT_MEASURED),
        (percent(0.99999), "99.9 %"),
        (percent(0.00001), "less than 0.1 %"),
        (duration(math.inf), NOT_MEASURED),
        (duration(3661), "1 h 01 min"),
        (escaped("a\nb | `c`"), r"a b \| \`c\`"),
    ],
)
def test_words(text: str, expected: str) -> None:
    assert text == expected


def test_names_that_no_encoding_writes_do_not_stop_the_report(tmp_path: Path) -> None:
    summary, region = full_summary(), full_region()
    summary["source"] = "photos \udcff"  # a folder's name that is not UTF-8
    region["provenance"]["region"] = "\ud800x"
    write_pictures(tmp_path)
    values, text = write(tmp_path, summary, {REGION: region})
    assert values["source"] == "photos \udcff"
    assert "# Report: photos ?" in text


def test_where_the_job_computed_and_why_is_said(tmp_path: Path) -> None:
    report = {"version": 1, **full_summary(), "regions": {}}
    for trained, told in ((None, ""), ("cuda:1", ""), ("cpu", " Trained on cpu.")):
        report["training"]["device"] = trained
        line = f"- Device: cuda:1. Some GPU, kernels compiled by libnvrtc.so.13.{told}"
        assert line in report_markdown(report, tmp_path).splitlines()
    del report["device"]  # as version 0.1.0 wrote it
    assert "- Device" not in report_markdown(report, tmp_path)


def test_metres_and_how_well_they_are_known_are_said(tmp_path: Path) -> None:
    units = {
        "sources": ["gps", "markers"], "applied": True, "scale_error": 0.0023,
        "gps": {"median_m": 0.351, "used": 18}, "markers": {"used": 7},
        "origin": {"latitude_deg": 46.8426598, "longitude_deg": -91.9940031, "altitude_m": 198.6},
    }  # fmt: skip

    def written(**facts: Any) -> str:
        report = {"cameras": {"facts": {"kind": "photos", **facts}}}
        return report_markdown(report, tmp_path)

    text = written(georeference=units)
    assert "One world unit is one metre." in text
    assert "arbitrary length" not in text
    for name, figure in (
        ("Metres from", "gps, markers"),
        ("Error of the scale (standard deviation)", "0.23 %"),
        ("Cameras off their known places, median", "0.351 m"),
        ("Markers measured", "7 markers"),
    ):
        assert row(text, name) == figure
    assert "46.842660, -91.994003" in row(text, "Origin: latitude, longitude (WGS 84)")
    broken = {"sources": 3, "applied": "yes", "gps": [], "origin": {"latitude_deg": "x"}}
    for georeference in ({**units, "applied": False}, broken):
        assert "arbitrary length" in written(georeference=georeference)
    assert row(written(georeference_note="too little"), "GPS is not used") == "too little"


EXPECTED = {"seconds_low": 60.0, "seconds_high": 120.0, "memory_bytes": 2**30}


def test_time_and_photos_are_compared_with_what_was_expected() -> None:
    for took, words in ((59.0, "below it"), (60.0, "within it"), (121.0, "above it")):
        told = estimate_lines({"estimate": EXPECTED, "seconds_training": took})
        assert words in " ".join(told)
    for training in ({}, {"seconds_training": 5.0}, {"estimate": EXPECTED}):
        assert estimate_lines(training) == []
    photos = {"photos": 400, "all_bytes": 6 * 2**30, "budget_bytes": 3 * 2**30}
    told = {"estimate": {**EXPECTED, "photos": photos}, "seconds_training": 70.0}
    for size, end in (
        (6 * 2**30, "read on demand: 6.00 GiB decoded, 3.00 GiB of memory for them."),
        (2**29, "All photos fitted into memory (512 MiB)."),
        ("much", "within it."),
    ):
        photos["all_bytes"] = size
        assert " ".join(estimate_lines(told)).endswith(end)


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
        assert warning["code"]
    assert report["warnings"][0] == {"stage": "cameras", **full_summary()["cameras"]["warnings"][0]}


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


def test_nothing_is_judged_where_nothing_is_wrong_or_the_boundary_open_by_request(
    tmp_path: Path,
) -> None:
    report = good()
    assert collect_warnings(report) == []
    assert "No stage reported a warning" in report_markdown(report, tmp_path)
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
        (("regions", REGION, "provenance", "level_error_p99"), 0.251, "not lie on the"),
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


NAMES = ("exposure", "multi_view", "full_size", "dense_start", "refine_poses")


def training() -> dict[str, Any]:
    selection = ModelSelection()
    for name in NAMES:
        selection = selection.with_decision(decide(name, "auto", True, f"Seen in {name} a|b."))
    chosen = decide("exposure", "off", True, "Photos differ by 20 %.")
    return {"decisions": selection.with_decision(chosen).to_json()}


def test_every_decision_is_listed_with_its_evidence_setting_and_who_decided() -> None:
    summary = full_summary()
    summary["training"] |= training()
    assert "\n## Model selection\n" in report_markdown(summary, Path("nowhere"))
    text = "\n".join(selection_lines(training()))
    for name in NAMES:
        if name != "exposure":
            assert f"Seen in {name.replace('_', chr(92) + '_')} a\\|b." in text
        assert f"setting `{name}`" in text
        assert name in TrainingSettings.__dataclass_fields__
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + len(NAMES)
    assert text.count("*To change this:*") == len(NAMES)
    assert "| off | you (off) |" in text
    assert text.count("| the photos |") == len(NAMES) - 1
    assert "Set by you. Evidence from the photos: Photos differ by 20 %." in text
    assert text.count('"auto" chooses from the photos') == 1


def test_where_nothing_was_measured_the_photos_say_nothing() -> None:
    evidence = "The settings decide."
    decision = Decision("growth", "off", "off", evidence, measured=False)
    stored = Decision.from_json(json.loads(json.dumps(decision.to_json())))
    assert stored == decision
    text = "\n".join(selection_lines({"decisions": [stored.to_json()]}))
    assert f"{evidence}\n" in text
    assert "Set by you" not in text
    values = decision.to_json()
    del values["measured"]  # as version 0.1.0 wrote it
    assert Decision.from_json(values).measured
    text = "\n".join(selection_lines({"decisions": [values]}))
    assert f"Set by you. Evidence from the photos: {evidence}" in text


def test_what_is_no_decision_is_passed_over_and_an_unknown_one_shown_as_it_is() -> None:
    assert "## Model selection" not in report_markdown(full_summary(), Path("nowhere"))
    for decisions in (None, 3, "x", [], [None, 3, {}, {"chosen": "on"}]):
        assert selection_lines({"decisions": decisions}) == []
    text = "\n".join(selection_lines({"decisions": [{"name": "new_one", "chosen": "x`y"}]}))
    for words in ("new\\_one", "x\\`y", "No evidence was recorded"):
        assert words in text
