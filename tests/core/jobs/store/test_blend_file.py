# SPDX-License-Identifier: GPL-3.0-or-later
"""A ``scene.blend`` is renamed when the result beside it changes."""

from __future__ import annotations

from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.jobs.store.job_folder import back_up_stale_blend, result_state


@pytest.fixture
def result(tmp_path: Path) -> Path:
    (tmp_path / "ball").mkdir()
    (tmp_path / "ball" / "figures.json").write_text('{"seconds": 1}')
    (tmp_path / "scene.blend").write_bytes(b"first")
    return tmp_path


def test_an_unchanged_result_keeps_its_file(result: Path) -> None:
    before = result_state(result)
    (result / "ball" / "figures.json").write_text('{"seconds": 1}')
    assert not back_up_stale_blend(result, before)
    assert (result / "scene.blend").read_bytes() == b"first"


@pytest.mark.parametrize("region", ["ball", "cap"])
def test_a_changed_and_a_new_region_set_the_file_aside(
    result: Path, region: str, caplog: pytest.LogCaptureFixture
) -> None:
    before = result_state(result)
    (result / region).mkdir(exist_ok=True)
    (result / region / "figures.json").write_text('{"seconds": 2}')
    with caplog.at_level("INFO", "gaussian_wrapping"):
        assert back_up_stale_blend(result, before)
    assert not (result / "scene.blend").exists()
    assert (result / "scene.blend1").read_bytes() == b"first"
    assert "scene.blend1" in caplog.text
    assert not back_up_stale_blend(result, before), "there is none to set aside"
    (result / "scene.blend").write_bytes(b"second")
    assert back_up_stale_blend(result, before)
    assert (result / "scene.blend1").read_bytes() == b"second"


def test_a_folder_without_a_result_is_no_error(tmp_path: Path) -> None:
    assert result_state(tmp_path / "missing") == {}
    assert not back_up_stale_blend(tmp_path / "missing", {})
