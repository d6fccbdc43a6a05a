"""Numba types of vectors of numbers ("lanes") and of their masks, and the machine code of their
operators. Other modules import `lanes.py`, which also explains lanes.
"""

# ruff: noqa: ANN401, ARG001, ARG002 the interfaces of numba and llvmlite have no types
# mypy: disable-error-code="no-untyped-call, untyped-decorator"

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any, Final

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, lower_cast, models, register_model

from schemas.runtime.records import LANES

DOUBLE: Final = ir.DoubleType()
LONG: Final = ir.IntType(64)
INDEX: Final = ir.IntType(32)
VECTOR: Final = ir.VectorType(DOUBLE, LANES)
LONG_VECTOR: Final = ir.VectorType(LONG, LANES)
BIT_VECTOR: Final = ir.VectorType(ir.IntType(1), LANES)
ANY_BYTE: Final = 8  # [bytes] alignment of vectors in memory: that of a single number
INVERSE_BITS: Final = 0x7FDE623822FC16E6
INVERSE_ROOT_BITS: Final = 0x5FE6EB50C7B537A9
FUSED: Final = ("contract",)  # LLVM flag: a*b + c may become one instruction, which rounds once


class LanesType(types.Type):
    """Numba type of one vector register with LANES float64 numbers ("lanes")."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")

    def can_convert_from(self, typingctx: Any, other: Any) -> Conversion | None:
        """Return `Conversion.safe` if `other` is the type of a single number, because a number can
        be copied into all lanes of the vector; else None.
        """
        return Conversion.safe if isinstance(other, types.Float | types.Integer) else None

    def unify(self, typingctx: Any, other: Any) -> LanesType | None:
        """Return the type of a variable that holds a vector in one branch of the code and a value
        of type `other` in another. This is the vector type if `other` is a number's type, else
        None.
        """
        return self if isinstance(other, types.Float | types.Integer) else None


class MaskType(types.Type):
    """Numba type of a mask: LANES truth values, the result of a comparison of two vectors."""

    def __init__(self) -> None:
        super().__init__(name="LanesMask")

    def can_convert_from(self, typingctx: Any, other: Any) -> Conversion | None:
        """Return `Conversion.safe` if `other` is the type of a single truth value, because it can
        be copied into all lanes of the mask; else None.
        """
        return Conversion.safe if isinstance(other, types.Boolean) else None


LANES_TYPE: Final = LanesType()
MASK_TYPE: Final = MaskType()


@register_model(LanesType)
class LanesModel(models.PrimitiveModel):
    """Storage of Numba values of the type LanesType: an LLVM vector of numbers."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


