# SPDX-License-Identifier: GPL-3.0-or-later
"""Parameters of which the first are tests of every day and the others proofs (`make proofs`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def first_then_proofs(values: Iterable[Any], first: int = 1, *, names: int = 1) -> list[Any]:
    """Return parameters for ``pytest.mark.parametrize``, those after the first ones as proofs.

    ``names`` is the number of arguments that each value is for.
    """
    return [
        pytest.param(*(value if names > 1 else [value]), marks=[pytest.mark.proof] * (k >= first))
        for k, value in enumerate(values)
    ]
