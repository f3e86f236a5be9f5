# SPDX-License-Identifier: GPL-3.0-or-later
"""Studies of many runs over several sittings: cases, records of single runs, their page.

A record (``benchmarks/records/STUDY/*.json``) is committed: documents are written from records
alone, and a run that has one is not made again.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import logging
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from gaussian_wrapping_addon.core.errors import ParseError, UsageError, WorkerError
from gaussian_wrapping_addon.core.files import finite_json, read_json, write_json
from gaussian_wrapping_addon.core.machine import processor_name

from .provenance import DOCUMENTS, RECORDS, ROOT, Code, code_of_tree, versions
from .runs import BATCH, LAST_LINES, Photos, Settings, judged_by, with_set
from .runs import warm_up as run_warm_up
from .scenes.cache import ensure_scene
from .tables import MIDDLE, thin_recall

READINGS = ROOT / "benchmarks" / "readings"
PHOTOS = Photos(40, 640, 480)
"""Of every rendered scene of the studies."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A job through the command line, or another mesh of the training of one."""

    study: str
    """Folder of its record."""
    scene: str
    name: str
    """Cell of the ablation, preset, or mesher."""
    seed: int
    preset: str
    arguments: tuple[str, ...]
    """Of the command line, besides input, folder, preset, seed, region and threads."""
    base: str = ""
    """Identity of the case whose training is meshed again; empty: a job of its own."""
    photos: Photos = PHOTOS

    @property
    def identity(self) -> str:
        """Name of the record and of the folder of the run."""
        return f"{self.scene}-{self.name}-seed{self.seed}"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> Case:
        """Return what :meth:`to_json` wrote."""
        known = {**values, "arguments": tuple(values["arguments"])}
        return Case(**{**known, "photos": Photos(**values["photos"])})


def options(arguments: tuple[str, ...]) -> dict[str, str]:
    """Return the values of a command line by their options.

    Every option of the studies takes one value.
    """
    if len(arguments) % 2 or any(not word.startswith("--") for word in arguments[::2]):
        raise ValueError(f"{arguments} are not pairs of option and value")
    return dict(zip(arguments[::2], arguments[1::2], strict=True))


def named(cases: Sequence[Case], words: Sequence[str]) -> list[Case]:
    """Return the cases of the scenes, names and seeds (``seed1``) that are named.

    Words of one kind are alternatives; of a kind that none names, all count.

    Raises
    ------
    UsageError
        A word names nothing.
    """
    kinds = [
        {word: {c.identity for c in cases if of(c) == word} for word in map(of, cases)}
        for of in (lambda c: c.scene, lambda c: c.name, lambda c: f"seed{c.seed}")
    ]
    known = set().union(*kinds)
    if unknown := sorted(set(words) - known):
        raise UsageError(f"Nothing is called {', '.join(unknown)}.", f"Use {sorted(known)}.")
    kept = {c.identity for c in cases}
    for kind in kinds:
        if set(words) & set(kind):
            kept &= set().union(*(kind[word] for word in words if word in kind))
    return [c for c in cases if c.identity in kept]


VERSION = 1


