# SPDX-License-Identifier: GPL-3.0-or-later
"""Sum gradients of several views or losses."""

from __future__ import annotations

import dataclasses

import numpy as np

from ...kernels.array_store import ArrayStore
from ...kernels.compiled import kernel
from ...kernels.parallel import default_threads, even_bounds, run_chunks
from ...render.types.gradients import ImageGradients, VisibleGradients

_TENSORS = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")


def merge_gradients(
    first: VisibleGradients,
    second: VisibleGradients,
    count: int,
    *,
    threads: int = 0,
    store: ArrayStore | None = None,
) -> VisibleGradients:
    """Return the sum of two gradients, Gaussian by Gaussian.

    Parameters
    ----------
    first, second : VisibleGradients
        For the same Gaussians, each with increasing ids. Neither is changed.
    count : int
        Number of Gaussians that ids point into.
    threads : int
        The result does not depend on it.
    store : ArrayStore, optional
        Memory for the sum, which is then valid until the next call.

    Returns
    -------
    VisibleGradients
        One row for each Gaussian in either, with increasing ids.
    """
    threads = threads or default_threads()
    taken = ArrayStore() if store is None else store
    listed = taken.zeros("merged listed", count, np.bool_)
    listed[first.ids] = True
    listed[second.ids] = True
    ids = np.flatnonzero(listed).astype(np.int32)
    new_row = taken.take("merged place", count, np.int32)
    new_row[ids] = np.arange(len(ids), dtype=np.int32)
    rows = []
    for name, part in (("merged first", first), ("merged second", second)):
        row_of = taken.take(name, len(ids), np.int32)
        row_of.fill(-1)
        row_of[new_row[part.ids]] = np.arange(len(part.ids), dtype=np.int32)
        rows.append(row_of)
    sums = {}
    for name in _TENSORS:
        one, two = getattr(first, name), getattr(second, name)
        shape = (len(ids), *one.shape[1:])
        sums[name] = out = taken.take(f"merged {name}", shape, np.float32)
        flat = out.reshape(len(ids), -1) if len(ids) else np.zeros((0, 1), np.float32)
        one, two = (part.reshape(len(part), flat.shape[1]) for part in (one, two))
        _add_rows_everywhere(rows[0], rows[1], one, two, flat, threads)
    return VisibleGradients(ids, **sums)


def _add_rows_everywhere(
    first_rows: np.ndarray,
    second_rows: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    out: np.ndarray,
    threads: int,
) -> None:
    def run(begin: int, end: int) -> None:
        _add_rows(begin, end, first_rows, second_rows, first, second, out)

    run_chunks(run, even_bounds(len(out), threads, 2), threads)


def add_image_gradients(first: ImageGradients, second: ImageGradients) -> ImageGradients:
    """Return the sum of two image gradients; common arrays are summed into those of ``first``."""
    sums = {}
    for field in dataclasses.fields(ImageGradients):
        one, two = getattr(first, field.name), getattr(second, field.name)
        if one is not None and two is not None:
            one += two
        sums[field.name] = two if one is None else one
    return ImageGradients(**sums)


@kernel(fast=False)
def _add_rows(
    begin: int,
    end: int,
    first_rows: np.ndarray,
    second_rows: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    out: np.ndarray,
) -> None:
    """Sum the rows of both (-1: none) into rows [begin, end) of ``out``."""
    for k in range(begin, end):
        one, two = first_rows[k], second_rows[k]
        for c in range(out.shape[1]):
            value = np.float32(0.0)
            if one >= 0:
                value += first[one, c]
            if two >= 0:
                value += second[two, c]
            out[k, c] = value
