# SPDX-License-Identifier: GPL-3.0-or-later
"""A job as parts: planned, with a state each."""

from __future__ import annotations

import hashlib
import os
import re
import time
import uuid
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path, PurePosixPath
from typing import Any

from ... import limits
from ...errors import (
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_RESOURCES,
    DeviceError,
    ParseError,
    UsageError,
    WorkerError,
)
from ...farm import child
from ...files import overwrite_json, read_json, resolve_inside, write_json
from ...names import FACES, GATHER, POINTS, region_names
from ...settings import key_values
from ...worker.spawn import host_and_pid_namespace, process_start_ticks
from ..store.job_file import JobFile, read_job
from ..store.job_folder import JobFolder, has_type
from ..store.stage_folder import STAGE_VERSIONS, stage_key

# -- Exit codes of ``run-part``: what an engine may do with a part that is not done ---------------

DONE = EXIT_DONE
NEVER = 1
"""Bad data: it fails wherever it is run."""
MAY_WORK_ELSEWHERE = 2
"""Memory, disk, a device, a killed helper: elsewhere or later it may work."""
OTHER_CODE = child.OTHER_CODE
"""This computer has another version of the program than the one that planned."""
CANCELLED = EXIT_CANCELLED


def part_exit_code(error: Exception, job_code: int) -> int:
    """Return the exit code of a part that ended with an error, by what a job's would be."""
    if job_code == EXIT_CANCELLED:
        return CANCELLED
    elsewhere = job_code == EXIT_RESOURCES or isinstance(error, WorkerError | DeviceError)
    return MAY_WORK_ELSEWHERE if elsewhere else NEVER


# -- The version of the code that runs parts: two computers must have the same --------------------

_CORE = Path(__file__).resolve().parents[2]
_DIGITS = 12


@cache
def code_version() -> str:
    """Return a hash of all files of ``core``, whatever the line ends of their checkout."""
    hashed = hashlib.sha256()
    for path in sorted(_CORE.rglob("*.py"), key=lambda path: path.relative_to(_CORE).as_posix()):
        hashed.update(path.relative_to(_CORE).as_posix().encode())
        hashed.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return hashed.hexdigest()[:_DIGITS]


# -- The state of each part of a job: ``parts/NAME.json``, written by the process that runs it ----

STATES_FOLDER = "parts"
STATES = ("RUNNING", "DONE", "FAILED")


@dataclass(frozen=True)
class PartState:
    """What is known of a part that was begun."""

    state: str
    plan: str
    """Hash of the plan that it was run for."""
    place: str = ""
    """Where the pid is one: host, boot and namespace."""
    pid: int = 0
    pid_started: int = 0
    token: str = ""
    """Differs between two runs of the same part."""
    begun_s: float = 0.0
    """Unix time, by the clock of that computer."""
    heartbeat_s: float = 0.0
    """Unix time of the last sign of life, by the same clock."""
    fraction: float = 0.0
    message: str = ""
    attempts: int = 1
    error: str = ""
    hint: str = ""
    exit_code: int | None = None
    seconds: float = 0.0
    """How long it took, in this attempt."""
    peak_memory_bytes: int = 0
    figures: dict[str, float] = field(default_factory=dict)
    """Live figures, such as ``iteration`` and ``psnr`` of a training."""
    outputs: tuple[str, ...] = ()
    """Files and folders, relative to the job folder; of a stage first its own folder."""

    @property
    def host(self) -> str:
        """The computer, for people."""
        return self.place.split(" ")[0]


def state_path(root: Path, name: str) -> Path:
    """Return the state file of a part."""
    return root / STATES_FOLDER / f"{name}.json"


def write_state(root: Path, name: str, state: PartState) -> None:
    """Write the state of a part, atomically."""
    state_path(root, name).parent.mkdir(exist_ok=True)
    write_json(state_path(root, name), asdict(state))


