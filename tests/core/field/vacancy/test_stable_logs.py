# SPDX-License-Identifier: GPL-3.0-or-later
"""The stable forms against 160-digit arithmetic (docs/method.md, section 5.4)."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.field.vacancy_kernels import log_gaussian, log_one_minus
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians

LOGITS = [-30.0, -20.0, -5.0, -0.7, 0.0, 0.3, 2.0, 8.0, 15.0, 20.0, 30.0, 40.0]
DISTANCES = [0.0, 1e-18, 1e-9, 1e-3, 0.5, 1.0, 1.3862943611198906, 4.0, 30.0, 120.0, 200.0]


def relative(value: float, exact: mpmath.mpf) -> float:
    return float(abs((mpmath.mpf(float(value)) - exact) / exact))


def log_opacity(logit: float) -> np.float64:
    """Return the model's log opacity of a Gaussian without filter."""
    one = OrientedGaussians(
        *(torch.zeros((1, *shape), dtype=torch.float64) for shape in ((3,), (3,), (4,))),
        torch.tensor([logit], dtype=torch.float64),
        *(torch.zeros((1, *shape), dtype=torch.float64) for shape in ((1, 3), (4,), ())),
    )
    return np.float64(one.log_opacities().item())


@pytest.mark.parametrize("logit", LOGITS)
@pytest.mark.parametrize("q", DISTANCES)
def test_forms_keep_all_digits(logit: float, q: float) -> None:
    with mpmath.workdps(160):
        log_alpha = -mpmath.log(1 + mpmath.exp(-mpmath.mpf(logit)))
        log_g = log_alpha - mpmath.mpf(q) / 2
        mine_alpha = log_opacity(logit)
        mine_g = log_gaussian(mine_alpha, np.float64(q))
        assert relative(mine_alpha, log_alpha) < 4e-15
        assert relative(mine_g, log_g) < 4e-15
        # exp magnifies the rounding of log G by its size, which reaches 130 here.
        allowed = 4e-15 * (2.0 + abs(float(log_g)))
        assert relative(log_one_minus(mine_g), mpmath.log(1 - mpmath.exp(log_g))) < allowed


def test_limits_are_infinite_or_zero_not_nan() -> None:
    assert log_one_minus(np.float64(0.0)) == -np.inf
    assert log_one_minus(np.float64(-2000.0)) == 0.0
    assert log_opacity(-1e4) == -1e4
    assert log_opacity(1e4) == 0.0
