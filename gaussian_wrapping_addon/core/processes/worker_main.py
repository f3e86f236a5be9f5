# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry point of every child process: ``python -I worker_main.py MODULE [ARGUMENT ...]``.

Run as a file, never imported. It loads the package that contains this file, without adding the
parent folder (which inside Blender holds every other extension) to ``sys.path``, then calls
``main(arguments)`` of a module named relative to ``core``, such as ``jobs.worker``.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
from pathlib import Path

_PACKAGE = "gaussian_wrapping_addon"


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


if __name__ == "__main__":
    if len(sys.argv) < 2 or not re.fullmatch(r"[a-z_]+(\.[a-z_]+)*", sys.argv[1]):
        sys.exit(2)
    # The folder of this file would shadow the standard library (a module named ``types``, say).
    sys.path[:] = [
        p for p in sys.path if p and Path(p).resolve() != Path(__file__).resolve().parent
    ]
    _add_packages()
    _load_package()
    sys.exit(importlib.import_module(f"{_PACKAGE}.core.{sys.argv[1]}").main(sys.argv[2:]))
