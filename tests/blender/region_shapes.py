# SPDX-License-Identifier: GPL-3.0-or-later
"""What the region objects of a file stand for."""

from __future__ import annotations

import bpy
import numpy as np

from gaussian_wrapping_addon.ops.region_objects import region_body


def region_from_object(thing: bpy.types.Object) -> np.ndarray:
    """Return the (n, 3) float64 hull of a region object in the world of the input."""
    return np.array(region_body(thing)["vertices"])
