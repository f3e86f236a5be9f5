# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``scene.blend`` of a result: set aside where it shows another result than the one beside it.

It is written outside of the worker, which has no Blender, and only where it is asked for.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

_logger = logging.getLogger("gaussian_wrapping")

NAME = "scene.blend"
EARLIER = "scene.blend1"
"""As Blender calls the version before: it may hold what a person has added."""


def result_state(result: Path) -> dict[str, bytes]:
    """Return what tells one result from another: the figures of each region, by its name."""
    return {path.parent.name: path.read_bytes() for path in sorted(result.glob("*/figures.json"))}


def back_up_stale_blend(result: Path, before: dict[str, bytes]) -> bool:
    """Rename ``scene.blend`` where the result has changed; tell whether it was.

    Parameters
    ----------
    before : dict
        From :func:`result_state`, when the file was up to date.
    """
    blend = result / NAME
    if not blend.is_file() or result_state(result) == before:
        return False
    os.replace(blend, result / EARLIER)
    _logger.info("%s showed the result before this one: it is %s now", NAME, EARLIER)
    return True
