# SPDX-License-Identifier: GPL-3.0-or-later
"""Solved poses held against their matches."""

from __future__ import annotations

import dataclasses
import logging
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..files import read_json
from ..progress import ReportWarning
from ..readers.lenses import import_pycolmap
from ..readers.source_model import SourceModel

# -- Find photos of a camera that stands still while the object turns, by their matches -----------
#
# Between two such photos the background's features stay where they are and the object's move. A
# camera that moves leaves no feature in its place; a pause of it leaves all of them.

TURNTABLE_NAME = "turntable.json"
"""How many ``photos`` are of a turntable, and whether it ``is_masked``."""
TURNING_FOLDER = "turning"
"""Masks of what turns, named as the photos."""
STILL_SHARE, MIN_STILL_PX = 0.002, 1.5
"""A feature that moves less than this share of the photo's long side, or these pixels, is still."""
MOVED_SHARE = 0.01
MIN_STILL_MATCHES, MIN_ROWS, MIN_COLUMNS = 10, 3, 3
"""Still matches of a pair, and the rows and columns of cells that they lie in: a date, a logo, a
caption or a car's bonnet stays in its place, too."""
MIN_STILL_CELLS_SHARE = 0.4
"""Least share of the cells with matches in which most are still: the background is around what
turns; behind what is fixed to a camera that moves, all the rest moves."""
CELLS = 6
"""Cells along each side of a photo."""
MIN_TURNING_MATCHES = 12
"""Matches that move as one body which a photo of a turntable has with some other photo."""
MIN_PHOTOS_SHARE = 0.8
"""Share of all photos that must be of a turntable: a camera that waits on its way while somebody
walks by sees the same in a few of them."""
MIN_GROUP = 8
"""Fewer photos from one place give no background."""
MIN_PARTNERS_SHARE = 0.5
"""Share of a group's other photos, of those it was matched with, that show a photo's background."""


@dataclass(frozen=True)
class PairMotion:
    """What the matches of two photos say of the camera between them."""

    first: int
    second: int
    is_still: bool
    """Background stays where it is."""
    moved: int
    """Matches that move, right or wrong."""


def pair_motion(
    first: int, second: int, points: np.ndarray, others: np.ndarray, size: tuple[int, int]
) -> PairMotion:
    """Judge the matches of photos ``first`` and ``second``, both of ``size`` (width, height).

    ``points``, ``others``: (n, 2) float, matched positions in the two photos, pixels.
    """
    long_side = max(size)
    distance = np.linalg.norm(np.subtract(points, others), axis=1)
    still = distance < max(STILL_SHARE * long_side, MIN_STILL_PX)
    moved = distance > MOVED_SHARE * long_side
    cells = np.floor(points / size * CELLS).astype(int).clip(0, CELLS - 1)
    place = np.zeros((2, CELLS, CELLS), int)
    for number, chosen in enumerate((still, moved)):
        np.add.at(place[number], (cells[chosen, 1], cells[chosen, 0]), 1)
    by_still = place[0] > place[1]
    is_still = (
        still.sum() >= MIN_STILL_MATCHES
        and by_still.any(axis=1).sum() >= MIN_ROWS
        and by_still.any(axis=0).sum() >= MIN_COLUMNS
        and by_still.sum() >= MIN_STILL_CELLS_SHARE * place.any(axis=0).sum()
    )
    return PairMotion(first, second, bool(is_still), int(moved.sum()))


def standing_groups(count: int, motions: Sequence[PairMotion]) -> list[list[int]]:
    """Return groups of photos, each from a camera that stands still while something moves.

    Whether what moves turns as one body is left to :func:`are_turning`.

    Parameters
    ----------
    count : int
        Number of photos.
    motions : sequence of PairMotion
        Of all pairs that were matched, also of those without a match.

    Returns
    -------
    list of list of int
        Ascending numbers of photos; photos of no such group are in none.
    """
    still = [(motion.first, motion.second) for motion in motions if motion.is_still]
    if not still:
        return []
    label = connected_parts(count, still)
    partners, matched, moved = (np.zeros(count, int) for _ in range(3))
    for motion in motions:
        pair = [motion.first, motion.second]
        if label[motion.first] != label[motion.second]:
            continue
        matched[pair] += 1
        partners[pair] += motion.is_still
        moved[pair] = np.maximum(moved[pair], motion.moved)
    groups = []
    for number in np.unique(label):
        group = np.flatnonzero((label == number) & (partners >= MIN_PARTNERS_SHARE * matched))
        # Nothing that turns: the same photo many times, or a camera that waits.
        if len(group) >= MIN_GROUP and np.median(moved[group]) >= MIN_TURNING_MATCHES:
            groups.append(group.tolist())
    return groups if sum(map(len, groups)) >= MIN_PHOTOS_SHARE * count else []


