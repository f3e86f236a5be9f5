# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pairs of photos are matched: order, GPS, resemblance, known poses."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..photos.exif import GpsPosition
from ..readers.lenses import import_pycolmap
from ..worker.helper_process import emit
from .checks import connected_parts

# -- Distances between photos by their GPS positions ----------------------------------------------

EARTH_RADIUS_M = 6_371_000.0
MIN_POSITIONS = 3
SAME_PLACE_M = 0.5
"""Where all positions are this near to each other, they do not tell photos apart."""


def gps_distances(positions: Sequence[GpsPosition | None]) -> np.ndarray | None:
    """Return (n, n) distances over ground in metres, infinite for photos without a position.

    Heights are left out: cameras measure them worst, and what they see lies on the ground. None
    where fewer than three photos have a position, or all have the same.
    """
    if sum(p is not None for p in positions) < MIN_POSITIONS:
        return None
    angles = np.radians(
        [[np.nan] * 2 if p is None else [p.latitude_deg, p.longitude_deg] for p in positions]
    )
    latitude, longitude = angles[:, 0], angles[:, 1]
    east = longitude[:, None] - longitude[None]
    # Across the date line the short way round counts.
    east = (east + np.pi) % (2 * np.pi) - np.pi
    north = latitude[:, None] - latitude[None]
    middle = 0.5 * (latitude[:, None] + latitude[None])
    metres = EARTH_RADIUS_M * np.hypot(north, east * np.cos(middle))
    metres = np.where(np.isfinite(metres), metres, np.inf)
    return metres if float(metres[np.isfinite(metres)].max()) > SAME_PLACE_M else None


# -- Pairs of photos by their order, and by known poses -------------------------------------------

Pairs = list[tuple[int, int]]
"""Sorted, without repetition, (i, j) with i < j."""

EXHAUSTIVE_LIMIT = 150
"""Up to this many photos all pairs are matched (11 175 of them)."""
_ORDER_NEIGHBOURS = 12
_NAME_NEIGHBOURS = 3
"""Neighbours by name where the order is not known to mean anything."""
_POSED_NEIGHBOURS = 14
_SAME_PLACE = 1e-9
"""Distance of photos from one place over the typical one: rounding of their poses."""
_MAX_VIEW_ANGLE_COS = np.cos(np.radians(60.0))


def all_pairs(count: int) -> Pairs:
    """Return all pairs of ``count`` photos."""
    return list(itertools.combinations(range(count), 2))


def pairs_in_order(count: int) -> Pairs:
    """Return pairs of photos taken one after the other, as of a video.

    Each with the 12 next ones, and with those 16, 32, 64, ... later.
    """
    return pairs_at_steps(
        count, [*range(1, _ORDER_NEIGHBOURS + 1), *(2**k for k in range(4, count.bit_length()))]
    )


def pairs_by_name(count: int) -> Pairs:
    """Return each photo with the next ones by name, which mostly were taken next."""
    return pairs_at_steps(count, range(1, _NAME_NEIGHBOURS + 1))


def pairs_at_steps(count: int, steps: Iterable[int]) -> Pairs:
    """Return each photo with those that come so many steps after it."""
    return sorted((i, i + step) for step in steps for i in range(count - step))


def nearest_pairs(distances: np.ndarray, nearest: int) -> Pairs:
    """Return each item with its ``nearest`` others.

    ``distances``: (n, n) array, symmetric; infinite or not a number where unknown. Of equal ones
        the first is taken.
    """
    known = np.where(np.isfinite(distances), distances, np.inf)
    np.fill_diagonal(known, np.inf)
    order = np.argsort(known, axis=1, kind="stable")[:, :nearest]
    both = {(i, j) for i, row in enumerate(order.tolist()) for j in row if np.isfinite(known[i, j])}
    return sorted({(min(pair), max(pair)) for pair in both})


