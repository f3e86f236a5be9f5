# SPDX-License-Identifier: GPL-3.0-or-later
"""Leave out of a solver's database what stands still while the object turns.

Runs in the helper process of :mod:`.pose_solver`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter

from ..photos.photo_file import read_photo
from ..pycolmap_import import import_pycolmap
from .standing_still import MIN_GROUP, pair_motion, standing_groups
from .turntable_masks import masks_of_turning

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
        features = {
            image.name: (
                image.image_id, db.read_keypoints(image.image_id),
                db.read_descriptors(image.image_id),
            )
            for image in db.read_all_images()
        }  # fmt: skip
        for clear in (
            db.clear_two_view_geometries, db.clear_matches, db.clear_descriptors,
            db.clear_keypoints,
        ):  # fmt: skip
            clear()
        for name, (image_id, keypoints, descriptors) in features.items():
            if name in masks:
                kept = _inside(keypoints, _grown(masks[name]))
                keypoints, descriptors.data = keypoints[kept], descriptors.data[kept]
            db.write_keypoints(image_id, keypoints)
            db.write_descriptors(image_id, descriptors)


def _grown(mask: np.ndarray) -> np.ndarray:
    return maximum_filter(mask, 2 * max(1, round(MARGIN_SHARE * max(mask.shape))) + 1)


def _inside(keypoints: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Tell which of (n, 2+) keypoints, pixels, lie inside a mask."""
    height, width = mask.shape
    column = keypoints[:, 0].astype(int).clip(0, width - 1)
    row = keypoints[:, 1].astype(int).clip(0, height - 1)
    return mask[row, column]
