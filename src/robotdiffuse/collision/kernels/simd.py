"""SIMD in compiled code: sixteen float32 numbers as one value of the type `Lanes`, LLVM's <16 x float>.

Operations on lanes become SIMD instructions without relying on LLVM's vectorizer: one instruction each with
AVX-512, two with AVX2, four with SSE or NEON. `+ - * /` take two values of lanes, or lanes and a float32,
which is broadcast. `a < b` returns a mask: an int64 with bit i set if lane i of a is less than lane i of b.
The compiler may contract arithmetic to fused multiply-add, and assumes that no value is NaN and that the sign
of zeros does not matter.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel.models import PrimitiveModel
from numba.core.datamodel.registry import register_default
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic
from numpy import ndarray

from robotdiffuse.core.kernels import allocation_free, kernel

W = 16
"""Number of lanes. It is also the number of configurations in a block, and of spheres or obstacles in a
row."""
_FLAGS = ("nnan", "nsz", "contract")
_FLOAT = ir.FloatType()
_BITS = ir.IntType(64)
_VECTOR = ir.VectorType(_FLOAT, W)
_INTEGERS = ir.VectorType(ir.IntType(32), W)
# Indices of a shuffle that copies element 0 to all lanes
_FIRST_TO_ALL = ir.Constant(_INTEGERS, [0] * W)
# Alignment that loads, stores and gathers rely on [bytes]: that of one float32
_ALIGN = 4
# typed as Any, since callers of intrinsics omit the first argument, the context
_operation: Any = intrinsic


class LanesType(types.Type):
    """Numba's type of 16 float32 numbers."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


LANES = LanesType()


@register_default(LanesType)
class _LanesModel(PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: types.Type) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _splat(builder: Any, scalar: Any, kind: ir.Type = _VECTOR) -> Any:
    """A vector of this kind with the number in all lanes."""
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(_BITS, 0))
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), _FIRST_TO_ALL)


@lower_cast(types.float32, LanesType)
def _float_to_lanes(_context: Any, builder: Any, _from: Any, _to: Any, value: Any) -> Any:
    return _splat(builder, value)


def _call(builder: Any, name: str, arguments: list[Any], result: ir.Type = _VECTOR) -> Any:
    """An LLVM intrinsic for vectors of 16 float32 numbers."""
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{W}f32")
    return builder.call(function, arguments, fastmath=_FLAGS)


def _mask(builder: Any, bits: Any) -> Any:
    return builder.zext(builder.bitcast(bits, ir.IntType(W)), _BITS)


