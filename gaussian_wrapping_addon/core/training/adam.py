# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam on the rows that a view has seen."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ..compiled import kernel, part
from ..gaussians.model import OrientedGaussians
from ..parallel import ArrayStore, default_threads, even_bounds, run_chunks, run_rows
from ..render.types import ImageGradients, VisibleGradients

# -- Sum gradients of several views or losses -----------------------------------------------------

_TENSORS = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")


def merge_gradients(
    first: VisibleGradients, second: VisibleGradients, count: int, *, threads: int = 0,
    store: ArrayStore | None = None,
) -> VisibleGradients:  # fmt: skip
    """Return the sum of two gradients, one row for each Gaussian in either, with increasing ids.

    Both are for the same ``count`` Gaussians, each with increasing ids; neither is changed. A sum
    in memory of ``store`` is valid until the next call. The result does not depend on ``threads``.
    """
    taken = store or ArrayStore()
    listed = taken.zeros("merged listed", count, np.bool_)
    listed[first.ids] = True
    listed[second.ids] = True
    ids = np.flatnonzero(listed).astype(np.int32)
    new_row = taken.take("merged place", count, np.int32)
    new_row[ids] = np.arange(len(ids), dtype=np.int32)
    rows = []
    for name, of_one in (("merged first", first), ("merged second", second)):
        row_of = taken.take(name, len(ids), np.int32)
        row_of.fill(-1)
        row_of[new_row[of_one.ids]] = np.arange(len(of_one.ids), dtype=np.int32)
        rows.append(row_of)
    sums = {}
    for name in _TENSORS:
        one, two = getattr(first, name), getattr(second, name)
        shape = (len(ids), *one.shape[1:])
        sums[name] = out = taken.take(f"merged {name}", shape, np.float32)
        flat = out.reshape(len(ids), -1) if len(ids) else np.zeros((0, 1), np.float32)
        one, two = (part.reshape(len(part), flat.shape[1]) for part in (one, two))
        run_rows(_add_rows, len(flat), threads, *rows, one, two, flat, chunks=2)
    return VisibleGradients(ids, **sums)


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
    begin: int, end: int, first_rows: np.ndarray, second_rows: np.ndarray, first: np.ndarray,
    second: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
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


# -- Compiled Adam steps, all tensors of a Gaussian at once, with explicit SIMD vectors -----------

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-15

LANES = 16
"""Columns per step. LLVM splits them into as many registers as the processor needs."""

COLUMNS = {"quats": 0, "orientation": 4, "means": 8, "opacity_logits": 11, "log_scales": 12}
"""First column of each small tensor in moments and rates; column 15 stays empty."""

SH_COLUMN = LANES
"""First column of the harmonics."""

AHEAD = 8
"""Prefetch distance in Gaussians: the order of those that a view sees is not predictable for the
processor."""

_WORD = ir.IntType(32)


class _Emitter:
    """Emit Adam on runs of 16 columns; every operation is rounded to float32, as in numpy."""

    def __init__(self, context: Any, builder: Any, sig: Any, args: Any) -> None:
        self.context, self.builder, self.sig, self.args = context, builder, sig, args
        self.vector = ir.VectorType(ir.FloatType(), LANES)

    def pointer(self, argument: int, at: Any, lanes: int) -> Any:
        """Return the address of ``lanes`` values of an array, from index ``at`` on."""
        make = self.context.make_array(self.sig.args[argument])
        data = make(self.context, self.builder, self.args[argument]).data
        kind = ir.VectorType(ir.FloatType(), lanes)
        return self.builder.bitcast(self.builder.gep(data, [at]), kind.as_pointer())

    def state(self, moments: int, rates: int, rate_at: Any) -> tuple[Any, Any, Any]:
        """Return the addresses of both moments, whose indices follow their array, and of rates."""
        return (
            self.pointer(moments, self.args[moments + 1], LANES),
            self.pointer(moments, self.args[moments + 2], LANES),
            self.pointer(rates, rate_at, LANES),
        )

    def splat(self, value: Any) -> Any:
        kind = ir.VectorType(value.type, LANES)
        nothing = ir.Constant(kind, ir.Undefined)
        single = self.builder.insert_element(nothing, value, ir.Constant(_WORD, 0))
        lanes = ir.Constant(ir.VectorType(_WORD, LANES), [0] * LANES)
        return self.builder.shuffle_vector(single, nothing, lanes)

    def constant(self, value: float) -> Any:
        return ir.Constant(self.vector, [float(np.float32(value))] * LANES)

    def function(self, name: str, result: Any, arguments: list[Any]) -> Any:
        kind = ir.FunctionType(result, arguments)
        return cgutils.get_or_insert_function(self.builder.module, kind, name)

    def shuffled(self, a: Any, b: Any, lanes: list[int]) -> Any:
        chosen = ir.Constant(ir.VectorType(_WORD, len(lanes)), lanes)
        return self.builder.shuffle_vector(a, b, chosen)

    def advance(self, x: Any, g: Any, addresses: tuple[Any, Any, Any], up: Any, down: Any) -> Any:
        """Update the moments and return the new values; columns of negative rate are unchanged.

        ``addresses``: addresses of first moment, second moment and rate.
        """
        b = self.builder
        m, v, rate = (b.load(address, align=4) for address in addresses)
        one = np.float32(1.0)
        keep1, take1 = self.constant(BETA1), self.constant(float(one - np.float32(BETA1)))
        keep2, take2 = self.constant(BETA2), self.constant(float(one - np.float32(BETA2)))
        new_m = b.fadd(b.fmul(keep1, m), b.fmul(take1, g))
        new_v = b.fadd(b.fmul(keep2, v), b.fmul(b.fmul(take2, g), g))
        root = self.function(f"llvm.sqrt.v{LANES}f32", self.vector, [self.vector])
        size = b.fadd(b.fmul(b.call(root, [new_v]), self.splat(down)), self.constant(EPSILON))
        step = b.fdiv(b.fmul(b.fmul(rate, self.splat(up)), new_m), size)
        moves = b.fcmp_ordered(">=", rate, ir.Constant(self.vector, None))
        b.store(b.select(moves, new_m, m), addresses[0], align=4)
        b.store(b.select(moves, new_v, v), addresses[1], align=4)
        return b.select(moves, b.fsub(x, step), x)


