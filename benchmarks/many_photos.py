# SPDX-License-Identifier: GPL-3.0-or-later
"""Does a capture of many photos keep what any photo needs? ``python -m benchmarks.many_photos``.

The same scene is wrapped from 120 photos and from every second of them, with the same settings, and
both results are judged by the same test views and the true surface. Each run leaves a record in
``benchmarks/records/many_photos``; a run that has one is not made again. At the end, or with
``--document``, ``docs/benchmarks/many-photos.md`` is written from the records alone.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import write_bytes

from .scenes import ensure_scene
from .speed_error.plan import Photos
from .speed_error.tables import SHARES, Row, table_of
from .study.case import Case
from .study.command import run_study
from .study.figures import gaussians, normal_error, view_psnr
from .study.making import KEPT_RUNS, make
from .study.origin import made_by, reading
from .study.record import Record
from .study.spread import Spread, shown
from .tables import Table

STUDY = "many_photos"
SCENES = ("room",)
SEEDS = (0, 1, 2)
MOST = 120
STEPS = (2, 1)
"""Every n-th photo is used."""
WIDTH_PX, HEIGHT_PX = 320, 240
ARGUMENTS = ("--holdout", "0", "--texture-size", "512")
PAGE, READING = "many-photos.md", "many-photos-reading.md"
COMMAND = "python -m benchmarks.many_photos"
_TRUTH = ("truth.npz", "crop.json", "scene.json", "region.json")
"""Files of a scene by which a run is judged."""


def photos_case(scene: str, step: int, seed: int) -> Case:
    """Return the run on every ``step``-th photo of a scene."""
    count = MOST // step
    photos = Photos(count, WIDTH_PX, HEIGHT_PX)
    return Case(STUDY, scene, f"photos{count}", seed, "draft", ARGUMENTS, photos=photos)


def plan() -> list[Case]:
    """Return all runs in the order in which they are made."""
    return [photos_case(name, step, seed) for name in SCENES for seed in SEEDS for step in STEPS]


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks for; return 1 where a run failed, else 0."""
    return run_study(arguments, __doc__, plan(), write_document, make_one, find_scene=find_scene)


def make_one(case: Case, *, threads: int, kept: Path = KEPT_RUNS) -> Record:
    """Make one run and write its record."""
    return make(case, threads=threads, kept=kept, find_scene=find_scene)


def find_scene(case: Case) -> Path:
    """Return the folder of a case's photos, with what they are judged by; make it if missing."""
    whole = ensure_scene(case.scene, photos=MOST, width=WIDTH_PX, height=HEIGHT_PX)
    step = MOST // case.photos.count
    if step == 1:
        return whole
    part = KEPT_RUNS / STUDY / "scenes" / f"{whole.name}-every{step}"
    if not part.is_dir():
        making = part.with_name(f"{part.name}.making")
        shutil.rmtree(making, ignore_errors=True)
        every_nth_photo(whole, step, making)
        for name in _TRUTH:
            shutil.copy(whole / name, making)
        shutil.copytree(whole / "test", making / "test")
        making.rename(part)
    return part


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
    return target


def _content(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").split("\n")
    return [line for line in lines[:-1] if not line.startswith("#")]


_PURPOSE = (
    f"The same scenes from {MOST} photos of {WIDTH_PX} x {HEIGHT_PX} pixels and from every second "
    "of them; preset Draft, exact cameras, everything else as the program decides. Pruning by "
    "contribution must not remove what only some of many photos show."
)

_NOTES = (
    "Mean ± standard deviation over the seeds; difference: 120 photos less 60 of the same seed.",
    (
        "PSNR and SSIM of eight test views that no run was given; F1 over the whole true surface "
        "at shares of the crop volume's diagonal."
    ),
)


def write_document(out: Path, records: Mapping[str, Record], cases: Sequence[Case]) -> Path:
    """Write the page into a folder."""
    lines = [
        "# Captures of many photos",
        "",
        *made_by(COMMAND, list(records.values()), cases),
        "",
        _PURPOSE,
        "",
        *reading(out / READING),
        photos_table(records).markdown(),
    ]
    path = out / PAGE
    write_bytes(path, ("\n".join(lines).rstrip() + "\n").encode())
    return path


def photos_table(records: Mapping[str, Record]) -> Table:
    """Return a row for each number of photos of a scene, and one for their difference."""
    rows: list[Row] = []
    for scene in SCENES:
        by_count = {
            MOST // step: {
                seed: records[case.identity]
                for seed in SEEDS
                if (case := photos_case(scene, step, seed)).identity in records
            }
            for step in STEPS
        }
        for count, made in by_count.items():
            if made:
                rows.append({"scene": scene, "photos": str(count), **_cells(list(made.values()))})
        few, many = by_count.values()
        pairs = [(few[seed], many[seed]) for seed in SEEDS if seed in few and seed in many]
        if pairs:
            rows.append({"scene": scene, "photos": "difference", **_differences(pairs)})
    return table_of("Many photos", rows, *_NOTES)


def _figures(record: Record) -> dict[str, tuple[float | None, int]]:
    """Return the figures of a run with their decimals."""
    return {
        "PSNR dB": (view_psnr(record), 2),
        "SSIM": (float(record.scores["gaussians"]["ssim"]), 4),
        **{f"F1 {share}": (record.f1(index), 3) for index, share in enumerate(SHARES)},
        "normal error": (normal_error(record), 3),
    }


def _cells(records: Sequence[Record]) -> Row:
    found = [_figures(record) for record in records]
    return {
        "seeds": len(records),
        "Gaussians": shown([gaussians(record) for record in records], 0),
        **{k: shown([of[k][0] for of in found], digits) for k, (_, digits) in found[0].items()},
    }


def _differences(pairs: Sequence[tuple[Record, Record]]) -> Row:
    found = [(_figures(few), _figures(many)) for few, many in pairs]
    row: Row = {"seeds": len(pairs), "Gaussians": None}
    for name, (_, digits) in found[0][0].items():
        apart = [
            many[name][0] - few[name][0]  # type: ignore[operator]
            for few, many in found
            if few[name][0] is not None and many[name][0] is not None
        ]
        spread = Spread.of(apart)
        row[name] = None if spread is None else spread.text(digits, signed=True)
    return row


if __name__ == "__main__":
    raise SystemExit(main())
