# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: ``blender --background -P batch.py -- wrap INPUT --out DIR``, or plain Python.

It starts the same worker as the buttons do, shows its progress, and writes ``scene.blend``.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import math
import sys
import time
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from .core.jobs.client import JobClient
    from .core.jobs.job_file import JobFile
    from .core.settings import JobSettings

_logger = logging.getLogger("gaussian_wrapping")

POLL_S = 0.2
LINE_EVERY_S = 5.0
CANCEL_WAIT_S = 12.0
MAX_WAIT_S = 7 * 86400.0


def main(arguments: list[str]) -> int:
    """Run one command and return the exit code (0, 1, 2, 3, 4, 5: see the README)."""
    from .batch_options import in_words_of_options
    from .core.errors import EXIT_OTHER, SettingError, WrapError

    _log_to_terminal()
    try:
        options = _parser().parse_args(arguments)
        return int(options.run(options))
    except SettingError as error:
        _logger.error("error: %s", in_words_of_options(error))
        return error.exit_code
    except WrapError as error:
        _logger.error("error: %s", error)
        return error.exit_code
    except OSError as error:
        _logger.error("error: %s", error)
        return EXIT_OTHER


class _Parser(ArgumentParser):
    """Raises our usage error instead of leaving the process, so that Blender ends in order."""

    def error(self, message: str) -> NoReturn:
        from .core.errors import UsageError

        raise UsageError(
            f"{message}.", f"Usage: {self.format_usage().split('usage: ')[-1].strip()}"
        )


def _parser() -> ArgumentParser:
    from .batch_options import (
        add_boundary_options,
        add_clean_up_options,
        add_method_options,
        add_training_options,
    )
    from .core.settings import EXPORT_FORMATS

    parser = _Parser(prog="batch.py", description="Photos in, a textured mesh out.")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=_Parser)

    wrap = commands.add_parser("wrap", help="photos, a COLMAP project or a transforms.json -> mesh")
    wrap.add_argument("input", type=Path)
    add_training_options(wrap)
    wrap.set_defaults(run=_wrap)

    mesh = commands.add_parser(
        "mesh", help="another region or resolution, from a finished training"
    )
    mesh.set_defaults(run=_mesh)

    more = commands.add_parser("more", help="train a finished job further, and mesh it again")
    more.add_argument("--out", type=Path, required=True, metavar="DIR")
    more.add_argument("--iterations", type=int, required=True, metavar="N", help="to be added")
    more.set_defaults(run=_more)

    resume = commands.add_parser("resume", help="continue a job that was stopped")
    resume.add_argument("out", type=Path, metavar="DIR")
    resume.add_argument(
        "--max-gaussians", type=int, metavar="N", help="train anew with another cap"
    )
    resume.set_defaults(run=_resume)

    mesh_estimate = commands.add_parser(
        "estimate-mesh", help="triangles, time and memory of a region's mesh, before it is made"
    )
    mesh_estimate.add_argument("--region", default="auto", metavar="auto|all|REGION.json")
    mesh_estimate.set_defaults(run=_estimate_mesh)

    for command in (wrap, mesh):
        command.add_argument("--region", nargs="+", action="extend", metavar="auto|all|REGION.json")
    for command in (wrap, mesh, mesh_estimate):
        command.add_argument("--out", type=Path, required=True, metavar="DIR")
        add_method_options(command)
    for command in (wrap, mesh):
        add_boundary_options(command)
        add_clean_up_options(command)
        command.add_argument("--texture-size", default="auto", metavar="auto|N")
        command.add_argument(
            "--export", default="glb", help=f"comma separated, of {','.join(EXPORT_FORMATS)}"
        )
    for command in (mesh, mesh_estimate):
        command.add_argument("--threads", type=int, default=0, help="0 uses every core")
    for command in (wrap, mesh, more, resume):
        command.add_argument("--no-blend", action="store_true", help="needs no bpy")

    tiles = commands.add_parser(
        "work-tiles", help="help a job that meshes in tiles, from another process or machine"
    )
    tiles.add_argument("out", type=Path, metavar="DIR", help="job folder of that job")
    tiles.add_argument("--threads", type=int, default=0, help="0 uses every core")
    tiles.add_argument(
        "--wait", type=float, default=0.0, metavar="S", help="seconds to wait for tiles, at most"
    )
    tiles.set_defaults(run=_work_tiles)

    _add_evaluate(commands.add_parser("evaluate", help="a mesh or a job against a ground truth"))

    estimate = commands.add_parser("estimate", help="time, memory and disk of a training, before")
    estimate.add_argument("input", type=Path)
    add_training_options(estimate)
    estimate.set_defaults(run=_estimate)

    check = commands.add_parser("check", help="findings about an input, without starting anything")
    check.add_argument("input", type=Path)
    check.set_defaults(run=_check)
    doctor = commands.add_parser("doctor", help="findings about the worker's Python")
    doctor.set_defaults(run=_doctor)
    return parser