def pairs_by_pose(centers: np.ndarray, forwards: np.ndarray) -> Pairs:
    """Return pairs (i < j) of posed photos with similar positions and viewing directions.

    ``centers``, ``forwards``: (n, 3) float64, camera centres and unit viewing directions.
    """
    pairs: set[tuple[int, int]] = set()
    typical = max(float(np.linalg.norm(centers - centers.mean(0), axis=1).mean()), 1e-12)
    for i in range(len(centers)):
        angle_cos = forwards @ forwards[i]
        cost = np.linalg.norm(centers - centers[i], axis=1) / typical + (1.0 - angle_cos)
        # Photos from one place, as the views of a panorama, tell no depth (the photo itself, too).
        same_place = np.linalg.norm(centers - centers[i], axis=1) <= _SAME_PLACE * typical
        cost[(angle_cos < _MAX_VIEW_ANGLE_COS) | same_place] = np.inf
        order = np.argsort(cost, kind="stable")[:_POSED_NEIGHBOURS]
        pairs.update((min(i, int(j)), max(i, int(j))) for j in order if np.isfinite(cost[j]))
    return sorted(pairs)


# -- Choose the pairs of a set of photos to match, in two rounds (docs/method.md, section 15.1)
#
# Up to 150 photos: all. Beyond, the nearest by order, by GPS and by resemblance; then, for photos
# with few verified neighbours, the neighbours of their neighbours.

ALIKE_NEIGHBOURS = 20
ALIKE_IN_ORDER = 8
"""Of a video, whose order gives the others: these close loops."""
GPS_NEIGHBOURS = 10
GPS_FAR_RANKS = (16, 32)
"""Ranks by distance of photos farther away, which close loops."""
VERIFIED_MATCHES = 30
"""Matches that agree with one motion, from which on two photos count as neighbours."""
WELL_CONNECTED = 8
"""With as many neighbours a photo needs no second round."""
SECOND_ROUND_PAIRS = 10
"""Most new pairs of a photo in the second round."""


def choose_pairs(
    count: int,
    *,
    in_order: bool = False,
    metres: np.ndarray | None = None,
    resemblance: np.ndarray | None = None,
) -> Pairs:
    """Return the pairs of the first round.

    Parameters
    ----------
    count : int
        Photos, sorted by name.
    in_order : bool
        They were taken one after the other, as of a video.
    metres : (count, count) array or None
        Distances by GPS, infinite where unknown. They may be wrong: they add pairs only.
    resemblance : (count, count) array or None
        The more alike, the larger; needed for more than ``EXHAUSTIVE_LIMIT`` photos.
    """
    if count <= EXHAUSTIVE_LIMIT:
        return all_pairs(count)
    pairs = set(pairs_in_order(count) if in_order else pairs_by_name(count))
    if resemblance is not None:
        pairs.update(nearest_pairs(-resemblance, ALIKE_IN_ORDER if in_order else ALIKE_NEIGHBOURS))
    if metres is not None:
        pairs.update(nearest_pairs(metres, GPS_NEIGHBOURS))
        pairs.update(_at_ranks(metres))
    return sorted(pairs)


def second_round(
    count: int, tried: Pairs, verified: Mapping[tuple[int, int], int], resemblance: np.ndarray
) -> Pairs:
    """Return more pairs for photos with few neighbours.

    Parameters
    ----------
    tried : list of (int, int)
        Pairs of the first round.
    verified : mapping of (int, int) to int
        Matches of a pair that agree with one motion.
    resemblance : (count, count) array
        Decides between equals, and for photos without any neighbour.
    """
    linked = np.zeros((count, count), bool)
    for (i, j), matches in verified.items():
        if matches >= VERIFIED_MATCHES:
            linked[i, j] = linked[j, i] = True
    done = np.eye(count, dtype=bool)
    for i, j in tried:
        done[i, j] = done[j, i] = True
    # Neighbours in common, then resemblance, which lies in [-1, 1].
    common = linked.astype(np.float32) @ linked.astype(np.float32)
    apart = connected_parts(count, np.argwhere(linked))
    largest = np.bincount(apart).argmax()
    pairs: set[tuple[int, int]] = set()
    for i in range(count):
        is_outside = apart[i] != largest
        if linked[i].sum() >= WELL_CONNECTED and not is_outside:
            continue
        worth = common[i] + 0.49 * (1.0 + resemblance[i])
        if is_outside:
            # What it is linked to is no way out of its part.
            worth = np.where(apart == apart[i], -1.0, worth)
        worth[done[i]] = -1.0
        order = np.argsort(-worth, kind="stable")[:SECOND_ROUND_PAIRS]
        pairs.update((min(i, j), max(i, j)) for j in order.tolist() if worth[j] >= 0.0)
    return sorted(pairs)


