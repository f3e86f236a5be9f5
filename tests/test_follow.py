# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line reports the progress and outcome of a job correctly."""

from __future__ import annotations

import logging
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.command_line import job_commands as module
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.settings import JobSettings


@pytest.mark.parametrize("changed", [False, True])
def test_a_mesh_that_failed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    changed: bool,
) -> None:
    """The job is put back, and its status is that of the finished job, with the error."""
    folder = JobFolder(tmp_path / "out")
    folder.create()
    (tmp_path / "photos").mkdir()
    job = make_job("mesh", tmp_path / "photos", JobSettings())
    write_job(folder.job_path, job)
    figures = folder.result / "box" / "figures.json"
    figures.parent.mkdir(parents=True)
    write_json(figures, {"old": 1})
    finished = JobStatus("DONE", "export", 1.0, seconds_left=0.0)
    folder.write_status(
        replace(finished, error="No surface.", hint="Look.", exit_code=3, put_back=True)
    )

    def statuses() -> Iterator[JobStatus]:
        yield JobStatus("RUNNING", "mesh", 0.8, "meshing")
        if changed:
            write_json(figures, {"new": 1})
        yield JobStatus("FAILED", "export", 1.0, seconds_left=0.0, error="No.", exit_code=3)

    client, said = JobClient.attach(folder.root), statuses()
    monkeypatch.setattr(client, "poll", lambda: next(said))
    monkeypatch.setattr(module, "POLL_S", 0.0)
    monkeypatch.setattr(module._logger, "propagate", True)
    with caplog.at_level(logging.INFO, logger=module._logger.name):
        assert module.follow(client, job, Namespace(no_blend=True)) == 3
    assert "[ 80.0 %] mesh" in caplog.text
    assert "100.0 %" not in caplog.text
    assert "error: No." in caplog.text
    assert ("are unchanged" in caplog.text) == (not changed)
    assert ("its result is not" in caplog.text) == changed
