# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of the training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..limits import MAX_BLOCKS
from .declaration import (
    CORRELATIONS,
    MASK_MODES,
    PRESETS,
    SELECTION_MODES,
    SWITCH,
    Check,
    Choices,
    Item,
    Option,
    PanelProperty,
    Range,
    auto_on_off,
    declarations,
    setting,
)

# -- Weights, schedule and limits of the method ---------------------------------------------------
#
# ``--set NAME=VALUE`` changes each, the panel none; the preset ``"paper"`` sets all of them to the
# published values (docs/method.md, section 4.5).


_WEIGHT = Range(0.0, 1000.0)
_SHARE = Range(0.0, 1.0)
_COUNT = Range(1, 10**6)
_OF_ITERATIONS = "share of iterations"


def _constant(
    default: Any, help: str, check: Check, *, paper: Any = None, large: Any = None,
    others: Any = None, **more: Any,
) -> Any:  # fmt: skip
    """Declare a constant of the method.

    ``paper`` and ``large`` are the published value and that of the preset for GPUs, if others;
    ``others`` that of all presets but Paper, where jobs of 0.1.0 had the default.
    """
    values = {name: others for name in PRESETS if name != "paper"}
    values |= {"paper": paper, "large": others if large is None else large}
    presets = {name: value for name, value in values.items() if value is not None}
    option = Option(metavar="" if isinstance(check, Choices) else "X")
    return setting(default, help=help, check=check, presets=presets, option=option, **more)


