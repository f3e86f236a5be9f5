# SPDX-License-Identifier: GPL-3.0-or-later
"""Make a copy of the package that declares one more setting and is otherwise unchanged."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "gaussian_wrapping_addon"
GROUPS = ("training", "meshing", "texture")

_DECLARATION = """\
    fake_number: int = setting(
        3,
        help="A number that only the test knows.",
        check=Range(1, 9),
        unit="bananas",
        presets={"fine": 5},
        option=Option("--fake-number", "N"),
        panel=PanelProperty("Fake Number", "A number that only the test knows"),
    )
"""


def copy_with_fake_setting(folder: Path, group: str) -> Path:
    """Copy package and table writer into a folder, and declare ``fake_number`` in a group."""
    shutil.copytree(PACKAGE, folder / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "tools").mkdir()
    shutil.copy(REPOSITORY / "tools" / "settings_table.py", folder / "tools")
    path = folder / PACKAGE.name / "core" / "settings" / f"{group}.py"
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    first = next(i for i, line in enumerate(lines) if line.startswith("class "))
    indented = [i for i, line in enumerate(lines) if i > first and line.startswith("    ")]
    body = [i for i in indented if not any(line[0].isalpha() for line in lines[first + 1 : i])]
    lines.insert(body[-1] + 1, _DECLARATION)
    path.write_text("".join(lines), encoding="utf-8")
    return folder


def said_by(module: str, folder: Path, *arguments: str) -> Any:
    """Run a module of the tests with the copied package; return the JSON of its last line."""
    code = (
        "import runpy, sys\n"
        f"sys.path[:0] = [{str(folder)!r}, {str(REPOSITORY)!r}]\n"
        f"sys.argv = {[module, *arguments]!r}\n"
        f"runpy.run_module({module!r}, run_name='__main__')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    values = json.loads(done.stdout.splitlines()[-1])
    assert Path(values["package"]).is_relative_to(folder), "the copy is what ran"
    return values
