#!/usr/bin/env python3
# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the extension zip: stage, validate, write the same bytes every time, validate again.

    python build_addon.py [--output DIR]

Blender wants ``blender_manifest.toml`` beside ``__init__.py`` at the top of the zip; here it lies
at the root of the repository. Needs only the standard library; Blender's own validator is used
where it is found (the bpy wheel, or ``blender`` on the path or in ``BLENDER``).
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent
PACKAGE = ROOT / "gaussian_wrapping_addon"
MANIFEST = "blender_manifest.toml"
BESIDE_THE_PACKAGE = (
    MANIFEST, "LICENSE", "requirements-worker.txt", "requirements-worker-hashes.txt",
)  # fmt: skip

# The earliest date that a zip can hold; every file gets it, so that the bytes do not depend on it.
FIXED_DATE = (1980, 1, 1, 0, 0, 0)
FILE_MODE = 0o644
MAX_ZIP_BYTES = 5 * 2**20
VALIDATE_DEADLINE_S = 120

REQUIRED = (
    "schema_version", "id", "version", "name", "tagline", "maintainer", "type",
    "blender_version_min", "license",
)  # fmt: skip
OPTIONAL = ("blender_version_max", "website", "copyright", "tags", "platforms", "permissions")
# Blender's list for add-ons; its validator does not check tags without being given one.
TAGS = (
    "3D View", "Add Curve", "Add Mesh", "Animation", "Bake", "Camera", "Compositing",
    "Development", "Game Engine", "Geometry Nodes", "Grease Pencil", "Import-Export", "Lighting",
    "Material", "Mesh", "Modeling", "Node", "Object", "Paint", "Physics", "Pipeline", "Render",
    "Rigging", "Scene", "Sculpt", "Sequencer", "System", "Text Editor", "Tracking",
    "User Interface", "UV",
)  # fmt: skip
PERMISSIONS = ("files", "network", "clipboard", "camera", "microphone")
OLDEST_BLENDER = (4, 2, 0)
LONGEST_LINE = 64


class BuildError(Exception):
    """The zip cannot be built; the message says why and what to do."""


def manifest_problems(text: str) -> list[str]:
    """Return what Blender's rules, and the ones that its validator forgets, find wrong."""
    try:
        manifest = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        return [f"not TOML: {error}"]
    problems = [f"{key} is missing" for key in REQUIRED if key not in manifest]
    problems += [f"{key} is unknown" for key in manifest if key not in REQUIRED + OPTIONAL]
    if problems:
        return problems
    lines = {"tagline": manifest["tagline"]}
    for name, reason in manifest.get("permissions", {}).items():
        if name not in PERMISSIONS:
            problems.append(f"permission {name} does not exist")
        lines[f"permission {name}"] = reason
    for name, line in lines.items():
        if not (isinstance(line, str) and 0 < len(line) <= LONGEST_LINE):
            problems.append(f"{name} must have 1 to {LONGEST_LINE} characters")
        elif not (line[-1].isalnum() or line[-1] in ")]}"):
            problems.append(f"{name} must not end in punctuation")
    if manifest["schema_version"] != "1.0.0":
        problems.append("schema_version must be 1.0.0")
    if manifest["type"] != "add-on":
        problems.append("type must be add-on")
    if manifest["id"] != PACKAGE.name:
        problems.append(f"id must be {PACKAGE.name}")
    if "blender" in manifest["name"].lower():
        problems.append("name must not hold the word Blender")
    if not re.fullmatch(r"\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?", manifest["version"]):
        problems.append("version must be semantic, such as 1.2.3")
    oldest = manifest["blender_version_min"]
    if not re.fullmatch(r"\d+\.\d+\.\d+", oldest):
        problems.append("blender_version_min must be three numbers")
    elif tuple(map(int, oldest.split("."))) < OLDEST_BLENDER:
        problems.append("blender_version_min must be 4.2.0 or later")
    licences = manifest["license"]
    if not isinstance(licences, list) or not all(str(x).startswith("SPDX:") for x in licences):
        problems.append("license must be a list of SPDX: identifiers")
    problems += [f"tag {tag} does not exist" for tag in manifest.get("tags", []) if tag not in TAGS]
    return problems


