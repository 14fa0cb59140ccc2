"""SIMD values for numba: consecutive float32 numbers in vector registers.

Needed because numba compiles short loops to scalar instructions and assumes that rows may overlap.
"""

import operator

from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model

from nerf_lightning.kernels.cpu.jit import jit


class SimdType(types.Type):
    """Numba type of `width` float32 numbers."""

    def __init__(self, width):
        self.width = width
        super().__init__(name=f"Lanes({width})")

    def __len__(self):
        return self.width


@register_model(SimdType)
class _SimdModel(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        super().__init__(manager, lanes, ir.VectorType(ir.FloatType(), lanes.width))


def _pointer(context, builder, types_, values, width):
    """Pointer to `width` numbers of an array's row, given array, row and first column."""
    array = context.make_array(types_[0])(context, builder, values[0])
    indices = [context.cast(builder, values[i], types_[i], types.intp) for i in (1, 2)]
    pointer = cgutils.get_item_pointer(context, builder, types_[0], array, indices, wraparound=False)
    return builder.bitcast(pointer, ir.VectorType(ir.FloatType(), width).as_pointer())


@intrinsic
def load(typing, array, row, first, lanes):
    """Loads array[row, first : first + len(lanes)] of a C-ordered float32 array; `lanes` is any tuple of that length."""
    width = len(lanes)

    def code(context, builder, signature, values):
        return builder.load(_pointer(context, builder, signature.args, values, width), align=4)

    return SimdType(width)(array, row, first, lanes), code


@intrinsic
def store(typing, array, row, first, values):
    """Stores array[row, first : first + width] = values."""

    def code(context, builder, signature, args):
        builder.store(args[3], _pointer(context, builder, signature.args, args, values.width), align=4)
        return context.get_dummy_value()

    return types.none(array, row, first, values), code


@intrinsic
def prefetch(typing, array, row, first):
    """Prefetches the cache line of array[row, first]."""

    def code(context, builder, signature, values):
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        pointer = builder.bitcast(_pointer(context, builder, signature.args, values, 1), byte)
        builder.call(function, [pointer, number(0), number(3), number(1)])  # read, high locality, data cache
        return context.get_dummy_value()

    return types.none(array, row, first), code


@intrinsic
def broadcast(typing, a, lanes):
    """Vector of `a` in every lane; `lanes` is a tuple or a vector of that length."""
    width = len(lanes)

    def code(context, builder, signature, values):
        empty = ir.Constant(ir.VectorType(ir.FloatType(), width), ir.Undefined)
        first = builder.insert_element(empty, values[0], ir.IntType(32)(0))
        return _shuffle(builder, first, empty, [0] * width)

    return SimdType(width)(types.float32, lanes), code


@intrinsic
def horizontal_sum(typing, a):
    """Sum of all lanes by recursive halving."""

    def code(context, builder, signature, values):
        vector, width = values[0], 1 << (a.width - 1).bit_length()
        zeros = ir.Constant(vector.type, [0.0] * a.width)
        vector = _shuffle(builder, vector, zeros, [min(i, a.width) for i in range(width)])  # pad to a power of two
        while width > 1:
            width //= 2
            first, second = (_shuffle(builder, vector, vector, range(start, start + width)) for start in (0, width))
            vector = builder.fadd(first, second)
        return builder.extract_element(vector, ir.IntType(32)(0))

    return types.float32(a), code


def _shuffle(builder, first, second, indices):
    """Elements of the concatenation of two vectors at these indices."""
    mask = ir.Constant(ir.VectorType(ir.IntType(32), len(indices)), list(indices))
    return builder.shuffle_vector(first, second, mask)


FEATURES = binding.get_host_cpu_features()
HAS_FMA = FEATURES.get("fma", True)
"""Whether the processor has fused multiply-add; only some x86 ones lack it."""
MAX_LANES = 16 if FEATURES.get("avx512f", False) else 8
"""Lanes of the widest vector; with registers of four lanes, LLVM splits it."""


@intrinsic
def fma(typing, a, b, c):
    """Fused a * b + c of scalars or vectors of one width; rounds twice without hardware support."""

    def code(context, builder, signature, values):
        if not HAS_FMA:
            return builder.fadd(builder.fmul(values[0], values[1]), values[2])
        kind = values[0].type
        name = f"llvm.fma.v{a.width}f32" if isinstance(a, SimdType) else "llvm.fma.f32"
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind] * 3), name)
        return builder.call(function, values)

    return a(a, a, a), code


