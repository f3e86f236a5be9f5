# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``evaluate`` command: score a mesh or a job in the worker's Python.

:func:`~.run_in_worker.run_in_worker` starts it: the parent process needs neither scipy nor libigl.
"""

from __future__ import annotations

import errno
import json
import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import DatasetError, ParseError, UsageError, unwritable_error
from ...files import read_json, write_json
from ...names import JOB_MARKER
from ...worker.helper_process import emit_progress
from ..store.job_folder import JobFolder
from .run_in_worker import run_command

if TYPE_CHECKING:
    from collections.abc import Callable

    from ...progress import Progress
    from ...scene.camera import Camera


def main(arguments: list[str]) -> int:
    """Evaluate ``arguments = [request as JSON]`` in this process; return the exit code."""

    from ...texture.file_checks import write_errors

    def work() -> list[str]:
        request = json.loads(arguments[0])
        out = Path(request["out"]) if request["out"] else None
        if out is not None:
            _check_output(out)
        report, lines = _evaluate(request)
        if out is not None:
            with write_errors(out):
                write_json(out, report)
            lines.append(f"written to {out}")
        return lines

    return run_command(work, "Use fewer --samples or close other programs.")


def _check_output(out: Path) -> None:
    """Raise before the work starts if the output file cannot be written."""
    if out.is_dir():
        raise UsageError(f"{out} is a folder.", "Give a file for the figures.")
    if not (out.parent.is_dir() and os.access(out.parent, os.W_OK)):
        reason = errno.EACCES if out.parent.is_dir() else errno.ENOENT
        raise unwritable_error(out, OSError(reason, os.strerror(reason)))


def _evaluate(given: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the report and its table."""
    from ...evaluation.layouts import read_mesh
    from ...machine import describe_machine
    from ...parallel import default_threads
    from ...progress import Progress
    from ...worker.helper_process import peak_memory_bytes

    begun_s, begun_unix_s = time.monotonic(), time.time()
    threads = given["threads"] or default_threads()
    _check_metric(given)
    source = Path(given["mesh"])
    if source.is_dir():
        path = job_mesh(source, given["region"])
    else:
        if given["region"]:
            raise UsageError(
                f"{source.name} is a mesh file and has no regions.",
                "Omit --region, or give a job folder.",
            )
        path = source

    progress = Progress("evaluate", emit_progress)
    measure = _against_photos if given["metric"] == "mbr" else _against_truth
    mesh, result, lines = measure(given, source, lambda: read_mesh(path), threads, progress)
    report = {
        "version": 1, "started_unix_s": begun_unix_s, "seconds": time.monotonic() - begun_s,
        "mesh": {"path": str(path.resolve()), "vertices": len(mesh[0]), "faces": len(mesh[1])},
        **result, "machine": describe_machine(threads), "peak_memory_bytes": peak_memory_bytes(),
    }  # fmt: skip
    return report, [f"{path.name}: {len(mesh[0])} vertices, {len(mesh[1])} faces", *lines]


def _check_metric(given: dict[str, Any]) -> None:
    """Raise if options of one metric are given for the other."""
    if given["metric"] == "mbr":
        needless = [
            f"--{name}"
            for name in ("truth", "scan", "distances", "align", "protocols", "samples")
            if given[name] is not None
        ]
        needless += ["--thresholds"] * (given["shares"] is not None)
        if needless:
            raise UsageError(
                f"{', '.join(needless)}: --metric mbr compares with photos, not with a true "
                "surface.",
                "Omit it, or use --metric surface.",
            )
        if not Path(given["mesh"]).exists():
            raise UsageError(
                f"{given['mesh']} does not exist.", "Give the folder of --out, or a mesh file."
            )
        if not Path(given["mesh"]).is_dir() and given["cameras"] is None:
            raise UsageError(
                "--metric mbr needs the photos of the mesh.",
                "Give them with --cameras: a COLMAP project, a transforms.json or a job.",
            )
        return
    if given["truth"] is None:
        raise UsageError(
            "--metric surface needs a ground truth.",
            "Give it with --truth, or compare with photos: --metric mbr.",
        )
    for name in ("test", "max_image_px"):
        if given[name] is not None:
            raise UsageError(
                f"--{name.replace('_', '-')} is for --metric mbr.", "Omit it, or add --metric mbr."
            )


