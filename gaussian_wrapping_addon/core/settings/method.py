# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights, schedule and limits of the method.

Each has an option of the command line; the preset ``"paper"`` sets all of them to the published
values (docs/method.md, section 4.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .checks import Check, Choices, Range
from .choices import CORRELATIONS, SWITCH
from .declaration import Option, setting

_WEIGHT = Range(0.0, 1000.0)
_SHARE = Range(0.0, 1.0)
_COUNT = Range(1, 10**6)
_OF_ITERATIONS = "share of iterations"


def _constant(
    default: Any,
    option: str,
    help: str,
    check: Check,
    *,
    unit: str = "",
    paper: Any = None,
    large: Any = None,
    since: str = "",
) -> Any:
    """Declare a constant of the method with its option and values of presets, if others.

    Parameters
    ----------
    paper, large : optional
        The published value, and that of the preset for GPUs.
    """
    values = {"paper": paper, "large": large}
    presets = {name: value for name, value in values.items() if value is not None}
    metavar = "" if isinstance(check, Choices) else "X"
    shown = Option(option, metavar, scope="constants")
    return setting(
        default, help=help, check=check, unit=unit, presets=presets, option=shown, since=since
    )


@dataclass(frozen=True)
class MethodSettings:
    """Constants of the training. Milestones are shares of the iterations."""

    pixels_per_iteration: int = _constant(
        80_000,
        "--pixels-per-iteration",
        "An iteration trains on a window of a photo with at most about this many pixels.",
        Range(1000, 10**9),
        unit="pixels",
        paper=10**9,
        large=10**9,
    )
    coarse_to_fine: str = _constant(
        "on",
        "--coarse-to-fine",
        "Training begins on photos at a quarter and half of their size. off: full size throughout.",
        Choices(SWITCH),
        paper="off",
        since="0.2.0",
    )
    filter_variance: float = _constant(
        0.05,
        "--filter-variance",
        "Variance of the 3D filter. The published 0.2 takes opacity from what is as thin as a "
        "pixel.",
        _SHARE,
        unit="squared pixels",
        paper=0.2,
        since="0.2.0",
    )
    short_run_power: float = _constant(
        0.4,
        "--short-run-power",
        "Learning rates of n iterations grow with (30000 / n) to this power; 0 leaves them as "
        "published.",
        _SHARE,
        since="0.2.0",
    )
    lambda_dssim: float = _constant(
        0.2, "--lambda-dssim", "Weight of the D-SSIM term of the colour loss.", _SHARE
    )
    lambda_depth_normal: float = _constant(
        0.05, "--lambda-depth-normal", "Weight of the depth-normal loss.", _WEIGHT
    )
    lambda_depth_prior: float = _constant(
        0.1,
        "--lambda-depth-prior",
        "Weight of the depths that stereo confirmed, after a dense start.",
        _WEIGHT,
        paper=0.0,
        since="0.2.0",
    )
    lambda_opacity: float = _constant(
        0.001,
        "--lambda-opacity",
        "Weight of the opacity prior: what photos leave open is opaque.",
        _WEIGHT,
        paper=0.0,
        since="0.2.0",
    )
    lambda_normal: float = _constant(
        0.03, "--lambda-normal", "Weight of the normal loss.", _WEIGHT, paper=0.05
    )
    lambda_photometric: float = _constant(
        0.15,
        "--lambda-photometric",
        "Weight of the multi-view photometric loss, a quarter of the method's: with its 0.6, runs "
        "with a tenth of its iterations lose detail.",
        _WEIGHT,
        paper=0.6,
    )
    lambda_geometric: float = _constant(
        0.02, "--lambda-geometric", "Weight of the multi-view geometric loss.", _WEIGHT
    )
    correlation: str = _constant(
        "signed",
        "--correlation",
        "Correlation of two patches: signed, or squared, where -1 is as good as 1.",
        Choices(CORRELATIONS),
        paper="squared",
    )
    depth_from: float = _constant(
        7 / 30,
        "--depth-from",
        "Start of the depth-normal loss and the multi-view terms.",
        _SHARE,
        unit=_OF_ITERATIONS,
    )
    multi_view_until: float = _constant(
        0.75,
        "--multi-view-until",
        "End of the multi-view terms. What noise in the photos has displaced can settle after it.",
        _SHARE,
        unit=_OF_ITERATIONS,
        paper=1.0,
    )
    multi_view_pixels: int = _constant(
        4000,
        "--multi-view-pixels",
        "Pixels of an iteration at which the multi-view terms are evaluated.",
        Range(1, 10**9),
        unit="pixels",
        paper=10**9,
    )
    multi_view_every: int = _constant(
        1,
        "--multi-view-every",
        "The multi-view terms are evaluated in every n-th iteration, with n times the weight.",
        Range(1, 1000),
        unit="iterations",
    )
    neighbour_distance: float = _constant(
        1.0,
        "--neighbour-distance",
        "Largest distance of two cameras whose photos are compared.",
        Range(0.0, 100.0),
        unit="scene radii",
        paper=0.3,
        since="0.2.0",
    )
    neighbour_overlap: float = _constant(
        0.3,
        "--neighbour-overlap",
        "Least share of a camera's sparse points that lie in the other's image, too.",
        _SHARE,
        unit="share",
        paper=0.0,
        since="0.2.0",
    )
    # The usual sum of 5e-6 is far below the noise of photos: such patches agree by chance, displace
    # the surface at random, and a surface displaced at random recedes.
    patch_contrast: float = _constant(
        0.012,
        "--patch-contrast",
        "Least standard deviation of grey, in [0, 1], of a patch that is compared.",
        _SHARE,
        paper=(5e-6 / 49) ** 0.5,
        since="0.2.0",
    )
    # Plain walls and glaze show shading and stains at a larger scale only.
    patch_sizes: int = _constant(
        3,
        "--patch-sizes",
        "Patch sizes, each twice the one before: a larger one is taken where smaller ones are "
        "flat.",
        Range(1, 5),
        paper=1,
        since="0.2.0",
    )
    # Beyond it there is no plane, as for a spoke before a wall, and thin parts would be pulled
    # towards what lies behind. With 1, thin parts gain slightly more, but rooms lose most of the
    # terms' benefit.
    patch_rise: float = _constant(
        4.0,
        "--patch-rise",
        "Largest deviation of the surface from the plane of a patch that is compared.",
        Range(0.0, 1e9),
        unit="half sides of the patch",
        paper=1e9,
        since="0.2.0",
    )
    degree_every: float = _constant(
        1 / 6,
        "--degree-every",
        "After each such share of the iterations the degree of the harmonics rises by one, where "
        "`harmonics` is on.",
        Range(1e-6, 1.0),
        unit=_OF_ITERATIONS,
        paper=1 / 30,
        since="0.2.0",
    )
    densify_from: float = _constant(
        0.5 / 30, "--densify-from", "Start of densification.", _SHARE, unit=_OF_ITERATIONS
    )
    densify_until: float = _constant(
        0.5, "--densify-until", "End of densification.", _SHARE, unit=_OF_ITERATIONS
    )
    densify_every: int = _constant(
        100, "--densify-every", "Interval of densification.", _COUNT, unit="iterations"
    )
    densify_score: float = _constant(
        0.3,
        "--densify-score",
        "Share of the gradient threshold from which a Gaussian may be densified while the budget "
        "has room.",
        _SHARE,
        unit="share",
        paper=1.0,
        since="0.2.0",
    )
    min_opacity: float = _constant(
        0.02,
        "--min-opacity",
        "Density control removes Gaussians whose raw opacity is smaller. Short runs hardly recover "
        "what the published 0.05 removes.",
        _SHARE,
        paper=0.05,
        since="0.2.0",
    )
    free_views: int = _constant(
        2,
        "--free-views",
        "After a dense start, Gaussians that so many photos see through are removed at intervals; "
        "0 removes none.",
        Range(0, 1000),
        unit="photos",
        paper=0,
        since="0.2.0",
    )
    overlap_price: float = _constant(
        2e-5,
        "--overlap-price",
        "Footprint regulariser, where `growth` is auto: cost, in the unit of the loss, of one more "
        "Gaussian over every pixel.",
        _SHARE,
        paper=0.0,
    )
    # Of 40 photos of a thing in a studio, this prunes as many as half a per cent of the weights of
    # all views together would.
    prune_share: float = _constant(
        0.03,
        "--prune-share",
        "Where `growth` is auto, Gaussians that in no training view belong to more than the least "
        "contributors, which together make up this share of its blending weights, are pruned at "
        "intervals; 0 prunes none.",
        Range(0.0, 0.5, below_high=True),
        unit="share",
        paper=0.0,
    )
    orient_from: float = _constant(
        20 / 30, "--orient-from", "Start of the orientation loss.", _SHARE, unit=_OF_ITERATIONS
    )
    first_sign: float = _constant(
        0.5,
        "--first-sign",
        "First magnitude of the sign of an orientation, towards the cameras; 0 lets the normal "
        "loss find the side.",
        _SHARE,
        paper=0.0,
        since="0.2.0",
    )
    wrap_rounds: int = setting(
        3,
        help="Rounds in which clones of opposite orientation are added; 0 trains the orientation "
        "alone.",
        check=Range(0, 20),
        presets={"draft": 2, "fine": 4, "paper": 5, "large": 4},
        unit="rounds",
        option=Option("--wrap-rounds", "N", "rounds of clones; 0 trains the orientation alone"),
    )
    wrap_from: float = _constant(
        22 / 30, "--wrap-from", "First round of clones.", _SHARE, unit=_OF_ITERATIONS
    )
    wrap_until: float = _constant(
        26 / 30, "--wrap-until", "Last round of clones.", _SHARE, unit=_OF_ITERATIONS
    )
    wrap_share: float = _constant(
        0.05, "--wrap-share", "Share of the Gaussians that a round may clone.", _SHARE, unit="share"
    )
    wrap_divisor: int = _constant(
        2,
        "--wrap-divisor",
        "Views are rendered at their size divided by this to find normal errors.",
        Range(1, 8),
        paper=1,
        since="0.2.0",
    )