def _add_evaluate(parser: ArgumentParser) -> None:
    parser.add_argument(
        "mesh", type=Path, metavar="MESH_OR_JOB", help="PLY, OBJ, GLB, STL or OFF; or a job folder"
    )
    parser.add_argument(
        "--truth", type=Path, required=True, metavar="PATH", help="mesh, cloud, scene or data set"
    )
    parser.add_argument(
        "--layout",
        choices=("auto", "scene", "mesh", "tanks", "dtu"),
        default="auto",
        help="of the truth; auto tells it by the files there",
    )
    parser.add_argument("--scan", type=int, help="number of the DTU scan")
    parser.add_argument("--region", help="of the job, where it has several")
    parser.add_argument("--cameras", type=Path, help="cameras of a mesh file: COLMAP, transforms")
    parser.add_argument(
        "--thresholds", type=_floats, help="shares of the truth's diagonal, comma separated"
    )
    parser.add_argument("--distances", type=_floats, help="lengths instead, comma separated")
    parser.add_argument(
        "--align",
        choices=("none", "cameras", "icp"),
        help="how the mesh is placed on the truth first: as it is, by cameras of equal names, by "
        "nearest points (default: none; tanks icp, dtu cameras)",
    )
    parser.add_argument("--protocols", help="comma separated, of uniform,scan,legacy")
    parser.add_argument("--samples", type=int, help="points drawn on the mesh (uniform protocol)")
    parser.add_argument("--seed", type=int, default=0, help="of these points")
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="all figures, for programs")
    parser.set_defaults(run=_evaluate)


def _floats(text: str) -> list[float]:
    try:
        values = [float(word) for word in text.split(",") if word]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise ArgumentTypeError(f"{text!r}: give numbers separated by commas")
    return values


def _wrap(options: Namespace) -> int:
    from .batch_options import training_settings
    from .core.dataset.check import check_input
    from .core.errors import DatasetError
    from .core.jobs.client import JobClient, worker_python
    from .core.jobs.job_file import make_job

    settings = training_settings(options)
    job = make_job("wrap", options.input, _region_settings(settings, options))
    _require_bpy(job, options)
    for finding in check_input(options.input):
        if finding.severity == "error":
            raise DatasetError(finding.message, finding.hint)
        if finding.severity == "warning":
            _logger.warning("warning: %s %s", finding.message, finding.hint)
    return _follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def _more(options: Namespace) -> int:
    from .core.jobs.client import JobClient, worker_python
    from .core.jobs.earlier_job import finished_job
    from .core.jobs.job_folder import JobFolder
    from .core.jobs.more import job_with_more

    folder = JobFolder(options.out.resolve())
    job = job_with_more(folder, finished_job(folder), options.iterations)
    _require_bpy(job, options)
    return _follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def _estimate(options: Namespace) -> int:
    from .batch_options import training_settings
    from .core.jobs.client import worker_python
    from .core.jobs.evaluate import run_in_worker
    from .core.jobs.job_file import make_job

    job = make_job("wrap", options.input, training_settings(options))
    return run_in_worker(
        job.to_json(), python=worker_python(), module="jobs.estimate", what="estimate"
    )


def _mesh(options: Namespace) -> int:
    from .core.errors import UsageError
    from .core.jobs.client import JobClient, worker_python
    from .core.jobs.earlier_job import finished_job
    from .core.jobs.job_file import make_job
    from .core.jobs.job_folder import JobFolder
    from .core.jobs.stages import read_done

    folder = JobFolder(options.out.resolve())
    earlier = finished_job(folder)
    if not any(read_done(path) for path in folder.stages.glob("train-*")):
        raise UsageError(
            f"{options.out} holds no finished training.", "Run wrap, or resume it, first."
        )
    job = make_job("mesh", Path(earlier.source), _region_settings(earlier.settings, options))
    _require_bpy(job, options)
    return _follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def _estimate_mesh(options: Namespace) -> int:
    from .batch_options import method_settings
    from .core.jobs.client import worker_python
    from .core.jobs.evaluate import run_in_worker
    from .core.settings import JobSettings, MeshingSettings, to_json

    meshing = MeshingSettings(**method_settings(options))
    JobSettings(meshing=meshing, threads=options.threads).validated()
    region = options.region
    request = {
        "out": str(options.out.resolve()),
        "region": region if region in ("auto", "all") else str(Path(region).resolve()),
        "meshing": to_json(meshing),
        "threads": options.threads,
    }
    return run_in_worker(
        request, python=worker_python(), module="jobs.mesh_estimate", what="estimate"
    )


