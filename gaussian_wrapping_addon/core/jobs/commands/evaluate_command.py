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

from ...errors import (
    DatasetError,
    ParseError,
    UsageError,
    unwritable_error,
)
from ...files import read_json, write_json
from ...processes.helper_process import emit
from ..store.job_folder import MARKER, JobFolder
from .worker_call import run_command

if TYPE_CHECKING:
    from ...dataset.camera import Camera


def main(arguments: list[str]) -> int:
    """Evaluate ``arguments = [request as JSON]`` in this process; return the exit code."""

    from ...texture.files.file_checks import write_errors

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
    from ...evaluation.command import EvaluationRequest, evaluate_mesh, read_cameras, table
    from ...evaluation.layouts.mesh_input import read_mesh
    from ...kernels.parallel import default_threads
    from ...machine import describe_machine
    from ...processes.peak_memory import peak_memory_bytes
    from ...progress import Progress, ProgressEvent

    begun_s, begun_unix_s = time.monotonic(), time.time()

    def shares(name: str) -> tuple[Any, ...] | None:
        return None if given[name] is None else tuple(given[name])

    request = EvaluationRequest(
        Path(given["truth"]), given["layout"], given["scan"], shares("shares"),
        shares("distances"), given["align"], shares("protocols"), given["samples"], given["seed"],
        given["threads"] or default_threads(),
    ).checked()  # fmt: skip
    source = Path(given["mesh"])
    cameras: list[Camera] = []
    if source.is_dir():
        path = job_mesh(source, given["region"])
        cameras = job_cameras(source)
    else:
        if given["region"]:
            raise UsageError(
                f"{source.name} is a mesh file and has no regions.",
                "Omit --region, or give a job folder.",
            )
        path = source
    if given["cameras"]:
        cameras_path = Path(given["cameras"])
        cameras = (
            job_cameras(cameras_path)
            if (cameras_path / MARKER).exists()
            else read_cameras(cameras_path)
        )

    def report_progress(event: ProgressEvent) -> None:
        emit(fraction=event.fraction, message=event.message)

    vertices, faces = read_mesh(path)
    result = evaluate_mesh(vertices, faces, cameras, request, Progress("evaluate", report_progress))
    report = {
        "version": 1,
        "started_unix_s": begun_unix_s,
        "seconds": time.monotonic() - begun_s,
        "mesh": {"path": str(path.resolve()), "vertices": len(vertices), "faces": len(faces)},
        "truth": str(request.truth.resolve()),
        "cameras": len(cameras),
        "asked": {**asdict(request), "truth": str(request.truth)},
        **result,
        "machine": describe_machine(request.threads),
        "peak_memory_bytes": peak_memory_bytes(),
    }
    return report, [f"{path.name}: {len(vertices)} vertices, {len(faces)} faces", *table(result)]


def job_mesh(folder: Path, region: str | None) -> Path:
    """Return the world-frame mesh of a job's region.

    Raises
    ------
    UsageError
        The folder is not a job; it has several regions and none was named, or not the one named.
    DatasetError
        The job has no results.
    """
    if not (folder / MARKER).exists():
        raise UsageError(
            f"{folder.name} is not a job folder.", "Give the folder of --out, or a mesh file."
        )
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

    Raises
    ------
    DatasetError
        The job has no results yet.
    ParseError
        The file is not in the format that jobs write.
    """
    from ...dataset.camera import Camera
    from ...dataset.similarity import Similarity

    path = JobFolder(folder).result / "scene.json"
    if not path.is_file():
        raise DatasetError(f"The job {folder.name} has no {path.name} yet.", "Resume it first.")
    values = read_json(path)
    try:
        world_from_scene = Similarity.from_json(values["world_from_scene"])
        return [
            Camera.from_json({k: v for k, v in entry.items() if k != "photo"}).moved(
                world_from_scene
            )
            for entry in values["cameras"]
        ]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ParseError(
            path, "cameras", f"not as expected ({error}).", "Export the job again with resume."
        ) from None
