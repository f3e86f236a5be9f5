# SPDX-License-Identifier: GPL-3.0-or-later
"""All settings of one job, and its presets."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import UsageError
from ..export_formats import JOB_FORMATS
from .checks import Choices, Condition, Range, Subset
from .choices import DEVICE, MAX_MASK_GROW_PX, PRESETS, SWITCH, TURNTABLE_MODES
from .declaration import (
    Declaration,
    Item,
    Option,
    PanelProperty,
    declarations,
    setting,
    with_values,
)
from .meshing import MeshingSettings
from .texture import TextureSettings
from .training import TrainingSettings
from .validation import validate


def _formats(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word for word in text.split(",") if word))


def _distinct(words: list[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(words))


@dataclass(frozen=True)
class JobSettings:
    """All settings of one job."""

    preset: str = setting(
        "standard",
        help="Quality against time: sets the numbers of the training that have no value of their "
        "own.",
        check=Choices(PRESETS),
        option=Option("--preset", help="quality against time", scope="training"),
        panel=PanelProperty(
            "Preset",
            "Quality against time",
            items=(
                Item("draft", "Draft", "A first look: small images, few Gaussians"),
                Item("standard", "Standard", "For most scenes"),
                Item(
                    "fine",
                    "Fine",
                    "Larger images and more Gaussians; needs several times as long",
                ),
                Item(
                    "paper",
                    "Paper",
                    "The published settings: 30,000 iterations on whole photos, nothing decided "
                    "automatically; many hours to days on a processor",
                ),
                Item(
                    "large",
                    "Large",
                    "For a GPU: large photos, many Gaussians and iterations; hours on a processor",
                ),
            ),
            panel_name="train",
            expand=True,
        ),
    )
    seed: int = setting(
        0,
        help="Seed of all random numbers.",
        check=Range(0, 2**31 - 1),
        option=Option("--seed", help="seed of all random numbers", scope="training"),
    )
    threads: int = setting(
        0,
        help="Processor threads; 0 uses every core this process may use.",
        check=Range(0, 1024),
        unit="threads",
        option=Option("--threads", help="processor threads; 0 uses every core", scope="training"),
        panel=PanelProperty(
            "Threads",
            "Processor threads for jobs; 0 uses all",
            owner="preferences",
            panel_name="preferences",
        ),
    )
    device: str = setting(
        "auto",
        help="Where jobs compute what has a GPU path. auto: the first NVIDIA GPU where it can be "
        "used, else the processor, with the reason in log and report; cuda or cuda:N (numbered "
        "from 0): that GPU, or the job is refused. A job that was begun on one continues on the "
        "other.",
        check=Condition(
            lambda value: re.fullmatch(DEVICE, value) is not None,
            "auto, cpu, cuda or cuda:N with the number of a GPU",
        ),
        option=Option(
            "--device",
            "auto|cpu|cuda|cuda:N",
            "where to compute; auto: an NVIDIA GPU where one can be used",
            scope="training",
        ),
        panel=PanelProperty(
            "Device",
            "Where jobs compute what can run on a GPU",
            items=(
                Item("auto", "Auto", "An NVIDIA GPU where one can be used, else the processor"),
                Item("cpu", "Processor", "Never a GPU"),
                Item("cuda", "NVIDIA GPU", "The first GPU; jobs that cannot use it are refused"),
            ),
            owner="preferences",
            panel_name="preferences",
        ),
        affects_result=False,
        since="0.2.0",
    )
    regions: tuple[str, ...] = setting(
        ("auto",),
        help="What is meshed: auto, all, or the paths of region files.",
        check=Condition(lambda value: len(value) > 0, "at least one region"),
        option=Option(
            "--region",
            "auto|all|REGION.json",
            "what is meshed (default: auto)",
            scope="region",
            many=True,
            parse=_distinct,
        ),
    )
    export: tuple[str, ...] = setting(
        ("glb",),
        help="File formats that the meshes are written in.",
        check=Subset(JOB_FORMATS),
        option=Option(
            "--export",
            help=f"file formats, comma separated, of {','.join(JOB_FORMATS)}",
            scope="region",
            parse=_formats,
        ),
    )
    start_splat: str = setting(
        "",
        help="PLY of Gaussians that training starts from; empty starts from the sparse points.",
        option=Option(
            "--start-splat",
            "FILE.ply",
            "Gaussians that training starts from, instead of the sparse points",
            scope="training",
            parse=lambda text: str(Path(text)),
        ),
        panel=PanelProperty(
            "Start from Splat",
            "PLY of a Gaussian splat of the same photos and cameras, made here or elsewhere; "
            "empty starts from the points of the cameras",
            subtype="FILE_PATH",
            owner="training",
            panel_name="train_advanced",
        ),
    )
    turntable: str = setting(
        "auto",
        help="Whether the camera stood still while the object turned. The background is then left "
        "out of the search for cameras, and masked. Auto sees it by matches that stay where they "
        "are; of photos without cameras only.",
        check=Choices(TURNTABLE_MODES),
        option=Option(
            "--turntable",
            help="the camera stood still while the object turned: mask what stands still",
            scope="training",
        ),
        panel=PanelProperty(
            "Turntable",
            "The camera stood still while the object turned: the background is left out of the "
            "search for cameras, and masked",
            items=(
                Item("auto", "Auto", "Where the photos show it"),
                Item("on", "On", "All photos of one size are from one place"),
                Item("off", "Off", "Nothing is left out"),
            ),
            owner="training",
            panel_name="train_advanced",
        ),
    )
    mask_invert: str = setting(
        "off",
        help="Masks are white where photos are left out.",
        check=Choices(SWITCH),
        option=Option(
            "--mask-invert",
            help="masks are white where photos are left out",
            flag="on",
            scope="training",
        ),
        panel=PanelProperty(
            "Invert Masks",
            "Mask files are white where the photos are left out",
            owner="training",
            panel_name="train_advanced",
        ),
    )
    mask_grow_px: int = setting(
        0,
        help="Border that is kept around what masks keep, or taken away where negative, in pixels "
        "of the photos.",
        check=Range(-MAX_MASK_GROW_PX, MAX_MASK_GROW_PX),
        unit="pixels",
        option=Option(
            "--mask-grow",
            help="pixels by which what masks keep grows, or shrinks where negative",
            scope="training",
        ),
        panel=PanelProperty(
            "Grow Masks",
            "Pixels by which what the mask files keep grows; negative shrinks it",
            owner="training",
            panel_name="train_advanced",
        ),
    )
    training: TrainingSettings = field(default_factory=TrainingSettings)
    meshing: MeshingSettings = field(default_factory=MeshingSettings)
    texture: TextureSettings = field(default_factory=TextureSettings)

    def validated(self) -> JobSettings:
        """Return self, or raise :class:`~..errors.SettingError` naming the first bad setting."""
        validate(self)
        return self


def preset(name: str, **overrides: Any) -> JobSettings:
    """Return the settings of ``"draft"``, ``"standard"``, ``"fine"``, ``"paper"`` or ``"large"``.

    Raises
    ------
    UsageError
        There is no such preset.
    """
    if name not in PRESETS:
        raise UsageError(f"There is no preset {name!r}.", f"Choose one of {', '.join(PRESETS)}.")
    own = {d.path: d.presets[name] for d in declarations(JobSettings) if name in d.presets}
    return with_values(JobSettings(preset=name, **overrides), own)


def declared(path: str) -> Declaration:
    """Return the declaration of a setting by its path, such as ``"training.iterations"``.

    Raises
    ------
    KeyError
        There is no such setting.
    """
    return {entry.path: entry for entry in declarations(JobSettings)}[path]
