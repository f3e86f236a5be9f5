# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of the command line that become settings, and by which of them a setting is given."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .core.errors import SettingError
    from .core.settings import JobSettings

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

# Options that replace one number of the preset: their type, their placeholder, their help.
_NUMBERS: tuple[tuple[str, str, type, str, str], ...] = (
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


def add_training_options(parser: ArgumentParser) -> None:
    """Add preset, seed, threads and everything that changes the training's settings."""
    from .core.settings import DECISIONS, MASK_MODES, PRESETS

    parser.add_argument("--preset", choices=PRESETS, default="standard")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    for option, name, kind, metavar, text in _NUMBERS:
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


# Options of ``wrap`` and ``mesh`` that name one number of the meshing.
_MESHING: tuple[tuple[str, str, type, str, str], ...] = (
    ("--faces", "target_faces", int, "N", "decimate the mesh to N faces; 0 leaves all"),
    ("--smooth", "smooth_steps", int, "N", "steps of smoothing that keeps the volume; 0 for none"),
    (
        "--min-part",
        "min_component_share",
        float,
        "SHARE",
        "remove parts of less area than this share of the largest, but no long ones; 0 for none",
    ),
)


# Options of meshing that choose one word or number: their help.
_METHOD = {
    "method": "primal adaptive meshing, or marching tetrahedra on the Gaussians' pivots",
    "pivots": "of each Gaussian, with --method pivots (default: 2)",
    "spacing": "of the mesh's vertices (default: adaptive)",
}
_CHOICES = {
    "boundary": "of the region where it cuts a solid: faces close it there, or it stays open",
    "unseen": "what stands where no camera looks: nothing, or something",
}


def add_method_options(parser: ArgumentParser) -> None:
    """Add how a mesh is made, and how finely."""
    from .core.settings import MESH_METHODS, PIVOT_COUNTS, SPACINGS

    size = parser.add_mutually_exclusive_group()
    size.add_argument("--edge-length", type=float, metavar="X", help="world units of the input")
    size.add_argument("--points", type=int, metavar="N", help="number of surface points")
    of_option = zip(_METHOD, (MESH_METHODS, PIVOT_COUNTS, SPACINGS), strict=True)
    for name, choices in of_option:
        parser.add_argument(f"--{name}", type=type(choices[0]), choices=choices, help=_METHOD[name])
    parser.add_argument(
        "--tiles",
        metavar="auto|off|N",
        help="parts that a large region is meshed in, so that memory stays bounded (default: auto)",
    )


def add_boundary_options(parser: ArgumentParser) -> None:
    """Add of which field a mesh is made, and how it ends at the region's boundary."""
    from .core.settings import BOUNDARIES, UNSEEN, MeshingSettings

    for name, choices in zip(_CHOICES, (BOUNDARIES, UNSEEN), strict=True):
        default = getattr(MeshingSettings(), name)
        parser.add_argument(f"--{name}", choices=choices, default=default, help=_CHOICES[name])


def method_settings(options: Namespace) -> dict[str, Any]:
    """Return the meshing settings that :func:`add_method_options` was given.

    What was not given has its default, not that of an earlier mesh.

    Raises
    ------
    UsageError
        An option is given that the method does not heed.
    """
    from .core.errors import UsageError
    from .core.settings import MeshingSettings

    default = MeshingSettings()
    names = (*_METHOD, "edge_length", "points", "tiles")
    given = {name: value for name in names if (value := getattr(options, name)) is not None}
    method = given.get("method", default.method)
    if method == "pivots":
        # An edge length or number of 0 asks for none, and these words for what pivots do anyway.
        idle = {"edge_length": (0.0,), "points": (0,), "tiles": ("auto", "off")}
        for name in ("edge_length", "points", "spacing", "tiles"):
            if name in given and given[name] not in idle.get(name, ()):
                option = "--" + name.replace("_", "-")
                raise UsageError(
                    f"{option} {given[name]} does not go with --method pivots, which is as fine "
                    "as the Gaussians lie and makes the mesh whole.",
                    f"Leave one of the two out; --method pam heeds {option}.",
                )
    elif "pivots" in given:
        raise UsageError(
            f"--pivots {given['pivots']} does not go with --method {method}.",
            "Add --method pivots, or leave --pivots out.",
        )
    return {name: given.get(name, getattr(default, name)) for name in names}


def boundary_settings(options: Namespace) -> dict[str, Any]:
    """Return the meshing settings that :func:`add_boundary_options` was given."""
    return {name: getattr(options, name) for name in _CHOICES}


def add_clean_up_options(parser: ArgumentParser) -> None:
    """Add what happens to a mesh after it was made."""
    for option, name, kind, metavar, text in _MESHING:
        parser.add_argument(option, dest=name, type=kind, metavar=metavar, help=text)


def clean_up_settings(options: Namespace) -> dict[str, Any]:
    """Return the meshing settings that :func:`add_clean_up_options` was given.

    What was not given has its default, not that of an earlier mesh, as the edge length has.
    """
    from .core.settings import MeshingSettings

    default = MeshingSettings()
    given = {name: getattr(options, name) for _, name, *_ in _MESHING}
    return {n: getattr(default, n) if value is None else value for n, value in given.items()}


def training_settings(options: Namespace) -> JobSettings:
    """Return the preset's settings with what :func:`add_training_options` was given.

    Ranges are checked where the job is made.
    """
    from .core.settings import preset

    changes: dict[str, Any] = {}
    if options.needs is not None:
        changes = dict.fromkeys(NEEDS, _NEEDS_WORDS[options.needs])
    single = (*(name for _, name, *_ in _NUMBERS), *NEEDS, "mask_mode")
    changes |= {n: value for n in single if (value := getattr(options, n)) is not None}
    settings = preset(options.preset)
    return replace(
        settings,
        seed=options.seed,
        threads=options.threads,
        start_splat="" if options.start_splat is None else str(options.start_splat),
        training=replace(settings.training, **changes),
    )


_OTHERS = {
    "preset": "--preset",
    "seed": "--seed",
    "threads": "--threads",
    "regions": "--region",
    "export": "--export",
    "meshing.edge_length": "--edge-length",
    "meshing.points": "--points",
    "meshing.tiles": "--tiles",
    "texture.size_px": "--texture-size",
    "training.mask_mode": "--mask-mode",
    "training.extra_iterations": "--iterations",
}
"""Options by the setting that they give, besides those of the tables above."""


def option_of(setting: str) -> str:
    """Return the option that gives a setting (its path), ``""`` where there is none."""
    options = {
        **_OTHERS,
        **{f"training.{name}": option for option, name, *_ in _NUMBERS},
        **{f"training.{name}": "--" + name.replace("_", "-") for name in NEEDS},
        **{f"meshing.{name}": option for option, name, *_ in _MESHING},
        **{f"meshing.{name}": f"--{name}" for name in (*_METHOD, *_CHOICES)},
    }
    return options.get(setting, "")


def in_words_of_options(error: SettingError) -> SettingError:
    """Return the same error, naming the option where a setting is named."""
    from .core.errors import SettingError

    return SettingError(error.setting, error.wanted, called=option_of(error.setting))