@dataclasses.dataclass(frozen=True)
class Record:
    """One finished run."""

    case: Case
    code: Code
    machine: str
    versions: str
    threads: int
    date: str
    """Of the end of the run, ISO, UTC."""
    load_before: float | None
    wall_s: float
    """Of the whole command, on the clock: other programs may have run beside it."""
    processor_s: dict[str, float | None]
    """By stage, of all threads: as the job measures them, without starting Python; ``None`` where
    the system does not tell."""
    memory_gib: float | None
    mesh: dict[str, Any]
    """``vertices``, ``faces``, ``closed``, ``components``."""
    scores: dict[str, Any]
    """See :func:`kept_scores`."""
    mbr: dict[str, Any] | None = None
    """Mesh-based rendering: filled in afterwards from the kept mesh."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        values |= {"case": self.case.to_json(), "code": dataclasses.asdict(self.code)}
        return {"version": VERSION, **dict(finite_json(values))}

    @staticmethod
    def from_json(values: dict[str, Any]) -> Record:
        """Return what :meth:`to_json` wrote."""
        rest = {name: value for name, value in values.items() if name != "version"}
        rest |= {"case": Case.from_json(values["case"]), "code": Code(**values["code"])}
        return Record(**rest)

    def f1(self, index: int, protocol: str = "uniform") -> float:
        """Return F1 at a threshold."""
        return float(self.scores["surface"][protocol]["f1"][index])

    @property
    def spent_s(self) -> float:
        """Processor seconds of all its stages; NaN where one is not known."""
        return self.processor(*self.processor_s)

    def processor(self, *stages: str) -> float:
        """Return the processor seconds of some stages together; NaN where one is not known."""
        known = (self.processor_s.get(stage) for stage in stages)
        return math.fsum(math.nan if seconds is None else seconds for seconds in known)


def record_path(case: Case, root: Path = RECORDS) -> Path:
    """Return where the record of a case lies."""
    return root / case.study / f"{case.identity}.json"


def write_record(record: Record, root: Path = RECORDS) -> Path:
    """Write a record where its case belongs."""
    path = record_path(record.case, root)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, record.to_json())
    return path


def read_record(path: Path) -> Record:
    """Read a record.

    Raises
    ------
    ParseError
        It is of another version, or lacks a field.
    """
    values = read_json(path)
    known = isinstance(values, dict) and values.get("version") == VERSION
    try:
        if known:
            return Record.from_json(values)
    except (KeyError, TypeError) as error:
        raise ParseError(path, "record", str(error), "Make the run again with --again.") from error
    raise ParseError(path, "version", f"No record of version {VERSION}.", "Use --again.")


def read_records(cases: Iterable[Case], root: Path = RECORDS) -> dict[str, Record]:
    """Return the records that exist, by identity, in the order of the cases.

    Raises
    ------
    ParseError
        A record was made with other settings than its case has: it is of another plan.
    """
    found = {}
    for case in cases:
        path = record_path(case, root)
        if not path.is_file():
            continue
        record = read_record(path)
        if record.case != case:
            raise ParseError(
                path, "case", "The run was made with other settings than the plan has now.",
                "Delete the record, or make the run again with --again.",
            )  # fmt: skip
        found[case.identity] = record
    return found


def said_versions(records: Sequence[Record]) -> str:
    """Return one sentence: which code the runs are of, and whether versions are mixed."""
    names = list(dict.fromkeys(r.code.name for r in records))
    commits = {
        name: list(dict.fromkeys(r.code.commit for r in records if r.code.name == name))
        for name in names
    }
    if len(names) == 1:
        changed = ", with uncommitted changes" if records[0].code.changed else ""
        return f"All runs are of one version of the code (commit {commits[names[0]][0]}{changed})."
    counts = [
        f"{sum(r.code.name == name for r in records)} of {commits[name][0]}"
        + (" with uncommitted changes" if "changed" in name else "")
        for name in names
    ]
    differing = sorted(
        stage
        for stage in set().union(*(r.code.stages for r in records))
        if len({r.code.stages.get(stage) for r in records}) > 1
    )
    words = (
        f"between them the result of {', '.join(differing)} was changed on purpose"
        if differing
        else "that their stages have the same numbers does not say that their results are the same"
    )
    return (
        f"**Runs of {len(names)} versions of the code are mixed** ({', '.join(counts)}); {words}."
    )


def made_by(command: str, records: Sequence[Record], planned: Sequence[Case]) -> list[str]:
    """Return command, dates, machine, versions, code and completeness, as lines.

    Parameters
    ----------
    command : str
        What makes the missing runs and the document.
    records : sequence of Record
        At least one.
    planned : sequence of Case
        All of the plan: what has no record is counted as missing.
    """
    days = sorted({r.date[:10] for r in records})
    dates = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    machines = "; ".join(dict.fromkeys(f"{r.machine}, {_threads(r)}" for r in records))
    versions = "; ".join(dict.fromkeys(r.versions for r in records))
    used_s = math.fsum(r.spent_s for r in records)
    loads = [r.load_before for r in records if r.load_before is not None]
    load = f" Load average before a run: {min(loads):.1f} to {max(loads):.1f}." if loads else ""
    done = {r.case.identity for r in records}
    missing = [case for case in planned if case.identity not in done]
    left = (
        "All planned runs are there."
        if not missing
        else f"**{len(missing)} of {len(planned)} planned runs are not made yet.**"
    )
    return [
        f"`{command}`, runs of {dates}. {machines}; {versions}.",
        f"{len(records)} runs of {used_s / 3600:.1f} processor hours together. {left}",
        f"{said_versions(records)}{load}",
    ]


def photos_said(photos: Photos) -> str:
    """Return one sentence about the photos of rendered scenes."""
    return (
        f"Rendered scenes (`benchmarks/scenes`): {photos.count} photos of {photos.width} x "
        f"{photos.height} pixels, exact cameras, 8 test views apart."
    )


def reading(name: str) -> list[str]:
    """Return the hand-written part of a page, of that name in :data:`READINGS`."""
    return [(READINGS / f"{name}.md").read_text(encoding="utf-8").strip(), ""]


def commits(records: Iterable[Record]) -> list[str]:
    """Return the commits of records, for :func:`~.provenance.write_page`."""
    return [record.code.commit for record in records]


def _threads(record: Record) -> str:
    return f"{record.threads} thread{'' if record.threads == 1 else 's'} a run"


MBR_NOTE = (
    "MBR: PSNR of mesh-based rendering (docs/method.md, section 9.3), photos cut out along the "
    "true outline."
)


def f1_middle(record: Record) -> float:
    """F1 at 0.5 % of the diagonal, whole surface."""
    return record.f1(MIDDLE)


def f1_fine(record: Record) -> float:
    """F1 at 0.25 %."""
    return record.f1(0)


def f1_seen(record: Record) -> float:
    """F1 at 0.5 % of what cameras see of both surfaces."""
    return record.f1(MIDDLE, "scan")


def thin(record: Record) -> float | None:
    """Recall of thin parts at 0.5 %; ``None`` where there are practically none."""
    return thin_recall(record.scores["surface"]["uniform"])


def normal_error(record: Record) -> float:
    """One less the mean size of the cosine between normals of counterparts."""
    return 1.0 - float(record.scores["surface"]["uniform"]["normal_consistency"])


def view_psnr(record: Record) -> float | None:
    """PSNR of the Gaussians at the test views, whole photo, dB; ``None`` without Gaussians."""
    found = record.scores.get("gaussians")
    return None if found is None else float(found["psnr"])


def texture_psnr(record: Record) -> float | None:
    """PSNR of the textured mesh at the test views, where the true surface is seen, dB."""
    value = record.scores.get("texture", {}).get("psnr")
    return None if value is None else float(value)


def mbr_psnr(record: Record) -> float | None:
    """PSNR of mesh-based rendering, dB; ``None`` where it was not measured."""
    return None if record.mbr is None else float(record.mbr["psnr"])


def gaussians(record: Record) -> int | None:
    """Number of Gaussians."""
    found = record.scores.get("gaussians")
    return None if found is None else int(found["count"])


_logger = logging.getLogger("benchmarks")

STAGES = ("cameras", "train", "mesh", "texture")
REMADE_STAGES = STAGES[2:]
"""Of a further mesh of a training."""
KEPT_RUNS = ROOT / ".cache" / "studies"
"""Folders of runs, with Gaussians and meshes: not committed, and not needed for a document."""

_SURFACE = (
    "f1", "precision", "recall", "visible_recall", "thin_recall", "accuracy_median",
    "chamfer_mean", "normal_consistency", "truth_count", "visible_count", "thin_count",
)  # fmt: skip
"""What a record keeps of the scores of a surface."""
_STAGES = ("gaussians", "depth", "depths", "vacancy")
"""What it keeps of what lies before the mesh, where that was judged."""
DIGITS = 6


def rendered_scene(case: Case) -> Path:
    """Return the folder of a case's scene of :mod:`benchmarks.scenes`; render it where missing."""
    photos = case.photos
    return ensure_scene(case.scene, photos=photos.count, width=photos.width, height=photos.height)


