# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures for tests in the bpy module: a clean file, a private profile, the add-on registered."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

# Before the first import of bpy: no test may touch the profile of the person who runs it.
os.environ.setdefault("BLENDER_USER_RESOURCES", tempfile.mkdtemp(prefix="gwrap-profile-"))

bpy = pytest.importorskip("bpy", reason="needs the bpy wheel (pip install bpy==5.0.1)")

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.bpy)


@pytest.fixture(autouse=True)
def _clean_file() -> Iterator[None]:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    yield
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.fixture
def addon() -> Iterator[object]:
    """The add-on, registered for one test; leaving classes behind hangs some Blenders at exit."""
    import gaussian_wrapping_addon

    gaussian_wrapping_addon.register()
    try:
        yield gaussian_wrapping_addon
    finally:
        gaussian_wrapping_addon.unregister()
