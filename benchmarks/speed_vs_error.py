# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure speed against error: ``python -m benchmarks.speed_vs_error``.

Presets and meshers on photos of scenes whose surface is known exactly (``benchmarks/scenes``), each
through the command line as a user would run it. Each run leaves a record in
``benchmarks/records/speed``; a run that has one is not made again, so that the study may take
several sittings: stop the command whenever you like. At the end, or with ``--document``,
``docs/benchmarks/README.md`` and its plot are written from the records alone; ``--pictures`` draws
the runs that this machine has kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .scenes import ensure_scene
from .speed_error.alpha_shape import make_alpha
from .speed_error.cases import ALPHA, SCENES, preset_case, study_plan
from .speed_error.document import picture, write_document
from .speed_error.pictures import write_comparison
from .speed_error.plan import PRESETS
from .study.case import PHOTOS, Case
from .study.command import run_study
from .study.making import KEPT_RUNS, make, run_folder
from .study.record import Record


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks for; return 1 where a run failed, else 0."""
    return run_study(arguments, __doc__, study_plan(), write_document, make_one, draw_pictures)


def make_one(case: Case, *, threads: int, kept: Path = KEPT_RUNS) -> Record:
    """Make a preset, another mesh of it, or the alpha shape."""
    maker = make_alpha if case.name == ALPHA else make
    return maker(case, threads=threads, kept=kept)


def draw_pictures(out: Path) -> None:
    """Draw the presets of each scene side by side, as far as their runs are kept."""
    for scene in SCENES:
        folders = [(p, run_folder(preset_case(scene, p))) for p in PRESETS]
        kept = [(label, folder) for label, folder in folders if (folder / "mesh").is_dir()]
        if kept:
            truth = ensure_scene(
                scene, photos=PHOTOS.count, width=PHOTOS.width, height=PHOTOS.height
            )
            write_comparison(truth, kept, out / picture(scene))


if __name__ == "__main__":
    raise SystemExit(main())
