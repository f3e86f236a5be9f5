# SPDX-License-Identifier: GPL-3.0-or-later
"""Command lines that are wrong, and what people do in Blender."""

from __future__ import annotations

from tests.hostile.case import Build, Case, Group, Variant, Way
from tests.hostile.inputs import colmap, file, nothing
from tests.hostile.jobs import begun

_BLENDER = "tests/blender/test_job_cases.py"
_REGIONS = "tests/blender/test_region_cases.py"
_OUT = ("--out", "out", "--no-blend")
_USAGE = r"Usage: batch\.py"


def _line(
    name: str, words: tuple[str, ...], says: str, code: int = 2, build: Build = nothing
) -> Variant:
    return Variant(name, build, code, says, words)


_LINES = Case(
    50,
    "Command lines",
    (
        Variant("no arguments", nothing, 2, rf"required: command\. {_USAGE}", (), way=Way.PROCESS),
        _line("an unknown command", ("dance",), rf"invalid choice: 'dance'.*{_USAGE}"),
        _line("an unknown option", ("check", "set", "--dance"), rf"--dance\. {_USAGE}"),
        _line("--help", ("--help",), "Photos in, a textured mesh out", 0),
        _line("check without an input", ("check",), rf"required: input\. {_USAGE}"),
        _line(
            "wrap without --out", ("wrap", "set"), r"required: --out\. See batch\.py wrap --help"
        ),
        _line(
            "an unknown preset",
            ("wrap", "set", "--preset", "x", *_OUT),
            r"invalid choice: 'x'.*See batch\.py wrap --help",
        ),
        _line(
            "two resolutions",
            ("wrap", "set", "--points", "9", "--edge-length", "1", *_OUT),
            r"not allowed with.*See batch\.py wrap --help",
        ),
        _line(
            "pivots and a length",
            ("wrap", "set", "--set", "method=pivots", "--edge-length", "1", *_OUT),
            "--edge-length 1.0 has no effect with --set method=pivots.*Leave out one",
            build=colmap(),
        ),
        _line(
            "an unknown format",
            ("wrap", "set", "--export", "fbx", *_OUT),
            "--export is out of range. Give among glb, obj",
            build=colmap(),
        ),
        _line("more without a number", ("more", "--out", "out"), rf"--iterations\. {_USAGE}"),
        _line(
            "more of nothing",
            ("more", "--out", "out", "--iterations", "5", "--no-blend"),
            "out/job.json does not exist.*Choose a folder in which a job was started",
        ),
        _line(
            "mesh of a job without training",
            ("mesh", "--out", "out", "--no-blend"),
            "out holds no finished training.*Run wrap, or resume it, first",
            3,
            begun,
        ),
        _line(
            "bake without a mesh",
            ("bake", "--out", "out"),
            r"required: --mesh\. Usage: batch\.py bake \[-h\] --out DIR --mesh FILE",
        ),
        _line(
            "bake of a mesh that is gone",
            ("bake", "--out", "out", "--mesh", "gone.obj"),
            "out holds no finished training.*Run wrap",
            3,
            begun,
        ),
        _line(
            "evaluate without truth",
            ("evaluate", "a.off"),
            "needs a ground truth.*Give it with --truth",
            2,
            file("a.off", "OFF"),
        ),
        _line(
            "evaluate in a tiny size",
            ("evaluate", "a.off", "--metric", "mbr", "--max-image-px", "1"),
            "too small.*Give at least 64",
        ),
        _line(
            "thresholds that are none",
            ("evaluate", "a.off", "--truth", "a.off", "--thresholds", "a,b"),
            "give numbers separated by commas",
        ),
        _line(
            "markers of no dictionary",
            ("wrap", "set", "--markers", "4x4_51:0.05", *_OUT),
            "no marker dictionary '4x4_51'.*Use one of 4x4_50",
        ),
        _line(
            "markers of no size",
            ("wrap", "set", "--markers", "4x4_50:0", *_OUT),
            "marker size '0' is not a length.*in metres",
        ),
        _line(
            "control points that do not exist",
            ("wrap", "set", "--control-points", "gcp.txt", *_OUT),
            "control points gcp.txt do not exist.*Check the path",
            3,
            colmap(),
        ),
        Variant(
            "set-up-worker into a job",
            begun,
            2,
            "out is not a folder, or holds other files.*Choose",
            ("set-up-worker", "--dry-run", "--to", "out"),
            starts=True,
        ),
    ),
    (
        "tests/test_exit_codes.py::test_a_folder_that_is_no_job",
        "tests/test_exit_codes.py::test_a_command_line_that_is_wrong",
        (
            "tests/core/jobs/test_wrong_python.py::"
            "test_the_loser_of_a_concurrent_start_ends_with_code_2"
        ),
        "tests/blender/test_cli_command.py::*",
    ),
)

_REGION_OBJECTS = Case(
    36,
    "Objects of Blender given as regions",
    (),
    (
        f"{_REGIONS}::*",
        "tests/blender/test_jobs.py::test_mesh_region_refuses_what_cannot_be_meshed",
    ),
)
_BLENDER_STEPS = Case(
    38,
    "Undo, other files, disabling and quitting while a job runs",
    (),
    (
        f"{_BLENDER}::test_38_the_job_is_found_again",
        "tests/blender/test_killed_blender.py::test_quitting_leaves_no_process_behind",
        "tests/blender/test_killed_blender.py::test_a_killed_blender_finds_its_job_again",
        "tests/blender/test_jobs.py::test_undo_does_not_lose_a_running_job",
    ),
)

GROUP = Group("Commands and Blender", (_REGION_OBJECTS, _BLENDER_STEPS, _LINES))
