"""Networks of points in kernels for a GPU: one launch forward and three backward, however many layers they have.

All weights and biases of a network lie in one tensor, layer by layer. A program takes some points through all layers.
Products have the precision of float32 ("tf32x3"): each is three products of tensor cores.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mien.avatar.ops.point_network import CODES, SHARPNESS, PlannedLayer
from mien.kernels import blocks, launch

_POINTS = 64
_TILE = 64
_DEPTH = 32
_COPIED = 1024
_MOST_PARTS = 32
_POINTS_OF_PART = 4096
_SHARPNESS = tl.constexpr(SHARPNESS)


class Structure(NamedTuple):
    """The sizes of a network, one entry for each layer."""

    inputs: tuple[int, ...]
    """Values that a layer reads from the one before it."""
    extras: tuple[int, ...]
    """Values that it reads from an earlier one."""
    outputs: tuple[int, ...]
    activations: tuple[int, ...]
    sources: tuple[int, ...]
    """The values that are read again: 0 for the inputs, 1 for the first layer's, or -1."""

    def weights_at(self) -> tuple[int, ...]:
        """The places at which each layer's weights begin. Its biases follow them. The last entry is the size of all."""
        starts = [0]
        for one, other, out in zip(self.inputs, self.extras, self.outputs, strict=True):
            starts.append(starts[-1] + (one + other + 1) * out)
        return tuple(starts)

    def values_at(self) -> tuple[int, ...]:
        """The sum of the widths of the layers before each layer."""
        return tuple(sum(self.outputs[:layer]) for layer in range(len(self.outputs)))

    def constants(self) -> dict[str, Any]:
        """The sizes as kernels take them."""
        return {
            "INPUTS": self.inputs, "EXTRAS": self.extras, "OUTPUTS": self.outputs, "ACTIVATIONS": self.activations,
            "SOURCES": self.sources, "WEIGHTS_AT": self.weights_at(), "VALUES_AT": self.values_at(),
            "TILE": _TILE, "DEPTH": _DEPTH, "BLOCK": _POINTS,
        }  # fmt: skip


def structure_of(inputs: int, plan: Sequence[PlannedLayer]) -> Structure:
    """The structure of a planned network that reads so many numbers of each point."""
    widths = [inputs, *(sum(rows.linear.out_features for rows in layer.rows) for layer in plan)]
    sources = tuple(-1 if layer.extra is None else layer.extra for layer in plan)
    extras = tuple(0 if source < 0 else widths[source] for source in sources)
    activations = tuple(CODES[layer.activation] for layer in plan)
    return Structure(tuple(widths[:-1]), extras, tuple(widths[1:]), activations, sources)


def packed(plan: Sequence[PlannedLayer], structure: Structure) -> Tensor:
    """All weights and biases of a planned network in one tensor: one launch forward and one backward."""
    pieces, starts = [], structure.weights_at()
    for number, layer in enumerate(plan):
        total, first = structure.inputs[number] + structure.extras[number], 0
        biases = starts[number] + total * structure.outputs[number]
        for rows in layer.rows:
            out, width = rows.linear.out_features, rows.linear.in_features
            pieces.append((out, width, rows.column, total, starts[number] + first * total, biases + first, layer.scale))
            first += out
    linears = [rows.linear for layer in plan for rows in layer.rows]
    return _Pack.apply(starts[-1], tuple(pieces), *(tensor for one in linears for tensor in _parameters(one)))


def _parameters(linear: nn.Linear) -> tuple[Tensor | None, Tensor, Tensor]:
    """Length of the rows, or None without weight normalisation; rows; bias."""
    norm = getattr(linear, "parametrizations", None)
    if norm is None:
        return None, linear.weight, linear.bias
    return norm.weight.original0, norm.weight.original1, linear.bias


def packed_network(inputs: Tensor, parameters: Tensor, structure: Structure) -> Tensor:
    """`mien.avatar.ops.point_network.point_network` with packed parameters."""
    return _Network.apply(structure, inputs, parameters)  # pyright: ignore[reportReturnType]


