# SPDX-License-Identifier: GPL-3.0-or-later
"""Files beside the code agree with it: links, versions, the list of slow tests."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

from tests.conftest import slow_seconds

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
README_LINES = 150

_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\(([^)\s]+)\)")


def anchors_of(page: str) -> set[str]:
    """Return the anchors of the headings, by the rule of GitHub."""
    text = re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ +(.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


def broken_links(page: Path) -> list[str]:
    """Return the links of a page to files or headings that do not exist."""
    broken = []
    for link in _LINK.findall(_CODE.sub("", page.read_text(encoding="utf-8"))):
        if "://" in link:
            continue
        place, _, anchor = link.partition("#")
        target = (page.parent / place).resolve() if place else page
        if not target.is_file():
            broken.append(link)
            continue
        known = (
            anchors_of(target.read_text(encoding="utf-8")) if anchor and target.is_file() else {""}
        )
        if not target.is_file() or anchor not in known:
            broken.append(link)
    return broken


def test_the_check_of_links_finds_broken_ones(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("# One: two\n[x](#one-two) [x](a.md#one) [x](b.md) `[x](c)`\n")
    assert broken_links(tmp_path / "a.md") == ["a.md#one", "b.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    assert broken_links(page) == []


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= README_LINES


def test_citation_and_changelog_have_the_version() -> None:
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    version = manifest["version"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    released = re.search(r"^date-released: (\S+)$", citation, re.MULTILINE)
    assert f"\nversion: {version}\n" in citation
    assert released is not None
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\n## {version} - {released[1]}\n" in changelog


def test_pre_commit_has_the_ruff_of_the_tests() -> None:
    wanted = (ROOT / "requirements-dev.txt").read_text(encoding="utf-8")
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    pinned = re.search(r"^ruff==(\S+)$", wanted, re.MULTILINE)
    assert pinned is not None
    assert re.search(rf"ruff-pre-commit\n\s+rev: v{re.escape(pinned[1])}\n", hooks)


def test_every_slow_test_exists() -> None:
    names: dict[str, set[str]] = {}
    gone = []
    for entry in slow_seconds():
        file, _, test = entry.partition("::")
        if not (ROOT / file).is_file():
            gone.append(entry)
            continue
        if file not in names:
            tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
            names[file] = {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}
        if test and test not in names[file]:
            gone.append(entry)
    assert gone == [], "run tools/slow_tests.py again, or correct tests/slow_tests.txt"
