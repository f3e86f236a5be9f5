# SPDX-License-Identifier: GPL-3.0-or-later
"""Training options of ``wrap`` and ``estimate``."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from ...core.settings import MODEL_SELECTION, JobSettings, declarations, preset, with_values
from .setting_options import add_options, given_settings, option_of
from .user_preset import add_user_preset, saved_values

_SELECTION_VALUES = {"auto": "auto", "all": "on", "none": "off"}
"""Values of ``--needs`` and the model selection that they set."""


def add_training_options(parser: ArgumentParser) -> None:
    """Add preset, seed, threads, device and all options of the training."""
    add_options(parser, "training")
    add_user_preset(parser)
    names = ", ".join(option_of(f"training.{name}") for name in MODEL_SELECTION)
    parser.add_argument(
        "--needs",
        choices=tuple(_SELECTION_VALUES),
        help=f"model selection: sets {names}, each of which overrides this option; "
        "auto: selected from the photos; all: on; none: off",
    )
    constants = parser.add_argument_group(
        "constants of the method",
        "weights, schedule and limits of the training, a share where no unit is named; --preset "
        "paper sets all of them to the published values",
    )
    add_options(constants, "constants")


def training_settings(options: Namespace) -> JobSettings:
    """Return settings: the preset's, a user's preset, the options of :func:`add_training_options`.

    Ranges are checked when the job is made.
    """
    values = given_settings(options, "training") | given_settings(options, "constants")
    saved = saved_values(options, values.get("preset"))
    if options.needs is not None:
        word = _SELECTION_VALUES[options.needs]
        selected = {
            declared.path: word
            for declared in declarations(JobSettings)
            if declared.model_selection and word in declared.choices
        }
        values = {**selected, **values}
    values = {**saved, **values}
    chosen = preset(values.pop("preset", JobSettings().preset))
    return with_values(chosen, values)
