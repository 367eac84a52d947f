"""Packs: one number of each of four arms, in one register of the processor.

Arms of one model differ in numbers only, so a kernel that works on packs solves four for little more than the price of one: an
operation on a pack is one instruction where there is AVX2. Each works on the four numbers by themselves, and the compiler sees
one program whatever they are, so an arm's result does not depend, to the last bit, on its neighbours'.

Kernels get raw pointers instead of arrays: they pass in registers, cost nothing to index, and compile in a third of the time.
They are compiled once and called by address (`call_kernel`), or every caller would compile them again.
"""

from typing import Any

from llvmlite import ir
from numba import extending, types

from tca_envs.mechanics.traced import as_kind, emit, pack, traced

intrinsic: Any = extending.intrinsic

ALIGNMENT = 64
"""Packs lie at multiples of their size; this is that of a cache line [bytes]."""

packs = types.CPointer(pack)
floats = types.CPointer(types.float64)
ints = types.CPointer(types.int64)

KERNEL = types.void(floats, ints, ints, packs, types.int64, types.float64)
"""Signature of every kernel."""


def _pointer(kind):
    @intrinsic
    def pointer(typingctx, array):
        def lower(context, builder, sig, args):
            data = context.make_array(sig.args[0])(context, builder, args[0]).data
            return builder.bitcast(data, context.get_value_type(kind))

        return (kind(array), lower) if getattr(array, "layout", None) == "C" else None

    return pointer


pointer_to_packs, pointer_to_floats, pointer_to_ints = _pointer(packs), _pointer(floats), _pointer(ints)


@traced
def call_kernel(address, f, i, a, w, n, x):
    """Call a kernel of signature KERNEL by its address."""

    def write(builder, address, *values):
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in values])
        builder.call(builder.inttoptr(address, kind.as_pointer()), values)

    emit(None, write, address, f, i, a, w, as_kind(types.int64, n), as_kind(types.float64, x))


@traced
def floats_at(address):
    """Return the pointer to floats at an address."""
    return emit(floats, lambda builder, value: builder.inttoptr(value, ir.DoubleType().as_pointer()), address)


@traced
def floats_of(w):
    """Return the pointer to the single numbers of packs: number l of pack k is at PACK k + l."""
    return emit(floats, lambda builder, value: builder.bitcast(value, ir.DoubleType().as_pointer()), w)


@intrinsic
def address_of(typingctx, array):
    """Return the address of the data of a C-contiguous array."""

    def lower(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.ptrtoint(data, context.get_value_type(types.int64))

    return (types.int64(array), lower) if getattr(array, "layout", None) == "C" else None
