# SPDX-License-Identifier: GPL-3.0-or-later
"""Text from files in log and terminal: one line each, nothing that a terminal would obey.

Names of regions, photos and files come from elsewhere. A newline in one would forge a line of the
log, and an escape sequence could rewrite the screen or paste commands.
"""

from __future__ import annotations

import logging
import re
from types import TracebackType
from typing import TypeAlias

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


def _marked(text: str) -> str:
    return "\n".join(TRACEBACK_MARK + one_line(line) for line in text.split("\n"))
