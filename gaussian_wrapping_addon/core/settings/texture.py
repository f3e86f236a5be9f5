# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of UV map and textures."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import UsageError
from ..limits import MAX_ATLASES
from .declaration import (
    MAX_LODS,
    SELECTION_MODES,
    SWITCH,
    TEXTURE_SOURCES,
    Choices,
    Item,
    Option,
    PanelProperty,
    Range,
    setting,
)


def _size(text: str) -> int:
    if text == "auto":
        return 0
    if not text.isdecimal():
        raise UsageError(
            f"--texture-size {text} is not a number.", "Give auto or a size in pixels."
        )
    return int(text)


# Packed, as a survey of all settings needs few lines.
# fmt: off
@dataclass(frozen=True)
class TextureSettings:
    """How the mesh is unwrapped and textured."""

    size_px: int = setting(
        0, help="Side of the square texture; 0 derives it from the photos' footprint.",
        check=Range(64, 8192, zero="automatic"), unit="pixels",
        option=Option(
            "--texture-size", "auto|N", "side of the texture in pixels (default: auto)",
            parse=_size, own=True,
        ),
        panel=PanelProperty(
            "Texture Size", "Side of the texture", name="texture_size",
            items=(
                Item(0, "Automatic", "As many pixels as the photos provide"),
                *(Item(s, str(s), f"{s} pixels each way") for s in (1024, 2048, 4096, 8192)),
            ),
            order=10, drawn_label="Size",
        ),
    )
    gutter_px: int = setting(
        8,
        help="Margin around each chart of a 4096-pixel texture; in proportion for smaller ones, "
        "but at least 2.",
        check=Range(1, 64), unit="pixels",
    )
    normal_map: str = setting(
        "auto",
        help="Normal map with the detail of the dense mesh. auto: where decimation removed faces; "
        "on: always, flat where none were removed; off: none.",
        check=Choices(SELECTION_MODES),
        option=Option(
            "--normal-map",
            help="normal map with the dense mesh's detail; auto: where --faces removed faces",
        ),
        panel=PanelProperty(
            "Normal Map", "Detail of the mesh before its faces were limited, as a texture",
            items=(
                Item(
                    "auto", "Automatic", "Where the faces are limited: the detail that was removed",
                ),
                Item("on", "On", "Always; flat where no face was removed"),
                Item("off", "Off", "No normal map"),
            ),
            order=40,
        ),
    )
    ambient_occlusion: str = setting(
        "off", help="Ambient occlusion map of the dense mesh.", check=Choices(SWITCH),
        option=Option("--ambient-occlusion", help="bake ambient occlusion", flag="on"),
        panel=PanelProperty(
            "Ambient Occlusion", "Bake ambient occlusion as a texture, for glTF and game engines",
            order=50,
        ),
    )
    lods: int = setting(
        0,
        help="Levels of detail below the mesh, each with a quarter of the faces of the one above.",
        check=Range(0, MAX_LODS), unit="levels",
        option=Option(
            "--lods", "N", "coarser levels below the mesh, each with a quarter of the faces",
        ),
        panel=PanelProperty(
            "Levels of Detail",
            "Coarser meshes, each with a quarter of the faces of the one before", order=60,
        ),
    )
    source: str = setting(
        "photos",
        help="Source of the colours. photos: the photos' pixels; gaussians: the "
        "view-independent colour of the Gaussians, rendered from the photos' cameras.",
        check=Choices(TEXTURE_SOURCES),
        option=Option(
            "--texture-source",
            help="colours of the photos, or the view-independent colours of the Gaussians",
        ),
        panel=PanelProperty(
            "Texture From", "Where the colours of the texture come from", name="texture_source",
            items=(
                Item("photos", "Photos", "The photos' own pixels, blended: the finest detail"),
                Item(
                    "gaussians", "Gaussians",
                    "Colours of the Gaussians, without highlights and passers-by: even, but softer",
                ),
            ),
            order=30, drawn_label="Colors From", expand=True,
        ),
    )
    max_atlases: int = setting(
        0,
        help="Textures that the mesh may be spread over where the photos show more than one holds; "
        "0 is 1, or a few where one of the largest would not do.",
        check=Range(1, MAX_ATLASES, zero="automatic"), unit="textures",
        option=Option(
            "--max-atlases", "N",
            "spread over up to N textures where the photos show more than one holds; 0: automatic",
        ),
        panel=PanelProperty(
            "Max Textures",
            "Textures that a mesh may be spread over where the photos show more than one holds; "
            "0 chooses the number",
            order=20,
        ),
    )
# fmt: on
