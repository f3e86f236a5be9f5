# SPDX-License-Identifier: GPL-3.0-or-later
"""What the sub-panel "Training" edits: ``Scene.gwrap.training``; no property has a callback."""

from typing import Final

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

_Items = tuple[tuple[str, str, str], ...]


def _decision(automatic: str, on: str, off: str) -> _Items:
    return (("AUTO", "Auto", automatic), ("ON", "On", on), ("OFF", "Off", off))


_HARMONICS: Final = _decision(
    "Only as much as makes photos that were kept back look better",
    "As much as the preset allows, whether it helps or not",
    "Every point has one colour from all sides; fastest, right for matte things",
)
_EXPOSURE: Final = _decision(
    "Where the same points differ in brightness from photo to photo",
    "Always learn a brightness and a tint for each photo",
    "All photos were taken with the same settings and light",
)
_MULTI_VIEW: Final = _decision(
    "Where photos have neighbours that see the same from nearly the same side",
    "Always compare; takes more time, gives smoother and truer surfaces",
    "Never compare; faster",
)
_WRAPPING: Final = _decision(
    "Where the surface's direction still shows errors, such as on thin parts",
    "Always; thin parts such as wires, spokes and leaves get a front and a back",
    "Never; faster, but thin parts may be lost",
)
_GROWTH: Final = _decision(
    "Add Gaussians until more of them gain little",
    "Add Gaussians up to the limit",
    "Keep the number that training starts with",
)
_MASKS: Final = (
    ("IGNORE", "Ignore", "Masked parts of the photos teach nothing; anything may stand there"),
    ("BACKGROUND", "Background", "Nothing stands in masked parts: only the subject is modelled"),
)


class GWRAP_PG_training(bpy.types.PropertyGroup):
    """Choices that go before the preset's; 0 and Auto leave it to the preset and the photos."""

    harmonics: EnumProperty(  # type: ignore[valid-type]
        name="Reflections",
        description="Colours that change with the side one looks from: gloss, metal, glass",
        items=_HARMONICS,
        default="AUTO",
    )
    exposure: EnumProperty(  # type: ignore[valid-type]
        name="Exposure",
        description="Brightness and tint that differ from photo to photo",
        items=_EXPOSURE,
        default="AUTO",
    )
    multi_view: EnumProperty(  # type: ignore[valid-type]
        name="Compare Photos",
        description="Check each surface in neighbouring photos while training (multi-view terms)",
        items=_MULTI_VIEW,
        default="AUTO",
    )
    wrapping: EnumProperty(  # type: ignore[valid-type]
        name="Wrap Thin Parts",
        description="Learn where outside is, and give thin things a front and a back",
        items=_WRAPPING,
        default="AUTO",
    )
    growth: EnumProperty(  # type: ignore[valid-type]
        name="Add Gaussians",
        description="Whether more Gaussians are added where detail is missing",
        items=_GROWTH,
        default="AUTO",
    )
    mask_mode: EnumProperty(  # type: ignore[valid-type]
        name="Masks",
        description="What the masked parts of the photos mean; without masks it changes nothing",
        items=_MASKS,
        default="IGNORE",
    )
    iterations: IntProperty(  # type: ignore[valid-type]
        name="Iterations",
        description="Steps of the training; 0 takes the preset's number",
        default=0,
        min=0,
        max=1_000_000,
        soft_max=30_000,
        step=100,
    )
    max_gaussians: IntProperty(  # type: ignore[valid-type]
        name="Gaussians, Max",
        description=(
            "Most Gaussians there may be; fewer need less time and memory. "
            "0 takes the preset's number"
        ),
        default=0,
        min=0,
        max=20_000_000,
        soft_max=1_000_000,
        step=1000,
    )
    max_image_px: IntProperty(  # type: ignore[valid-type]
        name="Photo Size, Max",
        description=(
            "Photos are trained at no more than this length of their long side, in pixels. "
            "0 takes the preset's number"
        ),
        default=0,
        min=0,
        max=16384,
        soft_max=4096,
        step=100,
        subtype="PIXEL",
    )
    start_splat: StringProperty(  # type: ignore[valid-type]
        name="Start from Splat",
        description=(
            "PLY of a Gaussian splat of the same photos and cameras, made here or elsewhere; "
            "empty starts from the points of the cameras"
        ),
        subtype="FILE_PATH",
    )
    more_iterations: IntProperty(  # type: ignore[valid-type]
        name="Iterations",
        description="How many iterations Train More adds to the finished training",
        default=1000,
        min=1,
        max=1_000_000,
        soft_min=100,
        soft_max=10_000,
        step=100,
    )


CLASSES: Final = (GWRAP_PG_training,)
