# SPDX-License-Identifier: GPL-3.0-or-later
"""report.json and report.md."""

from __future__ import annotations

import math
import time
import urllib.parse
from pathlib import Path, PurePosixPath
from typing import Any

from ...files import finite_json, resolve_inside, write_bytes, write_json
from ...names import REPORT_FOLDER
from .figures import (
    FEW_HELD_OUT,
    NOT_MEASURED,
    bar,
    bytes_text,
    collect_warnings,
    duration,
    escaped,
    escaped_or,
    figure_rows,
    items,
    measured,
    number,
    part,
    percent,
    plural,
    table,
    warning_lines,
)
from .region_section import Picture, closedness, note_lines, region_lines, region_summary

# -- Report section on model selection: each choice, its evidence, the setting to override it -----


_TITLES = {
    "exposure": "Brightness and tint of each photo",
    "multi_view": "Comparison of neighbouring photos",
    "full_size": "Size of the training images",
    "dense_start": "Start on surfaces found by matching photos",
    "refine_poses": "Camera poses refined",
    "region_weight": "Trained for the regions",
}
"""Title of each choice, in an artist's words."""

_EFFECTS = {
    "exposure": '"on" corrects every photo; "off" uses them unchanged',
    "multi_view": '"on" or "off"',
    "full_size": '"on" trains at full size up to `max_image_px`; "off" at half of it',
    "refine_poses": '"on" refines them in any case; "off" takes them as given',
    "dense_start": '"on" starts on whatever is found; "off" starts from the sparse points',
    "region_weight": "1 trains for all that the photos show, more for regions in them",
}

_DECIDED_BY = {"auto": "the photos", "on": "you (on)", "off": "you (off)"}


def selection_lines(training: dict[str, Any]) -> list[str]:
    """Return the Markdown lines of the section with its heading; none if nothing was selected.

    The entry ``decisions`` of the training's figures holds what
    :meth:`~.model_selection.ModelSelection.to_json` wrote. Unknown entries of newer versions are
    shown unchanged.
    """
    rows, lines = [], []
    for entry in map(part, items(training.get("decisions"))):
        if not entry.get("name"):
            continue
        title = _TITLES.get(str(entry["name"]), escaped(entry["name"]))
        chosen, setting = escaped_or(entry.get("chosen")), entry.get("setting")
        rows.append((title, chosen, _DECIDED_BY.get(str(setting), escaped_or(setting))))
        lines += [f"- **{title}: {chosen}.** {_evidence(entry)}"]
        lines += [f"    - *To change this:* {_override(entry)}."]
    if not rows:
        return []
    text = (
        "A larger model than the scene needs costs time and can lower the quality. Each part "
        "is therefore chosen from the photos, unless you set it."
    )
    chosen_by = table(("part", "used", "chosen by"), rows, "lll")
    return ["## Model selection", "", text, "", *chosen_by, "", *lines]


def _evidence(entry: dict[str, Any]) -> str:
    evidence = escaped_or(entry.get("evidence"), "No evidence was recorded.")
    measured = entry.get("measured") is not False  # absent in version 0.1.0
    if entry.get("setting") in ("on", "off") and measured:
        return f"Set by you. Evidence from the photos: {evidence}"
    return evidence


def _override(entry: dict[str, Any]) -> str:
    name = str(entry["name"])
    effect = f": {_EFFECTS[name]}" if name in _EFFECTS else ""
    back = '; "auto" chooses from the photos' if entry.get("setting") in ("on", "off") else ""
    return f"setting `{escaped(name) if name not in _TITLES else name}`{effect}{back}"


# -- Report section: the blocks of a training -----------------------------------------------------


def blocks_lines(training: dict[str, Any]) -> list[str]:
    """Return a table of the blocks as Markdown lines; none for a training in one piece."""
    blocks = [part(block) for block in items(training.get("blocks"))]
    if not blocks:
        return []
    counts = ("photos", "gaussians", "still", "iterations")
    rows = [
        (
            str(index), *(number(block.get(name)) for name in counts),
            duration(block.get("seconds")), bytes_text(block.get("peak_memory_bytes")),
        )
        for index, block in enumerate(blocks)
    ]  # fmt: skip
    header = ("block", "photos", "Gaussians", "around it", "iterations", "time", "peak memory")
    text = (
        f"Trained in {len(blocks)} blocks, after a coarse training of the whole scene "
        f"({duration(training.get('seconds_coarse'))}), and joined. Photos and Gaussians of "
        "the margins count in several blocks; time and memory are those of its process so far."
    )
    return ["", text, "", *table(header, rows, "rrrrrrr")]