_Mesh = tuple[Any, Any]
"""Vertices (v, 3) and faces (f, 3), world frame."""


def _against_truth(
    given: dict[str, Any], source: Path, read: Callable[[], _Mesh], threads: int, progress: Progress
) -> tuple[_Mesh, dict[str, Any], list[str]]:
    """Return the mesh, its figures against the ground truth, and their table."""
    from ...evaluation.command import EvaluationRequest, evaluate_mesh, read_cameras, table

    def shares(name: str) -> tuple[Any, ...] | None:
        return None if given[name] is None else tuple(given[name])

    request = EvaluationRequest(
        Path(given["truth"]), given["layout"], given["scan"], shares("shares"),
        shares("distances"), given["align"], shares("protocols"), given["samples"], given["seed"],
        threads,
    ).checked()  # fmt: skip
    cameras: list[Camera] = job_cameras(source) if source.is_dir() else []
    if given["cameras"]:
        cameras_path = Path(given["cameras"])
        cameras = (
            job_cameras(cameras_path)
            if (cameras_path / JOB_MARKER).exists()
            else read_cameras(cameras_path)
        )
    mesh = read()
    result = evaluate_mesh(*mesh, cameras, request, progress)
    asked = {
        "truth": str(request.truth.resolve()),
        "cameras": len(cameras),
        "asked": {**asdict(request), "truth": str(request.truth)},
    }
    return mesh, {**asked, **result}, table(result)


def _against_photos(
    given: dict[str, Any], source: Path, read: Callable[[], _Mesh], threads: int, progress: Progress
) -> tuple[_Mesh, dict[str, Any], list[str]]:
    """Return the mesh, its mesh-based rendering, and the figures as lines."""
    from .mesh_based_command import MeshBasedRequest, evaluate_mesh_based, table

    request = MeshBasedRequest(
        Path(given["cameras"]) if given["cameras"] else source,
        None if given["test"] is None else Path(given["test"]),
        given["max_image_px"], given["seed"], threads,
    )  # fmt: skip
    mesh = read()
    result = evaluate_mesh_based(*mesh, request, progress)
    return mesh, result, table(result)


def job_mesh(folder: Path, region: str | None) -> Path:
    """Return the world-frame mesh of a job's region.

    Raises UsageError: this is no job, or it has no such region, or several; DatasetError: no
    results.
    """
    if not (folder / JOB_MARKER).exists():
        raise UsageError(
            f"{folder.name} is not a job folder.", "Give the folder of --out, or a mesh file."
        )
    JobFolder(folder).check_entries()
    found = {path.parent.name: path for path in sorted(folder.glob("result/*/mesh.ply"))}
    if not found:
        raise DatasetError(f"The job {folder.name} has no mesh yet.", "Resume it first.")
    if region is None and len(found) > 1:
        raise UsageError(
            f"The job {folder.name} has the regions {', '.join(found)}.",
            "Choose one with --region.",
        )
    if region is not None and region not in found:
        raise UsageError(
            f"The job {folder.name} has no region {region}.", f"It has {', '.join(found)}."
        )
    return found[region] if region is not None else next(iter(found.values()))


def job_cameras(folder: Path) -> list[Camera]:
    """Return the cameras of a job's ``result/scene.json``, in world coordinates.

    Raises DatasetError: the job has no results yet; ParseError: the file is not as jobs write it.
    """
    from ...scene.camera import Camera, Similarity

    JobFolder(folder).check_entries()
    path = JobFolder(folder).result / "scene.json"
    if not path.is_file():
        raise DatasetError(f"The job {folder.name} has no {path.name} yet.", "Resume it first.")
    values = read_json(path)
    try:
        world_from_scene = Similarity.from_json(values["world_from_scene"])
        entries = [{k: v for k, v in e.items() if k != "photo"} for e in values["cameras"]]
        return [Camera.from_json(entry).moved(world_from_scene) for entry in entries]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ParseError(
            path, "cameras", f"not as expected ({error}).", "Export the job again with resume."
        ) from None
