# SPDX-License-Identifier: GPL-3.0-or-later
"""What the check of photos says about real sets, as they are and with faults put in.

    python -m benchmarks.photo_check FOLDER [--document FILE]

FOLDER holds the sets named in ``CALIBRATED`` and ``HELD_OUT``, each a folder of photos. Of every
fourth photo a faulty copy takes its place among the others, one at a time (the limits were not
moved by those of ``HELD_OUT``). Faults are put into the reduced photos that the check measures.
"""

from __future__ import annotations

import argparse
import logging
import platform
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter1d

from gaussian_wrapping_addon.core.dataset.photos.photo_finder import list_photos, photo_root
from gaussian_wrapping_addon.core.dataset.quality.photo_measures import (
    SMALL_PX,
    PhotoMeasures,
    measure_grey,
    reduced_grey,
    shrunk,
)
from gaussian_wrapping_addon.core.dataset.quality.set_comparison import (
    blurred,
    light_spread,
    out_of_line,
    same_again,
)

CALIBRATED = ("banana", "flowerpot", "odm_caliterra", "skull_flash")
HELD_OUT = ("fox", "conch_turntable", "odm_brighton_beach")
EVERY = 4
_STOPS = 1.5
_logger = logging.getLogger("benchmarks.photo_check")

HEAD = """\
# Check of photos

What `check` says about photo sets as they are, and the share of photos that it names when a fault
is put into one photo at a time (every fourth). Limits stood before the figures of the last three
sets, in *italics*, and were not moved by them; how sharpness and light are measured was chosen
among several ways with all sets in view.
`python -m benchmarks.photo_check FOLDER`, {machine}, {date}.

Faults: blur of a focus {low} and {high} pixels off (standard deviation, of 1024 pixels a side), a
camera that moved 9 pixels, {stops} stops less or more light (white stays white), the
photo before once more with noise of 2 levels. Seconds are of decoding and comparing on one thread,
whatever else the machine did.

| set | photos | seconds | named as they are: blur, light, same | spread, stops \
| blur {low} | blur {high} | moved | darker | brighter | same |
|---|---|---|---|---|---|---|---|---|---|---|
"""
_BLURS = (1.5, 3.0)


def faults_of(grey: np.ndarray, before: np.ndarray) -> dict[str, np.ndarray]:
    """Return a photo's reduced grey with each of the faults."""
    noise = np.random.default_rng(0).normal(0.0, 2.0, before.shape)
    return {
        **{f"blur {sigma}": gaussian_filter(grey, sigma) for sigma in _BLURS},
        "moved": uniform_filter1d(grey, 9, axis=1),
        "darker": grey * 2 ** (-_STOPS / 2.2),
        "brighter": np.minimum(grey * 2 ** (_STOPS / 2.2), 255),
        "same": np.clip(before + noise, 0, 255).astype(np.float32),
    }


def named(kind: str, photos: list[PhotoMeasures], index: int) -> bool:
    """Tell whether the check names photo ``index`` for a kind of fault."""
    if kind in ("darker", "brighter"):
        return index in [i for i, _ in out_of_line(photos)]
    if kind == "same":
        return any(index in pair for pair in same_again(photos))
    return index in blurred(photos)


def row_of(folder: Path, *, italic: bool) -> str:
    """Measure a set and return its row of the table."""
    paths = list_photos(photo_root(folder))
    begun_s = time.perf_counter()
    greys = [reduced_grey(path) for path in paths]
    photos = [measure_grey(g, p.name) for g, p in zip(greys, paths, strict=True)]
    as_they_are = (blurred(photos), out_of_line(photos), same_again(photos))
    seconds = time.perf_counter() - begun_s
    found: dict[str, list[bool]] = {}
    for i in range(1, len(photos), EVERY):
        for kind, grey in faults_of(greys[i], greys[i - 1]).items():
            faulty = measure_grey(np.asarray(grey, np.float32), photos[i].name)
            if kind == "same":  # the photo before, in the place of this one
                faulty = replace(faulty, small=shrunk(grey, SMALL_PX))
            trial = [*photos[:i], faulty, *photos[i + 1 :]]
            found.setdefault(kind, []).append(named(kind, trial, i))
    shares = [f"{100 * np.mean(found[kind]):.0f} %" for kind in found]
    for title, items in zip(("blur", "light", "same"), as_they_are, strict=True):
        for item in items:
            index = item if isinstance(item, int) else item[-1] if title == "same" else item[0]
            _logger.info("%s, %s: %s %s", folder.name, title, photos[int(index)].name, item)
    name = f"*{folder.name}*" if italic else folder.name
    counts = ", ".join(str(len(items)) for items in as_they_are)
    cells = [name, str(len(photos)), f"{seconds:.1f}", counts, f"{light_spread(photos):.1f}"]
    return f"| {' | '.join([*cells, *shares])} |"


def _processor() -> str:
    """Return the processor's name where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    return next((line.split(": ")[1] for line in lines if line.startswith("model name")), "")


def main() -> int:
    """Measure all sets and write the page."""
    parser = argparse.ArgumentParser(description="Check of photos on real sets.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--document", type=Path, metavar="FILE")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    page = HEAD.format(
        low=_BLURS[0], high=_BLURS[1], stops=_STOPS,
        machine=f"one thread of {_processor()}, 2 cores",
        date=time.strftime("%Y-%m-%d"),
    )  # fmt: skip
    for name in (*CALIBRATED, *HELD_OUT):
        row = row_of(options.folder / name, italic=name in HELD_OUT)
        _logger.info("%s", row)
        page += row + "\n"
    if options.document is not None:
        options.document.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
