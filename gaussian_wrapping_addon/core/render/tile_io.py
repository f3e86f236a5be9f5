# SPDX-License-Identifier: GPL-3.0-or-later
"""What blocks of pixels read and write: screen Gaussians, pixels, contributors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, errors, types
from numba.extending import intrinsic

from ..compiled import inline
from . import raster_blocks as gradient
from .simd import (
    BLOCK_COLUMNS,
    BLOCK_WIDTH,
    DEPTH,
    F0,
    PLANE,
    SLOPE,
    STRIDE,
    TILE,
    TRANSMITTANCE,
    TRANSMITTANCE_MIN,
    Block,
    Vector,
    compile_time,
    lowest_bit,
    shuffle,
)

# -- Contributor lists of the blocks of a tile, and which blocks are not yet opaque ---------------


_GROUP = TILE
CONTRIBUTORS_PADDING = _GROUP
"""Values past the end of a list that may be overwritten."""
_WORD, _INDEX = ir.IntType(32), ir.IntType(64)


@intrinsic
def _pack_groups(typingctx, masks, begin, groups, block, contributors, at):  # type: ignore[no-untyped-def]
    """Write the intersections that reach a block to ``contributors[at ..]``; return their number.

    ``16 groups`` intersections are tested, sixteen per vector, which is compressed.
    """

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        words, bits = ir.VectorType(_WORD, _GROUP), ir.VectorType(ir.IntType(1), _GROUP)
        zeros, anything = ir.Constant(words, None), ir.Constant(words, ir.Undefined)

        def vector_at(argument: int, at: Any) -> Any:
            data = context.make_array(sig.args[argument])(context, builder, args[argument]).data
            return builder.bitcast(builder.gep(data, [at]), words.as_pointer())

        def repeated(value: Any) -> Any:
            one = builder.insert_element(anything, value, ir.Constant(_WORD, 0))
            return builder.shuffle_vector(one, one, zeros)

        _, begin_, groups_, block_, _, at_ = args
        steps = ir.Constant(words, [ir.Constant(_WORD, k) for k in range(_GROUP)])
        wanted = repeated(builder.shl(ir.Constant(_WORD, 1), builder.trunc(block_, _WORD)))
        kind = ir.FunctionType(words, [words, bits, words])
        name = f"llvm.experimental.vector.compress.v{_GROUP}i32"
        compress = cgutils.get_or_insert_function(builder.module, kind, name)
        end = cgutils.alloca_once_value(builder, at_)
        with cgutils.for_range(builder, groups_) as loop:
            first = builder.add(begin_, builder.mul(loop.index, ir.Constant(_INDEX, _GROUP)))
            own = builder.load(vector_at(0, first), align=4)
            reached = builder.icmp_unsigned("!=", builder.and_(own, wanted), zeros)
            intersections = builder.add(repeated(builder.trunc(first, _WORD)), steps)
            position = builder.load(end)
            packed = builder.call(compress, [intersections, reached, anything])
            builder.store(packed, vector_at(4, position), align=4)
            number = builder.ctpop(builder.bitcast(reached, ir.IntType(_GROUP)))
            builder.store(builder.add(position, builder.zext(number, _INDEX)), end)
        return builder.sub(builder.load(end), at_)

    index = types.intp
    return types.intp(masks, index, index, index, contributors, index), generate


@inline
def list_contributors(
    lanes: Any, masks: Any, begin: Any, count: Any, capacity: Any, contributors: Any, counts: Any
) -> None:
    """List, for each block, which intersections ``begin .. begin + count`` of a tile reach it.

    ``contributors (blocks * capacity,) int32`` receives those of block b, increasing, from
    ``b * capacity`` on, and ``counts (blocks,) int64`` their number. The capacity is at least
    ``count + CONTRIBUTORS_PADDING``.
    """
    blocks = PLANE // lanes
    if lanes == TILE:
        groups = count // _GROUP
        for block in range(blocks):
            at = block * capacity
            n = at + _pack_groups(masks, begin, groups, block, contributors, at)  # type: ignore[call-arg]
            for k in range(begin + groups * _GROUP, begin + count):
                contributors[n] = k
                n += np.int64((masks[k] >> np.uint32(block)) & np.uint32(1))
            counts[block] = n - at
    else:
        # Bit by bit, where no instruction compresses vectors.
        for block in range(blocks):
            counts[block] = 0
        for k in range(begin, begin + count):
            bits = np.uint64(masks[k])
            while bits != np.uint64(0):
                target = np.int64(lowest_bit(bits)) & (blocks - 1)
                contributors[target * capacity + counts[target]] = k
                counts[target] += 1
                bits &= bits - np.uint64(1)


@compile_time
def active_blocks(typingctx, lanes, m, plane):  # type: ignore[no-untyped-def]
    """Return as bits the blocks with a pixel that is not opaque; T is at ``m[plane ..]``."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        block, bits = Block(lanes.literal_value, context, builder), ir.Constant(_INDEX, 0)
        state = block.data(sig.args[1], args[1])
        for number in range(PLANE // block.lanes):
            transmittance = block.load(state, block.offset(args[2], number * block.lanes))
            passes = builder.zext((transmittance >= float(TRANSMITTANCE_MIN)).any(), _INDEX)
            bits = builder.or_(bits, builder.shl(passes, ir.Constant(_INDEX, number)))
        return bits

    return types.uint64(lanes, m, types.intp), generate


# -- Copy rows of a tile between its planes, ordered by blocks, and the images, ordered by pixels
#
# A row of a tile is 16 pixels: in a plane four runs of four values, one per block; in an image of
# three channels 48 interleaved values. Both are moved as vectors and reordered in registers. Rows
# that the image's edge cuts take the same path with masked loads and stores, so that their values
# are the same; whole rows use no masks because these are slow on some processors.


_CHANNELS = 3


class _Rows:
    """Copies rows of one tile; ``live`` is the number of columns in the image, None for all."""

    def __init__(
        self, lanes: int, context: Any, builder: Any, offset: Any, at: Any, live: Any | None
    ) -> None:
        self.lanes, self.builder = lanes, builder
        self.block, self.quad = Block(TILE, context, builder), Block(BLOCK_WIDTH, context, builder)
        self.offset, self.at = offset, at
        self._live = None if live is None else builder.trunc(live, _WORD)

    def plane(self, m: Any, which: int) -> Vector:
        """Return the row of one plane."""
        a, b, c, d = (self.quad.load(m, offset).value for offset in self._offsets(which))
        left, right = shuffle(self.builder, a, b, range(8)), shuffle(self.builder, c, d, range(8))
        return Vector(self.block, shuffle(self.builder, left, right, range(TILE)))

    def set_plane(self, value: Vector, m: Any, which: int) -> None:
        """Write the row of one plane."""
        for column, offset in enumerate(self._offsets(which)):
            order = range(column * BLOCK_WIDTH, (column + 1) * BLOCK_WIDTH)
            part = shuffle(self.builder, value.value, value.value, order)
            self.quad.store(Vector(self.quad, part), m, offset)

    def _offsets(self, which: int) -> list[Any]:
        return [
            self.block.offset(self.offset, which * STRIDE + column * self.lanes)
            for column in range(BLOCK_COLUMNS)
        ]

    def store_one(self, value: Vector, image: Any) -> None:
        """Write the row of an image of one channel."""
        self._store(value, image, self.at, 0, 1)

    def load_one(self, image: Any) -> Vector:
        """Return the row of an image of one channel, 0 outside it."""
        return self._load(image, self.at, 0, 1)

    def store_three(self, channels: Sequence[Vector], image: Any) -> None:
        """Write the row of an image of three channels."""
        a, b, c = (channel.value for channel in channels)
        first = self._first_value()
        for part in range(_CHANNELS):
            pixels = [divmod(part * TILE + k, _CHANNELS) for k in range(TILE)]
            two = [pixel + TILE * (channel == 1) for pixel, channel in pixels]
            three = [pixels[k][0] + TILE if pixels[k][1] == 2 else k for k in range(TILE)]
            value = shuffle(self.builder, shuffle(self.builder, a, b, two), c, three)
            self._store(Vector(self.block, value), image, first, part, _CHANNELS)

    def load_three(self, image: Any) -> list[Vector]:
        """Return the channels of the row of an image, 0 outside it."""
        first = self._first_value()
        a, b, c = (self._load(image, first, part, _CHANNELS).value for part in range(_CHANNELS))
        channels = []
        for channel in range(_CHANNELS):
            indices = [divmod(k * _CHANNELS + channel, TILE) for k in range(TILE)]
            two = [at + TILE * (part == 1) for part, at in indices]
            three = [indices[k][1] + TILE if indices[k][0] == 2 else k for k in range(TILE)]
            value = shuffle(self.builder, shuffle(self.builder, a, b, two), c, three)
            channels.append(Vector(self.block, value))
        return channels

    def inside(self, value: Vector) -> Vector:
        """Return ``value`` inside the image, 0 outside."""
        if self._live is None:
            return value
        zeros = self.block.vector(0.0).value
        return Vector(self.block, self.builder.select(self._mask(0, 1), value.value, zeros))

    def _first_value(self) -> Any:
        return self.builder.mul(self.at, self.block.index(_CHANNELS), flags=("nuw", "nsw"))

    def _mask(self, part: int, channels: int) -> Any:
        """Return which of 16 values of a row lie in the image."""
        words = ir.VectorType(_WORD, TILE)
        values = self.builder.mul(self._live, ir.Constant(_WORD, channels))
        one = self.builder.insert_element(
            ir.Constant(words, ir.Undefined), values, ir.Constant(_WORD, 0)
        )
        end = self.builder.shuffle_vector(one, one, ir.Constant(words, None))
        own = ir.Constant(words, [ir.Constant(_WORD, part * TILE + k) for k in range(TILE)])
        return self.builder.icmp_signed("<", own, end)

    def _masked(self, operation: str, result: Any, values: Sequence[Any]) -> Any:
        kind = ir.FunctionType(result, [value.type for value in values])
        name = f"llvm.masked.{operation}.v{TILE}f32.p0"
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.call(function, values)

    def _pointer(self, image: Any, first: Any, part: int) -> Any:
        pointer = self.builder.gep(image, [self.block.offset(first, part * TILE)])
        return self.builder.bitcast(pointer, self.block.kind.as_pointer())

    def _store(self, value: Vector, image: Any, first: Any, part: int, channels: int) -> None:
        pointer = self._pointer(image, first, part)
        if self._live is None:
            self.builder.store(value.value, pointer, align=4)
            return
        align = ir.Constant(_WORD, 4)
        mask = self._mask(part, channels)
        self._masked("store", ir.VoidType(), [value.value, pointer, align, mask])

    def _load(self, image: Any, first: Any, part: int, channels: int) -> Vector:
        pointer = self._pointer(image, first, part)
        if self._live is None:
            return Vector(self.block, self.builder.load(pointer, align=4))
        align, zeros = ir.Constant(_WORD, 4), self.block.vector(0.0).value
        mask = self._mask(part, channels)
        values = [pointer, align, mask, zeros]
        return Vector(self.block, self._masked("load", self.block.kind, values))


def _require_contiguous(*arrays: Any) -> None:
    for array in arrays:
        if not isinstance(array, types.Array) or array.layout != "C":
            raise errors.TypingError(f"Rows of tiles need C-contiguous arrays, not {array}")


def _images(block: Block, kinds: Any, values: Any) -> list[Any]:
    """Return the pointers to the arrays of a tuple."""
    arrays = cgutils.unpack_tuple(block.builder, values)
    return [block.data(kind, array) for kind, array in zip(kinds, arrays, strict=True)]


def _multiply_add(a: Vector, b: Vector, c: Vector) -> Vector:
    """Return ``a b + c``, fused where the processor can; never reordered."""
    return Vector(a.block, a.block.call("llvm.fmuladd", [a.value, b.value, c.value], flags=()))


@compile_time
def _write(typingctx, lanes, depth, whole, m, offset, live, background, images, at):  # type: ignore[no-untyped-def]
    _require_contiguous(m, background, *images)

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        live = None if whole.literal_value else args[5]
        rows = _Rows(lanes.literal_value, context, builder, args[4], args[8], live)
        block = rows.block
        state, behind = block.data(sig.args[3], args[3]), block.data(sig.args[6], args[6])
        *three, alpha, depth_image, slope = _images(block, sig.args[7], args[7])
        transmittance = rows.plane(state, TRANSMITTANCE)
        for number, image in enumerate(three):
            first = F0 + number * _CHANNELS
            planes = [rows.plane(state, first + channel) for channel in range(_CHANNELS)]
            if number == 0:
                colors = [block.scalar(behind, block.index(k)) for k in range(_CHANNELS)]
                planes = [
                    plane + transmittance * block.splat(color)
                    for plane, color in zip(planes, colors, strict=True)
                ]
            rows.store_three(planes, image)
        rows.store_one(1.0 - transmittance, alpha)
        if depth.literal_value:
            rows.store_one(rows.plane(state, DEPTH), depth_image)
            rows.store_one(rows.plane(state, SLOPE), slope)
        return context.get_dummy_value()

    index = types.intp
    return types.void(lanes, depth, whole, m, index, index, background, images, index), generate


@compile_time
def _read(typingctx, lanes, depth, whole, m, offset, live, images, grads, at):  # type: ignore[no-untyped-def]
    _require_contiguous(m, *images, *grads)

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        live = None if whole.literal_value else args[5]
        rows = _Rows(lanes.literal_value, context, builder, args[4], args[8], live)
        block = rows.block
        state = block.data(sig.args[3], args[3])
        *three, alpha, depth_image, slope_image = _images(block, sig.args[6], args[6])
        *g_three, g_alpha, g_depth = _images(block, sig.args[7], args[7])
        # The colour includes the background, and with it the final transmittance.
        grad = rows.load_one(g_alpha)
        remaining = _multiply_add(grad, rows.load_one(alpha), -grad)
        values = [rows.load_three(image) for image in three]
        grads_of = [rows.load_three(image) for image in g_three]
        for channel in range(_CHANNELS):
            for number, pair in enumerate(zip(values, grads_of, strict=True)):
                which = gradient.G0 + number * _CHANNELS + channel
                value, grad = (channels[channel] for channels in pair)
                rows.set_plane(grad, state, which)
                remaining = _multiply_add(grad, value, remaining)
        rows.set_plane(remaining, state, gradient.REMAINING)
        rows.set_plane(rows.inside(block.vector(1.0)), state, gradient.BACKWARD_TRANSMITTANCE)
        if depth.literal_value:
            found, grad = rows.load_one(depth_image), rows.load_one(g_depth)
            has_gradient = (found > 0.0) & ((grad < 0.0) | (grad > 0.0))
            slope = rows.load_one(slope_image)
            # Exact division: fast math would allow an approximation for vectors, and numba
            # makes every operation without a flag of its own fast.
            log_t_gradient = Vector(block, builder.fdiv(grad.value, slope.value, flags=("nsz",)))
            rows.set_plane(has_gradient.select(found, 0.0), state, gradient.DEPTH)
            rows.set_plane(has_gradient.select(log_t_gradient, 0.0), state, gradient.LOG_T_GRADIENT)
        return context.get_dummy_value()

    index = types.intp
    return types.void(lanes, depth, whole, m, index, index, images, grads, index), generate


@inline
def write_row(
    lanes: Any, depth: Any, m: Any, offset: Any, live: Any, background: Any, images: Any, at: Any
) -> None:
    """Write one row of a tile's forward planes to the images.

    The row starts at ``offset`` in each plane of the scratch ``m`` and at pixel ``at`` of the
    images (colour, normal, geometric normal, alpha, and with ``depth`` also depth and slope), which
    are C-contiguous; ``live`` columns of the tile lie in them.
    """
    if live == TILE:
        _write(lanes, depth, True, m, offset, live, background, images, at)
    else:
        _write(lanes, depth, False, m, offset, live, background, images, at)


@inline
def read_row(
    lanes: Any, depth: Any, m: Any, offset: Any, live: Any, images: Any, grads: Any, at: Any
) -> None:
    """Read one row of images and loss gradients into a tile's planes of the backward pass.

    Pixels outside the image become opaque and have no gradient; ``live`` may be 0. Other parameters
    as in :func:`write_row`; ``grads`` are those on all images but the slope.
    """
    if live == TILE:
        _read(lanes, depth, True, m, offset, live, images, grads, at)
    else:
        _read(lanes, depth, False, m, offset, live, images, grads, at)