SceneFinder = Callable[[Case], Path]
"""Returns the folder of a case's scene."""


class Maker(Protocol):
    """Makes one run and writes its record."""

    def __call__(self, case: Case, *, threads: int, kept: Path = KEPT_RUNS) -> Record: ...


def carry_out(
    cases: Sequence[Case],
    *,
    threads: int,
    again: bool = False,
    runs: int = 0,
    maker: Maker | None = None,
    kept: Path = KEPT_RUNS,
    find_scene: SceneFinder = rendered_scene,
) -> int:
    """Make the runs that have no record yet, in their order; return how many failed.

    It may be ended at any time: the run that it was at is made again the next time.

    Parameters
    ----------
    again : bool
        Make runs that have a record, too.
    runs : int
        Make no more runs than this; 0: there is no limit.
    maker : callable, optional
        Makes one run and writes its record; :func:`make` by default.
    kept : Path
        Folder of the runs themselves.
    find_scene : callable
        Where kernels are compiled on, before the first run.
    """
    failed = made = 0
    for number, case in enumerate(cases):
        if not again and record_path(case).is_file():
            continue
        if runs and made == runs:
            break
        made += 1
        warm_up(find_scene, case, threads, kept)
        try:
            record = (maker or make)(case, threads=threads, kept=kept)
        except WorkerError as error:
            failed += 1
            _logger.error("%s failed: %s", case.identity, error)
            continue
        _logger.info(
            "%d/%d %s: %.0f processor s, F1 %s", number + 1, len(cases), case.identity,
            record.spent_s,
            " ".join(f"{value:.3f}" for value in record.scores["surface"]["uniform"]["f1"]),
        )  # fmt: skip
    return failed


