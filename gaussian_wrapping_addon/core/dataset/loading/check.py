# SPDX-License-Identifier: GPL-3.0-or-later
"""Check an input quickly before any long work: needs numpy only, solves no poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ...errors import DatasetError, WorkerError, WrapError, known_error
from ...files import real_path
from ...limits import MIN_IMAGES
from ...ply.table import vertex_layout
from ...report_warning import ReportWarning
from ..frames.normalisation import find_scene_frame
from ..lenses.lens_fit import MIN_PHOTO_SIDE_PX, fit_lens
from ..panoramas.panorama_views import VIEWS, check_panorama
from ..photos.photo_finder import (
    PhotoIndex,
    find_mask,
    list_photos,
    list_second_copies,
    photo_root,
)
from ..photos.photo_header import read_photo_header
from ..readers.source_model import PosedPhoto, counts_stored_pixels
from ..readers.splat_header import read_splat_header
from ..video.probe import probe_video
from ..video.video_file import container_of
from ..video.video_warnings import hdr_warning, interlaced_warning
from .panorama_input import shape_warning, takes_for_panoramas
from .source_kind import SPLAT, VIDEO, SourceKind, read_poses, source_kind
from .sparse_points import nothing_in_common, points_in_scene
from .splat_cameras import NO_PHOTOS_HINT, NO_PHOTOS_WARNING

Severity = Literal["error", "warning", "fact"]

_MAX_UNREADABLE_SHARE = 0.2
_MIN_GOOD_SIDE_PX = 200
_SHORT_NAMES = {
    "photos": "cameras to be solved", SPLAT: "splat without photos", VIDEO: "cameras to be solved",
}  # fmt: skip
"""Headings of kinds whose name is unsuitable."""


@dataclass(frozen=True)
class Finding:
    """One sentence about an input."""

    severity: Severity
    message: str
    hint: str = ""
    short: str = ""
    """Part of a heading: joined, the short texts of all findings describe the input."""
    kind: str = ""
    """Of the finding that names it: the input's kind."""


_PANORAMAS = f"The photos are 360 degree panoramas; each is cut into {len(VIEWS)} views"


def check_input(source: Path, *, worker: str = "", panoramas: str = "auto") -> list[Finding]:
    """Check an input without decoding photos or solving cameras.

    Parameters
    ----------
    source : Path
    worker : str
        The worker's Python, which opens videos; without, only their first bytes are looked at.
    panoramas : {"auto", "on", "off"}
        Whether photos without cameras are cut into views.

    Returns
    -------
    list of Finding
        An ``"error"`` means that loading would fail.
    """
    findings: list[Finding] = []
    try:
        source = real_path(source)
        kind = source_kind(source)
        findings.append(
            Finding(
                "fact",
                f"The input is of kind: {kind.kind}.",
                short=_SHORT_NAMES.get(kind.kind, kind.kind),
                kind=kind.kind,
            )
        )
        if kind.kind == SPLAT:
            _check_splat(source, findings)
        elif kind.kind == VIDEO:
            assert kind.video is not None
            _check_video(kind.video, worker, findings)
        elif kind.kind == "photos":
            _check_photos(kind, findings, panoramas)
        else:
            _check_poses(kind, findings)
    except WrapError as error:
        findings.append(Finding("error", error.message, error.hint))
    except OSError as error:
        told = known_error(error, source) or DatasetError(
            f"{source} cannot be read: {error.strerror}.",
            "Check the path and its permissions.",
        )
        findings.append(Finding("error", told.message, told.hint))
    return findings


def _check_splat(path: Path, findings: list[Finding]) -> None:
    header = read_splat_header(path)
    vertex_layout(path, header.ply, "Export or download the splat again.")
    kind = "surfels" if header.axes == 2 else "Gaussians"
    findings.append(
        Finding(
            "fact",
            f"{header.count} {kind} with harmonics of degree {header.degree}.",
            short=f"{header.count:,} {kind}",
        )
    )
    findings.append(Finding("warning", NO_PHOTOS_WARNING, NO_PHOTOS_HINT))


