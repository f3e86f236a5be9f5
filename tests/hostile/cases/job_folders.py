# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders from elsewhere: links, pipes, devices, locks and entries that no job writes."""

from __future__ import annotations

import json
from typing import Any

from gaussian_wrapping_addon.core import limits
from tests.hostile.case import Build, Case, Group, Needs, Variant
from tests.hostile.inputs import file, link, pipe, region, remove, steps, unreadable
from tests.hostile.jobs import begun, job_entry, locked_by, status, this_process, trained

_FOLDERS = "tests/core/jobs/store/test_hostile_folders.py"
_BLENDER = "tests/blender/test_job_cases.py"
_PROFILE = "../../beside/profile"
_OUTSIDE = "../../beside"
_LINK = "Job folders hold regular files and folders only.*Remove it, or put what it stands for"
_RESUME = ("resume", "out", "--no-blend")
_STATUS = ("status", "out")
_CANCEL = ("cancel", "out")
_MESH = ("mesh", "--out", "out", "--no-blend")
_MORE = ("more", "--out", "out", "--iterations", "5", "--no-blend")
_UNREADABLE = "^continue with: resume .*out$"
_EXPORT = ("export", "out", "--format", "glb", "--out", "new")
_ESTIMATE = ("estimate-mesh", "--out", "out")
_PART = ("run-part", "out", "train")
_EVALUATE = ("evaluate", "out", "--truth", "out")


def _linked(
    entry: str, words: tuple[str, ...], says: str, code: int = 3, to: str = _PROFILE
) -> Variant:
    up = "../" * entry.count("/")
    name = f"{words[0]}, {entry}"
    build = steps(trained, link(f"out/{entry}", f"{up}{to}"))
    return Variant(name, build, code, says, words, needs=Needs.POSIX)


def _refused(entry: str, words: tuple[str, ...], to: str = _PROFILE) -> Variant:
    last = entry.rpartition("/")[2].replace(".", r"\.")
    return _linked(entry, words, rf"{last}.* is a link.*{_LINK}", to=to)


_FILES = ("log.txt", "worker-output.txt", "status.json", "result/x.txt", "stages/train-a/x.npz")
_LINKS = Case(
    51,
    "Links among the files of a job folder",
    (
        *(_refused(entry, _RESUME) for entry in _FILES),
        *(
            _refused("result/scene.json", words)
            for words in (_MESH, _MORE, _EXPORT, _ESTIMATE, _EVALUATE)
        ),
        _linked("result/scene.json", _PART, rf"scene\.json.* is a link.*{_LINK}", 1),
        _linked("cancel", _CANCEL, "no job is running in .*out", 0),
        _linked("status.json", _STATUS, _UNREADABLE, 0),
        _linked("lock.json", _STATUS, "^cancelled$", 0),
        _linked("job.json", _RESUME, r"job\.json.* is a link"),
        _linked("job.json", _MESH, r"job\.json.* is a link"),
    ),
    (
        f"{_FOLDERS}::test_a_job_whose_files_are_links_is_refused",
        f"{_FOLDERS}::test_an_empty_file_is_not_made_behind_a_link",
    ),
)

_FOLDER_LINKS = Case(
    52,
    "Links among the folders of a job folder",
    tuple(
        _refused(entry, words, _OUTSIDE)
        for entry in ("result/.earlier", "result/.new", "stages/mesh-a", "baked")
        for words in (_RESUME, _MESH, _EXPORT)
    ),
    (
        f"{_FOLDERS}::test_the_swap_deletes_and_moves_nothing_behind_a_link",
        f"{_FOLDERS}::test_rolling_back_deletes_nothing_behind_a_link",
    ),
)


def _instead(
    entry: str, make: Any, what: str, words: tuple[str, ...], code: int, says: str
) -> Variant:
    build = steps(begun, make(f"out/{entry}"))
    return Variant(f"{words[0]}, {entry} is {what}", build, code, says, words, needs=Needs.POSIX)


def _zero(name: str) -> Build:
    return link(name, "/dev/zero")


def _large(name: str) -> Build:
    """Return the build of a sparse file that is larger than any status."""

    def build(folder: Any) -> None:
        with (folder / name).open("wb") as stream:
            stream.truncate(limits.MAX_JSON_BYTES + 1)

    return build