def package_files() -> dict[str, Path]:
    """Return what goes into the zip: name in it -> file.

    Raises
    ------
    BuildError
        A file is missing, is a link, or is a pointer of Git LFS.
    """
    files = {name: ROOT / name for name in BESIDE_THE_PACKAGE}
    files |= {path.name: path for path in ROOT.glob("requirements-worker-*-hashes.txt")}  # extras
    for path in PACKAGE.rglob("*"):
        inside = path.relative_to(PACKAGE)
        if path.is_file() and not any(
            p == "__pycache__" or p.startswith(".") for p in inside.parts
        ):
            files[inside.as_posix()] = path
    for name, path in files.items():
        if not path.is_file():
            raise BuildError(f"{name} is missing. Add it at {path}.")
        if path.is_symlink():
            raise BuildError(f"{name} is a link. Put the file itself there.")
        if path.read_bytes().startswith(b"version https://git-lfs"):
            raise BuildError(f"{name} is a Git LFS pointer. Run git lfs pull.")
    return dict(sorted(files.items()))


def find_validator() -> list[str] | None:
    """Return the command of Blender's validator, or None where there is none."""
    spec = importlib.util.find_spec("bpy")
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        for script in sorted(Path(folder).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")):
            return [sys.executable, str(script), "validate"]
    blender = os.environ.get("BLENDER") or shutil.which("blender")
    if blender:
        return [blender, "--factory-startup", "--command", "extension", "validate"]
    return None


def validate(command: list[str], target: Path) -> None:
    """Run Blender's validator on a folder or zip; :class:`BuildError` with its words."""
    try:
        done = subprocess.run(
            [*command, str(target)], capture_output=True, text=True, timeout=VALIDATE_DEADLINE_S
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"the validator does not run: {error}.") from None
    words = f"{done.stdout}\n{done.stderr}".strip()
    if done.returncode != 0 or "FATAL_ERROR" in words:
        raise BuildError(f"Blender refuses {target.name}: {words}")


def write_zip(files: dict[str, Path], target: Path) -> None:
    """Write a zip whose bytes depend on names and contents only."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, path in files.items():
            item = zipfile.ZipInfo(name, FIXED_DATE)
            item.compress_type = zipfile.ZIP_DEFLATED
            item.create_system = 3
            item.external_attr = FILE_MODE << 16
            archive.writestr(item, path.read_bytes())


def build(output: Path) -> Path:
    """Build the zip into a folder and return its path.

    Raises
    ------
    BuildError
        Something is missing or refused; nothing is left in the folder then.
    """
    files = package_files()
    text = files[MANIFEST].read_text(encoding="utf-8")
    problems = manifest_problems(text)
    if problems:
        raise BuildError(f"{MANIFEST}: {'; '.join(problems)}.")
    manifest = tomllib.loads(text)
    validator = find_validator()
    with tempfile.TemporaryDirectory(prefix="gwrap-build-") as folder:
        stage = Path(folder) / manifest["id"]
        for name, path in files.items():
            (stage / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, stage / name)
        if validator:
            validate(validator, stage)
        partial = Path(folder) / f"{manifest['id']}-{manifest['version']}.zip"
        write_zip({name: stage / name for name in files}, partial)
        if partial.stat().st_size > MAX_ZIP_BYTES:
            raise BuildError(f"the zip has {partial.stat().st_size} bytes; something is too large.")
        if validator:
            validate(validator, partial)
        else:
            print("warning: no bpy and no blender found; only our own manifest rules were checked")
        output.mkdir(parents=True, exist_ok=True)
        target = output / partial.name
        writing = target.with_suffix(".writing")
        shutil.copyfile(partial, writing)
        os.replace(writing, target)
    return target


def main() -> int:
    """Parse the command line, build, and list what is in the zip."""
    parser = argparse.ArgumentParser(description="Build the extension zip.")
    parser.add_argument("--output", type=Path, default=ROOT / "dist", metavar="DIR")
    options = parser.parse_args()
    try:
        target = build(options.output.resolve())
    except (BuildError, OSError) as error:
        print(f"build_addon: {error}", file=sys.stderr)
        return 1
    with zipfile.ZipFile(target) as archive:
        for item in archive.infolist():
            print(f"{item.file_size:9d}  {item.filename}")
    print(f"{target}: {target.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
