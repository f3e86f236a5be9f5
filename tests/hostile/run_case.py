# SPDX-License-Identifier: GPL-3.0-or-later
"""Run one variant of a case and say what came of it."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import EXIT_DONE, WrapError
from gaussian_wrapping_addon.core.gaussians.files import read_foreign_splat
from gaussian_wrapping_addon.core.jobs.stages.cameras import run_cameras
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.loading.other_inputs import splat_extent
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import JobSettings
from gaussian_wrapping_addon.core.worker.helper_process import own_peak_bytes
from tests.hostile.case import Variant, Way
from tests.hostile.same_process import workers_in_this_process
from tests.hostile.surroundings import CASE, HOME, TEMPORARY, changes, content, make_place, watched
from tests.read_only import read_only

BATCH = Path(batch.__file__)
LIMIT_S = 10.0
"""No case may take longer. In tests the limit of this process is wider, which shares its cores."""
HERE_LIMIT_S = 60.0
MEMORY_LIMIT_BYTES = 500 * 1024 * 1024
"""Above what this process held before."""
_RESET_PEAK = Path("/proc/self/clear_refs")


@dataclass
class Outcome:
    """What a command did."""

    code: int | None
    output: str
    errors: str
    seconds: float
    memory_bytes: int = 0
    """Peak above what was held before; 0 where it is not known."""
    left: list[str] = field(default_factory=list)
    """Entries that were made, changed or removed and may not be."""
    outside: list[str] = field(default_factory=list)
    """Changes elsewhere, and reads of somebody's files."""
    started: list[str] = field(default_factory=list)

    def line(self, pattern: str) -> str:
        """Return the first line of the output with a match, or all of it where there is none."""
        return next((one for one in self.output.splitlines() if re.search(pattern, one)), "")


class TimeLimitError(BaseException):
    """Not an ``Exception``: nothing of the product may catch it."""


def run_variant(variant: Variant, place: Path) -> Outcome:
    """Make the input of a variant in a new folder, run its command and look around."""
    folder = make_place(place)
    variant.build(folder)
    before = content(place)
    closed: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
    if variant.closed:
        closed = read_only(folder / variant.closed)
    with closed:
        if variant.way in (Way.PROCESS, Way.TERMINAL):
            outcome = _in_process(variant, place)
        else:
            outcome = _here(variant, place)
    outcome.left = changes(before, content(place), variant.writes)
    for name in before:
        if "may not be read" in before[name]:
            (place / name).chmod(0o700)  # so that the place can be removed
    return outcome