def connected_parts(count: int, links: Iterable[tuple[int, int]]) -> np.ndarray:
    """Return for each of ``count`` photos the number of its part, (count,): what links connect."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    first, second = np.array([*links], int).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(first)), (first, second)), (count, count))
    return connected_components(graph, directed=False)[1]


def are_turning(most_inliers: Sequence[int]) -> bool:
    """Tell whether photos of still cameras show a body that turns.

    ``most_inliers``: for each photo: the most matches with another photo that move and agree with
        one motion.
    """
    return len(most_inliers) > 0 and float(np.median(most_inliers)) >= MIN_TURNING_MATCHES


# -- Do solved cameras agree with the matches of their photos? (docs/method.md, section 15.3) -----
#
# Plain geometry, no solver: pairs of photos whose matches agree with some motion, against the
# motion that the solved cameras have.

EPIPOLAR_PX = 6.0
"""Largest Sampson distance of a match that agrees; the matcher lets 4 pass."""
REPROJECTION_PX = 10.0
"""Largest distance between a match and where the other photo's point is projected."""
MIN_MATCHES = 30
"""Pairs with fewer matches are no evidence: chance finds them, too."""
AGREES, CONTRADICTS = 0.6, 0.3
"""Shares of a pair's matches, at least and at most, from which the pair counts so."""
STRONG = 0.2
"""Least matches of a strong pair, over those of the strongest pair of its weaker photo. Fur and
leaves make weak pairs that contradict right cameras; true neighbours are strong."""
DOUBTFUL_SHARE, MIN_CONTRADICTING = 0.05, 3
"""Share of the matches of strong pairs, and number of strong pairs, that contradict the cameras,
from which on these are doubtful."""
_FEW = 1e-12


@dataclass(frozen=True)
class PairEvidence:
    """Matches of two placed photos, and how many of them fit the cameras."""

    first: str
    second: str
    matches: int
    agreeing: int

    @property
    def share(self) -> float:
        """Of the matches, those that agree."""
        return self.agreeing / max(self.matches, 1)

    @property
    def contradicts(self) -> bool:
        """Tell whether the pair shows another motion than the cameras have."""
        return self.matches >= MIN_MATCHES and self.share <= CONTRADICTS

    @property
    def agrees(self) -> bool:
        """Tell whether the pair supports the cameras."""
        return self.agreeing >= MIN_MATCHES and self.share >= AGREES


@dataclass(frozen=True)
class Side:
    """One photo of a pair."""

    pose: np.ndarray
    """(3, 4) cam_from_world."""
    rays: np.ndarray
    """(n, 2) matches on the plane at depth 1."""
    points: np.ndarray
    """(n, 3) world points of the matches' features, not a number where a feature has none."""
    focal_px: float


def agreeing_matches(first: Side, second: Side) -> np.ndarray:
    """Tell which of n matches agree with the poses, (n,) bool.

    Where a feature has a point, the point must appear at the match in the other photo; else the
    match must lie on its epipolar line, before both cameras.
    """
    forth = _reprojection_px(first.points, second)
    back = _reprojection_px(second.points, first)
    has_point = ~(np.isnan(forth) & np.isnan(back))
    # Features of one thing may have two points, one of them poor: either is enough.
    near = np.fmin(forth, back) <= REPROJECTION_PX
    return np.where(has_point, near, _is_on_line(first, second))


