# SPDX-License-Identifier: GPL-3.0-or-later
"""Does a capture of many photos keep what any photo needs? ``python -m benchmarks.many_photos``.

The same scene is wrapped from 120 photos and from every second of them, with the same settings, and
both results are judged by the same test views and the true surface. Each run leaves a record in
``benchmarks/records/many_photos``; runs with a record are not made again without ``--again``, and
``docs/benchmarks/many-photos.md`` is written from the records.
"""

from __future__ import annotations

import argparse
import logging
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import read_json, write_json

from .judged_run import SHARES, judged_run
from .scenes import ensure_scene
from .speed_error.plan import Run
from .speed_error.runs import ROOT
from .tables import Table

_logger = logging.getLogger("benchmarks")

PHOTOS = 120
PARTS = (1, 2)
"""Every n-th photo is used."""
SCENES = ("room", "spot")
WIDTH_PX, HEIGHT_PX = 320, 240
ARGUMENTS = ("--holdout", "0", "--texture-size", "512")
RECORDS = ROOT / "benchmarks" / "records" / "many_photos"
DOCUMENT = ROOT / "docs" / "benchmarks" / "many-photos.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs that have no record, then write the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="make runs anew that have a record")
    parser.add_argument("--label", default="", help="of the code, for a comparison of versions")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    for name in options.scenes:
        for part in PARTS:
            words = [name, str(PHOTOS // part), *([options.label] if options.label else [])]
            path = RECORDS / f"{'-'.join(words)}.json"
            if options.again or not path.is_file():
                path.parent.mkdir(parents=True, exist_ok=True)
                write_json(path, record(name, part, options.threads, options.label))
                _logger.info("%s", path.name)
    DOCUMENT.write_text(document(), encoding="utf-8")
    return 0


def record(name: str, part: int, threads: int, label: str) -> dict[str, Any]:
    """Wrap every ``part``-th photo of a scene and return what is kept of the run."""
    whole = ensure_scene(name, photos=PHOTOS, width=WIDTH_PX, height=HEIGHT_PX)
    with tempfile.TemporaryDirectory() as folder:
        scene = whole if part == 1 else every_nth_photo(whole, part, Path(folder) / name)
        run = Run(name, "draft", 0, f"photos{PHOTOS // part}", ARGUMENTS)
        found = judged_run(run, scene, whole, threads)
    return {**found, "photos": PHOTOS // part, "label": label}


def every_nth_photo(scene: Path, step: int, target: Path) -> Path:
    """Write a copy of a scene's COLMAP project that has every ``step``-th photo.

    Sparse points stay where two of these photos see them.
    """
    (target / "images").mkdir(parents=True)
    sparse = target / "sparse" / "0"
    sparse.mkdir(parents=True)
    source = next(path.parent for path in scene.rglob("images.txt"))
    shutil.copy(source / "cameras.txt", sparse)
    lines = _content(source / "images.txt")
    kept, entries = set(), []
    for pose, points in list(zip(lines[0::2], lines[1::2], strict=True))[::step]:
        words = pose.split()
        kept.add(words[0])
        shutil.copy(scene / "images" / words[-1], target / "images")
        entries.append((pose, points))
    alive, points_out = set(), []
    for line in _content(source / "points3D.txt"):
        words = line.split()
        track = [(i, at) for i, at in zip(words[8::2], words[9::2], strict=True) if i in kept]
        if len(track) >= 2:
            alive.add(words[0])
            points_out.append(" ".join([*words[:8], *(word for pair in track for word in pair)]))
    text = []
    for pose, points in entries:
        words = points.split()
        triples = zip(words[0::3], words[1::3], words[2::3], strict=True)
        seen = [f"{u} {v} {p if p in alive else -1}" for u, v, p in triples]
        text += [pose, " ".join(seen)]
    (sparse / "images.txt").write_text("\n".join(text) + "\n", encoding="utf-8")
    (sparse / "points3D.txt").write_text("\n".join(points_out) + "\n", encoding="utf-8")
    if (scene / "region.json").is_file():
        shutil.copy(scene / "region.json", target)
    return target


def _content(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").split("\n")
    return [line for line in lines[:-1] if not line.startswith("#")]


_NOTE = (
    "PSNR and SSIM of eight test views that no run was given; F1 over the whole true surface at "
    "shares of the crop volume's diagonal."
)

_PURPOSE = (
    f"The same scene from {PHOTOS} photos of {WIDTH_PX} x {HEIGHT_PX} pixels and from every second "
    "of them; preset Draft, exact cameras, everything else as the program decides. Pruning by "
    "contribution must not remove what only some of many photos show."
)


def _cells(of: dict[str, Any]) -> tuple[str | float | int | None, ...]:
    """Return one row of the table."""
    scores = (f"{value:.3f}" for value in of["f1"].values())
    version = of["label"] or "this version"
    psnr, ssim = f"{of['psnr']:.2f}", f"{of['ssim']:.4f}"
    return (of["scene"], version, of["photos"], of["gaussians"], psnr, ssim, *scores)


def document() -> str:
    """Return the document from all records."""
    records = [read_json(path) for path in sorted(RECORDS.glob("*.json"))]
    records.sort(key=lambda of: (of["scene"], of["label"], of["photos"]))
    header = (
        "scene",
        "code",
        "photos",
        "Gaussians",
        "PSNR dB",
        "SSIM",
        *(f"F1 {s}" for s in SHARES),
    )
    table = Table("Many photos", header, [_cells(of) for of in records], (_NOTE,))
    facts = sorted({(of["label"] or "this version", of["code"], of["date"]) for of in records})
    machines = sorted({f"{of['machine']}, {of['threads']} thread" for of in records})
    lines = [
        "# Captures of many photos",
        "",
        f"`python -m benchmarks.many_photos`; {'; '.join(machines)}.",
        "",
        *(f"- {label}: code {code}, {date}" for label, code, date in facts),
        "",
        _PURPOSE,
        "",
        table.markdown(),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