# Packed, as a survey of all settings needs few lines.
# fmt: off
@dataclass(frozen=True)
class MethodSettings:
    """Constants of the training. Milestones are shares of the iterations."""

    pixels_per_iteration: int = _constant(
        80_000, "An iteration trains on a window of a photo with at most about this many pixels.",
        Range(1000, 10**9), unit="pixels", paper=10**9, large=10**9,
    )
    coarse_to_fine: str = _constant(
        "on",
        "Training begins on photos at a quarter and half of their size. off: full size throughout.",
        Choices(SWITCH), paper="off", since="0.2.0",
    )
    filter_variance: float = _constant(
        0.05,
        "Variance of the 3D filter. The published 0.2 takes opacity from what is as thin as a "
        "pixel.",
        _SHARE, unit="squared pixels", paper=0.2, since="0.2.0",
    )
    short_run_power: float = _constant(
        0.4,
        "Learning rates of n iterations grow with (30000 / n) to this power; 0 leaves them as "
        "published.",
        _SHARE, since="0.2.0", others=0.5,
    )
    lambda_dssim: float = _constant(0.2, "Weight of the D-SSIM term of the colour loss.", _SHARE)
    lambda_depth_normal: float = _constant(0.05, "Weight of the depth-normal loss.", _WEIGHT)
    lambda_depth_prior: float = _constant(
        0.1, "Weight of the depths that stereo confirmed, after a dense start.", _WEIGHT, paper=0.0,
        since="0.2.0",
    )
    lambda_opacity: float = _constant(
        0.001, "Weight of the opacity prior: what photos leave open is opaque.", _WEIGHT, paper=0.0,
        since="0.2.0",
    )
    lambda_normal: float = _constant(0.03, "Weight of the normal loss.", _WEIGHT, paper=0.05)
    lambda_photometric: float = _constant(
        0.15,
        "Weight of the multi-view photometric loss, a quarter of the method's: with its 0.6, runs "
        "with a tenth of its iterations lose detail.",
        _WEIGHT, paper=0.6,
    )
    lambda_geometric: float = _constant(0.02, "Weight of the multi-view geometric loss.", _WEIGHT)
    correlation: str = _constant(
        "signed", "Correlation of two patches: signed, or squared, where -1 is as good as 1.",
        Choices(CORRELATIONS), paper="squared",
    )
    depth_from: float = _constant(
        7 / 30, "Start of the depth-normal loss and the multi-view terms.", _SHARE,
        unit=_OF_ITERATIONS,
    )
    multi_view_until: float = _constant(
        0.75,
        "End of the multi-view terms. What noise in the photos has displaced can settle after it.",
        _SHARE, unit=_OF_ITERATIONS, paper=1.0,
    )
    multi_view_pixels: int = _constant(
        4000, "Pixels of an iteration at which the multi-view terms are evaluated.",
        Range(1, 10**9), unit="pixels", paper=10**9,
    )
    multi_view_every: int = _constant(
        1, "The multi-view terms are evaluated in every n-th iteration, with n times the weight.",
        Range(1, 1000), unit="iterations",
    )
    neighbour_distance: float = _constant(
        1.0, "Largest distance of two cameras whose photos are compared.", Range(0.0, 100.0),
        unit="scene radii", paper=0.3, since="0.2.0",
    )
    neighbour_overlap: float = _constant(
        0.3, "Least share of a camera's sparse points that lie in the other's image, too.", _SHARE,
        unit="share", paper=0.0, since="0.2.0",
    )
    # The usual sum of 5e-6 is far below the noise of photos: such patches agree by chance, displace
    # the surface at random, and a surface displaced at random recedes.
    patch_contrast: float = _constant(
        0.012, "Least standard deviation of grey, in [0, 1], of a patch that is compared.", _SHARE,
        paper=(5e-6 / 49) ** 0.5, since="0.2.0",
    )
    # Plain walls and glaze show shading and stains at a larger scale only.
    patch_sizes: int = _constant(
        3,
        "Patch sizes, each twice the one before: a larger one is taken where smaller ones are "
        "flat.",
        Range(1, 5), paper=1, since="0.2.0",
    )
    # Beyond it there is no plane, as for a spoke before a wall, and thin parts would be pulled
    # towards what lies behind. With 1, thin parts gain slightly more, but rooms lose most of the
    # terms' benefit.
    patch_rise: float = _constant(
        4.0, "Largest deviation of the surface from the plane of a patch that is compared.",
        Range(0.0, 1e9), unit="half sides of the patch", paper=1e9, since="0.2.0",
    )
    degree_every: float = _constant(
        1 / 6,
        "After each such share of the iterations the degree of the harmonics rises by one, where "
        "`harmonics` is on.",
        Range(1e-6, 1.0), unit=_OF_ITERATIONS, paper=1 / 30, since="0.2.0",
    )
    densify_from: float = _constant(
        0.5 / 30, "Start of densification.", _SHARE, unit=_OF_ITERATIONS,
    )
    densify_until: float = _constant(0.5, "End of densification.", _SHARE, unit=_OF_ITERATIONS)
    densify_every: int = _constant(100, "Interval of densification.", _COUNT, unit="iterations")
    densify_score: float = _constant(
        0.3,
        "Share of the gradient threshold from which a Gaussian may be densified while the budget "
        "has room.",
        _SHARE, unit="share", paper=1.0, since="0.2.0",
    )
    min_opacity: float = _constant(
        0.02,
        "Density control removes Gaussians whose raw opacity is smaller. Short runs hardly recover "
        "what the published 0.05 removes.",
        _SHARE, paper=0.05, since="0.2.0",
    )
    free_views: int = _constant(
        2,
        "After a dense start, Gaussians that so many photos see through are removed at intervals; "
        "0 removes none.",
        Range(0, 1000), unit="photos", paper=0, since="0.2.0",
    )
    overlap_price: float = _constant(
        2e-5,
        "Footprint regulariser: cost, in the unit of the loss, of one more Gaussian over every "
        "pixel.",
        _SHARE, paper=0.0,
    )
    # Of 40 photos of a thing in a studio, this prunes as many as half a per cent of the weights of
    # all views together would.
    prune_share: float = _constant(
        0.03,
        "Gaussians that in no training view belong to more than the least contributors, which "
        "together make up this share of its blending weights, are pruned at intervals; 0 prunes "
        "none.",
        Range(0.0, 0.5, below_high=True), unit="share", paper=0.0,
    )
    orient_from: float = _constant(
        20 / 30, "Start of the orientation loss.", _SHARE, unit=_OF_ITERATIONS,
    )
    first_sign: float = _constant(
        0.5,
        "First magnitude of the sign of an orientation, towards the cameras; 0 lets the normal "
        "loss find the side.",
        _SHARE, paper=0.0, since="0.2.0",
    )
    wrap_rounds: int = setting(
        3,
        help="Rounds in which clones of opposite orientation are added; 0 trains the orientation "
        "alone.",
        check=Range(0, 20), presets={"draft": 2, "fine": 4, "paper": 5, "large": 4}, unit="rounds",
        option=Option("--wrap-rounds", "N", "rounds of clones; 0 trains the orientation alone"),
    )
    wrap_from: float = _constant(22 / 30, "First round of clones.", _SHARE, unit=_OF_ITERATIONS)
    wrap_until: float = _constant(26 / 30, "Last round of clones.", _SHARE, unit=_OF_ITERATIONS)
    wrap_share: float = _constant(
        0.05, "Share of the Gaussians that a round may clone.", _SHARE, unit="share",
    )
    wrap_divisor: int = _constant(
        2, "Views are rendered at their size divided by this to find normal errors.", Range(1, 8),
        paper=1, since="0.2.0",
    )

