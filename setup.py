# SPDX-License-Identifier: GPL-3.0-or-later
"""Put the lists of the worker's packages into the wheel; everything else is in pyproject.toml."""

from __future__ import annotations

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithRequirements(build_py):
    """Copy the lists beside the package's modules, as the extension zip does."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for name in map(str, Path().glob("requirements-worker*.txt")):
                self.copy_file(name, str(Path(self.build_lib) / "gaussian_wrapping_addon" / name))


setup(cmdclass={"build_py": BuildWithRequirements})