def warm_up(find_scene: SceneFinder, case: Case, threads: int, kept: Path) -> None:
    """Compile all kernels in a job of a minute, once for each version of the code."""
    stamp = kept / f"warm-{code_of_tree().name.replace(', ', '-')}"
    if stamp.is_file():
        return
    everything = ("--multi-view", "on", "--wrapping", "on", "--harmonics", "on", "--exposure", "on")
    run_warm_up(find_scene(case), Settings(kept, threads, False), everything)
    stamp.touch()


def make(
    case: Case,
    *,
    threads: int,
    kept: Path = KEPT_RUNS,
    find_scene: SceneFinder = rendered_scene,
) -> Record:
    """Make a run, judge it, and write its record.

    Raises
    ------
    WorkerError
        With the last lines of the job's output.
    """
    scene = find_scene(case)
    folder = run_folder(case, kept)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    job = folder / "out"
    if case.base:
        base = run_folder(case, kept).with_name(case.base) / "out"
        if not base.is_dir():
            raise WorkerError(f"{case.base} is not kept on this machine, so nothing to mesh.")
        # A copy: the mesh of the base stays as its record says.
        shutil.copytree(base, job)
        words = ["mesh", "--out", str(job)]
    else:
        words = [
            "wrap", str(scene), "--out", str(job), "--preset", case.preset,
            "--seed", str(case.seed),
        ]  # fmt: skip
    words += ["--region", str(scene / "region.json"), *with_set(case.arguments)]
    words += ["--export", "ply", "--no-blend", "--threads", str(threads)]
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    code = code_of_tree()
    wall_s = _child([sys.executable, str(BATCH), *words], f"See {job}.")
    scores_file = folder / "scores.json"
    _judge(scene, job, folder, scores_file, threads)
    report = read_json(job / "result" / "report.json")
    region = _region_name(job)
    peaks = report["peak_memory_bytes"]
    # The report of a further mesh repeats what its training took.
    own = REMADE_STAGES if case.base else STAGES
    stages = {name: _processor_s(report, name) for name in own}
    statistics = report["regions"][region]["statistics"]
    record = Record(
        case=case,
        code=code,
        machine=processor_name(),
        versions=versions(),
        threads=threads,
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
        load_before=load,
        wall_s=round(wall_s, 1),
        processor_s=stages,
        memory_gib=round(max(peaks.values()) / 2**30, 2) if peaks else None,
        mesh={
            "vertices": statistics["vertices"],
            "faces": statistics["faces"],
            "closed": statistics["closed"],
            "components": statistics["components"],
        },
        scores=kept_scores(read_json(scores_file)),
    )
    write_record(record)
    write_json(folder / "record.json", record.to_json())
    return record


