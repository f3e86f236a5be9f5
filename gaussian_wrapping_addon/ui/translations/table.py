# SPDX-License-Identifier: GPL-3.0-or-later
"""Give Blender the table of translated texts: ``table.json``, a line for each language.

Errors and findings come from the worker and are in English.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import bpy

from ...ops.addon import CONTEXT, addon_package

_logger = logging.getLogger(__name__)

TABLE: Final = Path(__file__).with_name("table.json")
CONTEXTS: Final = (CONTEXT, "*")
"""Blender looks descriptions of classes up without a context."""

Translations = dict[str, dict[tuple[str, str], str]]
"""By language: context and English text -> translated text."""


def translations() -> Translations:
    """Read the table."""
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    found: Translations = {language: {} for language in table["languages"]}
    for text, translated in table["texts"].items():
        for language, words in zip(table["languages"], translated, strict=True):
            for context in CONTEXTS:
                found[language][context, text] = words
    return found


def use_context(classes: Iterable[type]) -> None:
    """Let Blender look up the texts of classes and of their properties in our context.

    Before they are registered.
    """
    for cls in classes:
        if issubclass(cls, (bpy.types.Panel, bpy.types.Operator, bpy.types.Menu)):
            cls.bl_translation_context = CONTEXT
        for declared in getattr(cls, "__annotations__", {}).values():
            if hasattr(declared, "keywords"):
                declared.keywords["translation_context"] = CONTEXT


def register() -> None:
    """Register the translations; without them, the panel is in English."""
    unregister()
    try:
        bpy.app.translations.register(addon_package(), translations())
    except (OSError, ValueError, KeyError):  # a damaged installation
        _logger.exception("the translations cannot be used")


def unregister() -> None:
    """Remove the translations; harmless where there are none."""
    bpy.app.translations.unregister(addon_package())
