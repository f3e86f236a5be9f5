# SPDX-License-Identifier: GPL-3.0-or-later
"""Turntables: features on the object alone, masks of what turns."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.ndimage import maximum_filter

from ..compiled import kernel
from ..parallel import even_bounds, run_chunks
from ..photos.photo_file import large_parts, read_photo
from ..readers.lenses import import_pycolmap
from .checks import MIN_GROUP, pair_motion, standing_groups

# -- Masks of what turns before a camera that stands still: what differs from the background ------

MAX_BACKGROUND_PHOTOS = 32
"""Photos, evenly spread, that the background is found from: memory and time stay bounded."""
SAME_LEVELS = 8.0
"""Levels of 255 within which two photos show the same thing."""
MIN_SUPPORT_SHARE = 0.2
"""Share of the photos that must agree on a pixel's background; else the object is always there."""
BLUR_PX = 1.0
MIN_DIFFERENCE = 6.0
"""Levels of 255 by which the object differs from the background, at least."""
NOISE_FACTOR = 6.0
"""Times the difference that the quieter pixels have by noise."""
SHARP_FACTOR = 1.5
"""Times that threshold, for what is not blurred: there is more noise in it."""
QUIET_PERCENTILE = 30.0
DARKEST = 16
"""Pixels darker than this tell nothing of a photo's exposure."""
CLOSED_SHARE = 0.008
"""Gaps up to twice this share of the long side are closed: where object and background look
alike."""
OFTEN = 0.05
"""Share of the photos in which the object is seen at a pixel where another one shows a hole in it:
a handle turns past. Where nothing is ever seen to differ, the object looks the same all around."""
SMALL_HOLE_SHARE = 0.0005
"""Holes up to this share of the photo's area are filled in any case."""
SMALLEST_SHARE = 0.02
"""Parts smaller than this share of the largest are noise, or leaves that the wind moves."""