def run_folder(case: Case, kept: Path = KEPT_RUNS) -> Path:
    """Return where a run is kept: ``out/`` is the job, ``mesh/`` its textured mesh."""
    return kept / case.study / case.identity


def kept_scores(scores: dict[str, Any]) -> dict[str, Any]:
    """Return what a record keeps of the scores, lengths as shares of the diagonal."""
    texture = {name: scores["texture"].get(name) for name in ("psnr", "ssim", "coverage")}
    kept = {"surface": kept_surface(scores["surface"], scores["diagonal"]), "texture": texture}
    kept |= {name: scores[name] for name in _STAGES if name in scores}
    return dict(rounded(kept))


def kept_surface(surface: dict[str, Any], diagonal: float) -> dict[str, Any]:
    """Return what a record keeps of the scores of a surface, by protocol."""
    found: dict[str, Any] = {}
    for protocol in ("uniform", "scan"):
        found[protocol] = {name: surface[protocol][name] for name in _SURFACE}
        for name in ("accuracy_median", "chamfer_mean"):
            length = found[protocol][name]
            found[protocol][name] = None if length is None else length / diagonal
    return dict(rounded(found))


def rounded(values: Any) -> Any:
    """Return values with :data:`DIGITS` significant digits: no figure is known better."""
    if isinstance(values, dict):
        return {name: rounded(value) for name, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [rounded(value) for value in values]
    if isinstance(values, float) and math.isfinite(values):
        return float(f"{values:.{DIGITS}g}")
    return values


def _judge(scene: Path, job: Path, folder: Path, path: Path, threads: int) -> None:
    mesh = folder / "mesh"
    shutil.copytree(job / "result" / _region_name(job), mesh)
    _child(
        [
            sys.executable, "-m", "benchmarks.score", str(scene), str(path),
            "--mesh", str(mesh), "--job", str(job), "--stages", "--threads", str(threads),
        ],
        f"See {folder}.",
    )  # fmt: skip


def _child(command: list[str], hint: str) -> float:
    """Run a command; return its seconds on the clock."""
    begun_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode != 0:
        words = "\n".join((done.stdout + done.stderr).splitlines()[-LAST_LINES:])
        raise WorkerError(f"A run failed with exit code {done.returncode}: {words}", hint)
    return time.monotonic() - begun_s


def _processor_s(report: dict[str, Any], stage: str) -> float | None:
    found = [
        entry.get("processor_seconds")
        for entry in report["stages"]
        if entry["name"].startswith(stage)
    ]
    return round(math.fsum(found), 1) if found and None not in found else None


def _region_name(job: Path) -> str:
    (name,) = sorted(path.parent.name for path in (job / "result").glob("*/mesh.npz"))
    return name


KEPT = ("psnr", "ssim", "covered_psnr", "inside_psnr", "uncovered", "beyond")
"""Means over the test views that a record keeps."""


def fill_in(
    cases: Sequence[Case],
    *,
    threads: int,
    runs: int = 0,
    again: bool = False,
    kept: Path = KEPT_RUNS,
    root: Path = RECORDS,
) -> int:
    """Judge meshes whose record lacks mesh-based rendering; return how many failed.

    A mesh that this machine has not kept is left as it is.

    Parameters
    ----------
    runs : int
        Judge no more meshes than this; 0: there is no limit.
    again : bool
        Judge meshes again that were judged before.
    """
    failed = judged = 0
    for record in read_records(cases, root).values():
        folder = run_folder(record.case, kept)
        if (record.mbr is not None and not again) or not (folder / "mesh").is_dir():
            continue
        if runs and judged == runs:
            break
        judged += 1
        try:
            found = _judged(record, folder, threads)
        except WorkerError as error:
            failed += 1
            _logger.error("%s: %s", record.case.identity, error)
            continue
        write_record(dataclasses.replace(record, mbr=kept_figures(found)), root)
        _logger.info("%s: mesh-based rendering %.2f dB", record.case.identity, found["psnr"])
    return failed


def kept_figures(found: dict[str, Any]) -> dict[str, Any]:
    """Return what a record keeps, with the code that measured it."""
    figures = {name: found.get(name) for name in KEPT}
    return {**dict(rounded(figures)), "code": code_of_tree().name}


def _judged(record: Record, folder: Path, threads: int) -> dict[str, Any]:
    photos = record.case.photos
    scene = ensure_scene(
        record.case.scene, photos=photos.count, width=photos.width, height=photos.height
    )
    path = folder / "mesh-based.json"
    arguments = [str(scene), str(path), "--mesh", str(folder / "mesh")]
    arguments += ["--job", str(folder / "out")]
    return judged_by("benchmarks.mesh_based", arguments, path, Settings(folder, threads, False))


Writer = Callable[[Path, Mapping[str, Record], Sequence[Case]], Path]
"""Writes the document of the records into a folder and returns its page."""


def run_study(
    arguments: Sequence[str] | None,
    description: str | None,
    cases: Sequence[Case],
    write_document: Writer,
    maker: Maker = make,
    draw: Callable[[Path], None] | None = None,
    find_scene: SceneFinder = rendered_scene,
) -> int:
    """Do what the command line asks for; return 1 where a run failed or nothing is there, else 0.

    Parameters
    ----------
    cases : sequence of Case
        The whole plan, in the order in which it is made.
    maker : callable
        Makes one case and writes its record.
    draw : callable, optional
        Draws pictures of kept runs into the document's folder.
    find_scene : callable
        Where kernels are compiled on, before the first run.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--runs", type=int, default=0, help="make at most so many; 0: no limit")
    parser.add_argument("--again", action="store_true", help="make runs that have a record, too")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="make runs of these scenes, names and seeds (seed0) only",
    )  # fmt: skip
    parser.add_argument(
        "--mbr", action="store_true",
        help="make no run: mesh-based rendering of the kept meshes whose record lacks it",
    )  # fmt: skip
    parser.add_argument("--document", action="store_true", help="make no run, write the document")
    if draw is not None:
        parser.add_argument(
            "--pictures", action="store_true", help="draw kept runs beside the document"
        )
    parser.add_argument("--out", type=Path, default=DOCUMENTS, help="folder of the document")
    options = parser.parse_args(arguments)
    try:
        chosen = named(cases, options.only)
    except UsageError as error:
        parser.error(str(error))
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("PIL").setLevel(logging.WARNING)
    failed = 0
    if options.mbr:
        failed = fill_in(chosen, threads=options.threads, runs=options.runs, again=options.again)
    elif not options.document:
        failed = carry_out(
            chosen, threads=options.threads, again=options.again, runs=options.runs, maker=maker,
            find_scene=find_scene,
        )  # fmt: skip
    records = read_records(cases)
    if not records:
        _logger.error("there is no record yet, so no document")
        return 1
    if draw is not None and options.pictures:
        draw(options.out)
    _logger.info("%s", write_document(options.out, records, cases))
    return int(failed > 0)
