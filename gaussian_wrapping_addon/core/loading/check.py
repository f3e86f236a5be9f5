# SPDX-License-Identifier: GPL-3.0-or-later
"""What an input path holds, checked before a job starts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import DatasetError, WorkerError, WrapError, known_error
from ..files import real_path
from ..limits import MAX_UNREADABLE_SHARE, MIN_IMAGES, MIN_PHOTO_SIDE_PX, POINT_REACH, SCENE_RADIUS
from ..photos.finder import PhotoIndex, find_mask, list_photos, list_second_copies, photo_root
from ..photos.formats import read_photo_header
from ..photos.video import container_of, kind_warnings, probe_video
from ..ply import vertex_layout
from ..poses.panoramas import VIEWS, check_panorama
from ..progress import LEFT_OUT_HINT, ReportWarning
from ..readers.lenses import fit_lens
from ..readers.point_files import read_splat_header
from ..readers.source_model import PosedPhoto, SourceModel, counts_stored_pixels
from ..scene.camera import Similarity
from ..scene.frames import POINT_STEP, SceneFrame, find_scene_frame, snapped
from ..scene.scene import usable_points
from .other_inputs import NO_PHOTOS_HINT, NO_PHOTOS_WARNING, shape_warning, takes_for_panoramas
from .source_kind import SPLAT, VIDEO, SourceKind, read_poses, source_kind

# -- Check an input quickly before any long work: needs numpy only, solves no poses ---------------

Severity = Literal["error", "warning", "fact"]

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


class Findings(list[Finding]):
    """Findings, collected."""

    def warn(self, message: str, hint: str = "") -> None:
        """Add a warning."""
        self.append(Finding("warning", message, hint))

    def take(self, warnings: Iterable[ReportWarning]) -> None:
        """Add the warnings that loading would give."""
        for warning in warnings:
            self.warn(warning.text, warning.hint)

    def tell(self, message: str) -> None:
        """Add a fact."""
        self.append(Finding("fact", message))


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
    findings = Findings()
    try:
        source = real_path(source)
        kind = source_kind(source)
        text, short = f"The input is of kind: {kind.kind}.", _SHORT_NAMES.get(kind.kind, kind.kind)
        findings.append(Finding("fact", text, short=short, kind=kind.kind))
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
            f"{source} cannot be read: {error.strerror}.", "Check the path and its permissions."
        )
        findings.append(Finding("error", told.message, told.hint))
    return findings


def _check_splat(path: Path, findings: Findings) -> None:
    header = read_splat_header(path)
    vertex_layout(path, header.ply, "Export or download the splat again.")
    kind = "surfels" if header.axes == 2 else "Gaussians"
    text = f"{header.count} {kind} with harmonics of degree {header.degree}."
    findings.append(Finding("fact", text, short=f"{header.count:,} {kind}"))
    findings.warn(NO_PHOTOS_WARNING, NO_PHOTOS_HINT)


def _check_video(path: Path, worker: str, findings: Findings) -> None:
    container_of(path)
    size = f"{path.stat().st_size / 1e6:,.1f} MB"
    if not worker:
        text = f"{path.name} ({size}) is opened when it is loaded; no worker is set up."
        findings.insert(0, Finding("fact", text, short="video"))
        return
    try:
        video = probe_video(path, worker)
    except WorkerError as error:
        findings.warn(f"{path.name}: {error.message}", error.hint)
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
        text = f"{path.name} has {video.frames} frames; at least {MIN_IMAGES} are needed."
        raise DatasetError(text, "Film longer.")
    if min(video.width, video.height) < MIN_PHOTO_SIDE_PX:
        text = f"{path.name} has {video.width} x {video.height} pixels."
        raise DatasetError(text, "Film larger pictures.")
    if max(video.width, video.height) < _MIN_GOOD_SIDE_PX:
        findings.warn(f"The frames are smaller than {_MIN_GOOD_SIDE_PX} pixels.")
    findings.take(kind_warnings(path, video.is_hdr, video.is_interlaced))


def _check_photos(kind: SourceKind, findings: Findings, panoramas: str) -> None:
    root = photo_root(kind.folder)
    photos = list_photos(root)
    _check_files(kind, photos, [path.relative_to(root).as_posix() for path in photos], findings)
    findings.take(second_copies_warning(root))
    findings.tell("The input has no camera poses; they will be solved from the photos.")
    by_shape = shape_warning(photos, panoramas)
    findings.take(by_shape)
    if not by_shape and takes_for_panoramas(photos, panoramas):
        findings.tell(f"{_PANORAMAS}.")


def second_copies_warning(root: Path) -> list[ReportWarning]:
    """Return the warning about photos that are there twice, as image and RAW; or none."""
    second = list_second_copies(root)
    if not second:
        return []
    names = ", ".join(path.name for path in second[:3]) + (" ..." if len(second) > 3 else "")
    text = (
        f"{len(second)} HEIC or RAW files are left out, as the same photo is there as an image of "
        f"the same name: {names}."
    )
    return [ReportWarning("photos-twice", text, "To use the RAW photos, move the images away.")]


def _check_poses(kind: SourceKind, findings: Findings) -> None:
    if kind.kind == "COLMAP model" and kind.transforms is not None:
        findings.tell(f"{kind.transforms.name} is present too; the COLMAP model is used.")
    model = read_poses(kind)
    if any(photo.is_panorama for photo in model.photos):
        findings.tell(f"{_PANORAMAS}.")
    findings.take(model.warnings)
    findings.tell(f"{len(model.photos)} posed photos, {len(model.points)} sparse points.")
    index = PhotoIndex(kind.photo_roots)
    matches = {p.name: index.find(p.name) for p in model.photos}
    missing = [name for name, match in matches.items() if match is None]
    if len(missing) == len(matches):
        text = f"None of the {len(matches)} photos that the {kind.kind} names was found."
        hint = f"Looked for {missing[0]} in {', '.join(str(r) for r in kind.photo_roots)}."
        raise DatasetError(text, hint)
    if missing:
        count = f"{len(missing)} of {len(matches)}"
        findings.warn(f"{count} photos were not found, such as {missing[0]}.")
    found: dict[Path, PosedPhoto] = {}
    for posed in sorted(model.photos, key=lambda one: one.name):
        if (match := matches[posed.name]) is not None:
            found.setdefault(match.path, posed)
    _check_files(kind, list(found), [one.name for one in found.values()], findings, found)
    frame = frame_of_poses([posed.cam_from_world for posed in found.values()])
    far = int((~frame.keep).sum())
    if far:
        findings.warn(f"{far} cameras are far away from all others.")
    if frame.collinear:
        findings.warn("All cameras lie on one line; depth will be inaccurate.")
    more: list[ReportWarning] = []
    if (apart := nothing_in_common(model)) is not None:
        more.append(apart)
    points_in_scene(model.points, model.point_colors, frame.scene_from_world, more)
    findings.take(more)


def frame_of_poses(poses: Sequence[np.ndarray], *, z_up: bool = False) -> SceneFrame:
    """Return the scene frame of cameras, given their (3, 4) ``cam_from_world``."""
    rotations = np.array([pose[:, :3] for pose in poses])  # (n, 3, 3)
    translations = np.array([pose[:, 3] for pose in poses])  # (n, 3)
    centers = -np.einsum("nji,nj->ni", rotations, translations)
    return find_scene_frame(rotations, centers, z_up=z_up)


def _check_files(
    kind: SourceKind,
    photos: list[Path],
    names: list[str],
    findings: Findings,
    posed: Mapping[Path, PosedPhoto] | None = None,
) -> None:
    """Check that headers are readable, and that photos are large enough and sufficiently many.

    ``posed``: cameras of the photos, whose sizes must be those of the photos.
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
            text = f"{path.name} is {width} x {height} pixels."
            bad.append(DatasetError(text, "Use larger photos."))
            continue
        if posed is not None and posed[path].is_panorama:
            check_panorama(header, path.name)
        elif posed is not None:
            fit_lens(posed[path], header, path.name, prefers_stored=counts_stored_pixels(kind.kind))
        sizes[f"{width} x {height}"] += 1
        small += max(width, height) < _MIN_GOOD_SIDE_PX
    good = len(photos) - len(bad)
    if bad and len(bad) > MAX_UNREADABLE_SHARE * len(photos):
        text = f"{len(bad)} of {len(photos)} photos cannot be read. First: {bad[0].message}"
        raise DatasetError(text, bad[0].hint)
    check_photo_count(good)
    if bad:
        text = f"{len(bad)} photos cannot be read and are not used. First: {bad[0].message}"
        findings.warn(text, bad[0].hint)
    if small:
        findings.warn(f"{small} photos are smaller than {_MIN_GOOD_SIDE_PX} pixels.")
    if unknown:
        findings.tell(f"{unknown} photos are of a format that is only checked on loading.")
    known = ", ".join(f"{count} of {size}" for size, count in sizes.most_common(3))
    message = f"{good} photos: {known or 'sizes not known yet'}."
    # In front of the kind: "80 photos, COLMAP model".
    findings.insert(0, Finding("fact", message, short=f"{good} photos"))
    masked = sum(find_mask(kind.mask_roots, name, kind.photo_roots) is not None for name in names)
    if masked:
        findings.tell(f"{masked} of {len(names)} photos have a mask.")


