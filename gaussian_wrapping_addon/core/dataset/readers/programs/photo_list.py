# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a camera file, collected: names made relative, unusable ones counted and left out."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from .... import limits
from ....errors import DatasetError, ParseError
from ....report_warning import LEFT_OUT_HINT, ReportWarning
from ..colmap_reader import is_safe_name
from ..source_model import LensCamera, PosedPhoto, RelativeLens
from .values import AGAIN

_EXAMPLES = 3
"""Names quoted in a warning about several photos."""
_ABSOLUTE = re.compile(r"^(/|[A-Za-z]:|file:)")


def relative_names(names: Iterable[str]) -> dict[str, str]:
    """Return names relative to the photos' folder: of each name of a file, the one to look up.

    Absolute names are of another computer, or another folder of this one, which a file must not
    choose: what all of them have in common is taken away. A name that leads upwards keeps its last
    part.
    """
    clean = {name: name.replace("\\", "/").strip() for name in names}
    absolute = [text for text in clean.values() if _ABSOLUTE.match(text)]
    folders = [PurePosixPath(text).parent.parts for text in absolute]
    common = 0
    if folders:
        shortest = min(len(parts) for parts in folders)
        while common < shortest and len({parts[common] for parts in folders}) == 1:
            common += 1
    result = {}
    for name, text in clean.items():
        parts = [part for part in PurePosixPath(text).parts if part != "."]
        if _ABSOLUTE.match(text):
            parts = parts[common:]
        while parts and _ABSOLUTE.match(parts[0]):  # drives differ
            parts = parts[1:]
        if ".." in parts:
            parts = parts[-1:]
        result[name] = "/".join(parts)
    return result


@dataclass
class PhotoList:
    """Collects the photos that a camera file poses.

    Parameters
    ----------
    path : Path
        The camera file.
    """

    path: Path
    photos: list[PosedPhoto] = field(default_factory=list)
    warnings: list[ReportWarning] = field(default_factory=list)
    offered: int = 0
    _left_out: dict[str, list[str]] = field(default_factory=dict)
    _names: set[str] = field(default_factory=set)

    def check_count(self, place: str, count: int) -> None:
        """Raise :class:`ParseError` where a file lists none or too many."""
        if not count:
            raise ParseError(self.path, place, "at least one was expected.", AGAIN)
        if count > limits.MAX_IMAGES:
            raise ParseError(self.path, place, f"{count} are too many.", "Split the project.")

    def add(
        self,
        name: str,
        lens: LensCamera | None,
        cam_from_world: np.ndarray,
        relative: RelativeLens | None = None,
        *,
        is_panorama: bool = False,
    ) -> None:
        """Take a photo over, unless its name is unsafe or was used before."""
        if not is_safe_name(self.path.parent, name):
            self.leave_out(name, "a name that is empty, too long or leads outside the folder")
        elif name in self._names:
            self.leave_out(name, "a name that was used before")
        else:
            self.offered += 1
            self._names.add(name)
            self.photos.append(
                PosedPhoto(name, lens, cam_from_world, relative=relative, is_panorama=is_panorama)
            )

    def leave_out(self, name: str, reason: str) -> None:
        """Count a photo that is not used."""
        self.offered += 1
        self._left_out.setdefault(reason, []).append(repr(name[:80]))

    def warn(self, code: str, text: str, hint: str = "") -> None:
        """Add a warning."""
        self.warnings.append(ReportWarning(code, text, hint))

    def finished(self) -> tuple[PosedPhoto, ...]:
        """Return the photos; what was left out becomes warnings.

        Raises
        ------
        DatasetError
            None is usable.
        """
        for reason, names in self._left_out.items():
            listed = ", ".join(names[:_EXAMPLES]) + (" ..." if len(names) > _EXAMPLES else "")
            self.warn(
                "images-left-out",
                f"{len(names)} photos were left out for {reason}: {listed}.",
                LEFT_OUT_HINT,
            )
        if not self.photos:
            raise DatasetError(
                f"None of the {self.offered} photos of {self.path.name} is usable.",
                " ".join([*(warning.text for warning in self.warnings[:3]), AGAIN]),
            )
        return tuple(self.photos)