def summed_directions(parameters: Tensor, coefficients: Tensor, structure: Structure) -> tuple[Tensor, Structure]:
    """The network whose last layer gives sums of directions, weighted by coefficients [b, c], in place of them.

    The rows of the last layer are three times 1 + c directions, and others. The first direction of each three stays.
    """
    b, c = coefficients.shape
    others = structure.outputs[-1] - 3 * (1 + c)
    summed = structure._replace(outputs=(*structure.outputs[:-1], 3 + 3 * b + others))
    return _Sum.apply(structure, summed, parameters, coefficients), summed


class _Pack(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, size: int, pieces: tuple[tuple[Any, ...], ...], *given: Tensor | None) -> Tensor:
        own = [None if one is None else one.detach() for one in given]
        lengths, weights, biases = own[::3], own[1::3], own[2::3]
        flat = next(one for one in biases if one is not None).new_empty(size)
        ctx.constants = _constants_of(pieces)
        ctx.save_for_backward(*given)
        arguments = (tuple(lengths), tuple(weights), tuple(biases), flat)
        launch(_pack, ctx.constants["FIRST"][-1], *arguments, **ctx.constants)
        return flat

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_flat: Tensor) -> tuple[Tensor | None, ...]:
        own = [None if one is None else one.detach() for one in ctx.saved_tensors]
        results = [None if one is None else torch.empty_like(one) for one in own]
        launch(
            _pack_backward, ctx.constants["FIRST"][-1], tuple(own[::3]), tuple(own[1::3]), by_flat.contiguous(),
            tuple(results[::3]), tuple(results[1::3]), tuple(results[2::3]), **ctx.constants,
        )  # fmt: skip
        return None, None, *results


def _constants_of(pieces: tuple[tuple[Any, ...], ...]) -> dict[str, Any]:
    outputs, *others = map(tuple, zip(*pieces, strict=True))
    names = ("WIDTHS", "COLUMNS", "TOTALS", "WEIGHTS_AT", "BIASES_AT", "SCALES")
    first = tuple(sum(outputs[:index]) for index in range(len(outputs) + 1))
    powers = tuple(triton.next_power_of_2(total) for total in others[2])
    return {"FIRST": first, "POWERS": powers, **dict(zip(names, others, strict=True))}


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, structure: Structure, inputs: Tensor, parameters: Tensor) -> Tensor:
        inputs, parameters, n = inputs.contiguous(), parameters.contiguous(), len(inputs)
        values, outputs = inputs.new_empty(n * sum(structure.outputs[:-1])), inputs.new_empty(n, structure.outputs[-1])
        ctx.structure, programs = structure, blocks(n, _POINTS)
        launch(_forward, programs, inputs, parameters, values, outputs, n, **structure.constants())
        ctx.save_for_backward(inputs, parameters, values)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_outputs: Tensor) -> tuple[Tensor | None, ...]:
        inputs, parameters, values = ctx.saved_tensors
        by_outputs, n, structure = by_outputs.contiguous(), len(inputs), ctx.structure
        slopes, by_inputs = torch.empty_like(values), torch.empty_like(inputs) if ctx.needs_input_grad[1] else None
        constants = structure.constants()
        arguments = (parameters, values, by_outputs, slopes, by_inputs, n)
        launch(_backward, blocks(n, _POINTS), *arguments, **constants)
        tiles = [
            blocks(out, _TILE) * blocks(one + other, _TILE)
            for one, other, out in zip(structure.inputs, structure.extras, structure.outputs, strict=True)
        ]
        first = tuple(sum(tiles[:index]) for index in range(len(tiles) + 1))
        parts = min(max(blocks(n, _POINTS_OF_PART), 1), _MOST_PARTS)
        by_parameters, length = parameters.new_empty(parts, len(parameters)), blocks(blocks(n, parts), _DEPTH) * _DEPTH
        launch(
            _backward_weights, parts * first[-1], inputs, values, by_outputs, slopes, by_parameters, n, length,
            FIRST=first, **constants,
        )  # fmt: skip
        return None, by_inputs, by_parameters.sum(0)


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, before: Structure, after: Structure, parameters: Tensor, coefficients: Tensor) -> Tensor:
        parameters, coefficients = parameters.contiguous(), coefficients.contiguous()
        flat, (b, c) = parameters.new_empty(after.weights_at()[-1]), coefficients.shape
        total, start = before.inputs[-1] + before.extras[-1], before.weights_at()[-2]
        ctx.sizes = (start, before.outputs[-1], after.outputs[-1], b, c)
        ctx.constants = {"TOTAL": total, "WIDTH": triton.next_power_of_2(total), "BLOCK": _COPIED}
        programs = after.outputs[-1] + blocks(start, _COPIED)
        launch(_sum_directions, programs, parameters, coefficients, flat, *ctx.sizes, **ctx.constants)
        ctx.save_for_backward(parameters, coefficients)
        return flat

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_flat: Tensor) -> tuple[Tensor | None, ...]:
        parameters, coefficients = ctx.saved_tensors
        results, (start, before, _, _, c) = (torch.empty_like(parameters), torch.empty_like(coefficients)), ctx.sizes
        programs = before - 2 * (1 + c) + blocks(start, _COPIED)
        arguments = (by_flat.contiguous(), parameters, coefficients, *results)
        launch(_sum_directions_backward, programs, *arguments, *ctx.sizes, **ctx.constants)
        return None, None, *results