def check_photo_count(count: int, left_out: Sequence[ReportWarning] = ()) -> None:
    """Raise :class:`DatasetError` where fewer than ``MIN_IMAGES`` photos are usable.

    ``left_out`` tells why others are not; its texts and next steps become part of the message.
    """
    if count < MIN_IMAGES:
        photos = "photo is" if count == 1 else "photos are"
        reasons = "".join(f" {warning.text}" for warning in left_out)
        hints = [warning.hint for warning in left_out if warning.hint]
        text = f"Only {count} {photos} usable; at least {MIN_IMAGES} are needed.{reasons}"
        hint = " ".join(hints) or "Add photos of the same thing from other places."
        raise DatasetError(text, hint)


# -- Take over the sparse points of an input ------------------------------------------------------

MIN_POINTS = 100
"""Smallest number of points to start from."""
_ONE_PLACE_REACH = 100.0 * SCENE_RADIUS
"""Points farther than this are far away for the distances between the cameras."""
_MIN_NEAR_SHARE = 0.1
"""Where fewer of the sparse points are nearer, it is not the points that are far: the cameras
hardly moved."""

_COMMON_SAMPLE = 2000
"""Points that are looked for in the photos, evenly chosen."""
_FIELD_MARGIN = 1.5
"""Width of a camera's field over that of its photo without distortion."""


