# SPDX-License-Identifier: GPL-3.0-or-later
"""LPIPS with random weights of the right shapes; the real ones are not in the repository."""

from __future__ import annotations

import importlib.util
import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core import image_metrics as module
from gaussian_wrapping_addon.core.errors import ParseError, ResourceError, UsageError
from gaussian_wrapping_addon.core.image_metrics import (
    MIN_SIDE_PX,
    WEIGHTS_VARIABLE,
    Lpips,
    lpips_if_ready,
    lpips_ready,
)
from tests.core.evaluation.views.lpips_weights import BACKBONE, HEADS, State, random_states, write


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder that is the only place where weights are looked for."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "no_cache"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path))
    return tmp_path


def pictures(height: int = 40, width: int = 52) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(1)
    photo = generator.integers(0, 256, (height, width, 3), dtype=np.uint8)
    noise = generator.normal(0, 20, photo.shape)
    return (photo + noise).clip(0, 255).astype(np.uint8), photo


def test_equal_pictures_have_distance_0_and_others_more(places: Path) -> None:
    write(places, *random_states())
    assert lpips_ready() == (True, "")
    metric = Lpips.load()
    image, photo = pictures()
    assert metric.distance(photo, photo) == 0.0
    near = metric.distance(image, photo)
    assert near > 1e-4
    assert metric.distance(photo, image) == pytest.approx(near, rel=1e-6)
    assert metric.distance(255 - photo, photo) > near
    # 8-bit pictures and floats agree; what a display cannot show is clamped.
    assert metric.distance(image / 255.0, photo) == pytest.approx(near, rel=1e-5)
    assert metric.distance(np.full((40, 40, 3), 1.5), np.ones((40, 40, 3))) == 0.0


def test_the_network_is_its_definition(places: Path) -> None:
    """Against plain float64 loops over the definition: convolutions as sums of shifted pictures."""
    backbone, heads = random_states(3)
    write(places, backbone, heads)
    image, photo = pictures(35, 31)
    assert Lpips.load().distance(image, photo) == pytest.approx(
        naive(image, photo, backbone, heads), rel=2e-4
    )


