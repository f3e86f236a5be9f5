# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the buttons of masks, and the photo under review with its mask, from memory."""

from __future__ import annotations

from typing import Any

from ...ops.common.translate import tr
from ...ops.masks import mask_review
from ..common.text import wrapped_label

_PICTURE_SCALE = 12.0  # of an icon's size
_LONG_LABEL = 0.66  # of the width, for the longer of two labels


def draw_masks(layout: Any, characters: int) -> None:
    """Draw the making of masks, and their review where one is open."""
    row = layout.split(factor=_LONG_LABEL, align=True)
    row.operator("gwrap.masks_from_region", icon="MOD_MASK")
    row.operator("gwrap.review_masks", text="Review", icon="VIEWZOOM")
    if not mask_review.is_open():
        return
    mask, accepted, icon = mask_review.shown()
    box = layout.box()
    box.template_icon(icon_value=icon, scale=_PICTURE_SCALE)
    wrapped_label(box, mask.photo, characters - 4, icon="CHECKMARK" if accepted else "CANCEL")
    number, count, rejected = mask_review.place()
    text = tr(
        "{number} of {count}, {rejected} rejected", number=number, count=count, rejected=rejected
    )
    row = box.row(align=True)
    row.operator("gwrap.step_mask", text="", icon="TRIA_LEFT").by = -1
    row.label(text=text, translate=False)
    row.operator("gwrap.step_mask", text="", icon="TRIA_RIGHT").by = 1
    row = box.row(align=True)
    row.operator("gwrap.decide_mask", text="Accept", icon="CHECKMARK").accepted = True
    row.operator("gwrap.decide_mask", text="Reject", icon="CANCEL").accepted = False
    box.operator("gwrap.end_mask_review", icon="X")
