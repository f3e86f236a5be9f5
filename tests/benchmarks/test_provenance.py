# SPDX-License-Identifier: GPL-3.0-or-later
"""Pages say in their first line when the core has changed since their figures were measured."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from benchmarks.provenance import (
    DOCUMENTS,
    PACKAGE,
    UNKNOWN,
    age,
    code_of_tree,
    read_figures,
    said_origin,
    write_figures,
    write_page,
)
from gaussian_wrapping_addon.core.errors import ParseError


class Repository:
    """A repository whose core and documents are committed one after the other."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.git("init", "-q")

    def git(self, *words: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        command = ["git", "-C", str(self.root), *who, *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    def commit(self, path: str, text: str) -> str:
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        self.git("add", "-A")
        self.git("commit", "-q", "-m", text)
        return self.git("rev-parse", "--short=10", "HEAD")


@pytest.fixture
def repository(tmp_path: Path) -> Repository:
    return Repository(tmp_path)


def test_figures_are_old_once_the_core_has_changed(repository: Repository) -> None:
    first = repository.commit(f"{PACKAGE}/a.py", "one")
    assert code_of_tree(repository.root).commit == first
    later = repository.commit("docs/a.md", "words")
    assert age([first, later], repository.root) == ""
    changed = repository.commit(f"{PACKAGE}/a.py", "two")
    said = age([first, later, first, changed], repository.root)
    assert f"measured at {first}, {later};" in said
    assert said.endswith("the core was changed since.")
    assert age([changed], repository.root) == ""
    assert "0123456789" in age([changed, "0123456789"], repository.root)  # not in this repository


@pytest.mark.parametrize("commit", [None, "", UNKNOWN])
def test_records_without_a_commit_are_told(commit: str | None, repository: Repository) -> None:
    known = repository.commit(f"{PACKAGE}/a.py", "one")
    assert "name no commit" in age([known, commit], repository.root)


def test_nothing_is_said_without_a_repository(tmp_path: Path) -> None:
    assert age(["0123456789"], tmp_path / "nowhere") == ""
    assert "name no commit" in age([None], tmp_path / "nowhere")


def test_the_warning_is_the_first_line_of_a_page(repository: Repository) -> None:
    old = repository.commit(f"{PACKAGE}/a.py", "one")
    new = repository.commit(f"{PACKAGE}/a.py", "two")
    page = repository.root / "pages" / "a.md"
    write_page(page, "Title", [new], ["words", ""], repository.root)
    assert page.read_text() == "# Title\n\nwords\n"
    lines = write_page(page, "Title", [old], ["words"], repository.root).read_text().split("\n")
    assert old in lines[0]
    assert lines[1:] == ["", "# Title", "", "words", ""]


def test_records_name_code_machine_and_date(tmp_path: Path) -> None:
    code = code_of_tree()
    write_figures(tmp_path / "new" / "a.json", {"seconds": 2.0}, 3, code)
    record = read_figures(tmp_path / "new" / "a.json")
    assert record["seconds"] == 2.0
    said = said_origin("python -m a", record)
    for words in (
        "`python -m a`",
        "3 threads",
        code.commit,
        record["machine"],
        record["date"][:10],
    ):
        assert words in said
    (tmp_path / "b.json").write_text('{"seconds": 2.0}')
    with pytest.raises(ParseError):
        read_figures(tmp_path / "b.json")


def test_every_page_of_figures_is_linked() -> None:
    index = (DOCUMENTS / "README.md").read_text(encoding="utf-8")
    for page in DOCUMENTS.glob("*.md"):
        assert page.name == "README.md" or f"({page.name})" in index, page.name
