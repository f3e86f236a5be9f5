# SPDX-License-Identifier: GPL-3.0-or-later
"""What the meshing study measures: scenes, methods, sizes."""

from __future__ import annotations

import dataclasses

from ..speed_error.plan import Photos, Run

TETRAHEDRA, UNIFORM, ADAPTIVE, FUSION = "tetrahedra", "uniform", "adaptive", "tsdf"
METHODS = (TETRAHEDRA, UNIFORM, ADAPTIVE, FUSION)

LABELS = {
    TETRAHEDRA: "marching tetrahedra",
    UNIFORM: "PAM uniform",
    ADAPTIVE: "PAM adaptive",
    FUSION: "TSDF fusion",
}
"""Words for tables."""
UNITS = {TETRAHEDRA: "pivots", UNIFORM: "points", ADAPTIVE: "points", FUSION: "voxels"}
"""What the size of a method counts; voxels: along the region's diagonal."""

PAM = (UNIFORM, ADAPTIVE)

SPACING_SCENES = ("spot", "wheel", "room")
"""Where uniform and adaptive spacing are compared at several sizes."""
RENDERED = ("spot", "wheel", "torus", "fence", "room", "cup_inside")
REAL = ("fox", "flowerpot", "banana")
LARGE_SCENE, LARGE_POINTS = "fox", 200_000

POINTS = (6000, 12_000, 24_000)
"""The last has half the edge length of the first, so that a doubled resolution is among them."""
VOXELS = (150, 300)
PHOTOS, PRESET = Photos(40, 640, 480), "standard"
"""Of the rendered scenes, and how all scenes are trained: thin parts are opaque only then."""

VACANCY = "vacancy"
"""Word for ``--only``: a million points from fifty cameras."""


@dataclasses.dataclass(frozen=True)
class Method:
    """One way to make a mesh, at one size."""

    name: str
    size: int
    """Pivots a Gaussian, points asked for, or voxels along the region's diagonal."""

    @property
    def identity(self) -> str:
        """File name and word for ``--only``."""
        return f"{self.name}-{self.size}"

    @property
    def label(self) -> str:
        """Words for tables."""
        return LABELS[self.name]


@dataclasses.dataclass(frozen=True)
class Subject:
    """A scene, trained once, and the meshes that are made of it."""

    run: Run
    photos: Photos | None
    """``None``: real photos, without a true surface."""
    methods: tuple[Method, ...]
    reference_points: int
    """Of the fine uniform mesh that stands for the isosurface."""

    @property
    def name(self) -> str:
        """Of the scene."""
        return self.run.scene

    @property
    def folder(self) -> str:
        """Name of the folder of trainings on photos of this size."""
        if self.photos is None:
            return "real"
        return f"{self.photos.count}x{self.photos.width}x{self.photos.height}"


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that is measured, the most important first: time may not suffice for all."""

    subjects: tuple[Subject, ...]
    vacancy: bool
    """Whether a million points from fifty cameras are timed."""
    minutes: float
    """Nothing is begun after this; 0: there is no limit."""

    @property
    def words(self) -> set[str]:
        """What ``--only`` may name."""
        methods = {m for s in self.subjects for m in s.methods}
        return (
            {s.name for s in self.subjects}
            | {m.name for m in methods}
            | {m.identity for m in methods}
            | ({VACANCY} if self.vacancy else set())
        )


def _methods(points: tuple[int, ...], voxels: tuple[int, ...]) -> tuple[Method, ...]:
    return (
        *(Method(UNIFORM, count) for count in points),
        *(Method(ADAPTIVE, count) for count in points),
        Method(TETRAHEDRA, 2),
        Method(TETRAHEDRA, 9),
        *(Method(FUSION, count) for count in voxels),
    )


REFERENCE_FACTOR = 8
"""The reference has so many times the points of the finest mesh: about a third of its edge length,
an eighth of its chord errors."""


def full_plan() -> Plan:
    """Return the plan of the committed report."""
    reference = REFERENCE_FACTOR * POINTS[-1]
    every, finest = _methods(POINTS, VOXELS), _methods(POINTS[-1:], VOXELS[-1:])
    rendered = {
        name: Subject(
            Run(name, PRESET), PHOTOS, every if name in SPACING_SCENES else finest, reference
        )
        for name in RENDERED
    }
    large = tuple(Method(name, LARGE_POINTS) for name in PAM)
    real = {
        name: Subject(
            Run(name, PRESET),
            None,
            (*finest, *(large if name == LARGE_SCENE else ())),
            reference,
        )
        for name in REAL
    }
    subjects = {**rendered, **real}
    order = (
        "spot", "wheel", "room", "torus", "fence", "fox", "flowerpot", "banana", "cup_inside",
    )  # fmt: skip
    return Plan(tuple(subjects[name] for name in order), True, 0.0)


def quick_plan() -> Plan:
    """Return a plan of a few minutes: it shows that all works, not how well."""
    run = Run("spot", "draft", 0, "few", ("--iterations", "400", "--max-gaussians", "8000"))
    methods = (*_methods((1500, 3000, 6000), (100,)),)
    return Plan((Subject(run, Photos(24, 192, 144), methods, 24_000),), False, 10.0)