_SMALL_VALUES = (4, 4, 3, 1, 3)
"""Columns of the small tensors, in the order of :data:`COLUMNS`."""


@intrinsic
def _step_small(  # type: ignore[no-untyped-def]
    typingctx, quats, orientation, means, opacity_logits, log_scales, row,
    grad_quats, grad_orientation, grad_means, grad_opacity_logits, grad_log_scales, grad_row,
    moments, first_at, second_at, rates, up, down,
):  # fmt: skip
    """Step the small tensors of one row; all arrays are flat."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        emit = _Emitter(context, builder, sig, args)

        def addresses(first: int, row: Any) -> list[Any]:
            found = []
            for k, values in enumerate(_SMALL_VALUES):
                at = builder.mul(row, ir.Constant(row.type, values))
                found.append(emit.pointer(first + k, at, values))
            return found

        def joined(pointers: list[Any]) -> Any:
            a, o, m, p, s = (builder.load(pointer, align=4) for pointer in pointers)
            turns = emit.shuffled(a, o, list(range(8)))
            mean_opacity = emit.shuffled(m, emit.shuffled(p, p, [0, 0, 0]), [0, 1, 2, 3])
            scales = emit.shuffled(s, ir.Constant(s.type, None), [0, 1, 2, 3])
            rest = emit.shuffled(mean_opacity, scales, list(range(8)))
            return emit.shuffled(turns, rest, list(range(LANES)))

        targets, first_rate = addresses(0, args[5]), ir.Constant(args[5].type, 0)
        moved = emit.advance(
            joined(targets), joined(addresses(6, args[11])), emit.state(12, 15, first_rate),
            args[16], args[17],
        )  # fmt: skip
        at = 0
        for target, values in zip(targets, _SMALL_VALUES, strict=True):
            part = emit.shuffled(moved, moved, list(range(at, at + values)))
            builder.store(part, target, align=4)
            at += values
        return context.get_dummy_value()

    array, index = quats, types.intp
    signature = types.void(
        array, array, array, array, array, index, array, array, array, array, array, index,
        array, index, index, array, types.float32, types.float32,
    )  # fmt: skip
    return signature, generate


@intrinsic
def _step_run(  # type: ignore[no-untyped-def]
    typingctx, values, at, gradients, gradient_at, count, moments, first_at, second_at,
    rates, rate_at, up, down,
):  # fmt: skip
    """Step ``count`` columns, at most 16, of flat arrays; moments and rates always have 16."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        emit = _Emitter(context, builder, sig, args)
        words = builder.trunc(args[4], _WORD)
        lanes = ir.Constant(ir.VectorType(_WORD, LANES), list(range(LANES)))
        inside = builder.icmp_signed("<", lanes, emit.splat(words))
        pointer = emit.vector.as_pointer()
        load = emit.function(
            f"llvm.masked.load.v{LANES}f32.p0", emit.vector,
            [pointer, _WORD, inside.type, emit.vector],
        )  # fmt: skip
        store = emit.function(
            f"llvm.masked.store.v{LANES}f32.p0", ir.VoidType(),
            [emit.vector, pointer, _WORD, inside.type],
        )  # fmt: skip
        align, zeros = ir.Constant(_WORD, 4), ir.Constant(emit.vector, None)
        x_at, g_at = emit.pointer(0, args[1], LANES), emit.pointer(2, args[3], LANES)
        x = builder.call(load, [x_at, align, inside, zeros])
        g = builder.call(load, [g_at, align, inside, zeros])
        moved = emit.advance(x, g, emit.state(5, 8, args[9]), args[10], args[11])
        builder.call(store, [moved, x_at, align, inside])
        return context.get_dummy_value()

    index = types.intp
    signature = types.void(
        values, index, gradients, index, index, moments, index, index, rates, index,
        types.float32, types.float32,
    )  # fmt: skip
    return signature, generate


