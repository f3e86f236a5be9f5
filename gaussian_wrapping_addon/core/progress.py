# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job says while it runs: progress, log lines, warnings for the report."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from types import TracebackType
from typing import IO, Any, TypeAlias

from .errors import Cancelled

# -- Progress reports with remaining time, and cooperative cancellation ---------------------------


COMPILING = "compiling"
"""Phase in which kernels are compiled: no Python code runs that could poll for cancellation, and
nothing is lost if the process ends at once."""


@dataclass(frozen=True)
class ProgressEvent:
    """One progress report: fraction in [0, 1] of the stage, a short message, optional figures."""

    stage: str
    fraction: float
    message: str
    figures: dict[str, float] = field(default_factory=dict)
    seconds_left: float | None = None
    phase: str = ""  # phase for programs, such as :data:`COMPILING`


class Progress:
    """Progress of a span of one stage; :meth:`span` returns a sub-span for a callee.

    The ``sink`` receives each :class:`ProgressEvent`; ``is_cancelled`` is polled by :meth:`check`,
    which raises :class:`Cancelled` if it returns true.
    """

    def __init__(
        self, stage: str = "", sink: Callable[[ProgressEvent], None] | None = None,
        is_cancelled: Callable[[], bool] | None = None, *, start: float = 0.0, end: float = 1.0,
        begun_s: float | None = None,
    ) -> None:  # fmt: skip
        self.stage, self._sink, self._is_cancelled = stage, sink, is_cancelled
        self._start, self._end = start, end
        self._begun_s = time.monotonic() if begun_s is None else begun_s

    def span(self, start: float, end: float) -> Progress:
        """Return the part [start, end] of this span, for a callee."""
        width = self._end - self._start
        return Progress(
            self.stage, self._sink, self._is_cancelled, start=self._start + width * start,
            end=self._start + width * end, begun_s=self._begun_s,
        )  # fmt: skip

    def cancelled(self) -> bool:
        """Return whether the user cancelled, without raising."""
        return self._is_cancelled is not None and self._is_cancelled()

    def check(self) -> None:
        """Raise :class:`Cancelled` if the user cancelled."""
        if self.cancelled():
            raise Cancelled()

    def update(self, fraction: float, message: str = "", **figures: float) -> None:
        """Report ``fraction`` of this span as done, then check for cancellation."""
        self._report(fraction, message, figures)

    def enter(self, phase: str, message: str) -> None:
        """Report the start of a phase, lasting until the next report; check for cancellation."""
        self._report(0.0, message, {}, phase)

    def _report(
        self, fraction: float, message: str, figures: dict[str, float], phase: str = ""
    ) -> None:
        if self._sink is not None:
            local = min(max(fraction, 0.0), 1.0)
            overall = self._start + (self._end - self._start) * local
            elapsed_s = time.monotonic() - self._begun_s
            left_s = elapsed_s * (1.0 - overall) / overall if overall > 0.01 else None
            self._sink(ProgressEvent(self.stage, overall, message, dict(figures), left_s, phase))
        self.check()


# -- Text from files in log and terminal: one line each, nothing that a terminal would obey -------
#
# Names of regions, photos and files come from elsewhere. A newline in one would forge a line of
# the log, and an escape sequence could rewrite the screen or paste commands.


_ExcInfo: TypeAlias = (
    tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]
)

