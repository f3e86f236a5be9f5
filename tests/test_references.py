# SPDX-License-Identifier: GPL-3.0-or-later
"""What comments, docstrings and pages refer to exists: files, sections, objects, headings."""

from __future__ import annotations

import ast
from functools import lru_cache
from pathlib import Path

import pytest

from tests.references import (
    METHOD,
    Files,
    Module,
    Names,
    anchors,
    c_comments,
    check_citations,
    check_entry_points,
    check_links,
    check_pages,
    check_places,
    check_roles,
    check_sources,
    comments_and_docstrings,
    folders_of_map,
    section_numbers,
    without_fences,
)
from tests.test_layers import PACKAGE, python_files

ROOT = Path(__file__).resolve().parents[1]
ARCHITECTURE = "docs/architecture.md"
CODE = ("gaussian_wrapping_addon", "tests", "benchmarks", "tools")
PAGES = ("docs", "benchmarks", "examples", "README.md", "CONTRIBUTING.md")
HISTORY = "CHANGELOG.md"
"""Names files that were there in their time: only its links are checked."""

TEMPLATES = {"benchmarks/readings": "docs/benchmarks"}
"""Folders of Markdown that is put into pages of another folder, which its links are relative to."""


# -- the repository -----------------------------------------------------------------------------


@lru_cache(maxsize=1)
def files() -> Files:
    return Files.below(ROOT)


def below(places: tuple[str, ...], *suffixes: str) -> list[str]:
    return sorted(
        path
        for path in files().paths
        if path.endswith(suffixes) and any(path == p or path.startswith(f"{p}/") for p in places)
    )


@lru_cache(maxsize=1)
def modules() -> tuple[dict[str, str], Names]:
    """Return what each module says to people, by path, and the names of all modules."""
    said, found = {}, {}
    for path in below((*CODE, "build_addon.py"), ".py"):
        source = (ROOT / path).read_text(encoding="utf-8")
        tree = ast.parse(source)
        said[path] = comments_and_docstrings(source, tree)
        found[dotted(path)] = Module.of(tree)
    return said, Names(found)


def dotted(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@lru_cache(maxsize=1)
def pages() -> dict[str, str]:
    return {
        path: (ROOT / path).read_text(encoding="utf-8") for path in below((*PAGES, HISTORY), ".md")
    }


@lru_cache(maxsize=1)
def spoken() -> dict[str, str]:
    """Return all text for people, by path: comments, docstrings, pages."""
    kernels = {
        path: c_comments((ROOT / path).read_text(encoding="utf-8"))
        for path in below(CODE, ".cu", ".cpp", ".h")
    }
    return modules()[0] | kernels | {p: t for p, t in pages().items() if p != HISTORY}


def assert_none(complaints: list[str]) -> None:
    assert not complaints, "\n" + "\n".join(complaints)


def test_pages_that_are_named_exist() -> None:
    texts = dict(spoken())
    for path in below(CODE[:1], ".py"):  # messages send people to pages, too
        texts[path] = (ROOT / path).read_text(encoding="utf-8")
    assert_none([c for path, text in texts.items() for c in check_pages(text, path, files())])


def test_sources_that_are_named_exist() -> None:
    assert_none([c for path, text in spoken().items() for c in check_sources(text, path, files())])


def test_places_that_are_named_exist() -> None:
    names = modules()[1]
    assert_none(
        [c for path, text in spoken().items() for c in check_places(text, path, files(), names)]
    )


def test_sections_of_the_method_exist() -> None:
    sections = section_numbers(pages()[METHOD])
    assert {"1", "3.4", "10.3"} <= sections
    assert_none([c for p, text in spoken().items() for c in check_citations(text, p, sections)])


def test_map_of_the_architecture_is_the_order_of_folders() -> None:
    folders = {path.parent.relative_to(PACKAGE).as_posix() for path in python_files(PACKAGE)}
    assert set(folders_of_map(pages()[ARCHITECTURE])) == {f.removeprefix(".") for f in folders}


def test_entry_points_are_in_their_files() -> None:
    package = "gaussian_wrapping_addon.core"
    assert_none(check_entry_points(pages()[ARCHITECTURE], ARCHITECTURE, package, modules()[1]))


def test_roles_name_something() -> None:
    said, names = modules()
    assert_none(
        [c for path, text in said.items() for c in check_roles(text, path, dotted(path), names)]
    )


def test_links_lead_somewhere() -> None:
    complaints = []
    for path, text in pages().items():
        own = Path(path).parent.as_posix()
        folder = TEMPLATES.get(own, own)
        complaints += check_links(text, path, folder, files(), pages())
    assert_none(complaints)


# -- the checks notice what is wrong ------------------------------------------------------------

SMALL = Files(frozenset({"docs/method.md", "docs/guide.md", "pkg/render/ray.py", "pkg/k.cu"}))
NAMES = Names(
    {
        "pkg.render.ray": Module.of(
            ast.parse("import numpy as np\nLIMIT = 1\nclass Ray:\n  t: float\n  def at(self): ...")
        ),
        "pkg.trace": Module.of(ast.parse("from .render.ray import Ray\ndef walk(): ...")),
    }
)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("see docs/method.md and guide.md", 0),
        ("see ../docs/guide.md", 0),
        ("see conventions.md C.6", 1),
        ("see pkg/guide.md", 1),
        ("see ./guide.md", 1),
        ("https://example.org/readme.md", 0),
        ("``report.md`` of the job", 0),
    ],
)
def test_missing_pages_are_noticed(text: str, wrong: int) -> None:
    assert len(check_pages(text, "pkg/trace.py", SMALL)) == wrong


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("`ray.py`, render/ray.py, pkg/render/ray.py, `k.cu`", 0),
        ("`rays.py`", 1),
        ("trace/ray.py", 1),
        ("`a.py` and `b.cu`", 2),
        ("no.python", 0),
    ],
)
def test_missing_sources_are_noticed(text: str, wrong: int) -> None:
    assert len(check_sources(text, "docs/guide.md", SMALL)) == wrong


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("benchmarks/scenes and benchmarks/scenes/, `python -m benchmarks.scenes all`", 0),
        ("benchmarks.scenes.make, docs/guide", 0),
        ("tests/core", 1),
        ("benchmarks/scene", 1),
        ("python -m benchmarks.cuda", 1),
        ("benchmarks.scenes.draw", 1),
    ],
)
def test_missing_places_are_noticed(text: str, wrong: int) -> None:
    there = Files(SMALL.paths | {"benchmarks/scenes/__main__.py", "benchmarks/scenes/__init__.py"})
    names = Names({"benchmarks.scenes": Module.of(ast.parse("def make(): ..."))})
    assert len(check_places(text, "docs/guide.md", there, names)) == wrong


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("docs/method.md, section 2.1", 0),
        ("docs/method.md, section\n    2.1).", 0),
        ("docs/method.md, sections 1, 2.1 and 2.2", 0),
        ("docs/method.md, section 2.3", 1),
        ("docs/method.md, sections 2.1 to 2.9", 1),
        ("docs/method.md, sections 3, 4 and 2.1", 2),
        ("method.md 2.1", 1),
        ("docs/method.md", 0),
    ],
)
def test_missing_sections_are_noticed(text: str, wrong: int) -> None:
    sections = section_numbers("# M\n## 1 A\n## 2 B\n### 2.1 C\n### 2.2 D\n```\n## 2.3 no\n```\n")
    assert len(check_citations(text, "pkg/trace.py", sections)) == wrong