def nothing_in_common(model: SourceModel) -> ReportWarning | None:
    """Return a warning if no sparse point lies in the photos of two cameras.

    ``None`` as well where the input has too few points to tell.
    """
    if len(model.points) < MIN_POINTS or (_fields(model, _COMMON_SAMPLE).sum(0) >= 2).any():
        return None
    return ReportWarning(
        "nothing-in-common",
        "No sparse point lies in the photos of two cameras: they show nothing in common.",
        "Check the poses, or take photos of the same thing from several places.",
    )


def _fields(model: SourceModel, sample: int) -> np.ndarray:
    """Tell which photos have which sparse points in view, with a margin, (photos, points) bool.

    Of the points, about ``sample`` are looked at, evenly chosen.
    """
    points = model.points[:: max(1, len(model.points) // sample)].astype(np.float64)
    fields = np.zeros((len(model.photos), len(points)), bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for k, photo in enumerate(model.photos):
            local = points @ photo.cam_from_world[:, :3].T + photo.cam_from_world[:, 3]  # (n, 3)
            fields[k] = local[:, 2] > 0.0
            if photo.lens is not None:
                lens = photo.lens
                (fx, fy), (cx, cy) = lens.focal, lens.principal_point
                x = fx * local[:, 0] + (cx - 0.5 * lens.width) * local[:, 2]
                y = fy * local[:, 1] + (cy - 0.5 * lens.height) * local[:, 2]
                reach = 0.5 * _FIELD_MARGIN * local[:, 2]
                fields[k] &= np.abs(x) <= lens.width * reach
                fields[k] &= np.abs(y) <= lens.height * reach
    return fields


def points_in_scene(
    points: np.ndarray,
    colors: np.ndarray,
    scene_from_world: Similarity,
    warnings: list[ReportWarning],
) -> tuple[np.ndarray, np.ndarray]:
    """Transform sparse points of an input to the scene frame's grid; leave out unusable ones.

    ``points``, ``colors``: (n, 3) ndarrays, world frame; colours go along.
    Raises DatasetError: the cameras hardly moved, for the distances of the points.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        points = snapped(scene_from_world.points(points.reshape(-1, 3)), POINT_STEP)
        beyond = ~(np.linalg.norm(points, axis=1) <= _ONE_PLACE_REACH)
    if len(points) >= MIN_POINTS and beyond.mean() > 1.0 - _MIN_NEAR_SHARE:
        raise DatasetError(
            f"{int(beyond.sum())} of {len(points)} sparse points are more than "
            f"{_ONE_PLACE_REACH / SCENE_RADIUS:.0f} times as far away as the cameras are from each "
            "other: all photos were taken from nearly one place, so that no depth can be measured.",
            "Walk around the object while taking photos.",
        )
    near = usable_points(points)
    if not near.all():
        text = (
            f"{int((~near).sum())} of {len(near)} sparse points were left out: they are not finite "
            f"or farther away than {POINT_REACH / SCENE_RADIUS:.0f} scene radii."
        )
        warnings.append(ReportWarning("points-far-away", text, LEFT_OUT_HINT))
    return points[near], colors[near]


# -- What cameras cover: photos with few sparse points, and photos that show nothing of the others

_WEAK_SHARE = 0.1
"""Of the median number of sparse points in a photo: with fewer, its pose hangs on few matches."""
_WEAK_POINTS = 30
"""With fewer points than this, a pose is not sure (solvers ask for 15 to 30)."""
_COMMON_POINTS = 20
"""Points of a sample in the field of a photo and of two others, with fewer of which it shows
something else."""
_SAMPLE = 20000
_MOST_NAMES = 5


def coverage_warnings(model: SourceModel) -> list[ReportWarning]:
    """Return warnings about photos that contribute little; none where points are too few to tell.

    ``model``: poses and sparse points of an input, or solved ones.
    """
    if len(model.points) < MIN_POINTS or len(model.photos) < 3:
        return []
    found = []
    names = [photo.name for photo in model.photos]
    alone = [names[i] for i in looking_elsewhere(model)]
    if alone:
        text = f"{listed(alone)}: hardly any sparse point of other photos is in view."
        hint = "Check their poses, remove them, or take photos in between."
        found.append(ReportWarning("photos-elsewhere", text, hint))
    weak = [names[i] for i in weakly_matched(model) if names[i] not in alone]
    if weak:
        text = f"{listed(weak)}: far fewer sparse points than in the other photos."
        hint = "Take more photos with more overlap there, or remove these."
        found.append(ReportWarning("photos-weak", text, hint))
    return found


def weakly_matched(model: SourceModel) -> list[int]:
    """Return the photos in which few sparse points were found, where the input tells."""
    counts = [photo.observed for photo in model.photos]
    known = [count for count in counts if count is not None]
    if len(known) < len(counts) or not any(known):
        return []
    limit = max(_WEAK_SHARE * float(np.median(known)), min(_WEAK_POINTS, float(np.median(known))))
    return [i for i, count in enumerate(known) if count < limit]


def looking_elsewhere(model: SourceModel) -> list[int]:
    """Return the photos in whose field hardly any point lies that two other photos may see."""
    fields = _fields(model, _SAMPLE)
    shared = (fields & (fields.sum(0) >= 3)).sum(1)
    limit = min(_COMMON_POINTS, 0.5 * float(np.median(shared)))
    return [int(i) for i in np.flatnonzero(shared < limit)]


def listed(names: Sequence[str]) -> str:
    """Return names for a message: the first few, and how many others."""
    others = len(names) - _MOST_NAMES
    if others <= 0:
        return ", ".join(names)
    return f"{', '.join(names[:_MOST_NAMES])} and {others} other{'s' * (others > 1)}"
