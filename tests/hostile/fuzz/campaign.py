# SPDX-License-Identifier: GPL-3.0-or-later
"""Change good inputs by chance and see that each ends well or in a typed error."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.errors import WrapError
from gaussian_wrapping_addon.core.worker.helper_process import own_peak_bytes
from tests.hostile.fuzz.targets import Target
from tests.hostile.run_case import (
    MEMORY_LIMIT_BYTES,
    TimeLimitError,
    reset_peak_memory,
    within,
)

LIMIT_S = 10.0
"""Of one reading."""


@dataclass
class Report:
    """What a campaign found."""

    target: str
    inputs: int = 0
    ended: Counter[str] = field(default_factory=Counter)
    """Number of readings by how they ended: ``"read"``, or the type of the error."""
    failures: list[str] = field(default_factory=list)


@contextlib.contextmanager
def _good_input(target: Target) -> Iterator[tuple[Path, list[Path]]]:
    with tempfile.TemporaryDirectory(prefix="fuzz-", ignore_cleanup_errors=True) as place:
        folder = Path(place)
        target.build(folder)
        yield folder, [path for name in target.files for path in sorted(folder.glob(name))]


def fuzz(
    target: Target, seed: int, *, first: int = 0, inputs: int | None = None, seconds: float = 0.0
) -> Report:
    """Read changed inputs; each depends on the seed and its number alone.

    Parameters
    ----------
    first : int
        Number of the first changed input.
    inputs : int, optional
        How many; ``None``: as many as ``seconds`` allow.

    Returns
    -------
    Report
        ``failures`` tell how to repeat them.
    """
    report = Report(target.name)
    end_s = time.monotonic() + seconds
    with _good_input(target) as (folder, files), _quiet():
        good = {path: path.read_bytes() for path in files}
        for read in target.reads:
            read(folder)
        number = first
        while number < first + inputs if inputs is not None else time.monotonic() < end_s:
            random = np.random.default_rng([seed, number])
            path = files[int(random.integers(len(files)))]
            mutation = target.mutations[int(random.integers(len(target.mutations)))]
            with contextlib.suppress(json.JSONDecodeError):  # the file is no JSON
                path.write_bytes(mutation(good[path], random))
            for read in target.reads:
                problem = _read(read, folder, report)
                if problem:
                    repeat = f"--only {target.name} --seed {seed} --first {number} --inputs 1"
                    report.failures.append(f"{path.name}, {mutation.__name__}: {problem}\n{repeat}")
            for one, content in good.items():  # what reads may have put back or moved
                one.write_bytes(content)
            report.inputs += 1
            number += 1
    return report


def _read(read: object, folder: Path, report: Report) -> str:
    """Read the input; return what is wrong about how that ended, or nothing."""
    held_bytes = reset_peak_memory()
    ended, problem = "read", ""
    try:
        with within(LIMIT_S):
            read(folder)  # type: ignore[operator]
    except WrapError as error:
        ended = type(error).__name__
        if not error.hint:
            problem = f"no next step: {error}"
    except (Exception, TimeLimitError) as error:
        ended = type(error).__name__
        problem = f"{ended}: {error} ({_place(error)})"
    report.ended[ended] += 1
    if held_bytes and own_peak_bytes() - held_bytes > MEMORY_LIMIT_BYTES:
        problem = f"{(own_peak_bytes() - held_bytes) / 2**20:.0f} MB. {problem}"
    return problem


def _place(error: BaseException) -> str:
    """Return the last place in the package that a traceback passes."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "gaussian_wrapping_addon" in frame.filename] or frames
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno} in {ours[-1].name}"


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Raise Python's warnings, which users would see; log nowhere."""
    nowhere = logging.NullHandler()
    logging.getLogger().addHandler(nowhere)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        logging.getLogger().removeHandler(nowhere)
