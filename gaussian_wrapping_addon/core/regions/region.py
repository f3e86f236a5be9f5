# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write regions; re-exports the region class and the automatic regions."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MeshingError, ParseError
from .automatic_region import automatic_region, whole_region
from .convex_region import Region
from .region_file import RegionFile, parse_region_file, read_region_body, write_region_file

__all__ = [
    "Region",
    "automatic_region",
    "parse_region",
    "read_region",
    "whole_region",
    "write_region",
]

_logger = logging.getLogger(__name__)


def read_region(path: Path) -> Region:
    """Read a region file; the region is in world coordinates.

    Raises
    ------
    DatasetError
        There is no file, or it cannot be read.
    ParseError
        Names the file, the entry and what to do.
    """
    return parse_region(read_region_body(path), path)


def parse_region(values: Any, path: Path) -> Region:
    """Build a region from JSON values; ``path`` is used in errors only.

    Raises
    ------
    ParseError
    """
    file = parse_region_file(values, path)
    try:
        region = Region(file.name, file.vertices)
    except MeshingError as error:
        raise ParseError(path, "vertices", error.message, error.hint) from None
    _warn_about_inner_corners(region, file, path)
    return region


def _warn_about_inner_corners(region: Region, file: RegionFile, path: Path) -> None:
    used = len(np.unique(region.simplices))
    if used < len(file.vertices):
        _logger.warning(
            "%s: %d of %d corners lie inside the convex hull; the hull is used",
            path.name, len(file.vertices) - used, len(file.vertices),
        )  # fmt: skip


def write_region(path: Path, region: Region) -> None:
    """Write a region file atomically; the region must be in world coordinates."""
    write_region_file(path, region.name, region.vertices, region.simplices)
