# SPDX-License-Identifier: GPL-3.0-or-later
"""Peak memory is that of the process itself, not of its parent."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from gaussian_wrapping_addon.core.worker.helper_process import peak_memory_bytes
from gaussian_wrapping_addon.core.worker.spawn import child_environment

PRINT_PEAKS = (
    "import json, sys\n"
    "sys.path[:0] = json.loads(sys.argv[1])\n"
    "from gaussian_wrapping_addon.core.worker.helper_process import peak_memory_bytes\n"
    "print(json.dumps(peak_memory_bytes()))\n"
)


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="elsewhere it includes the parent's"
)
def test_a_small_child_of_a_large_parent_is_small() -> None:
    held = b"x" * (300 * 2**20)
    done = subprocess.run(
        [sys.executable, "-c", PRINT_PEAKS, json.dumps(sys.path)],
        capture_output=True, check=True, env=child_environment(),
    )  # fmt: skip
    child = json.loads(done.stdout)
    assert 2**20 < child["worker"] < len(held) < peak_memory_bytes()["worker"]
    assert child["largest_helper"] == 0