@register_model(MaskType)
class MaskModel(models.PrimitiveModel):
    """Storage of Numba values of the type MaskType: an LLVM vector of bits."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, BIT_VECTOR)


def spread_value(builder: Any, value: Any, vector: Any) -> Any:
    """Generate code that copies `value` into all lanes of a new vector of the LLVM type `vector`;
    return the LLVM value of this vector.
    """
    empty = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(empty, value, INDEX(0))
    places = ir.Constant(ir.VectorType(INDEX, LANES), [INDEX(0)] * LANES)
    return builder.shuffle_vector(first, empty, places)


@lower_cast(types.Float, LanesType)
@lower_cast(types.Integer, LanesType)
def cast_number(context: Any, builder: Any, source_type: Any, target_type: Any, value: Any) -> Any:
    """Generate code that copies the number `value` into all lanes of a new vector; return the LLVM
    value of this vector.
    """
    return spread_value(builder, context.cast(builder, value, source_type, types.float64), VECTOR)


@lower_cast(types.Boolean, MaskType)
def cast_truth(context: Any, builder: Any, source_type: Any, target_type: Any, value: Any) -> Any:
    """Generate code that copies the truth value `value` into all lanes of a new mask; return the
    LLVM value of this mask.
    """
    return spread_value(builder, cgutils.as_bool_bit(builder, value), BIT_VECTOR)


def call_llvm(builder: Any, name: str, *args: Any) -> Any:
    """Generate a call of the LLVM intrinsic `name`, for example "sqrt". The arguments are LLVM
    values of single numbers or of vectors. Return the LLVM value of the result.
    """
    kind = args[0].type
    function = cgutils.get_or_insert_function(
        builder.module,
        ir.FunctionType(kind, [kind] * len(args)),
        f"llvm.{name}.v{LANES}f64" if kind == VECTOR else f"llvm.{name}.f64",
    )
    return builder.call(function, args)


def choose_lanes(builder: Any, sign: str, a: Any, b: Any) -> Any:
    """Generate code that chooses between two vectors lane by lane. The result has the number of `a`
    where `a sign b` holds (`sign` is for example "<"), else that of `b`. NaN in either vector
    selects `b`.
    """
    return builder.select(builder.fcmp_ordered(sign, a, b), a, b)


def _is_number(kind: Any) -> bool:
    return isinstance(kind, LanesType | types.Float | types.Integer)


def _is_truth(kind: Any) -> bool:
    return isinstance(kind, MaskType | types.Boolean)


def _register(function: Any, arguments: int, given: Any, result: Any, lower: Any) -> None:
    """Register a code generator with Numba.

    Args:
        function: function or operator for whose calls code is generated, for example
            `operator.add`.
        arguments: number of its arguments.
        given: vector or mask type. The registration applies to calls in which at least one argument
            has this type; the others may be single numbers or truth values.
        result: type of the result.
        lower: code generator, called with the LLVM builder and the LLVM values of the arguments.
            All arguments have been converted to the type `given`.
    """
    fits: Callable[[Any], bool] = _is_number if given is LANES_TYPE else _is_truth

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if kws or len(args) != arguments or given not in args or not all(map(fits, args)):
                return None
            return signature(result, *[given] * arguments)

    infer_global(function)(Template)

    @lower_builtin(function, *[type(given)] * arguments)
    def _lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return lower(builder, *args)


def _register_arithmetic() -> None:
    lowers: dict[Any, Any] = {
        operator.add: lambda builder, a, b: builder.fadd(a, b, flags=FUSED),
        operator.sub: lambda builder, a, b: builder.fsub(a, b, flags=FUSED),
        operator.mul: lambda builder, a, b: builder.fmul(a, b, flags=FUSED),
        operator.truediv: lambda builder, a, b: builder.fdiv(a, b),
        max: lambda builder, a, b: choose_lanes(builder, ">", a, b),
        min: lambda builder, a, b: choose_lanes(builder, "<", a, b),
    }
    lowers[operator.iadd] = lowers[operator.add]
    lowers[operator.isub] = lowers[operator.sub]
    lowers[operator.imul] = lowers[operator.mul]
    for function, lower in lowers.items():
        _register(function, 2, LANES_TYPE, LANES_TYPE, lower)
    singles: dict[Any, Any] = {
        operator.neg: lambda builder, a: builder.fneg(a),
        abs: lambda builder, a: call_llvm(builder, "fabs", a),
        math.sqrt: lambda builder, a: call_llvm(builder, "sqrt", a),
    }
    for function, lower in singles.items():
        _register(function, 1, LANES_TYPE, LANES_TYPE, lower)


def _register_comparisons() -> None:
    signs: dict[Any, str] = {
        operator.lt: "<",
        operator.le: "<=",
        operator.gt: ">",
        operator.ge: ">=",
        operator.eq: "==",
    }
    for function, sign in signs.items():
        _register(
            function,
            2,
            LANES_TYPE,
            MASK_TYPE,
            lambda builder, a, b, sign=sign: builder.fcmp_ordered(sign, a, b),
        )
    _register(operator.and_, 2, MASK_TYPE, MASK_TYPE, lambda builder, a, b: builder.and_(a, b))
    _register(operator.or_, 2, MASK_TYPE, MASK_TYPE, lambda builder, a, b: builder.or_(a, b))


_register_arithmetic()
_register_comparisons()


def find_vector(target: Any, builder: Any, sig: Any, values: Any) -> Any:
    """Generate code that computes the address of one vector (LANES numbers) in an array; return
    this pointer. `sig` is the signature of an intrinsic. Its first two arguments are the array, and
    the position: an index, or a tuple with one index for each axis except the last (the lanes).
    """
    kind = sig.args[0]
    data = target.make_array(kind)(target, builder, values[0])
    shape = cgutils.unpack_tuple(builder, data.shape, kind.ndim)
    place = sig.args[1]
    kinds = getattr(place, "types", (place,))
    parts = cgutils.unpack_tuple(builder, values[1]) if len(kinds) > 1 else [values[1]]
    row = LONG(0)
    for axis, (part, given) in enumerate(zip(parts, kinds, strict=True)):
        index = target.cast(builder, part, given, types.intp)
        row = builder.add(builder.mul(row, shape[axis]), index)
    pointer = builder.bitcast(data.data, VECTOR.as_pointer())
    return builder.gep(pointer, [row], inbounds=True)


def type_load(context: Any, array: Any, place: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `lanes_at`, which loads a vector
    from an array.
    """

    def generate_code(target: Any, builder: Any, sig: Any, values: Any) -> Any:
        return builder.load(find_vector(target, builder, sig, values), align=ANY_BYTE)

    return LANES_TYPE(array, place), generate_code


