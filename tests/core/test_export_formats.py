# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of export formats is the only list of them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gaussian_wrapping_addon.command_line.parser import build_parser
from gaussian_wrapping_addon.core.names import (
    BLENDER_FORMATS,
    EXPORT_FORMATS,
    JOB_FORMATS,
    MESH_FORMATS,
    PACKABLE_FORMATS,
    RESULT_FORMATS,
    WORKER_FORMATS,
)

PACKAGE = Path(__file__).resolve().parents[2] / "gaussian_wrapping_addon"


def test_lists_are_those_that_job_files_and_options_know() -> None:
    assert JOB_FORMATS == ("glb", "obj", "ply", "usd")
    assert WORKER_FORMATS == ("glb", "obj", "ply", "splat")
    assert BLENDER_FORMATS == ("usd", "fbx")
    assert MESH_FORMATS == ("glb", "obj", "ply", "usd", "fbx")
    assert RESULT_FORMATS == ("glb", "obj", "ply")
    assert PACKABLE_FORMATS == ("usd", "fbx")
    assert {name for name, f in EXPORT_FORMATS.items() if f.y_up} == {"glb", "obj", "fbx"}


@pytest.mark.parametrize(
    ("name", "plain", "packed"),
    [("glb", ".glb", ".glb"), ("usd", ".usdc", ".usdz"), ("fbx", ".fbx", ".fbx")],
)
def test_suffixes(name: str, plain: str, packed: str) -> None:
    assert EXPORT_FORMATS[name].file_suffix(pack=False) == plain
    assert EXPORT_FORMATS[name].file_suffix(pack=True) == packed


def test_the_table_needs_the_standard_library_alone() -> None:
    code = (
        "import sys\n"
        f"sys.path.insert(0, {str(PACKAGE.parent)!r})\n"
        "import gaussian_wrapping_addon.core.names\n"
        "assert 'numpy' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-I", "-c", code], check=True)


def test_help_names_every_format(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["export", "--help"])
    text = "".join(capsys.readouterr().out.split())
    assert ",".join(EXPORT_FORMATS) in text