def _work_tiles(options: Namespace) -> int:
    from .core.errors import UsageError
    from .core.jobs.client import worker_python
    from .core.jobs.evaluate import run_in_worker
    from .core.settings import JobSettings

    JobSettings(threads=options.threads).validated()
    if not 0 <= options.wait <= MAX_WAIT_S:
        raise UsageError("--wait is out of range.", f"Give from 0 to {MAX_WAIT_S:.0f} seconds.")
    request = {
        "out": str(options.out.resolve()), "threads": options.threads, "wait_s": options.wait,
    }  # fmt: skip
    return run_in_worker(
        request, python=worker_python(), module="jobs.tile_worker", what="work on tiles"
    )


def _resume(options: Namespace) -> int:
    from .core.jobs.client import JobClient, worker_python
    from .core.jobs.job_file import read_job
    from .core.jobs.job_folder import JobFolder

    job = read_job(JobFolder(options.out.resolve()).job_path)
    _require_bpy(job, options)
    if options.max_gaussians is None:
        return _follow(JobClient.resume(options.out, python=worker_python()), job, options)
    # A training with another cap starts anew: there is nothing that it could add to.
    training = replace(
        job.settings.training, max_gaussians=options.max_gaussians, extra_iterations=0
    )
    settings = replace(job.settings, training=training).validated()
    job = replace(job, command="wrap", settings=settings)
    return _follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def _region_settings(settings: JobSettings, options: Namespace) -> JobSettings:
    """Put the options that ``wrap`` and ``mesh`` share into the settings."""
    from .batch_options import boundary_settings, clean_up_settings, method_settings
    from .core.errors import UsageError

    size = options.texture_size
    if size != "auto" and not size.isdecimal():
        raise UsageError(
            f"--texture-size {size} is not a number.", "Give auto or a size in pixels."
        )
    return replace(
        settings,
        threads=options.threads,
        regions=tuple(dict.fromkeys(options.region or ["auto"])),
        export=tuple(dict.fromkeys(f for f in options.export.split(",") if f)),
        meshing=replace(
            settings.meshing,
            **method_settings(options),
            **boundary_settings(options),
            **clean_up_settings(options),
        ),
        texture=replace(settings.texture, size_px=0 if size == "auto" else int(size)),
    )


def _evaluate(options: Namespace) -> int:
    from .core.jobs.client import worker_python
    from .core.jobs.evaluate import run_in_worker
    from .core.settings import JobSettings

    JobSettings(seed=options.seed, threads=options.threads).validated()
    protocols = options.protocols
    request = {
        "mesh": str(options.mesh),
        "truth": str(options.truth),
        "layout": options.layout,
        "scan": options.scan,
        "region": options.region,
        "cameras": None if options.cameras is None else str(options.cameras),
        "shares": options.thresholds,
        "distances": options.distances,
        "align": options.align,
        "protocols": None if protocols is None else [p for p in protocols.split(",") if p],
        "samples": options.samples,
        "seed": options.seed,
        "threads": options.threads,
        "out": None if options.out is None else str(options.out),
    }
    return run_in_worker(request, python=worker_python())


def _check(options: Namespace) -> int:
    from .core.dataset.check import check_input
    from .core.errors import EXIT_BAD_DATA, EXIT_DONE

    findings = check_input(options.input)
    for finding in findings:
        _logger.info("%s: %s %s", finding.severity, finding.message, finding.hint)
    bad = any(finding.severity == "error" for finding in findings)
    return EXIT_BAD_DATA if bad else EXIT_DONE


def _doctor(_options: Namespace) -> int:
    from .core.errors import EXIT_BAD_DATA, EXIT_DONE
    from .core.jobs.client import worker_python
    from .core.jobs.doctor import diagnose_worker

    findings = diagnose_worker(worker_python())
    for finding in findings:
        mark = "good" if finding.good else "BAD "
        _logger.info("%s  %-9s %s", mark, finding.subject, finding.finding)
        if not finding.good:
            _logger.info("               %s", finding.hint)
    _logger.info("bpy       %s", "present" if _has_bpy() else "absent: use --no-blend")
    return EXIT_DONE if all(f.good for f in findings) else EXIT_BAD_DATA


