# SPDX-License-Identifier: GPL-3.0-or-later
"""Read XMP files beside the photos, as RealityScan and RealityCapture export them.

``xcr:Rotation`` leads from world to camera (x right, y down, z forward), row by row;
``xcr:Position`` is the camera's centre. Focal length in millimetres of a film 36 mm wide, principal
point in shares of the photo's long side from its middle, distortion ``k1 k2 k3 k4 t1 t2``.
"""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ....errors import ParseError
from ....report_warning import ReportWarning
from ...photos.photo_finder import list_photos
from ..source_model import Brown, RelativeLens, SourceModel
from .photo_list import PhotoList
from .realityscan_csv import FILM_WIDTH_MM
from .values import AGAIN, number, numbers, pose_at, rotation, unsupported
from .xml_file import read_xml

KIND = "RealityScan XMP"

_MAX_BYTES = 1024 * 1024
"""An XMP file of a photo takes about 2 kB; with a thumbnail from elsewhere, hundreds."""
_MARK = b"capturingreality.com/ns/xcr"
_POSE = b"Rotation"
_NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_WITHOUT_HINT = "Export the cameras again, or move the XMP files away to have all cameras solved."
_BROWN = ("brown3", "brown4", "brown3t2", "brown4t2")
_PLAIN = "perspective"
_NO_DIVISION = "Choose Brown as the distortion model in the alignment's settings, align and export."


def xmp_files(root: Path) -> dict[Path, Path]:
    """Return the XMP files of the program beside photos under ``root``: of each photo, its file."""
    found: dict[Path, Path] = {}
    used: set[Path] = set()
    for photo in list_photos(root):
        for suffix in (".xmp", ".XMP"):
            path = photo.with_suffix(suffix)
            if os.path.isfile(path) and path not in used and _is_of_program(path):
                found[photo] = path
                used.add(path)
                break
    return found


def _is_of_program(path: Path) -> bool:
    """Whether the file has a pose of the program.

    Other programs write XMP files as well, and this one also writes files without any.
    """
    try:
        with path.open("rb") as stream:
            text = stream.read(_MAX_BYTES)
            return _MARK in text and _POSE in text
    except OSError:
        return False


def read_xmp_files(root: Path, files: dict[Path, Path]) -> SourceModel:
    """Read the XMP files of photos under ``root``; they hold no points.

    Parameters
    ----------
    files : dict of Path to Path
        As of :func:`xmp_files`.

    Raises
    ------
    ParseError
        A file is broken; names it and the entry.
    DatasetError
        No photo is usable.
    """
    photos = PhotoList(root / "the XMP files")
    posed: dict[str, list[tuple[str, np.ndarray, RelativeLens]]] = {}
    for photo, path in files.items():
        name = photo.relative_to(root).as_posix()
        entry = _description(path)
        matrix = None if entry is None else _value(entry, "Rotation")
        center = None if entry is None else _value(entry, "Position")
        if entry is None or matrix is None or center is None:
            photos.leave_out(name, "no pose in their XMP file")
            continue
        turned = rotation(
            path, "xcr:Rotation", numbers(path, "xcr:Rotation", matrix, 9).reshape(3, 3)
        )
        pose = pose_at(turned, numbers(path, "xcr:Position", center, 3))
        component = _value(entry, "ComponentId") or ""
        posed.setdefault(component, []).append((name, pose, _lens(path, entry)))
    chosen = max(posed.values(), key=len, default=[])
    for entries in posed.values():
        for name, pose, lens in entries:
            if entries is chosen:
                photos.add(name, None, pose, relative=lens)
            else:
                photos.leave_out(name, "another component than the largest")
    usable = photos.finished()
    warnings = list(photos.warnings)
    without = len(list_photos(root)) - len(files)
    if without > 0:
        text = f"{without} photos have no camera of RealityScan beside them and are left out."
        warnings.append(ReportWarning("photos-without-camera", text, _WITHOUT_HINT))
    return SourceModel(KIND, usable, warnings=tuple(warnings), facts={"files": len(files)})


def _description(path: Path) -> Element | None:
    """Return the element that holds the program's values."""
    for element in read_xml(path, _MAX_BYTES).iter():
        names = (*element.attrib, *(child.tag for child in element))
        if any(name.startswith(_NAMESPACE) for name in names):
            return element
    return None


def _value(entry: Element, name: str) -> str | None:
    """Return a value, which may stand in an attribute or in an element."""
    value = entry.get(_NAMESPACE + name)
    return value if value is not None else entry.findtext(_NAMESPACE + name)


def _lens(path: Path, entry: Element) -> RelativeLens:
    def value(name: str, default: str) -> float:
        text = _value(entry, name)
        return number(path, f"xcr:{name}", default if text is None else text)

    if _value(entry, "FocalLength35mm") is None:
        raise ParseError(path, "xcr:FocalLength35mm", "the focal length is missing.", AGAIN)
    focal = value("FocalLength35mm", "0") / FILM_WIDTH_MM
    aspect = value("AspectRatio", "1")
    if focal <= 0 or aspect <= 0:
        raise ParseError(path, "xcr:FocalLength35mm", "a length is not positive.", AGAIN)
    offset = value("PrincipalPointU", "0"), value("PrincipalPointV", "0")
    model = _value(entry, "DistortionModel") or _PLAIN
    text = _value(entry, "DistortionCoeficients") or "0 0 0 0 0 0"
    k1, k2, k3, k4, t1, t2 = numbers(path, "xcr:DistortionCoeficients", text, 6).tolist()
    skew = value("Skew", "0")
    if skew:
        raise unsupported(
            path,
            "xcr:Skew",
            "a skewed camera",
            "Choose a distortion model without K+, align again.",
        )
    if model == _PLAIN or not any((k1, k2, k3, k4, t1, t2)):
        return RelativeLens(focal, aspect, offset, Brown())
    if model not in _BROWN:
        raise unsupported(path, "xcr:DistortionModel", f"the lens {model}", _NO_DIVISION)
    # The program's t1 and t2 are OpenCV's p2 and p1.
    return RelativeLens(focal, aspect, offset, Brown(k1, k2, k3, k4, p1=t2, p2=t1))