def masks_of_turning(
    count: int, read: Callable[[int], np.ndarray], step: Callable[[float], None], *, threads: int
) -> list[np.ndarray]:
    """Return (h, w) bool masks, true where a photo shows the turning object.

    Parameters
    ----------
    count : int
        Number of photos, all of one size and from one place.
    read : callable
        The (h, w, 3) uint8 photo of a number.
    step : callable
        Told the share that is done.

    Notes
    -----
    The background of a pixel is the colour that most photos agree on (docs/method.md, section 12):
    a median would show the object wherever it covers a pixel in more than half of them. Where
    few agree, the object is always there.
    """
    chosen = np.unique(np.linspace(0, count - 1, min(count, MAX_BACKGROUND_PHOTOS)).astype(int))
    stack = []
    for done, index in enumerate(chosen.tolist()):
        stack.append(read(index))
        step(0.3 * done / len(chosen))
    first = stack[len(stack) // 2]
    photos = np.stack([np.rint(_evened(photo, first)).astype(np.uint8) for photo in stack])
    del stack
    background, support = steady_colors(photos, threads)
    del photos
    known = support >= MIN_SUPPORT_SHARE * len(chosen)
    soft = ndimage.gaussian_filter(background, (BLUR_PX, BLUR_PX, 0))

    def turning(index: int) -> np.ndarray:
        photo = _evened(read(index), background)
        blurred = ndimage.gaussian_filter(photo, (BLUR_PX, BLUR_PX, 0))
        difference = np.abs(blurred - soft).max(axis=2)
        noise = float(np.percentile(difference[known], QUIET_PERCENTILE)) if known.any() else 0.0
        threshold = max(MIN_DIFFERENCE, NOISE_FACTOR * noise)
        mask = whole_parts((difference > threshold) | ~known)
        # The blur has moved borders outwards, by a pixel where the contrast is high.
        sharp = np.abs(photo - background).max(axis=2)
        rim = mask & ~ndimage.binary_erosion(mask, border_value=True)
        return mask & ~(rim & known & (sharp <= SHARP_FACTOR * threshold))

    masks = []
    with ThreadPoolExecutor(threads) as pool:
        for index, mask in enumerate(pool.map(turning, range(count))):
            masks.append(mask)
            step(0.4 + 0.6 * index / count)
    often = np.mean(masks, axis=0, dtype=np.float32) >= OFTEN
    return [without_holes(mask, often) for mask in masks]


def steady_colors(photos: np.ndarray, threads: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the colour that most of the photos agree on, for each pixel.

    ``photos``: (n, h, w, 3) uint8.
    Returns ``colors``: (h, w, 3) float32, mean of those that agree; ``support``: (h, w) int32, how
    many agree.
    """
    colors = np.empty(photos.shape[1:], np.float32)
    support = np.empty(photos.shape[1:3], np.int32)

    def chunk(begin: int, end: int) -> None:
        _steady(photos, begin, end, SAME_LEVELS, colors, support)

    run_chunks(chunk, even_bounds(photos.shape[1], threads), threads)
    return colors, support


@kernel(fast=False)
def _steady(
    photos: Any, begin: int, end: int, same_levels: float, colors: Any, support: Any
) -> None:
    count = photos.shape[0]
    for y in range(begin, end):
        for x in range(photos.shape[2]):
            best, leader = 0, 0
            for i in range(count):
                agreeing = 0
                for j in range(count):
                    far = 0.0
                    for k in range(3):
                        far = max(far, abs(float(photos[i, y, x, k]) - float(photos[j, y, x, k])))
                    agreeing += far <= same_levels
                if agreeing > best:
                    best, leader = agreeing, i
            red, green, blue = 0.0, 0.0, 0.0
            for j in range(count):
                far = 0.0
                for k in range(3):
                    far = max(far, abs(float(photos[leader, y, x, k]) - float(photos[j, y, x, k])))
                if far <= same_levels:
                    red += photos[j, y, x, 0]
                    green += photos[j, y, x, 1]
                    blue += photos[j, y, x, 2]
            colors[y, x, 0], colors[y, x, 1], colors[y, x, 2] = (
                red / best, green / best, blue / best,
            )  # fmt: skip
            support[y, x] = best


def _evened(photo: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return a photo (h, w, 3) float32 with the exposure and white balance of another one.

    By the commonest ratio of their pixels, that of the background.
    """
    evened = photo.astype(np.float32)
    for channel in range(3):
        bright = (like[..., channel] > DARKEST) & (photo[..., channel] > DARKEST)
        if not bright.any():
            continue
        ratio = np.log(evened[..., channel][bright] / like[..., channel][bright])
        counts, edges = np.histogram(ratio, _RATIO_BINS, (-_MAX_RATIO, _MAX_RATIO))
        at = int(ndimage.gaussian_filter1d(counts.astype(float), 1.0).argmax())
        low, high = edges[max(at - 1, 0)], edges[min(at + 2, _RATIO_BINS)]
        near = ratio[(ratio >= low) & (ratio <= high)]
        evened[..., channel] /= np.exp(float(np.median(near)) if len(near) else 0.0)
    return evened.clip(0.0, 255.0)


_RATIO_BINS, _MAX_RATIO = 200, 1.0


def whole_parts(differs: np.ndarray) -> np.ndarray:
    """Return (h, w) bool with specks taken out and gaps closed."""
    radius = max(1, round(CLOSED_SHARE * max(differs.shape)))
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    disc = x * x + y * y <= radius * radius
    # Pad, so that what the border cuts is closed like the rest.
    padded = np.pad(ndimage.binary_opening(differs, np.ones((2, 2))), radius, mode="edge")
    closed = ndimage.binary_closing(padded, disc)[radius:-radius, radius:-radius]
    return large_parts(np.asarray(closed), SMALLEST_SHARE)


def without_holes(mask: np.ndarray, often: np.ndarray) -> np.ndarray:
    """Fill the holes of a (h, w) bool mask, but large ones where ``often`` the object is seen."""
    holes = ndimage.binary_fill_holes(mask) & ~mask
    label, count = ndimage.label(holes)
    if count == 0:
        return mask
    small = np.bincount(label.ravel()) <= SMALL_HOLE_SHARE * mask.size
    return mask | (holes & (small[label] | ~often))


# -- Leave out of a solver's database what stands still while the object turns --------------------
#
# Runs in the helper process of :mod:`.solver`.

MIN_MATCHES_INSIDE = 0.8
"""Share of the matches that turn which masks must contain; else something that turns looks the same
from all sides, and the masks would cut it away."""
MIN_MASK_SHARE, MAX_MASK_SHARE = 0.002, 0.75
"""Of a photo's area, median over the photos."""
MARGIN_SHARE = 0.01
"""Features this share of the long side outside of a mask count as inside: they look at more than a
pixel."""


def turntable_groups(database: Path, task: Mapping[str, Any]) -> list[list[str]]:
    """Return names of photos from cameras that stand still before something that turns.

    Parameters
    ----------
    database : Path
        With matches.
    task : mapping
        ``turntable`` ("auto", "on" or "off"), ``groups`` of one lens and size, and ``pairs``.
    """
    pycolmap = import_pycolmap()
    if task["turntable"] == "off":
        return []
    if task["turntable"] == "on":
        return [group["names"] for group in task["groups"] if len(group["names"]) >= MIN_GROUP]
    names = [name for group in task["groups"] for name in group["names"]]
    number = {name: k for k, name in enumerate(names)}
    motions = []
    with pycolmap.Database.open(database) as db:
        images = {image.name: image for image in db.read_all_images()}
        cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
        points = {name: db.read_keypoints(images[name].image_id)[:, :2] for name in names}
        for first, second in task["pairs"]:
            camera = cameras[images[first].camera_id]
            if images[second].camera_id != camera.camera_id:
                continue
            matches = db.read_matches(images[first].image_id, images[second].image_id)
            found = (points[first][matches[:, 0]], points[second][matches[:, 1]])
            size = (camera.width, camera.height)
            motions.append(pair_motion(number[first], number[second], *found, size))
    return [[names[k] for k in group] for group in standing_groups(len(names), motions)]


def turning_masks(
    photos: Path, groups: Sequence[Sequence[str]], step: Callable[[float], None], *, threads: int
) -> dict[str, np.ndarray]:
    """Return a (h, w) bool mask of what turns for each photo of the groups.

    Parameters
    ----------
    photos : Path
        Their folder.
    step : callable
        Told the share that is done.
    """
    masks: dict[str, np.ndarray] = {}
    for number, group in enumerate(groups):

        def read(index: int, group: Sequence[str] = group) -> np.ndarray:
            return read_photo(photos / group[index]).color

        def tell(share: float, number: int = number) -> None:
            step((number + share) / len(groups))

        made = masks_of_turning(len(group), read, tell, threads=threads)
        masks |= dict(zip(group, made, strict=True))
    return masks


def most_inliers(
    database: Path, names: Collection[str], pairs: Iterable[Sequence[str]]
) -> list[int]:
    """Return for each of the photos how many verified matches it has with another one, at most."""
    pycolmap = import_pycolmap()
    most = dict.fromkeys(names, 0)
    with pycolmap.Database.open(database) as db:
        for first, second, matches in _verified(db, most, pairs):
            for name in (first, second):
                most[name] = max(most[name], len(matches))
    return list(most.values())


def matches_inside(
    database: Path, masks: Mapping[str, np.ndarray], pairs: Iterable[Sequence[str]]
) -> float:
    """Return the share of the verified matches between masked photos that masks contain.

    0 where there are none.
    """
    pycolmap = import_pycolmap()
    inside, total = 0, 0
    with pycolmap.Database.open(database) as db:
        images = {image.name: image.image_id for image in db.read_all_images()}
        kept = {
            name: _inside(db.read_keypoints(images[name]), _grown(mask))
            for name, mask in masks.items()
        }
        for first, second, matches in _verified(db, masks, pairs):
            both = kept[first][matches[:, 0]] & kept[second][matches[:, 1]]
            inside, total = inside + int(both.sum()), total + len(both)
    return inside / total if total else 0.0


def are_usable(masks: Mapping[str, np.ndarray], inside: float) -> bool:
    """Tell whether masks show what turns: they contain its matches, and a fair part of the photos.

    Almost nothing differs where nothing turns, almost everything where the camera moves.
    """
    share = float(np.median([mask.mean() for mask in masks.values()]))
    return inside >= MIN_MATCHES_INSIDE and MIN_MASK_SHARE <= share <= MAX_MASK_SHARE


def _verified(
    db: Any, names: Collection[str], pairs: Iterable[Sequence[str]]
) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield the verified matches (n, 2) of the pairs of these photos."""
    images = {image.name: image.image_id for image in db.read_all_images()}
    for first, second in pairs:
        if first in names and second in names:
            ids = images[first], images[second]
            if db.exists_two_view_geometry(*ids):
                yield first, second, db.read_two_view_geometry(*ids).inlier_matches


def drop_still_features(database: Path, masks: Mapping[str, np.ndarray]) -> None:
    """Remove the features outside of the masks, and all matches, which number features."""
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(database) as db:
        features = [
            (image, db.read_keypoints(image.image_id), db.read_descriptors(image.image_id))
            for image in db.read_all_images()
        ]
        db.clear_two_view_geometries()
        db.clear_matches()
        db.clear_descriptors()
        db.clear_keypoints()
        for image, keypoints, descriptors in features:
            if image.name in masks:
                kept = _inside(keypoints, _grown(masks[image.name]))
                keypoints, descriptors.data = keypoints[kept], descriptors.data[kept]
            db.write_keypoints(image.image_id, keypoints)
            db.write_descriptors(image.image_id, descriptors)


def _grown(mask: np.ndarray) -> np.ndarray:
    return maximum_filter(mask, 2 * max(1, round(MARGIN_SHARE * max(mask.shape))) + 1)


def _inside(keypoints: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Tell which of (n, 2+) keypoints, pixels, lie inside a mask."""
    height, width = mask.shape
    column = keypoints[:, 0].astype(int).clip(0, width - 1)
    row = keypoints[:, 1].astype(int).clip(0, height - 1)
    return mask[row, column]