_PIPES = Case(
    53,
    "Named pipes, devices and vast files instead of those of a job",
    (
        _instead("status.json", pipe, "a pipe", _STATUS, 0, _UNREADABLE),
        _instead("status.json", _zero, "/dev/zero", _STATUS, 0, _UNREADABLE),
        _instead("status.json", _large, "of 64 MB", _STATUS, 0, _UNREADABLE),
        _instead("lock.json", pipe, "a pipe", _CANCEL, 0, "no job is running in .*out"),
        _instead("lock.json", _zero, "/dev/zero", _CANCEL, 0, "no job is running in .*out"),
        _instead("job.json", pipe, "a pipe", _RESUME, 3, r"job\.json.* named pipe"),
        _instead("job.json", _zero, "/dev/zero", _RESUME, 3, r"job\.json.* is a link"),
        _instead("job.json", _large, "of 64 MB", _RESUME, 3, r"job\.json, whole file: more than"),
        _instead("x", pipe, "a pipe", _RESUME, 3, rf"out/x is a named pipe.*{_LINK}"),
        _instead("job-finished.json", pipe, "a pipe", _STATUS, 0, "^cancelled$"),
    ),
    (
        f"{_FOLDERS}::test_looking_at_a_job_neither_waits_nor_fills_the_memory",
        (
            "tests/blender/test_found_jobs.py::"
            "test_opening_a_file_never_waits_for_a_pipe_in_the_folder_beside_it"
        ),
    ),
)

_DEAD = 2**30
_LOCKS = Case(
    63,
    "Locks of processes that are none of ours",
    (
        Variant(
            "of process 1",
            steps(begun, file("out/lock.json", '{"pid": 1, "started": 0}')),
            0,
            "no job is running in .*out",
            _CANCEL,
        ),
        Variant(
            "of a number that is no process",
            steps(begun, file("out/lock.json", json.dumps({"pid": 10**400, "started": -1}))),
            0,
            "no job is running in .*out",
            _CANCEL,
        ),
        Variant(
            "of words",
            steps(begun, file("out/lock.json", '{"pid": "me"}')),
            0,
            "no job is running in .*out",
            _CANCEL,
        ),
    ),
    ("tests/core/jobs/store/test_job_folder.py::test_a_stale_lock_is_taken_over",),
)

_TWO = Case(
    39,
    "Two commands on one job folder",
    (
        Variant(
            "resume of a running job",
            steps(begun, locked_by(this_process)),
            2,
            r"A job is running in out\. Wait for it, or stop it: cancel DIR",
            _RESUME,
        ),
        Variant(
            "mesh of a running job",
            steps(trained, locked_by(this_process)),
            2,
            r"A job is running in out\. Wait for it, or stop it: cancel DIR",
            _MESH,
        ),
        Variant(
            "status of a worker that has died",
            steps(begun, status(state="RUNNING", stage="train", pid=_DEAD, heartbeat_s=1.0)),
            0,
            "^lost$",
            _STATUS,
        ),
        Variant(
            "the number of a dead worker in use again",
            steps(begun, status(state="RUNNING", pid=1, pid_started=12345, heartbeat_s=1e12)),
            0,
            "^lost$",
            _STATUS,
        ),
    ),
    (
        f"{_BLENDER}::test_39_two_jobs_in_two_scenes",
        f"{_BLENDER}::test_39_a_second_blender_is_refused_with_words",
        f"{_BLENDER}::test_39_a_stale_lock_is_taken_over",
        "tests/core/jobs/store/test_job_folder.py::test_two_that_take_over_at_once_leave_one",
    ),
)


def _entry(place: str, value: Any, says: str, name: str = "") -> Variant:
    build = steps(begun, job_entry(place, value))
    return Variant(name or f"{place} = {value!r}", build, 2, says, _RESUME)


