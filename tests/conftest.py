# SPDX-License-Identifier: GPL-3.0-or-later
"""No test sees or changes the worker that the person who runs it has set up."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile

_DATA = "GAUSSIAN_WRAPPING_DATA"

_folder = tempfile.mkdtemp(prefix="gwrap-data-")
os.environ[_DATA] = _folder
atexit.register(shutil.rmtree, _folder, ignore_errors=True)
