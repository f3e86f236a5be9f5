# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of a job's engine: on which processes and computers its parts run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from .checks import Condition, Range
from .choices import COMPUTERS, MAX_PROCESSES
from .declaration import Option, PanelProperty, setting

LOCAL = "local"
"""A cluster of this computer, made for a job and gone with it."""


def computers_setting() -> Any:
    """Return the declaration of ``computers``."""
    return setting(
        "",
        help="What runs the parts of a job. Empty: this process, one after another; local: several "
        "processes of this computer; tls://HOST:PORT: the computers of a Dask scheduler.",
        check=Condition(
            lambda value: re.fullmatch(COMPUTERS, value) is not None,
            "local or tls://HOST:PORT",
        ),
        option=Option(
            "--computers",
            "local|tls://HOST:PORT",
            "run parts side by side: in processes of this computer, or at a Dask scheduler's",
            scope="region",
        ),
        affects_result=False,
        since="0.2.0",
    )


def processes_setting() -> Any:
    """Return the declaration of ``processes``."""
    return setting(
        2,
        help="Parts that run side by side on this computer.",
        check=Range(1, MAX_PROCESSES),
        unit="processes",
        option=Option(
            "--processes", help="parts side by side with --computers local", scope="region"
        ),
        panel=PanelProperty(
            "Processes",
            "Parts of a job that run side by side on this computer, each with its own memory",
            default=1,
            owner="scene",
            panel_name="computers",
            soft_high=8,
        ),
        affects_result=False,
        since="0.2.0",
    )


def certificates_setting() -> Any:
    """Return the declaration of ``certificates``."""
    return setting(
        "",
        help="Folder of the certificates for tls:// addresses; empty: the one that the environment "
        "variable GW_CERTIFICATES names.",
        option=Option(
            "--certificates",
            "DIR",
            "certificates for tls:// addresses",
            scope="region",
            parse=lambda text: str(Path(text)),
        ),
        affects_result=False,
        since="0.2.0",
    )