# fmt: on


# -- Settings of the training ---------------------------------------------------------------------


_SECONDS = Range(0.0, words="a number of seconds, 0 or more")


def _model_selection(
    *, paper: str, label: str, tooltip: str, auto: str, on: str, off: str, **more: Any
) -> Any:
    """Declare whether a part of the model is used: ``"auto"``, ``"on"`` or ``"off"``.

    ``paper`` is the value in the preset of that name; ``label`` and ``tooltip`` are of the property
    in the panel, ``auto``, ``on`` and ``off`` the tooltips of its entries.
    """
    return setting(
        "auto", check=Choices(SELECTION_MODES), presets={"paper": paper}, model_selection=True,
        panel=PanelProperty(label, tooltip, items=auto_on_off(auto, on, off)), **more,
    )  # fmt: skip


def _switch(default: str, *, label: str, tooltip: str, name: str, **more: Any) -> Any:
    """Declare a part of the model that no photo decides on; the preset Paper has all of them.

    Version 0.1.0 decided on it from the photos: its job files say ``"auto"``, which trains without
    harmonics and orientations, and with growth; saved settings that do take the default. The
    property in the panel has a ``name`` that is not the setting's, which .blend files hold as an
    enum.
    """
    return setting(
        default, check=Choices(SWITCH, earlier=("auto",)),
        presets={} if default == "on" else {"paper": "on"}, model_selection=True,
        panel=PanelProperty(label, tooltip, name=name), **more,
    )  # fmt: skip


