# SPDX-License-Identifier: GPL-3.0-or-later
"""A layout that checks each call of a panel against Blender's own description of layouts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import bpy

_CHILDREN = ("row", "column", "box", "split", "grid_flow", "column_flow")


class _OperatorProperties:
    """Accepts only properties that the operator has."""

    def __init__(self, known: set[str]) -> None:
        object.__setattr__(self, "_known", known)

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self._known, f"the operator has no property {name}"


class FakeLayout:
    """Records ``(name, arguments, keywords)`` of every call, also those of its children."""

    def __init__(self, log: list[tuple[str, tuple, dict]] | None = None) -> None:
        object.__setattr__(self, "log", [] if log is None else log)
        object.__setattr__(self, "values", {})

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
            if name == "progress":
                assert 0.0 <= keywords["factor"] <= 1.0
            if name.startswith("operator"):
                module, operator = arguments[0].split(".")
                kind = getattr(getattr(bpy.ops, module), operator).get_rna_type()
                if name == "operator_menu_enum":
                    assert arguments[1] in kind.properties
                return _OperatorProperties(set(kind.properties.keys()))
            return FakeLayout(self.log) if name in _CHILDREN else None

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
    """Let a panel draw itself in the present context."""
    layout = FakeLayout()
    methods = {k: v for k, v in vars(panel).items() if callable(v) and k.startswith("_")}
    fake = SimpleNamespace(layout=layout)
    for name, method in methods.items():
        if not name.startswith("__"):
            setattr(fake, name, method.__get__(fake))
    panel.draw(fake, bpy.context)  # type: ignore[attr-defined]
    return layout
