# SPDX-License-Identifier: GPL-3.0-or-later
"""What readers of other programs' cameras share: numbers, lenses, XML, lists of photos."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from .. import limits
from ..errors import DatasetError, ParseError
from ..files import read_bounded
from ..progress import LEFT_OUT_HINT, ReportWarning
from .colmap import is_safe_name
from .source_model import LensCamera, PosedPhoto, RelativeLens

# -- Checked values of camera files: numbers, vectors, rotations, sizes ---------------------------

AGAIN = "Export the cameras again."
OPENGL_FROM_COLMAP = np.diag([1.0, -1.0, -1.0])
"""From x right, y down, z forward to x right, y up, z back."""

ROTATION_TOLERANCE = 1e-2
"""How far a matrix may be from a rotation; exporters write as few as 4 digits."""
_LARGEST = 1e15
"""Of a number in a file: the squares of larger ones leave no digits for a camera."""


@dataclass(frozen=True)
class CameraFile:
    """A file of another program, with checked values of it; errors name their place there."""

    path: Path

    def wrong(self, place: str, text: str, hint: str = AGAIN) -> ParseError:
        """Return the error for what is wrong at a place."""
        return ParseError(self.path, place, text, hint)

    def number(self, place: str, value: Any) -> float:
        """Return a finite number, also where the file writes it as text. Raises ParseError."""
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise self.wrong(place, "a number was expected.")
        try:
            result = float(value)
        except (ValueError, OverflowError):
            raise self.wrong(place, "a number was expected.") from None
        if not math.isfinite(result) or abs(result) > _LARGEST:
            raise self.wrong(place, "the number is not finite, or too large.")
        return result

    def numbers(self, place: str, values: Any, count: int) -> np.ndarray:
        """Return (count,) float64 of a list of numbers, or of a text with blanks between them.

        Raises ParseError.
        """
        if isinstance(values, str):
            values = values.split()
        if not isinstance(values, Sequence) or len(values) != count:
            raise self.wrong(place, f"{count} numbers were expected.")
        return np.array([self.number(f"{place}[{i}]", value) for i, value in enumerate(values)])

    def _whole(self, place: str, value: Any) -> int:
        """Return a whole number of at most 10 digits. Raises ParseError."""
        result = self.number(place, value)
        if result != round(result) or abs(result) > 1e10:
            raise self.wrong(place, "a whole number was expected.")
        return round(result)

    def image_size(self, place: str, width: Any, height: Any) -> tuple[int, int]:
        """Return a photo's width and height in pixels. Raises ParseError."""
        size = self._whole(f"{place}.width", width), self._whole(f"{place}.height", height)
        if not all(0 < side <= limits.MAX_IMAGE_SIDE_PX for side in size):
            raise self.wrong(place, f"image size {size[0]} x {size[1]} is out of range.")
        return size

    def rotation(self, place: str, matrix: np.ndarray) -> np.ndarray:
        """Return the rotation nearest to a (3, 3) matrix that is one but for the digits written.

        Raises ParseError: the matrix is not orthonormal, or it mirrors.
        """
        u, sizes, vt = np.linalg.svd(matrix)
        nearest: np.ndarray = u @ vt
        if np.abs(sizes - 1.0).max() > ROTATION_TOLERANCE:
            raise self.wrong(place, "the matrix is not a rotation.")
        if np.linalg.det(nearest) < 0:
            raise self.wrong(place, "the matrix mirrors; a rotation was expected.")
        return nearest

    def lens(self, place: str, lens: LensCamera) -> LensCamera:
        """Return the lens, or raise :class:`ParseError` with what makes it unusable."""
        if problem := lens.problem():
            raise self.wrong(place, f"{problem}.")
        return lens

    def points(
        self, place: str, entries: Iterable[tuple[str, Any]], position: str, count: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, 3) float64 positions and (n, 3) uint8 colours of the file's ``count`` points.

        ``entries``: the place and the object of each, whose position has the name ``position``.
        """
        if count > limits.MAX_POINTS:
            raise self.wrong(place, f"{count} points are too many.")
        points = np.zeros((count, 3))
        colors = np.full((count, 3), 128, np.uint8)
        for i, (here, entry) in enumerate(entries):
            if not isinstance(entry, dict):
                raise self.wrong(here, "an object was expected.")
            points[i] = self.numbers(f"{here}.{position}", entry.get(position), 3)
            if "color" in entry:
                color = self.numbers(f"{here}.color", entry["color"], 3)
                colors[i] = color.clip(0, 255).astype(np.uint8)
        return points, colors

    def unsupported(self, place: str, what: str, hint: str) -> ParseError:
        """Return the error for a lens or an option that no model here can express."""
        return self.wrong(place, f"{what[:80]} is not supported.", hint)


def begins_with(path: Path, suffix: str, most_bytes: int) -> bytes:
    """Return the beginning of a file of a suffix; empty where it is none, or cannot be read."""
    if path.suffix.lower() != suffix or not path.is_file():
        return b""
    try:
        with path.open("rb") as stream:
            return stream.read(most_bytes)
    except OSError:
        return b""


# -- Fisheye lenses of other programs as COLMAP's models ------------------------------------------


def fisheye_lens(
    width: int,
    height: int,
    focal: tuple[float, float],
    center: tuple[float, float],
    k: tuple[float, float, float, float],
    p: tuple[float, float] = (0.0, 0.0),
) -> LensCamera:
    """Return an equidistant fisheye: OPENCV_FISHEYE, or THIN_PRISM_FISHEYE where it is decentred.

    ``k`` are the coefficients of the angle's powers 3, 5, 7 and 9, ``p`` the tangential ones as of
    OpenCV, applied to the ray's direction at a length of its angle.
    """
    if not any(p):
        return LensCamera("OPENCV_FISHEYE", width, height, (*focal, *center, *k))
    params = (*focal, *center, k[0], k[1], *p, k[2], k[3], 0.0, 0.0)
    return LensCamera("THIN_PRISM_FISHEYE", width, height, params)


# -- Bounded reader of XML: no document types, no entities, limits on size, depth and elements ----

MAX_XML_BYTES = 64 * 1024 * 1024
"""A camera of a Metashape project takes about 1 kB: 64 MB are 60 000 of them."""
_MAX_ELEMENTS = 4_000_000
"""Memory of the tree: about 0.3 kB an element."""
_AGAIN = "Export the file again."


class _RefusedError(Exception):
    """What the file holds is not read: the reason is the argument."""


def read_xml(path: Path, most_bytes: int = MAX_XML_BYTES) -> Element:
    """Read an XML file and return its root; names with a namespace are ``{uri}name``.

    Raises ParseError: not XML, larger or deeper than the limits, or with a document type or
    entities, which a hostile file uses to expand without bounds or to name other files.
    """
    try:
        data = read_bounded(path, most_bytes, follow_links=True)
    except PermissionError as error:
        text = f"cannot be read: {error.strerror}."
        raise ParseError(path, "whole file", text, "Check its permissions.") from error
    parser = expat.ParserCreate(namespace_separator="}")
    parser.buffer_text = True
    builder = TreeBuilder()
    depth = elements = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, elements
        depth += 1
        elements += 1
        if depth > limits.MAX_JSON_DEPTH:
            raise _RefusedError("nested too deeply.")
        if elements > _MAX_ELEMENTS:
            raise _RefusedError(f"more than {_MAX_ELEMENTS} elements are too many.")
        builder.start(_full(tag), {_full(key): value for key, value in attributes.items()})

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(_full(tag))

    def refuse(*_: object) -> int:
        raise _RefusedError("document types and entities are not read.")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.ExternalEntityRefHandler = refuse
    try:
        parser.Parse(data, True)
    except _RefusedError as error:
        raise ParseError(path, f"line {parser.CurrentLineNumber}", str(error), _AGAIN) from None
    except (expat.ExpatError, ValueError, LookupError) as error:
        # Besides its own errors expat raises those of Python's decoders.
        reason = expat.errors.messages.get(getattr(error, "code", -1), str(error))
        place = f"line {parser.CurrentLineNumber}"
        raise ParseError(path, place, f"not XML: {reason}.", _AGAIN) from None
    return builder.close()


def _full(name: str) -> str:
    """Return a name as ElementTree writes it: expat gives ``uri}name``."""
    return f"{{{name}" if "}" in name else name


# -- Photos of a camera file, collected: names made relative, unusable ones counted and left out

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
    """Collects the photos that a camera file poses."""

    path: Path
    """The camera file."""
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
    ) -> None:
        """Take a photo over, unless its name is unsafe or was used before.

        One without a lens of either kind is a panorama.
        """
        if not is_safe_name(self.path.parent, name):
            self.leave_out(name, "a name that is empty, too long or leads outside the folder")
        elif name in self._names:
            self.leave_out(name, "a name that was used before")
        else:
            self.offered += 1
            self._names.add(name)
            self.photos.append(PosedPhoto(name, lens, cam_from_world, relative=relative))

    def leave_out(self, name: str, reason: str) -> None:
        """Count a photo that is not used."""
        self.offered += 1
        self._left_out.setdefault(reason, []).append(repr(name[:80]))

    def warn(self, code: str, text: str, hint: str) -> None:
        """Add a warning."""
        self.warnings.append(ReportWarning(code, text, hint))

    def finished(self) -> tuple[PosedPhoto, ...]:
        """Return the photos; what was left out becomes warnings.

        Raises DatasetError: None is usable.
        """
        for reason, names in self._left_out.items():
            listed = ", ".join(names[:_EXAMPLES]) + (" ..." if len(names) > _EXAMPLES else "")
            text = f"{len(names)} photos were left out for {reason}: {listed}."
            self.warn("images-left-out", text, LEFT_OUT_HINT)
        if not self.photos:
            text = f"None of the {self.offered} photos of {self.path.name} is usable."
            hint = " ".join([*(warning.text for warning in self.warnings[:3]), AGAIN])
            raise DatasetError(text, hint)
        return tuple(self.photos)
