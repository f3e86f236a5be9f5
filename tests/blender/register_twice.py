# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs in any Blender without a window: install the zip, register twice, draw, leave cleanly.

``GW_ZIP`` is the extension; ``BLENDER_USER_RESOURCES`` an empty profile. Prints ``REGISTERED`` and
the versions as its last line.
"""

from __future__ import annotations

import os
import sys

import bpy

NAME = "bl_ext.user_default.gaussian_wrapping_addon"


def is_there() -> bool:
    """Tell whether the add-on's classes and properties are registered."""
    return hasattr(bpy.types.Scene, "gwrap") and hasattr(bpy.types, "GWRAP_OT_wrap_scene")


def main() -> None:
    """Go through installation and removal; an assertion ends it."""
    bpy.ops.extensions.package_install_files(
        filepath=os.environ["GW_ZIP"], repo="user_default", enable_on_install=True
    )
    assert is_there(), "enabled by the installation"
    for _ in range(2):
        bpy.ops.preferences.addon_disable(module=NAME)
        assert not is_there(), "disabled"
        left = [n for n in dir(bpy.types) if n.startswith("GWRAP_")]
        assert left == [], left
        bpy.ops.preferences.addon_enable(module=NAME)
        assert is_there(), "enabled again"
    registration = sys.modules[NAME + ".registration"]
    registration.register()  # as "Reload Scripts" does: once more without a word in between
    assert is_there()
    assert bpy.ops.gwrap.wrap_scene.get_rna_type() is not None
    bpy.ops.preferences.addon_disable(module=NAME)
    assert not is_there(), "gone at the end"
    package = NAME.rpartition(".")[2]
    bpy.ops.extensions.package_uninstall(repo_index=user_repository(), pkg_id=package)
    version = ".".join(map(str, bpy.app.version))
    print("REGISTERED", version, sys.version.split()[0], flush=True)


def user_repository() -> int:
    """Return the place of the repository that was installed into."""
    repositories = bpy.context.preferences.extensions.repos
    return next(i for i, r in enumerate(repositories) if r.module == "user_default")


main()
