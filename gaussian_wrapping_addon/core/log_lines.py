# SPDX-License-Identifier: GPL-3.0-or-later
"""Text from files in log and terminal: one line each, nothing that a terminal would obey.

Names of regions, photos and files come from elsewhere. A newline in one would forge a line of the
log, and an escape sequence could rewrite the screen or paste commands.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
from types import TracebackType
from typing import IO, TypeAlias

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

    Parameters
    ----------
    stream : file of text or None
        ``None`` where a program has none (a window without a console): nothing is written.
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
