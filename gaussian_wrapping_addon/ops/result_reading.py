# SPDX-License-Identifier: GPL-3.0-or-later
"""Read a result folder in a thread, so that Blender goes on meanwhile."""

from __future__ import annotations

import threading
from pathlib import Path

from .result_files import ResultFiles, read_result


class ResultReading:
    """A result folder that is being read; what is read is plain arrays, nothing of Blender."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: ResultFiles | None = None
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        try:
            self._files = read_result(self._folder)
        except Exception as failure:  # raised where somebody waits for it
            self._failure = failure

    def finished(self) -> bool:
        """Tell whether :meth:`files` has an answer; never waits."""
        return not self._thread.is_alive()

    def files(self) -> ResultFiles:
        """Return what was read.

        Raises
        ------
        DatasetError, ParseError
            The folder does not hold a sound result.
        """
        self._thread.join()
        if self._files is None:
            raise self._failure or RuntimeError("the reading has ended without a word")
        return self._files
