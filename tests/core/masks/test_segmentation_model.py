# SPDX-License-Identifier: GPL-3.0-or-later
"""Models that others made: what they give becomes a mask; files that are no models are refused."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError, ResourceError, WorkerError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.limits import MAX_MODEL_BYTES
from gaussian_wrapping_addon.core.masks.segmentation import (
    RANGES,
    USUAL_SIDE_PX,
    SegmentationModel,
    as_shares,
)
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.worker.helper_process import run_helper
from tests.core.masks import onnx_files

pytest.importorskip("onnxruntime")


def photo(width: int = 96, height: int = 64) -> np.ndarray:
    """Return a dark photo with a bright disc left of the middle."""
    y, x = np.mgrid[:height, :width] + 0.5
    bright = (x - width / 3) ** 2 + (y - height / 2) ** 2 < (height / 4) ** 2
    return np.where(bright[..., None], 230, 20).astype(np.uint8) + np.zeros(3, np.uint8)


def model(tmp_path: Path, data: bytes, color_range: str = "unit") -> SegmentationModel:
    path = onnx_files.written(tmp_path / "model.onnx", data)
    return SegmentationModel(path, color_range, threads=1)


@pytest.mark.parametrize("logits", [False, True])
def test_shares_and_logits_give_the_same_mask(tmp_path: Path, logits: bool) -> None:
    made = model(tmp_path, onnx_files.brightness(64, logits=logits))
    assert made.size == (64, 64)
    share = made.share(photo())
    assert share.dtype == np.float32
    small = np.asarray(Image.fromarray(photo()).resize((64, 64), Image.Resampling.BILINEAR))
    assert ((share >= 0.5) == (small[..., 0] >= 128)).all()
    assert 0.0 <= share.min() < 0.2
    assert 0.8 < share.max() <= 1.0


def test_an_open_size_takes_the_usual_one(tmp_path: Path) -> None:
    made = model(tmp_path, onnx_files.brightness("side"))
    assert made.size == (USUAL_SIDE_PX, USUAL_SIDE_PX)
    assert made.share(photo()).shape == (USUAL_SIDE_PX, USUAL_SIDE_PX)


@pytest.mark.parametrize("color_range", sorted(RANGES))
def test_colors_are_normalised_as_the_range_says(tmp_path: Path, color_range: str) -> None:
    made = model(tmp_path, onnx_files.brightness(8, logits=False), color_range)
    mean, deviation = RANGES[color_range]
    grey = np.full((8, 8, 3), 51, np.uint8)  # 0.2
    expected = np.mean([(0.2 - m) / d for m, d in zip(mean, deviation, strict=True)])
    wanted = as_shares(np.full((8, 8), expected, np.float32))
    np.testing.assert_allclose(made.share(grey), wanted, atol=1e-5)


def test_logits_are_told_by_their_range() -> None:
    shares = np.array([[0.0, 1.0 + 5e-4], [-5e-4, 0.25]], np.float32)
    np.testing.assert_array_equal(as_shares(shares), np.clip(shares, 0, 1))
    logits = np.array([[-1000.0, 0.0, 1000.0, 2.0]], np.float32)
    np.testing.assert_allclose(as_shares(logits), [[0, 0.5, 1, 1 / (1 + np.exp(-2))]], atol=1e-6)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\x89PNG\r\n\x1a\n and so on", "cannot be read as an ONNX model"),
        (b"{}", "cannot be read as an ONNX model"),
        (onnx_files.brightness()[:60], "cannot be read as an ONNX model"),
        (onnx_files.same_shape((1, 3)), r"takes \[1, 3\], not \(1, 3, height, width\)"),
        (onnx_files.same_shape((1, 4, 8, 8)), "takes .*, not"),
        (onnx_files.same_shape((2, 3, 8, 8)), "takes 2 photos at once"),
        (onnx_files.same_shape((1, 3, 8, 100_000)), "photos of 100000 x 8 pixels"),
        (onnx_files.same_shape((1, 3, 8, 8), kind=onnx_files.DOUBLE), "takes 1 inputs"),
        (onnx_files.two_inputs(), "takes 2 inputs"),
    ],
)  # fmt: skip
def test_what_is_no_such_model_is_refused(tmp_path: Path, data: bytes, words: str) -> None:
    begun_s = time.monotonic()
    with pytest.raises(DatasetError, match=words) as caught:
        model(tmp_path, data)
    assert "U2-Net" in caught.value.hint
    assert time.monotonic() - begun_s < 5.0


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (onnx_files.not_a_number(), "not finite"),
        (onnx_files.same_shape((1, 3, 8, 8)), r"float32 of shape \(1, 3, 8, 8\)"),
    ],
)
def test_what_it_gives_is_checked(tmp_path: Path, data: bytes, words: str) -> None:
    made = model(tmp_path, data)
    with pytest.raises(DatasetError, match=words):
        made.share(photo())


def test_missing_empty_and_huge_files_are_refused_unread(tmp_path: Path) -> None:
    for path, words in (
        (tmp_path / "none.onnx", "is not there"),
        (tmp_path, "is not there, or no file"),
        (onnx_files.written(tmp_path / "empty.onnx", b""), "is empty"),
    ):
        with pytest.raises(DatasetError, match=words):
            SegmentationModel(path, "unit")
    huge = tmp_path / "huge.onnx"
    with huge.open("wb") as stream:
        stream.truncate(MAX_MODEL_BYTES + 1)  # takes no room on the disk
    with pytest.raises(ResourceError, match=r"2\.0 GiB; 2 GiB are the limit"):
        SegmentationModel(huge, "unit")


def test_without_the_package_the_next_step_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(WorkerError, match=r"model\.onnx: the worker has no package") as caught:
        model(tmp_path, onnx_files.brightness())
    assert "set-up-worker --add masks" in caught.value.hint


def test_the_helper_masks_all_photos_and_keeps_what_is_there(tmp_path: Path) -> None:
    path = onnx_files.written(tmp_path / "model.onnx", onnx_files.brightness(64))
    photos = []
    for index, size in enumerate(((96, 64), (64, 96), (300, 200))):
        photos.append(str(tmp_path / f"photo-{index}.png"))
        Image.fromarray(photo(*size)).save(photos[-1])
    kept = tmp_path / "000001.png"
    kept.write_bytes(b"made before")
    task = {"model": str(path), "range": "unit", "threads": 1, "photos": photos}
    write_json(tmp_path / "task.json", task)
    fractions: list[float] = []
    progress = Progress("masks", lambda event: fractions.append(event.fraction), lambda: False)
    run_helper("masks.model_helper", tmp_path, progress, deadline_s=60.0)
    assert kept.read_bytes() == b"made before"
    assert fractions[-1] == 1.0
    for index, size in ((0, (96, 64)), (2, (300, 200))):
        with Image.open(tmp_path / f"{index:06d}.png") as image:
            mask = np.asarray(image) == 255
        bright = photo(*size)[..., 0] > 128
        assert mask.shape == bright.shape
        assert (mask & bright).sum() / (mask | bright).sum() >= 0.97
