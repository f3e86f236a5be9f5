# SPDX-License-Identifier: GPL-3.0-or-later
"""One tile: points, faces, simplified surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...errors import MeshingError
from ...mesh.components import compacted
from ...mesh.sampling import EDGE_PER_RADIUS, thin
from ...mesh.simplification import Units, merge_vertices
from ...progress import Progress
from ...regions.shapes import Region
from ..classification import classify, faces_opposite, of_neighbours, tetrahedron_neighbours
from ..delaunay import bounding_points, delaunay
from ..primal_adaptive import DEGENERATE_SHARE, LONGEST_EDGE_SHARE, kinds_after
from ..repair import remove_degenerate, split_nonmanifold
from ..spacing import ResolutionRequest
from ..surface_points import (
    KIND_CAP,
    KIND_JUMP,
    PRIORITY_SURFACE,
    Field,
    SurfacePoints,
    SurfaceSampler,
)
from .plan import CLEARANCE_CAP_RADII, CLEARANCE_RADII, JITTER_SHARE, TilePlan, outside_clearance

# -- Sample the surface points of one tile, and gather the points of all tiles --------------------

KIND_STEINER = 4
"""A Steiner point between inside and outside, where the field is ambiguous away from a surface."""

MARGIN_RADII = 4.0
"""Candidates up to this many of the largest radii beyond a tile may be projected into it."""

PIECE_RADII = 8.0
"""Triangles of the candidate surface across the border are split until edges are this short."""
MAX_SPLITS = 24


def tile_points(field: Field, plan: TilePlan, tile: int, progress: Progress) -> SurfacePoints:
    """Sample the points of a tile, thinned among themselves.

    The result is the same for any number of threads and on any machine of the same kind.
    """
    low, high = plan.tiling.box(tile)
    margin = MARGIN_RADII * plan.radius
    vertices, faces = pieces_in_box(
        plan.surface.vertices, plan.surface.faces, low - margin, high + margin,
        PIECE_RADII * plan.radius,
    )  # fmt: skip
    faces = faces[plan.region.contains(vertices[faces].mean(1), margin)]
    if len(faces) == 0:
        return _no_points(plan)
    surface = replace(plan.surface, vertices=vertices, faces=faces)
    sampler = SurfaceSampler(field, plan.region, surface)
    if sampler.area <= 0.0:
        return _no_points(plan)
    rng = np.random.default_rng([plan.seed, tile, 0])
    return sampler.sample(
        ResolutionRequest(0.0, 0), rng, progress, spacing=plan.spacing,
        owned=lambda where: plan.tiling.owner(where) == tile,
    )  # fmt: skip


def _no_points(plan: TilePlan) -> SurfacePoints:
    none, kind = np.zeros((0, 3)), np.zeros(0, np.uint8)
    return SurfacePoints(none, none, kind, np.zeros(0), plan.spacing.nominal, (), {})


def pieces_in_box(
    vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a triangle soup that covers the part of a surface in a box, and little more.

    Triangles across the border are bisected at their longest edge until it is shorter than
    ``length``; pieces outside are dropped.
    """
    corners = vertices[faces]  # (f, 3, 3)
    for _ in range(MAX_SPLITS):
        lowest, highest = corners.min(1), corners.max(1)
        corners = corners[((highest >= low) & (lowest <= high)).all(1)]
        edges = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)  # (f, 3)
        whole = ((corners >= low[None, None]) & (corners <= high[None, None])).all((1, 2))
        cut = np.flatnonzero(~whole & (edges.max(1) > length))
        if len(cut) == 0:
            break
        longest = edges[cut].argmax(1)
        rows = np.arange(len(cut))
        a, b, c = (corners[cut][rows, (longest + k) % 3] for k in range(3))
        middle = (a + b) / 2
        first, second = np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)
        corners = np.concatenate([np.delete(corners, cut, 0), first, second])
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


@dataclass(frozen=True)
class GatheredPoints:
    """The points of the whole region: a few bytes each, held by every worker."""

    cloud: SurfacePoints
    """Surface points, cap points and Steiner points (normal 0, ``KIND_STEINER``)."""
    shifted: np.ndarray  # (n, 3) float64: perturbed positions for the triangulation
    inner: np.ndarray  # (n,) bool: false for Steiner points beyond the region


