# SPDX-License-Identifier: GPL-3.0-or-later
"""Every row of the suite: exit code, message, time, memory, and nothing left or read outside.

``docs/hostile-input.md`` is the table that ``python -m tests.hostile.table`` makes of them.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.hostile.all_cases import rows
from tests.hostile.case import Way
from tests.hostile.run_case import LIMIT_S, MEMORY_LIMIT_BYTES, run_variant

ROWS = rows()


@pytest.mark.parametrize("row", ROWS)
def test_it_ends_as_the_table_says(row: str, tmp_path: Path) -> None:
    variant = ROWS[row]
    if variant.needs is not None and not variant.needs.met():
        pytest.skip(variant.needs.value)
    ended = run_variant(variant, tmp_path)
    assert "Traceback" not in ended.output + ended.errors, ended.output + ended.errors
    assert ended.code == variant.code, ended.output
    assert ended.line(variant.says), ended.output
    assert ended.errors == ""
    assert not re.search(r"[^\n\t -~\u00a0-\U0010ffff]", ended.output), "control characters"
    assert ended.left == []
    assert ended.outside == []
    assert variant.starts or ended.started == []
    assert ended.memory_bytes < MEMORY_LIMIT_BYTES
    if variant.way in (Way.PROCESS, Way.TERMINAL):
        assert ended.seconds < LIMIT_S
