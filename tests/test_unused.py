# SPDX-License-Identifier: GPL-3.0-or-later
"""What a module defines at its top level is used: nothing lives that only tests call.

Used means: read in its own module, or imported, or read as an attribute of the imported module, in
the package, ``benchmarks`` or ``tools``. What an ``__init__.py`` imports is used if somebody takes
it from there.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
CHECKED = ("gaussian_wrapping_addon", "benchmarks")
USERS = (*CHECKED, "tools")

ALLOWED = {
    "gaussian_wrapping_addon": {"register", "unregister"},  # called by Blender
    "gaussian_wrapping_addon.batch": {"console_entry"},  # named in pyproject.toml
    # Definitions that tests compare with.
    "gaussian_wrapping_addon.core.units.georeference": {"geographic_from_enu"},
}
"""Names that nothing in the repository uses but its tests, and why they stay."""

Found = dict[str, set[str]]


@dataclass
class Module:
    """A module or package."""

    tree: ast.Module
    is_package: bool
    exports: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Of a package: module and name there of what it imports."""


def modules(root: Path, folders: tuple[str, ...]) -> dict[str, Module]:
    """Return all modules by their dotted name."""
    found = {}
    for path in sorted(path for folder in folders for path in root.glob(f"{folder}/**/*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found[".".join(parts[:-1] if is_package else parts)] = Module(tree, is_package)
    return found


def defined(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Yield the names defined at the top level; ``main`` is started by name, ``__x__`` special."""
    for statement in tree.body:
        names: list[str] = []
        if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
            names = [statement.name]
        elif isinstance(statement, (ast.Assign, ast.AnnAssign)):
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            every = (node for target in targets for node in ast.walk(target))
            names = [node.id for node in every if isinstance(node, ast.Name)]
        yield from ((name, statement) for name in names if name != "main" and name[:2] != "__")


def read_names(statement: ast.AST) -> set[str]:
    """Return the names that a statement reads."""
    return {
        node.id
        for node in ast.walk(statement)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
    }


def used_elsewhere(name: str, known: dict[str, Module]) -> Found:
    """Return, by module, the names that a module uses of others; ``*`` if it passes one on."""
    this = known[name]
    tree, package = this.tree, name.split(".") if this.is_package else name.split(".")[:-1]
    used: Found = {}
    aliases: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            aliases |= {a.asname or a.name: a.name for a in node.names if a.name in known}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else []
            module = ".".join([*above, *(node.module.split(".") if node.module else [])])
            for alias in node.names:
                if f"{module}.{alias.name}" in known:
                    aliases[alias.asname or alias.name] = f"{module}.{alias.name}"
                elif not this.is_package:
                    used.setdefault(module, set()).add(alias.name)
                else:
                    this.exports[alias.asname or alias.name] = (module, alias.name)
    owners = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owners.add(id(node.value))
            if node.value.id in aliases:
                used.setdefault(aliases[node.value.id], set()).add(node.attr)
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and id(node) not in owners and node.id in aliases:
            used.setdefault(aliases[node.id], set()).add("*")
    return used


def unused(root: Path, checked: tuple[str, ...], users: tuple[str, ...]) -> Found:
    """Return the unused names of each checked module."""
    known = modules(root, users)
    used: Found = {}
    for name in known:
        for module, names in used_elsewhere(name, known).items():
            if module != name:
                used.setdefault(module, set()).update(names)
    # Inner packages last: what an outer one hands on is followed through them.
    for name in sorted(known, key=lambda name: name.count(".")):
        for export, (module, origin) in known[name].exports.items():
            if export in used.get(name, ()):
                used.setdefault(module, set()).add(origin)
    found: Found = {}
    for module, this in known.items():
        if module.split(".")[0] not in checked or "*" in used.get(module, ()):
            continue
        read = [(statement, read_names(statement)) for statement in this.tree.body]
        for name, statement in defined(this.tree):
            here = any(name in names for other, names in read if other is not statement)
            if not here and name not in used.get(module, ()):
                found.setdefault(module, set()).add(name)
    return found


def test_everything_defined_is_used() -> None:
    assert unused(REPOSITORY, CHECKED, USERS) == ALLOWED


def test_what_only_tests_or_itself_or_a_package_use_is_found(tmp_path: Path) -> None:
    texts = {
        "made/__init__.py": "from .parts import exported, handed\nfrom . import whole\n",
        "made/parts.py": (
            "LIMIT = 1\nSPARE: int = 2\n\n\ndef exported():\n    return exported\n\n\n"
            "def asked():\n    return LIMIT\n\n\ndef handed():\n    pass\n\n\n"
            "def _kept():\n    pass\n\n\nclass Reached:\n    pass\n\n\ndef main():\n    pass\n"
        ),
        "made/whole.py": "def by_name():\n    pass\n",
        "made/user.py": (
            "from made import handed, parts as p\nfrom . import whole\nfrom .parts import asked\n\n"
            "chosen = [whole]\n_here = p.Reached\nprint(chosen, _here)\n"
        ),
        "tests/test_made.py": "from made.parts import SPARE\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert unused(tmp_path, ("made",), ("made",)) == {"made.parts": {"SPARE", "exported", "_kept"}}
