# SPDX-License-Identifier: GPL-3.0-or-later
"""Options that become texture settings besides the size: source, maps and levels of detail."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any


def add_texture_options(parser: ArgumentParser) -> None:
    """Add where colours come from, and what a mesh is given besides."""
    from ..core.settings import DECISIONS, TEXTURE_SOURCES, TextureSettings

    default = TextureSettings()
    parser.add_argument(
        "--texture-source",
        choices=TEXTURE_SOURCES,
        default=default.source,
        help="colours of the photos, or of the Gaussians without what changes with direction",
    )
    parser.add_argument(
        "--normal-map",
        choices=DECISIONS,
        default=default.normal_map,
        help="of the dense mesh's detail; auto bakes it where --faces took faces away",
    )
    parser.add_argument(
        "--max-atlases",
        type=int,
        default=default.max_atlases,
        metavar="N",
        help="spread over up to N textures where the photos show more than one holds; 0: automatic",
    )
    parser.add_argument(
        "--ambient-occlusion", action="store_true", help="bake how open the surface is"
    )
    parser.add_argument(
        "--lods",
        type=int,
        default=default.lods,
        metavar="N",
        help="coarser levels below the mesh, each with a quarter of the faces",
    )


def texture_settings(options: Namespace) -> dict[str, Any]:
    """Return the texture settings that :func:`add_texture_options` was given."""
    return {
        "source": options.texture_source,
        "normal_map": options.normal_map,
        "ambient_occlusion": "on" if options.ambient_occlusion else "off",
        "lods": options.lods,
        "max_atlases": options.max_atlases,
    }
