# SPDX-License-Identifier: GPL-3.0-or-later
"""What ``check`` passes, the first stage of a job loads: for every data set of the suite."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.loading.source_kind import source_kind
from tests.hostile.all_cases import rows
from tests.hostile.case import Variant, Way
from tests.hostile.run_case import run_variant
from tests.hostile.surroundings import CASE, make_place

PASSED = {
    row: variant
    for row, variant in rows().items()
    if variant.words == ("check", "set") and variant.way is Way.HERE and variant.code == 0
}


def needs_no_solving(variant: Variant, place: Path) -> bool:
    """Tell whether a data set has poses: solving them takes long, and noise has none."""
    folder = make_place(place)
    variant.build(folder)
    return source_kind(folder / "set").kind != "photos"


@pytest.mark.parametrize("row", PASSED)
def test_what_check_passes_is_loaded(row: str, tmp_path: Path) -> None:
    variant = PASSED[row]
    if variant.needs is not None and not variant.needs.met():
        pytest.skip(variant.needs.value)
    if not needs_no_solving(variant, tmp_path / "look"):
        pytest.skip("poses would be solved, of photos that show noise")
    loading = replace(variant, way=Way.LOADING, writes=("out",), starts=True)
    ended = run_variant(loading, tmp_path / "load")
    assert ended.code == 0, ended.output
    assert "points are ready" in ended.output
    assert ended.errors == ""
    assert ended.left == []
    assert (tmp_path / "load" / CASE / "out" / "stages").is_dir()