_AGAIN = "Start the job again"
_FLAT = region(vertices=[[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
_ENTRIES = Case(
    64,
    "Entries of job.json that no job holds",
    (
        _entry(
            "settings.training.densify_every",
            0,
            r"job\.json: settings\.training\.densify_every is out of range\. Give from 1",
        ),
        _entry(
            "settings.training.focus",
            "[" * 5000,
            f"focus is no list of regions.*{_AGAIN}",
            "a focus nested deeply",
        ),
        _entry("settings.training.focus", "[]", f"focus is no list of regions.*{_AGAIN}"),
        _entry("settings.training.focus", "{", f"focus is no list of regions.*{_AGAIN}"),
        _entry(
            "settings.training.focus", "[1]", f"focus.0., top level: is not an object.*{_AGAIN}"
        ),
        _entry(
            "settings.training.iterations",
            "9",
            "iterations has the wrong type. Give a whole number",
        ),
        _entry(
            "settings.training.iterations",
            True,
            "iterations has the wrong type. Give a whole number",
        ),
        _entry("settings.training.dance", 1, "training has an unknown entry 'dance'. Remove it"),
        _entry(
            "settings.threads", -1, r"job\.json: settings\.threads is out of range\. Give from 0"
        ),
        _entry(
            "settings.meshing.edge_length",
            10**400,
            r"job\.json: settings\.meshing\.edge_length is too large\. Give a smaller number",
            "an edge of 10⁴⁰⁰",
        ),
        _entry("settings.regions", ["/nowhere/x.json"], f"holds no region '/nowhere.*{_AGAIN}"),
        _entry("region_bodies", {"/x.json": {"a": 1}}, rf"x\.json, class_name: .*{_AGAIN}"),
        _entry("region_bodies", {"/x.json": _FLAT}, f"is flat.*{_AGAIN}", "a flat region"),
        _entry("region_bodies", [], f"region_bodies must be an object.*{_AGAIN}"),
        _entry("source", "/", "'/' cannot be the source of a job.*Give the folder of the photos"),
        _entry("source", "", "'' cannot be the source of a job.*Give the folder of the photos"),
        _entry("source", "a\0b", "cannot be the source of a job.*Give the folder of the photos"),
        _entry("source", 5, f"names no command or source.*{_AGAIN}"),
        _entry("command", "rm", f"names no command or source.*{_AGAIN}"),
        _entry("command", ["wrap"], f"names no command or source.*{_AGAIN}"),
        _entry("schema_version", 2, f"has schema version 2, not 1.*{_AGAIN}"),
        _entry("settings", [], r"job\.json: settings must be an object\. Write it as"),
        _entry("settings.regions", "auto", "regions has the wrong type. Give a list of text"),
        Variant(
            "bake without a mesh",
            steps(begun, job_entry("command", "bake")),
            2,
            "names no mesh to bake onto.*Start the bake again",
            _RESUME,
        ),
        Variant(
            "no JSON",
            steps(begun, file("out/job.json", "{")),
            3,
            r"job\.json, line 1: not JSON",
            _RESUME,
        ),
        Variant(
            "a list",
            steps(begun, file("out/job.json", "[]")),
            2,
            f"job.json does not hold the entries of a job.*{_AGAIN}",
            _RESUME,
        ),
        Variant(
            "missing",
            steps(begun, remove("out/job.json")),
            2,
            "job.json does not exist.*Choose a folder in which a job was started",
            _RESUME,
        ),
    ),
    ("tests/core/jobs/store/test_job_file.py::test_what_is_not_a_job_is_refused_by_name",),
)

_STATES = Case(
    45,
    "A status or a job from elsewhere",
    (
        Variant("a list", steps(begun, file("out/status.json", "[]")), 0, _UNREADABLE, _STATUS),
        Variant(
            "half a file", steps(begun, file("out/status.json", '{"sta')), 0, _UNREADABLE, _STATUS
        ),
        Variant(
            "a status that may not be read",
            steps(begun, unreadable("out/status.json")),
            0,
            _UNREADABLE,
            _STATUS,
            needs=Needs.USER,
        ),
        Variant(
            "a job file that may not be read",
            steps(begun, unreadable("out/job.json")),
            3,
            r"job\.json, whole file: cannot be read: Permission denied\. Check its permissions",
            _RESUME,
            needs=Needs.USER,
        ),
        Variant(
            "a folder that may not be read",
            steps(begun, unreadable("out/stages")),
            3,
            r"stages cannot be read: Permission denied.*Check its permissions",
            _RESUME,
            needs=Needs.USER,
        ),
        Variant(
            "an unknown state",
            steps(begun, status(state="OWNED", stage="x")),
            0,
            _UNREADABLE,
            _STATUS,
        ),
        Variant(
            "numbers out of reach",
            steps(begun, status(state="FAILED", fraction=1e308, seconds_left=1e308, pid=10**400)),
            0,
            "^failed$",
            _STATUS,
        ),
        Variant(
            "seconds that are negative",
            steps(begun, status(state="FAILED", stage="train", seconds_left=-1e300)),
            0,
            "^failed$",
            _STATUS,
        ),
        Variant(
            "a result that leads elsewhere",
            steps(begun, status(state="DONE", result="/etc")),
            0,
            "^results: .*/out/result$",
            _STATUS,
        ),
        Variant(
            "another program as its worker",
            steps(begun, status(state="FAILED", pid=1, pid_started=0)),
            0,
            "no job is running in .*out",
            _CANCEL,
        ),
    ),
    (
        f"{_BLENDER}::test_45_a_status_from_elsewhere_breaks_nothing",
        f"{_BLENDER}::test_45_cancelling_a_job_from_elsewhere_ends_no_other_program",
        "tests/blender/test_found_jobs.py::test_a_file_from_elsewhere_opens_no_job_unasked",
        "tests/test_job_commands.py::test_a_process_that_is_no_worker_is_not_ended",
    ),
)

GROUP = Group("Job folders", (_TWO, _STATES, _LINKS, _FOLDER_LINKS, _PIPES, _LOCKS, _ENTRIES))