def _at_ranks(metres: np.ndarray) -> set[tuple[int, int]]:
    known = np.where(np.eye(len(metres), dtype=bool), np.inf, metres)
    order = np.argsort(known, axis=1, kind="stable")
    return {
        (min(i, j), max(i, j))
        for rank in GPS_FAR_RANKS
        if rank < len(metres) - 1
        for i, j in enumerate(order[:, rank].tolist())
        if np.isfinite(known[i, j])
    }


# -- How much photos resemble each other, by the features that were found in them (VLAD) ----------
#
# A vocabulary is learnt from the set's own descriptors by k-means; a photo is described by how
# its descriptors differ from their words (docs/method.md, section 15.1).

WORDS = 64
SAMPLED_DESCRIPTORS = 60_000
"""Of all photos together, for the vocabulary."""
DESCRIBING = 2048
"""Most descriptors of a photo that describe it: of the largest features, which come last."""
_ROUNDS = 12

ReadDescriptors = Callable[[int], np.ndarray]
"""Returns the (m, 128) uint8 descriptors of a photo by its number, m may be 0."""


def resemblances(count: int, read: ReadDescriptors, *, seed: int) -> np.ndarray:
    """Return the (count, count) float32 resemblance of photos, 1 for equal ones.

    The same for the same seed. A photo without features resembles none: 0.
    """
    vectors = photo_vectors(count, read, vocabulary(count, read, seed=seed))
    return vectors @ vectors.T


def vocabulary(count: int, read: ReadDescriptors, *, seed: int) -> np.ndarray:
    """Return the (w, 128) float32 words learnt from a sample of all descriptors."""
    chance = np.random.default_rng(seed)
    each = max(SAMPLED_DESCRIPTORS // max(count, 1), 1)
    samples = []
    for number in range(count):
        found = _unit(read(number)[-DESCRIBING:])
        samples.append(found[np.sort(chance.permutation(len(found))[:each])])
    sample = np.concatenate(samples) if samples else np.zeros((0, 128), np.float32)
    words = sample[np.sort(chance.permutation(len(sample))[:WORDS])]
    for _ in range(_ROUNDS if len(words) else 0):
        nearest = _nearest_words(sample, words)
        sums = np.zeros(words.shape)
        np.add.at(sums, nearest, sample)
        counts = np.bincount(nearest, minlength=len(words))
        # A word that nothing is near to stays where it is.
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words)
        words = words.astype(np.float32)
    return words


def photo_vectors(count: int, read: ReadDescriptors, words: np.ndarray) -> np.ndarray:
    """Return the (count, w * 128) float32 unit vectors of photos, 0 of photos without features."""
    vectors = np.zeros((count, words.size), np.float32)
    for number in range(count):
        found = _unit(read(number)[-DESCRIBING:])
        if not len(found) or not len(words):
            continue
        nearest = _nearest_words(found, words)
        apart = np.zeros(words.shape, np.float32)
        np.add.at(apart, nearest, found - words[nearest])
        # Words that a photo has very often (grass) must not outweigh the others.
        length = np.linalg.norm(apart, axis=1, keepdims=True)
        apart = apart / np.maximum(length, 1e-12) * np.sqrt(length)
        flat = np.sign(apart) * np.sqrt(np.abs(apart))
        vectors[number] = (flat / max(float(np.linalg.norm(flat)), 1e-12)).ravel()
    # What all photos have in common tells nothing about who resembles whom.
    has_any = np.any(vectors != 0.0, axis=1)
    if has_any.any():
        vectors[has_any] -= vectors[has_any].mean(0)
        vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return vectors


def _unit(descriptors: np.ndarray) -> np.ndarray:
    found = descriptors.astype(np.float32)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)


