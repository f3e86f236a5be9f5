# SPDX-License-Identifier: GPL-3.0-or-later
"""Rename the ``scene.blend`` of a result when it no longer matches the result.

It is written outside of the worker, which has no Blender, and only on request.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

from ... import limits
from ...regular_files import read_bounded

_logger = logging.getLogger("gaussian_wrapping")

NAME = "scene.blend"
EARLIER = "scene.blend1"
"""Blender's name for the previous version, which may hold a user's additions."""


def result_state(result: Path) -> dict[str, bytes]:
    """Return the content of each region's figures file, by region: it identifies a result."""
    return {
        path.parent.name: read_bounded(path, limits.MAX_JSON_BYTES)
        for path in sorted(result.glob("*/figures.json"))
    }


def back_up_stale_blend(result: Path, before: dict[str, bytes]) -> bool:
    """Rename ``scene.blend`` if the result has changed; tell whether it was renamed.

    Parameters
    ----------
    before : dict
        :func:`result_state` from when the file was up to date.
    """
    blend = result / NAME
    if not blend.is_file() or result_state(result) == before:
        return False
    os.replace(blend, result / EARLIER)
    _logger.info("%s showed the previous result and was renamed to %s", NAME, EARLIER)
    return True