def naive(image: np.ndarray, photo: np.ndarray, backbone: State, heads: State) -> float:
    def convolve(x: np.ndarray, index: int, stride: int, padding: int) -> np.ndarray:
        weight = backbone[f"features.{index}.weight"].double().numpy()
        x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
        side = weight.shape[2]
        rows, columns = ((n - side) // stride + 1 for n in x.shape[1:])
        total = np.zeros((len(weight), rows, columns))
        for i in range(side):
            for j in range(side):
                part = x[:, i : i + stride * rows : stride, j : j + stride * columns : stride]
                total += np.einsum("oc,chw->ohw", weight[:, :, i, j], part[:, :rows, :columns])
        bias = backbone[f"features.{index}.bias"].double().numpy()
        return np.maximum(total + bias[:, None, None], 0.0)

    def shrink(x: np.ndarray) -> np.ndarray:
        rows, columns = ((n - 3) // 2 + 1 for n in x.shape[1:])
        out = np.empty((len(x), rows, columns))
        for i, j in np.ndindex(rows, columns):
            out[:, i, j] = x[:, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3].max(axis=(1, 2))
        return out

    def features(picture: np.ndarray) -> list[np.ndarray]:
        signed = 2.0 * picture / 255.0 - 1.0  # as the paper's code takes them: -1 to 1
        x = (signed - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        one = convolve(x.transpose(2, 0, 1), 0, 4, 2)
        two = convolve(shrink(one), 3, 1, 2)
        three = convolve(shrink(two), 6, 1, 1)
        four = convolve(three, 8, 1, 1)
        return [one, two, three, four, convolve(four, 10, 1, 1)]

    total = 0.0
    for layer, (a, b) in enumerate(zip(features(image), features(photo), strict=True)):
        a, b = (x / (np.sqrt((x**2).sum(0)) + 1e-10) for x in (a, b))
        head = heads[f"lin{layer}.model.1.weight"].double().numpy()[0]
        total += ((a - b) ** 2 * head).sum(0).mean()
    return total


def test_a_value_worked_out_by_hand(places: Path) -> None:
    """Only biases: every unit feature is known, and only channels that differ count."""
    backbone, heads = random_states()
    for value in [*backbone.values(), *heads.values()]:
        value.zero_()
    # Channel 0 of the first layer is red where it is positive, channel 1 is always 1.
    backbone["features.0.weight"][0, 0, 5, 5] = 0.229
    backbone["features.0.bias"][0] = 0.485
    backbone["features.0.bias"][1] = 1.0
    heads["lin0.model.1.weight"][0, 0] = 3.0
    heads["lin0.model.1.weight"][0, 1] = 5.0
    write(places, backbone, heads)
    black, red = np.zeros((40, 40, 3)), np.zeros((40, 40, 3))
    red[..., 0] = 0.75
    # Features: (0, 1) and (0.75, 1) / 1.25 = (0.6, 0.8).
    expected = 3.0 * 0.6**2 + 5.0 * 0.2**2
    assert Lpips.load().distance(black, red) == pytest.approx(expected, rel=1e-6)


def test_missing_weights_are_a_reason_not_an_error(places: Path) -> None:
    ready, reason = lpips_ready()
    assert not ready
    for words in ("alexnet-owt", "alex.pth", WEIGHTS_VARIABLE, "nothing is downloaded"):
        assert words in reason
    assert lpips_if_ready() == (None, reason)
    with pytest.raises(ResourceError, match="AlexNet"):
        Lpips.load()
    torch.save(random_states()[0], places / BACKBONE)
    ready, reason = lpips_ready()
    assert not ready
    assert "AlexNet" not in reason


def test_the_usual_places_are_found(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cache of torch's hub, and the folder of the package lpips, which is not imported."""
    monkeypatch.delenv(WEIGHTS_VARIABLE)
    cache, package = places / "no_cache" / "hub" / "checkpoints", places / "lpips"
    cache.mkdir(parents=True)
    (package / "weights" / "v0.1").mkdir(parents=True)
    backbone, heads = random_states()
    torch.save(backbone, cache / BACKBONE)
    torch.save(heads, package / "weights" / "v0.1" / HEADS)
    assert not lpips_ready()[0]
    found = importlib.machinery.ModuleSpec("lpips", None, origin=str(package / "__init__.py"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: found)
    assert lpips_ready() == (True, "")
    assert torch.equal(Lpips.load().heads[4], heads["lin4.model.1.weight"])


def test_single_files_may_be_named(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(places, *random_states())
    both = os.pathsep.join([str(places / HEADS), str(places / BACKBONE)])
    monkeypatch.setenv(WEIGHTS_VARIABLE, both)
    assert lpips_ready()[0]
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(places / HEADS))
    assert not lpips_ready()[0]


@pytest.mark.parametrize("name", [BACKBONE, HEADS])
def test_a_truncated_file_is_named(places: Path, name: str) -> None:
    write(places, *random_states())
    whole = (places / name).read_bytes()
    for kept in (0, 100, len(whole) // 2, len(whole) - 50):
        (places / name).write_bytes(whole[:kept])
        with pytest.raises(ParseError, match=name):
            Lpips.load()
        metric, reason = lpips_if_ready()
        assert metric is None
        assert name in reason


def test_code_in_a_file_of_weights_does_not_run(places: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.mkdir, (str(places / "harm"),)

    backbone, heads = random_states()
    write(places, backbone, heads)
    torch.save({"lin0.model.1.weight": Harm()}, places / HEADS)
    with pytest.raises(ParseError, match=HEADS):
        Lpips.load()
    assert not (places / "harm").exists()


@pytest.mark.parametrize("change", ["absent", "shape", "nan", "negative", "list"])
def test_wrong_weights_are_refused(places: Path, change: str) -> None:
    backbone, heads = random_states()
    name = "lin2.model.1.weight"
    if change == "absent":
        del heads[name]
    elif change == "shape":
        heads[name] = heads[name][:, :8]
    elif change == "list":
        heads = [1, 2]
    else:
        heads[name][0, 5] = math.nan if change == "nan" else -1.0
    write(places, backbone, heads)
    with pytest.raises(ParseError, match="named" if change == "list" else "lin2"):
        Lpips.load()


def test_huge_files_are_refused(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(places, *random_states())
    monkeypatch.setattr(module, "MAX_FILE_BYTES", 1000)
    with pytest.raises(ParseError, match="too many"):
        Lpips.load()


def test_sizes(places: Path) -> None:
    write(places, *random_states())
    metric = Lpips.load()
    least, small = np.zeros((MIN_SIDE_PX, 50, 3)), np.zeros((MIN_SIDE_PX - 1, 50, 3))
    assert metric.distance(least, least) == 0.0
    assert not metric.fits(small.shape)
    with pytest.raises(UsageError):
        metric.distance(small, small)
    with pytest.raises(UsageError):
        metric.distance(least, np.zeros((50, MIN_SIDE_PX, 3)))
    # Less than the least has no pixel left: it is not refused for nothing.
    pooled = torch.zeros((1, 1, ((MIN_SIDE_PX - 1 + 4 - 11) // 4 + 1 - 3) // 2 + 1, 9))
    with pytest.raises(RuntimeError):
        torch.nn.functional.max_pool2d(pooled, 3, 2)
