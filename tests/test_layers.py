# SPDX-License-Identifier: GPL-3.0-or-later
"""The map of docs/architecture.md: imports of the same or earlier folders only, no circles."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "gaussian_wrapping_addon"
CORE = PACKAGE / "core"

# A file imports its own folder and folders listed earlier in FOLDERS, never later ones.
FOLDERS = (
    "core",
    "core/settings", "core/ply", "core/kernels", "core/processes", "core/imaging",
    "core/dataset", "core/dataset/frames", "core/dataset/photos", "core/dataset/video",
    "core/dataset/readers", "core/dataset/readers/programs", "core/dataset/lenses",
    "core/dataset/matching", "core/dataset/poses", "core/dataset/panoramas", "core/dataset/units",
    "core/dataset/loading", "core/dataset/quality",
    "core/mesh", "core/mesh/exchange", "core/stereo", "core/stereo/plain", "core/gaussians",
    "core/regions", "core/mesh/simplification",
    "core/render/types", "core/render/simd", "core/render/projection", "core/render/tiling",
    "core/render/isosurface", "core/render/raster", "core/render/query", "core/render/reference",
    "core/render/cuda", "core/render", "core/devices",
    "core/field/vacancy", "core/field",
    "core/training/optimizer", "core/training/losses", "core/training/density",
    "core/training/appearance", "core/training/poses", "core/training/selection",
    "core/training/initialisation", "core/training/devices",
    "core/training", "core/training/blocks", "core/training/cost", "core/masks",
    "core/meshing/tetrahedra", "core/meshing/points", "core/meshing/cleanup",
    "core/meshing/checks", "core/meshing", "core/meshing/tiles", "core/meshing/cost",
    "core/texture/atlas", "core/texture/unwrap", "core/texture/bake", "core/texture/cost",
    "core/texture/files", "core/texture/detail", "core/texture",
    "core/evaluation/surface", "core/evaluation/alignment", "core/evaluation/layouts",
    "core/evaluation/color_field", "core/evaluation/views", "core/evaluation/report",
    "core/evaluation",
    "core/cluster", "core/jobs/store", "core/jobs/video", "core/jobs/stages", "core/jobs/masking",
    "core/jobs/training", "core/jobs/baking", "core/jobs/parts", "core/jobs",
    "core/jobs/commands", "core/jobs/commands/farm", "core/setup", "core/farm",
    "ops/common", "ops/cameras", "ops/regions", "ops/placement", "ops/results", "ops/baking",
    "ops/export",
    "ops/worker", "ops/jobs", "ops/computers", "ops/presets", "ops/training", "ops/dataset",
    "ops/meshing", "ops/masks", "ops",
    "ui/translations", "ui/common", "ui/worker", "ui/jobs", "ui/presets", "ui/dataset",
    "ui/training", "ui/computers", "ui/masks", "ui/regions", "ui/meshing", "ui/baking",
    "ui/results", "ui/placement", "ui",
    "command_line/options", "command_line/farm", "command_line", "",
)  # fmt: skip

# What a part may not import although it is listed earlier: part -> parts.
KEPT_APART = {
    "field": {"training"}, "meshing": {"training"}, "texture": {"training"},
    "evaluation": {"training"},
}  # fmt: skip

MOST_MODULES = 12
"""Modules of a folder, ``__init__.py`` not counted."""

# Blender's own process has only the standard library and numpy: what it loads may import no more.
BLENDER_SIDE = (
    "core.jobs.client", "core.jobs.commands.run_in_worker",
    "core.jobs.commands.evaluate_command", "core.jobs.store.job_file",
    "core.dataset.loading.check", "core.settings", "core.setup.install",
    "core.processes.worker_environment", "core.regions.box", "core.regions.region_file",
    "core.names", "core.gaussians.preview_points",
    "core.jobs.parts.planning", "core.farm.part_states",
)  # fmt: skip
HEAVY = ("torch", "numba", "scipy", "pycolmap", "xatlas", "trimesh", "shull", "igl", "av")


def python_files(folder: Path) -> list[Path]:
    files = sorted(p for p in folder.rglob("*.py") if "__pycache__" not in p.parts)
    assert files
    return files


def imports_of(path: Path) -> list[tuple[int, str, list[str]]]:
    """Return (level, module, names) of every import, also of those inside functions."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(0, alias.name, []) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found.append((node.level, node.module or "", [alias.name for alias in node.names]))
    return found