def _define_operator(function: Callable, result: types.Type, build: Callable[[Any, Any, Any], Any]) -> None:
    """Define a binary operator on lanes; `build` takes the builder and two vectors."""

    class Template(AbstractTemplate):
        key = function

        def generic(self, args: tuple, kws: dict) -> Any:
            if len(args) == 2 and LANES in args and all(arg in (LANES, types.float32) for arg in args):
                return signature(result, LANES, LANES)
            return None

    infer_global(function, types.Function(Template))

    @lower_builtin(function, LANES, LANES)
    def lowered(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return build(builder, *args)


_define_operator(operator.add, LANES, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
_define_operator(operator.sub, LANES, lambda builder, a, b: builder.fsub(a, b, flags=_FLAGS))
_define_operator(operator.mul, LANES, lambda builder, a, b: builder.fmul(a, b, flags=_FLAGS))
_define_operator(operator.truediv, LANES, lambda builder, a, b: builder.fdiv(a, b, flags=_FLAGS))
_define_operator(
    operator.lt,
    types.int64,
    lambda builder, a, b: _mask(builder, builder.fcmp_ordered("<", a, b, flags=_FLAGS)),
)


def _elementwise(name: str, count: int) -> Any:
    """An elementwise LLVM intrinsic of one or two arguments, each lanes or a float32."""
    lane_types = (LANES, types.float32)

    def generated(context: Any, *args: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, values: Any) -> Any:
            casted = [context.cast(builder, v, t, LANES) for v, t in zip(values, args, strict=True)]
            return _call(builder, name, casted)

        return (LANES(*args), codegen) if all(arg in lane_types for arg in args) else None

    if count == 1:
        return _operation(lambda context, a: generated(context, a))
    return _operation(lambda context, a, b: generated(context, a, b))


minimum = _elementwise("minnum", 2)
maximum = _elementwise("maxnum", 2)
absolute = _elementwise("fabs", 1)
copysign = _elementwise("copysign", 2)
sqrt = _elementwise("sqrt", 1)
floor = _elementwise("floor", 1)


def _reduction(name: str) -> Any:
    """An LLVM intrinsic that reduces lanes to a float32."""

    def generated(_context: Any, a: Any) -> Any:
        def codegen(_context: Any, builder: Any, _sig: Any, values: Any) -> Any:
            return _call(builder, f"vector.reduce.{name}", list(values), _FLOAT)

        return (types.float32(a), codegen) if a == LANES else None

    return _operation(generated)


reduce_min = _reduction("fmin")
reduce_max = _reduction("fmax")


def _address(context: Any, builder: Any, array_type: Any, array: Any, row: Any, part: Any) -> Any:
    """Address of array[row, 16 * part] in a contiguous array."""
    struct = context.make_array(array_type)(context, builder, array)
    columns = cgutils.unpack_tuple(builder, struct.shape, 2)[1]
    size = columns.type
    start = builder.add(
        builder.mul(builder.sext(row, size) if row.type != size else row, columns),
        builder.mul(builder.sext(part, size) if part.type != size else part, ir.Constant(size, W)),
    )
    return builder.gep(struct.data, [start])


def _holds_floats(array: Any, dimensions: int) -> bool:
    return isinstance(array, types.Array) and (array.dtype, array.ndim, array.layout) == (
        types.float32,
        dimensions,
        "C",
    )


@_operation
def lane_numbers(_context: Any) -> Any:
    """Lanes with the values 0 to 15: lane i has the value i."""
    return LANES(), lambda *_: ir.Constant(_VECTOR, [float(i) for i in range(W)])


@_operation
def load(_context: Any, array: Any, row: Any, part: Any) -> Any:
    """Lanes loaded from array[row, 16 * part :] of a C-contiguous float32 array."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _address(context, builder, sig.args[0], *args)
        return builder.load(builder.bitcast(pointer, _VECTOR.as_pointer()), align=_ALIGN, typ=_VECTOR)

    return (LANES(array, row, part), codegen) if _holds_floats(array, 2) else None


@_operation
def store(_context: Any, array: Any, row: Any, part: Any, value: Any) -> Any:
    """Stores lanes to array[row, 16 * part :] of a C-contiguous float32 array."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _address(context, builder, sig.args[0], *args[:3])
        builder.store(args[3], builder.bitcast(pointer, _VECTOR.as_pointer()), align=_ALIGN)
        return context.get_dummy_value()

    return (
        (types.void(array, row, part, value), codegen) if _holds_floats(array, 2) and value == LANES else None
    )


@_operation
def gather(_context: Any, array: Any, index: Any) -> Any:
    """Lanes gathered from a contiguous float32 array; `index` holds integers as float32 lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        places: Any = builder.gep(data, [builder.fptosi(args[1], _INTEGERS)], source_etype=_FLOAT)
        places.type = ir.VectorType(ir.PointerType(), W)  # llvmlite does not infer it for vectors of indices
        everywhere = ir.Constant(ir.VectorType(ir.IntType(1), W), [1] * W)
        operands = [
            places,
            ir.Constant(ir.IntType(32), _ALIGN),
            everywhere,
            ir.Constant(_VECTOR, ir.Undefined),
        ]
        kind = ir.FunctionType(_VECTOR, [value.type for value in operands])
        name = f"llvm.masked.gather.v{W}f32.v{W}p0"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), operands)

    return (LANES(array, index), codegen) if _holds_floats(array, 1) and index == LANES else None


@_operation
def lane(_context: Any, a: Any, i: Any) -> Any:
    """The number in lane i."""

    def codegen(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return builder.extract_element(*args)

    return (types.float32(a, i), codegen) if a == LANES else None


@_operation
def lanes_with_bit(_context: Any, a: Any, bit: Any) -> Any:
    """Mask of the lanes for which (the integer value & `bit`) is not 0."""

    def codegen(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        numbers = builder.fptosi(args[0], _INTEGERS)
        common = builder.and_(numbers, _splat(builder, args[1], _INTEGERS))
        return _mask(builder, builder.icmp_unsigned("!=", common, ir.Constant(_INTEGERS, [0] * W)))

    return (types.int64(a, bit), codegen) if a == LANES and bit == types.int32 else None


@_operation
def first_lane(_context: Any, mask: Any) -> Any:
    """The first lane in a mask that is not empty: the index of the lowest set bit."""

    def codegen(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return (types.int64(mask), codegen) if mask == types.int64 else None


@allocation_free(forceinline=True)
def load_vector(array, row, part):
    """A vector in each of 16 lanes. From array[row, 16 * part :], 16 numbers are loaded for x, then 16 for y
    and 16 for z."""
    return load(array, row, part), load(array, row, part + 1), load(array, row, part + 2)


@allocation_free(forceinline=True)
def store_vector(array, row, part, vector):
    """Stores the vectors of 16 lanes to array[row, 16 * part :], as `load_vector` reads them."""
    store(array, row, part, vector[0])
    store(array, row, part + 1, vector[1])
    store(array, row, part + 2, vector[2])


@allocation_free(forceinline=True)
def vector_in(vectors, i):
    """The vector in lane i."""
    return lane(vectors[0], i), lane(vectors[1], i), lane(vectors[2], i)


@kernel()
def lanes_array(rows, parts):
    """Zeros [rows, parts * 16], aligned to cache lines, so that no load or store of lanes touches two cache
    lines."""
    size = rows * parts * W
    memory = np.zeros(size + W, np.float32)
    start = -(memory.ctypes.data // 4) % W
    return memory[start : start + size].reshape((rows, parts * W))


def by_sixteen(rows: ndarray, fill: ndarray) -> ndarray:
    """Rearranges rows [n, k] in groups of sixteen, [ceil(n / 16), k * 16]: a group is column 0 of sixteen
    rows, then their column 1, and so on.

    The last group is filled up with copies of `fill` [1, k].
    """
    n, k = rows.shape
    filled = np.concatenate([rows, np.repeat(fill, -n % W, axis=0)]).astype(np.float32)
    return np.ascontiguousarray(filled.reshape(-1, W, k).swapaxes(1, 2)).reshape(-1, k * W)
