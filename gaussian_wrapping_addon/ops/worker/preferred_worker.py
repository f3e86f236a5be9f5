# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of the worker in the add-on's preferences."""

from __future__ import annotations

from dataclasses import dataclass

import bpy

from ...core.settings import declared
from ..common.addon import addon_preferences


@dataclass(frozen=True)
class WorkerChoice:
    """Settings of the worker in the add-on's preferences; never read from a .blend file."""

    python: str = ""
    threads: int = 0
    keep_running: bool = False
    device: str = "auto"


def worker_choice(context: bpy.types.Context) -> WorkerChoice:
    """Read the add-on's preferences; defaults if it is not enabled as an add-on."""
    preferences = addon_preferences(context)
    if preferences is None:
        return WorkerChoice()
    python = bpy.path.abspath(preferences.worker_python) if preferences.worker_python else ""
    device = declared("device").from_panel(preferences.device)
    return WorkerChoice(python, preferences.threads, preferences.keep_running, device)
