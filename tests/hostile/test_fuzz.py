# SPDX-License-Identifier: GPL-3.0-or-later
"""Changed inputs end well or in a typed error with the next step, soon and with little memory.

``python -m tests.hostile.fuzz --seconds N`` goes on for longer.
"""

from __future__ import annotations

import pytest

from gaussian_wrapping_addon.core.errors import ParseError
from tests.hostile.fuzz.campaign import fuzz
from tests.hostile.fuzz.mutations import BYTES, JSON
from tests.hostile.fuzz.targets import TARGETS, Target
from tests.hostile.inputs import file

SEED = 20


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_changed_inputs_end_well_or_in_a_typed_error(target: Target) -> None:
    report = fuzz(target, SEED, inputs=target.budget)
    assert report.failures == []
    assert report.inputs == target.budget
    assert report.ended["read"] > 0


def broken_reader(folder: object) -> None:
    """Fail as a reader would that looks into a file without care."""
    data = (folder / "a").read_bytes()  # type: ignore[operator]
    if len(data) < 4:
        raise ParseError("a", "whole file", "too short.")  # without a next step
    if data != b"good":
        raise KeyError(data)


def test_a_careless_reader_is_found_and_the_failure_can_be_repeated() -> None:
    target = Target("careless", file("a", b"good"), ("a",), BYTES, (broken_reader,), 0)
    report = fuzz(target, 1, inputs=200)
    assert any("KeyError" in failure for failure in report.failures)
    assert any("no next step" in failure for failure in report.failures)
    failure = report.failures[-1]
    number = int(failure.split("--first ")[1].split()[0])
    assert fuzz(target, 1, first=number, inputs=1).failures == [failure]


def test_json_mutations_keep_json_of_any_kind() -> None:
    target = Target("json", file("a", b"[]"), ("a",), JSON, (lambda folder: None,), 0)
    assert fuzz(target, 0, inputs=50).failures == []
