# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse Adam over the Gaussians' tensors, in place: only Gaussians seen by a view are stepped."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import numpy as np
import torch

from ...gaussians.model import OrientedGaussians
from ...kernels.parallel import default_threads, even_bounds, run_chunks
from ...render.types.gradients import VisibleGradients
from .adam_kernels import BETA1, BETA2, COLUMNS, LANES, SH_COLUMN, adam_rows

_TABLE_STEPS = 20_000
"""Steps from which both bias corrections are 1 in float32."""

_STAYS = np.float32(-1.0)


@functools.lru_cache(maxsize=1)
def corrections() -> np.ndarray:
    """Return (s, 2) float32 bias corrections by step: ``1 / (1 - beta1^t)``, ``1 / sqrt(...)``."""
    steps = np.arange(1, _TABLE_STEPS, dtype=np.float64)
    table = np.ones((_TABLE_STEPS, 2))
    table[1:, 0] = 1.0 / (1.0 - BETA1**steps)
    table[1:, 1] = 1.0 / np.sqrt(1.0 - BETA2**steps)
    return table.astype(np.float32)


def packed_rates(columns: int, rates: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return (columns,) float32 rates of the moments' columns; negative: not changed."""
    packed = np.full(columns, _STAYS)
    for name, begin in (*COLUMNS.items(), ("sh", SH_COLUMN)):
        if name in rates:
            packed[begin : begin + len(rates[name])] = rates[name]
    return packed


class Adam:
    """Adam optimiser of the trained tensors; rows are Gaussians and can be rebuilt.

    Each Gaussian counts its own steps, so that one created late, or rarely seen, has the right bias
    correction instead of an overshooting first step.

    Parameters
    ----------
    gaussians : OrientedGaussians
        float32, on the CPU. The tensors are copied.
    """

    def __init__(self, gaussians: OrientedGaussians) -> None:
        self.values: dict[str, torch.Tensor] = {
            name: tensor.detach().clone().contiguous() for name, tensor in gaussians.tensors()
        }
        harmonics = -(-3 * self.values["sh"].shape[1] // LANES) * LANES
        self.all_moments = np.zeros((len(gaussians), 2, SH_COLUMN + harmonics), np.float32)
        """(n, 2, c) first and second moments, in the columns of :mod:`.adam_kernels`."""
        self.steps = np.zeros(len(gaussians), np.int32)
        self.frozen = 0
        """So many Gaussians, the first ones, keep every bit of their values and moments. What adds,
        removes or sets Gaussians leaves them alone, and first."""

    def __len__(self) -> int:
        return len(self.steps)

    def gaussians(self) -> OrientedGaussians:
        """Return the current Gaussians; the tensors share memory with the trained ones."""
        return OrientedGaussians(**self.values)

    def array(self, name: str) -> np.ndarray:
        """Return a view of one tensor; writing changes the Gaussians."""
        return self.values[name].numpy()

    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return views of the first and second moment of one tensor, in its shape."""
        shape = self.shape(name)
        begin = COLUMNS.get(name, SH_COLUMN)
        both = self.all_moments[:, :, begin : begin + math.prod(shape[1:])]
        return both[:, 0].reshape(shape), both[:, 1].reshape(shape)

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of one tensor."""
        return tuple(self.values[name].shape)

    def on_host(self) -> Adam:
        """Return the optimiser of the host's memory: this one."""
        return self

    def copy(self) -> Adam:
        """Return a copy of values, moments and steps."""
        twin = Adam(self.gaussians())
        twin.all_moments[...] = self.all_moments
        twin.steps[...] = self.steps
        twin.frozen = self.frozen
        return twin

    def step_rows(
        self,
        gradients: VisibleGradients,
        rates: Mapping[str, np.ndarray],
        *,
        sh_degree: int | None = None,
        threads: int = 0,
    ) -> None:
        """Step the Gaussians that a view has seen, in place.

        A Gaussian counts as seen if any of its gradients is not 0. Listed Gaussians that are hidden
        behind others keep their values, moments and steps, like those not listed and frozen ones.

        Parameters
        ----------
        gradients : VisibleGradients
            No Gaussian is listed twice; in increasing order where some are frozen.
        rates : mapping of name to (c,) float32
            Learning rate of each column of the flattened tensor, >= 0; absent tensors are not
            changed.
        sh_degree : int, optional
            Highest degree of the harmonics that has ever had a gradient: the columns beyond, with
            moments of 0, are skipped.
        """
        threads = threads or default_threads()
        coefficients = self.values["sh"].shape[1]
        used = coefficients if sh_degree is None else min(coefficients, (sh_degree + 1) ** 2)
        packed = packed_rates(self.all_moments.shape[2], rates)
        rows, listed = len(self), len(gradients.ids)
        flat = [getattr(gradients, name).reshape(-1) for name in COLUMNS]
        flat += [gradients.sh.reshape(listed, 3 * coefficients)]
        flat += [self.array(name).reshape(-1) for name in COLUMNS]
        flat += [self.array("sh").reshape(rows, 3 * coefficients)]
        table = corrections()
        first = int(np.searchsorted(gradients.ids, self.frozen)) if self.frozen else 0

        def run(begin: int, end: int) -> None:
            adam_rows(
                first + begin, first + end, gradients.ids, *flat, self.all_moments, self.steps,
                table, packed, 3 * used,
            )  # fmt: skip

        run_chunks(run, even_bounds(listed - first, threads, 2), threads)

    def rebuild(
        self, parents: np.ndarray, fresh: np.ndarray, changes: Mapping[str, np.ndarray]
    ) -> None:
        """Replace all Gaussians by rows selected from the current ones.

        Parameters
        ----------
        parents : (m,) int64
            Row of the current Gaussians from which each new one is copied.
        fresh : (m,) bool
            New Gaussians whose moments and steps start at zero; the others keep their parent's.
        changes : mapping of name to array
            Tensors to replace after the selection, (m, ...).
        """
        rows = torch.from_numpy(np.ascontiguousarray(parents, np.int64))
        for name in list(self.values):
            if name in changes:
                array = np.ascontiguousarray(changes[name], np.float32)
                self.values[name] = torch.from_numpy(array.copy())
            else:
                self.values[name] = self.values[name][rows].contiguous()
        self.all_moments = self.all_moments[parents]
        self.all_moments[fresh] = 0.0
        self.steps = self.steps[parents]
        self.steps[fresh] = 0

    def reset_moments(self, name: str) -> None:
        """Zero the moments of one tensor (after its values were set directly)."""
        for moment in self.moments(name):
            moment[...] = 0.0

    def is_finite(self) -> bool:
        """Tell whether every parameter is finite."""
        return all(math.isfinite(float(tensor.sum())) for tensor in self.values.values())
