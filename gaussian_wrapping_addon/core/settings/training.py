# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of the training."""

from __future__ import annotations

from dataclasses import dataclass

from .checks import Choices, Range
from .choices import MASK_MODES, SELECTION_MODES
from .declaration import Item, Option, PanelProperty, declarations, setting
from .method import MethodSettings

_COUNT = Range(1, 10**6)
_SECONDS = Range(0.0, words="a number of seconds, 0 or more")


def _selection(automatic: str, on: str, off: str) -> tuple[Item, ...]:
    """Return the entries Auto, On and Off with their tooltips."""
    return (Item("auto", "Auto", automatic), Item("on", "On", on), Item("off", "Off", off))


@dataclass(frozen=True)
class TrainingSettings(MethodSettings):
    """How the Gaussians are trained. Milestones are fractions of ``iterations``."""

    iterations: int = setting(
        3000,
        help="Training iterations.",
        check=_COUNT,
        unit="iterations",
        presets={"draft": 1500, "fine": 4000, "paper": 30_000},
        option=Option("--iterations", "N", "training iterations instead of the preset's"),
        panel=PanelProperty(
            "Iterations",
            "Steps of the training; 0 takes the preset's number",
            preset_if_zero=True, soft_high=30_000, step=100,
        ),
    )  # fmt: skip
    extra_iterations: int = setting(
        0,
        help="Iterations added to a finished training, at its last learning rates.",
        check=Range(0, 10**6),
        unit="iterations",
        option=Option("--iterations", "N", "iterations to be added", scope="more"),
    )
    max_gaussians: int = setting(
        80_000,
        help="Largest number of Gaussians.",
        check=Range(100, 20_000_000),
        unit="Gaussians",
        presets={"draft": 40_000, "fine": 120_000, "paper": 6_000_000},
        option=Option("--max-gaussians", "N", "cap of Gaussians instead of the preset's"),
        panel=PanelProperty(
            "Gaussians, Max",
            "Largest number of Gaussians; fewer need less time and memory. "
            "0 takes the preset's number",
            preset_if_zero=True, soft_high=1_000_000, step=1000,
        ),
    )  # fmt: skip
    max_image_px: int = setting(
        640,
        help="Long side of the finest training image.",
        check=Range(32, 16384),
        unit="pixels",
        presets={"draft": 480, "fine": 1024, "paper": 1600},
        option=Option("--max-image-px", "N", "training image size instead of the preset's"),
        panel=PanelProperty(
            "Photo Size, Max",
            "Photos are trained at no more than this length of their long side, in pixels. "
            "0 takes the preset's number",
            preset_if_zero=True, soft_high=4096, step=100, subtype="PIXEL",
        ),
    )  # fmt: skip
    sh_degree: int = setting(
        2,
        help="Highest degree of the spherical harmonics; `harmonics` selects how much of it is "
        "used.",
        check=Range(0, 3),
        presets={"draft": 1, "fine": 3, "paper": 3},
        option=Option("--sh-degree", "0..3", "highest degree of the spherical harmonics"),
    )
    holdout_every: int = setting(
        8,
        help="Every n-th photo, sorted by name, is held out for measuring; 0 holds out none.",
        check=Range(0, 10**6, words="0 or more"),
        unit="photos",
        option=Option("--holdout", "N", "hold out each n-th photo for measuring; 0 holds out none"),
    )
    harmonics: str = setting(
        "auto",
        help="View-dependent colour. auto: only degrees that lower the error of held-out photos; "
        "on: all of them; off: degree 0.",
        presets={"paper": "on"},
        check=Choices(SELECTION_MODES),
        model_selection=True,
        option=Option("--harmonics", help="colour that depends on the direction"),
        panel=PanelProperty(
            "Reflections",
            "Colours that change with the viewing direction: gloss, metal, glass",
            items=_selection(
                "Only as much as lowers the error of held-out photos",
                "As much as the preset allows, whether it helps or not",
                "One colour from all directions; fastest, right for matte surfaces",
            ),
        ),
    )
    exposure: str = setting(
        "auto",
        help="Gain and offset per photo.",
        presets={"paper": "off"},
        check=Choices(SELECTION_MODES),
        model_selection=True,
        option=Option("--exposure", help="gain and offset per photo"),
        panel=PanelProperty(
            "Exposure",
            "Brightness and tint that differ from photo to photo",
            items=_selection(
                "Where the same points differ in brightness from photo to photo",
                "Always learn a brightness and a tint for each photo",
                "All photos were taken with the same settings and light",
            ),
        ),
    )
    multi_view: str = setting(
        "auto",
        help="Loss terms that compare neighbouring photos.",
        presets={"paper": "on"},
        check=Choices(SELECTION_MODES),
        model_selection=True,
        option=Option("--multi-view", help="terms that compare neighbouring photos"),
        panel=PanelProperty(
            "Compare Photos",
            "Check each surface in neighbouring photos while training (multi-view terms)",
            items=_selection(
                "Where photos have neighbours with nearly the same view",
                "Always compare; slower, gives smoother and more accurate surfaces",
                "Never compare; faster",
            ),
        ),
    )
    wrapping: str = setting(
        "auto",
        help="Orientation of the Gaussians, its loss, and clones of opposite orientation.",
        presets={"paper": "on"},
        check=Choices(SELECTION_MODES),
        model_selection=True,
        option=Option("--wrapping", help="orientation, and clones of opposite orientation"),
        panel=PanelProperty(
            "Wrap Thin Parts",
            "Learn orientations, and give thin parts a front and a back",
            items=_selection(
                "Where the normals still show errors, such as on thin parts",
                "Always; thin parts such as wires, spokes and leaves get a front and a back",
                "Never; faster, but thin parts may be lost",
            ),
        ),
    )
    growth: str = setting(
        "auto",
        help="Densification. auto: it stops where more Gaussians gain little, and Gaussians that "
        "contribute little are kept small (`overlap_price`) and pruned (`prune_share`); on: only "
        "the cap stops it; off: none are added.",
        presets={"paper": "on"},
        check=Choices(SELECTION_MODES),
        model_selection=True,
        option=Option(
            "--growth", help="more Gaussians: while they lower the error, up to the cap, or none"
        ),
        panel=PanelProperty(
            "Add Gaussians",
            "Whether more Gaussians are added where detail is missing",
            items=_selection(
                "Add Gaussians while they lower the error",
                "Add Gaussians up to the limit",
                "Keep the number that training starts with",
            ),
        ),
    )
    full_size: str = setting(
        "auto",
        help="Training image size. auto: photos that show nothing finer than half their size are "
        "trained on at half size; on: always full size; off: half size.",
        presets={"paper": "on"},
        check=Choices(SELECTION_MODES),
        model_selection=True,
        option=Option(
            "--full-size", help="photos at their full size, also where half size shows as much"
        ),
        panel=PanelProperty(
            "Full Photo Size",
            "Train on photos at their full size, within the limit below",
            items=_selection(
                "At half size where the photos show nothing finer",
                "Always at full size, even where half size shows as much",
                "Always at half size; faster, with less memory",
            ),
        ),
    )
    dense_start: str = setting(
        "auto",
        help="Initial Gaussians from stereo matching of the photos. auto: where other photos "
        "confirm the depth of enough pixels; off: from the sparse points alone.",
        presets={"paper": "off"},
        check=Choices(SELECTION_MODES),
        model_selection=True,
        option=Option("--dense-start", help="initial Gaussians from stereo matching of the photos"),
        panel=PanelProperty(
            "Dense Start",
            "Match neighbouring photos before training, and start on the surfaces found",
            items=_selection(
                "Where neighbouring photos show the same surfaces",
                "On whatever surfaces matching finds",
                "Start from the sparse points alone",
            ),
        ),
        since="0.2.0",
    )
    refine_poses: str = setting(
        "auto",
        help="Camera poses are refined while training. auto: after a dense start, and kept if the "
        "photos move them clearly; off: poses stay as given.",
        presets={"paper": "off"},
        check=Choices(SELECTION_MODES),
        model_selection=True,
        option=Option("--refine-poses", help="camera poses refined while training"),
        panel=PanelProperty(
            "Refine Cameras",
            "Move each photo's camera by fractions of a pixel to where its photo fits best",
            items=_selection(
                "Where photos show that the given cameras are inexact",
                "Always refine; the frame of all cameras together stays",
                "Take the cameras as they are given",
            ),
        ),
        since="0.2.0",
    )
    region_weight: float = setting(
        1.0,
        help="Gaussians inside the job's regions count this many times where their number is "
        "limited.",
        check=Range(1.0, 1000.0),
        option=Option(
            "--region-weight",
            "W",
            "Gaussians inside the regions count this many times where their number is limited",
        ),
    )
    focus: str = setting(
        "",
        help="JSON list of the job's region bodies, world coordinates. Written when a job that "
        "trains is made with a region weight; other regions are meshed from the same training.",
    )
    mask_mode: str = setting(
        "ignore",
        help="What masks exclude. ignore: these pixels are not trained on, and anything may be "
        "there; background: the space behind them is empty.",
        check=Choices(MASK_MODES),
        option=Option(
            "--mask-mode", help="masked pixels: ignore them, or treat them as empty background"
        ),
        panel=PanelProperty(
            "Masks",
            "Meaning of the masked parts of the photos; no effect without masks",
            items=(
                Item(
                    "ignore",
                    "Ignore",
                    "Masked pixels are not trained on; anything may be there",
                ),
                Item(
                    "background",
                    "Background",
                    "Masked pixels show empty space: only the subject is modelled",
                ),
            ),
        ),
    )
    checkpoint_every_s: float = setting(
        60.0,
        help="Time between two checkpoints.",
        check=_SECONDS,
        unit="seconds",
        affects_result=False,
    )
    preview_every_s: float = setting(
        20.0,
        help="Time between two preview pictures of a running training; 0 writes none.",
        check=_SECONDS,
        unit="seconds",
        affects_result=False,
        option=Option(
            "--preview-every",
            "S",
            "seconds between two preview pictures of the training; 0 writes none",
        ),
    )


MODEL_SELECTION = tuple(d.name for d in declarations(TrainingSettings) if d.model_selection)
"""Settings of the model selection; ``"auto"`` decides from the photos."""