# Control characters but the tab, line separators, marks that turn the direction of text, and lone
# surrogates, which no encoding can write.
_UNSAFE = re.compile(
    r"[\x00-\x08\x0a-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
TRACEBACK_MARK = "| "
"""Begins each line of a traceback, so that none looks like a message."""


def one_line(text: str) -> str:
    """Return text with control characters written as Python would, such as ``\\n``."""
    return _UNSAFE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class LineFormatter(logging.Formatter):
    """A formatter whose messages are one line each; tracebacks follow, each line marked."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as text."""
        record.exc_text = None  # may have been made by the formatter of another handler
        return super().format(record)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - a name of logging
        """Return the record's own line."""
        record.message = one_line(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: _ExcInfo) -> str:  # noqa: N802
        """Return a traceback, each line marked."""
        return _marked(super().formatException(ei))

    def formatStack(self, stack_info: str) -> str:  # noqa: N802
        """Return a stack, each line marked."""
        return _marked(super().formatStack(stack_info))


def write_text(stream: IO[str], text: str) -> None:
    """Write and flush text; characters that the stream's encoding lacks become codes.

    Raises
    ------
    OSError, ValueError
        The stream cannot be written, or is closed.
    """
    encoding = getattr(stream, "encoding", None) or "utf-8"
    stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
    stream.flush()


class TerminalHandler(logging.Handler):
    """Write records to a terminal, a pipe or a file; after a failure, which is kept, no more.

    Without a stream, as in a program with a window but no console, nothing is written.
    """

    def __init__(self, stream: IO[str] | None) -> None:
        super().__init__()
        self._stream = stream
        self.failure: OSError | ValueError | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        self.write(self.format(record) + "\n")

    def write(self, text: str) -> None:
        """Write text, unless an earlier text could not be written."""
        if self._stream is None or self.failure is not None:
            return
        try:
            write_text(self._stream, text)
        except (OSError, ValueError) as error:
            self.failure = error
            _discard_buffer(self._stream)

    def lost(self) -> OSError | None:
        """Return the failure by which output was lost; None if there is none, or no reader."""
        error = self.failure
        return error if isinstance(error, OSError) and not _is_closed_pipe(error) else None


def _is_closed_pipe(error: OSError) -> bool:
    # Windows says EINVAL of a pipe whose reader has ended.
    return isinstance(error, BrokenPipeError) or (os.name == "nt" and error.errno == errno.EINVAL)


def _discard_buffer(stream: IO[str]) -> None:
    """Lead a stream nowhere: else what is left in its buffer fails again when Python ends."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, stream.fileno())
        finally:
            os.close(nowhere)
        stream.flush()


def _marked(text: str) -> str:
    return "\n".join(TRACEBACK_MARK + one_line(line) for line in text.split("\n"))


# -- Structured warnings of the stages, written to the report -------------------------------------


LEFT_OUT_HINT = "Check whether these are needed; if so, export the input again."
UNREADABLE_HINT = "Save these photos again as JPEG or PNG."


@dataclass(frozen=True)
class ReportWarning:
    """A warning about a result: code, text and hint."""

    code: str
    """Stable identifier for programs, such as ``"photos-not-placed"``; empty for texts read from
    version 0.1.0."""
    text: str  # one or more sentences for the user
    hint: str = ""  # What the user can do; empty if nothing is known to help.

    def to_json(self) -> dict[str, str]:
        """Return plain JSON values."""
        return asdict(self)


# Version 0.1.0 stored texts alone, and told what to do by these marks in them.
_HINTS_0_1_0 = (
    ("could not be placed", "Take more photos with more overlap there, or remove blurred ones."),
    ("cannot be read", "Save these photos again as JPEG or PNG."),
    ("start points", "Photos with more texture help, or a COLMAP model with its points."),
    ("points3D", "Export the COLMAP model together with its points."),
    ("held out for measuring", "Take more photos, from all around."),
    ("numbers were not finite", "If the figures below are poor, train again with another seed."),
    ("stand far away", "Check the poses of these cameras."),
    ("stand on one line", "Take photos from other heights and directions too."),
    ("models:", "Take photos that connect the parts, so that one model holds them all."),
    ("left out", "Check whether these are needed; if so, export the input again."),
    ("levels of detail were made", "Ask for fewer (--set lods=N), or for a mesh of more faces."),
    ("ply_file_path", "Put the file where transforms.json says it is."),
)


def read_warnings(values: Any) -> tuple[ReportWarning, ...]:
    """Return the warnings of a JSON list; invalid entries are skipped.

    Entries are :meth:`ReportWarning.to_json` values, or strings as written by version 0.1.0.
    """
    found = []
    for value in values if isinstance(values, list) else []:
        if isinstance(value, str):
            hint = next((hint for mark, hint in _HINTS_0_1_0 if mark in value), "")
            found.append(ReportWarning("", value, hint))
        elif isinstance(value, dict) and isinstance(value.get("text"), str):
            code, hint = (v if isinstance(v := value.get(k), str) else "" for k in ("code", "hint"))
            found.append(ReportWarning(code, value["text"], hint))
    return tuple(found)
