# SPDX-License-Identifier: GPL-3.0-or-later
"""Options that become training settings, of ``wrap`` and ``estimate``."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..core.settings import JobSettings

NEEDS = ("harmonics", "exposure", "multi_view", "wrapping", "growth", "full_size")
"""What ``--needs`` decides at once; names of training settings."""

_NEEDS_WORDS = {"auto": "auto", "all": "on", "none": "off"}
_NEEDS_HELP = {
    "harmonics": "colour that depends on the direction",
    "exposure": "gain and offset per photo",
    "multi_view": "terms that compare neighbouring photos",
    "wrapping": "orientation, and clones of opposite orientation",
    "growth": "more Gaussians: as many as pay, up to the cap, or none",
    "full_size": "photos at their full size, also where half shows as much",
}

NUMBERS: tuple[tuple[str, str, type, str, str], ...] = (
    ("--iterations", "iterations", int, "N", "training iterations instead of the preset's"),
    ("--max-gaussians", "max_gaussians", int, "N", "cap instead of the preset's"),
    ("--max-image-px", "max_image_px", int, "N", "training image size instead of the preset's"),
    ("--sh-degree", "sh_degree", int, "0..3", "highest degree of the harmonics"),
    ("--wrap-rounds", "wrap_rounds", int, "N", "rounds of clones; 0 trains orientation alone"),
    (
        "--region-weight",
        "region_weight",
        float,
        "W",
        "Gaussians inside the regions count this many times where their number is limited",
    ),
    ("--holdout", "holdout_every", int, "N", "keep each n-th photo for measuring; 0 keeps none"),
    (
        "--preview-every",
        "preview_every_s",
        float,
        "S",
        "seconds between two preview pictures of the training; 0 writes none",
    ),
)
"""Options that replace one number of the preset: their type, their placeholder, their help."""


def add_training_options(parser: ArgumentParser) -> None:
    """Add preset, seed, threads and everything that changes the training's settings."""
    from ..core.settings import DECISIONS, MASK_MODES, PRESETS

    parser.add_argument("--preset", choices=PRESETS, default="standard")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    for option, name, kind, metavar, text in NUMBERS:
        parser.add_argument(option, dest=name, type=kind, metavar=metavar, help=text)
    parser.add_argument(
        "--needs",
        choices=tuple(_NEEDS_WORDS),
        help="what the photos decide (auto), everything, or nothing of the six options below, "
        "each of which wins over this one",
    )
    for name in NEEDS:
        option = "--" + name.replace("_", "-")
        parser.add_argument(option, choices=DECISIONS, help=_NEEDS_HELP[name])
    parser.add_argument(
        "--mask-mode",
        choices=MASK_MODES,
        help="what masks leave out: anything may stand there, or nothing",
    )
    parser.add_argument(
        "--start-splat",
        type=Path,
        metavar="FILE.ply",
        help="Gaussians that training starts from, instead of the sparse points",
    )


def training_settings(options: Namespace) -> JobSettings:
    """Return the preset's settings with what :func:`add_training_options` was given.

    Ranges are checked where the job is made.
    """
    from ..core.settings import preset

    changes: dict[str, Any] = {}
    if options.needs is not None:
        changes = dict.fromkeys(NEEDS, _NEEDS_WORDS[options.needs])
    single = (*(name for _, name, *_ in NUMBERS), *NEEDS, "mask_mode")
    changes |= {n: value for n in single if (value := getattr(options, n)) is not None}
    settings = preset(options.preset)
    return replace(
        settings,
        seed=options.seed,
        threads=options.threads,
        start_splat="" if options.start_splat is None else str(options.start_splat),
        training=replace(settings.training, **changes),
    )