# -- Report section: estimated and actual time and memory of the training -------------------------


def estimate_lines(training: dict[str, Any]) -> list[str]:
    """Return the comparison as Markdown lines; none if nothing was estimated."""
    expected = part(training, "estimate")
    low, high = measured(expected.get("seconds_low")), measured(expected.get("seconds_high"))
    took = measured(training.get("seconds_training"))
    if low is None or high is None or took is None:
        return []
    where = "within it" if low <= took <= high else ("below it" if took < low else "above it")
    text = (
        f"Estimated before the start: {duration(low)} to {duration(high)}, "
        f"{bytes_text(expected.get('memory_bytes'))} of memory. It took {duration(took)}, "
        f"{where}.{_photos(part(expected, 'photos'))}"
    )
    return ["", text]


def _photos(photos: dict[str, Any]) -> str:
    """Return where the photos were, as a sentence; nothing if the report is older."""
    whole, budget = measured(photos.get("all_bytes")), measured(photos.get("budget_bytes"))
    if whole is None or budget is None:
        return ""
    if whole <= budget:
        return f" All photos fitted into memory ({bytes_text(whole)})."
    return (
        f" Photos were read on demand: {bytes_text(whole)} decoded, {bytes_text(budget)} of memory "
        "for them."
    )


# -- ``report.md``: the results of a job as text for its user; a summary, then all figures --------


CURVE = "learning-curve.svg"

_STAGES = {
    "cameras": "photos and cameras",
    "masks": "making masks",
    "masked": "photos with these masks",
    "coarse": "coarse training",
    "block": "training one block",
    "train": "training the Gaussians",
    "mesh": "mesh of region",
    "texture": "texture of region",
}
_MEMORY = {
    "worker": "main process",
    "largest_helper": "largest helper process (camera solving, unwrapping)",
}
_FACTS = {
    "kind": ("Input", ""),
    "video_frames_read": ("Frames of the video", "frames"),
    "video_frames_blurred": ("Frames left out as blurred", "frames"),
    "video_frames_still": ("Frames left out because nothing moved", "frames"),
    "video_frames_damaged": ("Frames that cannot be decoded", "frames"),
    "video_frames_kept": ("Frames used as photos", "frames"),
    "photos_in_order": ("Photos in the order of", ""),
    "photos": ("Photos in the input", "photos"),
    "photos_placed": ("Photos with a solved camera", "photos"),
    "photos_undistorted": ("Photos undistorted", "photos"),
    "photos_masked": ("Photos with a mask", "photos"),
    "turntable_photos": ("Photos of a turntable", "photos"),
    "photos_masked_as_turning": ("Photos masked to what turns", "photos"),
    "photos_masked_to_object": ("Photos with a made mask", "photos"),
    "photos_rejected": ("Photos whose mask was rejected, left out", "photos"),
    "photos_with_focal_length": ("Photos with a recorded focal length", "photos"),
    "pairs_matched": ("Pairs of photos matched", "pairs"),
    "pairs_verified": ("Pairs that show the same", "pairs"),
    "pairs_contradicting_cameras": ("Pairs that contradict the cameras", "pairs"),
    "photos_joined": ("Photos joined from other parts", "photos"),
    "photo_sizes": ("Photo size", "pixels"),
    "mean_reprojection_error_px": ("Mean reprojection error of the sparse points", "px"),
    "start_points": ("Initial points", ""),
    "up_from": ("Up direction taken from", ""),
    "world_frame": ("World frame", ""),
    "camera_models": ("Lens model", ""),
    "georeference_note": ("GPS is not used", ""),
    "also_present": ("Also found in the input", ""),
}