def _check_video(path: Path, worker: str, findings: list[Finding]) -> None:
    container_of(path)
    size = f"{path.stat().st_size / 1e6:,.1f} MB"
    if not worker:
        text = f"{path.name} ({size}) is opened when it is loaded; no worker is set up."
        findings.insert(0, Finding("fact", text, short="video"))
        return
    try:
        video = probe_video(path, worker)
    except WorkerError as error:
        findings.append(Finding("warning", f"{path.name}: {error.message}", error.hint))
        return
    length = f"{video.duration_s:.0f} s" if video.duration_s else "unknown length"
    frames = f", {video.frames} frames" if video.frames else ""
    text = (
        f"{path.name}: {length}{frames}, {video.width} x {video.height}, {video.codec}, {size}. "
        "Sharp frames are chosen when it is loaded."
    )
    # In front of the kind: "20 s of video, cameras to be solved".
    findings.insert(0, Finding("fact", text, short=f"{length} of video"))
    if 0 < video.frames < MIN_IMAGES:
        raise DatasetError(
            f"{path.name} has {video.frames} frames; at least {MIN_IMAGES} are needed.",
            "Film longer.",
        )
    if min(video.width, video.height) < MIN_PHOTO_SIDE_PX:
        raise DatasetError(
            f"{path.name} has {video.width} x {video.height} pixels.", "Film larger pictures."
        )
    if max(video.width, video.height) < _MIN_GOOD_SIDE_PX:
        findings.append(
            Finding("warning", f"The frames are smaller than {_MIN_GOOD_SIDE_PX} pixels.")
        )
    told = [hdr_warning(path)] * video.is_hdr + [interlaced_warning(path)] * video.is_interlaced
    findings += [Finding("warning", warning.text, warning.hint) for warning in told]


def _check_photos(kind: SourceKind, findings: list[Finding], panoramas: str) -> None:
    root = photo_root(kind.folder)
    photos = list_photos(root)
    names = [path.relative_to(root).as_posix() for path in photos]
    _check_files(kind, photos, names, findings)
    for warning in second_copies_warning(root):
        findings.append(Finding("warning", warning.text, warning.hint))
    findings.append(
        Finding("fact", "The input has no camera poses; they will be solved from the photos.")
    )
    by_shape = shape_warning(photos, panoramas)
    findings += [Finding("warning", warning.text, warning.hint) for warning in by_shape]
    if not by_shape and takes_for_panoramas(photos, panoramas):
        findings.append(Finding("fact", f"{_PANORAMAS}."))


def second_copies_warning(root: Path) -> list[ReportWarning]:
    """Return the warning about photos that are there twice, as image and RAW; or none."""
    second = list_second_copies(root)
    if not second:
        return []
    listed = ", ".join(path.name for path in second[:3]) + (" ..." if len(second) > 3 else "")
    text = (
        f"{len(second)} HEIC or RAW files are left out, as the same photo is there as an image of "
        f"the same name: {listed}."
    )
    return [ReportWarning("photos-twice", text, "To use the RAW photos, move the images away.")]


