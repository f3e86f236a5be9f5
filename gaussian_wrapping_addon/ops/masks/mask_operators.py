# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of masks: make them of a region, review, accept and reject them."""

from pathlib import Path
from typing import Final

import bpy
from bpy.props import BoolProperty, IntProperty

from ...core.errors import UsageError
from ..common import tags
from ..common.addon import properties_of
from ..common.error_reporting import OperatorResult, ReportsErrors
from ..jobs.job_guards import ConfirmsFolder, has_worker, no_job_runs, selected_regions
from ..worker import preferred_worker
from . import mask_actions, mask_review


class GWRAP_OT_masks_from_region(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.masks_from_region"
    bl_label = "Masks from Region"
    bl_description = (
        "Mask all photos to what stands in the selected regions, train again without the rest, and "
        "mesh the regions"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not selected_regions(context):
            cls.poll_message_set("Select a region box around the object")
            return False
        return has_worker(cls) and no_job_runs(cls, context)

    def folder(self, context: bpy.types.Context) -> Path | None:
        regions = selected_regions(context)
        frame = tags.frame_of(regions[0]) if regions else None
        return tags.result_folder(frame).parent if frame and frame.get(tags.RESULT) else None

    def work(self, context: bpy.types.Context) -> OperatorResult:
        regions = selected_regions(context)
        choice = preferred_worker.worker_choice(context)
        mask_actions.start_region_masks(context.scene, regions, choice)
        self.report({"INFO"}, f"Masking to {', '.join(r.name for r in regions)}")
        return {"FINISHED"}


class GWRAP_OT_review_masks(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.review_masks"
    bl_label = "Review Masks"
    bl_description = "Show each photo of the job with its mask, here and in an open Image Editor"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not properties_of(context.scene).job_folder:
            cls.poll_message_set("This scene has no job; press Wrap Scene, or find its folder")
            return False
        return True

    def folder(self, context: bpy.types.Context) -> Path | None:
        return Path(bpy.path.abspath(properties_of(context.scene).job_folder))

    def work(self, context: bpy.types.Context) -> OperatorResult:
        folder = self.folder(context)
        if folder is None:
            raise UsageError("This scene has no job.", "Wrap the scene first.")
        mask_review.begin(folder)
        return {"FINISHED"}


class _OfReview(ReportsErrors):
    """Mixin: available while masks are reviewed."""

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Tell whether masks are reviewed; Blender calls this."""
        if not mask_review.is_open():
            cls.poll_message_set("Press Review Masks first")
            return False
        return True


class GWRAP_OT_step_mask(_OfReview, bpy.types.Operator):
    bl_idname = "gwrap.step_mask"
    bl_label = "Next Mask"
    bl_description = "Show the next or the previous photo and its mask"

    by: IntProperty(default=1, options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def work(self, _context: bpy.types.Context) -> OperatorResult:
        mask_review.step(self.by)
        return {"FINISHED"}


class GWRAP_OT_decide_mask(_OfReview, bpy.types.Operator):
    bl_idname = "gwrap.decide_mask"
    bl_label = "Accept or Reject"
    bl_description = (
        "Use this photo with its mask, or leave it out of the next training; then show the next"
    )

    accepted: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def work(self, _context: bpy.types.Context) -> OperatorResult:
        mask_review.decide(accepted=self.accepted)
        mask_review.step(1)
        return {"FINISHED"}


class GWRAP_OT_end_mask_review(_OfReview, bpy.types.Operator):
    bl_idname = "gwrap.end_mask_review"
    bl_label = "Close"
    bl_description = "End the review; decisions stay"

    def work(self, _context: bpy.types.Context) -> OperatorResult:
        mask_review.end()
        return {"FINISHED"}


CLASSES: Final = (
    GWRAP_OT_masks_from_region,
    GWRAP_OT_review_masks,
    GWRAP_OT_step_mask,
    GWRAP_OT_decide_mask,
    GWRAP_OT_end_mask_review,
)
