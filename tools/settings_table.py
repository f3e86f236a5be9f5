# SPDX-License-Identifier: GPL-3.0-or-later
"""Write ``docs/settings.md`` from the declarations of the settings.

    python -m tools.settings_table [--check]

Run it from the root of the repository after a setting was added or changed; ``make settings-table``
does the same. With ``--check`` nothing is written, and the exit code is 1 where the file is out of
date.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.settings import PRESETS, Declaration, JobSettings, declarations
from gaussian_wrapping_addon.core.settings.declaration import JOB

TARGET = Path(__file__).resolve().parents[1] / "docs" / "settings.md"

_logger = logging.getLogger("tools.settings_table")

_PANELS = {
    "dataset": "Dataset",
    "train": "Train",
    "train_advanced": "Train, Advanced",
    "mesh": "Mesh",
    "mesh_advanced": "Mesh, Advanced",
    "texture": "Texture",
    "computers": "Computers",
    "preferences": "Preferences",
}
_HEAD = f"""\
# Settings

Every setting of a job. In `job.json` the first group stands in `settings` itself, the others in
objects of their names. `make settings-table` writes this file from the declarations in
`gaussian_wrapping_addon/core/settings/`; do not edit it.

Without an option or a choice in the panel, the default counts; where the presets differ, the table
gives the defaults of {", ".join(PRESETS[:-1])} and {PRESETS[-1]}, in this order.
`--set NAME=VALUE` gives what has no option of its own. `--needs auto|all|none` sets all settings of
the model selection at once; a single setting wins over it.
"""
_COLUMNS = ("setting", "option", "panel", "default", "range", "unit", "what it does")


def table() -> str:
    """Return the content of ``docs/settings.md``."""
    parts = [_HEAD]
    settings = declarations(JobSettings)
    for group in dict.fromkeys(declared.group for declared in settings):
        rows = [_row(declared) for declared in settings if declared.group == group]
        example: Any = JobSettings()
        purpose = ((example if group == JOB else getattr(example, group)).__doc__ or "").strip()
        parts.append(f"\n## {group.capitalize()}\n\n{purpose.replace('``', '`')}\n\n")
        parts.append(f"| {' | '.join(_COLUMNS)} |\n{'|---' * len(_COLUMNS)}|\n")
        parts.append("".join(f"| {' | '.join(row)} |\n" for row in rows))
    return "".join(parts)


def _row(declared: Declaration) -> tuple[str, ...]:
    help_text = declared.help + (" *Model selection.*" if declared.model_selection else "")
    cells = (
        f"`{declared.name}`",
        _option(declared),
        _panel(declared),
        _default(declared),
        "" if declared.check is None else declared.check.wanted,
        declared.unit,
        help_text,
    )
    return tuple(cell.replace("|", r"\|") for cell in cells)


def _option(declared: Declaration) -> str:
    option = declared.option
    if option is None:
        return ""
    command = "`more` " if declared.scope == "more" else ""
    if not option.own:
        return f"`--set {option.word}={option.metavar or 'X'}`"
    return f"{command}`{option.name} {option.metavar}".rstrip() + "`"


def _panel(declared: Declaration) -> str:
    panel = declared.panel
    if panel is None:
        return ""
    return f"{_PANELS[declared.panel_name]}: {panel.drawn_label or panel.label}"


def _default(declared: Declaration) -> str:
    values = [_text(declared.presets.get(name, declared.default)) for name in PRESETS]
    return values[0] if len(set(values)) == 1 else " / ".join(values)


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value) if value != "" else "empty"


def main() -> int:
    """Write or check the file; return the exit code."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    parser = argparse.ArgumentParser(description="Write docs/settings.md.")
    parser.add_argument("--check", action="store_true", help="write nothing; 1 where out of date")
    wanted = table()
    if parser.parse_args().check:
        current = TARGET.is_file() and TARGET.read_text(encoding="utf-8") == wanted
        _logger.info("%s is %s", TARGET.name, "up to date" if current else "out of date")
        return 0 if current else 1
    TARGET.write_text(wanted, encoding="utf-8", newline="\n")
    _logger.info("%s written", TARGET)
    return 0


if __name__ == "__main__":
    sys.exit(main())
