# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of a region, and their review."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import bpy
import bpy.utils.previews
import numpy as np
from bpy.props import BoolProperty, IntProperty

from ..core.errors import DatasetError, UsageError
from ..core.masks.mask_folder import FOLDER, MadeMask, MaskList, read_list, write_list
from . import addon
from .addon import ReportsErrors
from .job_timer import new_icon
from .jobs import (
    OnRegions,
    OnSceneJob,
    selected_regions,
    start_wrap_for,
    why_no_start,
)
from .worker_setup import worker_choice

# -- Look at made masks over their photos; decisions go into the job's folder at once -------------
#
# The picture is an image of the file, ``Mask Review``, shown in Image Editors, and an icon for
# the panel, which draws from memory.


IMAGE_NAME = "Mask Review"
LONGEST_PX = 1600
"""Of the picture: enough to see a border."""
ICON_PX = 512
DIMMED = 0.3
LEFT_OUT = (0.0, 0.0, 0.45)
"""What a mask leaves out is dimmed and tinted."""
THRESHOLD = 0.5


@dataclass
class _Review:
    folder: Path
    """The job's."""
    masks: MaskList
    index: int = 0
    icon: int = 0


_review: _Review | None = None
_icons: Any = None  # ImagePreviewCollection, created with the first picture
_count = 0


def begin(folder: Path) -> None:
    """Begin the review of a job's masks with the first photo.

    Raises UsageError: the job has made no masks; ParseError: its list of masks is damaged;
    DatasetError: a photo or mask cannot be read.
    """
    global _review
    masks = read_list(folder / FOLDER)
    if masks is None or not masks.masks:
        raise UsageError("This job has made no masks yet.", "Press Masks from Region.")
    _review = _Review(folder, masks)
    _show()


def step(by: int) -> None:
    """Show a later or earlier photo; after the last comes the first."""
    review = _current()
    review.index = (review.index + by) % len(review.masks.masks)
    _show()


def decide(*, accepted: bool) -> None:
    """Accept or reject the photo that is shown, and write that down.

    The list is read again first: the job may have replaced it by other masks. Raises UsageError:
    other masks were made meanwhile.
    """
    review = _current()
    photo = review.masks.masks[review.index].photo
    there = read_list(review.folder / FOLDER)
    if there is None or there.made_by != review.masks.made_by:
        end()
        raise UsageError("Other masks were made meanwhile.", "Press Review Masks again.")
    review.masks = there.with_decision(photo, accepted=accepted)
    write_list(review.folder / FOLDER, review.masks)


def end() -> None:
    """Forget the review and its picture."""
    image: Any = bpy.data.images.get(IMAGE_NAME)
    if image is not None and image.users <= 1:
        bpy.data.images.remove(image)
    stop()


def stop() -> None:
    """Remove the icons; Blender warns about collections left behind."""
    global _icons, _review
    _review = None
    if _icons is not None:
        bpy.utils.previews.remove(_icons)
        _icons = None


def is_open() -> bool:
    """Return whether masks are being reviewed."""
    return _review is not None


def shown() -> tuple[MadeMask, bool, int]:
    """Return the mask that is shown, whether it is accepted, and the icon of its picture."""
    review = _current()
    mask = review.masks.masks[review.index]
    return mask, mask.photo not in review.masks.rejected, review.icon


def place() -> tuple[int, int, int]:
    """Return the number of the photo that is shown, from 1, of how many, and how many rejected."""
    review = _current()
    return review.index + 1, len(review.masks.masks), len(review.masks.rejected)


