# SPDX-License-Identifier: GPL-3.0-or-later
"""``blender --command gwrap ...``: the command line of ``batch.py``, from the installed add-on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

NAME = "gwrap"

_handle: Any = None


def register(main: Callable[[list[str], str], int]) -> None:
    """Register the command with Blender, once.

    ``main``: takes the arguments and the name of the program, runs one command, returns its exit
    code.
    """
    global _handle
    if _handle is None:

        def run(arguments: list[str]) -> int:
            return main(list(arguments), f"blender --command {NAME}")

        _handle = bpy.utils.register_cli_command(NAME, run)


def unregister() -> None:
    """Unregister the command if it is registered."""
    global _handle
    if _handle is not None:
        bpy.utils.unregister_cli_command(_handle)
        _handle = None
