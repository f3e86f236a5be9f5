# SPDX-License-Identifier: GPL-3.0-or-later
"""Retry a training with reduced settings after it runs out of memory."""

from __future__ import annotations

import contextlib
import gc
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from ...errors import ParseError, ResourceError
from ...files import read_json, write_json
from ...report_warning import ReportWarning
from ...settings import MeshingSettings, TrainingSettings

_logger = logging.getLogger(__name__)

MAX_RETRIES = 2
GAUSSIANS_FACTOR = 0.6
IMAGE_FACTOR = 0.75
"""Each retry keeps 0.6 of the Gaussians and 0.56 of the pixels: about half of the memory that
grows with them."""

MIN_GAUSSIANS = 1000
MIN_IMAGE_PX = 96
RETRIES_FILE = "smaller.json"

_TORCH_OOM_MESSAGES = ("out of memory", "can't allocate memory", "not enough memory")

Result = TypeVar("Result")


@dataclass(frozen=True)
class Trained(Generic[Result]):
    """A result with the settings it was finally trained with."""

    result: Result
    settings: TrainingSettings
    warnings: tuple[ReportWarning, ...]
    """One for each retry."""


def is_out_of_memory(error: BaseException) -> bool:
    """Tell whether an error means that memory ran out.

    A :class:`ResourceError` raised by training is a limit of the renderer: too many intersections
    of Gaussians and tiles, or a full GPU.
    """
    if isinstance(error, (MemoryError, ResourceError)):
        return True
    if not isinstance(error, RuntimeError):
        return False
    text = str(error).lower()
    return any(message in text for message in _TORCH_OOM_MESSAGES)


def reduced_settings(settings: TrainingSettings) -> TrainingSettings | None:
    """Return settings with fewer Gaussians and smaller images; ``None`` at the lower bounds."""
    gaussians = max(MIN_GAUSSIANS, round(GAUSSIANS_FACTOR * settings.max_gaussians))
    side_px = max(MIN_IMAGE_PX, round(IMAGE_FACTOR * settings.max_image_px))
    gaussians = min(gaussians, settings.max_gaussians)
    side_px = min(side_px, settings.max_image_px)
    if (gaussians, side_px) == (settings.max_gaussians, settings.max_image_px):
        return None
    return replace(settings, max_gaussians=gaussians, max_image_px=side_px)


def train_with_oom_retry(
    train: Callable[[TrainingSettings], Result],
    settings: TrainingSettings,
    folder: Path,
    discard_checkpoints: Callable[[], None],
) -> Trained[Result]:
    """Train; after running out of memory, train again with reduced settings, at most twice.

    The retries are recorded in the folder, so that an interrupted run resumes with the same
    settings.

    Parameters
    ----------
    train : callable
        Takes the settings; trains from the start or the last checkpoint.
    settings : TrainingSettings
        The requested settings.
    folder : Path
        Of the training stage.
    discard_checkpoints : callable
        Removes the checkpoints of the failed attempt, which fit no other settings.

    Raises
    ------
    ResourceError
        The last retry also ran out of memory. Other exceptions of ``train`` propagate.
    """
    reasons = _read_retries(folder)
    for _ in reasons:
        settings = reduced_settings(settings) or settings
    while True:
        try:
            result = train(settings)
            warnings = tuple(ReportWarning("memory-step-down", reason) for reason in reasons)
            return Trained(result, settings, warnings)
        except (MemoryError, ResourceError, RuntimeError) as error:
            # Keep only the text: the exception would hold the memory of the failed training.
            if not is_out_of_memory(error):
                raise
            reduced = reduced_settings(settings)
            if reduced is None or len(reasons) >= MAX_RETRIES:
                raise ResourceError(
                    f"Memory did not suffice, even with at most {settings.max_gaussians} Gaussians "
                    f"and photos of {settings.max_image_px} px ({_first_line(error)}).",
                    "Close other programs, or choose a smaller preset.",
                ) from error
            reasons.append(_reason(error, settings, reduced))
        _logger.warning("%s", reasons[-1])
        discard_checkpoints()
        write_json(folder / RETRIES_FILE, {"reasons": reasons})
        gc.collect()
        settings = reduced


@contextlib.contextmanager
def within_memory(what: str) -> Iterator[None]:
    """Turn running out of memory into an error with the next step, for a part of a training.

    Raises
    ------
    ResourceError
        Memory did not suffice: the part may work elsewhere.
    """
    try:
        yield
    except (MemoryError, ResourceError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise ResourceError(
            f"{what} ran out of memory ({_first_line(error)}).",
            "Choose more --blocks, fewer --max-gaussians or a smaller --max-image-px; or close "
            "other programs and resume.",
        ) from error


def _reason(error: BaseException, before: TrainingSettings, after: TrainingSettings) -> str:
    return (
        f"Memory did not suffice ({_first_line(error)}): trained again with at most "
        f"{after.max_gaussians} Gaussians and photos of {after.max_image_px} px, instead of "
        f"{before.max_gaussians} and {before.max_image_px} px."
    )


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


def _read_retries(folder: Path) -> list[str]:
    try:
        values: Any = read_json(folder / RETRIES_FILE)
        return [str(reason) for reason in values["reasons"]][:MAX_RETRIES]
    except (OSError, ParseError, KeyError, TypeError):
        return []


def killed_hint(settings: TrainingSettings) -> str:
    """Return the hint for a training worker that the system killed, probably for its memory."""
    reduced = reduced_settings(settings)
    number = settings.max_gaussians if reduced is None else reduced.max_gaussians
    return (
        "Close other programs and resume, which continues from the last checkpoint; or resume with "
        f"--max-gaussians {number}, which trains anew with fewer."
    )


def killed_mesh_hint(meshing: MeshingSettings, *, kept: bool) -> str:
    """Return the hint for a killed worker that was meshing or texturing.

    Parameters
    ----------
    kept : bool
        Whether the folder has the result of an earlier job.
    """
    alternatives = "fewer --points, a larger --edge-length, or --tiles N with more tiles"
    if meshing.method == "pivots":
        alternatives = "a smaller region, or --method pam with fewer --points"
    elif meshing.tiles == "auto":
        alternatives = "fewer --points, a larger --edge-length, or --tiles N"
    unchanged = " The earlier result is unchanged." if kept else ""
    return f"Close other programs and resume; or use mesh with {alternatives}.{unchanged}"
