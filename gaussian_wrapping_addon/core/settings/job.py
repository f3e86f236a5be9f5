# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of a job, and how stored ones are read."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ..errors import ParseError, UsageError
from ..files import read_json, write_json
from ..limits import MAX_CHOSEN_FRAMES, MIN_IMAGES
from ..names import JOB_FORMATS
from .declaration import (
    COMPUTERS,
    DEVICE,
    MASKS_MADE,
    MAX_MASK_GROW_PX,
    MAX_PROCESSES,
    MODEL_RANGES,
    PRESETS,
    SELECTION_MODES,
    SWITCH,
    Choices,
    Condition,
    Declaration,
    Item,
    Option,
    PanelProperty,
    Range,
    Subset,
    auto_on_off,
    declarations,
    has_kind,
    setting,
    validate,
    with_values,
)
from .meshing import MeshingSettings
from .texture import TextureSettings
from .training import TrainingSettings

# -- Settings of a job's engine: on which processes and computers its parts run -------------------


LOCAL = "local"  # a cluster of this computer, made for a job and gone with it


# -- Printed markers as a setting: dictionary and side, such as ``4x4_50:0.05`` -------------------


MARKER_DICTIONARIES = (
    "4x4_50", "4x4_100", "4x4_250", "4x4_1000", "5x5_50", "5x5_100", "5x5_250", "5x5_1000",
    "6x6_50", "6x6_100", "6x6_250", "6x6_1000", "7x7_50", "7x7_100", "7x7_250", "7x7_1000",
    "aruco_original", "aruco_mip_36h12",
    "apriltag_16h5", "apriltag_25h9", "apriltag_36h10", "apriltag_36h11",
)  # fmt: skip
"""Names of marker dictionaries: OpenCV's without ``DICT_``, in small letters."""
MAX_SIDE_M = 1000.0
MARKERS_WANTED = "DICTIONARY:SIZE, such as 4x4_50:0.05, the size in metres"


@dataclass(frozen=True)
class MarkerSpec:
    """Which markers were printed."""

    dictionary: str  # a name of :data:`MARKER_DICTIONARIES`
    side_m: float  # side of the black square, metres


def marker_spec(text: str) -> MarkerSpec | None:
    """Read the setting; None of an empty text.

    Raises
    ------
    UsageError
        The dictionary is unknown, or the size is no length greater than 0.
    """
    if not text:
        return None
    name, colon, size = text.strip().rpartition(":")
    if not colon:
        raise UsageError(f"Markers {text!r} have no size.", f"Give {MARKERS_WANTED}.")
    dictionary = name.strip().lower().removeprefix("dict_")
    if dictionary not in MARKER_DICTIONARIES:
        raise UsageError(
            f"There is no marker dictionary {name!r}.",
            f"Use one of {', '.join(MARKER_DICTIONARIES)}.",
        )
    try:
        side = float(size)
    except ValueError:
        side = math.nan
    if not 0.0 < side <= MAX_SIDE_M:
        raise UsageError(
            f"The marker size {size.strip()!r} is not a length of up to {MAX_SIDE_M:g} m.",
            "Give the side of the black square in metres, such as 0.05.",
        )
    return MarkerSpec(dictionary, side)


def checked_markers(text: str) -> str:
    """Return the option as it is kept, or raise as :func:`marker_spec` does."""
    spec = marker_spec(text)
    return "" if spec is None else f"{spec.dictionary}:{spec.side_m!r}"


def are_markers(text: str) -> bool:
    """Tell whether :func:`marker_spec` reads a text."""
    try:
        marker_spec(text)
    except UsageError:
        return False
    return True


# -- All settings of one job, and its presets -----------------------------------------------------


def _distinct(words: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(words))


def _path(text: str) -> str:
    return str(Path(text))


