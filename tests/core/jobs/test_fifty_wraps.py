# SPDX-License-Identifier: GPL-3.0-or-later
"""Fifty wraps on two processes, killed twice: all done, with the results that they have alone."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import EXIT_DONE
from tests.core.jobs.killed_queue import (
    apart,
    carry_out,
    command_of,
    files_of,
    left_behind,
    table_of,
    wrap_alone,
    write_photo_sets,
    write_things_region,
)

WRAPS, SEED, COMPARED = 50, 0, 6


@pytest.mark.proof
@pytest.mark.timeout(3 * 3600)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are read in /proc")
def test_a_queue_that_is_killed_twice_ends_with_the_results_of_single_wraps(
    tmp_path: Path,
) -> None:
    sets, out = tmp_path / "sets", tmp_path / "jobs"
    names = write_photo_sets(sets, WRAPS, SEED)
    region = write_things_region(tmp_path / "things.json")
    wrap_alone(sets / names[0], tmp_path / "warm", region)  # compiles kernels
    course = carry_out(command_of(sets, out, region), out, names, SEED)
    assert course.first_code != EXIT_DONE  # it was killed
    assert course.second_code == EXIT_DONE
    assert course.left == ()
    assert "Traceback" not in course.said
    rows = table_of(out)
    assert [row["name"] for row in rows if row["state"] != "done"] == []
    assert len(rows) == WRAPS
    assert left_behind(out, tmp_path / "temporary") == []
    wanted = files_of(tmp_path / "warm")
    assert wanted
    assert [name for name in names if files_of(out / name) != wanted] == []
    struck = [name for strike in course.strikes for name in strike.stages]
    others = np.random.default_rng(SEED).permutation(names).tolist()
    for name in list(dict.fromkeys([*struck, *others]))[: max(COMPARED, len(struck))]:
        wrap_alone(sets / name, tmp_path / "alone" / name, region)
        items, found = apart(out / name, tmp_path / "alone" / name)
        assert items > 100
        assert found == [], name
