# SPDX-License-Identifier: GPL-3.0-or-later
"""Findings about sets of made photos: each with a set that has the fault and one that has not."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, uniform_filter1d

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, EXIT_DONE, Cancelled
from gaussian_wrapping_addon.core.jobs.commands import photo_check_command
from gaussian_wrapping_addon.core.loading import check
from gaussian_wrapping_addon.core.loading.check import Finding
from gaussian_wrapping_addon.core.loading.photo_quality import (
    MEASURED_PX,
    beside,
    photo_findings,
    reduced_grey,
    sharpness_of,
)
from gaussian_wrapping_addon.core.photos.video import ProbedVideo
from gaussian_wrapping_addon.core.progress import Progress

COUNT = 12


@functools.cache
def wall() -> np.ndarray:
    """A wide wall of patches and edges, (480, 2000) in 0 to 255."""
    rng = np.random.default_rng(4)
    pixels = np.full((480, 2000), 128.0)
    for _ in range(900):
        x, y, w, h = rng.integers(0, (1950, 440, 80, 60))
        pixels[y : y + h, x : x + w] = rng.uniform(30, 225)
    return gaussian_filter(pixels, 0.6)


def view(k: int) -> np.ndarray:
    """Photo k of a walk along the wall, 30 pixels a step."""
    return wall()[:, 30 * k : 30 * k + 640].copy()


def save(folder: Path, photos: list[np.ndarray], suffix: str = "jpg") -> Path:
    folder.mkdir()
    for k, pixels in enumerate(photos):
        image = Image.fromarray(np.clip(np.rint(pixels), 0, 255).astype(np.uint8)).convert("RGB")
        image.save(folder / f"p{k:02d}.{suffix}", quality=92)
    return folder


def walk() -> list[np.ndarray]:
    return [view(k) for k in range(COUNT)]


def found(folder: Path, words: str) -> list[Finding]:
    findings = photo_findings(folder, Progress(), threads=1)
    return [f for f in findings if words in f.message]


def test_a_good_set_is_not_spoken_of(tmp_path: Path) -> None:
    (fact,) = photo_findings(save(tmp_path / "set", walk()), Progress(), threads=1)
    assert fact.severity == "fact"
    assert "mean light differs by 0." in fact.message


@pytest.mark.parametrize("how", ["focus", "moved across", "moved along"])
def test_blurred_photos_are_named(tmp_path: Path, how: str) -> None:
    photos = walk()
    for k in (3, 8):
        if how == "focus":
            photos[k] = gaussian_filter(photos[k], 2.5)
        else:
            photos[k] = uniform_filter1d(photos[k], 11, axis=int(how == "moved across"))
    (finding,) = found(save(tmp_path / "set", photos), "less sharp")
    assert finding.message.startswith("2 photos are much less sharp")
    assert "p03.jpg, p08.jpg." in finding.message
    assert finding.hint


def test_a_blurred_background_is_no_fault(tmp_path: Path) -> None:
    photos = walk()
    soft = gaussian_filter(photos[5], 4)
    soft[120:360, 160:480] = photos[5][120:360, 160:480]
    photos[5] = soft
    assert found(save(tmp_path / "set", photos), "less sharp") == []


def test_sharpness_does_not_depend_on_contrast_or_exposure() -> None:
    sharp = sharpness_of(view(0).astype(np.float32))
    assert sharpness_of((0.3 * view(0) + 20).astype(np.float32)) == pytest.approx(sharp, rel=0.05)
    assert sharpness_of(gaussian_filter(view(0), 2).astype(np.float32)) < 0.4 * sharp
    assert np.isnan(sharpness_of(np.full((480, 640), 99, np.float32)))
    assert np.isnan(sharpness_of(np.zeros((20, 30), np.float32)))


@pytest.mark.parametrize("stops", [-1.5, 1.3])
def test_jumps_of_exposure_are_named(tmp_path: Path, stops: float) -> None:
    photos = [0.6 * pixels for pixels in walk()]
    photos[6] = photos[6] * 2 ** (stops / 2.2)
    folder = save(tmp_path / "set", photos)
    (finding,) = found(folder, "brighter or darker")
    name, _, value = finding.message.rpartition(": ")[2].rstrip(".").rpartition(" ")
    assert name == "p06.jpg"
    assert float(value.strip("()")) == pytest.approx(stops, abs=0.35)


def test_light_that_changes_slowly_is_a_spread_not_a_jump(tmp_path: Path) -> None:
    photos = [p * 2 ** (-3.5 * k / COUNT / 2.2) for k, p in enumerate(walk())]
    folder = save(tmp_path / "set", photos)
    assert found(folder, "brighter or darker") == []
    (spread,) = found(folder, "mean light")
    assert spread.severity == "warning"
    assert "from p11.jpg to p00.jpg" in spread.message


def test_the_same_again_is_named(tmp_path: Path) -> None:
    photos = walk()
    noise = np.random.default_rng(0).normal(0, 2, photos[0].shape)
    photos += [photos[2], 0.8 * photos[4] + noise, view(COUNT)]
    (finding,) = found(save(tmp_path / "set", photos), "the same as another")
    assert finding.message == (
        "2 photos are the same as another one: p12.jpg (as p02.jpg), p13.jpg (as p04.jpg)."
    )
    # A step of half a percent is another photo.
    photos = [wall()[:, 4 * k : 4 * k + 640] for k in range(COUNT)]
    assert found(save(tmp_path / "steps", photos), "the same") == []


@pytest.mark.parametrize("orientation", [1, 6])
def test_large_photos_are_measured_at_a_reduced_size(tmp_path: Path, orientation: int) -> None:
    big = np.kron(wall()[:, :640], np.ones((5, 5)))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "a.jpg"
    Image.fromarray(big.astype(np.uint8)).convert("RGB").save(path, quality=92, exif=exif)
    grey = reduced_grey(path)
    wanted = (768, MEASURED_PX) if orientation == 1 else (MEASURED_PX, 768)
    assert grey.shape == wanted
    image = Image.fromarray(big.astype(np.float32)).resize((1024, 768), Image.Resampling.BOX)
    full = np.asarray(image) if orientation == 1 else np.asarray(image)[::-1].T
    assert np.abs(grey - full).mean() < 3


def test_photos_are_compared_with_those_beside() -> None:
    values = np.arange(20.0)
    values[5] = np.nan
    around = beside(values)
    assert around[0] == np.median([1, 2, 3, 4, 6, 7, 8])
    assert around[10] == np.median([6, 7, 8, 9, 11, 12, 13, 14])
    assert around[19] == np.median(np.arange(11, 19))
    assert np.isfinite(around).all()


def test_inputs_without_photos_are_not_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    video = tmp_path / "clip.mp4"
    video.write_bytes(b"\0\0\0\x18ftypisom")
    assert photo_findings(video, Progress(), threads=1) == []
    assert photo_findings(tmp_path, Progress(), threads=1) == [], "a folder with a video"
    probed = ProbedVideo(320, 240, 30, 1.0, "h264", False, False)
    monkeypatch.setattr(check, "probe_video", lambda *_: probed)
    assert batch.main(["check", str(video)]) == EXIT_DONE
    said = capsys.readouterr().out
    assert "fact: clip.mp4: 1 s, 30 frames" in said
    assert "All photos were looked at" not in said


def test_the_worker_and_the_command_line_say_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = walk()
    photos[3] = gaussian_filter(photos[3], 3)
    folder = save(tmp_path / "set", photos)
    request = {"source": str(folder), "threads": 1}
    assert photo_check_command.main([json.dumps(request)]) == EXIT_DONE
    said = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    told = [values["finding"] for values in said if "finding" in values]
    assert [f["severity"] for f in told] == ["warning", "fact"]
    line = "warning: 1 photo is much less sharp than the photos beside: p03.jpg."
    assert any(values.get("line", "").startswith(line) for values in said)
    request["source"] = str(tmp_path / "none")
    assert photo_check_command.main([json.dumps(request)]) == EXIT_BAD_DATA
    assert "does not exist" in capsys.readouterr().out
    assert batch.main(["check", str(folder), "--threads", "1"]) == EXIT_DONE
    assert line in capsys.readouterr().out
    assert batch.main(["check", str(folder), "--quick"]) == EXIT_DONE
    assert "less sharp" not in capsys.readouterr().out
    with pytest.raises(Cancelled):
        photo_findings(folder, Progress(is_cancelled=lambda: True), threads=1)