def gather(plan: TilePlan, parts: list[SurfacePoints]) -> GatheredPoints:
    """Thin the points of all tiles, in order, with the caps; drop Steiner points near them."""
    rng = np.random.default_rng([plan.seed, len(plan.tiling), 1])
    caps = plan.caps
    points, normals, radii = (
        np.concatenate([getattr(some, name) for some in (caps, *parts)])
        for name in ("points", "normals", "radii")
    )
    kind = np.full(len(points), KIND_CAP, np.uint8)
    kind[len(caps.points) :] = np.concatenate([part.kind for part in parts])
    # As within a tile: jumps come last among surface points.
    priority = PRIORITY_SURFACE + 0.5 * (rng.random(len(points)) + (kind == KIND_JUMP))
    priority[: len(caps.points)] = caps.priority
    kept = thin(points, normals, radii, priority)
    points, normals, radii, kind = points[kept], normals[kept], radii[kept], kind[kept]
    is_cap = kind == KIND_CAP
    free = np.ones(len(plan.steiner_points), np.bool_)
    for chosen, clear in ((~is_cap, CLEARANCE_RADII), (is_cap, CLEARANCE_CAP_RADII)):
        free &= outside_clearance(plan.steiner_points, points[chosen], clear * radii[chosen])
    steiner_points = plan.steiner_points[free]
    figures = {
        "surface_points": int((~is_cap).sum()),
        "cap_points": int(is_cap.sum()),
        "fillers": len(steiner_points),
        "limited_by_photos_share": plan.spacing.limited,
        "shortest_spacing_scene": EDGE_PER_RADIUS * float(radii.min(initial=np.inf)),
        "longest_spacing_scene": EDGE_PER_RADIUS * float(radii.max(initial=0.0)),
    }
    for name in ("candidates", "dropped_candidates", "jump_points", "projection_evaluations"):
        figures[name] = sum(part.figures.get(name, 0) for part in parts)
    inner = np.append(np.ones(len(points), np.bool_), plan.region.distance(steiner_points) < 0)
    cloud = SurfacePoints(
        np.concatenate([points, steiner_points]),
        np.concatenate([normals, np.zeros_like(steiner_points)]),
        np.concatenate([kind, np.full(len(steiner_points), KIND_STEINER, np.uint8)]),
        np.concatenate([radii, np.full(len(steiner_points), np.inf)]),
        plan.spacing.nominal, plan.notes, figures,
    )  # fmt: skip
    shift = JITTER_SHARE * plan.region.diagonal * rng.uniform(-1.0, 1.0, cloud.points.shape)
    return GatheredPoints(cloud, cloud.points + shift, inner)


# -- Faces between the tetrahedra of different tiles: on the surface where one of them is solid


def tiles_disagree() -> MeshingError:
    """Return the error that the faces of tiles do not fit together."""
    return MeshingError(
        "Tiles do not agree on their border.", "Use another seed or number of tiles."
    )


class BorderFaces:
    """Holds the faces that one tile has listed until the other one has, too.

    A face listed by a single tile, when all tiles at one of its corners are there, lies on the
    region's boundary.
    """

    def __init__(self) -> None:
        self._faces = np.zeros((0, 3), np.int64)
        self._solid = self._settled = np.zeros(0, np.bool_)

    def add(self, faces: np.ndarray, solid: np.ndarray) -> np.ndarray:
        """Add the border faces of a tile; return those of the surface that this settles.

        ``faces`` (b, 3) hold indices of points and are oriented out of the tile; ``solid`` (b,)
        tells whether the tile's tetrahedron at each is inside. Returns (k, 3) int64, oriented
        outward.
        Raises MeshingError: two tiles have triangulated the points near their border differently.
        """
        border = np.concatenate([self._faces, faces])
        solid = np.concatenate([self._solid, solid])
        settled = np.concatenate([self._settled, np.zeros(len(faces), np.bool_)])
        low = np.sort(border, 1)
        order = np.lexsort((low[:, 2], low[:, 1], low[:, 0]))
        same = (low[order[1:]] == low[order[:-1]]).all(1)
        first, second = order[:-1][same], order[1:][same]
        turned = _parity(border[first]) != _parity(border[second])
        twice = settled[first] | settled[second]
        if (same[1:] & same[:-1]).any() or not turned.all() or twice.any():
            raise tiles_disagree()
        settled[first] = True
        surface = np.where(solid[first, None], border[first], border[second])
        surface = surface[solid[first] != solid[second]]
        # One of each pair stays, to notice a third.
        kept = np.ones(len(border), np.bool_)
        kept[second] = False
        self._faces, self._solid, self._settled = border[kept], solid[kept], settled[kept]
        return surface.astype(np.int64)

    def close(self, points: np.ndarray) -> np.ndarray:
        """Forget the faces at points whose tiles are all there; return those of the surface."""
        closed = np.isin(self._faces, points).any(1)
        surface = self._faces[closed & self._solid & ~self._settled]
        self._faces, self._solid = self._faces[~closed], self._solid[~closed]
        self._settled = self._settled[~closed]
        return surface


