# SPDX-License-Identifier: GPL-3.0-or-later
"""The arrows of docs/architecture.md: imports run down only, and core never reaches Blender."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "gaussian_wrapping_addon"
CORE = PACKAGE / "core"

# Each part may import the parts named, and the plain files of core/.
ALLOWED = {
    "mesh": set(),
    "dataset": set(),
    "gaussians": {"dataset"},
    "render": {"dataset", "gaussians"},
    "training": {"dataset", "gaussians", "render", "evaluation"},
    "field": {"dataset", "gaussians", "render"},
    "meshing": {"mesh", "dataset", "gaussians", "render", "field"},
    "texture": {"mesh", "dataset", "gaussians", "render", "field", "meshing"},
    "evaluation": {"mesh", "dataset", "gaussians", "render", "field", "meshing", "texture"},
    "setup": {"jobs"},
    "jobs": {
        "dataset", "gaussians", "render", "training", "field", "meshing", "texture", "evaluation",
        "regions",
    },
}  # fmt: skip

# Blender's own process has only the standard library and numpy: what it loads may import no more.
BLENDER_SIDE = (
    "core.jobs.client", "core.jobs.evaluate", "core.jobs.job_file", "core.dataset.check",
    "core.settings", "core.setup.install", "core.worker_environment", "core.regions.box",
    "core.regions.region_file", "core.names",
)  # fmt: skip
HEAVY = ("torch", "numba", "scipy", "pycolmap", "xatlas", "trimesh", "shull", "igl")


def imports_of(path: Path) -> list[tuple[int, str]]:
    """Return (level, dotted name) of every import statement, also those inside functions."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(0, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module] if node.module else [alias.name for alias in node.names]
            found += [(node.level, name) for name in names]
    return found


def resolved(path: Path, level: int, name: str) -> tuple[str, ...]:
    """Return the parts of an import below the package, or () for something outside of it."""
    if level == 0:
        return ()
    here = path.relative_to(PACKAGE).parent.parts
    return (*here[: len(here) - (level - 1)], *name.split("."))


def python_files(folder: Path) -> list[Path]:
    files = sorted(folder.rglob("*.py"))
    assert files
    return files


def test_imports_run_down() -> None:
    wrong = []
    for path in python_files(CORE):
        part = path.relative_to(CORE).parts[0]
        for level, name in imports_of(path):
            target = resolved(path, level, name)
            if len(target) < 2 or target[0] != "core" or target[1] not in ALLOWED:
                continue
            if part not in ALLOWED:
                wrong.append(f"{path.name} (plain file of core) imports {target[1]}")
            elif target[1] != part and target[1] not in ALLOWED[part]:
                wrong.append(f"{path.relative_to(CORE)} imports {'.'.join(target)}")
    assert wrong == []


def test_core_never_reaches_blender() -> None:
    wrong = []
    for path in python_files(CORE):
        for level, name in imports_of(path):
            outside = level == 0 and name.split(".")[0] in ("bpy", "mathutils", "gpu", "bmesh")
            target = resolved(path, level, name)
            if outside or (target and target[0] in ("ops", "ui", "registration", "batch")):
                wrong.append(f"{path.relative_to(CORE)} imports {name}")
    assert wrong == []


def test_only_relative_imports_inside_the_package() -> None:
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in python_files(PACKAGE)
        for level, name in imports_of(path)
        if level == 0 and name.split(".")[0] == PACKAGE.name
    ]
    assert wrong == []


@pytest.mark.parametrize("layer", ["ops", "ui"])
def test_blender_layers_import_nothing_heavy(layer: str) -> None:
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in python_files(PACKAGE / layer)
        for level, name in imports_of(path)
        if level == 0 and name.split(".")[0] in HEAVY
    ]
    assert wrong == []


def test_blender_side_of_core_loads_without_heavy_packages() -> None:
    code = (
        "import sys, importlib\n"
        f"sys.path.insert(0, {str(PACKAGE.parent)!r})\n"
        f"for name in {BLENDER_SIDE!r}:\n"
        "    importlib.import_module('gaussian_wrapping_addon.' + name)\n"
        f"loaded = sorted(set({HEAVY!r}) & set(sys.modules))\n"
        "assert not loaded, loaded\n"
        "assert 'bpy' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
