# SPDX-License-Identifier: GPL-3.0-or-later
"""Constructs that run foreign code or hide failures do not occur in the package."""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "gaussian_wrapping_addon"

BANNED_CALLS = {"eval", "exec", "compile", "print", "__import__"}
BANNED_MODULES = {"pickle", "cPickle", "marshal", "shelve", "dill", "yaml"}


def findings_in(tree: ast.AST) -> list[str]:
    """Return one sentence for each banned construct."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name.split(".")[0] in BANNED_MODULES]
        elif isinstance(node, ast.ImportFrom) and (node.module or "") in BANNED_MODULES:
            found.append(node.module or "")
        elif isinstance(node, ast.ExceptHandler) and node.type is None:
            found.append(f"bare except in line {node.lineno}")
        elif isinstance(node, ast.Call):
            found += _findings_in_call(node)
    return found


def _findings_in_call(node: ast.Call) -> list[str]:
    found = []
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    attribute = node.func.attr if isinstance(node.func, ast.Attribute) else ""
    owner = getattr(getattr(node.func, "value", None), "id", "")
    if name in BANNED_CALLS:
        found.append(f"{name}() in line {node.lineno}")
    if (owner, attribute) in {("torch", "save"), ("os", "system")}:
        found.append(f"{owner}.{attribute} in line {node.lineno}")
    # With weights_only, torch builds tensors and plain containers and runs nothing of the file.
    if (owner, attribute) == ("torch", "load") and not any(
        k.arg == "weights_only" and getattr(k.value, "value", None) is True for k in node.keywords
    ):
        found.append(f"torch.load without weights_only=True in line {node.lineno}")
    for keyword in node.keywords:
        value = getattr(keyword.value, "value", None)
        if keyword.arg in ("shell", "parallel", "allow_pickle") and value is True:
            found.append(f"{keyword.arg}=True in line {node.lineno}")
    if (owner, attribute) == ("np", "load") and not any(
        k.arg == "allow_pickle" for k in node.keywords
    ):
        found.append(f"np.load without allow_pickle=False in line {node.lineno}")
    return found


def test_the_walker_finds_what_it_looks_for() -> None:
    bad = "import pickle\neval('1')\nf(shell=True)\nnp.load(p)\ntry:\n  pass\nexcept:\n  pass\n"
    assert len(findings_in(ast.parse(bad))) == 5


def test_torch_may_load_weights_and_nothing_else() -> None:
    assert findings_in(ast.parse("torch.load(p, weights_only=True)")) == []
    for other in ("torch.load(p)", "torch.load(p, weights_only=False)", "torch.load(p, **options)"):
        assert len(findings_in(ast.parse(other))) == 1


def test_no_banned_construct() -> None:
    wrong = {
        str(path.relative_to(PACKAGE)): found
        for path in sorted(PACKAGE.rglob("*.py"))
        if (found := findings_in(ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert wrong == {}


def test_every_file_names_its_licence() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    first = "# SPDX-License-Identifier: GPL-3.0-or-later"
    assert [p.name for p in files if p.read_text().splitlines()[:1] != [first]] == []