def _parity(faces: np.ndarray) -> np.ndarray:
    """Return the parity of the permutation that sorts the corners of each face, (f,) bool."""
    a, b, c = faces.T
    return (a < b) ^ (b < c) ^ (c < a)


# -- Label the tetrahedra of one tile and extract its part of the boundary faces ------------------
#
# Each tetrahedron inside the region is owned by the tile of its corner with the smallest index.
# All tiles agree on the tetrahedron (:mod:`.plan`), and only its owner labels it. So
# the faces of all tiles together bound a set of tetrahedra of one triangulation: they are closed,
# whatever the labels are.

CONTEXT_RADII = 4.0
"""Tetrahedra of other tiles within this distance are labelled as well, as neighbours of the own."""


@dataclass(frozen=True)
class TileFaces:
    """Faces of one tile; corners are indices into the gathered points of the region."""

    faces: np.ndarray
    """(f, 3) int64, oriented outward: between two tetrahedra of the tile, or on the region's
    boundary."""
    border: np.ndarray
    """(b, 3) int64: faces between the tile's tetrahedra and others, oriented out of the tile's."""
    solid: np.ndarray  # (b,) bool: whether the tile's tetrahedron at that face is inside
    figures: dict[str, Any]
    whole: np.ndarray
    """(p,) int64, increasing: points whose faces are all in ``faces``, since no other tile has a
    tetrahedron there."""


def tile_faces(
    field: Field, plan: TilePlan, gathered: GatheredPoints, tile: int, progress: Progress
) -> TileFaces:
    """Triangulate the points in and around a tile, label its tetrahedra, return its faces."""
    numbers = np.flatnonzero(plan.tiling.within(tile, gathered.shifted, plan.halo))
    own = plan.tiling.owner(gathered.cloud.points[numbers]) == tile
    if not (own & gathered.inner[numbers]).any():
        none = np.zeros((0, 3), np.int64)
        return TileFaces(none, none, np.zeros(0, np.bool_), {}, np.zeros(0, np.int64))
    seed = int(np.random.default_rng([plan.seed, tile, 2]).integers(2**31))
    numbers, tetrahedra = local_tetrahedra(plan, gathered, tile, seed, progress.span(0.0, 0.2))
    # Farther away they may differ from the triangulation of the whole region.
    near = plan.tiling.within(tile, gathered.cloud.points[numbers], CONTEXT_RADII * plan.radius)
    near, inner, own = (  # the bounding points are none of these
        np.append(flags, np.zeros(8, np.bool_)) for flags in (near, gathered.inner[numbers], own)
    )
    tetrahedra = tetrahedra[near[tetrahedra].any(1)]
    neighbours = tetrahedron_neighbours(tetrahedra)
    outer = ~inner[tetrahedra].all(1)
    # Indices of the region's points increase with the local ones.
    owned = ~outer & own[tetrahedra.min(1)]
    # Only outer tetrahedra have bounding points as corners, whose positions are not used.
    points = np.concatenate([gathered.cloud.points[numbers], np.zeros((8, 3))])
    rng = np.random.default_rng([plan.seed, tile, 3])
    labels = classify(
        points, tetrahedra, neighbours, outer, gathered.cloud.normals[numbers],
        gathered.cloud.radii[numbers], field.vacancy, rng, progress.span(0.2, 1.0),
    )  # fmt: skip
    inside = labels.inside
    known, theirs = of_neighbours(owned, neighbours), of_neighbours(inside, neighbours)  # (m, 4)
    # A neighbour with a corner in the tile is the same in all tiles.
    beyond = owned[:, None] & (neighbours >= 0) & outer[neighbours]
    known[beyond] = own[faces_opposite(tetrahedra, beyond)].any(1)
    theirs[beyond] = False
    faces = faces_opposite(tetrahedra, (owned & inside)[:, None] & known & ~theirs)
    at_border = owned[:, None] & ~known
    border = faces_opposite(tetrahedra, at_border)
    # All tetrahedra at points of the tile are there.
    whole = own.copy()
    whole[tetrahedra[~owned & ~outer]] = False
    figures = {
        "tetrahedra": int(owned.sum()),
        "interior_samples": int(labels.samples[owned].sum()),
        "relabelled_tetrahedra": labels.flipped,
        "undecided_tetrahedra": labels.undecided,
    }
    whole = numbers[whole[:-8] & gathered.inner[numbers]]
    solid = inside[np.nonzero(at_border)[0]]
    return TileFaces(numbers[faces], numbers[border], solid, figures, whole)