@intrinsic
def rectify(typing, a):
    """ReLU of every lane; keeps NaN."""

    def code(context, builder, signature, values):
        zero = ir.Constant(values[0].type, [0.0] * a.width)
        return builder.select(builder.fcmp_ordered("<", values[0], zero), zero, values[0])

    return a(a), code


@intrinsic
def interpolate_lanes(typing, table, unit, first, cells, factors, mask, out, features, hashed, lanes):
    """Trilinear interpolation: fills out[:, n] for the n of first : first + len(lanes), rounded as in scalar code.

    Args:
        table, unit, out: [T, F], [3, N] and [F, N], F = len(features); pairs of features are gathered as one double.
        cells: cells along the three axes; int32, as `factors` and `mask`.
        factors: factor of each coordinate in a vertex's row. The products are added; with `hashed`, a tuple, not empty,
            they are combined by XOR and masked.
    """
    width, pack, hashes = len(lanes), 2 - len(features) % 2, len(hashed) > 0
    element = ir.DoubleType() if pack == 2 else ir.FloatType()
    vector, packed = ir.VectorType(ir.FloatType(), width), ir.VectorType(ir.FloatType(), pack * width)
    whole, bits = ir.VectorType(ir.IntType(32), width), ir.VectorType(ir.IntType(1), width)
    places, loaded = ir.VectorType(element.as_pointer(), width), ir.VectorType(element, width)
    row = ir.ArrayType(element, len(features) // pack)

    def code(context, builder, signature, values):
        kinds, number = signature.args, ir.IntType(32)
        name = f"llvm.masked.gather.v{width}f{32 * pack}.v{width}p0"
        gather = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(loaded, [places, number, bits, loaded]), name
        )
        base = builder.bitcast(context.make_array(kinds[0])(context, builder, values[0]).data, row.as_pointer())

        def splat(value):
            empty = ir.Constant(ir.VectorType(value.type, width), ir.Undefined)
            return _shuffle(builder, builder.insert_element(empty, value, number(0)), empty, [0] * width)

        def entry(index, column):
            place = builder.gep(base, [index, number(column)], source_etype=row)
            place.type = places  # llvmlite takes the scalar's
            arguments = place, number(4), ir.Constant(bits, [1] * width), ir.Constant(loaded, ir.Undefined)
            return builder.bitcast(builder.call(gather, arguments), packed)

        zero, one, corners = ir.Constant(vector, [0.0] * width), ir.Constant(vector, [1.0] * width), [(None, None)]
        for axis in range(3):
            sides, factor = (splat(builder.extract_value(values[i], axis)) for i in (3, 4))
            where = (kinds[1], types.intp, kinds[2]), (values[1], ir.IntType(64)(axis), values[2])
            x = builder.load(_pointer(context, builder, *where, width), align=4)
            x = builder.select(builder.fcmp_ordered("<", x, zero), zero, x)  # keeps NaN
            x = builder.select(builder.fcmp_ordered(">", x, one), one, x)
            scaled, last = (
                builder.fmul(x, builder.sitofp(sides, vector)),
                builder.sub(sides, ir.Constant(whole, [1] * width)),
            )
            cell = builder.fptosi(scaled, whole)
            cell = builder.select(builder.icmp_unsigned("<", cell, last), cell, last)
            fraction, low = builder.fsub(scaled, builder.sitofp(cell, vector)), builder.mul(cell, factor)
            ends = (low, builder.fsub(one, fraction)), (builder.add(low, factor), fraction)
            combine = builder.xor if hashes else builder.add
            corners = [
                end if index is None else (combine(index, end[0]), builder.fmul(weight, end[1]))
                for index, weight in corners
                for end in ends
            ]
        if hashes:
            corners = [(builder.and_(index, splat(values[5])), weight) for index, weight in corners]
        repeated = [lane // pack for lane in range(pack * width)]
        weights = [_shuffle(builder, weight, weight, repeated) for _, weight in corners]
        for column in range(len(features) // pack):
            terms = [builder.fmul(w, entry(index, column)) for (index, _), w in zip(corners, weights, strict=True)]
            while len(terms) > 1:
                terms = [builder.fadd(*pair) for pair in zip(terms[::2], terms[1::2], strict=True)]
            for part in range(pack):
                number_of_row = ir.IntType(64)(pack * column + part)
                where = (kinds[6], types.intp, kinds[2]), (values[6], number_of_row, values[2])
                value = _shuffle(builder, terms[0], terms[0], range(part, pack * width, pack))
                builder.store(value, _pointer(context, builder, *where, width), align=4)
        return context.get_dummy_value()

    return types.none(table, unit, first, cells, factors, mask, out, features, hashed, lanes), code


@intrinsic
def transpose(typing, source, row, column, target, to_row, to_column, lanes):
    """Transposes a square: target[to_row + j, to_column + i] = source[row + i, column + j] for i, j < len(lanes) = 2^n."""
    width = len(lanes)

    def code(context, builder, signature, values):
        def pointers(start):
            """Pointers to the rows of a square, given the index of its array among the arguments."""
            array, first, column = values[start : start + 3]
            kinds = signature.args[start], types.intp, signature.args[start + 2]
            first = context.cast(builder, first, signature.args[start + 1], types.intp)
            numbers = [builder.add(first, first.type(i)) for i in range(width)]
            return [_pointer(context, builder, kinds, (array, number, column), width) for number in numbers]

        rows, half = [builder.load(pointer, align=4) for pointer in pointers(0)], width // 2
        lower = [i // 2 + width * (i % 2) for i in range(width)]
        mixes = lower, [index + half for index in lower]
        for _ in range(width.bit_length() - 1):  # each pass moves one bit of the index from column to row
            rows = [_shuffle(builder, rows[i], rows[i + half], mix) for i in range(half) for mix in mixes]
        for row_vector, pointer in zip(rows, pointers(3), strict=True):
            builder.store(row_vector, pointer, align=4)
        return context.get_dummy_value()

    return types.none(source, row, column, target, to_row, to_column, lanes), code


@jit
def transpose_blocks(source, row, column, target, to_row, to_column, height, width, block):
    """Transposes a rectangle, as `transpose` with i < height and j < width, in squares of side len(block)."""
    side = len(block)
    for i in range(0, height - side + 1, side):
        for j in range(0, width - side + 1, side):
            transpose(source, row + i, column + j, target, to_row + j, to_column + i, block)
    for i in range(height):
        for j in range(width - width % side if i < height - height % side else 0, width):
            target[to_row + j, to_column + i] = source[row + i, column + j]


@intrinsic
def _emit_add(typing, a, b):
    return a(a, b), lambda context, builder, signature, values: builder.fadd(*values)


@intrinsic
def _emit_multiply(typing, a, b):
    return a(a, b), lambda context, builder, signature, values: builder.fmul(*values)


@overload(operator.add)
def _add(a, b):
    if isinstance(a, SimdType) and a == b:
        return lambda a, b: _emit_add(a, b)


@overload(operator.mul)
def _multiply(a, b):
    if isinstance(a, SimdType) and a == b:
        return lambda a, b: _emit_multiply(a, b)
    if a == types.float32 and isinstance(b, SimdType):
        return lambda a, b: _emit_multiply(broadcast(a, b), b)