def report_markdown(report: dict[str, Any], result: Path, earlier: Path | None = None) -> str:
    """Return the text of ``report.md``, of a report of any version.

    Missing entries are reported as not measured; a picture of the result folder is linked only if
    its file exists. What the folder lacks is looked up in ``earlier``, the result folder into
    which it will be merged.
    """
    picture, training = _pictures_of(result, earlier), part(report, "training")
    lines = [
        f"# Report: {escaped_or(report.get('source'), 'job')}", "",
        *picture("preview.png", "Left: part of a photo. Right: the textured mesh."),
        *_summary(report), "",
        "## Time and memory", "", *_time(report), "",
        "## Photos and cameras", "", *_cameras(part(report, "cameras")), "",
        "## Training", "", *_training(training, picture), "",
        *selection_lines(training),
    ]  # fmt: skip
    for name, region in part(report, "regions").items():
        lines += ["", f"## Region {escaped(name)}", "", *region_lines(name, region, picture)]
    lines += ["", "## Warnings", "", *warning_lines(report)]
    lines += ["", "## Machine, versions, seed", "", *_machine(report)]
    figures = table(("figure", "value", "unit"), figure_rows(report), "lrl")
    lines += ["", "<details>", "<summary>All figures</summary>", "", *figures, "", "</details>"]
    # Runs of empty lines become one.
    return "\n".join(t for i, t in enumerate(lines) if t or i == 0 or lines[i - 1]) + "\n"


def _pictures_of(result: Path, earlier: Path | None) -> Picture:
    def picture(path: str, caption: str) -> list[str]:
        replaced = earlier is None or (result / PurePosixPath(path).parts[0]).exists()
        file = resolve_inside(result if replaced or earlier is None else earlier, path)
        if file is None or not file.is_file():
            return []
        link = urllib.parse.quote(PurePosixPath(path).as_posix())
        return [f"![{escaped(caption)}]({link})", "", f"*{escaped(caption)}*", ""]

    return picture


def _summary(report: dict[str, Any]) -> list[str]:
    cameras, training = part(report, "cameras"), part(report, "training")
    preset = part(report, "settings").get("preset")
    text = f"Photos used: {number(cameras.get('views'))}. "
    text += f"Gaussians trained on them: {number(training.get('gaussians'))}"
    if preset:
        text += f" (preset {escaped(preset)})"
    lines = ["## Summary", "", f"- **Result.** {text}."]
    lines[-1] += "".join(" " + region_summary(n, r) for n, r in part(report, "regions").items())
    lines.append(f"- **Time.** {_duration_sentence(report)}")
    lines.append(f"- **Accuracy.** {_accuracy_sentence(training)}{_mesh_accuracy_sentence(report)}")
    lines.append(f"- **Texture coverage.** {_coverage_sentence(report)}")
    warnings = collect_warnings(report)
    if not warnings:
        return [*lines, "- **Warnings.** No stage reported a warning."]
    lines.append(f"- **Warnings** ({plural(len(warnings), 'warning')}):")
    return lines + [f"    - {escaped(w.text)}" for w in warnings]


def _duration_sentence(report: dict[str, Any]) -> str:
    stages = [(s, measured(s.get("seconds"))) for s in map(part, items(report.get("stages")))]
    known = [(s, seconds) for s, seconds in stages if seconds is not None]
    total = sum(seconds for _, seconds in known)
    text = f"This run: {duration(report.get('wall_seconds'))}."
    reused = [_stage_name(s) for s, _ in stages if s.get("reused") is True]
    if reused:
        text = f"{text[:-1]}; reused from an earlier run: {', '.join(reused)}."
    if known and total > 0:
        longest, seconds = max(known, key=lambda pair: pair[1])
        text += (
            f" All stages together took {duration(total)}; the longest was {_stage_name(longest)} "
            f"({percent(seconds / total, 0)})."
        )
    return text


def _accuracy_sentence(training: dict[str, Any]) -> str:
    held_out = items(training.get("held_out"))
    psnr = measured(training.get("held_out_psnr"))
    if not held_out or psnr is None:
        why = "No photo was held out: the" if training.get("held_out") == [] else "The"
        return f"{why} accuracy of new views was {NOT_MEASURED}."
    text = (
        f"{plural(len(held_out), 'photo')} held out of training "
        f"{'is' if len(held_out) == 1 else 'are'} reproduced by the Gaussians with a PSNR of "
        f"{psnr:.1f} dB, a typical error of "
        f"{percent(10.0 ** (-psnr / 20.0))} of full brightness."
    )
    if len(held_out) < FEW_HELD_OUT:
        text += " These are too few for a reliable mean."
    return text