@no_type_check
@triton.jit
def _pack(
    lengths, weights, biases, flat, FIRST: tl.constexpr, WIDTHS: tl.constexpr, COLUMNS: tl.constexpr,
    TOTALS: tl.constexpr, WEIGHTS_AT: tl.constexpr, BIASES_AT: tl.constexpr, SCALES: tl.constexpr,
    POWERS: tl.constexpr,
):  # fmt: skip
    """A program writes a row. Columns that it does not read are 0."""
    program = tl.program_id(0)
    for i in tl.static_range(len(weights)):
        if (program >= FIRST[i]) & (program < FIRST[i + 1]):
            row, column = program - FIRST[i], tl.arange(0, POWERS[i])
            own = (column >= COLUMNS[i]) & (column < COLUMNS[i] + WIDTHS[i])
            weight = tl.load(weights[i] + row * WIDTHS[i] + column - COLUMNS[i], mask=own, other=0.0)
            if lengths[i] is not None:
                weight *= tl.load(lengths[i] + row) / tl.sqrt(tl.sum(weight * weight, 0))
            tl.store(flat + WEIGHTS_AT[i] + row * TOTALS[i] + column, weight * SCALES[i], mask=column < TOTALS[i])
            tl.store(flat + BIASES_AT[i] + row, tl.load(biases[i] + row))


@no_type_check
@triton.jit
def _pack_backward(
    lengths, weights, by_flat, by_lengths, by_weights, by_biases, FIRST: tl.constexpr, WIDTHS: tl.constexpr,
    COLUMNS: tl.constexpr, TOTALS: tl.constexpr, WEIGHTS_AT: tl.constexpr, BIASES_AT: tl.constexpr,
    SCALES: tl.constexpr, POWERS: tl.constexpr,
):  # fmt: skip
    program = tl.program_id(0)
    for i in tl.static_range(len(weights)):
        if (program >= FIRST[i]) & (program < FIRST[i + 1]):
            row, column = program - FIRST[i], tl.arange(0, POWERS[i])
            own = (column >= COLUMNS[i]) & (column < COLUMNS[i] + WIDTHS[i])
            at = row * WIDTHS[i] + column - COLUMNS[i]
            gradient = tl.load(by_flat + WEIGHTS_AT[i] + row * TOTALS[i] + column, mask=own, other=0.0) * SCALES[i]
            if lengths[i] is not None:
                weight = tl.load(weights[i] + at, mask=own, other=0.0)
                norm = tl.sqrt(tl.sum(weight * weight, 0))
                along = tl.sum(gradient * weight, 0) / norm
                tl.store(by_lengths[i] + row, along)
                gradient = tl.load(lengths[i] + row) / norm * (gradient - weight * along / norm)
            tl.store(by_weights[i] + at, gradient, mask=own)
            tl.store(by_biases[i] + row, tl.load(by_flat + BIASES_AT[i] + row))


@no_type_check
@triton.jit
def _layer_inputs(inputs, values, n, source: tl.constexpr, VALUES_AT: tl.constexpr):
    """The place of the values with a number: those of the inputs, or of a layer."""
    if source == 0:
        return inputs
    return values + tl.cast(n, tl.int64) * VALUES_AT[source - 1]


