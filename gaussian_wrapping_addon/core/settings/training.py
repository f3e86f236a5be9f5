# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of the training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..limits import MAX_BLOCKS
from .checks import Choices, Range
from .choices import MASK_MODES, SELECTION_MODES
from .declaration import Item, Option, PanelProperty, declarations, setting
from .method import MethodSettings

_COUNT = Range(1, 10**6)
_SECONDS = Range(0.0, words="a number of seconds, 0 or more")


def _model_selection(
    *,
    help: str,
    paper: str,
    option: Option,
    label: str,
    tooltip: str,
    auto: str,
    on: str,
    off: str,
    since: str = "",
) -> Any:
    """Declare whether a part of the model is used: ``"auto"``, ``"on"`` or ``"off"``.

    Parameters
    ----------
    paper : str
        Value in the preset of that name.
    label, tooltip : str
        Of the property in the panel; `auto`, `on` and `off` are the tooltips of its entries.
    """
    items = (Item("auto", "Auto", auto), Item("on", "On", on), Item("off", "Off", off))
    return setting(
        "auto",
        help=help,
        check=Choices(SELECTION_MODES),
        presets={"paper": paper},
        option=option,
        panel=PanelProperty(label, tooltip, items=items),
        model_selection=True,
        since=since,
    )


@dataclass(frozen=True)
class TrainingSettings(MethodSettings):
    """How the Gaussians are trained. Milestones are fractions of ``iterations``."""

    iterations: int = setting(
        3000,
        help="Training iterations.",
        check=_COUNT,
        unit="iterations",
        presets={"draft": 800, "fine": 4000, "paper": 30_000, "large": 7000},
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
        presets={"draft": 40_000, "fine": 120_000, "paper": 6_000_000, "large": 300_000},
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
        presets={"draft": 480, "fine": 1024, "paper": 1600, "large": 1600},
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
        presets={"draft": 1, "fine": 3, "paper": 3, "large": 3},
        option=Option("--sh-degree", "0..3", "highest degree of the spherical harmonics"),
    )
    holdout_every: int = setting(
        8,
        help="Every n-th photo, sorted by name, is held out for measuring; 0 holds out none.",
        check=Range(0, 10**6, words="0 or more"),
        unit="photos",
        option=Option("--holdout", "N", "hold out each n-th photo for measuring; 0 holds out none"),
    )
    harmonics: str = _model_selection(
        help="View-dependent colour. auto: only degrees that lower the error of held-out photos; "
        "on: all of them; off: degree 0.",
        paper="on",
        option=Option("--harmonics", help="colour that depends on the direction"),
        label="Reflections",
        tooltip="Colours that change with the viewing direction: gloss, metal, glass",
        auto="Only as much as lowers the error of held-out photos",
        on="As much as the preset allows, whether it helps or not",
        off="One colour from all directions; fastest, right for matte surfaces",
    )
    exposure: str = _model_selection(
        help="Gain and offset per photo.",
        paper="off",
        option=Option("--exposure", help="gain and offset per photo"),
        label="Exposure",
        tooltip="Brightness and tint that differ from photo to photo",
        auto="Where the same points differ in brightness from photo to photo",
        on="Always learn a brightness and a tint for each photo",
        off="All photos were taken with the same settings and light",
    )
    multi_view: str = _model_selection(
        help="Loss terms that compare neighbouring photos.",
        paper="on",
        option=Option("--multi-view", help="terms that compare neighbouring photos"),
        label="Compare Photos",
        tooltip="Check each surface in neighbouring photos while training (multi-view terms)",
        auto="Where photos have neighbours with nearly the same view",
        on="Always compare; slower, gives smoother and more accurate surfaces",
        off="Never compare; faster",
    )
    wrapping: str = _model_selection(
        help="Orientation of the Gaussians, its loss, and clones of opposite orientation.",
        paper="on",
        option=Option("--wrapping", help="orientation, and clones of opposite orientation"),
        label="Wrap Thin Parts",
        tooltip="Learn orientations, and give thin parts a front and a back",
        auto="Where the normals still show errors, such as on thin parts",
        on="Always; thin parts such as wires, spokes and leaves get a front and a back",
        off="Never; faster, but thin parts may be lost",
    )
    growth: str = _model_selection(
        help="Densification. auto: it stops where more Gaussians gain little, and Gaussians that "
        "contribute little are kept small (`overlap_price`) and pruned (`prune_share`); on: only "
        "the cap stops it; off: none are added.",
        paper="on",
        option=Option(
            "--growth", help="more Gaussians: while they lower the error, up to the cap, or none"
        ),
        label="Add Gaussians",
        tooltip="Whether more Gaussians are added where detail is missing",
        auto="Add Gaussians while they lower the error",
        on="Add Gaussians up to the limit",
        off="Keep the number that training starts with",
    )
    full_size: str = _model_selection(
        help="Training image size. auto: photos that show nothing finer than half their size are "
        "trained on at half size; on: always full size; off: half size.",
        paper="on",
        option=Option(
            "--full-size", help="photos at their full size, also where half size shows as much"
        ),
        label="Full Photo Size",
        tooltip="Train on photos at their full size, within the limit below",
        auto="At half size where the photos show nothing finer",
        on="Always at full size, even where half size shows as much",
        off="Always at half size; faster, with less memory",
    )
    dense_start: str = _model_selection(
        help="Initial Gaussians from stereo matching of the photos. auto: where other photos "
        "confirm the depth of enough pixels; off: from the sparse points alone.",
        paper="off",
        option=Option("--dense-start", help="initial Gaussians from stereo matching of the photos"),
        label="Dense Start",
        tooltip="Match neighbouring photos before training, and start on the surfaces found",
        auto="Where neighbouring photos show the same surfaces",
        on="On whatever surfaces matching finds",
        off="Start from the sparse points alone",
        since="0.2.0",
    )
    match_px: int = setting(
        640,
        help="Longest side of photos when they are matched for a dense start; larger ones are "
        "halved until they fit.",
        check=Range(32, 4096),
        unit="pixels",
        presets={"draft": 320},
        option=Option("--match-px", "N", "photo size when photos are matched for a dense start"),
        since="0.2.0",
    )
    refine_poses: str = _model_selection(
        help="Camera poses are refined while training. auto: after a dense start, and kept if the "
        "photos move them clearly; off: poses stay as given.",
        paper="off",
        option=Option("--refine-poses", help="camera poses refined while training"),
        label="Refine Cameras",
        tooltip="Move each photo's camera by fractions of a pixel to where its photo fits best",
        auto="Where photos show that the given cameras are inexact",
        on="Always refine; the frame of all cameras together stays",
        off="Take the cameras as they are given",
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
        "auto",
        help="What masks exclude. ignore: these pixels are not trained on, and anything may be "
        "there; background: the space behind them is empty; auto: background where the masks were "
        "made of a turntable, of a region or by a model, else ignore.",
        check=Choices(MASK_MODES),
        option=Option(
            "--mask-mode",
            help="masked pixels: ignore them, or treat them as empty background; auto: background "
            "where the masks were made of a turntable, of a region or by a model",
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
                Item("auto", "Auto", "Background for a turntable and for made masks, else Ignore"),
            ),
        ),
    )
    blocks: int = setting(
        1,
        help="Parts of the scene that are trained each by itself, after a coarse training of the "
        "whole, and then joined: side by side in several processes or computers, or one after "
        "another in less memory. 1 trains the scene in one piece.",
        check=Range(1, MAX_BLOCKS),
        unit="blocks",
        option=Option("--blocks", help="train the scene in this many parts, and join them"),
        panel=PanelProperty(
            "Blocks",
            "Parts of the scene that are trained each by itself and then joined: for hundreds of "
            "photos, on several processes or computers. 1: in one piece",
            soft_high=16,
        ),
        since="0.2.0",
    )
    polish: float = setting(
        0.1,
        help="Share of the iterations that joined blocks are trained together on all photos; 0: "
        "none, which needs the least memory. No effect without blocks.",
        check=Range(0.0, 1.0),
        option=Option(
            "--polish", "SHARE", "share of the iterations that joined blocks are trained together"
        ),
        since="0.2.0",
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
