# SPDX-License-Identifier: GPL-3.0-or-later
"""A layout that checks each call of a panel against Blender's own description of layouts."""

from __future__ import annotations

from dataclasses import dataclass
from types import MethodType, SimpleNamespace
from typing import Any

import bpy

_CHILDREN = ("row", "column", "box", "split", "grid_flow", "column_flow")


class _OperatorProperties:
    """Accepts only properties that the operator has."""

    def __init__(self, known: set[str]) -> None:
        object.__setattr__(self, "_known", known)

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self._known, f"the operator has no property {name}"


@dataclass(frozen=True)
class Button:
    """An operator as it was drawn."""

    operator: str
    text: str
    layout: FakeLayout

    @property
    def enabled(self) -> bool:
        """Whether the panel leaves it to be pressed (its poll may still refuse)."""
        return all(part.values.get("enabled", True) for part in self.layout.chain)

    @property
    def large(self) -> bool:
        """Whether it is drawn higher than others."""
        return any(part.values.get("scale_y", 1.0) > 1.2 for part in self.layout.chain)


@dataclass(frozen=True)
class Field:
    """A property as it was drawn."""

    name: str
    layout: FakeLayout

    @property
    def enabled(self) -> bool:
        """Whether it can be changed."""
        return all(part.values.get("enabled", True) for part in self.layout.chain)


class FakeLayout:
    """Records ``(name, arguments, keywords)`` of every call, also those of its children."""

    def __init__(self, parent: FakeLayout | None = None) -> None:
        object.__setattr__(self, "log", [] if parent is None else parent.log)
        object.__setattr__(self, "buttons", [] if parent is None else parent.buttons)
        object.__setattr__(self, "fields", [] if parent is None else parent.fields)
        object.__setattr__(self, "chain", [self] if parent is None else [*parent.chain, self])
        object.__setattr__(self, "values", {})
        object.__setattr__(self, "header", "")

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in bpy.types.UILayout.bl_rna.properties, name
        self.values[name] = value

    def __getattr__(self, name: str) -> Any:
        function = bpy.types.UILayout.bl_rna.functions.get(name)
        if function is None:
            if name in bpy.types.UILayout.bl_rna.properties:
                return self.values.get(name)
            raise AttributeError(f"UILayout has no {name}")
        known = {p.identifier for p in function.parameters}
        known |= {"text", "icon", "text_ctxt", "translate"}
        icons = bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items.keys()

        def call(*arguments: Any, **keywords: Any) -> Any:
            assert set(keywords) <= known, (name, set(keywords) - known)
            assert keywords.get("icon", "NONE") in icons, keywords["icon"]
            self.log.append((name, arguments, keywords))
            if name == "prop":
                assert arguments[1] in arguments[0].bl_rna.properties, arguments[1]
                self.fields.append(Field(arguments[1], self))
            if name == "progress":
                assert 0.0 <= keywords["factor"] <= 1.0
            if name.startswith("operator"):
                module, operator = arguments[0].split(".")
                kind = getattr(getattr(bpy.ops, module), operator).get_rna_type()
                text = keywords.get("text", kind.name)
                self.buttons.append(Button(arguments[0], text, self))
                if name == "operator_menu_enum":
                    assert arguments[1] in kind.properties
                return _OperatorProperties(set(kind.properties.keys()))
            return FakeLayout(self) if name in _CHILDREN else None

        return call

    @property
    def texts(self) -> str:
        """All texts drawn, one a line."""
        return "\n".join(str(k["text"]) for _, _, k in self.log if k.get("text"))

    @property
    def operators(self) -> list[str]:
        """Ids of the operators drawn."""
        return [a[0] for name, a, _ in self.log if name.startswith("operator")]


def draw(panel: type) -> FakeLayout:
    """Let a panel draw itself in the present context; ``header`` has the texts of its header."""
    layout = FakeLayout()
    if hasattr(panel, "draw_header_preset"):
        header = FakeLayout()
        panel.draw_header_preset(_standing_for(panel, header), bpy.context)
        object.__setattr__(layout, "header", header.texts)
    panel.draw(_standing_for(panel, layout), bpy.context)  # type: ignore[attr-defined]
    return layout


def _standing_for(panel: type, layout: FakeLayout) -> Any:
    """Return an object with the panel's own methods: Blender makes no panels for us."""
    fake = SimpleNamespace(layout=layout)
    for cls in reversed(panel.__mro__):
        if cls.__module__.startswith("gaussian_wrapping_addon"):
            for name, method in vars(cls).items():
                if callable(method) and not name.startswith("__"):
                    setattr(fake, name, MethodType(method, fake))
    return fake
