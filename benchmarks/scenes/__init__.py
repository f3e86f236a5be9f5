# SPDX-License-Identifier: GPL-3.0-or-later
"""Ground-truth scenes: exact geometry and cameras, photos by Blender's Cycles, made on first use.

``python -m benchmarks.scenes all`` renders them; programs call :func:`ensure_scene`. Scenes with
role "test" are reported and nothing may be tuned on them; "development" scenes are for that.
"""

from __future__ import annotations

from .cache import ALL_KINDS, ensure_scene
from .catalogue import KINDS, SceneKind

__all__ = ["ALL_KINDS", "KINDS", "SceneKind", "ensure_scene"]
