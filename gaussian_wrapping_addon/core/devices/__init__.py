# SPDX-License-Identifier: GPL-3.0-or-later
"""The device of a job: chosen by its setting, checked by a small rendering, described.

In: the setting ``device``. Out: a :class:`DeviceChoice`, or why a GPU cannot be used. Blender can
load the folder: torch is imported where it is needed, in the worker.
"""

from __future__ import annotations

from .choice import CPU, DeviceChoice, choose_device, reject_absent_gpu, stage_device

__all__ = ["CPU", "DeviceChoice", "choose_device", "reject_absent_gpu", "stage_device"]
