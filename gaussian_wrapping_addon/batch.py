# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: ``blender --background -P batch.py -- wrap INPUT --out DIR``, or plain Python.

It starts the same worker as the buttons, shows its progress, and writes ``scene.blend``. The
commands and their options are in ``command_line/``.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .core.progress import TerminalHandler

_logger = logging.getLogger("gaussian_wrapping")


def main(arguments: list[str], program: str = "batch.py") -> int:
    """Run one command and return the exit code (0 to 5, see ``docs/command-line.md``).

    ``program`` is the name shown in help and usage.
    """
    from .core.errors import EXIT_DONE, EXIT_RESOURCES

    with _shown_in_terminal() as terminal:
        try:
            code = _run(arguments, program)
        except SystemExit as ended:  # of --help, after its text
            code = ended.code if isinstance(ended.code, int) else EXIT_DONE
    lost = terminal.lost()
    if lost is None:
        return code
    with contextlib.suppress(OSError, ValueError, AttributeError):
        reason = lost.strerror or str(lost)
        sys.stderr.write(f"error: The output cannot be written: {reason}.\n")
    return code or EXIT_RESOURCES


def _run(arguments: list[str], program: str) -> int:
    from .command_line.options import with_option_name
    from .command_line.parser import build_parser
    from .core.errors import EXIT_OTHER, SettingError, WrapError, known_error
    from .core.worker.environment import interpreter_of, ready_worker

    try:
        options = build_parser(program).parse_args(arguments)
        return int(options.run(options))
    except SettingError as error:
        _logger.error("error: %s", with_option_name(error))
        return error.exit_code
    except WrapError as error:
        _logger.error("error: %s", error)
        return error.exit_code
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith(__name__.partition(".")[0]):
            raise
        ready = ready_worker()
        worker = interpreter_of(ready)[0] if ready else "that of Blender, or of the worker"
        _logger.error("error: This Python lacks %s. Use another Python: %s", error.name, worker)
        return EXIT_OTHER
    except OSError as error:
        known = known_error(error)
        if known is not None:
            _logger.error("error: %s", known)
            return known.exit_code
        _logger.error("error: %s", error)
        return EXIT_OTHER


def console_entry() -> int:
    """Run the ``gaussian-wrapping`` command of an installed package and return the exit code."""
    return main(sys.argv[1:], "gaussian-wrapping")


@contextlib.contextmanager
def _shown_in_terminal() -> Iterator[TerminalHandler]:
    """Write what the commands log to stdout, and nowhere else, while the block runs."""
    from .core.progress import LineFormatter, TerminalHandler

    handler = TerminalHandler(sys.stdout)
    handler.setFormatter(LineFormatter("%(message)s"))
    level, propagate = _logger.level, _logger.propagate
    _logger.addHandler(handler)
    _logger.setLevel(logging.INFO)
    _logger.propagate = False
    try:
        yield handler
    finally:
        _logger.removeHandler(handler)
        _logger.setLevel(level)
        _logger.propagate = propagate


def _arguments(argv: list[str]) -> list[str]:
    """Return what follows ``--`` (inside Blender), or everything (plain Python)."""
    if "--" in argv:
        return argv[argv.index("--") + 1 :]
    bpy = sys.modules.get("bpy")
    if bpy is not None and not getattr(bpy.app, "module", False):
        return []
    return argv[1:]


def _main_as_script() -> int:
    """Load the package that contains this file, then run its ``batch`` module."""
    name = "gaussian_wrapping_addon"
    root = Path(__file__).resolve().parent
    spec = importlib.util.spec_from_file_location(
        name, root / "__init__.py", submodule_search_locations=[str(root)]
    )
    if spec is None or spec.loader is None:
        raise ImportError(f"{root} holds no package")
    package = importlib.util.module_from_spec(spec)
    sys.modules[name] = package
    spec.loader.exec_module(package)
    # The folder of this file would make ``core``, ``ops`` and ``ui`` importable as top-level names.
    sys.path[:] = [p for p in sys.path if not p or Path(p).resolve() != root]
    return int(importlib.import_module(f"{name}.batch").main(_arguments(sys.argv)))


if __name__ == "__main__":
    sys.exit(_main_as_script())
