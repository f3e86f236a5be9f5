# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder of tiny wheels, a short list of packages, and a request for an environment."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.jobs.install import SetupRequest, probe
from gaussian_wrapping_addon.core.worker.environment import DATA_VARIABLE
from tests.core.setup.wheels import write_wheel


@pytest.fixture(autouse=True)
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's data folder of one test."""
    folder = tmp_path / "data"
    monkeypatch.setenv(DATA_VARIABLE, str(folder))
    return folder


@pytest.fixture
def request_(tmp_path: Path) -> SetupRequest:
    """A set-up of two packages, one of which needs a third, below a path with odd letters."""
    home = tmp_path / "Zoë's 机 folder"
    write_wheel(home / "wheels", "gwalpha", "1.2", "gwgamma>=1")
    write_wheel(home / "wheels", "gwbeta", "0.9")
    write_wheel(home / "wheels", "gwgamma", "1.0")
    requirements = home / "requirements.txt"
    requirements.write_text("# two\ngwalpha==1.2\ngwbeta>=0.5,<1  # a range\n")
    return SetupRequest(
        str(home / "worker"), sys.executable, str(requirements), "cpu", str(home / "wheels")
    )


@pytest.fixture
def quick(request_: SetupRequest, tmp_path: Path) -> SetupRequest:
    """The same from a Python that says it has no venv: quick, as no pip is installed."""
    real = probe(sys.executable).path
    launcher = tmp_path / "python3"
    said = {
        "version": list(sys.version_info[:3]), "base": str(launcher),
        "is_64_bit": True, "venv": False, "pip": True, "ensurepip": True,
    }  # fmt: skip
    launcher.write_text(
        f"#!/bin/sh\ncase \"$*\" in *_base_executable*) echo '{json.dumps(said)}'; exit;; esac\n"
        f'exec "{real}" "$@"\n'
    )
    launcher.chmod(0o755)
    return replace(request_, python=str(launcher))