@intrinsic
def _prefetch(typingctx, values, at):  # type: ignore[no-untyped-def]
    """Prefetch the cache line of ``values[at]`` of a flat array for writing."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        emit = _Emitter(context, builder, sig, args)
        byte = ir.IntType(8).as_pointer()
        fetch = emit.function("llvm.prefetch.p0", ir.VoidType(), [byte, _WORD, _WORD, _WORD])
        hints = [ir.Constant(_WORD, value) for value in (1, 3, 1)]  # to write, keep, data
        builder.call(fetch, [builder.bitcast(emit.pointer(0, args[1], 1), byte), *hints])
        return context.get_dummy_value()

    return types.void(values, types.intp), generate


@part(fast=False)
def _has_value(values, first, count):  # type: ignore[no-untyped-def]
    for j in range(first, first + count):  # noqa: SIM110 - numba compiles no generators to loops
        if values[j] != 0.0:
            return True
    return False


@kernel(fast=False)
def adam_rows(  # type: ignore[no-untyped-def]
    begin, end, ids,
    grad_quats, grad_orientation, grad_means, grad_opacity_logits, grad_log_scales, grad_sh,
    quats, orientation, means, opacity_logits, log_scales, sh,
    moments, steps, corrections, rates, sh_columns,
):  # fmt: skip
    """Step the Gaussians ``ids[begin .. end]``; those whose gradient is 0 are unchanged.

    Parameters
    ----------
    ids : (v,) int32
        Gaussians of the gradients' rows, without duplicates.
    grad_quats ... grad_log_scales
        (4 v,), (4 v,), (3 v,), (v,), (3 v,) float32; ``grad_sh`` (v, k).
    quats ... log_scales, sh
        The same with n rows.
    moments : (n, 2, c) float32
        First and second moment, in the columns of :data:`COLUMNS` and :data:`SH_COLUMN`.
    steps : (n,) int32
        Steps of each Gaussian so far.
    corrections : (s, 2) float32
        ``1 / (1 - beta1^t)`` and ``1 / sqrt(1 - beta2^t)``.
    rates : (c,) float32
        Learning rate of each column; negative for columns to leave unchanged.
    sh_columns : int
        Number of columns of the harmonics to step.
    """
    last = corrections.shape[0] - 1
    sh_values, sh_gradients, columns = sh.reshape(-1), grad_sh.reshape(-1), sh.shape[1]
    both, width = moments.reshape(-1), moments.shape[2]
    for k in range(begin, end):
        ahead = np.int64(ids[min(k + AHEAD, end - 1)])
        for j in range(0, 2 * width, LANES):
            _prefetch(both, 2 * width * ahead + j)  # type: ignore[call-arg]
        for j in range(0, sh_columns + LANES - 1, LANES):
            _prefetch(sh_values, columns * ahead + j)  # type: ignore[call-arg]
        _prefetch(quats, 4 * ahead)  # type: ignore[call-arg]
        _prefetch(orientation, 4 * ahead)
        _prefetch(means, 3 * ahead)
        _prefetch(log_scales, 3 * ahead)
        # The opacity's gradient alone decides, except for Gaussians capped at every pixel.
        if not (
            grad_opacity_logits[k] != 0.0
            or _has_value(grad_quats, 4 * k, 4)
            or _has_value(grad_orientation, 4 * k, 4)
            or _has_value(grad_means, 3 * k, 3)
            or _has_value(grad_log_scales, 3 * k, 3)
            or _has_value(sh_gradients, columns * k, columns)
        ):
            continue
        i = np.int64(ids[k])
        steps[i] += 1
        step = min(steps[i], last)
        up, down = corrections[step, 0], corrections[step, 1]
        m, v = 2 * i * width, (2 * i + 1) * width
        _step_small(
            quats, orientation, means, opacity_logits, log_scales, i,
            grad_quats, grad_orientation, grad_means, grad_opacity_logits, grad_log_scales, k,
            both, m, v, rates, up, down,
        )  # fmt: skip
        for j in range(0, sh_columns, LANES):
            _step_run(
                sh_values, i * columns + j, sh_gradients, k * columns + j,
                min(LANES, sh_columns - j), both, m + SH_COLUMN + j, v + SH_COLUMN + j,
                rates, SH_COLUMN + j, up, down,
            )  # fmt: skip


# -- Sparse Adam over the Gaussians' tensors, in place: only Gaussians seen by a view are stepped

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
    correction instead of an overshooting first step. The tensors given, float32 on the CPU, are
    copied.
    """

    def __init__(self, gaussians: OrientedGaussians) -> None:
        self.values: dict[str, torch.Tensor] = {
            name: tensor.detach().clone().contiguous() for name, tensor in gaussians.tensors()
        }
        harmonics = -(-3 * self.values["sh"].shape[1] // LANES) * LANES
        self.all_moments = np.zeros((len(gaussians), 2, SH_COLUMN + harmonics), np.float32)
        """(n, 2, c) first and second moments, in the columns of :mod:`.adam`."""
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
        self, gradients: VisibleGradients, rates: Mapping[str, np.ndarray], *,
        sh_degree: int | None = None, threads: int = 0,
    ) -> None:  # fmt: skip
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
