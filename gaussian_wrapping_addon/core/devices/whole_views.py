# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole views on a job's device, or on the processor where that fails. Worker only: loads torch."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from ..render.types.renderer import Renderer
from ..render.view_renderer import ViewRenderer
from .choice import CPU
from .failures import is_device_failure

_logger = logging.getLogger(__name__)

Made = TypeVar("Made")


def with_renderer(device: str, what: str, work: Callable[[Renderer], Made]) -> Made:
    """Return what work makes of the renderer of a device.

    Where the GPU fails, the log says why, and the work is done again from its beginning with the
    renderer of the processor.

    Parameters
    ----------
    device : str
        ``"cpu"`` or ``"cuda:N"``.
    what : str
        What is rendered, for the log; a plural that begins a sentence.
    work : callable
        Keeps nothing of a call that has failed.
    """
    if device == CPU:
        return work(ViewRenderer())
    from ..render.cuda.device_renderer import device_renderer

    try:
        renderer = device_renderer(device)
        try:
            return work(renderer)
        finally:
            renderer.release()
    except Exception as error:
        if not is_device_failure(error):
            raise
        lines = str(getattr(error, "message", error)).strip().splitlines()
        reason = lines[0] if lines else type(error).__name__
        _logger.warning("%s are rendered on the processor, not on the GPU: %s", what, reason)
    return work(ViewRenderer())
