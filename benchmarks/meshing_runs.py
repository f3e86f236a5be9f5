# SPDX-License-Identifier: GPL-3.0-or-later
"""The meshing study: which scenes and methods, and their runs."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.files import read_json, write_json

from .runs import Photos, Run, Settings, code_state, first_line, judged_by, measured, run_wrap
from .scenes.cache import ensure_scene

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


_logger = logging.getLogger("benchmarks")

_ONE_MESH = "benchmarks.one_mesh"
_JUDGE = "benchmarks.meshing_judge"
_VACANCY = "benchmarks.vacancy_scale"

WARM_POINTS = 1500
MESH, MEASURED = "mesh.npz", "measured.json"
"""What :mod:`.one_mesh` writes."""


@dataclasses.dataclass(frozen=True)
class Made:
    """A mesh with its figures."""

    subject: Subject
    method: Method
    figures: dict[str, Any]
    """Of :mod:`.one_mesh`, with ``code`` and ``load_before``."""
    scores: dict[str, Any]
    """Of :mod:`.meshing_judge`."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Everything that a plan gave."""

    made: list[Made]
    trainings: dict[str, dict[str, Any]]
    """What the trainings measured of themselves, by scene."""
    vacancy: dict[str, Any] | None
    """Of :mod:`.vacancy_scale`."""
    missing: list[tuple[str, str]]
    """What was not measured, or failed, each with the reason."""
    failed: bool


class _Work:
    """The time that is left, and what the caller wants."""

    def __init__(self, plan: Plan, settings: Settings, only: Sequence[str]) -> None:
        self.settings, self.only, self.minutes = settings, set(only), plan.minutes
        self.begun_s = time.monotonic()
        self.outcome = Outcome([], {}, None, [], False)
        self.warm: set[str] = set()
        self.keep_trainings = False

    def refusal(self, words: set[str]) -> str | None:
        """Return why something that is not finished yet is not begun, if so."""
        if self.only and not words & self.only:
            return "left out by --only"
        if self.minutes and time.monotonic() - self.begun_s > 60 * self.minutes:
            return f"not begun within {self.minutes:g} minutes"
        return None

    def miss(self, name: str, reason: str, *, failed: bool = False) -> None:
        """Keep that something has no figures."""
        self.outcome.missing.append((name, reason))
        if failed:
            _logger.warning("%s %s", name, reason)
            self.outcome = dataclasses.replace(self.outcome, failed=True)


def carry_out(
    plan: Plan,
    settings: Settings,
    data: Path | None,
    only: Sequence[str] = (),
    *,
    keep_trainings: bool = False,
) -> Outcome:
    """Train, mesh and judge in the plan's order until its time is over.

    Parameters
    ----------
    settings : Settings
        ``reuse`` keeps finished trainings, meshes and judgements.
    data : Path or None
        Folder with the real sets; those that it lacks are left out, with the reason.
    only : sequence of str
        What none of these words names is not made; with ``reuse`` finished figures are shown.
    keep_trainings : bool
        Keep finished trainings, make meshes anew.
    """
    work = _Work(plan, settings, only)
    work.keep_trainings = keep_trainings or settings.reuse
    if plan.vacancy:
        _time_vacancy(work)
    for subject in plan.subjects:
        _carry_out_subject(work, subject, data)
    return work.outcome


def _time_vacancy(work: _Work) -> None:
    path = work.settings.folder / f"{VACANCY}.json"
    finished = work.settings.reuse and path.is_file()
    reason = None if finished else work.refusal({VACANCY})
    if reason is not None:
        work.miss("vacancy of a million points", reason)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        found = judged_by(_VACANCY, [str(path)], path, work.settings)
    except WorkerError as error:
        work.miss("vacancy of a million points", f"failed: {first_line(str(error))}", failed=True)
        return
    work.outcome = dataclasses.replace(work.outcome, vacancy=found)