# fmt: off
@dataclass(frozen=True)
class TrainingSettings(MethodSettings):
    """How the Gaussians are trained. Milestones are fractions of ``iterations``."""

    iterations: int = setting(
        3000, help="Training iterations.", check=_COUNT, unit="iterations",
        presets={"draft": 1500, "fine": 4000, "paper": 30_000, "large": 7000},
        option=Option("--iterations", "N", "training iterations instead of the preset's", own=True),
        panel=PanelProperty(
            "Iterations", "Steps of the training; 0 takes the preset's number", preset_if_zero=True,
            soft_high=30_000, step=100,
        ),
    )
    extra_iterations: int = setting(
        0, help="Iterations added to a finished training, at its last learning rates.",
        check=Range(0, 10**6), unit="iterations",
        option=Option("--iterations", "N", "iterations to be added", scope="more", own=True),
    )
    max_gaussians: int = setting(
        80_000, help="Largest number of Gaussians.", check=Range(100, 20_000_000), unit="Gaussians",
        presets={"draft": 40_000, "fine": 120_000, "paper": 6_000_000, "large": 300_000},
        option=Option("--max-gaussians", "N", "cap of Gaussians instead of the preset's", own=True),
        panel=PanelProperty(
            "Gaussians, Max",
            "Largest number of Gaussians; fewer need less time and memory. "
            "0 takes the preset's number",
            preset_if_zero=True, soft_high=1_000_000, step=1000,
        ),
    )
    max_image_px: int = setting(
        640, help="Long side of the finest training image.", check=Range(32, 16384), unit="pixels",
        presets={"draft": 480, "fine": 1024, "paper": 1600, "large": 1600},
        option=Option("--max-image-px", "N", "training size instead of the preset's", own=True),
        panel=PanelProperty(
            "Photo Size, Max",
            "Photos are trained at no more than this length of their long side, in pixels. "
            "0 takes the preset's number",
            preset_if_zero=True, soft_high=4096, step=100, subtype="PIXEL",
        ),
    )
    sh_degree: int = setting(
        2,
        help="Highest degree of the spherical harmonics; `harmonics` selects how much of it is "
        "used.",
        check=Range(0, 3), presets={"draft": 1, "fine": 3, "paper": 3, "large": 3},
        option=Option("--sh-degree", "0..3", "highest degree of the spherical harmonics"),
    )
    holdout_every: int = setting(
        8, help="Every n-th photo, sorted by name, is held out for measuring; 0 holds out none.",
        check=Range(0, 10**6, words="0 or more"), unit="photos",
        option=Option(
            "--holdout", "N", "hold out each n-th photo for measuring; 0 holds out none", own=True,
        ),
    )
    harmonics: str = _switch(
        "on",
        help="View-dependent colour. on: up to degree `sh_degree`; off: degree 0, but a splat that "
        "training starts from keeps what it has.",
        option=Option("--harmonics", help="colour that depends on the direction"),
        label="Reflections",
        tooltip="Learn colours that change with the viewing direction: without them, gloss becomes "
        "false surfaces",
        name="reflections",
    )
    exposure: str = _model_selection(
        help="Gain and offset per photo.", paper="off",
        option=Option("--exposure", help="gain and offset per photo"),
        label="Exposure", tooltip="Brightness and tint that differ from photo to photo",
        auto="Where the same points differ in brightness from photo to photo",
        on="Always learn a brightness and a tint for each photo",
        off="All photos were taken with the same settings and light",
    )
    multi_view: str = _model_selection(
        help="Loss terms that compare neighbouring photos.", paper="on",
        option=Option("--multi-view", help="terms that compare neighbouring photos"),
        label="Compare Photos",
        tooltip="Check each surface in neighbouring photos while training (multi-view terms)",
        auto="Where photos have neighbours with nearly the same view",
        on="Always compare; slower, gives smoother and more accurate surfaces",
        off="Never compare; faster",
    )
    wrapping: str = _switch(
        "off",
        help="Orientation of the Gaussians, its loss, and clones of opposite orientation.",
        option=Option("--wrapping", help="orientation, and clones of opposite orientation"),
        label="Orientations",
        tooltip="Learn which way Gaussians face, and clone those that face two ways; meshes of "
        "short trainings lose a little. The preset Paper always does",
        name="orientations",
    )
    growth: str = _switch(
        "on",
        help="Density control: Gaussians are added up to the limit where the photos show more, "
        "kept small (`overlap_price`) and removed where they contribute little (`prune_share`). "
        "off: their number stays that of the start.",
        option=Option("--growth", help="Gaussians added up to the limit, and pruned"),
        label="Add Gaussians",
        tooltip="Add Gaussians up to the limit where detail is missing, and remove those that "
        "contribute little",
        name="add_gaussians",
    )
    full_size: str = _model_selection(
        help="Training image size. auto: photos that show nothing finer than half their size are "
        "trained on at half size; on: always full size; off: half size.",
        paper="on",
        option=Option(
            "--full-size", help="photos at their full size, also where half size shows as much",
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
        on="On whatever surfaces matching finds", off="Start from the sparse points alone",
        since="0.2.0",
    )
    match_px: int = setting(
        640,
        help="Longest side of photos when they are matched for a dense start; larger ones are "
        "halved until they fit.",
        check=Range(32, 4096), unit="pixels", presets={"draft": 320},
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
        off="Take the cameras as they are given", since="0.2.0",
    )
    region_weight: float = setting(
        10.0,
        help="The training is for the job's regions, the automatic one among them: most iterations "
        "see what shows them, and Gaussians inside count this many times where their number is "
        "limited. 1: for all that the photos show, as for the region `all`.",
        check=Range(1.0, 1000.0), presets={"paper": 1.0},
        option=Option(
            "--region-weight", "W",
            "how much the training is for the regions; 1: for all that the photos show",
        ),
    )
    focus: str = setting(
        "",
        help="JSON list of the bodies of the regions that the training is for, world coordinates; "
        "`auto` for the automatic one. Written when a job that trains is made; other regions are "
        "meshed from the same training.",
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
            "Masks", "Meaning of the masked parts of the photos; no effect without masks",
            items=(
                Item("ignore", "Ignore", "Masked pixels are not trained on; anything may be there"),
                Item(
                    "background", "Background",
                    "Masked pixels show empty space: only the subject is modelled",
                ),
                Item("auto", "Auto", "Background for a turntable and for made masks, else Ignore"),
            ),
        ),
    )
    blocks: int = setting(
        1,
        help="Parts of the scene that are trained each by itself, after a coarse training of the "
        "whole, and then joined; on several computers only. 1 trains the scene in one piece.",
        check=Range(1, MAX_BLOCKS), unit="blocks",
        option=Option("--blocks", help="with --computers: train the scene in this many parts"),
        since="0.2.0",
    )
    checkpoint_every_s: float = setting(
        60.0, help="Time between two checkpoints.", check=_SECONDS, unit="seconds",
        affects_result=False,
    )
    preview_every_s: float = setting(
        20.0, help="Time between two preview pictures of a running training; 0 writes none.",
        check=_SECONDS, unit="seconds", affects_result=False,
        option=Option(
            "--preview-every", "S",
            "seconds between two preview pictures of the training; 0 writes none",
        ),
    )


# fmt: on
MODEL_SELECTION = tuple(d.name for d in declarations(TrainingSettings) if d.model_selection)
"""Parts of the model that can be switched on and off, or left to the photos (``"auto"``)."""
