# SPDX-License-Identifier: GPL-3.0-or-later
"""Blur, exposure and duplicates among photos."""

from __future__ import annotations

import time
from collections.abc import Sequence, Sized
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DatasetError
from ..files import real_path
from ..parallel import default_threads
from ..photos.finder import PhotoIndex, list_photos, photo_root
from ..photos.formats import RAW, open_image, photo_kind, require_extras, without_warnings
from ..photos.photo_file import apply_orientation, photo_header, read_photo
from ..progress import Progress
from ..readers.source_model import SourceModel
from .check import Finding, Findings, coverage_warnings, listed
from .source_kind import WITHOUT_PHOTOS, SourceKind, read_poses, source_kind

# -- Measure one photo at a reduced size: sharpness, brightness, and a small picture of it --------

MEASURED_PX = 1024
"""Long side that photos are measured at: about what training sees, and quick to decode."""
SMALL_PX = 96
"""Long side of the small pictures that are compared."""
_TILES = 8
"""Tiles along each side, of which those with contrast are measured."""
_BEST_TILES = 0.25
"""Share of the tiles, those with the strongest edges, that decide the sharpness."""
_SHARPER_TILES = 0.75
"""Quantile of these tiles."""
_SMOOTH = 3
"""Pixels that edges are smoothed over."""
_FLAT = 1.0
"""Root mean square difference between pixels, levels of 255, below which a tile has no edges."""
_DARKEST = 1.0 / 255.0
"""Linear light that counts as black in the logarithm."""


@dataclass(frozen=True)
class PhotoMeasures:
    """What is compared between the photos of a set."""

    name: str
    sharpness: float
    """Share of the edges that smoothing takes; NaN where the photo has none."""
    light: float
    """Mean linear light as log2, "stops"."""
    small: np.ndarray
    """(h, w) float32, levels of 255."""


def measure_photo(path: Path, name: str) -> PhotoMeasures:
    """Measure a photo.

    Raises DatasetError: it cannot be decoded; MissingExtraError: the worker lacks the package for
    HEIF or RAW.
    """
    grey = reduced_grey(path)
    linear = (grey / 255.0) ** 2.2
    light = float(np.log2(max(float(linear.mean()), _DARKEST)))
    return PhotoMeasures(name, sharpness_of(grey), light, shrunk(grey, SMALL_PX))


def reduced_grey(path: Path) -> np.ndarray:
    """Return a photo as (h, w) float32 grey of 255 levels, upright, at most ``MEASURED_PX``.

    JPEGs are decoded at a half, a quarter or an eighth of their size where that is enough.

    Raises DatasetError, MissingExtraError: as :func:`~.photo_file.read_photo`.
    """
    header = photo_header(path)
    if max(header.width, header.height) >= 2 * MEASURED_PX and photo_kind(path) != RAW:
        with without_warnings():
            pixels = _drafted(path)
        if pixels is not None:
            return apply_orientation(shrunk(pixels, MEASURED_PX), header.orientation)
    from PIL import Image

    color = read_photo(path, enough_px=MEASURED_PX).color
    return shrunk(np.asarray(Image.fromarray(color).convert("L")), MEASURED_PX)


def _drafted(path: Path) -> np.ndarray | None:
    """Return the grey of a JPEG at a reduced size, as stored; ``None`` for other formats."""
    try:
        with open_image(path) as image:
            if image.format != "JPEG" or image.mode not in ("RGB", "L"):
                return None
            image.draft("L", (MEASURED_PX, MEASURED_PX))
            return np.asarray(image.convert("L"))
    except (OSError, ValueError, SyntaxError):
        return None  # decoded in full, which says what is wrong


def shrunk(grey: np.ndarray, long_px: int) -> np.ndarray:
    """Return (h, w) grey, uint8 or float, with its long side limited; float32."""
    from PIL import Image

    height, width = grey.shape
    factor = long_px / max(height, width)
    image = Image.fromarray(np.asarray(grey, np.float32))
    if factor < 1.0:
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        image = image.resize(size, Image.Resampling.BOX)
    return np.asarray(image)


