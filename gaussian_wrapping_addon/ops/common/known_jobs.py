# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders used on this machine, so that a .blend from elsewhere opens none.

A .blend file names its job folder. It may come from the internet, and the folder beside it with it:
the folder is read without confirmation only if it was used on this machine before.
"""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path

import bpy

from ...core.errors import WrapError
from ...core.files import read_json, real_path, write_json
from .addon import addon_package

_logger = logging.getLogger(__name__)

MAX_KNOWN = 200
_FILE = "known_jobs.json"
_session: list[str] = []


def remember(folder: Path) -> None:
    """Record a folder that the user has chosen."""
    text = str(real_path(folder))
    if text in _session:
        return
    _session.append(text)
    path = _list_path()
    if path is not None:
        known = [t for t in _stored() if t != text]
        try:
            write_json(path, [*known, text][-MAX_KNOWN:])
        except OSError:
            _logger.exception("cannot write %s", path)


def is_trusted(folder: Path) -> bool:
    """Return whether a folder named by the open file may be read without confirmation."""
    if is_remote(folder):
        return False
    absolute = str(real_path(folder))
    return absolute in _session or absolute in _stored()


def is_named(folder: Path) -> bool:
    """Return whether a folder was used on this machine, by its name alone.

    The folder is not touched: it may be on a network that does not answer. Links are not followed.
    """
    return not is_remote(folder) and (str(folder) in _session or str(folder) in _stored())


def is_remote(folder: Path) -> bool:
    r"""Return whether a path is ``\\server\share``: Windows would send it the user's name."""
    return str(folder).replace("\\", "/").startswith("//")


def _list_path() -> Path | None:
    package = addon_package()
    with contextlib.suppress(ValueError, OSError):  # ValueError: not installed as an extension
        return Path(bpy.utils.extension_path_user(package, create=True)) / _FILE
    return None


def _stored() -> list[str]:
    path = _list_path()
    if path is None or not path.is_file():
        return []
    try:
        values = read_json(path, follow_links=True)
    except (OSError, WrapError):
        return []
    return [v for v in values if isinstance(v, str)] if isinstance(values, list) else []
