# SPDX-License-Identifier: GPL-3.0-or-later
"""Every text of the panel is in the one table, in every language, and is drawn from it."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import pytest

import gaussian_wrapping_addon
from gaussian_wrapping_addon import registration
from gaussian_wrapping_addon.core.jobs.install import CUDA_BRINGS
from gaussian_wrapping_addon.core.settings import JobSettings, declarations
from gaussian_wrapping_addon.core.worker.environment import EXTRAS
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.addon import CONTEXT, tr
from gaussian_wrapping_addon.ui.panel_base import progress_text, wrapped
from gaussian_wrapping_addon.ui.translations import table
from tests.blender.fake_layout import draw

pytestmark = pytest.mark.usefixtures("addon")

PACKAGE = Path(gaussian_wrapping_addon.__file__).parent
ROWS = json.loads(table.TABLE.read_text(encoding="utf-8"))
TEXTS: dict[str, list[str]] = ROWS["texts"]

DRAWN = (
    *sorted(PACKAGE.glob("ui/**/*.py")),
    PACKAGE / "ops/report_data.py",
)
"""Modules whose texts are drawn in panels; those of other modules are reports and errors."""

SAME_IN_ALL = {"2", "3", "9", "1024", "2048", "4096", "8192", "GOF", "ImageNet", "Dask"}
"""Numbers and names that no language changes."""

NOT_SHOWN = {
    "Gaussian Wrapping",  # the tab: the add-on's name
    "Wrap",  # of a hidden property
    "Warnings",  # of the text that Copy puts on the clipboard
    "long side",  # looked for in an estimate
    "GIZMO_GT_cage_3d", "_Panel", "_Operator",
}  # fmt: skip


def of_classes() -> Iterator[tuple[str, str]]:
    """Yield every label, description and property text of the registered classes, and where."""
    for cls in registration.CLASSES:
        for text in (getattr(cls, "bl_label", ""), getattr(cls, "bl_description", "")):
            yield text, cls.__name__
        for name, declared in getattr(cls, "__annotations__", {}).items():
            keywords: dict[str, Any] = getattr(declared, "keywords", {})
            if "HIDDEN" in keywords.get("options", ()):
                continue
            items = keywords.get("items", ())
            texts = [keywords.get("name", ""), keywords.get("description", "")]
            if not callable(items):
                texts += [text for item in items for text in item[1:3]]
            for text in texts:
                yield text, f"{cls.__name__}.{name}"


def of_panels() -> Iterator[tuple[str, str]]:
    """Yield the shorter labels that panels draw of settings."""
    for declared in declarations(JobSettings):
        if declared.panel is not None:
            yield declared.panel.drawn_label, declared.path


def literals(path: Path) -> Iterator[str]:
    """Yield the texts in a module's code: no docstrings, log messages and parts of f-strings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    left_out = set()
    for node in ast.walk(tree):
        parts: list[ast.AST] = []
        if isinstance(node, ast.Expr):
            parts = [node.value]
        elif isinstance(node, ast.JoinedStr):
            parts = [*node.values]
        elif isinstance(node, ast.Call) and "_logger" in ast.dump(node.func):
            parts = [*node.args]
        left_out |= {id(part) for part in parts}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
            worded = re.match(r"[A-Z0-9{]", text) or " " in text
            if id(node) not in left_out and re.search("[a-z]", text) and worded:
                yield text


def test_every_text_of_the_classes_is_in_the_table() -> None:
    found = [*of_classes(), *of_panels()]
    assert len(found) > 450
    missing = {text: where for text, where in found if text and text not in TEXTS}
    assert {text: w for text, w in missing.items() if text not in SAME_IN_ALL} == {}


def test_every_text_in_the_drawing_code_is_in_the_table() -> None:
    found = [(text, path.name) for path in DRAWN for text in literals(path)]
    assert len(found) > 200
    known = {*TEXTS, *NOT_SHOWN, *SAME_IN_ALL}
    missing = {text: where for text, where in found if text not in known}
    assert {t: w for t, w in missing.items() if not re.match(r"GWRAP_\w+$", t)} == {}


