# SPDX-License-Identifier: GPL-3.0-or-later
"""Registering is symmetric, repeatable, and survives its own failures."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import bpy
import pytest

import gaussian_wrapping_addon
from gaussian_wrapping_addon import registration
from gaussian_wrapping_addon.ops import background, job_timer, jobs
from gaussian_wrapping_addon.ui import job_view, region_panel

REPOSITORY = Path(gaussian_wrapping_addon.__file__).resolve().parents[1]


def left_behind() -> list[str]:
    found = [name for name in dir(bpy.types) if name.upper().startswith("GWRAP")]
    found += [o.__name__ for o in (bpy.types.Scene, bpy.types.Object) if hasattr(o, "gwrap")]
    for name in dir(bpy.app.handlers):
        handlers = getattr(bpy.app.handlers, name)
        if isinstance(handlers, list):
            found += [name for h in handlers if "gaussian_wrapping" in h.__module__]
    bar = bpy.types.STATUSBAR_HT_header._dyn_ui_initialize()
    found += [f.__name__ for f in bar if "gaussian_wrapping" in f.__module__]
    views = (job_view.VIEW, region_panel.VIEW)
    found += ["drawing" for view in views if view.handle is not None]
    found += ["batches"] if region_panel._drawing.batches else []
    if bpy.app.timers.is_registered(background.poll):
        found.append("poll")
    return found


BASES = (
    bpy.types.Operator,
    bpy.types.Panel,
    bpy.types.PropertyGroup,
    bpy.types.AddonPreferences,
    bpy.types.GizmoGroup,
    bpy.types.Menu,
)


def is_there(cls: type) -> bool:
    """Tell whether Blender knows a class, and this one of its name."""
    (base,) = (base for base in BASES if issubclass(cls, base))
    return bool(base.bl_rna_get_subclass_py(cls.__name__) is cls)


def test_register_and_unregister_twice() -> None:
    assert left_behind() == []
    for _ in range(2):
        gaussian_wrapping_addon.register()
        assert [cls.__name__ for cls in registration.CLASSES if not is_there(cls)] == []
        assert None not in (job_view.VIEW.handle, region_panel.VIEW.handle)
        for name, handler in registration.HANDLERS:
            assert getattr(bpy.app.handlers, name).count(handler) == 1
        job_timer.start_timer()
        gaussian_wrapping_addon.unregister()
        assert left_behind() == []
        assert [cls.__name__ for cls in registration.CLASSES if is_there(cls)] == []
        assert [c.__name__ for c in registration.CLASSES if "bl_rna" in c.__dict__] == []
    gaussian_wrapping_addon.unregister()


def test_register_after_register_doubles_nothing() -> None:
    gaussian_wrapping_addon.register()
    gaussian_wrapping_addon.register()
    assert bpy.app.handlers.load_post.count(jobs.after_load) == 1
    bar = bpy.types.STATUSBAR_HT_header._dyn_ui_initialize()
    assert bar.count(job_view.draw) == 1
    gaussian_wrapping_addon.unregister()
    assert left_behind() == []


def test_a_failure_half_way_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    class GwrapBroken(bpy.types.Operator):
        bl_idname = "not.a.valid.id"
        bl_label = "Broken"

    classes = (*registration.CLASSES[:7], GwrapBroken, *registration.CLASSES[7:])
    with monkeypatch.context() as patch:
        patch.setattr(registration, "CLASSES", classes)
        with pytest.raises((ValueError, RuntimeError)):
            gaussian_wrapping_addon.register()
        assert left_behind() == []
    gaussian_wrapping_addon.register()
    gaussian_wrapping_addon.unregister()


def test_names_follow_blenders_convention() -> None:
    for cls in registration.CLASSES:
        if issubclass(cls, bpy.types.Operator):
            assert cls.__name__.replace("GWRAP_OT_", "gwrap.") == cls.bl_idname
            assert cls.bl_description
            assert not cls.bl_description.endswith(".")
        elif issubclass(cls, bpy.types.Panel):
            assert cls.__name__.startswith("GWRAP_PT_")
            assert cls.bl_category == "Gaussian Wrapping"


def test_blender_never_loads_what_only_workers_have(tmp_path: Path) -> None:
    """Register, draw and import in a fresh Blender: torch and its kind stay out."""
    code = f"""
import os, sys
os.environ["BLENDER_USER_RESOURCES"] = {str(tmp_path)!r}
sys.path.insert(0, {str(REPOSITORY)!r})
import bpy
from pathlib import Path
import gaussian_wrapping_addon
from tests.blender.synthetic_result import write_result
from tests.blender.fake_layout import draw
gaussian_wrapping_addon.register()
from gaussian_wrapping_addon.registration import CLASSES
bpy.ops.gwrap.import_result(directory=str(write_result(Path({str(tmp_path)!r}) / "job")))
for panel in CLASSES:
    if issubclass(panel, bpy.types.Panel):
        draw(panel)
gaussian_wrapping_addon.unregister()
heavy = {{"torch", "numba", "scipy", "pycolmap", "xatlas", "trimesh", "shull", "igl", "PIL"}}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_package_imports_without_bpy() -> None:
    code = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('bpy', 'mathutils', 'bmesh'):\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        f"sys.path.insert(0, {str(REPOSITORY)!r})\n"
        "import gaussian_wrapping_addon, gaussian_wrapping_addon.ops, gaussian_wrapping_addon.ui\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


def properties_of(base: type) -> dict[str, dict[str, object]]:
    """Return the keywords of every property that a kind of our classes declares."""
    return {
        f"{cls.__name__}.{name}": declared.keywords
        for cls in registration.CLASSES
        if issubclass(cls, base)
        for name, declared in cls.__annotations__.items()
    }


def test_no_property_has_a_callback() -> None:
    """One that ever had crashes Blender 4.2 at exit, even when it was unregistered."""
    found = properties_of(bpy.types.PropertyGroup) | properties_of(bpy.types.AddonPreferences)
    assert {"GWRAP_PG_scene.points", "GWRAP_preferences.threads"} <= set(found)
    callbacks = {"update", "get", "set", "poll", "search"}
    assert [name for name, keywords in found.items() if callbacks & set(keywords)] == []


def test_no_program_path_comes_from_a_file() -> None:
    """The worker's Python is read from preferences only, never from scene or object properties."""
    names = {name.rpartition(".")[2] for name in properties_of(bpy.types.PropertyGroup)}
    assert {"source", "start_splat"} <= names
    assert not [n for n in names if "python" in n or "program" in n or "executable" in n]