def _mesh_accuracy_sentence(report: dict[str, Any]) -> str:
    text = ""
    for name, region in part(report, "regions").items():
        rendering = part(region, "mesh_rendering")
        psnr = measured(rendering.get("psnr"))
        if psnr is None:
            text += f' Accuracy of the textured mesh of "{escaped(name)}": {NOT_MEASURED}.'
        else:
            views = plural(len(items(rendering.get("views"))), "photo")
            if rendering.get("pixels") == "covered":
                # The Gaussians are measured over whole photos: the two values are not comparable.
                covered = percent(rendering.get("covered"))
                views += f", over the pixels the mesh covers: {covered} of the photo"
            exposed = measured(rendering.get("exposed_psnr"))
            if exposed is not None:
                views += f", and {exposed:.1f} dB over them in the exposure of each photo"
            views += _left_out(
                rendering,
                "; no face covers {share} of the photo, and with these pixels counted as black it "
                "is {whole:.1f} dB",
            )
            note = rendering.get("note")
            if isinstance(note, str) and note.strip():
                views += f"; {escaped(note.strip().rstrip('.'))}"
            text += f' The textured mesh of "{escaped(name)}": {psnr:.1f} dB ({views}).'
    return text


def _left_out(rendering: dict[str, Any], text: str) -> str:
    """Return what the PSNR leaves out; nothing for reports of versions that did not measure it.

    ``text`` has the places ``{share}`` and ``{whole}``, the PSNR with uncovered pixels black.
    """
    share, whole = measured(rendering.get("uncovered")), measured(rendering.get("whole_psnr"))
    if share is None or whole is None:
        return ""
    return text.format(share=percent(share), whole=whole)


def _coverage_sentence(report: dict[str, Any]) -> str:
    parts = []
    for name, region in part(report, "regions").items():
        texture = part(region, "texture")
        coverage = percent(texture.get("coverage"))
        views = measured(texture.get("views_per_seen_texel"))
        behind = f", each seen texel by {views:.1f} photos on average" if views else ""
        if coverage == NOT_MEASURED:
            parts.append(f"{escaped(name)}: {NOT_MEASURED}.")
        else:
            parts.append(f"{escaped(name)}: photos saw {coverage} of the texture{behind}.")
    return " ".join(parts) or f"Coverage was {NOT_MEASURED}."


def _stage_name(stage: dict[str, Any]) -> str:
    kind, _, region = str(stage.get("name") or "unknown").partition("-")
    title = _STAGES.get(kind, escaped(kind))
    return f'{title} "{escaped(region)}"' if region else title


def _time(report: dict[str, Any]) -> list[str]:
    stages = [part(stage) for stage in items(report.get("stages"))]
    total = sum(measured(s.get("seconds")) or 0.0 for s in stages)
    rows = []
    for stage in stages:
        seconds = measured(stage.get("seconds"))
        share = seconds / total if seconds is not None and total > 0 else None
        rows.append(
            (
                _stage_name(stage) + (" (earlier run)" if stage.get("reused") is True else ""),
                NOT_MEASURED if seconds is None else f"{seconds:,.1f} s",
                percent(share),
                "" if share is None else bar(share),
            )
        )
    rows.append(("**all stages**", f"{total:,.1f} s" if total else NOT_MEASURED, "", ""))
    wall = number(report.get("wall_seconds"), "s", digits=1)
    rows.append(("**this run, until the report**", wall, "", ""))
    lines = table(("stage", "time", "share", ""), rows, "lrrl")
    memory = part(report, "peak_memory_bytes")
    lines += ["", "Peak memory of this run:", ""]
    for key, process in _MEMORY.items():
        value = memory.get(key)
        text = "none ran" if key != "worker" and value == 0 else bytes_text(value)
        lines.append(f"- {process}: {text}")
    return lines


