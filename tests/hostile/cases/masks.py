# SPDX-License-Identifier: GPL-3.0-or-later
"""Made masks: regions that are missing, models that are none."""

from __future__ import annotations

from pathlib import Path

from gaussian_wrapping_addon.core.limits import MAX_MODEL_BYTES
from tests.core.masks import onnx_files
from tests.hostile.case import Build, Case, Group, Needs, Variant
from tests.hostile.inputs import colmap, file, json_file, link, region, steps

_WORDS = ("wrap", "set", "--set", "mask_model=model.onnx", "--out", "out", "--no-blend")
_STAGE = "tests/core/jobs/stages/test_masks_stage.py"
_MODEL = "tests/core/masks/test_segmentation_model.py"


def _huge(folder: Path) -> None:
    with (folder / "model.onnx").open("wb") as stream:
        stream.truncate(MAX_MODEL_BYTES + 1)  # takes no room on the disk


def _model(name: str, build: Build, says: str, code: int = 3, *, starts: bool = False) -> Variant:
    writes = ("out",) if starts else ()
    return Variant(name, steps(colmap(), build), code, says, _WORDS, writes=writes, starts=starts)


_MODELS = Case(
    71,
    "Mask models that are none",
    (
        _model("missing", colmap(), r"mask model model\.onnx is not there.*Check the path"),
        _model("empty", file("model.onnx"), r"mask model model\.onnx is empty"),
        _model("2 GiB and a byte", _huge, "2 GiB are the limit", 4),
        _model(
            "text", file("model.onnx", "no model"), "cannot be read as an ONNX model", starts=True
        ),
        _model(
            "of another shape",
            file("model.onnx", onnx_files.same_shape((1, 3))),
            r"takes \[1, 3\], not",
            starts=True,
        ),
        Variant(
            "/dev/zero",
            steps(colmap(), link("model.onnx", "/dev/zero")),
            3,
            "is not there, or no file",
            _WORDS,
            needs=Needs.POSIX,
        ),
        Variant(
            "and a region",
            steps(
                colmap(),
                file("model.onnx", onnx_files.brightness()),
                json_file("box.json", region()),
            ),
            2,
            "regions or by a model, not both",
            (*_WORDS, "--make-masks", "region", "--region", "box.json"),
        ),
    ),
    (
        f"{_MODEL}::test_what_is_no_such_model_is_refused",
        f"{_MODEL}::test_what_it_gives_is_checked",
        f"{_STAGE}::test_a_model_that_is_none_is_refused_before_photos_are_read",
    ),
)

_REGIONS = Case(
    72,
    "Masks of no region",
    (
        Variant(
            "the automatic one",
            colmap(),
            2,
            r"need a region file.*Give --region REGION\.json",
            ("wrap", "set", "--make-masks", "region", "--out", "out", "--no-blend"),
        ),
    ),
    (f"{_STAGE}::test_a_region_with_nothing_in_it_is_refused",),
)

GROUP = Group("Made masks", (_MODELS, _REGIONS))
