# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension zip: rules of the manifest, the same bytes twice, and a clean installation."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def build_addon() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_addon", REPOSITORY / "build_addon.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def built(build_addon: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_addon.build(tmp_path_factory.mktemp("dist"))


def test_the_zip_is_reproducible(build_addon: ModuleType, built: Path, tmp_path: Path) -> None:
    assert build_addon.build(tmp_path).read_bytes() == built.read_bytes()


def test_the_zip_holds_the_package_and_nothing_else(built: Path) -> None:
    with zipfile.ZipFile(built) as archive:
        names = archive.namelist()
        assert archive.testzip() is None
    assert names == sorted(names)
    top = {name for name in names if "/" not in name}
    assert {"__init__.py", "blender_manifest.toml", "LICENSE", "registration.py"} <= top
    wrong = [
        n
        for n in names
        if "__pycache__" in n or n.endswith((".pyc", ".nbi")) or "test" in n.lower()
    ]
    assert wrong == []
    assert built.stat().st_size < 2 * 2**20, "pure Python stays under two megabytes"


def test_blenders_validator_was_found_and_accepts_the_zip(
    build_addon: ModuleType, built: Path
) -> None:
    command = build_addon.find_validator()
    assert command is not None, "the bpy wheel holds it"
    build_addon.validate(command, built)


MANIFEST = (REPOSITORY / "blender_manifest.toml").read_text()


def test_our_manifest_is_good(build_addon: ModuleType) -> None:
    assert build_addon.manifest_problems(MANIFEST) == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('id = "gaussian_wrapping_addon"', 'id = "other"', "id must be"),
        ('version = "0.1.0"', 'version = "0.1"', "semantic"),
        ('min = "4.2.0"', 'min = "4.1.0"', "4.2.0 or later"),
        ('min = "4.2.0"', 'min = "4.2"', "three numbers"),
        ("meshes out", "meshes out.", "punctuation"),
        ("meshes out", "meshes out" * 9, "64 characters"),
        ("[permissions]", "[permissions]\ndisk = 'x'", "permission disk"),
        ('"SPDX:GPL', '"GPL', "SPDX"),
        ('"3D View"', '"Mesh Making"', "tag Mesh Making"),
        ("tags =", "labels = ['x']\ntags =", "labels is unknown"),
        ('name = "Gaussian Wrapping"', 'name = "Wrap for Blender"', "the word Blender"),
        ('type = "add-on"', "", "type is missing"),
        ("schema_version", "{", "not TOML"),
    ],
)
def test_manifest_rules(build_addon: ModuleType, old: str, new: str, words: str) -> None:
    assert old in MANIFEST
    problems = build_addon.manifest_problems(MANIFEST.replace(old, new, 1))
    assert any(words in p for p in problems), problems


def test_a_build_that_cannot_work_says_why(
    build_addon: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build_addon, "BESIDE_THE_PACKAGE", ("no-such-file",))
    with pytest.raises(build_addon.BuildError, match="no-such-file is missing"):
        build_addon.build(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_version_is_the_one_of_pyproject() -> None:
    import tomllib

    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    assert project["project"]["version"] == tomllib.loads(MANIFEST)["version"]


INSTALL = """
import bpy, sys
from pathlib import Path
bpy.ops.extensions.package_install_files(
    filepath={zip!r}, repo="user_default", enable_on_install=True
)
name = "bl_ext.user_default.gaussian_wrapping_addon"
preferences = bpy.context.preferences.addons[name].preferences
preferences.threads = 3
preferences.device = "CPU"
preferences.worker_python = {python!r}
assert "gaussian_wrapping_addon" not in sys.modules
workers = sys.modules[name + ".ops.worker_setup"]
choice = workers.worker_choice(bpy.context)
assert (choice.threads, choice.python, choice.device) == (3, {python!r}, "cpu"), choice
import time
scene = bpy.context.scene
scene.gwrap.source = {photos!r}
assert bpy.ops.gwrap.wrap_scene() == {{"FINISHED"}}
timer = sys.modules[name + ".ops.job_timer"]
end_s = time.monotonic() + 60
while timer.poll_jobs() and time.monotonic() < end_s:
    time.sleep(0.1)
watched = sys.modules[name + ".ops.job_timer"]
status = watched.status_of(scene.gwrap.job_folder)
print("STATUS", status.state, status.error)
known = Path(bpy.utils.extension_path_user(name)) / "known_jobs.json"
assert scene.gwrap.job_folder in known.read_text()
bpy.ops.preferences.addon_disable(module=name)
assert not hasattr(bpy.types.Scene, "gwrap")
bpy.ops.preferences.addon_enable(module=name)
assert hasattr(bpy.types.Scene, "gwrap")
"""


def test_the_zip_installs_enables_and_reaches_the_real_worker(built: Path, tmp_path: Path) -> None:
    """In a clean profile; the real worker refuses a folder without photos, in its own words."""
    photos = tmp_path / "photos"
    photos.mkdir()
    code = INSTALL.format(zip=str(built), python=sys.executable, photos=str(photos))
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
        env={
            "PATH": "/usr/bin:/bin",
            "HOME": str(tmp_path),
            "BLENDER_USER_RESOURCES": str(tmp_path / "profile"),
        },
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "STATUS FAILED" in done.stdout, done.stdout
    installed = tmp_path / "profile" / "extensions" / "user_default" / "gaussian_wrapping_addon"
    assert (installed / "blender_manifest.toml").is_file()