def _nearest_words(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return the (n,) numbers of the words nearest to unit descriptors."""
    return np.argmax(descriptors @ words.T - 0.5 * (words**2).sum(1), axis=1)


# -- Find and match features, in the helper processes that solve cameras and points ---------------

EXTRACT_END, MATCH_END = 0.5, 0.85
"""Shares of the solver's progress."""
_SECOND_ROUND_BEGIN = 0.8
_MATCHING_BLOCKS = 3
_MATCHING_BLOCK_PAIRS = 1500
"""Every block rebuilds the search index of each of its photos: few, large blocks are faster."""


def extract(
    folder: Path, database: Path, names_of_camera: dict[int, list[str]], threads: int, most: int
) -> None:
    """Find features of photos of each camera, at most so many a photo, in order, with progress."""
    pycolmap = import_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    options.use_gpu = False
    options.sift.max_num_features = most
    reader = pycolmap.ImageReaderOptions()
    if any((folder / "masks").iterdir()):
        reader.mask_path = folder / "masks"
    total = sum(len(names) for names in names_of_camera.values())
    done = 0
    for camera_id, names in names_of_camera.items():
        reader.existing_camera_id = camera_id
        # Import in order first: extraction would number the photos as its threads finish.
        pycolmap.import_images(
            database, folder / "images", camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=names, options=reader,
        )  # fmt: skip
        for begin in range(0, len(names), 2 * threads):
            block = names[begin : begin + 2 * threads]
            emit(
                fraction=EXTRACT_END * done / total,
                message=f"searching features, photo {done + 1} of {total}",
            )
            pycolmap.extract_features(
                database, folder / "images", image_names=block,
                camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
                extraction_options=options, device=pycolmap.Device.cpu,
            )  # fmt: skip
            done += len(block)


def match_chosen(folder: Path, database: Path, task: dict[str, Any], names: list[str]) -> None:
    """Choose pairs, match them, and in large sets those of a second round; ``task`` gets both.

    Parameters
    ----------
    task : dict
        ``seed``, ``threads``, ``in_order`` and ``positions`` (degrees of latitude and longitude of
        each photo, or None); gets ``pairs`` of names.
    names : list of str
        All photos, sorted.
    """
    count = len(names)
    if count <= EXHAUSTIVE_LIMIT:
        task["pairs"] = _named(all_pairs(count), names)
        match(folder, database, task)
        return
    pycolmap = import_pycolmap()
    emit(fraction=EXTRACT_END, message=f"comparing {count} photos")
    with pycolmap.Database.open(database) as db:
        number_of = {image.name: image.image_id for image in db.read_all_images()}

        def descriptors(index: int) -> np.ndarray:
            return np.asarray(db.read_descriptors(number_of[names[index]]).data)

        alike = resemblances(count, descriptors, seed=task["seed"])
    places = [place and GpsPosition(place[0], place[1], None) for place in task["positions"]]
    metres = gps_distances(places)
    first = choose_pairs(count, in_order=task["in_order"], metres=metres, resemblance=alike)
    task["pairs"] = _named(first, names)
    match(folder, database, task, end=_SECOND_ROUND_BEGIN)
    index = {number_of[name]: k for k, name in enumerate(names)}
    verified = {}
    with pycolmap.Database.open(database) as db:
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            i, j = sorted(index[number] for number in pycolmap.pair_id_to_image_pair(pair_id))
            verified[i, j] = len(geometry.inlier_matches)
    more = _named(second_round(count, first, verified, alike), names)
    match(folder, database, {**task, "pairs": more}, begin=_SECOND_ROUND_BEGIN)
    task["pairs"] += more


def _named(pairs: Pairs, names: list[str]) -> list[list[str]]:
    return [[names[i], names[j]] for i, j in pairs]


def match(
    folder: Path,
    database: Path,
    task: dict[str, Any],
    *,
    begin: float = EXTRACT_END,
    end: float = MATCH_END,
    is_turntable: bool = False,
) -> None:
    """Match and verify the pairs of ``task``, with progress from ``begin`` to ``end``."""
    pycolmap = import_pycolmap()
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = task["threads"]
    verification = _options_of(task, is_turntable=is_turntable)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    pairs = task["pairs"]
    step = max(1, min(-(-len(pairs) // _MATCHING_BLOCKS), _MATCHING_BLOCK_PAIRS))
    for done in range(0, len(pairs), step):
        emit(
            fraction=begin + (end - begin) * done / len(pairs),
            message=f"matching photos, pair {done + 1} of {len(pairs)}",
        )
        block = pairs[done : done + step]
        pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in block))
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing,
            verification_options=verification, device=pycolmap.Device.cpu,
        )  # fmt: skip


def verify_again(database: Path, task: dict[str, Any], *, is_turntable: bool) -> None:
    """Verify all matches anew."""
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(database) as db:
        db.clear_two_view_geometries()
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = task["threads"]
    options = _options_of(task, is_turntable=is_turntable)
    pycolmap.geometric_verification(
        database, verifier_options=verifier, two_view_geometry_options=options
    )


def _options_of(task: dict[str, Any], *, is_turntable: bool) -> Any:
    options = import_pycolmap().TwoViewGeometryOptions()
    options.ransac.random_seed = task["seed"]
    options.filter_stationary_matches = is_turntable
    return options