@contextlib.contextmanager
def _surroundings(variant: Variant, place: Path) -> Iterator[None]:
    """Let the command see a home, a folder for temporary files and a working directory of ours."""
    given = {
        "HOME": str(place / HOME),
        "TMPDIR": str(place / TEMPORARY),
        **dict(variant.environment),
    }
    earlier = {name: os.environ.get(name) for name in given}
    here = os.getcwd()
    os.environ.update(given)
    tempfile.tempdir = None
    os.chdir(place / CASE)
    try:
        yield
    finally:
        os.chdir(here)
        tempfile.tempdir = None
        for name, value in earlier.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise where the block takes longer, such as one that waits for a pipe."""
    if (
        not hasattr(signal, "setitimer")
        or threading.current_thread() is not threading.main_thread()
    ):
        yield
        return

    def fail(_number: int, _frame: object) -> None:
        raise TimeLimitError(f"not done after {seconds:g} s")

    handler = signal.signal(signal.SIGALRM, fail)
    left_s, _ = signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, left_s)  # that of pytest's own limit
        signal.signal(signal.SIGALRM, handler)


def _here(variant: Variant, place: Path) -> Outcome:
    output, errors = io.StringIO(), io.StringIO()
    code: int | None = None
    held_bytes = reset_peak_memory()
    with (
        _surroundings(variant, place),
        watched(place) as seen,
        warnings.catch_warnings(record=True) as warned,
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
        _silent_log(),
        workers_in_this_process(),
    ):
        warnings.simplefilter("always")
        begun_s = time.monotonic()
        try:
            with within(HERE_LIMIT_S):
                code = _load() if variant.way is Way.LOADING else batch.main(list(variant.words))
        except (Exception, TimeLimitError) as error:
            errors.write(f"Traceback: {type(error).__name__}: {error}")
        seconds = time.monotonic() - begun_s
        memory_bytes = max(own_peak_bytes() - held_bytes, 0) if held_bytes else 0
    noise = "".join(
        f"{one.category.__name__}: {one.message} ({one.filename}:{one.lineno})\n"
        for one in warned
        if not issubclass(one.category, DeprecationWarning | ResourceWarning)
    )
    outside = [*seen.changed_outside]
    if not variant.reads_beside:
        outside += [f"read {path}" for path in seen.read_beside]
    return Outcome(
        code, output.getvalue(), errors.getvalue() + noise, seconds, memory_bytes,
        outside=outside, started=list(seen.started),
    )  # fmt: skip


@contextlib.contextmanager
def _silent_log() -> Iterator[None]:
    """Stand for the log file of a worker: what its modules log is no output of the command."""
    nowhere = logging.NullHandler()
    logging.getLogger().addHandler(nowhere)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(nowhere)


def reset_peak_memory() -> int:
    """Let the peak of this process begin anew; return what it holds, 0 where that is unknown."""
    try:
        _RESET_PEAK.write_text("5")
    except OSError:
        return 0
    return own_peak_bytes()


def _load() -> int:
    """Run the first stage of ``wrap set --out out``, with the words of the command line.

    A splat is read and measured, but not rendered.
    """
    source = next(path for path in Path.cwd().iterdir() if path.stem == "set")
    try:
        warned, ready = (_read_splat if source.suffix == ".ply" else _load_set)(source)
    except WrapError as error:
        print(f"error: {error}")
        return error.exit_code
    for text, hint in warned:
        print(f"warning: {text} {hint}")
    print(ready)
    return EXIT_DONE


def _load_set(source: Path) -> tuple[list[tuple[str, str]], str]:
    job = make_job("wrap", source, JobSettings(threads=1))
    folder = JobFolder(Path.cwd() / "out")
    folder.create()
    done = run_cameras(folder, job, Progress(), threads=1).done
    warned = [(warning["text"], warning.get("hint", "")) for warning in done["warnings"]]
    return warned, f"{done['views']} photos and {done['points']} points are ready"


def _read_splat(source: Path) -> tuple[list[tuple[str, str]], str]:
    splat = read_foreign_splat(source)
    gaussians = splat.gaussians
    opacities = gaussians.opacity_logits.sigmoid().numpy()
    extent = splat_extent(gaussians.means.numpy(), opacities)
    warned = [(warning.text, warning.hint) for warning in splat.warnings]
    return warned, f"{len(gaussians.means)} Gaussians reach {extent.radius:.2f} from their middle"


def _in_process(variant: Variant, place: Path) -> Outcome:
    command = [sys.executable, str(BATCH), *variant.words]
    begun_s = time.monotonic()
    with _surroundings(variant, place):
        environment = {
            **os.environ, "PYTHONIOENCODING": variant.encoding, "PYTHONUTF8": "0",
            "PYTHONDONTWRITEBYTECODE": "1",
        }  # fmt: skip
        run = _with_terminal if variant.way is Way.TERMINAL else _with_pipes
        try:
            code, output, errors = run(command, environment, variant.encoding)
        except subprocess.TimeoutExpired:
            code, output, errors = None, "", f"Traceback: not done after {LIMIT_S:g} s"
    return Outcome(code, output, errors, time.monotonic() - begun_s)


def _with_pipes(command: list[str], environment: dict[str, str], encoding: str) -> tuple[Any, ...]:
    ended = subprocess.run(
        command, env=environment, capture_output=True, check=False, timeout=LIMIT_S
    )
    return ended.returncode, ended.stdout.decode(encoding), ended.stderr.decode(encoding)


def _with_terminal(
    command: list[str], environment: dict[str, str], encoding: str
) -> tuple[Any, ...]:
    ours, theirs = pty.openpty()
    try:
        ended = subprocess.run(
            command, env=environment, stdin=theirs, stdout=theirs, stderr=theirs, check=False,
            timeout=LIMIT_S,
        )  # fmt: skip
    finally:
        os.close(theirs)
    written = b""
    with contextlib.suppress(OSError), open(ours, "rb", buffering=0) as stream:  # EIO at its end
        while part := stream.read(65536):
            written += part
    return ended.returncode, written.decode(encoding).replace("\r\n", "\n"), ""
