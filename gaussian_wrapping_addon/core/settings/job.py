# SPDX-License-Identifier: GPL-3.0-or-later
"""All settings of one job, and its presets."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import UsageError
from ..export_formats import JOB_FORMATS
from ..limits import MAX_CHOSEN_FRAMES, MIN_IMAGES
from .checks import Choices, Condition, Range, Subset
from .choices import (
    DEVICE,
    GEOREFERENCES,
    MASKS_MADE,
    MAX_MASK_GROW_PX,
    MODEL_RANGES,
    PANORAMA_MODES,
    PRESETS,
    SWITCH,
    TURNTABLE_MODES,
)
from .declaration import (
    Declaration,
    Item,
    Option,
    PanelProperty,
    declarations,
    setting,
    validate,
    with_values,
)
from .farm import certificates_setting, computers_setting, processes_setting
from .markers import MARKERS_WANTED, are_markers, checked_markers
from .meshing import MeshingSettings
from .texture import TextureSettings
from .training import TrainingSettings


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
        affects_result=False,
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
    computers: str = computers_setting()
    processes: int = processes_setting()
    certificates: str = certificates_setting()
    regions: tuple[str, ...] = setting(
        ("auto",),
        help="What is meshed: auto, all, or the paths of region files (JSON, or .rsbox of "
        "RealityScan).",
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
    equirectangular: str = setting(
        "auto",
        help="Whether photos without cameras are 360 degree panoramas, which are cut into pinhole "
        "views. Auto: where all are exactly twice as wide as high and none says another projection "
        "(XMP GPano).",
        check=Choices(PANORAMA_MODES),
        since="0.2.0",
        option=Option(
            "--equirectangular",
            help="photos without cameras are 360 degree panoramas: cut them into views",
            scope="training",
        ),
        panel=PanelProperty(
            "360° Photos",
            "Photos without cameras are equirectangular panoramas: each is cut into 14 views",
            items=(
                Item("auto", "Auto", "Where all photos are exactly twice as wide as high"),
                Item("on", "On", "All photos are panoramas"),
                Item("off", "Off", "Photos are used as they are"),
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
    georeference: str = setting(
        "auto",
        help="Whether GPS positions in the photos give metres, place on the earth and up. Auto: "
        "where the photos come without cameras and the positions determine these; with cameras "
        "the place is written into sidecars only. On: also with cameras, or the job is refused.",
        check=Choices(GEOREFERENCES),
        option=Option(
            "--georeference",
            help="metres, place and up by the photos' GPS; auto: where it is good",
            scope="training",
        ),
        panel=PanelProperty(
            "Georeference",
            "Metres, place on the earth and up direction from the GPS of the photos",
            items=(
                Item("auto", "Auto", "Photos without cameras, if GPS is good enough"),
                Item("on", "On", "Also photos with cameras; refused if GPS is not good enough"),
                Item("off", "Off", "GPS is not read"),
            ),
            owner="training",
            panel_name="train_advanced",
        ),
        since="0.2.0",
    )
    markers: str = setting(
        "",
        help="Printed ArUco or AprilTag markers in the photos, as dictionary and side of the black "
        "square in metres, such as 4x4_50:0.05: the scene gets metres. Needs OpenCV in the "
        "worker's Python.",
        check=Condition(are_markers, f"empty, or {MARKERS_WANTED}"),
        option=Option(
            "--markers",
            "DICTIONARY:SIZE",
            "printed markers in the photos, such as 4x4_50:0.05, side in metres: gives the scale",
            scope="training",
            parse=checked_markers,
        ),
        panel=PanelProperty(
            "Markers",
            "Printed markers in the photos: dictionary and side in metres, such as 4x4_50:0.05",
            owner="training",
            panel_name="train_advanced",
        ),
        since="0.2.0",
    )
    control_points: str = setting(
        "",
        help="Text file of control points: known places and the pixels that show them. The scene "
        "gets their frame, in metres.",
        option=Option(
            "--control-points",
            "FILE.txt",
            "known places and the pixels that show them: gives scale, place and up",
            scope="training",
            parse=lambda text: str(Path(text)),
        ),
        panel=PanelProperty(
            "Control Points",
            "Text file of known places and the pixels of photos that show them",
            subtype="FILE_PATH",
            owner="training",
            panel_name="train_advanced",
        ),
        since="0.2.0",
    )
    make_masks: str = setting(
        "off",
        help="Masks made for the photos. region: a short training shows which part of each photo "
        "is what stands in the job's region files; all else counts as background.",
        check=Choices(MASKS_MADE),
        option=Option(
            "--make-masks",
            help="region: mask the photos to what stands in the region files (--region)",
            scope="training",
        ),
        since="0.2.0",
    )
    mask_regions: str = setting(
        "",
        help="JSON list of the region bodies that masks are made of, world coordinates. Written "
        "when a job that trains is made with `make_masks`; other regions are meshed from the same "
        "training.",
        since="0.2.0",
    )
    mask_model: str = setting(
        "",
        help="ONNX file of a model that tells an object from its background; masks the photos to "
        "what it finds. Nothing is downloaded. Empty uses none.",
        option=Option(
            "--mask-model",
            "FILE.onnx",
            "segmentation model that masks the photos; needs onnxruntime in the worker",
            scope="training",
            parse=lambda text: str(Path(text)),
        ),
        panel=PanelProperty(
            "Mask Model",
            "ONNX file of a segmentation model, such as U2-Net, IS-Net or BiRefNet: photos are "
            "masked to the object that it finds; empty uses none",
            subtype="FILE_PATH",
            owner="training",
            panel_name="train_advanced",
        ),
        since="0.2.0",
    )
    mask_model_range: str = setting(
        "imagenet",
        help="Colours that the mask model was trained with. imagenet: less the mean of ImageNet, "
        "over its deviation (U2-Net, BiRefNet); half: -0.5 to 0.5 (IS-Net); unit: 0 to 1.",
        check=Choices(MODEL_RANGES),
        option=Option(
            "--mask-model-range",
            help="colours that the mask model wants: imagenet (U2-Net, BiRefNet), half (IS-Net) "
            "or unit",
            scope="training",
        ),
        panel=PanelProperty(
            "Model Colors",
            "Range of colours that the mask model expects; no effect without one",
            items=(
                Item("imagenet", "ImageNet", "Mean and deviation of ImageNet: U2-Net, BiRefNet"),
                Item("half", "-0.5 to 0.5", "Range that IS-Net expects"),
                Item("unit", "0 to 1", "Colours as the photos have them"),
            ),
            owner="training",
            panel_name="train_advanced",
        ),
        since="0.2.0",
    )
    video_frames: int = setting(
        0,
        help="Frames of a video that are used: the sharpest of so many stretches of equal motion, "
        "fewer where a stretch is blurred. 0 chooses 40 to 200 by how far the picture moves.",
        check=Range(MIN_IMAGES, MAX_CHOSEN_FRAMES, zero="by the motion"),
        unit="frames",
        option=Option(
            "--frames",
            help="frames of a video that are used; 0: by its motion",
            scope="training",
            exclusive="video frames",
        ),
        panel=PanelProperty(
            "Frames",
            "Number of frames used, the sharpest ones; 0 chooses by the motion in the video",
            owner="scene",
            panel_name="dataset",
            soft_high=300,
        ),
        since="0.2.0",
    )
    video_fps: float = setting(
        0.0,
        help="Frames of a video that are used for each of its seconds, the sharpest of each "
        "stretch, whatever the motion; 0 chooses by the motion. Applies where no number of frames "
        "is given.",
        check=Range(0.05, 240.0, zero="by the motion"),
        unit="frames per second",
        option=Option(
            "--fps",
            "X",
            help="frames of a video that are used for each of its seconds; 0: by its motion",
            scope="training",
            exclusive="video frames",
        ),
        panel=PanelProperty(
            "Frames per Second",
            "Frames used per second of the video; 0 chooses by the motion",
            owner="scene",
            panel_name="dataset",
            soft_high=10,
            precision=2,
            shown_if=("video_frames", 0),
            default_if_hidden=True,
        ),
        since="0.2.0",
    )
    training: TrainingSettings = field(default_factory=TrainingSettings)
    meshing: MeshingSettings = field(default_factory=MeshingSettings)
    texture: TextureSettings = field(default_factory=TextureSettings)

    @property
    def masks_are_made(self) -> bool:
        """Whether the job makes masks of its own."""
        return self.make_masks != "off" or bool(self.mask_model)

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
