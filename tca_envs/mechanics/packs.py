"""Packs: one number of each of four arms, in one register of the processor.

Arms of one model differ in numbers only, so a kernel that works on packs solves four for little more than the price of one: an
operation on a pack is one instruction where there is AVX2. Each works on the four numbers by themselves, and the compiler sees
one program whatever they are, so an arm's result does not depend, to the last bit, on its neighbours'.

Kernels get raw pointers instead of arrays: they pass in registers, cost nothing to index, and compile in a third of the time.
They are compiled once and called by address (`call_kernel`), or every caller would compile them again.
"""

import operator
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, register_model

intrinsic: Any = extending.intrinsic

PACK = 4
"""Arms in a pack."""
ALIGNMENT = 64
"""Packs lie at multiples of their size; this is that of a cache line [bytes]."""

_INT = ir.IntType(32)
_VECTOR = ir.VectorType(ir.DoubleType(), PACK)


class _Pack(types.Type):
    def __init__(self):
        super().__init__("Pack")


pack = _Pack()
packs = types.CPointer(pack)
floats = types.CPointer(types.float64)
ints = types.CPointer(types.int64)

KERNEL = types.void(floats, ints, ints, packs, types.int64, types.float64)
"""Signature of every kernel."""


@register_model(_Pack)
class _PackModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, _VECTOR)


def _spread(builder, x):
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(nothing, x, _INT(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(_INT, PACK), [0] * PACK))


def _arithmetic(operation, instruction):
    @infer_global(operation)
    class _Signature(AbstractTemplate):
        def generic(self, args, kws):
            if len(args) == 2 and pack in args and all(a in (pack, types.float64) for a in args):
                return signature(pack, *args)

    def lower(context, builder, sig, args):
        first, second = (x if t is pack else _spread(builder, x) for t, x in zip(sig.args, args, strict=True))
        return getattr(builder, instruction)(first, second)

    for kinds in ((pack, pack), (pack, types.float64), (types.float64, pack)):
        lower_builtin(operation, *kinds)(lower)


for _operation, _instruction in (
    (operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv"),
    (operator.iadd, "fadd"), (operator.isub, "fsub"), (operator.imul, "fmul"),
):  # fmt: skip
    _arithmetic(_operation, _instruction)


@infer_global(operator.neg)
class _Negative(AbstractTemplate):
    def generic(self, args, kws):
        return signature(pack, pack) if tuple(args) == (pack,) else None


@lower_builtin(operator.neg, pack)
def _negate(context, builder, sig, args):
    return builder.fneg(args[0])


@intrinsic
def spread(typingctx, x):
    """Return a pack of four times the float `x`."""

    def lower(context, builder, sig, args):
        return _spread(builder, args[0])

    return pack(types.float64), lower


@intrinsic
def choose(typingctx, a, b, x, y):
    """Return x where a < b, and y where not or where a or b is not a number; floats stand for packs."""

    def lower(context, builder, sig, args):
        a, b, x, y = (v if t is pack else _spread(builder, v) for t, v in zip(sig.args, args, strict=True))
        return builder.select(builder.fcmp_ordered("<", a, b), x, y)

    return pack(a, b, x, y), lower


def _function(name):
    @intrinsic
    def apply(typingctx, x):
        def lower(context, builder, sig, args):
            kind = ir.FunctionType(_VECTOR, [_VECTOR])
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{PACK}f64"), args)

        return pack(pack), lower

    return apply


root = _function("sqrt")
size = _function("fabs")


@intrinsic
def part(typingctx, x, lane):
    """Return the number of one arm."""

    def lower(context, builder, sig, args):
        return builder.extract_element(args[0], builder.trunc(args[1], _INT))

    return types.float64(pack, types.int64), lower


@intrinsic
def replaced(typingctx, x, lane, value):
    """Return a pack with the number of one arm replaced."""

    def lower(context, builder, sig, args):
        return builder.insert_element(args[0], args[2], builder.trunc(args[1], _INT))

    return pack(pack, types.int64, types.float64), lower


@intrinsic
def behind(typingctx, pointer, count):
    """Return the pointer to what lies `count` places behind."""

    def lower(context, builder, sig, args):
        return builder.gep(args[0], [args[1]])

    return pointer(pointer, types.int64), lower


def _pointer(kind):
    @intrinsic
    def pointer(typingctx, array):
        def lower(context, builder, sig, args):
            data = context.make_array(sig.args[0])(context, builder, args[0]).data
            return builder.bitcast(data, context.get_value_type(kind))

        return (kind(array), lower) if getattr(array, "layout", None) == "C" else None

    return pointer


pointer_to_packs, pointer_to_floats, pointer_to_ints = _pointer(packs), _pointer(floats), _pointer(ints)


@intrinsic
def call_kernel(typingctx, address, f, i, a, w, n, x):
    """Call a kernel of signature KERNEL by its address."""

    def lower(context, builder, sig, args):
        kind = ir.FunctionType(ir.VoidType(), [context.get_value_type(t) for t in KERNEL.args])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])
        return context.get_dummy_value()

    return types.void(types.int64, *KERNEL.args), lower


@intrinsic
def floats_at(typingctx, address):
    """Return the pointer to floats at an address."""

    def lower(context, builder, sig, args):
        return builder.inttoptr(args[0], context.get_value_type(floats))

    return floats(types.int64), lower


@intrinsic
def floats_of(typingctx, w):
    """Return the pointer to the single numbers of packs: number l of pack k is at PACK k + l."""

    def lower(context, builder, sig, args):
        return builder.bitcast(args[0], context.get_value_type(floats))

    return floats(packs), lower


@intrinsic
def address_of(typingctx, array):
    """Return the address of the data of a C-contiguous array."""

    def lower(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.ptrtoint(data, context.get_value_type(types.int64))

    return (types.int64(array), lower) if getattr(array, "layout", None) == "C" else None