@no_type_check
@triton.jit
def _product(total, left, row, n, width: tl.constexpr, right, column, columns, across, down, DEPTH: tl.constexpr):
    """Add left [n, width] @ right to a tile.

    `across` and `down` are the steps of `right` from column to column and from row to row.
    """
    for first in range(0, width, DEPTH):
        middle = first + tl.arange(0, DEPTH)
        one = tl.load(
            left + row.to(tl.int64)[:, None] * width + middle[None, :],
            mask=(row < n)[:, None] & (middle < width)[None, :], other=0.0,
        )  # fmt: skip
        other = tl.load(
            right + middle[:, None] * down + column[None, :] * across,
            mask=(middle < width)[:, None] & (column < columns)[None, :], other=0.0,
        )  # fmt: skip
        total += tl.dot(one, other, input_precision="tf32x3", out_dtype=total.dtype)
    return total


@no_type_check
@triton.jit
def _forward(
    inputs, parameters, values, outputs, n, INPUTS: tl.constexpr, EXTRAS: tl.constexpr, OUTPUTS: tl.constexpr,
    ACTIVATIONS: tl.constexpr, SOURCES: tl.constexpr, WEIGHTS_AT: tl.constexpr, VALUES_AT: tl.constexpr,
    TILE: tl.constexpr, DEPTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    for layer in tl.static_range(len(OUTPUTS)):
        read = INPUTS[layer] + EXTRAS[layer]
        weights, before = parameters + WEIGHTS_AT[layer], _layer_inputs(inputs, values, n, layer, VALUES_AT)
        for first in range(0, OUTPUTS[layer], TILE):
            column = first + tl.arange(0, TILE)
            there = column < OUTPUTS[layer]
            bias = tl.load(weights + read * OUTPUTS[layer] + column, mask=there, other=0.0)
            total = tl.zeros([BLOCK, TILE], parameters.dtype.element_ty) + bias[None, :]
            total = _product(total, before, row, n, INPUTS[layer], weights, column, OUTPUTS[layer], read, 1, DEPTH)
            if SOURCES[layer] >= 0:
                again = _layer_inputs(inputs, values, n, SOURCES[layer], VALUES_AT)
                more = weights + INPUTS[layer]
                total = _product(total, again, row, n, EXTRAS[layer], more, column, OUTPUTS[layer], read, 1, DEPTH)
            if ACTIVATIONS[layer] == 1:
                total = tl.where(total < 0, 0.0, total)
            if ACTIVATIONS[layer] == 2:
                sharp = _SHARPNESS * total
                total = tl.where(sharp > 20, total, tl.log(1 + tl.exp(tl.where(sharp > 20, 0.0, sharp))) / _SHARPNESS)
            into = outputs
            if layer + 1 < len(OUTPUTS):
                into = _layer_inputs(inputs, values, n, layer + 1, VALUES_AT)
            at = row.to(tl.int64)[:, None] * OUTPUTS[layer] + column[None, :]
            tl.store(into + at, total, mask=(row < n)[:, None] & there[None, :])
        tl.debug_barrier()  # Other threads read what this one wrote.


@no_type_check
@triton.jit
def _backward(
    parameters, values, by_outputs, slopes, by_inputs, n, INPUTS: tl.constexpr, EXTRAS: tl.constexpr,
    OUTPUTS: tl.constexpr, ACTIVATIONS: tl.constexpr, SOURCES: tl.constexpr, WEIGHTS_AT: tl.constexpr,
    VALUES_AT: tl.constexpr, TILE: tl.constexpr, DEPTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Derivatives by the sums that each layer's activation takes, and by the inputs, which are number 0."""
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    for number in tl.static_range(len(OUTPUTS) - 1, -1, -1):
        if number > 0 or by_inputs is not None:
            width = INPUTS[number]
            for first in range(0, INPUTS[number], TILE):
                column = first + tl.arange(0, TILE)
                total = tl.zeros([BLOCK, TILE], parameters.dtype.element_ty)
                for layer in tl.static_range(number, len(OUTPUTS)):
                    slope = by_outputs
                    if layer + 1 < len(OUTPUTS):
                        slope = _layer_inputs(by_outputs, slopes, n, layer + 1, VALUES_AT)
                    read, weights = INPUTS[layer] + EXTRAS[layer], parameters + WEIGHTS_AT[layer]
                    if layer == number:
                        total = _product(total, slope, row, n, OUTPUTS[layer], weights, column, width, 1, read, DEPTH)
                    if SOURCES[layer] == number:
                        more = weights + INPUTS[layer]
                        total = _product(total, slope, row, n, OUTPUTS[layer], more, column, width, 1, read, DEPTH)
                at = row.to(tl.int64)[:, None] * width + column[None, :]
                there = (row < n)[:, None] & (column < width)[None, :]
                if number == 0:
                    tl.store(by_inputs + at, total, mask=there)
                else:
                    value = tl.load(_layer_inputs(values, values, n, number, VALUES_AT) + at, mask=there, other=0.0)
                    if ACTIVATIONS[number - 1] == 1:
                        total = tl.where(value <= 0, 0.0, total)
                    if ACTIVATIONS[number - 1] == 2:
                        total *= 1 - tl.exp(value * -_SHARPNESS)
                    tl.store(_layer_inputs(slopes, slopes, n, number, VALUES_AT) + at, total, mask=there)
            tl.debug_barrier()


@no_type_check
@triton.jit
def _backward_weights(
    inputs, values, by_outputs, slopes, by_parameters, n, length, FIRST: tl.constexpr, INPUTS: tl.constexpr,
    EXTRAS: tl.constexpr, OUTPUTS: tl.constexpr, ACTIVATIONS: tl.constexpr, SOURCES: tl.constexpr,
    WEIGHTS_AT: tl.constexpr, VALUES_AT: tl.constexpr, TILE: tl.constexpr, DEPTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A program sums up a tile of a layer's weights over a part of the points."""
    part, program = tl.program_id(0) // FIRST[len(OUTPUTS)], tl.program_id(0) % FIRST[len(OUTPUTS)]
    into = by_parameters + part.to(tl.int64) * WEIGHTS_AT[len(OUTPUTS)]
    for layer in tl.static_range(len(OUTPUTS)):
        if (program >= FIRST[layer]) & (program < FIRST[layer + 1]):
            read = INPUTS[layer] + EXTRAS[layer]
            tiles, number = (read + TILE - 1) // TILE, program - FIRST[layer]
            output = number // tiles * TILE + tl.arange(0, TILE)
            column = number % tiles * TILE + tl.arange(0, TILE)
            slope = by_outputs
            if layer + 1 < len(OUTPUTS):
                slope = _layer_inputs(by_outputs, slopes, n, layer + 1, VALUES_AT)
            before, again = _layer_inputs(inputs, values, n, layer, VALUES_AT), inputs
            if SOURCES[layer] >= 0:
                again = _layer_inputs(inputs, values, n, SOURCES[layer], VALUES_AT)
            total = tl.zeros([TILE, TILE], by_parameters.dtype.element_ty)
            of_bias = tl.zeros([TILE], by_parameters.dtype.element_ty)
            for first in range(part * length, tl.minimum(part * length + length, n), DEPTH):
                row = first + tl.arange(0, DEPTH)
                known, wide = row < n, row.to(tl.int64)
                at = output[:, None] + wide[None, :] * OUTPUTS[layer]
                one = tl.load(slope + at, mask=(output < OUTPUTS[layer])[:, None] & known[None, :], other=0.0)
                own = known[:, None] & (column < INPUTS[layer])[None, :]
                other = tl.load(before + wide[:, None] * INPUTS[layer] + column[None, :], mask=own, other=0.0)
                if SOURCES[layer] >= 0:
                    own = known[:, None] & ((column >= INPUTS[layer]) & (column < read))[None, :]
                    at = wide[:, None] * EXTRAS[layer] + column[None, :] - INPUTS[layer]
                    other += tl.load(again + at, mask=own, other=0.0)
                total += tl.dot(one, other, input_precision="tf32x3", out_dtype=total.dtype)
                of_bias += tl.sum(one, 1)
            there = (output < OUTPUTS[layer])[:, None] & (column < read)[None, :]
            tl.store(into + WEIGHTS_AT[layer] + output[:, None] * read + column[None, :], total, mask=there)
            biases = into + WEIGHTS_AT[layer] + read * OUTPUTS[layer] + output
            tl.store(biases, of_bias, mask=(output < OUTPUTS[layer]) & (number % tiles + 0 * output == 0))


@no_type_check
@triton.jit
def _sum_directions(
    parameters, coefficients, flat, start, before, after, b, c, TOTAL: tl.constexpr, WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """A program writes a row of the last layer, or copies numbers of the layers before it."""
    program, column = tl.program_id(0), tl.arange(0, WIDTH)
    own, biases = parameters + start, parameters + start + TOTAL * before
    if program >= after:
        at = (program - after) * BLOCK + tl.arange(0, BLOCK)
        tl.store(flat + at, tl.load(parameters + at, mask=at < start), mask=at < start)
    else:
        axis, frame = program % 3, program // 3 - 1
        row = tl.where(program < 3, axis * (1 + c), program - 3 * b - 3 + 3 * (1 + c))
        weight = tl.zeros([WIDTH], flat.dtype.element_ty)
        bias = tl.sum(tl.zeros([1], flat.dtype.element_ty), 0)
        if (program >= 3) & (program < 3 + 3 * b):
            for number in range(c):
                share, row = tl.load(coefficients + frame * c + number), axis * (1 + c) + 1 + number
                weight += share * tl.load(own + row * TOTAL + column, mask=column < TOTAL, other=0.0)
                bias += share * tl.load(biases + row)
        else:
            weight += tl.load(own + row * TOTAL + column, mask=column < TOTAL, other=0.0)
            bias += tl.load(biases + row)
        tl.store(flat + start + program * TOTAL + column, weight, mask=column < TOTAL)
        tl.store(flat + start + after * TOTAL + program, bias)


@no_type_check
@triton.jit
def _sum_directions_backward(
    by_flat, parameters, coefficients, by_parameters, by_coefficients, start, before, after, b, c,
    TOTAL: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The first 1 + c programs take a direction's three rows each, the next ones another row, the others copy."""
    program, column = tl.program_id(0), tl.arange(0, WIDTH)
    there, rows = column < TOTAL, before - 2 * (1 + c)
    own, biases = parameters + start, parameters + start + TOTAL * before
    given, given_biases = by_flat + start, by_flat + start + TOTAL * after
    into, into_biases = by_parameters + start, by_parameters + start + TOTAL * before
    if program >= rows:
        at = (program - rows) * BLOCK + tl.arange(0, BLOCK)
        tl.store(by_parameters + at, tl.load(by_flat + at, mask=at < start), mask=at < start)
    elif program > c:
        other, row = program - (1 + c) + 3 + 3 * b, program + 2 * (1 + c)
        tl.store(into + row * TOTAL + column, tl.load(given + other * TOTAL + column, mask=there), mask=there)
        tl.store(into_biases + row, tl.load(given_biases + other))
    elif program == 0:
        for axis in tl.static_range(3):
            row = axis * (1 + c)
            tl.store(into + row * TOTAL + column, tl.load(given + axis * TOTAL + column, mask=there), mask=there)
            tl.store(into_biases + row, tl.load(given_biases + axis))
    else:
        for axis in tl.static_range(3):
            row = axis * (1 + c) + program
            gradient = tl.zeros([WIDTH], by_flat.dtype.element_ty)
            of_bias = tl.sum(tl.zeros([1], by_flat.dtype.element_ty), 0)
            for frame in range(b):
                share, source = tl.load(coefficients + frame * c + program - 1), 3 + 3 * frame + axis
                gradient += share * tl.load(given + source * TOTAL + column, mask=there, other=0.0)
                of_bias += share * tl.load(given_biases + source)
            tl.store(into + row * TOTAL + column, gradient, mask=there)
            tl.store(into_biases + row, of_bias)
        for frame in range(b):
            total = tl.sum(tl.zeros([1], by_flat.dtype.element_ty), 0)
            for axis in tl.static_range(3):
                row, source = axis * (1 + c) + program, 3 + 3 * frame + axis
                weight = tl.load(own + row * TOTAL + column, mask=there, other=0.0)
                total += tl.sum(weight * tl.load(given + source * TOTAL + column, mask=there, other=0.0), 0)
                total += tl.load(biases + row) * tl.load(given_biases + source)
            tl.store(by_coefficients + frame * c + program - 1, total)