def overwrite_state(root: Path, name: str, state: PartState) -> None:
    """Write the state of a part over the earlier one, where there is no room for another file."""
    overwrite_json(state_path(root, name), asdict(state))


def read_state(root: Path, name: str) -> PartState | None:
    """Return the state of a part; ``None`` where there is none, or it is damaged."""
    try:
        return _state_of(read_json(state_path(root, name), most_bytes=limits.MAX_PART_STATE_BYTES))
    except (OSError, ParseError, TypeError, ValueError, KeyError, OverflowError):
        return None


def done_state(root: Path, name: str, plan: str) -> PartState | None:
    """Return the state of a part that is done for a plan, and whose outputs are still there."""
    state = read_state(root, name)
    if state is None or state.state != "DONE" or state.plan != plan:
        return None
    paths = [resolve_inside(root, output) for output in state.outputs]
    return state if all(path is not None and path.exists() for path in paths) else None


def _state_of(values: Any) -> PartState:
    known: dict[str, Any] = {f.name: values[f.name] for f in fields(PartState)}
    types = {f.name: str(f.type) for f in fields(PartState)}
    if known["state"] not in STATES or not all(has_type(types[n], x) for n, x in known.items()):
        raise TypeError("a value has the wrong type")
    numbers = {name: float(x) for name, x in known.items() if types[name] == "float"}
    return PartState(**{**known, **numbers, "outputs": tuple(known["outputs"])})


def new_state(plan: str, attempt: int) -> PartState:
    """Return the state of a part that begins in this process."""
    pid, now_s = os.getpid(), time.time()
    return PartState(
        "RUNNING", plan, host_and_pid_namespace(), pid, process_start_ticks(pid),
        uuid.uuid4().hex, now_s, now_s, attempts=attempt,
    )  # fmt: skip


def keep_states(root: Path, names: Collection[str]) -> None:
    """Remove the states of all parts of a job but some."""
    for path in (root / STATES_FOLDER).glob("*.json"):
        if path.stem not in names:
            path.unlink(missing_ok=True)


# -- The parts of a job, what each needs, and ``parts.json`` (docs/file-formats.md, Parts) --------

VERSION = 1
PARTS_NAME = "parts.json"
KINDS = (
    "cameras", "masks", "coarse", "block", "train", "plan", "points", "gather", "faces", "mesh",
    "texture", "bake", "export",
)  # fmt: skip
"""In the order of a job."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,79}")
"""Of a part: also that of its state file."""
_AGAIN = "Plan the parts again: batch.py parts DIR."


@dataclass(frozen=True)
class Part:
    """What one process does at a time; it can be repeated, with the same result."""

    name: str
    kind: str
    needs: tuple[str, ...]
    """Names of parts that are done before."""
    outputs: tuple[str, ...]
    """Patterns of the files it makes, relative to the job folder; the state of a finished part
    has their names."""
    share: float
    """Of the job's time, estimated."""
    region: str = ""
    """Folder name of its region, if it is of one."""
    tile: int = -1
    """Number of its tile, if it is of one."""
    memory_bytes: int | None = None
    seconds: float | None = None
    """Estimated; ``None`` where nothing is known yet."""
    block: int = -1
    """Number of its block, if it trains one."""

    @property
    def is_one_of_many(self) -> bool:
        """Whether parts of its kind can run side by side with it."""
        return self.tile >= 0 or self.block >= 0


@dataclass(frozen=True)
class PartsGraph:
    """All parts of a job that are known so far."""

    code: str
    """Version of the code that planned: another one must not run the parts."""
    plan: str
    """Hash of what is to be done."""
    source: str
    """Path of the photos relative to the job folder; empty if they are on another drive."""
    parts: tuple[Part, ...]

    def part(self, name: str) -> Part:
        """Return a part by its name. Raises UsageError: there is none of this name."""
        if found := [part for part in self.parts if part.name == name]:
            return found[0]
        raise UsageError(f"The job has no part {name}.", f"Its parts are listed in {PARTS_NAME}.")

    def of_region(self, region: str) -> list[Part]:
        """Return the parts of a region, in their order."""
        return [part for part in self.parts if part.region == region]


