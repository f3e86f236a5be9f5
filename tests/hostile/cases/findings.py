# SPDX-License-Identifier: GPL-3.0-or-later
"""Inputs that a hostile review brought: PostScript, circles of links, names, other terminals."""

from __future__ import annotations

import os
from pathlib import Path

from tests.core.photos.test_formats import EPS
from tests.core.readers.model_writers import Model, ring_model, write_photos
from tests.hostile.case import Build, Case, Group, Needs, Variant, Way
from tests.hostile.inputs import (
    colmap,
    file,
    json_file,
    link,
    photo,
    region,
    renamed,
    steps,
    transforms,
)
from tests.hostile.jobs import begun, status

_PHOTOS = "tests/core/photos/test_formats.py"
_HOSTILE_PHOTOS = "tests/core/loading/test_hostile_folders.py"


def _eps(path: Path) -> None:
    path.write_bytes(EPS)


_POSTSCRIPT = Case(
    55,
    "PostScript named as a photo, which would start Ghostscript",
    (
        Variant(
            "among photos",
            photo("p00.png", _eps),
            0,
            r"1 photos cannot be read .*p00\.png is not a readable photo.*Export it again as JPEG",
        ),
        Variant(
            "among photos, loaded",
            photo("p00.png", _eps),
            0,
            r"1 photos cannot be read and are not used: p00\.png",
            way=Way.LOADING,
            writes=("out",),
        ),
        Variant(
            "as a mask, loaded",
            steps(colmap(), file("set/masks/p00.png", EPS)),
            0,
            r"1 masks were not used: Mask p00\.png",
            way=Way.LOADING,
            writes=("out",),
        ),
    ),
    (
        f"{_PHOTOS}::test_postscript_named_as_a_photo_starts_nothing",
        f"{_PHOTOS}::test_the_texture_of_a_mesh_to_evaluate_starts_nothing",
    ),
)

_CIRCLE = steps(link("set", "other"), link("other", "set"))
_IN_PHOTOS = steps(
    colmap(), link("set/images/p00.png", "p99.png"), link("set/images/p99.png", "p00.png")
)


def _circle(name: str, words: tuple[str, ...], code: int, says: str) -> Variant:
    return Variant(name, _CIRCLE, code, says, words, needs=Needs.POSIX)


_OUT = ("--out", "out", "--no-blend")
_CIRCLES = Case(
    56,
    "Links in a circle",
    (
        Variant(
            "among photos",
            _IN_PHOTOS,
            0,
            r"1 photos cannot be read .*p00\.png is not a file|1 of 6 photos were not found",
            needs=Needs.POSIX,
        ),
        _circle(
            "check", ("check", "set"), 3, "(set|other) does not exist.*Give a folder of photos"
        ),
        _circle("wrap", ("wrap", "set", *_OUT), 3, "set does not exist.*Check the path"),
        _circle("estimate", ("estimate", "set"), 3, "set does not exist.*Check the path"),
        _circle("status", ("status", "set"), 2, "set holds no job.*Choose a job folder"),
        _circle("resume", ("resume", "set", "--no-blend"), 2, "does not exist.*Choose a folder"),
        _circle("mesh", ("mesh", "--out", "set", "--no-blend"), 2, "does not exist.*Choose"),
        _circle("run-part", ("run-part", "set", "train"), 1, "set is not a job folder.*Give the"),
        Variant(
            "as a region",
            steps(colmap(), link("a.json", "b.json"), link("b.json", "a.json")),
            3,
            r"Region file a\.json does not exist.*Check the path",
            ("wrap", "set", "--region", "a.json", *_OUT),
            needs=Needs.POSIX,
        ),
        Variant(
            "as --out",
            steps(colmap(), link("a", "b"), link("b", "a")),
            4,
            "(a|b) cannot be written: .*Check that the folder exists",
            ("wrap", "set", "--out", "a", "--no-blend"),
            needs=Needs.POSIX,
        ),
    ),
    (
        f"{_HOSTILE_PHOTOS}::test_links_in_a_circle_among_photos_are_left_out",
        "tests/blender/test_found_jobs.py::test_a_file_whose_folders_are_links_in_a_circle_opens",
    ),
)

_UNICODE = "Küche · β"


def _photos_that_are_none(folder: Path) -> None:
    (folder / "set").mkdir()
    for number in range(4):
        (folder / "set" / f"{_UNICODE} {number}.png").write_bytes(b"none")


def _terminal(encoding: str, says: str) -> Variant:
    return Variant(encoding, _photos_that_are_none, 3, says, way=Way.PROCESS, encoding=encoding)


_OUTPUT = "tests/test_terminal_output.py"
_TERMINALS = Case(
    59,
    "Terminals that lack letters; pipes that are closed; full disks",
    (
        _terminal("ascii", r"First: K\\xfcche \\xb7 \\u03b2 0\.png is not a readable photo"),
        _terminal("cp1252", r"First: Küche · \\u03b2 0\.png is not a readable photo"),
        _terminal("utf-8", r"First: Küche · β 0\.png is not a readable photo"),
    ),
    (
        f"{_OUTPUT}::test_a_closed_pipe_is_no_failure_of_the_command",
        f"{_OUTPUT}::test_output_that_cannot_be_written_is_code_4",
        f"{_OUTPUT}::test_without_a_terminal_nothing_is_said",
        f"{_OUTPUT}::test_a_log_on_a_full_disk_is_silent",
    ),
)