def _reprojection_px(points: np.ndarray, side: Side) -> np.ndarray:
    """Return (n,) distances in pixels, infinite behind the camera, not a number without a point."""
    local = points @ side.pose[:, :3].T + side.pose[:, 3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.linalg.norm(local[:, :2] / depth[:, None] - side.rays, axis=1) * side.focal_px
    return np.where(np.isnan(depth), np.nan, np.where(depth > 0.0, apart, np.inf))


def _is_on_line(first: Side, second: Side) -> np.ndarray:
    rotation = second.pose[:, :3] @ first.pose[:, :3].T
    shift = second.pose[:, 3] - rotation @ first.pose[:, 3]
    shift = shift / max(float(np.linalg.norm(shift)), _FEW)
    ones = np.ones((len(first.rays), 1))
    a, b = np.hstack([first.rays, ones]), np.hstack([second.rays, ones])
    turned = a @ rotation.T
    essential = np.cross(np.broadcast_to(shift, turned.shape), turned)  # E a, (n, 3)
    across = b @ np.cross(np.eye(3), shift) @ rotation  # E^T b up to sign, (n, 3)
    scale = np.sqrt((essential[:, :2] ** 2).sum(1) + (across[:, :2] ** 2).sum(1))
    apart = np.abs((b * essential).sum(1)) / np.maximum(scale, _FEW)
    apart *= 0.5 * (first.focal_px + second.focal_px)
    # Depths z a' + t = w b by least squares; far points have either sign of a tiny angle.
    aa, bb, ab = (turned**2).sum(1), (b**2).sum(1), (turned * b).sum(1)
    at, bt = turned @ shift, b @ shift
    size = aa * bb - ab**2
    z, w = (ab * bt - bb * at), (aa * bt - ab * at)
    is_far = size < (REPROJECTION_PX / first.focal_px) ** 2 * aa * bb
    return (apart <= EPIPOLAR_PX) & (is_far | ((z > 0.0) & (w > 0.0)))


@dataclass(frozen=True)
class Verdict:
    """All pairs of a solution together."""

    pairs: tuple[PairEvidence, ...]

    @property
    def agreeing(self) -> int:
        """Matches that fit, of all pairs."""
        return sum(pair.agreeing for pair in self.pairs)

    @property
    def strong(self) -> tuple[PairEvidence, ...]:
        """Pairs with many matches for their photos, the ones with most first."""
        strongest: dict[str, int] = {}
        for pair in self.pairs:
            for name in (pair.first, pair.second):
                strongest[name] = max(strongest.get(name, 0), pair.matches)
        found = [
            pair
            for pair in self.pairs
            if pair.matches >= MIN_MATCHES
            and pair.matches >= STRONG * min(strongest[pair.first], strongest[pair.second])
        ]
        return tuple(sorted(found, key=lambda p: (-p.matches, p.first, p.second)))

    @property
    def contradicting(self) -> tuple[PairEvidence, ...]:
        """Strong pairs that show another motion, the ones with most matches first."""
        return tuple(pair for pair in self.strong if pair.contradicts)

    @property
    def contradicting_share(self) -> float:
        """Share of the matches of strong pairs that belong to contradicting ones."""
        counted = sum(pair.matches for pair in self.strong)
        return sum(pair.matches for pair in self.contradicting) / max(counted, 1)

    @property
    def is_doubtful(self) -> bool:
        """Tell whether so many matches contradict the cameras that these are likely wrong."""
        return (
            len(self.contradicting) >= MIN_CONTRADICTING
            and self.contradicting_share >= DOUBTFUL_SHARE
        )

    def parts(self, names: Sequence[str]) -> list[list[str]]:
        """Return photos in parts that no agreeing pair links, the largest part first."""
        number = {name: k for k, name in enumerate(names)}
        links = [(number[pair.first], number[pair.second]) for pair in self.pairs if pair.agrees]
        groups: dict[int, list[str]] = defaultdict(list)
        for name, part in zip(names, connected_parts(len(names), links).tolist(), strict=True):
            groups[part].append(name)
        return sorted(groups.values(), key=lambda group: (-len(group), group[0]))

    def to_json(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the figures and the strongest evidence."""
        counted = self.strong
        return {
            "pairs": sum(pair.matches >= MIN_MATCHES for pair in self.pairs),
            "strong_pairs": len(counted),
            "contradicting_pairs": len(self.contradicting),
            "contradicting_share": self.contradicting_share,
            "median_share": float(np.median([p.share for p in counted])) if counted else 0.0,
            "strongest": [
                [p.first, p.second, p.matches, p.agreeing] for p in self.contradicting[:10]
            ],
            "parts": self.parts(names),
        }


# -- Hold a solver's reconstruction against the verified matches in its database ------------------
#
# Runs in the helper process of :mod:`.solver`.


def check_solution(database: Path, model: Any) -> Verdict:
    """Return how the verified pairs of placed photos agree with a pycolmap reconstruction.

    Pairs that the solver did not use, or gave up, count like all others.
    """
    pycolmap = import_pycolmap()
    pairs = []
    with pycolmap.Database.open(database) as db:
        placed = {
            image_id: _Placed(model, image_id, db.read_keypoints(image_id)[:, :2])
            for image_id in sorted(model.reg_image_ids())
        }
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            matches = geometry.inlier_matches
            if not len(matches) or not all(image_id in placed for image_id in ids):
                continue
            first, second = (placed[image_id] for image_id in ids)
            agreeing = agreeing_matches(first.side(matches[:, 0]), second.side(matches[:, 1]))
            pairs.append(PairEvidence(first.name, second.name, len(matches), int(agreeing.sum())))
    return Verdict(tuple(sorted(pairs, key=lambda pair: (pair.first, pair.second))))


class _Placed:
    """A placed photo with its features, at (n, 2) ``pixels``."""

    def __init__(self, model: Any, image_id: int, pixels: np.ndarray) -> None:
        image = model.image(image_id)
        self.name: str = image.name
        self.pose = np.asarray(image.cam_from_world().matrix())
        self._camera = model.camera(image.camera_id)
        self._rays = np.asarray(self._camera.cam_from_img(pixels.astype(np.float64)))
        self._points = np.full((len(pixels), 3), np.nan)
        if len(image.points2D) == len(pixels):  # a photo without any match has no features there
            for at, feature in enumerate(image.points2D):
                if feature.has_point3D():
                    self._points[at] = model.point3D(feature.point3D_id).xyz

    def side(self, features: np.ndarray) -> Side:
        """Return this photo with the features of a pair's matches."""
        focal_px = float(self._camera.mean_focal_length())
        return Side(self.pose, self._rays[features], self._points[features], focal_px)


# -- What the solver's check of its own cameras found: facts and warnings of the report -----------

SOLUTION_NAME = "solution.json"
"""Of the helper, in its folder."""
_NAMED = 5
"""Most photos or pairs that a warning names."""
_MIN_PART = 3
"""Photos of a part that is worth a warning; single ones hang on few matches everywhere."""
_logger = logging.getLogger(__name__)


def with_findings(model: SourceModel, folder: Path, source_names: Mapping[str, str]) -> SourceModel:
    """Add facts and warnings to a solved model; warnings also go to the log.

    Parameters
    ----------
    folder : Path
        The solver's.
    source_names : mapping of str to str
        Photos by the solver's names.
    """
    found = read_json(folder / SOLUTION_NAME)
    warnings = findings(found, source_names)
    for warning in warnings:
        _logger.warning("%s %s", warning.text, warning.hint)
    facts = {
        **model.facts, "pairs_matched": found["pairs_matched"], "pairs_verified": found["pairs"],
        "pairs_contradicting_cameras": found["contradicting_pairs"],
        "photos_joined": found["joined"], "mapper": found["mapper"],
    }  # fmt: skip
    return dataclasses.replace(model, facts=facts, warnings=(*model.warnings, *warnings))


def photos_in_parts(folder: Path) -> frozenset[str]:
    """Return the photos, by the solver's names, of parts that a warning says stay apart."""
    return frozenset(name for part in read_json(folder / SOLUTION_NAME)["apart"] for name in part)


def findings(found: Mapping[str, Any], source_names: Mapping[str, str]) -> list[ReportWarning]:
    """Return the warnings of ``solution.json``."""
    warnings = []

    def add(code: str, text: str, hint: str) -> None:
        warnings.append(ReportWarning(code, text, hint))

    share = f"{100 * found['contradicting_share']:.0f} %"
    if found["is_doubtful"]:
        strongest = "; ".join(
            f"{source_names[one]} and {source_names[other]} ({agreeing} of {matches} matches fit)"
            for one, other, matches, agreeing in found["strongest"][:_NAMED]
        )
        add(
            "cameras-contradicted",
            f"The solved cameras may be wrong: {found['contradicting_pairs']} of "
            f"{found['strong_pairs']} strong pairs of photos, with {share} of the matches, "
            f"contradict them, as where things look alike or repeat. Strongest: {strongest}.",
            "Look at the cameras before the mesh. Take photos that show what is different "
            "from place to place, or mask what repeats.",
        )
    if found["is_mended"]:
        add(
            "cameras-mended",
            "The cameras solved first contradicted many matches. These are solved again from "
            "the photos that have most in common, and contradict fewer of their matches.",
            "Look at the cameras before the mesh.",
        )
    weak = [part for part in found["parts"][1:] if len(part) >= _MIN_PART]
    if weak:
        add(
            "cameras-weakly-linked",
            f"{sum(map(len, weak))} placed photos are linked to the others by few matches; where "
            f"they stand is uncertain: {_listed(weak, source_names)}.",
            "Take photos in between, with more overlap.",
        )
    if found["apart"]:
        add(
            "cameras-in-parts",
            f"{sum(map(len, found['apart']))} photos fit each other but not the rest, in "
            f"{len(found['apart'])} parts, and are not used: "
            f"{_listed(found['apart'], source_names)}.",
            "Take photos that connect the parts.",
        )
    return warnings


def _listed(parts: Sequence[Sequence[str]], source_names: Mapping[str, str]) -> str:
    names = [source_names[name] for part in parts for name in part]
    return ", ".join(names[:_NAMED]) + (" ..." if len(names) > _NAMED else "")
