# SPDX-License-Identifier: GPL-3.0-or-later
"""Where jobs lie, which Python works for them, and what ends them."""

from __future__ import annotations

from pathlib import Path

from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from tests.hostile.case import Build, Case, Group, Needs, Variant, Way
from tests.hostile.inputs import colmap, file, folder_of, nothing, renamed, steps
from tests.hostile.jobs import begun, with_result

_BLENDER = "tests/blender/test_job_cases.py"
_WORKER = "tests/core/jobs/test_worker.py"
_PYTHON = "tests/core/jobs/test_wrong_python.py"
_WRAP = ("wrap", "set", "--out", "out", "--no-blend")


def _out(place: str) -> tuple[str, ...]:
    return ("wrap", "set", "--out", place, "--no-blend")


def _closed(folder: Path) -> None:
    colmap()(folder)
    (folder / "closed").mkdir()


_ODD_JOB = "Ö x/" + "y" * 200
_PLACES = Case(
    43,
    "Job folders in unusual places",
    (
        Variant(
            "read-only",
            _closed,
            4,
            "closed/out cannot be written: .*Check that the folder exists, is not read-only",
            _out("closed/out"),
            closed="closed",
            needs=Needs.CLOSED_FOLDER,
        ),
        Variant(
            "a file",
            steps(colmap(), file("out", "mine")),
            2,
            "out is a file.*Choose a folder for the results",
            _WRAP,
        ),
        Variant(
            "under a file",
            steps(colmap(), file("file", "mine")),
            4,
            "file/out cannot be written: Not a directory.*Check that the folder exists",
            _out("file/out"),
        ),
        Variant(
            "with other files",
            steps(colmap(), file("out/mine.txt", "mine")),
            2,
            "out holds other files.*Choose a new or empty folder for results",
            _WRAP,
        ),
        Variant(
            "Unicode, spaces and 200 characters",
            steps(begun, renamed("out", _ODD_JOB)),
            0,
            "continue with: resume .*Ö x/yyy",
            ("status", _ODD_JOB),
        ),
        Variant(
            "that was deleted",
            nothing,
            2,
            "gone holds no job.*Choose a job folder",
            ("status", "gone"),
        ),
        Variant(
            "that is none",
            folder_of("set"),
            2,
            "set/job.json does not exist.*Choose a folder in which a job was started",
            ("resume", "set", "--no-blend"),
        ),
    ),
    (
        f"{_BLENDER}::test_43_a_folder_deleted_while_the_job_runs",
        f"{_BLENDER}::test_43_a_folder_that_cannot_be_written",
        f"{_BLENDER}::test_43_a_long_path_in_other_letters",
        (
            "tests/blender/test_found_jobs.py::"
            "test_a_project_folder_that_was_moved_asks_before_its_job_is_read"
        ),
        (
            "tests/blender/test_found_jobs.py::"
            "test_a_job_whose_folder_was_deleted_is_told_and_forgotten"
        ),
    ),
)

_LONG = "x" * 300
_LONG_OUT = Case(
    66,
    "Paths of 300 characters",
    (
        Variant("--out", colmap(), 2, r"\.\.\. is longer.*Use shorter", _out(_LONG)),
        Variant("the input", nothing, 3, r"\.\.\. is longer.*Use shorter", ("check", _LONG)),
        Variant("status", nothing, 2, r"\.\.\. is longer.*Use shorter", ("status", _LONG)),
        Variant(
            "--out of an export",
            with_result,
            2,
            r"\.\.\. is longer.*Use shorter",
            ("export", "out", "--format", "glb", "--out", _LONG),
        ),
        Variant(
            "a region",
            colmap(),
            2,
            r"\.\.\. is longer.*Use shorter",
            ("wrap", "set", "--region", f"{_LONG}.json", "--out", "out", "--no-blend"),
        ),
    ),
    ("tests/test_exit_codes.py::test_a_job_folder_that_no_system_stores",),
)


def _python(text: str) -> Build:
    """Return the build of a worker's Python that is a script, beside a good input."""

    def build(folder: Path) -> None:
        colmap()(folder)
        path = folder / "python"
        path.write_text(text)
        path.chmod(0o755)

    return build


def _with_python(
    name: str, build: Build, words: tuple[str, ...], code: int, says: str, python: str = "./python"
) -> Variant:
    left = ("out",) if words[0] == "wrap" else ()
    return Variant(
        name,
        build,
        code,
        says,
        words,
        way=Way.PROCESS,
        writes=left,
        starts=True,
        environment=((PYTHON_VARIABLE, python),),
        needs=Needs.POSIX,
    )


