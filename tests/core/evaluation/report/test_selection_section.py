# SPDX-License-Identifier: GPL-3.0-or-later
"""The report lists each decision with its evidence and how to override it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.evaluation.report.report import report_markdown, selection_lines
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.model_selection import Decision, ModelSelection, decide
from tests.core.evaluation.report.report_examples import full_summary

NAMES = ("exposure", "multi_view", "growth", "full_size", "dense_start", "refine_poses")


def training() -> dict[str, Any]:
    model_selection = ModelSelection()
    for name in NAMES:
        model_selection = model_selection.with_decision(
            decide(name, "auto", True, f"Seen in {name} a|b.")
        )
    model_selection = model_selection.with_decision(
        decide("exposure", "off", True, "Photos differ by 20 %.")
    )
    return {"decisions": model_selection.to_json()}


def test_every_decision_is_listed_with_its_evidence_and_setting() -> None:
    text = "\n".join(selection_lines(training()))
    for name in NAMES:
        if name != "exposure":
            assert f"Seen in {name.replace('_', chr(92) + '_')} a\\|b." in text
        assert f"setting `{name}`" in text
        assert name in TrainingSettings.__dataclass_fields__
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + len(NAMES)
    assert text.count("*To change this:*") == len(NAMES)


def test_what_a_person_decided_is_told_apart() -> None:
    text = "\n".join(selection_lines(training()))
    assert "| off | you (off) |" in text
    assert text.count("| the photos |") == len(NAMES) - 1
    assert "Set by you. Evidence from the photos: Photos differ by 20 %." in text
    assert text.count('"auto" chooses from the photos') == 1


def test_where_nothing_was_measured_the_photos_say_nothing() -> None:
    evidence = "The settings decide."
    decision = Decision("growth", "off", "off", evidence, measured=False)
    stored = Decision.from_json(json.loads(json.dumps(decision.to_json())))
    assert stored == decision
    text = "\n".join(selection_lines({"decisions": [stored.to_json()]}))
    assert f"{evidence}\n" in text
    assert "Set by you" not in text
    values = decision.to_json()
    del values["measured"]  # as version 0.1.0 wrote it
    assert Decision.from_json(values).measured
    text = "\n".join(selection_lines({"decisions": [values]}))
    assert f"Set by you. Evidence from the photos: {evidence}" in text


def test_the_section_stands_between_training_and_regions() -> None:
    summary = full_summary()
    summary["training"] |= training()
    text = report_markdown(summary, Path("nowhere"))
    order = [text.index(f"\n## {title}") for title in ("Training", "Model selection", "Warnings")]
    assert order == sorted(order)
    assert "## Model selection" not in report_markdown(full_summary(), Path("nowhere"))


@pytest.mark.parametrize("decisions", [None, 3, "x", [], [None, 3, {}, {"chosen": "on"}]])
def test_nothing_is_written_where_nothing_was_decided(decisions: Any) -> None:
    assert selection_lines({"decisions": decisions}) == []


def test_an_unknown_decision_is_shown_as_it_is() -> None:
    text = "\n".join(selection_lines({"decisions": [{"name": "new_one", "chosen": "x`y"}]}))
    assert "new\\_one" in text
    assert "x\\`y" in text
    assert "No evidence was recorded" in text