def test_every_text_that_dialogs_draw_is_in_the_table() -> None:
    """Operators draw few texts: those that they give to ``tr``."""
    found = [
        (node.args[0].value, path.name)
        for path in PACKAGE.glob("ops/**/*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "tr"
        if isinstance(node.args[0], ast.Constant)
    ]
    found += [(CUDA_BRINGS, "commands.py"), *((extra.title, extra.name) for extra in EXTRAS)]
    assert len(found) > 10
    assert {str(text): where for text, where in found if text not in TEXTS} == {}


def test_no_text_is_put_together_from_words() -> None:
    """What an f-string adds to its values has no words: a language may need another order."""
    wrong = []
    for path in DRAWN:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                words = "".join(p.value for p in node.values if isinstance(p, ast.Constant))
                wrong += [(path.name, words)] if re.search("[A-Za-z]{3}", words) else []
    # A number that is a constant of ours; texts for the clipboard and of the report's figures.
    allowed = {"mesh_panel.py", "report_data.py"}
    assert [(name, words) for name, words in wrong if name not in allowed] == []


def test_the_table_has_nothing_else() -> None:
    used = {text for text, _ in (*of_classes(), *of_panels())}
    used |= {text for path in DRAWN for text in literals(path)}
    whole = "\n".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    assert [text for text in TEXTS if text not in used and f'"{text}"' not in whole] == []


@pytest.mark.parametrize("index", range(2), ids=ROWS["languages"])
def test_each_language_is_whole(index: int) -> None:
    assert ROWS["languages"] == ["de_DE", "ja_JP"]
    for text, translated in TEXTS.items():
        assert len(translated) == 2
        words = translated[index]
        assert words.strip() == words != "", text
        assert sorted(re.findall(r"{\w+}", words)) == sorted(re.findall(r"{\w+}", text)), text
        assert words.endswith((".", "。")) == text.endswith(".") or words.endswith("max."), text
    if ROWS["languages"][index] == "ja_JP":
        latin = [t for t, w in TEXTS.items() if re.fullmatch("[ -~]*", w[1])]
        assert set(latin) <= {
            "UVs",
            "Python",
            "Torch",
            "JSON",
            "NVIDIA GPU",
            "Processor",
            "{done} of {total}",
        }


class Languages:
    """Stands for Blender's translations, which the bpy wheel is built without."""

    def __init__(self, language: str = "") -> None:
        self.language = language
        self.known: dict[str, table.Translations] = {}

    def register(self, name: str, texts: table.Translations) -> None:
        assert name not in self.known
        self.known[name] = texts

    def unregister(self, name: str) -> None:
        self.known.pop(name, None)

    def pgettext_iface(self, text: str, context: str = "*") -> str:
        for texts in self.known.values():
            return texts.get(self.language, {}).get((context, text), text)
        return text


@pytest.fixture(params=["de_DE", "ja_JP"])
def languages(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Languages:
    found = Languages(request.param)
    blender = SimpleNamespace(app=SimpleNamespace(translations=found))
    monkeypatch.setattr(addon, "bpy", blender)
    monkeypatch.setattr(table, "bpy", blender)
    table.register()
    return found


EXPECTED = {
    "de_DE": ("Kantenlänge", "Trainieren · 26 % · noch 1 min 30 s", "Fotos wählen", "3 Regionen"),
    "ja_JP": ("辺の長さ", "学習 · 26 % · 残り1 min 30 s", "写真を選択", "領域3個"),
}


def test_texts_are_drawn_in_the_language(languages: Languages) -> None:
    edge, progress, choose, regions = EXPECTED[languages.language]
    assert tr("Edge Length") == edge
    assert progress_text("train", 0.256, 90) == progress
    assert tr("{count} regions", count=3) == regions
    assert languages.pgettext_iface("Choose Photos", CONTEXT) == choose
    (dataset,) = (c for c in registration.CLASSES if getattr(c, "bl_label", "") == "Dataset")
    wanted = TEXTS["Photos of one object from all sides, in a folder of their own, or a video."]
    layout = draw(dataset)
    assert wanted[languages.language == "ja_JP"] in layout.texts.replace(
        "\n", " " if languages.language == "de_DE" else ""
    )
    assert layout.header == TEXTS["No photos"][languages.language == "ja_JP"]
    assert tr("There are no photos.") == "There are no photos.", "errors stay in English"
    assert tr("{a}", a="{b}") == "{b}"
    languages.language = "fr_FR"
    assert progress_text("train", 0.256, 90) == "Train · 26 % · 1 min 30 s left", "not translated"
    table.register()
    table.unregister()
    table.unregister()
    assert languages.known == {}
    assert tr("Edge Length") == "Edge Length"


def test_blenders_own_meanings_of_our_words_are_not_taken() -> None:
    for cls in registration.CLASSES:
        if issubclass(cls, (bpy.types.Panel, bpy.types.Menu, bpy.types.Operator)):
            assert cls.bl_translation_context == CONTEXT, cls.__name__
            if issubclass(cls, bpy.types.Operator):
                kind = getattr(bpy.ops.gwrap, cls.bl_idname.partition(".")[2]).get_rna_type()
                assert kind.translation_context == CONTEXT
    for group in (bpy.context.scene.gwrap, bpy.context.scene.gwrap.training):
        for name in type(group).__annotations__:
            assert group.bl_rna.properties[name].translation_context == CONTEXT, name
    tr_labels = [
        (path.name, node.lineno)
        for path in (*PACKAGE.glob("ops/**/*.py"), *PACKAGE.glob("ui/**/*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "label"
        if "translate" not in {keyword.arg for keyword in node.keywords}
    ]
    assert tr_labels == [], "a label has no context of its own: draw tr(text), untranslated"


def test_a_damaged_table_leaves_the_panel_in_english(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for text in (None, "{", "{}"):
        path = tmp_path / "table.json"
        if text is not None:
            path.write_text(text)
        monkeypatch.setattr(table, "TABLE", path)
        caplog.clear()
        table.register()
        assert [r.message for r in caplog.records] == ["the translations cannot be used"]


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("", [""]),
        ("one two three", ["one two", "three"]),
        ("写真を選択", ["写真を選", "択"]),
        ("写真を選。択", ["写真を選。", "択"]),
        ("写真 COLMAP を", ["写真", "COLMAP", "を"]),
        ("abcdefghijk写", ["abcdefgh", "ijk写"]),
        ("写 /a/long/path", ["写", "/a/long/", "path"]),
    ],
)
def test_lines_are_cut_by_width(text: str, lines: list[str]) -> None:
    assert wrapped(text, 8) == lines