# Packed, as a survey of all settings needs few lines.
# fmt: off
@dataclass(frozen=True)
class JobSettings:
    """All settings of one job."""

    preset: str = setting(
        "standard",
        help="Quality against time: sets the numbers of the training that have no value of their "
        "own.",
        check=Choices(PRESETS),
        option=Option("--preset", help="quality against time", own=True),
        panel=PanelProperty(
            "Preset", "Quality against time",
            items=(
                Item("draft", "Draft", "A first look: small images, few Gaussians"),
                Item("standard", "Standard", "For most scenes"),
                Item(
                    "fine", "Fine", "Larger images and more Gaussians; needs several times as long",
                ),
                Item(
                    "paper", "Paper",
                    "The published settings: 30,000 iterations on whole photos, nothing decided "
                    "automatically; many hours to days on a processor",
                ),
                Item(
                    "large", "Large",
                    "For a GPU: large photos, many Gaussians and iterations; hours on a processor",
                ),
            ),
            owner="scene", panel_name="train", expand=True,
        ),
    )
    seed: int = setting(
        0, help="Seed of all random numbers.", check=Range(0, 2**31 - 1),
        option=Option("--seed", help="seed of all random numbers", own=True),
    )
    threads: int = setting(
        0, help="Processor threads; 0 uses every core this process may use.", check=Range(0, 1024),
        unit="threads",
        option=Option("--threads", help="processor threads; 0 uses every core", own=True),
        panel=PanelProperty(
            "Threads", "Processor threads for jobs; 0 uses all", owner="preferences",
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
            "--device", "auto|cpu|cuda|cuda:N",
            "where to compute; auto: an NVIDIA GPU where one can be used", own=True,
        ),
        panel=PanelProperty(
            "Device", "Where jobs compute what can run on a GPU",
            items=(
                Item("auto", "Auto", "An NVIDIA GPU where one can be used, else the processor"),
                Item("cpu", "Processor", "Never a GPU"),
                Item("cuda", "NVIDIA GPU", "The first GPU; jobs that cannot use it are refused"),
            ),
            owner="preferences", panel_name="preferences",
        ),
        affects_result=False, since="0.2.0",
    )
    computers: str = setting(
        "",
        help="What runs the parts of a job. Empty: this process, one after another; local: several "
        "processes of this computer; tls://HOST:PORT: the computers of a Dask scheduler.",
        check=Condition(
            lambda value: re.fullmatch(COMPUTERS, value) is not None, "local or tls://HOST:PORT",
        ),
        option=Option(
            "--computers", "local|tls://HOST:PORT",
            "run parts side by side: in processes of this computer, or at a Dask scheduler's",
            scope="region", own=True,
        ),
        affects_result=False, since="0.2.0",
    )
    processes: int = setting(
        2, help="Parts that run side by side on this computer.", check=Range(1, MAX_PROCESSES),
        unit="processes",
        option=Option(
            "--processes", help="parts side by side with --computers local", scope="region",
            own=True,
        ),
        panel=PanelProperty(
            "Processes",
            "Parts of a job that run side by side on this computer, each with its own memory",
            default=1, owner="scene", panel_name="computers", soft_high=8,
        ),
        affects_result=False, since="0.2.0",
    )
    certificates: str = setting(
        "",
        help="Folder of the certificates for tls:// addresses; empty: the one that the environment "
        "variable GW_CERTIFICATES names.",
        option=Option(
            "--certificates", "DIR", "certificates for tls:// addresses", scope="region",
            parse=_path, own=True,
        ),
        affects_result=False, since="0.2.0",
    )
    regions: tuple[str, ...] = setting(
        ("auto",),
        help="What is meshed: auto, all, or the paths of region files (JSON, or .rsbox of "
        "RealityScan).",
        check=Condition(lambda value: len(value) > 0, "at least one region"),
        option=Option(
            "--region", "auto|all|REGION.json", "what is meshed (default: auto)", scope="region",
            many=True, parse=_distinct, own=True,
        ),
    )
    export: tuple[str, ...] = setting(
        ("glb",), help="File formats that the meshes are written in.", check=Subset(JOB_FORMATS),
        option=Option(
            "--export", help=f"file formats, comma separated, of {','.join(JOB_FORMATS)}",
            scope="region", parse=lambda text: _distinct(filter(None, text.split(","))), own=True,
        ),
    )
    start_splat: str = setting(
        "", help="PLY of Gaussians that training starts from; empty starts from the sparse points.",
        option=Option(
            "--start-splat", "FILE.ply",
            "Gaussians that training starts from, instead of the sparse points", parse=_path,
        ),
        panel=PanelProperty(
            "Start from Splat",
            "PLY of a Gaussian splat of the same photos and cameras, made here or elsewhere; "
            "empty starts from the points of the cameras",
            subtype="FILE_PATH",
        ),
    )
    turntable: str = setting(
        "auto",
        help="Whether the camera stood still while the object turned. The background is then left "
        "out of the search for cameras, and masked. Auto sees it by matches that stay where they "
        "are; of photos without cameras only.",
        check=Choices(SELECTION_MODES),
        option=Option(
            "--turntable",
            help="the camera stood still while the object turned: mask what stands still", own=True,
        ),
        panel=PanelProperty(
            "Turntable",
            "The camera stood still while the object turned: the background is left out of the "
            "search for cameras, and masked",
            items=auto_on_off(
                "Where the photos show it", "All photos of one size are from one place",
                "Nothing is left out",
            ),
        ),
    )
    equirectangular: str = setting(
        "auto",
        help="Whether photos without cameras are 360 degree panoramas, which are cut into pinhole "
        "views. Auto: where all are exactly twice as wide as high and none says another projection "
        "(XMP GPano).",
        check=Choices(SELECTION_MODES), since="0.2.0",
        option=Option(
            "--equirectangular",
            help="photos without cameras are 360 degree panoramas: cut them into views",
        ),
        panel=PanelProperty(
            "360° Photos",
            "Photos without cameras are equirectangular panoramas: each is cut into 14 views",
            items=auto_on_off(
                "Where all photos are exactly twice as wide as high", "All photos are panoramas",
                "Photos are used as they are",
            ),
        ),
    )
    mask_invert: str = setting(
        "off", help="Masks are white where photos are left out.", check=Choices(SWITCH),
        option=Option("--mask-invert", help="masks are white where photos are left out", flag="on"),
        panel=PanelProperty("Invert Masks", "Mask files are white where the photos are left out"),
    )
    mask_grow_px: int = setting(
        0,
        help="Border that is kept around what masks keep, or taken away where negative, in pixels "
        "of the photos.",
        check=Range(-MAX_MASK_GROW_PX, MAX_MASK_GROW_PX), unit="pixels",
        option=Option(
            "--mask-grow", help="pixels by which what masks keep grows, or shrinks where negative",
        ),
        panel=PanelProperty(
            "Grow Masks", "Pixels by which what the mask files keep grows; negative shrinks it",
        ),
    )
    georeference: str = setting(
        "auto",
        help="Whether GPS positions in the photos give metres, place on the earth and up. Auto: "
        "where the photos come without cameras and the positions determine these; with cameras "
        "the place is written into sidecars only. On: also with cameras, or the job is refused.",
        check=Choices(SELECTION_MODES),
        option=Option(
            "--georeference",
            help="metres, place and up by the photos' GPS; auto: where it is good",
        ),
        panel=PanelProperty(
            "Georeference",
            "Metres, place on the earth and up direction from the GPS of the photos",
            items=auto_on_off(
                "Photos without cameras, if GPS is good enough",
                "Also photos with cameras; refused if GPS is not good enough", "GPS is not read",
            ),
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
            "--markers", "DICTIONARY:SIZE",
            "printed markers in the photos, such as 4x4_50:0.05, side in metres: gives the scale",
            parse=checked_markers, own=True,
        ),
        panel=PanelProperty(
            "Markers",
            "Printed markers in the photos: dictionary and side in metres, such as 4x4_50:0.05",
        ),
        since="0.2.0",
    )
    control_points: str = setting(
        "",
        help="Text file of control points: known places and the pixels that show them. The scene "
        "gets their frame, in metres.",
        option=Option(
            "--control-points", "FILE.txt",
            "known places and the pixels that show them: gives scale, place and up", parse=_path,
            own=True,
        ),
        panel=PanelProperty(
            "Control Points", "Text file of known places and the pixels of photos that show them",
            subtype="FILE_PATH",
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
            help="region: mask the photos to what stands in the region files (--region)", own=True,
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
            "--mask-model", "FILE.onnx",
            "segmentation model that masks the photos; needs onnxruntime in the worker",
            parse=_path,
        ),
        panel=PanelProperty(
            "Mask Model",
            "ONNX file of a segmentation model, such as U2-Net, IS-Net or BiRefNet: photos are "
            "masked to the object that it finds; empty uses none",
            subtype="FILE_PATH",
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
        ),
        panel=PanelProperty(
            "Model Colors", "Range of colours that the mask model expects; no effect without one",
            items=(
                Item("imagenet", "ImageNet", "Mean and deviation of ImageNet: U2-Net, BiRefNet"),
                Item("half", "-0.5 to 0.5", "Range that IS-Net expects"),
                Item("unit", "0 to 1", "Colours as the photos have them"),
            ),
        ),
        since="0.2.0",
    )
    video_frames: int = setting(
        0,
        help="Frames of a video that are used: the sharpest of so many stretches of equal motion, "
        "fewer where a stretch is blurred. 0 chooses 40 to 200 by how far the picture moves.",
        check=Range(MIN_IMAGES, MAX_CHOSEN_FRAMES, zero="by the motion"), unit="frames",
        option=Option(
            "--frames", help="frames of a video that are used; 0: by its motion",
            exclusive="video frames", own=True,
        ),
        panel=PanelProperty(
            "Frames",
            "Number of frames used, the sharpest ones; 0 chooses by the motion in the video",
            owner="scene", panel_name="dataset", soft_high=300,
        ),
        since="0.2.0",
    )
    video_fps: float = setting(
        0.0,
        help="Frames of a video that are used for each of its seconds, the sharpest of each "
        "stretch, whatever the motion; 0 chooses by the motion. Applies where no number of frames "
        "is given.",
        check=Range(0.05, 240.0, zero="by the motion"), unit="frames per second",
        option=Option(
            "--fps", "X",
            help="frames of a video that are used for each of its seconds; 0: by its motion",
            exclusive="video frames", own=True,
        ),
        panel=PanelProperty(
            "Frames per Second", "Frames used per second of the video; 0 chooses by the motion",
            owner="scene", panel_name="dataset", soft_high=10, precision=2,
            shown_if=("video_frames", 0), default_if_hidden=True,
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
        """Return self, or raise :class:`~.errors.SettingError` naming the first bad setting."""
        validate(self)
        return self


# fmt: on
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


# -- Settings that a user saves under a name, as JSON (docs/file-formats.md) ----------------------
#
# Values are by path and in the words of the settings, so that they outlive changes of the panel.
# A file of another version is used as far as it goes: what is unknown or out of range is named
# and left out.


FORMAT: Final = "GaussianWrappingSettings"
VERSION: Final = 1
MAX_BYTES: Final = 64 * 1024
"""A file with every setting has about 2 kB."""
MAX_NOTES: Final = 5  # Of a file that holds something else; the others are counted.
_SHOWN_NAME: Final = 40  # characters of an unknown entry that a note shows


@dataclass(frozen=True)
class SavedSettings:
    """Contents of a file of saved settings."""

    values: dict[str, Any]  # By path; 0 leaves a number to the preset.
    panel: dict[str, Any]
    """Choices of the panel that are no settings of a job, by property, not validated."""
    notes: tuple[str, ...]  # what was left out, a sentence each


def savable_settings() -> list[Declaration]:
    """Return the settings that are saved: those of a panel, without paths and the machine's."""
    return [
        declared
        for declared in declarations(JobSettings)
        if declared.panel is not None
        and declared.property_owner != "preferences"
        and declared.panel_name != "computers"
        and not (declared.kind is str and not declared.choices)
    ]


def write_saved_settings(path: Path, values: Mapping[str, Any], panel: Mapping[str, Any]) -> None:
    """Write saved settings atomically; the parameters are as in :class:`SavedSettings`."""
    write_json(
        path,
        {"format": FORMAT, "version": VERSION, "settings": dict(values), "panel": dict(panel)},
    )


def read_saved_settings(path: Path) -> SavedSettings:
    """Read saved settings.

    Raises
    ------
    ParseError
        The file holds something else; names the entry and what to do.
    OSError
        It cannot be read.
    """
    hint = "Delete this preset, and save it again."
    stored = read_json(path, most_bytes=MAX_BYTES)
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        raise ParseError(path, "format", f"is not {FORMAT!r}.", hint)
    if type(stored.get("version")) is not int or stored["version"] != VERSION:
        raise ParseError(path, "version", f"is not {VERSION}.", hint)
    settings, panel = stored.get("settings"), stored.get("panel", {})
    for name, part in (("settings", settings), ("panel", panel)):
        if not isinstance(part, dict):
            raise ParseError(path, name, "is not an object.", hint)
    assert isinstance(settings, dict)
    assert isinstance(panel, dict)
    known = {declared.path: declared for declared in savable_settings()}
    values, notes = {}, []
    for name, value in settings.items():
        declared = known.get(name)
        if declared is None:
            notes.append(f"{name[:_SHOWN_NAME]!r} is no setting of this version.")
        elif not _is_valid(declared, value):
            notes.append(f"{name} is out of range, and stays as it is.")
        elif isinstance(declared.check, Choices) and value in declared.check.earlier:
            values[name] = declared.default
        else:
            values[name] = float(value) if declared.kind is float else value
    if len(notes) > MAX_NOTES:
        notes[MAX_NOTES:] = [f"{len(notes) - MAX_NOTES} more entries were left out."]
    return SavedSettings(values, panel, tuple(notes))


def _is_valid(declared: Declaration, value: Any) -> bool:
    if not has_kind(declared.kind, value):
        return False
    if declared.panel is not None and declared.panel.preset_if_zero and value == 0:
        return True
    return declared.check is None or declared.check.holds(value)
