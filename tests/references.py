# SPDX-License-Identifier: GPL-3.0-or-later
"""What comments, docstrings and pages refer to, and whether it exists in the repository.

Every ``check_*`` takes plain text and returns complaints in words, so that it can be tried on
made-up text. Standard library only.
"""

from __future__ import annotations

import ast
import fnmatch
import os
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath

SKIPPED_FOLDERS = {"__pycache__", "build", "dist", "node_modules", "site"}

GENERATED = {
    "report.md": "written by every job",
    "gaussian_wrapping.cu": "made by a command in docs/cuda.md",
}
"""Files that text may name although the repository has none of that name, and why."""

EXTERNAL = {"bpy", "igl", "mathutils", "numba", "numpy", "pycolmap", "scipy", "torch", "trimesh"}
"""Packages whose objects roles may name without being looked up."""

METHOD = "docs/method.md"

_MD = re.compile(r"[\w./*-]*[\w*]\.md\b")
_SOURCE = re.compile(r"[\w./*-]*[\w*]\.(?:py|cu)\b")
_NUMBER = r"\d+(?:\.\d+)*"
_CITATION = re.compile(
    rf"\bmethod\.md,?\s+sections?\s+({_NUMBER}(?:(?:,|,?\s+and|\s+to)\s+{_NUMBER})*)"
)
_UNNAMED = re.compile(r"\bmethod\.md,?\s+(?!sections?\b)§?\s*\d")
_OWN = re.compile(rf"\bsections?\s+({_NUMBER}(?:(?:,|,?\s+and|\s+to)\s+{_NUMBER})*)")
_DOTTED = re.compile(r"(?<![\w./-])(?:gaussian_wrapping_addon|benchmarks|tests)(?:\.[A-Za-z_]\w*)+")
_PLACE = re.compile(
    r"(?<![\w./-])(?:gaussian_wrapping_addon|benchmarks|docs|tests)(?:/[\w-]+)+(?![\w./*-])"
)
_ROLE = re.compile(r":(mod|func|class|meth|data|attr|exc):`([^`]+)`")
_HEADING = re.compile(r"^(#{1,6})\s+(.*?)\s*#*$", re.MULTILINE)
_FENCE = re.compile(r"^(```|~~~).*?^\1[^\n]*$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)|(?:src|href)=\"([^\"]+)\"")
_ENTRY = re.compile(
    r"^\|(?P<names>[^|\n]*)\|[^|\n]*\|(?P<files>(?: *`[\w/]+\.py`,?)+) *\|$", re.MULTILINE
)
_ENTRY_NAME = re.compile(r"`(\.?[A-Za-z_]\w*)(?=[(`])")
_LINK_DEFINITION = re.compile(r"^\s{0,3}\[[^\]]+\]:\s+(\S+)", re.MULTILINE)


# -- the repository -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Files:
    """The files of a repository, as paths from its root with forward slashes."""

    paths: frozenset[str]

    @classmethod
    def below(cls, root: Path) -> Files:
        """List a folder; hidden folders and what tools leave behind are left out."""
        found = []
        for folder, folders, names in os.walk(root):
            folders[:] = [n for n in folders if n not in SKIPPED_FOLDERS and n[0] != "."]
            here = Path(folder).relative_to(root)
            found += [(here / name).as_posix() for name in names]
        return cls(frozenset(found))

    def has(self, mention: str, near: str) -> bool:
        """Tell whether a mention in the file ``near`` names a file.

        A bare name or the end of a path may be that of any file; what begins with a dot is
        relative to the folder of ``near``. A star stands for anything.
        """
        mention = mention.removeprefix("/")
        if mention.startswith("."):
            joined = os.path.normpath(PurePosixPath(near).parent / mention)
            return Path(joined).as_posix() in self.paths
        if "*" in mention:
            return bool(fnmatch.filter(self._endings, mention.lstrip("/")))
        return mention in self._endings

    def has_place(self, mention: str) -> bool:
        """Tell whether a path from the root names a folder, or a file without its suffix."""
        return any(path.startswith((f"{mention}/", f"{mention}.")) for path in self.paths)

    @cached_property
    def _endings(self) -> frozenset[str]:
        return frozenset(end for path in self.paths for end in _ends(path, "/"))


def _ends(name: str, separator: str) -> Iterator[str]:
    """Yield a name, and what is left of it without its first parts."""
    parts = name.split(separator)
    for k in range(len(parts)):
        yield separator.join(parts[k:])


