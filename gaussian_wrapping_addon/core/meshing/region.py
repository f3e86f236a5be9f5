# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions of interest: the body, its file, and the automatic choices."""

from __future__ import annotations

from .automatic_region import automatic_region, whole_region
from .convex_region import Region
from .region_file import parse_region, read_region, write_region

__all__ = [
    "Region",
    "automatic_region",
    "parse_region",
    "read_region",
    "whole_region",
    "write_region",
]
