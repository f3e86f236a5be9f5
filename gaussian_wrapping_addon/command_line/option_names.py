# SPDX-License-Identifier: GPL-3.0-or-later
"""By which option a setting is given: errors name what was typed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .meshing_options import CHOICES, MESHING, METHOD
from .training_options import NEEDS, NUMBERS

if TYPE_CHECKING:
    from ..core.errors import SettingError

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
    "texture.max_atlases": "--max-atlases",
    "texture.source": "--texture-source",
    "texture.normal_map": "--normal-map",
    "texture.ambient_occlusion": "--ambient-occlusion",
    "texture.lods": "--lods",
    "training.mask_mode": "--mask-mode",
    "training.extra_iterations": "--iterations",
}
"""Options by the setting that they give, besides those of the tables above."""


def option_of(setting: str) -> str:
    """Return the option that gives a setting (its path), ``""`` where there is none."""
    options = {
        **_OTHERS,
        **{f"training.{name}": option for option, name, *_ in NUMBERS},
        **{f"training.{name}": "--" + name.replace("_", "-") for name in NEEDS},
        **{f"meshing.{name}": option for option, name, *_ in MESHING},
        **{f"meshing.{name}": f"--{name}" for name in (*METHOD, *CHOICES)},
    }
    return options.get(setting, "")


def in_words_of_options(error: SettingError) -> SettingError:
    """Return the same error, naming the option where a setting is named."""
    from ..core.errors import SettingError

    return SettingError(error.setting, error.wanted, called=option_of(error.setting))
