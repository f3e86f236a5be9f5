# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussian Wrapping: photos in, textured and UV-unwrapped meshes out, inside Blender."""

from __future__ import annotations


def register() -> None:
    """Register the add-on with Blender."""
    from . import registration

    registration.register()


def unregister() -> None:
    """Remove everything that :func:`register` added."""
    from . import registration

    registration.unregister()
