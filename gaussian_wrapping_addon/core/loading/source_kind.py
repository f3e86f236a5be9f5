# SPDX-License-Identifier: GPL-3.0-or-later
"""Detect the kind of an input, locate its photos, and read its poses if it has any."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import DatasetError
from ..photos.finder import PHOTO_FOLDERS, list_photos, mask_roots_of, photo_root
from ..photos.video import is_video_path, the_video_in
from ..readers.colmap import find_models, read_colmap
from ..readers.point_files import is_splat_path
from ..readers.program_files import ProgramCameras, find_program_cameras
from ..readers.source_model import COLMAP, PHOTOS, TRANSFORMS, SourceModel
from ..readers.transforms import find_transforms, read_transforms

_WANTED = (
    "Give a folder of photos, a video, a folder with images/ and sparse/0 (COLMAP), a "
    "transforms.json, the camera file of another program (docs/file-formats.md), or the PLY of a "
    "3D Gaussian splat."
)


SPLAT = "splat"
"""Kind of an input that is a 3D Gaussian splat without photos."""
VIDEO = "video"
"""Kind of an input that is a video, or a folder with one and no photos."""
WITHOUT_PHOTOS = (SPLAT, VIDEO)
"""Kinds of inputs that have no photos to look at before they are loaded."""


@dataclass(frozen=True)
class SourceKind:
    """Kind and location of an input."""

    kind: str
    """``"COLMAP model"``, ``"transforms.json"``, ``"photos"``, ``"splat"``, ``"video"``, or a
    program's."""
    folder: Path
    """Folder that names in the input are relative to."""
    transforms: Path | None
    """The transforms file, also if a COLMAP model is preferred to it."""
    video: Path | None = None
    """The video of an input of that kind."""
    program: ProgramCameras | None = None
    """Cameras that another program wrote."""
    cut_folder: Path | None = None
    """Views of the input's panoramas, once they are cut."""

    @property
    def photo_roots(self) -> list[Path]:
        """Folders that photo names may be relative to, in order of preference."""
        cut = [] if self.cut_folder is None else [self.cut_folder]
        if self.program is not None:
            return [*self.program.photo_folders, *cut]
        roots = [photo_root(self.folder), self.folder]
        # The input is the model folder itself: photos are beside "sparse".
        if self.folder.name == "sparse":
            roots.append(photo_root(self.folder.parent))
        elif self.folder.parent.name == "sparse":
            roots.append(photo_root(self.folder.parent.parent))
        return list(dict.fromkeys([*roots, *cut]))

    @property
    def mask_roots(self) -> list[Path]:
        """Folders that may hold masks."""
        return [m for root in self.photo_roots for m in mask_roots_of(root)]


def source_kind(source: Path) -> SourceKind:
    """Detect the kind of input; prefers a COLMAP model to transforms.json, both to other programs.

    Raises DatasetError: the path does not exist or holds nothing usable.
    """
    if not source.exists():
        raise DatasetError(f"{source} does not exist.", _WANTED)
    if source.is_file():
        if is_splat_path(source):
            return SourceKind(SPLAT, source.parent, None)
        if is_video_path(source):
            return SourceKind(VIDEO, source.parent, None, video=source)
        program = find_program_cameras(source)
        if program is not None:
            return SourceKind(program.kind, source.parent, None, program=program)
        transforms = find_transforms(source)
        if transforms is None:
            raise DatasetError(f"{source.name} is a file, but not a transforms.json.", _WANTED)
        return SourceKind(TRANSFORMS, source.parent, transforms)
    if not source.is_dir():
        raise DatasetError(f"{source.name} is neither a file nor a folder.", _WANTED)
    transforms = find_transforms(source)
    if find_models(source):
        return SourceKind(COLMAP, source, transforms)
    if transforms is not None:
        return SourceKind(TRANSFORMS, source, transforms)
    if source.name in PHOTO_FOLDERS and find_models(source.parent):
        return SourceKind(COLMAP, source.parent, find_transforms(source.parent))
    program = find_program_cameras(source)
    if program is not None:
        return SourceKind(program.kind, source, None, program=program)
    if list_photos(photo_root(source)):
        return SourceKind(PHOTOS, source, None)
    video = the_video_in(source)
    if video is not None:
        return SourceKind(VIDEO, source, None, video=video)
    raise DatasetError(f"{source.name or source} holds no photos.", _WANTED)


def read_poses(kind: SourceKind) -> SourceModel:
    """Read the poses of an input that has them. Raises ParseError, DatasetError."""
    if kind.kind == SPLAT:
        raise DatasetError("A splat contains no cameras.", "Give the input that it was trained on.")
    if kind.kind == VIDEO:
        raise DatasetError("A video contains no cameras.", "Give photos with cameras.")
    if kind.kind == COLMAP:
        return read_colmap(kind.folder)
    if kind.program is not None:
        return kind.program.read()
    assert kind.transforms is not None
    return read_transforms(kind.transforms)