def sharpness_of(grey: np.ndarray) -> float:
    """Return how much of its edges (h, w) grey loses where it is smoothed over ``_SMOOTH`` pixels.

    In 0 to 1, whatever contrast and exposure: what is blurred already loses little. The
    tiles with the strongest edges decide, and of these the sharper part, as a blurred background is
    no fault; of the two directions the softer, as a moved camera blurs one.
    """
    height, width = grey.shape
    rows, columns = height // _TILES, width // _TILES
    if min(rows, columns) < 4 * _SMOOTH:
        return float("nan")
    sharp, smooth = zip(*(_edge_energy(grey, axis, rows, columns) for axis in (0, 1)), strict=True)
    strength = smooth[0] + smooth[1]
    best = np.argsort(strength)[::-1][: round(_BEST_TILES * strength.size)]
    best = best[strength[best] > _FLAT**2]
    if not len(best):
        return float("nan")
    lost = [
        1.0 - np.sqrt(after[best] / np.maximum(before[best], 1e-6))
        for before, after in zip(sharp, smooth, strict=True)
    ]
    return float(min(np.quantile(loss, _SHARPER_TILES) for loss in lost))


def _edge_energy(
    grey: np.ndarray, axis: int, rows: int, columns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean squares of differences along an axis in each tile, before and after smoothing."""
    steps = np.diff(grey, axis=axis)
    sums = np.cumsum(steps, axis=axis, dtype=np.float64)
    along = np.moveaxis(sums, axis, 0)  # a view
    smoothed = np.moveaxis(along[_SMOOTH:] - along[:-_SMOOTH], 0, axis) / _SMOOTH
    return _tile_means(steps**2, rows, columns), _tile_means(smoothed**2, rows, columns)


def _tile_means(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return the (tiles * tiles,) means of (h, w) values; a missing border counts as 0."""
    full = np.zeros((_TILES * rows, _TILES * columns))
    part = values[: full.shape[0], : full.shape[1]]
    full[: part.shape[0], : part.shape[1]] = part
    return full.reshape(_TILES, rows, _TILES, columns).mean((1, 3)).ravel()


# -- Compare the measures of a set's photos: which are blurred, brighter or darker, the same again

NEIGHBOURS = 4
"""Photos before and after one, by name, that it is compared with: they show much the same."""
SIDE = 3
"""Photos on each side that its light is compared with."""
MIN_PHOTOS = 5
"""With fewer photos there is nothing to compare with."""
BLURRED_SHARE = 0.45
"""Of its neighbours' sharpness and of the set's: a photo with less is blurred."""
JUMP_STOPS = 1.0
"""Difference in light from the neighbours that one sees, and that exposure correction should not
have to bridge."""
SAME_PX = 0.15
"""Apparent movement, in pixels of the small pictures, up to which two photos are the same."""
_SPREAD_QUANTILES = (0.05, 0.95)


def beside(values: np.ndarray) -> np.ndarray:
    """Return the median of the neighbours of each of (n,) values; NaN values are left out."""
    count = len(values)
    medians = np.full(count, np.nan)
    for i in range(count):
        low = min(max(i - NEIGHBOURS, 0), max(count - 2 * NEIGHBOURS - 1, 0))
        around = np.delete(values[low : low + 2 * NEIGHBOURS + 1], i - low)
        around = around[np.isfinite(around)]
        if len(around):
            medians[i] = np.median(around)
    return medians


def blurred(photos: Sequence[PhotoMeasures]) -> list[int]:
    """Return the photos that are much less sharp than those beside them and than most of the set.

    Both, as photos from another place or of a plainer part may be softer without a fault.
    """
    values = np.array([photo.sharpness for photo in photos])
    if np.isfinite(values).sum() < MIN_PHOTOS:
        return []
    limit = BLURRED_SHARE * np.fmin(beside(values), np.nanmedian(values))
    with np.errstate(invalid="ignore"):
        return [int(i) for i in np.flatnonzero(values < limit)]


def out_of_line(photos: Sequence[PhotoMeasures]) -> list[tuple[int, float]]:
    """Return the photos that are brighter or darker than those on both sides, with the stops."""
    light = np.array([photo.light for photo in photos])
    if len(light) < MIN_PHOTOS:
        return []
    found = []
    for i in range(len(light)):
        sides = (light[max(i - SIDE, 0) : i], light[i + 1 : i + 1 + SIDE])
        # On both sides: where the light changes from one place to the next, nothing is wrong.
        stops = [float(light[i] - np.median(side)) for side in sides if len(side)]
        if min(stops) > JUMP_STOPS or max(stops) < -JUMP_STOPS:
            found.append((i, min(stops, key=abs)))
    return found


def light_spread(photos: Sequence[PhotoMeasures]) -> float:
    """Return by how many stops the photos' mean light differs, without the most extreme."""
    low, high = np.quantile([photo.light for photo in photos], _SPREAD_QUANTILES)
    return float(high - low)


def same_again(photos: Sequence[PhotoMeasures]) -> list[tuple[int, int]]:
    """Return pairs of photos that show the same from the same place, each second photo once."""
    of_shape: dict[tuple[int, ...], list[int]] = {}
    for i, photo in enumerate(photos):
        of_shape.setdefault(photo.small.shape, []).append(i)
    pairs: list[tuple[int, int]] = []
    for members in of_shape.values():
        pixels = np.stack([photos[i].small for i in members]).astype(np.float32)
        edges = np.array([_edge_strength(small) for small in pixels])
        pixels -= pixels.mean((1, 2), keepdims=True)
        spread = np.maximum(pixels.std((1, 2), keepdims=True), 1e-3)
        flat = (pixels / spread).reshape(len(members), -1)
        # Standardised: exposure does not count. Moved in units of the edges' strength.
        alike = 2.0 * (1.0 - np.clip(flat @ flat.T / flat.shape[1], -1.0, 1.0))
        moved_px = np.sqrt(np.maximum(alike, 0.0)) * spread[:, 0] / np.maximum(edges, 1e-3)[:, None]
        for b in range(1, len(members)):
            a = int(np.argmin(moved_px[b, :b]))
            if moved_px[b, a] < SAME_PX and edges[b] > 0.0:
                pairs.append((members[a], members[b]))
    return sorted(pairs)


def _edge_strength(small: np.ndarray) -> float:
    """Return the root mean square gradient of (h, w) grey, levels per pixel; 0 of a line."""
    if min(small.shape) < 2:
        return 0.0
    rows, columns = np.diff(small, axis=0), np.diff(small, axis=1)
    return float(np.sqrt((np.mean(rows**2) + np.mean(columns**2)) / 2.0))


# -- Look at the photos of an input, and say what should be done about which ----------------------

_SAID_EVERY_S = 2.0
"""Progress is reported this often."""
_SPREAD_STOPS = 2.5
"""Spread of the photos' light beyond which the set as a whole is spoken of."""


def photo_findings(source: Path, progress: Progress, *, threads: int = 0) -> list[Finding]:
    """Look at every photo of an input at a reduced size, and at what its cameras cover.

    Parameters
    ----------
    source : Path
        As for :func:`~.check.check_input`, which has found no error.
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
        findings.take(coverage_warnings(model))
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


def set_findings(photos: list[PhotoMeasures]) -> Findings:
    """Return what the photos of a set have against each other."""
    findings = Findings()
    if not photos:
        return findings
    soft = blurred(photos)
    if soft:
        named = listed([photos[i].name for i in soft])
        text = f"{_count(soft)} much less sharp than the photos beside: {named}."
        hint = "Look at these, and remove them where others show the same; else take them again."
        findings.warn(text, hint)
    jumps = out_of_line(photos)
    if jumps:
        named = listed([f"{photos[i].name} ({stops:+.1f})" for i, stops in jumps])
        text = f"{_count(jumps)} brighter or darker than the photos beside, in stops: {named}."
        findings.warn(
            text, "Remove them where others show the same. Lock exposure for the whole set."
        )
    spread = light_spread(photos)
    ordered = sorted(range(len(photos)), key=lambda i: photos[i].light)
    ends = f"from {photos[ordered[0]].name} to {photos[ordered[-1]].name}"
    text = f"The photos' mean light differs by {spread:.1f} stops, {ends}."
    if spread > _SPREAD_STOPS:
        hint = "Lock exposure and white balance; exposures are evened out only within limits."
        findings.warn(text, hint)
    else:
        findings.tell(text)
    again = same_again(photos)
    if again:
        named = listed([f"{photos[b].name} (as {photos[a].name})" for a, b in again])
        text = f"{_count(again)} the same as another one: {named}."
        findings.warn(text, "Remove them: they cost time and show no depth.")
    return findings


def _count(items: Sized) -> str:
    return "1 photo is" if len(items) == 1 else f"{len(items)} photos are"
