# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings: presets, ranges, JSON."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.settings import (
    PRESETS,
    JobSettings,
    MeshingSettings,
    TrainingSettings,
    declarations,
    declared,
    from_json,
    key_values,
    preset,
    to_json,
)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_json(name: str) -> None:
    settings = preset(name).validated()
    assert from_json(JobSettings, to_json(settings)) == settings


def test_an_excluded_end_of_a_range_is_said() -> None:
    check = declared("training.prune_share").check
    assert check is not None
    assert not check.holds(0.5)
    assert check.wanted == "from 0 to below 0.5"


def test_presets_grow() -> None:
    draft, standard, fine = (preset(n).training for n in ("draft", "standard", "fine"))
    for name in ("iterations", "max_gaussians", "max_image_px"):
        assert getattr(draft, name) < getattr(standard, name) < getattr(fine, name)


def test_unknown_preset_is_refused() -> None:
    with pytest.raises(UsageError, match="huge"):
        preset("huge")


@pytest.mark.parametrize(
    "change",
    [
        {"threads": -1}, {"seed": -1}, {"regions": ()}, {"export": ("stl",)},
        {"meshing": MeshingSettings(edge_length=float("nan"))},
        {"meshing": MeshingSettings(edge_length=-1.0)},
        {"meshing": MeshingSettings(points=-5)},
        {"meshing": MeshingSettings(target_faces=3)},
        {"meshing": MeshingSettings(target_faces=-1)},
        {"meshing": MeshingSettings(smooth_steps=-1)},
        {"meshing": MeshingSettings(smooth_steps=1001)},
        {"meshing": MeshingSettings(min_component_share=float("nan"))},
        {"meshing": MeshingSettings(min_component_share=1.5)},
        {"meshing": MeshingSettings(method="poisson")},
        {"meshing": MeshingSettings(pivots=4)},
        {"meshing": MeshingSettings(boundary="ajar")},
        {"meshing": MeshingSettings(unseen="invalid")},
        {"meshing": MeshingSettings(spacing="dense")},
    ],
)  # fmt: skip
def test_values_out_of_range_are_named(change: dict) -> None:
    with pytest.raises(UsageError, match=next(iter(change))):
        replace(JobSettings(), **change).validated()


def test_every_training_setting_is_a_plain_number_or_a_word() -> None:
    training = preset("draft").training
    assert all(isinstance(getattr(training, f.name), (int, float, str)) for f in fields(training))


@pytest.mark.parametrize("name", ["exposure", "multi_view", "growth", "harmonics", "wrapping"])
def test_what_a_scene_may_need_is_auto_on_or_off(name: str) -> None:
    for word in ("auto", "on", "off"):
        settings = replace(preset("draft"), training=replace(TrainingSettings(), **{name: word}))
        assert settings.validated() is settings
    wrong = replace(preset("draft"), training=replace(TrainingSettings(), **{name: "maybe"}))
    with pytest.raises(UsageError, match=f"training.{name}"):
        wrong.validated()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("wrap_rounds", -1), ("wrap_rounds", 100_000), ("holdout_every", -1),
        ("preview_every_s", float("nan")), ("preview_every_s", float("inf")),
        ("preview_every_s", -1.0), ("checkpoint_every_s", float("nan")),
        ("region_weight", 0.5), ("overlap_price", -1.0), ("prune_share", 0.7),
        ("pixels_per_iteration", 3),
    ],
)  # fmt: skip
def test_numbers_that_make_no_sense_are_refused(name: str, value: float) -> None:
    wrong = replace(preset("draft"), training=replace(TrainingSettings(), **{name: value}))
    with pytest.raises(UsageError, match=f"training.{name}"):
        wrong.validated()


def test_keys_hold_what_decides_about_the_result_and_is_not_a_later_default() -> None:
    settings = TrainingSettings()
    held = key_values(settings)
    assert "preview_every_s" not in held  # has no influence
    later = {d.name for d in declarations(TrainingSettings) if d.since}
    assert "filter_variance" in later
    assert not later & set(held)
    assert later | set(held) | {"checkpoint_every_s", "preview_every_s"} == set(to_json(settings))
    other = key_values(replace(settings, filter_variance=0.2))
    assert other == {**held, "filter_variance": 0.2}


def test_trainings_of_the_first_version_keep_their_keys() -> None:
    """Else a finished training of 0.1.0 would be made again."""
    path = Path(__file__).parents[1] / "data" / "job-0.1.0" / "job" / "job.json"
    stored = json.loads(path.read_text(encoding="utf-8"))["settings"]["training"]
    independent = {"checkpoint_every_s", "preview_every_s"}
    held = key_values(from_json(TrainingSettings, stored))
    assert held == {name: value for name, value in stored.items() if name not in independent}


def test_paper_has_the_published_constants() -> None:
    paper = preset("paper").training
    assert (paper.iterations, paper.sh_degree, paper.wrap_rounds) == (30_000, 3, 5)
    weights = (
        paper.lambda_dssim, paper.lambda_depth_normal, paper.lambda_normal,
        paper.lambda_photometric, paper.lambda_geometric,
    )  # fmt: skip
    assert weights == (0.2, 0.05, 0.05, 0.6, 0.02)
    at = {
        name: round(getattr(paper, name) * paper.iterations)
        for name in (
            "densify_from", "depth_from", "densify_until", "orient_from", "wrap_from", "wrap_until",
            "degree_every",
        )
    }  # fmt: skip
    assert list(at.values()) == [500, 7000, 15_000, 20_000, 22_000, 26_000, 1000]
    assert (paper.filter_variance, paper.overlap_price, paper.prune_share) == (0.2, 0.0, 0.0)