def overlaid(photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return a photo (h, w, 4) float32 whose pixels outside of a (h, w) bool mask are dimmed."""
    out = photo.copy()
    tint = np.array(LEFT_OUT, np.float32)
    out[..., :3] = np.where(mask[..., None], photo[..., :3], DIMMED * photo[..., :3] + tint)
    out[..., 3] = 1.0
    return np.clip(out, 0.0, 1.0)


def _current() -> _Review:
    if _review is None:
        raise UsageError("No masks are being reviewed.", "Press Review Masks.")
    return _review


def _show() -> None:
    global _icons, _count
    review = _current()
    mask = review.masks.masks[review.index]
    photo = _pixels(review.folder / mask.image, LONGEST_PX)
    path = review.folder / FOLDER / mask.file
    kept = np.zeros(photo.shape[:2], bool)
    if path.is_file():
        kept = _pixels(path, 0, (photo.shape[1], photo.shape[0]))[..., 0] >= THRESHOLD
    picture = overlaid(photo, kept)
    _put_into_image(picture)
    step_px = max(1, -(-max(picture.shape[:2]) // ICON_PX))
    if _icons is None:
        _icons = bpy.utils.previews.new()
    _icons.clear()
    _count += 1  # a new name each time: Blender caches what it has drawn under a name
    review.icon = new_icon(_icons, f"mask {_count}", picture[::step_px, ::step_px])


def _pixels(path: Path, longest_px: int, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return an image file as (h, w, 4) float32, from the bottom up, scaled by Blender."""
    if addon.is_remote(path):  # a job folder may come from elsewhere
        raise UsageError(f"{path} is on another computer.", "Copy the photos to this one.")
    try:
        image: Any = bpy.data.images.load(str(path), check_existing=False)
    except RuntimeError:
        raise DatasetError(
            f"{path} cannot be read.", "Put it back, or make the masks again."
        ) from None
    try:
        width, height = image.size
        if not width or not height:
            raise DatasetError(f"{path} cannot be read.", "Put it back, or make the masks again.")
        factor = min(1.0, longest_px / max(width, height)) if longest_px else 1.0
        wanted = size or (max(1, round(width * factor)), max(1, round(height * factor)))
        image.colorspace_settings.name = "Non-Color"  # bytes as they are, no conversion
        if wanted != (width, height):
            image.scale(*wanted)
        values = np.empty(wanted[0] * wanted[1] * image.channels, np.float32)
        image.pixels.foreach_get(values)
        pixels = values.reshape(wanted[1], wanted[0], image.channels)
    finally:
        bpy.data.images.remove(image)
    out = np.ones((*pixels.shape[:2], 4), np.float32)
    out[..., :3] = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1]
    return out


def _put_into_image(picture: np.ndarray) -> None:
    height, width = picture.shape[:2]
    image: Any = bpy.data.images.get(IMAGE_NAME)
    if image is None:
        image = bpy.data.images.new(IMAGE_NAME, width, height)
    elif tuple(image.size) != (width, height):
        image.scale(width, height)
    image.pixels.foreach_set(np.ascontiguousarray(picture).ravel())
    image.update()
    for window in bpy.context.window_manager.windows if bpy.context.window_manager else ():
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR" and area.spaces.active is not None:
                space: Any = area.spaces.active
                if space.image is None or space.image == image:
                    space.image = image
                area.tag_redraw()


# -- Operators of masks: make them of a region, review, accept and reject them --------------------


class GWRAP_OT_masks_from_region(OnRegions, bpy.types.Operator):
    bl_idname = "gwrap.masks_from_region"
    bl_label = "Masks from Region"
    bl_description = (
        "Mask all photos to what stands in the selected regions, train again without the rest, and "
        "mesh the regions"
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not selected_regions(context):
            return "Select a region box around the object"
        return why_no_start(context)

    def work(self, context: bpy.types.Context) -> None:
        regions = self.regions(context)
        changed = {"make_masks": "region", "mask_model": ""}
        start_wrap_for(context.scene, regions, worker_choice(context), changed)
        self.report({"INFO"}, f"Masking to {', '.join(r.name for r in regions)}")


class GWRAP_OT_review_masks(OnSceneJob, bpy.types.Operator):
    bl_idname = "gwrap.review_masks"
    bl_label = "Review Masks"
    bl_description = "Show each photo of the job with its mask, here and in an open Image Editor"

    def work(self, context: bpy.types.Context) -> None:
        begin(self.folder(context))


class _OfReview(ReportsErrors):
    """Mixin: available while masks are reviewed."""

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        return "" if is_open() else "Press Review Masks first"


class GWRAP_OT_step_mask(_OfReview, bpy.types.Operator):
    bl_idname = "gwrap.step_mask"
    bl_label = "Next Mask"
    bl_description = "Show the next or the previous photo and its mask"

    by: IntProperty(default=1, options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def work(self, _context: bpy.types.Context) -> None:
        step(self.by)


class GWRAP_OT_decide_mask(_OfReview, bpy.types.Operator):
    bl_idname = "gwrap.decide_mask"
    bl_label = "Accept or Reject"
    bl_description = (
        "Use this photo with its mask, or leave it out of the next training; then show the next"
    )

    accepted: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def work(self, _context: bpy.types.Context) -> None:
        decide(accepted=self.accepted)
        step(1)


class GWRAP_OT_end_mask_review(_OfReview, bpy.types.Operator):
    bl_idname = "gwrap.end_mask_review"
    bl_label = "Close"
    bl_description = "End the review; decisions stay"

    def work(self, _context: bpy.types.Context) -> None:
        end()


CLASSES: Final = (
    GWRAP_OT_masks_from_region, GWRAP_OT_review_masks, GWRAP_OT_step_mask, GWRAP_OT_decide_mask,
    GWRAP_OT_end_mask_review,
)  # fmt: skip
