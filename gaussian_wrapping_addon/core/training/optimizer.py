# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam over the Gaussians' tensors, in place, stepping only Gaussians that the view saw."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import numpy as np
import torch

from ..compiled import kernel
from ..gaussians.model import OrientedGaussians
from ..parallel import default_threads, even_bounds, run_chunks

TRAINED = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
"""Tensors that receive gradients; ``filter_3d`` is recomputed instead (method.md 1.5)."""

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-15
_TABLE_STEPS = 20_000
"""Both bias corrections are 1 within float32 from here on."""


@kernel(fast=True)
def _adam_rows(  # type: ignore[no-untyped-def]
    begin, end, value, gradient, first, second, active, steps, corrections, rates
):
    """One step of rows [begin, end).

    Parameters
    ----------
    value, gradient, first, second : (n, c) float32
    active : (n,) bool
        Rows that are stepped; the moments of the others stay.
    steps : (n,) int32
        Steps of each row so far, this one included.
    corrections : (s, 2) float32
        ``1 / (1 - beta1^t)`` and ``1 / sqrt(1 - beta2^t)``.
    rates : (c,) float32
        Learning rate of each column.
    """
    columns = value.shape[1]
    last = corrections.shape[0] - 1
    one = np.float32(1.0)
    b1, b2, epsilon = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON)
    for i in range(begin, end):
        if not active[i]:
            continue
        step = min(steps[i], last)
        up, down = corrections[step, 0], corrections[step, 1]
        x, g, m, v = value[i], gradient[i], first[i], second[i]
        for j in range(columns):
            m[j] = b1 * m[j] + (one - b1) * g[j]
            v[j] = b2 * v[j] + (one - b2) * g[j] * g[j]
            x[j] -= rates[j] * up * m[j] / (np.sqrt(v[j]) * down + epsilon)


@functools.lru_cache(maxsize=1)
def _corrections() -> np.ndarray:
    steps = np.arange(1, _TABLE_STEPS, dtype=np.float64)
    table = np.ones((_TABLE_STEPS, 2))
    table[1:, 0] = 1.0 / (1.0 - BETA1**steps)
    table[1:, 1] = 1.0 / np.sqrt(1.0 - BETA2**steps)
    return table.astype(np.float32)


class Adam:
    """Trained tensors with their moments; rows are Gaussians and can be rebuilt.

    Each Gaussian counts its own steps, so that one created late, or rarely seen, starts with the
    right bias correction instead of jumping.

    Parameters
    ----------
    gaussians : OrientedGaussians
        float32, on the CPU. The tensors are copied.
    """

    def __init__(self, gaussians: OrientedGaussians) -> None:
        self.values: dict[str, torch.Tensor] = {
            name: tensor.detach().clone().contiguous() for name, tensor in gaussians.tensors()
        }
        self.first = {n: np.zeros(tuple(self.values[n].shape), np.float32) for n in TRAINED}
        self.second = {n: np.zeros(tuple(self.values[n].shape), np.float32) for n in TRAINED}
        self.steps = np.zeros(len(gaussians), np.int32)
        self._require_gradients()

    def __len__(self) -> int:
        return len(self.steps)

    def _require_gradients(self) -> None:
        for name in TRAINED:
            self.values[name].requires_grad_(True)

    def gaussians(self) -> OrientedGaussians:
        """Return the current Gaussians; the tensors are the trained leaves themselves."""
        return OrientedGaussians(**self.values)

    def array(self, name: str) -> np.ndarray:
        """Return the memory of one tensor; writing changes the Gaussians."""
        return self.values[name].detach().numpy()

    def step(
        self, rates: Mapping[str, np.ndarray], active: np.ndarray, *, threads: int = 0
    ) -> None:
        """Update the active Gaussians from the tensors' gradients, then drop the gradients.

        Parameters
        ----------
        rates : mapping of name to (c,) float32
            Learning rate of each column of the flattened tensor; a name that is absent stays.
        active : (n,) bool
            Gaussians to step.
        """
        threads = threads or default_threads()
        self.steps[active] += 1
        table = _corrections()
        bounds = even_bounds(len(self), threads, 2)
        for name in TRAINED:
            gradient = self.values[name].grad
            if gradient is None or name not in rates:
                continue
            rows = (len(self), -1)
            arrays = (
                self.array(name).reshape(rows),
                gradient.contiguous().numpy().reshape(rows),
                self.first[name].reshape(rows),
                self.second[name].reshape(rows),
            )
            column_rates = rates[name]

            def run(
                begin: int,
                end: int,
                arrays: tuple[np.ndarray, ...] = arrays,
                column_rates: np.ndarray = column_rates,
            ) -> None:
                _adam_rows(begin, end, *arrays, active, self.steps, table, column_rates)

            run_chunks(run, bounds, threads)
        for name in TRAINED:
            self.values[name].grad = None

    def rebuild(
        self, parents: np.ndarray, fresh: np.ndarray, changes: Mapping[str, np.ndarray]
    ) -> None:
        """Replace all Gaussians by rows picked from the current ones.

        Parameters
        ----------
        parents : (m,) int64
            Row of the current Gaussians that each new one starts from.
        fresh : (m,) bool
            New Gaussians whose moments and steps start at zero; the others keep their parent's.
        changes : mapping of name to array
            Tensors to replace after picking, (m, ...).
        """
        rows = torch.from_numpy(np.ascontiguousarray(parents, np.int64))
        for name in list(self.values):
            if name in changes:
                array = np.ascontiguousarray(changes[name], np.float32)
                self.values[name] = torch.from_numpy(array.copy())
            else:
                self.values[name] = self.values[name].detach()[rows].contiguous()
        for moments in (self.first, self.second):
            for name in TRAINED:
                picked = moments[name][parents]
                picked[fresh] = 0.0
                moments[name] = picked
        self.steps = self.steps[parents]
        self.steps[fresh] = 0
        self._require_gradients()

    def reset_moments(self, name: str) -> None:
        """Forget the moments of one tensor (after its values were set by hand)."""
        self.first[name][...] = 0.0
        self.second[name][...] = 0.0

    def is_finite(self) -> bool:
        """Tell whether every parameter is a finite number."""
        return all(math.isfinite(float(tensor.detach().sum())) for tensor in self.values.values())
