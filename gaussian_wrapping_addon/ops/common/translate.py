# SPDX-License-Identifier: GPL-3.0-or-later
"""Texts of the panels in the language of Blender's interface (``ui/translations``)."""

from __future__ import annotations

from typing import Final

import bpy

CONTEXT: Final = "GaussianWrapping"
"""Of our texts: Blender has other meanings for some, such as *Paper*, *Fine* and *Open*."""


def tr(text: str, **values: object) -> str:
    """Return a text of the panel in the interface's language, with its ``{values}`` filled in.

    A text without translation, such as an error of the worker, stays as it is.
    """
    translated = bpy.app.translations.pgettext_iface(text, CONTEXT)
    return translated.format(**values) if values else translated