_DOCTOR = ("doctor",)
_ESTIMATE = ("estimate", "set")
_SET_UP = r"Press Set Up Worker"
_GONE = "The worker's Python ./gone does not exist.*Correct it in"
_NO_PYTHON = "#!/bin/sh\necho hello\n"
_OPTIONS = "#!/bin/sh\necho 'Unknown option: -I' >&2\nexit 2\n"
_WORKERS = Case(
    44,
    "A worker's Python that is missing, none, or too old",
    (
        _with_python("missing, wrap", colmap(), _WRAP, 2, _GONE, "./gone"),
        _with_python("missing, estimate", colmap(), _ESTIMATE, 2, _GONE, "./gone"),
        _with_python(
            "missing, doctor", nothing, _DOCTOR, 3, "Worker +The worker's Python", "./gone"
        ),
        _with_python(
            "another program, doctor",
            _python(_NO_PYTHON),
            _DOCTOR,
            3,
            r"python reported nothing: no output\.",
        ),
        _with_python(
            "another program, wrap", _python(_NO_PYTHON), _WRAP, 1, r"hello.*batch\.py doctor"
        ),
        _with_python(
            "without -I, estimate", _python(_OPTIONS), _ESTIMATE, 1, "Unknown option: -I.*doctor"
        ),
        _with_python(
            "no program at all, wrap",
            _python("#!/nowhere\n"),
            _WRAP,
            1,
            f"python, does not run: No such file.*{_SET_UP}",
        ),
    ),
    (
        f"{_PYTHON}::test_what_is_no_python_is_named_with_the_next_step",
        f"{_PYTHON}::test_an_older_python_is_told_its_version",
        f"{_PYTHON}::test_a_job_names_the_package_that_is_missing",
        "tests/blender/test_jobs.py::test_a_missing_worker_python_is_named",
        "tests/blender/test_worker_setup.py::test_every_state_draws",
    ),
)

_KILLED = Case(
    40,
    "A worker that is killed, out of memory, or crashes",
    (),
    (
        f"{_WORKER}::test_a_killed_worker_is_lost_and_says_the_signal",
        f"{_WORKER}::test_a_killed_worker_is_told_what_its_stage_can_do_with_less",
        "tests/blender/test_jobs.py::test_a_worker_killed_from_outside_is_lost_and_can_be_resumed",
        "tests/blender/test_jobs.py::test_failures_are_shown_with_the_next_step",
        "tests/core/worker/test_helper_process.py::test_a_crash_names_the_signal",
        "tests/core/worker/test_helper_process.py::test_the_memory_limit_holds",
    ),
)
_CANCELLED = Case(
    41,
    "Cancelling in every stage, twice, and without an answer",
    (),
    (
        f"{_BLENDER}::test_41_cancelled_twice_in_each_stage",
        f"{_BLENDER}::test_41_a_worker_of_another_blender_that_does_not_listen_is_killed",
        "tests/test_job_commands.py::test_a_running_job_is_shown_and_cancelled",
        "tests/test_job_commands.py::test_a_worker_that_does_not_listen_is_ended",
        (
            "tests/core/jobs/test_worker_ends_itself.py::"
            "test_a_worker_that_does_not_listen_ends_itself"
        ),
    ),
)
_FULL = Case(
    42,
    "A full disk at any write",
    (),
    (
        (
            "tests/core/jobs/test_disk_full.py::"
            "test_a_worker_on_a_full_disk_says_which_file_and_keeps_its_checkpoint"
        ),
        "tests/core/jobs/test_disk_full.py::test_every_writer_leaves_the_file_that_was_there",
        "tests/test_exit_codes.py::test_a_disk_without_room_has_the_same_code_everywhere",
    ),
)
_ORPHANS = Case(
    54,
    "A caller that dies as soon as it has started a worker",
    (),
    (
        f"{_WORKER}::test_a_worker_ends_with_its_caller_even_if_that_dies_first",
        ("tests/core/worker/test_processes.py::test_a_caller_that_was_dead_at_the_start_has_ended"),
    ),
)
_SIGNALS = Case(
    57,
    "SIGTERM after pycolmap was imported",
    (),
    ("tests/core/worker/test_signal_handlers.py::test_the_handlers_of_a_worker_stay",),
)
_LOSERS = Case(
    62,
    "Two starts at once",
    (),
    (f"{_PYTHON}::test_the_loser_of_a_concurrent_start_ends_with_code_2",),
)
_CUT_TRACEBACKS = Case(
    68,
    "Tracebacks of helpers among warnings",
    (),
    (
        (
            "tests/core/worker/test_helper_process.py::"
            "test_an_exception_brings_its_last_words_and_the_log_the_others"
        ),
    ),
)
_PARTIAL = Case(
    65,
    "Half-written files of killed workers",
    (),
    (
        f"{_WORKER}::test_a_worker_removes_what_killed_ones_left",
        "tests/core/test_files.py::test_what_killed_processes_left_is_removed",
    ),
)

GROUP = Group(
    "Jobs",
    (
        _KILLED,
        _CANCELLED,
        _FULL,
        _PLACES,
        _WORKERS,
        _ORPHANS,
        _SIGNALS,
        _LOSERS,
        _LONG_OUT,
        _CUT_TRACEBACKS,
        _PARTIAL,
    ),
)
