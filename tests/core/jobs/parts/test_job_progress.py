# SPDX-License-Identifier: GPL-3.0-or-later
"""The progress of a job: of parts that run here, and of the states of those that run elsewhere."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.jobs.parts import runner
from gaussian_wrapping_addon.core.jobs.parts.graph import Part, new_state, write_state
from gaussian_wrapping_addon.core.jobs.parts.runner import JobProgress
from gaussian_wrapping_addon.core.progress import ProgressEvent

PARTS = {f"block-{k:04d}": Part(f"block-{k:04d}", "block", (), (), 0.2, block=k) for k in range(3)}


def told(sent: list[ProgressEvent]) -> JobProgress:
    progress = JobProgress(sent.append, lambda: False)
    progress.begin(0.8)
    return progress


def test_a_part_that_runs_here_moves_the_job_by_its_share() -> None:
    sent: list[ProgressEvent] = []
    progress = told(sent)
    progress.report(0.5, {}, 2)
    progress.part(PARTS["block-0000"]).update(0.5, "iteration 7", iteration=7.0)
    assert sent[-1].fraction == pytest.approx(0.5 + 0.5 * 0.2 / 0.8)
    assert sent[-1].figures == {"iteration": 7.0}


def test_parts_elsewhere_are_told_by_their_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "STATES_EVERY_S", -1.0)
    sent: list[ProgressEvent] = []
    report = told(sent).side_by_side(tmp_path)
    report(0.25, PARTS, 1)
    assert sent[-1].message == ("block-0000: waits for a computer and 2 more; parts done: 1")
    state = dataclasses.replace(
        new_state("plan", 1), fraction=0.5, message="iteration 9", figures={"psnr": 24.5}
    )
    write_state(tmp_path, "block-0001", state)
    write_state(tmp_path, "block-0002", dataclasses.replace(state, state="DONE", fraction=1.0))
    report(0.25, PARTS, 1)
    assert sent[-1].stage == "train"
    assert sent[-1].message == "block-0001: iteration 9 and 2 more; parts done: 1"
    assert sent[-1].figures == {"psnr": 24.5}
    assert sent[-1].fraction == pytest.approx(0.25 + 0.5 * 0.2 / 0.8)
    report(0.5, {}, 2)
    assert len(sent) == 2, "nothing runs"
