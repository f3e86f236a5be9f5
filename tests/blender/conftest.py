# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures for tests in the bpy module: a clean file, a private profile, the add-on registered."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

# Before the first import of bpy: no test may touch the profile of the person who runs it. The
# processes of pytest-xdist may inherit the variable, but each needs a profile of its own.
if "BLENDER_USER_RESOURCES" not in os.environ or "PYTEST_XDIST_WORKER" in os.environ:
    _profile = tempfile.mkdtemp(prefix="gwrap-profile-")
    os.environ["BLENDER_USER_RESOURCES"] = _profile
    atexit.register(shutil.rmtree, _profile, ignore_errors=True)

try:
    import bpy
except ModuleNotFoundError:
    bpy = None

HERE = Path(__file__).parent


class _SkippedModule(pytest.Module):
    """A test module that cannot even be imported here."""

    def collect(self) -> Iterable[pytest.Item]:
        pytest.skip("needs the bpy wheel (pip install bpy==5.0.1)", allow_module_level=True)


def pytest_pycollect_makemodule(
    module_path: Path, parent: pytest.Collector
) -> pytest.Module | None:
    if bpy is None and module_path.is_relative_to(HERE):
        return _SkippedModule.from_parent(parent, path=module_path)
    return None


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
def addon(monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """The add-on, registered for one test; leaving classes behind hangs some Blenders at exit."""
    import gaussian_wrapping_addon
    from gaussian_wrapping_addon.ops import job_timer

    # One look at a job is enough, however busy the machine is.
    monkeypatch.setattr(job_timer, "POLL_WAIT_S", 30.0)
    gaussian_wrapping_addon.register()
    try:
        yield gaussian_wrapping_addon
    finally:
        gaussian_wrapping_addon.unregister()


@pytest.fixture
def ended_workers(addon: object, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No job of a test is known to others; its workers end before ``addon`` forgets them."""
    from gaussian_wrapping_addon.ops import addon as known_jobs
    from gaussian_wrapping_addon.ops import job_timer
    from gaussian_wrapping_addon.ops import job_timer as watched_jobs

    monkeypatch.setattr(known_jobs, "_session", [])
    yield
    for job in watched_jobs.jobs.values():
        if job.client.poll().active:
            job.client.kill()
            assert not job.client.poll().active, "a worker outlived its test"
    job_timer.forget_all_jobs()


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """An empty folder for photos, whose name is not plain ASCII."""
    folder = tmp_path / "photos of été"
    folder.mkdir()
    return folder


@pytest.fixture
def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Put the fake in the place of the worker's Python; the value says what it does, and where."""
    from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
    from tests.blender.job_play import write_fake_python

    monkeypatch.setenv(PYTHON_VARIABLE, str(write_fake_python(tmp_path)))

    def behave(mode: str, stage: str = "train") -> None:
        monkeypatch.setenv("GW_FAKE", mode)
        monkeypatch.setenv("GW_FAKE_STAGE", stage)

    behave("quick")
    return behave