def write_parts(folder: Path, graph: PartsGraph) -> None:
    """Write ``parts.json`` into a job folder, atomically."""
    write_json(folder / PARTS_NAME, {"version": VERSION, **asdict(graph)})


def read_parts(folder: Path) -> PartsGraph:
    """Read and check ``parts.json`` of a job folder.

    Raises UsageError: there is none; ParseError: it is damaged, of another version, or too large.
    """
    path = folder / PARTS_NAME
    try:
        values = read_json(path, most_bytes=limits.MAX_PARTS_BYTES)
    except FileNotFoundError:
        raise UsageError(
            f"{folder} has no {PARTS_NAME}: its work is not divided into parts yet.",
            "Divide it: batch.py parts DIR.",
        ) from None
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise ParseError(path, "version", f"it is not {VERSION}.", _AGAIN)
    listed = values.get("parts")
    if not isinstance(listed, list) or not 0 < len(listed) <= limits.MAX_PARTS:
        raise ParseError(path, "parts", f"not a list of 1 to {limits.MAX_PARTS:,} parts.", _AGAIN)
    texts = {}
    for key in ("code", "plan", "source"):
        found = values.get(key)
        if not isinstance(found, str) or len(found) > limits.MAX_NAME_BYTES:
            raise ParseError(path, key, "not a short text.", _AGAIN)
        texts[key] = found
    parts = []
    for number, entry in enumerate(listed):
        try:
            parts.append(_part_of(entry))
        except _WrongEntryError as error:
            where = f"parts[{number}]" + (f".{error.entry}" if error.entry else "")
            raise ParseError(path, where, f"{error}.", _AGAIN) from None
    graph = PartsGraph(texts["code"], texts["plan"], texts["source"], tuple(parts))
    _check_order(path, graph.parts)
    return graph


class _WrongEntryError(ValueError):
    """An entry of a part that is not as it should be."""

    def __init__(self, entry: str, words: str) -> None:
        super().__init__(words)
        self.entry = entry


def _part_of(entry: Any) -> Part:
    if not isinstance(entry, dict) or set(entry) != {f.name for f in fields(Part)}:
        raise _WrongEntryError("", "not the entries of a part")
    for key in ("name", "region"):
        text = entry[key]
        is_none = key == "region" and text == ""
        if not is_none and not (isinstance(text, str) and NAME.fullmatch(text)):
            raise _WrongEntryError(key, "not a name of letters, digits, _ and -")
    if entry["kind"] not in KINDS:
        raise _WrongEntryError("kind", "no kind of parts")
    outputs = _texts(entry, "outputs")
    for output in outputs:
        if PurePosixPath(output).is_absolute() or ".." in output or "\\" in output or ":" in output:
            raise _WrongEntryError("outputs", "not inside of the job folder")
    needs = _texts(entry, "needs")
    if len(set(needs)) != len(needs):
        raise _WrongEntryError("needs", "a name is there twice")
    return Part(
        entry["name"], entry["kind"], needs, outputs, _number(entry, "share", 0.0, 1.0),
        entry["region"], int(_number(entry, "tile", -1.0, limits.MAX_TILES)),
        _optional(entry, "memory_bytes", int), _optional(entry, "seconds", float),
        int(_number(entry, "block", -1.0, limits.MAX_BLOCKS)),
    )  # fmt: skip


def _texts(entry: dict[str, Any], key: str) -> tuple[str, ...]:
    values = entry[key]
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise _WrongEntryError(key, "not a list of texts")
    return tuple(values)


