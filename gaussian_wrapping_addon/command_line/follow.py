# SPDX-License-Identifier: GPL-3.0-or-later
"""Follow a job on the command line: show its progress, then write the Blender files."""

from __future__ import annotations

import importlib.util
import logging
import time
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..core.jobs.client import JobClient
    from ..core.jobs.store.job_file import JobFile
    from ..core.jobs.store.job_folder import JobStatus

_logger = logging.getLogger("gaussian_wrapping")

POLL_S = 0.2
LINE_EVERY_S = 5.0
CANCEL_WAIT_S = 12.0


def has_bpy() -> bool:
    """Tell whether this Python can write Blender files."""
    return importlib.util.find_spec("bpy") is not None


def require_bpy(job: JobFile, options: Namespace) -> None:
    """Raise before the job starts if its Blender files could not be written without bpy."""
    from ..core.errors import UsageError
    from ..core.names import BLENDER_FORMATS

    wants = not options.no_blend or bool(set(job.settings.export) & set(BLENDER_FORMATS))
    if wants and not has_bpy():
        raise UsageError(
            "Writing scene.blend or USD needs bpy, which this Python does not have.",
            "Add --no-blend (and leave usd out), run it in Blender, or pip install bpy.",
        )


def follow(client: JobClient, job: JobFile, options: Namespace) -> int:
    """Show progress until the worker ends; then write the Blender files. Return the exit code."""
    from ..core.errors import EXIT_DONE
    from ..core.jobs.store.job_folder import result_state

    before = result_state(client.folder.result)  # the worker replaces it at its end
    code = watch(client)
    if code != EXIT_DONE:
        return code
    return _finish(client.folder.result, before, job, options) or EXIT_DONE


def watch(client: JobClient) -> int:
    """Show progress until the worker ends; return the exit code."""
    from ..core.errors import EXIT_CANCELLED, EXIT_DONE, EXIT_OTHER
    from ..core.jobs.store.job_folder import result_state

    before = result_state(client.folder.result)
    shown_s, shown, interrupted_s = 0.0, ("", ""), 0.0
    while True:
        try:
            status = client.poll()
            now_s = time.monotonic()
            news = (status.stage, status.message)
            due = status.stage != shown[0] or now_s - shown_s > LINE_EVERY_S
            failed = status.state in ("FAILED", "LOST")
            # Not after a failure: the status of a rolled-back job shows 100 %.
            if status.stage and due and news != shown and not failed:
                shown_s, shown = now_s, news
                _logger.info("%s", progress_line(status))
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
            same = result_state(client.folder.result) == before
            _logger.info(
                "the job and its result are unchanged: %s" if same
                else "the job is unchanged, but its result is not; mesh it again: %s",
                client.folder.root,
            )  # fmt: skip
        return status.exit_code or EXIT_OTHER
    return EXIT_DONE


def _finish(result: Path, before: dict[str, bytes], job: JobFile, options: Namespace) -> int:
    """Write the Blender files; a ``scene.blend`` of the result ``before`` is renamed."""
    from ..core.jobs.store.job_folder import NAME, back_up_stale_blend

    if options.no_blend:
        back_up_stale_blend(result, before)
    else:
        from ..ops.scene_objects import write_blend

        try:
            write_blend(result, result / NAME)
        except BaseException:
            back_up_stale_blend(result, before)
            raise
    if "usd" in job.settings.export:
        from ..ops.scene_objects import export_usd

        export_usd(result)
    from ..core.evaluation.report.report import headline
    from ..core.files import read_json

    _logger.info("results: %s", result)
    for line in headline(read_json(result / "report.json")):
        _logger.info("  %s", line)
    return 0


def progress_line(status: JobStatus) -> str:
    """Return how far a job is, in one line."""
    left = "" if status.seconds_left is None else f" · {_span(status.seconds_left)} left"
    return f"[{100 * status.fraction:5.1f} %] {status.stage:<7} {status.message}{left}"


def _span(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
