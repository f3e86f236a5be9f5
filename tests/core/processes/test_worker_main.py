# SPDX-License-Identifier: GPL-3.0-or-later
"""The entry point of child processes loads the package independent of the environment."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from gaussian_wrapping_addon.core.worker.helper_process import child_command
from gaussian_wrapping_addon.core.worker.spawn import child_environment


def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        child_command(*arguments),
        cwd=cwd,
        capture_output=True,
        env=child_environment(),
        check=False,
    )


def test_a_module_is_found_from_any_folder(tmp_path: Path) -> None:
    done = run("jobs.commands.doctor", cwd=tmp_path)
    assert b'"subject": "Python"' in done.stdout, done.stderr.decode()


def test_names_that_are_no_modules_are_refused(tmp_path: Path) -> None:
    for name in ("../x", "os;1", "", "Jobs", "a..b"):
        assert run(name, cwd=tmp_path).returncode == 2


def test_the_command_is_isolated() -> None:
    command = child_command("jobs.commands.doctor")
    assert command[:2] == [sys.executable, "-I"]
