# SPDX-License-Identifier: GPL-3.0-or-later
"""Find the camera file of a program in an input, and read it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..errors import DatasetError
from ..photos.finder import PHOTO_FOLDERS, photo_root
from . import meshroom, metashape, opensfm, polycam, realityscan
from .source_model import SourceModel


@dataclass(frozen=True)
class _Format:
    kind: str
    is_file: Callable[[Path], bool]
    read: Callable[[Path], SourceModel]
    folders: tuple[str, ...] = (".",)
    """Folders of an input that may hold the file, in order."""


_FORMATS = (
    _Format(opensfm.KIND, opensfm.is_opensfm, opensfm.read_opensfm, (".", "opensfm")),
    _Format(meshroom.KIND, meshroom.is_meshroom, meshroom.read_meshroom),
    _Format(metashape.KIND, metashape.is_metashape, metashape.read_metashape),
    _Format(realityscan.KIND, realityscan.is_csv_of_cameras, realityscan.read_csv),
    _Format(opensfm.SHOTS_KIND, opensfm.is_shots, opensfm.read_shots, (".", "odm_report")),
)

CAMERA_FILE_SUFFIXES = (".json", ".sfm", ".xml", ".csv", ".geojson", ".xmp")
"""Of files that are inputs themselves."""


@dataclass(frozen=True)
class ProgramCameras:
    """The cameras that a program wrote: where they are, and where their photos may be."""

    kind: str
    path: Path
    """The camera file; for XMP files and Polycam their folder."""
    photo_folders: tuple[Path, ...]

    def read(self) -> SourceModel:
        """Read them. Raises ParseError, DatasetError."""
        if self.kind == polycam.KIND:
            return polycam.read_polycam(self.path, self.photo_folders[0])
        if self.kind == realityscan.XMP_KIND:
            return realityscan.read_xmp_files(self.path, realityscan.xmp_files(self.path))
        return next(form.read for form in _FORMATS if form.kind == self.kind)(self.path)


def find_program_cameras(source: Path) -> ProgramCameras | None:
    """Return the cameras of a program that ``source`` is or holds, or ``None``.

    Raises DatasetError: a folder holds several files of one format.
    """
    if source.is_file():
        if source.suffix.lower() == ".xmp":
            return _xmp(source.parent)
        for form in _FORMATS:
            if form.is_file(source):
                return ProgramCameras(form.kind, source, _photo_folders(source.parent))
        return None
    folders = polycam.polycam_folders(source)
    if folders is not None:
        return ProgramCameras(polycam.KIND, folders[0], (folders[1],))
    for form in _FORMATS:
        for name in form.folders:
            found = _files(source / name, form)
            if len(found) > 1:
                listed = ", ".join(path.name for path in found[:3])
                text = f"{source.name} holds {len(found)} files of kind {form.kind}: {listed}."
                raise DatasetError(text, "Give one of these files instead of the folder.")
            if found:
                return ProgramCameras(form.kind, found[0], _photo_folders(found[0].parent))
    return _xmp(source)


def _files(folder: Path, form: _Format) -> list[Path]:
    if not folder.is_dir():
        return []
    suffixes = CAMERA_FILE_SUFFIXES
    entries = [path for path in folder.iterdir() if path.suffix.lower() in suffixes]
    return sorted(path for path in entries if path.name[:1] != "." and form.is_file(path))


def _xmp(source: Path) -> ProgramCameras | None:
    root = photo_root(source)
    if not realityscan.xmp_files(root):
        return None
    return ProgramCameras(realityscan.XMP_KIND, root, (root,))


def _photo_folders(folder: Path) -> tuple[Path, ...]:
    """Return folders that photo names may be relative to, those that hold photos first.

    OpenDroneMap writes its files into folders beside the one of the photos.
    """
    of_project = []
    if folder.name in ("opensfm", "odm_report"):
        beside = [folder.parent / name for name in PHOTO_FOLDERS]
        of_project = [path for path in beside if path.is_dir()][:1]
    return tuple(dict.fromkeys([*of_project, photo_root(folder), folder]))