def test_sections_within_the_method_are_checked_too() -> None:
    text = "as section 2 says, unlike sections 1 and 7"
    assert check_citations(text, METHOD, {"1", "2"}) == [f"{METHOD}: {METHOD} has no section 7"]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("| `Ray(...)`: `.at(t)`, `LIMIT` | `no` | `render/ray.py` |", 0),
        ("| `walk() -> Ray`, `Ray` | what | `trace.py`, `render/ray.py` |", 0),
        ("| `Ray`: `.to(t)` | what | `render/ray.py` |", 1),
        ("| `walk()` | what | `render/ray.py` |", 1),
        ("| `walk()` | what | `tracer.py` |", 1),
        ("| `walk()` | `trace.py` of the package |", 0),
    ],
)
def test_missing_entry_points_are_noticed(text: str, wrong: int) -> None:
    assert len(check_entry_points(text, "docs/guide.md", "pkg", NAMES)) == wrong


def test_the_map_is_the_longest_list_of_folders() -> None:
    page = "```\na/  one\n```\n\n```text\na/b/   two\na/     three\n.      four\n```\n"
    assert folders_of_map(page) == ["a/b", "a", ""]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (":func:`walk`, :class:`Ray`, :meth:`.Ray.at`, :attr:`Ray.t`", 0),
        (":mod:`.ray` :mod:`.render.ray` :class:`~.ray.Ray` :data:`~.ray.LIMIT`", 0),
        (":func:`pkg.trace.walk` :mod:`numpy.linalg`", 0),
        (":func:`the walk <walk>`", 0),
        (":func:`run`", 1),
        (":mod:`.rays` :func:`~.ray.cast` :class:`Ray.z`", 3),
        (":func:`pkg.trace.run`", 1),
    ],
)
def test_missing_targets_are_noticed(text: str, wrong: int) -> None:
    assert len(check_roles(text, "pkg/trace.py", "pkg.trace", NAMES)) == wrong


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("[a](method.md) [b](method.md#2-two) [c](#own) [d](../pkg/k.cu) [e](../pkg)", 0),
        ("[f](https://example.org/x.md) ![g](mailto:a@b.c) `[h](none.md)`", 0),
        ("```\n[i](none.md)\n```", 0),
        ("[j](none.md)", 1),
        ("[k](method.md#3-three)", 1),
        ("[l](#other)", 1),
        ("[m][n]\n\n[n]: none.md", 1),
        ('<img src="none.png">', 1),
    ],
)
def test_dead_links_are_noticed(text: str, wrong: int) -> None:
    known = {"docs/guide.md": f"# Own\n{text}", "docs/method.md": "## 2 Two\n"}
    found = check_links(known["docs/guide.md"], "docs/guide.md", "docs", SMALL, known)
    assert len(found) == wrong


def test_anchors_are_those_of_github() -> None:
    assert anchors("# A b\n## `c_d`, E: f-g\n# A b\n") == {"a-b", "c_d-e-f-g", "a-b-1"}


def test_text_for_people_is_found() -> None:
    source = (
        'X = """# no.py"""\nY = 1  # one.py\n"""two.py"""\n# three\n\n\ndef f():\n  """four"""\n'
    )
    said = comments_and_docstrings(source, ast.parse(source))
    assert sorted(said.split("\n")) == ["four", "one.py", "three", "two.py"]
    assert c_comments("int a; // one\n/* two */ b").split() == ["one", "two"]
    assert "no" not in without_fences("```\nno\n```\n")