def _has_bpy() -> bool:
    return importlib.util.find_spec("bpy") is not None


def _require_bpy(job: JobFile, options: Namespace) -> None:
    """Refuse before the start what could not be finished without bpy."""
    from .core.errors import UsageError

    wants = "usd" in job.settings.export or not options.no_blend
    if wants and not _has_bpy():
        raise UsageError(
            "Writing scene.blend or USD needs bpy, which this Python does not have.",
            "Add --no-blend (and leave usd out), run it in Blender, or pip install bpy.",
        )


def _follow(client: JobClient, job: JobFile, options: Namespace) -> int:
    """Show progress until the worker ends; then write the Blender files."""
    from .core.errors import EXIT_CANCELLED, EXIT_DONE, EXIT_OTHER
    from .core.jobs.blend_file import shown_result

    before = shown_result(client.folder.result)  # the worker writes it last
    shown_s, shown, interrupted_s = 0.0, ("", ""), 0.0
    while True:
        try:
            status = client.poll()
            now_s = time.monotonic()
            news = (status.stage, status.message)
            due = status.stage != shown[0] or now_s - shown_s > LINE_EVERY_S
            if status.stage and due and news != shown:
                shown_s, shown = now_s, news
                left = (
                    "" if status.seconds_left is None else f" · {_span(status.seconds_left)} left"
                )
                _logger.info(
                    "[%5.1f %%] %-7s %s%s",
                    100 * status.fraction,
                    status.stage,
                    status.message,
                    left,
                )
            if not status.active:
                break
            if interrupted_s and now_s - interrupted_s > CANCEL_WAIT_S:
                client.kill()
                return EXIT_CANCELLED
            time.sleep(POLL_S)
        except KeyboardInterrupt:
            _logger.info("cancelling; the job can be resumed")
            client.cancel()
            interrupted_s = time.monotonic()
    if status.state == "CANCELLED":
        _logger.info("cancelled; continue with: resume %s", client.folder.root)
        return EXIT_CANCELLED
    if status.state != "DONE":
        _logger.error("error: %s %s", status.error, status.hint)
        if client.folder.read_status().state == "DONE":
            _logger.info("the job and its result are as they were before: %s", client.folder.root)
        return status.exit_code or EXIT_OTHER
    return _finish(client.folder.result, before, job, options) or EXIT_DONE


def _finish(result: Path, before: dict[str, bytes], job: JobFile, options: Namespace) -> int:
    """Write the Blender files; one that shows the result ``before`` does not stay."""
    from .core.jobs.blend_file import NAME, set_aside_stale

    if options.no_blend:
        set_aside_stale(result, before)
    else:
        from .ops.scene_objects import write_blend

        try:
            write_blend(result, result / NAME)
        except BaseException:
            set_aside_stale(result, before)
            raise
    if "usd" in job.settings.export:
        from .ops.scene_objects import export_usd

        export_usd(result)
    from .core.evaluation.report.report import headline
    from .core.files import read_json

    _logger.info("results: %s", result)
    for line in headline(read_json(result / "report.json")):
        _logger.info("  %s", line)
    return 0


def _span(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _log_to_terminal() -> None:
    if _logger.handlers:
        return
    handler = logging.StreamHandler(sys.stdout)
    handler.setFormatter(logging.Formatter("%(message)s"))
    _logger.addHandler(handler)
    _logger.setLevel(logging.INFO)
    _logger.propagate = False


def _arguments(argv: list[str]) -> list[str]:
    """Return what follows ``--`` (inside Blender), or everything (plain Python)."""
    if "--" in argv:
        return argv[argv.index("--") + 1 :]
    bpy = sys.modules.get("bpy")
    if bpy is not None and not getattr(bpy.app, "module", False):
        return []
    return argv[1:]


def _main_as_script() -> int:
    """Load the package from where this file lies, then run its ``batch`` module."""
    name = "gaussian_wrapping_addon"
    root = Path(__file__).resolve().parent
    spec = importlib.util.spec_from_file_location(
        name, root / "__init__.py", submodule_search_locations=[str(root)]
    )
    if spec is None or spec.loader is None:
        raise ImportError(f"{root} holds no package")
    package = importlib.util.module_from_spec(spec)
    sys.modules[name] = package
    spec.loader.exec_module(package)
    # The folder of this file would put ``core``, ``ops`` and ``ui`` on the path as top-level names.
    sys.path[:] = [p for p in sys.path if not p or Path(p).resolve() != root]
    return int(importlib.import_module(f"{name}.batch").main(_arguments(sys.argv)))


if __name__ == "__main__":
    sys.exit(_main_as_script())
