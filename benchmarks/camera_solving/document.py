# SPDX-License-Identifier: GPL-3.0-or-later
"""The page docs/benchmarks/camera-solving.md, from records alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Records = Mapping[str, Mapping[str, Any]]

_HEAD = (
    "`python -m benchmarks.camera_solving --data DIR`, with `odm_caliterra`, `odm_brighton_beach`, "
    "`fox` and `conch_turntable` in DIR; from records, which name machine and date. Processor "
    "seconds are of the solver's process and all its threads; seconds on the clock mean something "
    "only where nothing else runs."
)
_RUNS = (
    "Rotation and centre: medians against exact cameras after a similarity, centres over their "
    "spread. GPS: median distance from the positions in EXIF after a similarity. `town-400` is "
    "rendered streets of 640 x 480 pixels, `town-400-176` the first 176 of its photos, `hall-64` a "
    "room with four equal walls."
)
_RETRIEVAL = (
    "A true pair has 30 verified matches where all pairs are matched. In these small sets most "
    "pairs are true, so that recall is bounded by the number of pairs; what cameras need are the "
    "strongest pairs of each photo."
)
_REPEATING = (
    "A hall of four walls by its matches alone, without pictures, made so that photos of different "
    "walls match. Right cameras must not be doubted, wrong ones must."
)


def page(records: Records) -> str:
    """Return the page."""
    lines = [
        "# Cameras of hundreds of photos",
        "",
        _HEAD,
        "",
        *_runs(records),
        *_retrieval(records),
        *_repeating(records),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _runs(records: Records) -> list[str]:
    rows = []
    for name, record in records.items():
        if "placed" not in record:
            continue
        errors, gps, facts = record.get("errors"), record.get("gps"), record["facts"]
        rows.append(
            [
                name,
                f"{record['placed']} / {record['photos']}",
                facts["mapper"],
                facts["pairs_matched"],
                f"{record['processor_seconds']:.0f}",
                f"{record['seconds']:.0f}",
                f"{record['peak_bytes'] / 2**30:.2f}",
                _number(errors and errors["rotation_degrees_median"], 3),
                _number(errors and 100 * errors["center_share_median"], 2),
                _number(facts.get("mean_reprojection_error_px"), 2),
                _number(gps and gps["median_m"], 1),
                facts["pairs_contradicting_cameras"],
                ", ".join(warning["code"] for warning in record["warnings"]) or "none",
                record["date"],
            ]
        )
    if not rows:
        return []
    head = [
        "photos", "placed", "mapper", "pairs", "processor s", "clock s", "GiB", "rotation deg",
        "centre %", "reprojection px", "GPS m", "contradicting pairs", "warnings", "date",
    ]  # fmt: skip
    threads = sorted({record["threads"] for record in records.values() if "threads" in record})
    processors = sorted({record["processor"] for record in records.values() if "threads" in record})
    return [
        "## Solved cameras",
        "",
        f"{', '.join(processors)}; threads: {', '.join(map(str, threads))}. {_RUNS}",
        "",
        *_table(head, rows),
    ]


def _retrieval(records: Records) -> list[str]:
    rows = []
    for name, record in records.items():
        if not name.startswith("recall-"):
            continue
        for row in record["rows"]:
            rows.append(
                [
                    name.removeprefix("recall-"),
                    record["photos"],
                    f"{record['true_pairs']} / {record['all_pairs']}",
                    row["nearest"],
                    row["pairs"],
                    f"{row['precision']:.2f}",
                    f"{row['recall']:.2f}",
                    f"{row['recall_of_matches']:.2f}",
                    f"{row['recall_of_strongest']:.2f}",
                ]
            )
    if not rows:
        return []
    head = [
        "set", "photos", "true / all pairs", "nearest", "pairs", "precision", "recall",
        "recall of matches", "recall of the 5 strongest",
    ]  # fmt: skip
    return [
        "## Pairs by resemblance alone",
        "",
        _RETRIEVAL,
        "",
        *_table(head, rows),
    ]


def _repeating(records: Records) -> list[str]:
    record = records.get("repeating")
    if record is None:
        return []
    rows = [
        [
            row["repeats"], f"{100 * row['alike']:.0f} %", row["seed"], row["placed"],
            f"{row['degrees_first']:.2f}", "yes" if row["is_suspected"] else "no",
            "yes" if row["is_mended"] else "no", f"{row['degrees']:.2f}",
            f"{row['contradicting_pairs']} / {row['strong_pairs']}",
            "yes" if row["is_doubtful"] else "no",
        ]
        for row in record["rows"]
    ]  # fmt: skip
    head = [
        "equal walls", "of their points", "seed", "placed", "rotation deg, first", "doubted",
        "solved again", "rotation deg, last", "contradicting pairs", "warned",
    ]  # fmt: skip
    return [
        "## Walls that repeat",
        "",
        f"{record['photos']} photos. {_REPEATING}",
        "",
        *_table(head, rows),
    ]


def _number(value: Any, digits: int) -> str:
    return "" if value is None else f"{float(value):.{digits}f}"


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    return [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows),
        "",
    ]