def _unit_rows(units: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what the entry ``georeference`` says about metres and how well they are known."""
    if not units:
        return []
    sources = units.get("sources")
    listed = ", ".join(str(s) for s in sources) if isinstance(sources, list) else None
    rows = [("Metres from", escaped_or(listed))]
    error = measured(units.get("scale_error"))
    if error is not None:
        rows.append(("Error of the scale (standard deviation)", number(100.0 * error, "%")))
    for key, name in (("gps", "Cameras"), ("control_points", "Control points")):
        found = part(units, key)
        if found:
            text = f"{name} off their known places, median"
            rows.append((text, number(found.get("median_m"), "m", digits=3)))
    markers = part(units, "markers")
    if markers:
        rows.append(("Markers measured", number(markers.get("used"), "markers")))
    origin = part(units, "origin")
    if origin:
        place = [measured(origin.get(k)) for k in ("latitude_deg", "longitude_deg", "altitude_m")]
        text = ", ".join("-" if v is None else f"{v:.6f}" for v in place[:2])
        rows.append(("Origin: latitude, longitude (WGS 84)", text))
    return rows


def _cameras(cameras: dict[str, Any]) -> list[str]:
    facts = part(cameras, "facts")
    rows = [
        ("Photos used", number(cameras.get("views"), "photos")),
        ("Sparse points", number(cameras.get("points"), "points")),
    ]
    if "mean_reprojection_error_px" not in facts:
        rows.append((_FACTS["mean_reprojection_error_px"][0], NOT_MEASURED))
    for key, (name, unit) in _FACTS.items():
        if key not in facts:
            continue
        value = facts[key]
        if measured(value) is not None:
            text = number(value, unit)
        else:
            listed = ", ".join(str(v) for v in value if v) if isinstance(value, list) else value
            text = f"{escaped_or(listed)} {unit}".strip()
        rows.append((name, text))
    units = part(facts, "georeference")
    rows += _unit_rows(units)
    if units.get("applied") is True:
        text = "One world unit is one metre."
    elif facts.get("kind") in ("photos", "video"):
        text = (
            "The cameras were solved from the photos alone, which do not determine the "
            "scale: one world unit is an arbitrary length. To measure in metres, scale the "
            "mesh by a known length."
        )
    else:
        text = "One world unit is the unit of the given camera poses."
    return [*table(("photos and cameras", "figure"), rows, "lr"), "", text]


_HELD_OUT = (
    "Held-out photos are not used for training; they measure the accuracy of new views. "
    "A PSNR higher by 6 dB means half the error."
)
_PICTURES = (
    "Left: the photo. Middle: the Gaussians rendered from the same camera. Right: the "
    "error; black is none, violet about 6 %, red 12 %, orange 19 %, and white 25 % of "
    "full brightness or more. The worst photo comes first."
)


def _training(training: dict[str, Any], picture: Picture) -> list[str]:
    held_out = [part(figure) for figure in items(training.get("held_out"))]
    iterations = number(training.get("iterations"), "iterations")
    lines = [
        f"{number(training.get('gaussians'), 'Gaussians')} after {iterations}.",
        *blocks_lines(training),
        *estimate_lines(training),
        "",
        *picture(f"{REPORT_FOLDER}/{CURVE}", "PSNR and number of Gaussians during training."),
    ]
    if not held_out:
        why = "No photo was held out: " if training.get("held_out") == [] else ""
        return [*lines, f"{why}PSNR and SSIM of new views were {NOT_MEASURED}."]
    lines += [_HELD_OUT, ""]
    perceptual = any(measured(figure.get("lpips")) is not None for figure in held_out)
    rows = [_held_out_row(escaped_or(f.get("name")), f, perceptual) for f in held_out]
    mean = {key: training.get(f"held_out_{key}") for key in ("psnr", "ssim", "lpips")}
    rows.append(_held_out_row("**mean**", mean, perceptual))
    header = ["held-out photo", "PSNR", "typical error", "SSIM (1 is identical)"]
    header += ["LPIPS (0 is identical)"] * perceptual
    lines += table(header, rows, "lrrr" + "r" * perceptual)
    if not perceptual:
        unknown = ["", f"LPIPS (perceptual distance) was {NOT_MEASURED}."]
        lines += note_lines({"lpips_note": training.get("lpips_note")}) or unknown
    shown: list[str] = []
    for entry in map(part, items(training.get("pictures"))):
        psnr = number(entry.get("psnr"), "dB", digits=1)
        caption = f"{entry.get('name') or 'photo'}, {psnr}"
        shown += picture(f"{REPORT_FOLDER}/{entry.get('file')}", caption)
    if not shown:
        return [*lines, "", "There are no pictures of the held-out photos."]
    return [*lines, "", _PICTURES, "", *shown]


def _held_out_row(name: str, figure: dict[str, Any], perceptual: bool) -> list[str]:
    psnr = measured(figure.get("psnr"))
    error = NOT_MEASURED if psnr is None else percent(math.pow(10.0, -psnr / 20.0))
    row = [name, number(psnr, "dB", digits=2), error, number(figure.get("ssim"), digits=4)]
    return [*row, number(figure.get("lpips"), digits=4)] if perceptual else row


def _machine(report: dict[str, Any]) -> list[str]:
    machine, settings = part(report, "machine"), part(report, "settings")
    started = measured(report.get("started_unix_s"))
    date = "unknown"
    if started is not None:
        date = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(started))
    packages = part(machine, "packages")
    versions = ", ".join(f"{escaped(k)} {escaped_or(v)}" for k, v in packages.items())
    threads = f"{number(machine.get('threads'), 'threads')} used"
    system, python = escaped_or(machine.get("system")), escaped_or(machine.get("python"))
    preset, seed = escaped_or(settings.get("preset")), escaped_or(settings.get("seed"))
    processor, cores = escaped_or(machine.get("processor")), number(machine.get("cores"), "cores")
    return [
        f"- Started: {date}",
        f"- Processor: {processor}, {cores}, {threads}",
        *_device(report),
        f"- Memory of the machine: {bytes_text(machine.get('memory_bytes'))}",
        f"- System: {system}, Python {python}",
        f"- Packages: {versions or 'unknown'}",
        f"- Preset: {preset}; seed: {seed}",
    ]


def _device(report: dict[str, Any]) -> list[str]:
    """Return the line on where the job computed; none for reports of earlier versions."""
    if "device" not in report:
        return []
    device, reason = escaped_or(report.get("device")), escaped_or(report.get("device_reason"))
    trained = part(report, "training").get("device")
    other = trained is not None and trained != report.get("device")
    trained_on = f" Trained on {escaped(trained)}." if other else ""
    return [f"- Device: {device}. {reason}{trained_on}"]


# -- Write the report of a job (``report.json``, ``report.md``) and summarise it in a few lines


def write_report(
    result: Path, summary: dict[str, Any], regions: dict[str, Any], earlier: Path | None = None
) -> None:
    """Write both files into the result folder; the pictures must already be there.

    Parameters
    ----------
    summary : dict
        Figures of the whole job: machine, stages, cameras, training.
    regions : dict
        For each region: mesh statistics, residuals, size in world units, texture coverage,
        renderings of the mesh, seconds.
    earlier : Path or None
        Result folder into which this one will be merged; it has the pictures of other regions.
    """
    report = finite_json({"version": 1, **summary, "regions": regions})
    report["warnings"] = [warning.to_json() for warning in collect_warnings(report)]
    write_json(result / "report.json", report)
    # File and region names may contain characters that cannot be encoded (lone surrogates).
    text = report_markdown(report, result, earlier).encode(errors="replace")
    write_bytes(result / "report.md", text)


def headline(report: dict[str, Any]) -> list[str]:
    """Return the main figures of a report, one line each."""
    training = part(report, "training")
    gaussians = number(training.get("gaussians"), "Gaussians")
    lines = [f"time: {duration(report.get('wall_seconds'))}, {gaussians}"]
    psnr, held_out = measured(training.get("held_out_psnr")), items(training.get("held_out"))
    known = psnr is not None and bool(held_out)
    text = f"PSNR {psnr:.2f} dB ({plural(len(held_out), 'photo')})" if known else NOT_MEASURED
    of_regions = measured(training.get("held_out_region_psnr"))
    if known and of_regions is not None:
        text += f", {of_regions:.2f} dB where they show the regions"
    lines.append(f"held-out photos: {text}")
    for name, region in part(report, "regions").items():
        statistics = part(region, "statistics")
        line = f"region {name}: {number(statistics.get('faces'), 'faces')}, "
        line += f"{closedness(statistics, part(region, 'provenance'))}, "
        line += f"{percent(part(region, 'texture').get('coverage'))} of the texture seen by photos"
        rendering = part(region, "mesh_rendering")
        rendered = measured(rendering.get("psnr"))
        if rendered is not None:
            line += f", textured mesh PSNR {rendered:.2f} dB"
            exposed = measured(rendering.get("exposed_psnr"))
            if exposed is not None:
                line += f" ({exposed:.2f} dB in the exposure of each photo)"
            where = " where it covers the photos" if rendering.get("pixels") == "covered" else ""
            line += _left_out(
                rendering, where + " ({share} of them uncovered; {whole:.2f} dB with these black)"
            )
        lines.append(line)
    return lines + [f"warning ({one.stage}): {one.text}" for one in collect_warnings(report)]
