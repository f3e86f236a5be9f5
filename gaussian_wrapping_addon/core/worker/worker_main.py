# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry point of every child process: ``python -I worker_main.py MODULE [ARGUMENT ...]``.

Run as a file, never imported. It loads the package that contains this file, without adding the
parent folder (which inside Blender holds every other extension) to ``sys.path``, then calls
``main(arguments)`` of a module named relative to ``core``, such as ``jobs.worker``.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import sys
from pathlib import Path

_PACKAGE = "gaussian_wrapping_addon"
_OLDEST = (3, 11)
"""Oldest version of Python that can read the package."""


def _add_packages() -> None:
    """Put the folder of ``-X gwrap_packages=DIR`` before the interpreter's own packages."""
    folder = sys._xoptions.get("gwrap_packages")
    if isinstance(folder, str):
        own = [i for i, p in enumerate(sys.path) if p.endswith(("site-packages", "dist-packages"))]
        sys.path.insert(own[0] if own else len(sys.path), folder)


def _load_package() -> None:
    root = Path(__file__).resolve().parents[2]
    spec = importlib.util.spec_from_file_location(
        _PACKAGE, root / "__init__.py", submodule_search_locations=[str(root)]
    )
    if spec is None or spec.loader is None:
        raise ImportError(f"{root} holds no package")
    module = importlib.util.module_from_spec(spec)
    sys.modules[_PACKAGE] = module
    spec.loader.exec_module(module)


def _main(module: str, arguments: list[str]) -> int:
    if sys.version_info[:2] < _OLDEST:
        return _refuse(
            f"The worker's Python, {sys.executable}, is version {sys.version.split()[0]}.",
            "Version {}.{} or later is needed: press Set Up Worker, run batch.py set-up-worker, or "
            "name another Python.".format(*_OLDEST),
        )
    _add_packages()
    _load_package()
    try:
        called = importlib.import_module(f"{_PACKAGE}.core.{module}").main
    except ImportError as error:
        named = importlib.import_module(f"{_PACKAGE}.core.worker.environment")
        missing = named.package_error(error)
        if missing is None:
            raise
        return _refuse(missing.message, missing.hint, missing.exit_code)
    return int(called(arguments))


def _refuse(error: str, hint: str, code: int = 1) -> int:
    """Report an error as commands, helpers and workers do: one JSON line on stdout."""
    sys.stdout.write(json.dumps({"error": error, "hint": hint}) + "\n")
    return code


if __name__ == "__main__":
    if len(sys.argv) < 2 or not re.fullmatch(r"[a-z_]+(\.[a-z_]+)*", sys.argv[1]):
        sys.exit(2)
    # The folder of this file would shadow the standard library (a module named ``types``, say).
    sys.path[:] = [
        p for p in sys.path if p and Path(p).resolve() != Path(__file__).resolve().parent
    ]
    sys.exit(_main(sys.argv[1], sys.argv[2:]))