def _carry_out_subject(work: _Work, subject: Subject, data: Path | None) -> None:
    own = dataclasses.replace(work.settings, folder=work.settings.folder / subject.folder)
    meshes = own.folder / subject.run.identity / "meshes"
    wanted: list[Method] = []
    for method in subject.methods:
        finished = own.reuse and (meshes / method.identity / "scores.json").is_file()
        words = {subject.name, method.name, method.identity}
        reason = None if finished else work.refusal(words)
        if reason is None:
            wanted.append(method)
        else:
            work.miss(f"{subject.name}, {method.identity}", reason)
    if not wanted:
        return
    scene = _scene(subject, data)
    if isinstance(scene, str):
        work.miss(subject.name, scene)
        return
    try:
        folder = run_wrap(subject.run, scene, dataclasses.replace(own, reuse=work.keep_trainings))
    except WorkerError as error:
        work.miss(f"training of {subject.name}", f"failed: {first_line(str(error))}", failed=True)
        return
    work.outcome.trainings[subject.name] = measured(folder)
    _logger.info("%s is trained", subject.name)
    reference: Path | None = None
    for method in wanted:
        name = f"{subject.name}, {method.identity}"
        # The reference alone may take minutes: the time is asked for again.
        finished = own.reuse and (meshes / method.identity / "scores.json").is_file()
        late = None if finished else work.refusal({subject.name, method.name, method.identity})
        if late is not None:
            work.miss(name, late)
            continue
        try:
            if reference is None and not finished:
                reference = _reference(work, subject, scene, folder, own)
            made = _make(work, subject, method, scene, folder, reference, own)
        except WorkerError as error:
            work.miss(name, f"failed: {first_line(str(error))}", failed=True)
            if reference is None and not finished:
                return
            continue
        work.outcome.made.append(made)
        _log(made)


def _reference(work: _Work, subject: Subject, scene: Path, folder: Path, own: Settings) -> Path:
    """Return the fine mesh that stands for the isosurface."""
    target = folder / "meshes" / "reference"
    _one_mesh(work, Method(UNIFORM, subject.reference_points), scene, folder, target, own)
    _logger.info("reference of %s", subject.name)
    return target / MESH


def _make(
    work: _Work,
    subject: Subject,
    method: Method,
    scene: Path,
    folder: Path,
    reference: Path | None,
    own: Settings,
) -> Made:
    target = folder / "meshes" / method.identity
    figures = _one_mesh(work, method, scene, folder, target, own)
    path = target / "scores.json"
    arguments = [str(p) for p in (scene, folder / "out", target / MESH, reference, path)]
    return Made(subject, method, figures, judged_by(_JUDGE, arguments, path, own))


def _one_mesh(
    work: _Work, method: Method, scene: Path, folder: Path, target: Path, own: Settings
) -> dict[str, Any]:
    """Make a mesh in a process of its own; the first of a kind is made twice, to compile."""
    path = target / MEASURED
    if own.reuse and path.is_file():
        return dict(read_json(path))
    if method.name not in work.warm:
        small = method.size if method.size < WARM_POINTS else WARM_POINTS
        _child(Method(method.name, small), scene, folder, folder / "meshes" / "warm-up", own)
        shutil.rmtree(folder / "meshes" / "warm-up")
        work.warm.add(method.name)
    shutil.rmtree(target, ignore_errors=True)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    figures = _child(method, scene, folder, target, own)
    write_json(path, {**figures, "code": code_state(), "load_before": load})
    return dict(read_json(path))


def _child(
    method: Method, scene: Path, folder: Path, target: Path, own: Settings
) -> dict[str, Any]:
    arguments = [
        str(scene), str(folder / "out"), str(target), "--method", method.name,
        "--size", str(method.size),
    ]  # fmt: skip
    anew = dataclasses.replace(own, reuse=False)
    return judged_by(_ONE_MESH, arguments, target / MEASURED, anew)


def _scene(subject: Subject, data: Path | None) -> Path | str:
    """Return the folder of the photos, or why there is none."""
    if subject.photos is not None:
        size = subject.photos
        return ensure_scene(subject.name, photos=size.count, width=size.width, height=size.height)
    if data is None:
        return "real photos lie outside of this repository: name their folder with --data"
    folder = data / subject.name
    if not (folder / "images").is_dir():
        return f"the folder of --data holds no {subject.name}/images"
    return folder


def _log(made: Made) -> None:
    figures, scores = made.figures, made.scores
    mean = scores["distance"]["mean"]
    words = "no surface in the region" if mean is None else f"{100 * mean:.4f} % of the diagonal"
    _logger.info(
        "%s, %s: %d vertices, %.0f s, %s off the isosurface",
        made.subject.name, made.method.identity, figures["vertices"], figures["wall_s"], words,
    )  # fmt: skip
