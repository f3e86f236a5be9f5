# SPDX-License-Identifier: GPL-3.0-or-later
"""The map of docs/architecture.md: imports of the same or earlier groups only, no circles."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import TypeGuard

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "gaussian_wrapping_addon"
CORE = PACKAGE / "core"

# A file imports its own group and groups listed earlier, never later ones. A group is a folder of
# the package or of ``core`` with all below it; within a group no modules import each other.
GROUPS = (
    "core", "core/settings", "core/worker", "core/scene", "core/photos", "core/readers",
    "core/gaussians", "core/render", "core/regions", "core/stereo", "core/devices", "core/poses",
    "core/units", "core/loading", "core/mesh", "core/field", "core/training", "core/masks",
    "core/meshing", "core/texture", "core/evaluation", "core/farm", "core/jobs", "ops", "ui",
    "command_line", "",
)  # fmt: skip

# What a part may not import although it is listed earlier: part -> parts.
KEPT_APART = {
    "field": {"training"}, "meshing": {"training"}, "texture": {"training"},
    "evaluation": {"training"},
}  # fmt: skip

MOST_FOLDERS = 45
MOST_LEVELS = 3
"""Folders below the package, one in another."""

# Blender's own process has only the standard library and numpy: what it loads may import no more.
BLENDER_SIDE = (
    "core.jobs.client", "core.jobs.commands.run_in_worker", "core.jobs.commands.evaluate_command",
    "core.jobs.store.job_file", "core.loading.check", "core.settings", "core.jobs.install",
    "core.worker.environment", "core.regions.box", "core.regions.files", "core.names",
    "core.gaussians.preview_points", "core.jobs.parts.graph", "core.jobs.parts.states",
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


def group_of(module: str) -> str:
    """Return the group of a module's path, ``""`` for the package's own files."""
    parts = PurePosixPath(module).parent.parts
    return "/".join(parts[: 2 if parts[:1] == ("core",) else 1])


def upward(package: Path, order: Iterable[str]) -> list[str]:
    """Return the imports of later groups, and those of or from folders that have no place."""
    place = {group: k for k, group in enumerate(order)}
    wrong = []
    for path in python_files(package):
        me = path.relative_to(package).with_suffix("").as_posix()
        mine = group_of(me)
        if mine not in place:
            wrong.append(f"{mine} has no place in GROUPS")
            continue
        for module in modules_named(package, path):
            if place.get(group_of(module), len(place)) > place[mine]:
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
    assert upward(PACKAGE, GROUPS) == []


def test_every_group_exists() -> None:
    assert [group for group in GROUPS if not (PACKAGE / group / "__init__.py").is_file()] == []


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


def test_folders_are_few_and_say_what_they_are_for() -> None:
    folders = {path.parent for path in python_files(PACKAGE)}
    assert len(folders) <= MOST_FOLDERS
    wrong = []
    for folder in folders:
        if len(folder.relative_to(PACKAGE).parts) > MOST_LEVELS:
            wrong.append(f"{folder.relative_to(PACKAGE)} is too deep")
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
        "high has no place in GROUPS",
        "high has no place in GROUPS",
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


@pytest.mark.parametrize("layer", ["ops", "ui"])
def test_no_own_generic_is_subscripted_at_import(layer: str) -> None:
    """``typing`` keeps what is subscripted, and with it bpy beyond Python's end, where 4.2 crashes.

    Modules with properties of Blender evaluate their annotations; the others read them as text.
    """
    wrong, evaluated = [], 0
    for path in python_files(PACKAGE / layer):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        own = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        names = [name for node in imports if node.level for name in node.names]
        own |= {name.name for name in names if not name.name.isupper()}  # no tables
        if any(node.module == "__future__" for node in imports):
            continue
        for node in ast.walk(tree):
            given = [getattr(node, name, None) for name in ("annotation", "returns")]
            for part in (part for hint in given if hint for part in ast.walk(hint)):
                evaluated += 1
                if isinstance(part, ast.Subscript) and getattr(part.value, "id", "") in own:
                    wrong.append(f"{path.relative_to(PACKAGE)}:{part.lineno}")
    assert evaluated > 50
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


@pytest.mark.parametrize(
    "name",
    [
        "meshing.delaunay_helper", "masks.model_helper", "photos.video", "photos.video_frames",
        "texture.unwrap.pack_helper", "texture.unwrap.unwrap_helper", "units.markers",
    ],
)  # fmt: skip
def test_helpers_load_no_more_than_they_need(name: str) -> None:
    """They start often, and under a limit of memory, of which torch alone takes a share."""
    code = (
        "import sys, importlib\n"
        f"sys.path.insert(0, {str(PACKAGE.parent)!r})\n"
        f"importlib.import_module('gaussian_wrapping_addon.core.{name}')\n"
        "loaded = {'torch', 'numba', 'igl'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


def test_modules_that_children_run_exist() -> None:
    """They are named in texts, which neither imports nor types check."""
    named = []
    for path in python_files(PACKAGE):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            texts: list[ast.expr] = []
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                if re.search(r"(MODULE|HELPER)$", node.targets[0].id):
                    texts = [node.value]
            elif isinstance(node, ast.Call):
                called = getattr(node.func, "id", getattr(node.func, "attr", ""))
                if called in ("child_command", "run_helper", "run_in_worker", "in_worker"):
                    texts = [*node.args[:1], *(k.value for k in node.keywords if k.arg == "module")]
                prefix = "jobs.commands.farm_" if called == "in_worker" else ""
                texts = [ast.Constant(prefix + t.value) for t in texts if is_text(t)]
            named += [(path.name, text.value) for text in texts if is_text(text)]
    assert len(named) > 20
    missing = [(n, m) for n, m in named if not (CORE / f"{m.replace('.', '/')}.py").is_file()]
    assert missing == []


def is_text(node: ast.expr) -> TypeGuard[ast.Constant]:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