def local_tetrahedra(
    plan: TilePlan, gathered: GatheredPoints, tile: int, seed: int, progress: Progress
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the points in and around a tile.

    Tetrahedra with a corner in the tile and one in the region are those of the whole region.
    Returns increasing indices of the points, (n,) int64, and tetrahedra of indices into these,
    (m, 4) int64; n and above are bounding points.
    """
    numbers = np.flatnonzero(plan.tiling.within(tile, gathered.shifted, plan.halo))
    shifted = gathered.shifted[numbers]
    shifted = np.concatenate([shifted, bounding_points(shifted, seed)])
    return numbers, delaunay(shifted, seed=seed, progress=progress, jitter_share=0.0)


# -- The surface of one tile: made manifold where it is the tile's alone, and prepared to be
#    joined
#
# A point is the tile's alone if no other tile has a tetrahedron there: then the tile knows all
# faces at it, and repair, removal of degenerate faces and vertex selection do there what they
# would do on the whole surface. The selection is not applied yet. How many vertices a tile may
# keep depends on all others; so each vertex gets the cost at which it is merged, and whoever
# joins the tiles chooses one highest cost for all. The other points stay as they are, in a band
# along the tile's border.

DEEPER = 4
"""Mergers go on until this many times fewer vertices are left than stay on average: in tiles that
are flatter than others fewer stay."""


@dataclass(frozen=True)
class TileSurface:
    """Dense faces of a tile, and the order in which its vertices may be merged."""

    vertices: np.ndarray  # (v, 3) float64, scene frame
    faces: np.ndarray  # (f, 3) int32, oriented outward; open along the tile's border
    number: np.ndarray
    """(v,) int32: index in the region's points of those that other tiles may have as well, else
    -1."""
    kind: np.ndarray  # (v,) uint8
    into: np.ndarray  # (v,) int32: see :class:`~.simplification.Merged`
    level: np.ndarray  # (v,) float64: see there
    border: np.ndarray  # (b, 3) int32: faces towards other tiles, as indices in the region's points
    solid: np.ndarray
    """(b,) bool: which of those have the tile's solid behind them; ``vertices`` has their
    corners."""
    least_height: float  # faces with a smaller height are removed; the same for all tiles
    figures: dict[str, Any]


def cost_units(region: Region) -> Units:
    """Return the units in which all tiles of a region measure costs."""
    return Units(np.asarray(region.center), region.diagonal)


def tile_surface(plan: TilePlan, gathered: GatheredPoints, part: TileFaces) -> TileSurface:
    """Repair a tile's faces where they are the tile's alone, and put its vertices in order."""
    cloud = gathered.cloud
    corners = np.concatenate([part.faces, part.border[part.solid]])
    shared = np.ones(len(cloud.points), np.bool_)
    shared[part.whole] = False
    shared[part.border] = True
    points, local, number = compacted(cloud.points, corners)
    fixed = shared[number]
    repaired = split_nonmanifold(points, local[: len(part.faces)], fixed)
    # Corners of border faces that the tile's own faces do not have.
    alone = np.setdiff1d(np.arange(len(points)), repaired.origin)
    vertices = np.concatenate([repaired.vertices, points[alone]])
    origin = np.concatenate([repaired.origin, alone])
    fixed = (origin >= 0) & fixed[np.maximum(origin, 0)]
    height = DEGENERATE_SHARE * float(cloud.radii.min())
    faces, _ = remove_degenerate(vertices, repaired.faces, height, plan.region, fixed)
    used = fixed.copy()
    used[faces] = True
    vertices, origin, fixed = vertices[used], origin[used], fixed[used]
    faces = (np.cumsum(used) - 1)[faces]
    kind = kinds_after(cloud.kind[number], repaired.origin)
    kind = np.append(kind, cloud.kind[number[alone]])[used]
    into, level = np.full(len(vertices), -1), np.full(len(vertices), np.inf)
    if plan.share < 1.0:
        least = int(fixed.sum()) + int(plan.share * (~fixed).sum()) // DEEPER
        merged = merge_vertices(
            vertices, faces, cost_units(plan.region), least, longest_edge(plan), locked=fixed
        )
        into, level = merged.into, merged.level
    splits = {"split_vertices": repaired.split_vertices, "split_edges": repaired.split_edges}
    number = np.where(fixed, number[np.maximum(origin, 0)], -1)
    return TileSurface(
        vertices, faces.astype(np.int32), number.astype(np.int32), kind, into.astype(np.int32),
        level, part.border.astype(np.int32), part.solid, height, {**part.figures, **splits},
    )  # fmt: skip


def longest_edge(plan: TilePlan) -> float:
    """Return the greatest length of an edge of the simplified mesh."""
    return LONGEST_EDGE_SHARE * plan.region.diagonal
