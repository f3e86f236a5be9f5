# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether camera poses are refined (docs/method.md, section 1.8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...dataset.camera import Camera
from ...dataset.scene import Scene
from ..poses.camera_poses import LEAST_VIEWS, CameraPoses
from .model_selection import Decision, ModelSelection, decide

LEAST_SHIFT_PX = 0.25
"""Median shift from which given poses count as inexact. Noise alone moves exact ones by 0.12."""


def start_poses(
    setting: str, scene: Scene, views: Sequence[int], model_selection: ModelSelection
) -> tuple[CameraPoses | None, ModelSelection]:
    """Return poses to refine, if any, and the decisions with this one where nothing is to measure.

    Parameters
    ----------
    setting : str
        ``"on"``, ``"off"``, or ``"auto"``: only after a dense start. From sparse points Gaussians
        are in the wrong places at first, and cameras would follow them.
    views : sequence of int
        Training views.
    """
    decision = None
    if setting == "off":
        decision = Decision.by_settings("refine_poses", "off")
    elif missing := _missing(setting, views, model_selection):
        decision = Decision("refine_poses", setting, "off", missing, measured=False)
    if decision is not None:
        return None, model_selection.with_decision(decision)
    given = np.array([view.camera.cam_from_world for view in scene.views], np.float64)
    if setting == "on":
        model_selection = model_selection.with_decision(Decision.by_settings("refine_poses", "on"))
    return CameraPoses(given, views), model_selection


def _missing(setting: str, views: Sequence[int], model_selection: ModelSelection) -> str:
    """Return what poses cannot be refined for, or nothing."""
    if len(views) < LEAST_VIEWS:
        return f"Not tried: fewer than {LEAST_VIEWS} photos to train on."
    if setting == "auto" and not model_selection.chose("dense_start"):
        return "Not tried: training did not start on surfaces found by matching photos."
    return ""


def select_poses(poses: CameraPoses, cameras: Mapping[int, Camera], means: np.ndarray) -> Decision:
    """Decide whether refined poses differ from those given, and give them up if not.

    Poses that photos move at random only are better as they were: what moves them is noise.

    Parameters
    ----------
    cameras : mapping of int to Camera
        Of the training photos.
    means : (n, 3) array
        Of the Gaussians, scene frame.
    """
    shift_px = float(np.median(poses.shifts_px(cameras, means)))
    needed = shift_px >= LEAST_SHIFT_PX
    if not needed:
        poses.give_up()
    evidence = (
        f"Photos move half of the cameras by {shift_px:.2f} px or more "
        f"(needed: {LEAST_SHIFT_PX:g} px)."
    )
    return decide("refine_poses", "auto", needed, evidence, {"shift_px": shift_px})