_LONG = f"{'x' * 300}.png"


def _renamed_last(name: str) -> Build:
    def change(model: Model) -> None:
        model.images[-1].name = name

    return colmap(change)


def _long_text(folder: Path) -> None:
    def change(model: Model) -> None:
        model.images[-1].name = _LONG

    colmap(change, text=True)(folder)


def _long_frame(values: dict) -> None:
    values["frames"][-1]["file_path"] = f"images/{_LONG}"


_NOT_FOUND = "1 of 6 photos were not found, such as xxx"
_LONG_NAMES = Case(
    60,
    "Names of photos that are longer than any file system stores",
    (
        Variant("COLMAP, binary", _renamed_last(_LONG), 0, _NOT_FOUND),
        Variant("COLMAP, text", _long_text, 0, _NOT_FOUND),
        Variant("transforms.json", transforms(_long_frame), 0, "images/xxx"),
        Variant(
            "2000 characters", _renamed_last("x" * 2000), 0, "left out for an unsafe name: 'xxx"
        ),
    ),
    (f"{_HOSTILE_PHOTOS}::test_an_over_long_name_is_left_out_and_named",),
)

_LINKED = "tests/core/loading/test_hostile_folders.py"


def _elsewhere(build: Build) -> Build:
    return steps(
        build, renamed("set/images", "another disk"), link("set/images", "../another disk")
    )


_LINKED_FOLDERS = Case(
    69,
    "Folders of photos that are links",
    (
        Variant("COLMAP", _elsewhere(colmap()), 0, "6 photos: 6 of", needs=Needs.POSIX),
        Variant("transforms", _elsewhere(transforms()), 0, "6 photos: 6 of", needs=Needs.POSIX),
    ),
    (f"{_LINKED}::test_what_leads_out_of_a_linked_folder_is_not_taken",),
)

_EVIL = "a\x1b]0;owned\x07\x1b[2J\r\nerror: b"
_CODES = r"a\\x1b\]0;owned\\x07\\x1b\[2J\\r\\nerror: b"


def _named_evil(folder: Path) -> None:
    model = ring_model(6, points=120)
    write_photos(model, folder / "set" / "images")
    colmap(lambda model: setattr(model.images[0], "name", _EVIL), photos=False)(folder)


def _evil_photo(folder: Path) -> None:
    colmap()(folder)
    os.rename(folder / "set/images/p00.png", folder / "set/images" / f"{_EVIL}.png")
    (folder / "set" / "images" / f"{_EVIL}.png").write_bytes(b"none")
    colmap(lambda model: setattr(model.images[0], "name", f"{_EVIL}.png"), photos=False)(folder)


def _evil(
    name: str, build: Build, code: int, words: tuple[str, ...], says: str = _CODES
) -> Variant:
    return Variant(name, build, code, says, words, way=Way.TERMINAL, needs=Needs.POSIX)


_CONTROL = Case(
    70,
    "Escape sequences and newlines in names, in a terminal",
    (
        _evil("of a photo in a model", _named_evil, 0, ("check", "set")),
        _evil("of a photo on the disk", _evil_photo, 0, ("check", "set")),
        _evil(
            "of a frame",
            transforms(lambda values: values["frames"][0].update(file_path=f"../{_EVIL}")),
            0,
            ("check", "set"),
        ),
        _evil("of the input", lambda folder: None, 3, ("check", _EVIL)),
        _evil("of an option", lambda folder: None, 2, ("check", "set", f"--{_EVIL}")),
        _evil(
            "of a region",
            steps(
                colmap(),
                json_file("a.json", region(blender_object_name=_EVIL)),
                json_file("b.json", region(blender_object_name=_EVIL)),
            ),
            2,
            ("wrap", "set", "--region", "a.json", "b.json", *_OUT),
            "Two regions have the same name, a",
        ),
        _evil(
            "in a status",
            steps(begun, status(state="FAILED", stage=_EVIL, error=_EVIL, hint=_EVIL)),
            0,
            ("status", "out"),
        ),
        _evil(
            "of an entry of a job",
            steps(begun, link(f"out/{_EVIL}", "x")),
            3,
            ("resume", "out", "--no-blend"),
        ),
        _evil(
            "in COLMAP text",
            steps(
                colmap(text=True),
                file("set/sparse/0/cameras.txt", f"1 {_EVIL[:12]} 64 48 60 32 24\n"),
            ),
            3,
            ("check", "set"),
            r"camera model a\\x1b\]0;owned\\x07\\x1b is not supported.*Convert the photos",
        ),
    ),
    ("tests/core/jobs/store/test_hostile_folders.py::test_names_cannot_forge_lines_of_the_log",),
)

_AGREES = Case(
    61,
    "What loading refuses, check refuses",
    (),
    (
        "tests/core/loading/test_hostile_folders.py::test_the_check_refuses_what_loading_refuses",
        "tests/hostile/test_check_agrees.py::test_what_check_passes_is_loaded",
    ),
)

GROUP = Group(
    "Findings",
    (_POSTSCRIPT, _CIRCLES, _TERMINALS, _LONG_NAMES, _LINKED_FOLDERS, _CONTROL, _AGREES),
)