def modules_named(package: Path, path: Path) -> list[str]:
    """Return the modules of the package that a file imports, as paths below it without ``.py``."""
    found = []
    for level, module, names in imports_of(path):
        if level == 0:
            continue
        here = path.relative_to(package).parent.parts
        base = (*here[: len(here) - (level - 1)], *(module.split(".") if module else ()))
        for name in names:
            for parts in ((*base, name), base, (*base, "__init__")):
                if package.joinpath(*parts).with_suffix(".py").is_file():
                    found.append("/".join(parts))
                    break
            else:
                found.append("/".join((*base, name)) + " (which does not exist)")
    return found


def folder_of(module: str) -> str:
    """Return the folder of a module's path, ``""`` for the package's own files.

    A package's ``__init__`` stands for the folder it opens.
    """
    parent = str(PurePosixPath(module).parent)
    return "" if parent == "." else parent


def upward(package: Path, order: Iterable[str]) -> list[str]:
    """Return the imports of later folders, and those of or from folders that have no place."""
    place = {folder: k for k, folder in enumerate(order)}
    wrong = []
    for path in python_files(package):
        me = path.relative_to(package).with_suffix("").as_posix()
        mine = folder_of(me)
        if mine not in place:
            wrong.append(f"{mine} has no place in FOLDERS")
            continue
        for module in modules_named(package, path):
            other = folder_of(module)
            if place.get(other, len(place)) > place[mine]:
                wrong.append(f"{me} imports {module}")
    return wrong


def circles(package: Path) -> list[list[str]]:
    """Return the groups of modules that import one another (Tarjan's components)."""
    edges = {
        path.relative_to(package).with_suffix("").as_posix(): modules_named(package, path)
        for path in python_files(package)
    }
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in edges.get(node, ()):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1 or node in edges.get(node, ()):
                found.append(sorted(group))

    for node in edges:
        if node not in index:
            visit(node)
    return found


def test_imports_run_down() -> None:
    assert upward(PACKAGE, FOLDERS) == []


def test_every_folder_of_the_plan_exists() -> None:
    assert [folder for folder in FOLDERS if not (PACKAGE / folder / "__init__.py").is_file()] == []


def test_no_circles() -> None:
    assert circles(PACKAGE) == []


def test_parts_that_are_kept_apart() -> None:
    wrong = []
    for path in python_files(CORE):
        part = path.relative_to(CORE).parts[0]
        for module in modules_named(PACKAGE, path):
            parts = module.split("/")
            if parts[0] == "core" and len(parts) > 2 and parts[1] in KEPT_APART.get(part, ()):
                wrong.append(f"{path.relative_to(CORE)} imports {module}")
    assert wrong == []


def test_folders_are_small_and_say_what_they_are_for() -> None:
    wrong = []
    for folder in {path.parent for path in python_files(PACKAGE)}:
        count = sum(path.name != "__init__.py" for path in folder.glob("*.py"))
        if count > MOST_MODULES:
            wrong.append(f"{folder.name} has {count} modules")
        first = folder / "__init__.py"
        if not first.is_file() or not ast.get_docstring(ast.parse(first.read_text("utf-8"))):
            wrong.append(f"{folder.name} does not say what lives there")
    assert wrong == []


def write_package(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_arrows_and_circles_are_found(tmp_path: Path) -> None:
    package = write_package(
        tmp_path,
        {
            "__init__.py": "",
            "low/__init__.py": "",
            "low/a.py": "def late():\n    from ..high.b import c\n",
            "high/__init__.py": "",
            "high/b.py": "from ..low.a import (\n    late,\n)\nfrom ..other import d\n",
        },
    )
    assert upward(package, ("low", "high", "")) == [
        "high/b imports other/d (which does not exist)",
        "low/a imports high/b",
    ]
    assert circles(package) == [["high/b", "low/a"]]
    assert upward(package, ("low", "")) == [
        "high has no place in FOLDERS",
        "high has no place in FOLDERS",
        "low/a imports high/b",
    ]


def test_core_never_reaches_blender() -> None:
    wrong = [
        f"{path.relative_to(CORE)} imports {module}"
        for path in python_files(CORE)
        for level, module, _ in imports_of(path)
        if level == 0 and module.split(".")[0] in ("bpy", "mathutils", "gpu", "bmesh")
    ]
    assert wrong == []


def test_only_relative_imports_inside_the_package() -> None:
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {module}"
        for path in python_files(PACKAGE)
        for level, module, _ in imports_of(path)
        if level == 0 and module.split(".")[0] == PACKAGE.name
    ]
    assert wrong == []


@pytest.mark.parametrize("layer", ["ops", "ui"])
def test_blender_layers_import_nothing_heavy(layer: str) -> None:
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {module}"
        for path in python_files(PACKAGE / layer)
        for level, module, _ in imports_of(path)
        if level == 0 and module.split(".")[0] in HEAVY
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