@dataclass
class Module:
    """Names that a module has, by what it takes to refer to them."""

    names: set[str] = field(default_factory=set)
    """Everything at its top level, imported names too."""
    members: set[str] = field(default_factory=set)
    """``Class.member`` of its classes."""

    @classmethod
    def of(cls, tree: ast.Module) -> Module:
        """Collect the names of a parsed module."""
        found = cls()
        for node in _statements(tree.body):
            found.names.update(_bound(node))
            if isinstance(node, ast.ClassDef):
                for inner in ast.walk(node):
                    found.members.update(f"{node.name}.{name}" for name in _bound(inner))
        return found


def _statements(body: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield the statements of a body and of the conditions and handlers in it."""
    for node in body:
        yield node
        if isinstance(node, (ast.If, ast.Try, ast.With)):
            for name in ("body", "orelse", "finalbody"):
                yield from _statements(getattr(node, name, []))
            for handler in getattr(node, "handlers", []):
                yield from _statements(handler.body)


def _bound(node: ast.AST) -> Iterator[str]:
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        yield node.name
    elif isinstance(node, (ast.Import, ast.ImportFrom)):
        for alias in node.names:
            yield (alias.asname or alias.name).split(".")[0]
    elif isinstance(node, (ast.Assign, ast.AnnAssign)):
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            for part in ast.walk(target):
                if isinstance(part, ast.Name):
                    yield part.id
                elif isinstance(part, ast.Attribute):
                    yield part.attr


@dataclass(frozen=True)
class Names:
    """The modules of a repository and what they hold, by dotted name."""

    modules: dict[str, Module]

    @cached_property
    def _module_ends(self) -> set[str]:
        return {end for dotted in self.modules for end in _ends(dotted, ".")}

    @cached_property
    def _all(self) -> set[str]:
        found: set[str] = set()
        for dotted, module in self.modules.items():
            found |= module.names | module.members
            for end in _ends(dotted, "."):
                found.update(f"{end}.{name}" for name in module.names | module.members)
        return found

    def has_module(self, target: str) -> bool:
        """Tell whether a target names a module: with leading dots by its end, else in full."""
        if target.startswith("."):
            return target.lstrip(".") in self._module_ends
        return target in self.modules or _is_external(target)

    def has(self, target: str, module: str) -> bool:
        """Tell whether the target of a role in ``module`` names an object.

        Without leading dots it is a name of that module, of one of its classes, or a full dotted
        name. With leading dots it is the end of any dotted name, as Sphinx takes it: such roles
        survive when modules move to other folders.
        """
        if target.startswith("."):
            return target.lstrip(".") in self._all
        own = self.modules.get(module, Module())
        if target in own.names | own.members or target in self.modules:
            return True
        if "." not in target:
            return any(member.split(".")[1] == target for member in own.members)
        return target in self._all or _is_external(target)


def _is_external(target: str) -> bool:
    first = target.split(".")[0]
    return first in EXTERNAL or first in sys.stdlib_module_names


# -- text ---------------------------------------------------------------------------------------


def comments_and_docstrings(source: str, tree: ast.Module) -> str:
    """Return the text of a module that is for people, each piece in lines of its own.

    Comments of neighbouring lines stay together, so that a citation may run on.
    """
    pieces = []
    quoted: dict[int, list[ast.expr]] = {}
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                pieces.append(text)
            case ast.Constant(value=str()) | ast.JoinedStr():
                for number in range(node.lineno, (node.end_lineno or node.lineno) + 1):
                    quoted.setdefault(number, []).append(node)
    for number, line in enumerate(source.split("\n"), 1):
        found = re.search(r"(?:^|\s)#:?\s(.*)$", line)
        if found and not any(
            (node.lineno, node.col_offset)
            <= (number, found.start())
            < (node.end_lineno, node.end_col_offset)
            for node in quoted.get(number, ())
        ):
            pieces.append(found[1])
    return "\n".join(pieces)


def c_comments(source: str) -> str:
    """Return the text of the comments of C, C++ or CUDA."""
    found = re.findall(r"//([^\n]*)|/\*(.*?)\*/", source, re.DOTALL)
    lines = [line for pair in found for line in pair if line]
    return "\n".join(lines)


def without_fences(text: str) -> str:
    """Return Markdown without its fenced code, which is an example and no reference."""
    return _FENCE.sub("", text)


def section_numbers(markdown: str) -> set[str]:
    """Return the numbers that headings begin with: ``## 3 Losses``, ``### 3.4 Multi-view``."""
    texts = [found[2] for found in _HEADING.finditer(without_fences(markdown))]
    return {m[0] for text in texts if (m := re.match(rf"{_NUMBER}(?=\s)", text))}


def anchors(markdown: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    found: set[str] = set()
    for heading in _HEADING.finditer(without_fences(markdown)):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading[2])
        plain = re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")
        slug, count = plain, 0
        while slug in found:
            count += 1
            slug = f"{plain}-{count}"
        found.add(slug)
    return found


# -- checks -------------------------------------------------------------------------------------


def check_pages(text: str, near: str, files: Files) -> list[str]:
    """Return mentions of ``*.md`` files that are not there."""
    return [
        f"{near}: there is no {mention}"
        for mention in sorted(set(_MD.findall(_without_urls(text))))
        if mention.split("/")[-1] not in GENERATED and not files.has(mention, near)
    ]


def check_sources(text: str, near: str, files: Files) -> list[str]:
    """Return mentions of ``*.py`` and ``*.cu`` files that are not there."""
    return [
        f"{near}: there is no {mention}"
        for mention in sorted(set(_SOURCE.findall(_without_urls(text))))
        if mention.split("/")[-1] not in GENERATED and not files.has(mention, near)
    ]


def check_places(text: str, near: str, files: Files, names: Names) -> list[str]:
    """Return folders (``tests/gui``) and dotted modules (``tests.references``) not there."""
    places = [m for m in _PLACE.findall(text) if not files.has_place(m)]
    places += [m for m in _DOTTED.findall(text) if not names.has(m, "")]
    return [f"{near}: there is no {mention}" for mention in sorted(set(places))]


def check_entry_points(text: str, near: str, root: str, names: Names) -> list[str]:
    """Return functions of a table that are not in the files of their row.

    The first cell of a row has ``function(...)`` and ``.method(...)``, the third has the files.

    Parameters
    ----------
    root : str
        Dotted package that the paths of the table begin below.
    """
    complaints = []
    for row in _ENTRY.finditer(text):
        files = re.findall(r"`([\w/]+)\.py`", row["files"])
        modules = [
            names.modules.get(f"{root}.{file.replace('/', '.')}", Module()) for file in files
        ]
        known = {name for module in modules for name in module.names}
        known |= {f".{member.split('.')[1]}" for module in modules for member in module.members}
        complaints += [
            f"{near}: there is no {name} in {', '.join(files)}"
            for name in _ENTRY_NAME.findall(row["names"])
            if name not in known
        ]
    return complaints


def folders_of_map(text: str) -> list[str]:
    """Return the folders that the fenced map of a page lists, ``""`` for the package's own."""
    fences = [found[0] for found in _FENCE.finditer(text)]
    rows = [re.findall(r"^([\w/]+/|\.)(?= {2,}\S)", fence, re.MULTILINE) for fence in fences]
    longest = max(rows, key=len, default=[])
    return [row.rstrip("/").replace(".", "") for row in longest]


def check_citations(text: str, near: str, sections: set[str]) -> list[str]:
    """Return citations of the method's page whose section is not there, or that name none."""
    complaints = [f"{near}: cite {METHOD} as '{METHOD}, section N.M'"] * len(_UNNAMED.findall(text))
    pattern = _OWN if near == METHOD else _CITATION
    cited = {n for found in pattern.finditer(text) for n in re.findall(_NUMBER, found[1])}
    return complaints + [
        f"{near}: {METHOD} has no section {number}" for number in sorted(cited - sections)
    ]


def check_roles(text: str, near: str, module: str, names: Names) -> list[str]:
    """Return Sphinx roles whose target is not there."""
    complaints = []
    for role, target in _ROLE.findall(text):
        explicit = re.search(r"<([^<>]+)>$", target)
        name = (explicit[1] if explicit else target).lstrip("~!").removesuffix("()")
        name = re.sub(r"\s+", "", name)
        if not (names.has_module(name) if role == "mod" else names.has(name, module)):
            complaints.append(f"{near}: :{role}:`{target}` names nothing")
    return complaints


def check_links(
    text: str, near: str, folder: str, files: Files, pages: dict[str, str]
) -> list[str]:
    """Return relative links of a Markdown page that lead nowhere.

    Parameters
    ----------
    folder : str
        That links are relative to, from the root.
    pages : dict
        Text of all Markdown files, by path from the root.
    """
    plain = re.sub(r"`[^`\n]*`", "", without_fences(text))
    targets = [a or b for a, b in _LINK.findall(plain)] + _LINK_DEFINITION.findall(plain)
    complaints = []
    for target in targets:
        if re.match(r"[a-z][a-z0-9+.-]*:|//", target):
            continue
        place, _, anchor = target.partition("#")
        path = Path(os.path.normpath(PurePosixPath(folder) / place)).as_posix() if place else near
        is_folder = any(other.startswith(f"{path}/") for other in files.paths)
        if path not in files.paths and not is_folder:
            complaints.append(f"{near}: the link {target} leads nowhere")
        elif anchor and path in pages and anchor not in anchors(pages[path]):
            complaints.append(f"{near}: the page of {target} has no such heading")
    return complaints


def _without_urls(text: str) -> str:
    return re.sub(r"\bhttps?://\S+", "", text)
