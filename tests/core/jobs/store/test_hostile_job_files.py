# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources, start splats and regions that no job can use; tests/hostile has those of job.json."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, UsageError
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, start_fingerprint
from gaussian_wrapping_addon.core.jobs.store.stage_folder import source_fingerprint
from gaussian_wrapping_addon.core.ply import read_ply_header
from gaussian_wrapping_addon.core.regions.files import parse_region_file, region_to_json
from gaussian_wrapping_addon.core.regions.scene_regions import parse_region
from gaussian_wrapping_addon.core.settings import JobSettings


def test_a_whole_disk_is_no_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="cannot be the source"):
        make_job("wrap", Path(tmp_path.anchor), JobSettings())
    monkeypatch.setattr(limits, "MAX_SOURCE_FILES", 3)
    for number in range(3):
        (tmp_path / f"{number}.bak").touch()
    assert source_fingerprint(tmp_path)
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "4.bak").touch()
    with pytest.raises(DatasetError, match="more than 3 files"):
        source_fingerprint(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="Windows has neither")
def test_devices_and_pipes_are_no_splats(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    for path in (Path("/dev/zero"), tmp_path / "pipe.ply"):
        with pytest.raises(DatasetError, match="not a regular file"):
            start_fingerprint(str(path))
        with pytest.raises(ParseError, match="not a regular file"):
            read_ply_header(path, "")
    with pytest.raises(DatasetError, match="cannot be read"):
        start_fingerprint(str(tmp_path / "none.ply"))


def test_what_a_region_file_passes_is_a_region(tmp_path: Path) -> None:
    """Far from the origin a body is flat by rounding alone: said when the file is read."""
    random = np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        offset = random.normal(size=3) * 10.0 ** random.integers(-3, 11)
        size = np.abs(offset).max() * 10.0 ** random.uniform(-16.5, -12.0)
        body = region_to_json("x", offset + size * random.normal(size=(8, 3)))
        try:
            parse_region_file(body, tmp_path / "x.json")
        except ParseError:
            refused += 1
        else:
            assert parse_region(body, tmp_path / "x.json").volume > 0.0
    assert 5 < refused < 290