def _check_poses(kind: SourceKind, findings: list[Finding]) -> None:
    if kind.kind == "COLMAP model" and kind.transforms is not None:
        findings.append(
            Finding("fact", f"{kind.transforms.name} is present too; the COLMAP model is used.")
        )
    model = read_poses(kind)
    if any(photo.is_panorama for photo in model.photos):
        findings.append(Finding("fact", f"{_PANORAMAS}."))
    findings += [Finding("warning", warning.text, warning.hint) for warning in model.warnings]
    findings.append(
        Finding("fact", f"{len(model.photos)} posed photos, {len(model.points)} sparse points.")
    )
    index = PhotoIndex(kind.photo_roots)
    matches = {p.name: index.find(p.name) for p in model.photos}
    missing = [name for name, match in matches.items() if match is None]
    if len(missing) == len(matches):
        raise DatasetError(
            f"None of the {len(matches)} photos that the {kind.kind} names was found.",
            f"Looked for {missing[0]} in {', '.join(str(r) for r in kind.photo_roots)}.",
        )
    if missing:
        findings.append(
            Finding(
                "warning",
                f"{len(missing)} of {len(matches)} photos were not found, such as {missing[0]}.",
            )
        )
    found: dict[Path, PosedPhoto] = {}
    for posed in sorted(model.photos, key=lambda one: one.name):
        if (match := matches[posed.name]) is not None:
            found.setdefault(match.path, posed)
    _check_files(kind, list(found), [one.name for one in found.values()], findings, found)
    rotations = np.array([p.cam_from_world[:, :3] for p in found.values()])
    translations = np.array([p.cam_from_world[:, 3] for p in found.values()])
    frame = find_scene_frame(rotations, -np.einsum("nji,nj->ni", rotations, translations))
    far = int((~frame.keep).sum())
    if far:
        findings.append(Finding("warning", f"{far} cameras are far away from all others."))
    if frame.collinear:
        findings.append(
            Finding("warning", "All cameras lie on one line; depth will be inaccurate.")
        )
    more: list[ReportWarning] = []
    if (apart := nothing_in_common(model)) is not None:
        more.append(apart)
    points_in_scene(model.points, model.point_colors, frame.scene_from_world, more)
    findings += [Finding("warning", warning.text, warning.hint) for warning in more]


def _check_files(
    kind: SourceKind,
    photos: list[Path],
    names: list[str],
    findings: list[Finding],
    posed: Mapping[Path, PosedPhoto] | None = None,
) -> None:
    """Check that headers are readable, and that photos are large enough and sufficiently many.

    Parameters
    ----------
    posed : mapping of Path to PosedPhoto, optional
        Cameras of the photos, whose sizes must be those of the photos.
    """
    bad: list[DatasetError] = []
    sizes: Counter[str] = Counter()
    small = unknown = 0
    for path in photos:
        try:
            header = read_photo_header(path)
        except DatasetError as error:
            bad.append(error)
            continue
        if header is None:
            unknown += 1
            continue
        width, height = header.upright_size
        if min(width, height) < MIN_PHOTO_SIDE_PX:
            bad.append(
                DatasetError(f"{path.name} is {width} x {height} pixels.", "Use larger photos.")
            )
            continue
        if posed is not None and posed[path].is_panorama:
            check_panorama(header, path.name)
        elif posed is not None:
            prefers_stored = counts_stored_pixels(kind.kind)
            fit_lens(posed[path], header, path.name, prefers_stored=prefers_stored)
        sizes[f"{width} x {height}"] += 1
        small += max(width, height) < _MIN_GOOD_SIDE_PX
    good = len(photos) - len(bad)
    if bad and len(bad) > _MAX_UNREADABLE_SHARE * len(photos):
        raise DatasetError(
            f"{len(bad)} of {len(photos)} photos cannot be read. First: {bad[0].message}",
            bad[0].hint,
        )
    if good < MIN_IMAGES:
        count = "1 photo is" if good == 1 else f"{good} photos are"
        raise DatasetError(
            f"Only {count} usable; at least {MIN_IMAGES} are needed.",
            "Add photos of the same thing from other places.",
        )
    if bad:
        text = f"{len(bad)} photos cannot be read and are not used. First: {bad[0].message}"
        findings.append(Finding("warning", text, bad[0].hint))
    if small:
        findings.append(
            Finding("warning", f"{small} photos are smaller than {_MIN_GOOD_SIDE_PX} pixels.")
        )
    if unknown:
        findings.append(
            Finding("fact", f"{unknown} photos are of a format that is only checked on loading.")
        )
    listed = ", ".join(f"{count} of {size}" for size, count in sizes.most_common(3))
    message = f"{good} photos: {listed or 'sizes not known yet'}."
    # In front of the kind: "80 photos, COLMAP model".
    findings.insert(0, Finding("fact", message, short=f"{good} photos"))
    masked = sum(find_mask(kind.mask_roots, name, kind.photo_roots) is not None for name in names)
    if masked:
        findings.append(Finding("fact", f"{masked} of {len(names)} photos have a mask."))
