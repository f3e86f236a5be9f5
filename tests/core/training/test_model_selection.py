# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: decisions with evidence, their order, overriding settings."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.training.model_selection import (
    Decision,
    ModelSelection,
    decide,
    select_multi_view,
)


def test_json_gives_back_the_same_decisions_in_order() -> None:
    model_selection = ModelSelection()
    for name in ("growth", "exposure", "harmonics"):
        model_selection = model_selection.with_decision(
            decide(name, "auto", True, "Because of 3.", {"a": 3.0})
        )
    values = json.loads(json.dumps(model_selection.to_json(), allow_nan=False))
    assert ModelSelection.from_json(values) == model_selection
    assert [d.name for d in model_selection] == ["growth", "exposure", "harmonics"]


def test_a_later_decision_takes_the_place_of_the_earlier() -> None:
    model_selection = (
        ModelSelection()
        .with_decision(decide("a", "auto", True, ""))
        .with_decision(decide("b", "auto", True, ""))
    )
    changed = model_selection.with_decision(decide("a", "auto", False, "now"))
    assert [(d.name, d.chosen) for d in changed] == [("a", "off"), ("b", "on")]
    assert model_selection.chose("a")
    assert not changed.chose("a")
    assert changed.chose("a", "off")
    assert not changed.chose("c")
    assert changed.get("c") is None
    assert len(changed) == 2


@pytest.mark.parametrize("needed", [True, False])
def test_the_setting_overrides_and_the_evidence_stays(needed: bool) -> None:
    assert decide("a", "auto", needed, "why").chosen == ("on" if needed else "off")
    for setting in ("on", "off"):
        decision = decide("a", setting, needed, "why")
        assert decision.chosen == setting
        assert decision.setting == setting
        assert decision.evidence == "why"
    with pytest.raises(UsageError, match="maybe"):
        decide("a", "maybe", needed, "why")


def test_figures_that_are_not_finite_are_left_out_of_json() -> None:
    decision = decide("a", "auto", True, "", {"a": math.nan, "b": math.inf, "c": 1.0})
    assert decision.to_json()["figures"] == {"c": 1.0}


@pytest.mark.parametrize(
    "values",
    [
        *(None, 3, {}, [3], [{"name": "a"}]),
        [{**decide("a", "on", True, "").to_json(), "chosen": 1}],
    ],
)
def test_other_json_is_refused(values: object) -> None:
    with pytest.raises(UsageError):
        ModelSelection.from_json(values)
    with pytest.raises(UsageError):
        Decision.from_json(values)


def test_multi_view_is_on_where_any_photo_has_a_neighbour() -> None:
    none, some = np.zeros(0, np.int64), np.array([1, 2])
    found = select_multi_view([some, none, none, some])
    assert found.chosen == "on"
    assert found.figures["share_with_neighbour"] == 0.5
    assert found.figures["neighbours_per_photo"] == 1.0
    assert "2 of 4 photos" in found.evidence
    assert select_multi_view([some], "off").chosen == "off"
    for setting in ("auto", "on", "off"):
        assert select_multi_view([none, none], setting).chosen == "off"
    assert select_multi_view([]).chosen == "off"