def _number(entry: dict[str, Any], key: str, least: float, most: float) -> float:
    value = entry[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise _WrongEntryError(key, f"not a number from {least:g} to {most:g}")
    return float(value)


def _optional(entry: dict[str, Any], key: str, kind: Any) -> Any:
    return None if entry[key] is None else kind(_number(entry, key, 0.0, 1e15))


def _check_order(path: Path, parts: Sequence[Part]) -> None:
    """Raise unless names are unique and each part can be done after what it needs."""
    names = {part.name for part in parts}
    if len({name.lower() for name in names}) != len(parts):  # each has a file
        raise ParseError(path, "parts", "two have the same name, but for case.", _AGAIN)
    for number, part in enumerate(parts):
        unknown = sorted(set(part.needs) - names)
        if unknown:
            where = f"parts[{number}].needs"
            raise ParseError(path, where, f"{unknown[0][:40]!r} is no part.", _AGAIN)
    try:
        TopologicalSorter({part.name: part.needs for part in parts}).prepare()
    except CycleError as error:
        circle = ", ".join(sorted(set(error.args[1]))[:3])
        raise ParseError(path, "parts", f"{circle} wait for each other.", _AGAIN) from None


# -- Plan the parts of a job: those of its stages, and those of tiles once they are known ---------

# Shares of a job's time: measured on the demo scene, 2 cores.
STAGE_SHARES = {"cameras": 0.12, "train": 0.60, "mesh": 0.14, "texture": 0.12, "export": 0.02}
MASKS_SHARE = 0.1
"""Of the time of a training that masks are made for."""
BAKE_BEGINS = 0.02
"""Share of a bake's time before the bake itself."""
_IN_BLOCKS = {"coarse": 0.12, "block": 0.68, "train": 0.2}
"""Shares of a training in blocks: the coarse one, all blocks, joining."""
_TILED = {"plan": 0.2, POINTS: 0.3, GATHER: 0.03, FACES: 0.37, "mesh": 0.1}
"""Shares of the mesh stage of a region in tiles."""


@dataclass(frozen=True)
class PlannedTiles:
    """What is known of a region in tiles."""

    count: int
    memory_bytes: int | None = None
    """Of a process that makes one of its parts."""
    seconds: float | None = None
    """Of the whole mesh."""


def plan_hash(job: JobFile) -> str:
    """Return the hash of what a job is to do, wherever it runs."""
    return stage_key(
        "parts", STAGE_VERSIONS, {**job.to_json(), "settings": key_values(job.settings)}
    )


def plan_parts(folder: Path, job: JobFile, tiles: Mapping[str, PlannedTiles]) -> PartsGraph:
    """Return the parts of a job, in an order in which they can be run one after another.

    ``folder``: the job folder; ``tiles``: by region, those that are known to be meshed in tiles.
    """
    parts = _begin(job)
    last = parts[-1].name
    if job.command == "bake":
        parts.append(Part("bake", "bake", (last,), ("baked/*",), 1.0 - BAKE_BEGINS))
    else:
        names = region_names(job.settings.regions, job.region_bodies)
        share = 1.0 / len(names)
        for name in names:
            parts += _of_region(name, last, share, tiles.get(name))
        textures = tuple(f"texture-{name}" for name in names)
        parts.append(
            Part("export", "export", textures, ("result/report.json",), STAGE_SHARES["export"])
        )
    return PartsGraph(code_version(), plan_hash(job), _relative(job.source, folder), tuple(parts))


def fixed_tiles(job: JobFile) -> dict[str, PlannedTiles]:
    """Return the regions whose number of tiles is a setting: known before anything is run."""
    names = region_names(job.settings.regions, job.region_bodies)
    known = {}
    for request, name in zip(job.settings.regions, names, strict=True):
        meshing = job.meshing_of(request)
        if meshing.method == "pam" and meshing.tiles not in ("auto", "off"):
            known[name] = PlannedTiles(int(meshing.tiles))
    return known


def plan_if_missing(folder: JobFolder) -> PartsGraph:
    """Return the parts of a job folder; plan them if that was never done, or for another job.

    Raises UsageError, ParseError: there is no job, or a file is damaged.
    """
    job = read_job(folder.job_path)
    if (folder.root / PARTS_NAME).exists():
        graph = read_parts(folder.root)
        if graph.plan == plan_hash(job):
            return graph
    graph = plan_parts(folder.root, job, fixed_tiles(job))
    write_parts(folder.root, graph)
    return graph


def _begin(job: JobFile) -> list[Part]:
    """Return the parts up to the training."""
    train, cameras = STAGE_SHARES["train"], STAGE_SHARES["cameras"]
    if job.command == "bake":  # both are finished
        cameras = train = BAKE_BEGINS / 2
    parts = [Part("cameras", "cameras", (), ("stages/cameras-*/scene.json",), cameras)]
    if job.settings.masks_are_made:
        made = train * MASKS_SHARE
        train -= made
        parts.append(Part("masks", "masks", ("cameras",), ("stages/masked-*/scene.json",), made))
    needs: tuple[str, ...] = (parts[-1].name,)
    blocks = job.settings.training.blocks
    if blocks > 1 and job.command != "bake":
        of = {kind: train * share for kind, share in _IN_BLOCKS.items()}
        stage = "stages/blocks-*"
        parts.append(Part("coarse", "coarse", needs, (f"{stage}/blocks.json",), of["coarse"]))
        trained = [
            Part(
                f"block-{number:04d}", "block", ("coarse",),
                (f"{stage}/block-{number:04d}/gaussians.npz",), of["block"] / blocks, block=number,
            )
            for number in range(blocks)
        ]  # fmt: skip
        parts += trained
        needs, train = tuple(part.name for part in trained), of["train"]
    return [*parts, Part("train", "train", needs, ("stages/train-*/gaussians.npz",), train)]


def _of_region(name: str, after: str, share: float, tiles: PlannedTiles | None) -> list[Part]:
    """Return the parts of a region. ``plan`` also makes the whole mesh if tiles are not needed."""
    whole = share * STAGE_SHARES["mesh"]
    stage = f"stages/mesh-{name}-*"
    mesh = (f"{stage}/mesh.npz",)

    def part(kind: str, needs: tuple[str, ...], outputs: tuple[str, ...], of: float) -> Part:
        return Part(f"{kind}-{name}", kind, needs, outputs, of, name)

    plan, joined = f"plan-{name}", f"mesh-{name}"
    if tiles is None:
        parts = [
            part("plan", (after,), mesh, 0.9 * whole),
            part("mesh", (plan,), mesh, 0.1 * whole),
        ]
    else:
        count = tiles.count

        def tile(kind: str, number: int, needs: tuple[str, ...]) -> Part:
            of = _TILED[kind]
            seconds = None if tiles.seconds is None else tiles.seconds * of / count
            return Part(
                f"{kind}-{name}-{number:04d}", kind, needs,
                (f"{stage}/tiles/{kind}-{number:04d}.npz",), whole * of / count, name, number,
                tiles.memory_bytes, seconds,
            )  # fmt: skip

        points = [tile(POINTS, number, (plan,)) for number in range(count)]
        gather = part(
            GATHER, tuple(p.name for p in points), (f"{stage}/tiles/points.npz",),
            whole * _TILED[GATHER],
        )  # fmt: skip
        faces = [tile(FACES, number, (gather.name,)) for number in range(count)]
        parts = [
            part("plan", (after,), (f"{stage}/tiles/tiles.json",), whole * _TILED["plan"]),
            *points,
            gather,
            *faces,
            part("mesh", tuple(p.name for p in faces), mesh, whole * _TILED["mesh"]),
        ]
    textured = (f"stages/texture-{name}-*/files/mesh.npz",)
    return [*parts, part("texture", (joined,), textured, share * STAGE_SHARES["texture"])]


def _relative(source: str, folder: Path) -> str:
    try:
        return Path(os.path.relpath(source, folder)).as_posix()
    except ValueError:  # another drive of Windows
        return ""
