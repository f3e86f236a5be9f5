# SPDX-License-Identifier: GPL-3.0-or-later
"""Look at the photos of an input, and say what should be done about which."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sized
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ...errors import DatasetError
from ...files import real_path
from ...kernels.parallel import default_threads
from ...progress import Progress
from ..loading.check import Finding
from ..loading.coverage import coverage_warnings, listed
from ..loading.source_kind import WITHOUT_PHOTOS, SourceKind, read_poses, source_kind
from ..photos.image_formats import require_extras
from ..photos.photo_finder import PhotoIndex, list_photos, photo_root
from ..readers.source_model import SourceModel
from .photo_measures import PhotoMeasures, measure_photo
from .set_comparison import blurred, light_spread, out_of_line, same_again

_SAID_EVERY_S = 2.0
"""Progress is reported this often."""
_SPREAD_STOPS = 2.5
"""Spread of the photos' light beyond which the set as a whole is spoken of."""


def photo_findings(source: Path, progress: Progress, *, threads: int = 0) -> list[Finding]:
    """Look at every photo of an input at a reduced size, and at what its cameras cover.

    Parameters
    ----------
    source : Path
        As for :func:`~..loading.check.check_input`, which has found no error.
    progress : Progress
    threads : int
        0 uses every core.

    Returns
    -------
    list of Finding
        Blur, exposure, duplicates and coverage, with the photos' names; none of a video or splat.

    Raises
    ------
    MissingExtraError
        Photos need a package that the worker lacks.
    DatasetError, ParseError
        The input cannot be read.
    """
    kind = source_kind(real_path(source))
    if kind.kind in WITHOUT_PHOTOS:
        return []
    model, photos = _photos(kind)
    require_extras([path for _, path in photos])
    findings = set_findings(_measured(photos, progress, threads or default_threads()))
    if model is not None:
        covered = coverage_warnings(model)
        findings += [Finding("warning", warning.text, warning.hint) for warning in covered]
    return findings


def _photos(kind: SourceKind) -> tuple[SourceModel | None, list[tuple[str, Path]]]:
    """Return the poses of an input, if it has any, and its photos in the order of their names."""
    if kind.kind == "photos":
        root = photo_root(kind.folder)
        return None, [(p.relative_to(root).as_posix(), p) for p in list_photos(root)]
    model, index = read_poses(kind), PhotoIndex(kind.photo_roots)
    matches = [(photo.name, index.find(photo.name)) for photo in model.photos]
    found = [(name, match.path) for name, match in matches if match is not None]
    # Neither pipes nor devices: reading one would wait for ever. The check of the files names them.
    return model, sorted((name, path) for name, path in found if path.is_file())


def _measured(
    photos: list[tuple[str, Path]], progress: Progress, threads: int
) -> list[PhotoMeasures]:
    """Measure the photos on several threads; those that cannot be decoded are left out."""

    def measure(one: tuple[str, Path]) -> PhotoMeasures | None:
        try:
            return measure_photo(one[1], one[0])
        except DatasetError:
            return None  # the check of the files, or loading, names it

    found: list[PhotoMeasures] = []
    said_s = time.monotonic()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for i, photo in enumerate(pool.map(measure, photos)):
                found += [] if photo is None else [photo]
                if time.monotonic() - said_s > _SAID_EVERY_S:
                    said_s = time.monotonic()
                    progress.update((i + 1) / len(photos), f"photo {i + 1} of {len(photos)}")
                progress.check()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return found


def set_findings(photos: list[PhotoMeasures]) -> list[Finding]:
    """Return what the photos of a set have against each other."""
    if not photos:
        return []
    findings = []

    def names(indices: Iterable[int]) -> str:
        return listed([photos[i].name for i in indices])

    soft = blurred(photos)
    if soft:
        text = f"{_count(soft)} much less sharp than the photos beside: {names(soft)}."
        hint = "Look at these, and remove them where others show the same; else take them again."
        findings.append(Finding("warning", text, hint))
    jumps = out_of_line(photos)
    if jumps:
        named = listed([f"{photos[i].name} ({stops:+.1f})" for i, stops in jumps])
        text = f"{_count(jumps)} brighter or darker than the photos beside, in stops: {named}."
        hint = "Remove them where others show the same. Lock exposure for the whole set."
        findings.append(Finding("warning", text, hint))
    spread = light_spread(photos)
    ordered = sorted(range(len(photos)), key=lambda i: photos[i].light)
    ends = f"from {photos[ordered[0]].name} to {photos[ordered[-1]].name}"
    text = f"The photos' mean light differs by {spread:.1f} stops, {ends}."
    if spread > _SPREAD_STOPS:
        hint = "Lock exposure and white balance; exposures are evened out only within limits."
        findings.append(Finding("warning", text, hint))
    else:
        findings.append(Finding("fact", text))
    again = same_again(photos)
    if again:
        named = listed([f"{photos[b].name} (as {photos[a].name})" for a, b in again])
        text = f"{_count(again)} the same as another one: {named}."
        findings.append(Finding("warning", text, "Remove them: they cost time and show no depth."))
    return findings


def _count(items: Sized) -> str:
    return "1 photo is" if len(items) == 1 else f"{len(items)} photos are"