def type_store(context: Any, array: Any, place: Any, value: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `put_lanes`, which stores a
    vector into an array.
    """

    def generate_code(target: Any, builder: Any, sig: Any, values: Any) -> Any:
        builder.store(values[2], find_vector(target, builder, sig, values), align=ANY_BYTE)
        return target.get_dummy_value()

    return types.void(array, place, LANES_TYPE), generate_code


def type_select(context: Any, where: Any, first: Any, other: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `select`, which takes each lane
    from the first of two vectors where a mask is True, else from the second.
    """
    wide = any(isinstance(kind, LanesType | MaskType) for kind in (where, first, other))
    number = LANES_TYPE if wide else types.float64
    truth = MASK_TYPE if isinstance(where, MaskType) else types.boolean

    def generate_code(target: Any, builder: Any, sig: Any, values: Any) -> Any:
        bit = values[0] if truth is MASK_TYPE else cgutils.as_bool_bit(builder, values[0])
        return builder.select(bit, values[1], values[2])

    return number(truth, number, number), generate_code


def _reduce(combine: Callable[[Any, Any, Any], Any]) -> Any:
    """Return a code generator that reduces a vector to one number. In the generated code, `combine`
    joins the lower and upper half of the vector lane by lane, again and again, until one number is
    left. The order of the operations is therefore fixed.
    """

    def generate_code(target: Any, builder: Any, sig: Any, values: Any) -> Any:
        value = values[0]
        width = LANES
        while width > 1:
            width //= 2
            halves = []
            for begin in (0, width):
                places = [INDEX(begin + lane) for lane in range(width)]
                mask = ir.Constant(ir.VectorType(INDEX, width), places)
                halves.append(builder.shuffle_vector(value, value, mask))
            value = combine(builder, *halves)
        return builder.extract_element(value, INDEX(0))

    return generate_code


def type_sum(context: Any, value: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `sum_lanes`, which adds the
    numbers of a vector.
    """
    return types.float64(LANES_TYPE), _reduce(lambda builder, a, b: builder.fadd(a, b))


def type_largest(context: Any, value: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `largest_lane`, which returns
    the largest number of a vector.
    """
    return types.float64(LANES_TYPE), _reduce(
        lambda builder, a, b: choose_lanes(builder, ">", a, b)
    )


def type_any(context: Any, mask: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `any_lane`, which returns True
    if any truth value of a mask is True.
    """

    def generate_code(target: Any, builder: Any, sig: Any, values: Any) -> Any:
        if isinstance(mask, types.Boolean):
            return values[0]
        bits = builder.bitcast(values[0], ir.IntType(LANES))
        found = builder.icmp_unsigned("!=", bits, ir.IntType(LANES)(0))
        return target.cast(builder, found, types.boolean, types.boolean)

    return types.boolean(mask), generate_code


def type_gather_pair(context: Any, table: Any, cell: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `gather_pair`, which returns two
    vectors of values read from `table`. Each lane of the vector `cell` is the index of the value in
    the first vector; the value in the second vector is the next one of the table.

    Each pair is loaded at once, and the pairs are then transposed, because some processors gather
    single numbers slowly. The indices are converted to 32 bits and moved to the address registers
    in pairs of 64 bits.
    """
    number = LANES_TYPE if isinstance(cell, LanesType) else types.float64

    def generate_code(target: Any, builder: Any, sig: Any, values: Any) -> Any:
        data = target.make_array(sig.args[0])(target, builder, values[0]).data
        if number is not LANES_TYPE:
            place = builder.fptosi(values[1], LONG)
            parts = [
                builder.load(builder.gep(data, [builder.add(place, LONG(k))])) for k in range(2)
            ]
            return target.make_tuple(builder, sig.return_type, parts)
        places = builder.fptosi(values[1], ir.VectorType(INDEX, LANES))
        halves = builder.bitcast(places, ir.VectorType(LONG, LANES // 2))
        pair = ir.VectorType(DOUBLE, 2)
        pairs = []
        for lane in range(LANES):
            both = builder.extract_element(halves, INDEX(lane // 2))
            shift = LONG(32 * (1 - lane % 2))
            place = builder.lshr(builder.shl(both, shift), LONG(32))
            start = builder.gep(data, [place])
            pairs.append(builder.load(builder.bitcast(start, pair.as_pointer()), align=ANY_BYTE))
        even = _join_vectors(builder, pairs[0::2])
        odd = _join_vectors(builder, pairs[1::2])
        parts = []
        for k in range(2):
            mask = [INDEX(k + 2 * (lane // 2) + LANES * (lane % 2)) for lane in range(LANES)]
            kind = ir.VectorType(INDEX, LANES)
            parts.append(builder.shuffle_vector(even, odd, ir.Constant(kind, mask)))
        return target.make_tuple(builder, sig.return_type, parts)

    return types.UniTuple(number, 2)(table, cell), generate_code


def _join_vectors(builder: Any, parts: list[Any]) -> Any:
    """Generate code that joins vectors of equal length to one vector; return its LLVM value. The
    number of vectors must be a power of two.
    """
    while len(parts) > 1:
        width = 2 * parts[0].type.count
        mask = ir.Constant(ir.VectorType(INDEX, width), [INDEX(k) for k in range(width)])
        parts = [
            builder.shuffle_vector(first, second, mask)
            for first, second in zip(parts[0::2], parts[1::2], strict=True)
        ]
    return parts[0]


def _constant(long: Any, value: int) -> Any:
    return ir.Constant(long, [LONG(value)] * LANES) if long == LONG_VECTOR else LONG(value)


def _type_function(value: Any, build: Callable[[Any, Any, Any, Any], Any]) -> Any:
    """Return the signature and the code generator of an intrinsic with one argument, a number or a
    vector. `build` generates the code from four arguments: the LLVM builder, the intrinsic's
    argument, its LLVM type, and the LLVM integer type of equal size.
    """
    wide = isinstance(value, LanesType)
    number = LANES_TYPE if wide else types.float64
    pair = (VECTOR, LONG_VECTOR) if wide else (DOUBLE, LONG)

    def generate_code(target: Any, builder: Any, sig: Any, values: Any) -> Any:
        return build(builder, values[0], *pair)

    return number(number), generate_code


def type_floor(context: Any, value: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `floor` (largest whole number
    that is not above the argument).
    """
    return _type_function(value, lambda builder, x, *_: call_llvm(builder, "floor", x))


def type_guess(context: Any, value: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `guess_inverse`, a first
    approximation of 1/x. The bits of the result are a constant minus the bits of x, which changes
    the sign of the binary exponent.
    """

    def build_code(builder: Any, x: Any, double: Any, long: Any) -> Any:
        bits = builder.sub(_constant(long, INVERSE_BITS), builder.bitcast(x, long))
        return builder.bitcast(bits, double)

    return _type_function(value, build_code)


def type_root_guess(context: Any, value: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `guess_inverse_root`, a first
    approximation of 1/sqrt(x). The bits of the result are a constant minus half the bits of x,
    which halves the binary exponent and changes its sign.
    """

    def build_code(builder: Any, x: Any, double: Any, long: Any) -> Any:
        half = builder.lshr(builder.bitcast(x, long), _constant(long, 1))
        return builder.bitcast(builder.sub(_constant(long, INVERSE_ROOT_BITS), half), double)

    return _type_function(value, build_code)


def type_power_of_two(context: Any, value: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `power_of_two`, which computes
    2^k by writing the exponent's bits.
    """

    def build_code(builder: Any, x: Any, double: Any, long: Any) -> Any:
        biased = builder.add(builder.fptosi(x, long), _constant(long, 1023))
        return builder.bitcast(builder.shl(biased, _constant(long, 52)), double)

    return _type_function(value, build_code)


def type_exponent(context: Any, value: Any) -> Any:
    """Return the signature and the code generator of the intrinsic `exponent_of`, which reads the
    binary exponent from the bits of a number.
    """

    def build_code(builder: Any, x: Any, double: Any, long: Any) -> Any:
        biased = builder.lshr(builder.bitcast(x, long), _constant(long, 52))
        return builder.sitofp(builder.sub(biased, _constant(long, 1023)), double)

    return _type_function(value, build_code)
