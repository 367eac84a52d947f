"""Functions that become part of the kernels that call them, without being compiled by themselves.

Where a kernel calls a function that is `traced`, the function runs, as plain Python, on symbols in place of numbers, and each
operation on a symbol writes one instruction into the kernel. That takes a small share of the time for which Numba would
compile the function, infer the types of the call and have the function optimised in each kernel anew. It may call what it
likes, but it cannot branch or loop on a symbol: see `written`. Called on numbers it is plain Python.
"""

import operator
import threading
from functools import cache
from math import cos, sin, sqrt
from typing import Any, TypeVar

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, register_model

Function = TypeVar("Function")

PACK = 4
"""Arms in a pack, see `packs`."""
_INT, _FLOAT, _LANE = ir.IntType(64), ir.DoubleType(), ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, PACK)


class _Pack(types.Type):
    def __init__(self):
        super().__init__("Pack")


pack, pack_of_flags = _Pack(), object()


@register_model(_Pack)
class _PackModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, _VECTOR)


class _Traces(threading.local):
    """The builders of the traces that are under way in a thread, the innermost last; None where only types are asked for."""

    def __init__(self) -> None:
        self.builders: list[Any] = []


traces = _Traces()


def emit(kind, write, *symbols):
    """Return the symbol of the instruction that `write` writes for the values of symbols."""
    builder = traces.builders[-1]
    return Symbol(kind, None if builder is None else write(builder, *(symbol.value for symbol in symbols)))


def _arithmetic(of_floats, of_ints):
    def operate(a, b):
        kind = _common(a, b)
        name = of_ints if kind in (types.int64, types.boolean) else of_floats
        return emit(kind, lambda builder, x, y: getattr(builder, name)(x, y), as_kind(kind, a), as_kind(kind, b))

    return operate, lambda a, b: operate(b, a)


def _comparison(sign):
    def compare(a, b):
        kind = _common(a, b)
        # As Python has it, what is not a number is unequal to all.
        name = "icmp_signed" if kind is types.int64 else ("fcmp_unordered" if sign == "!=" else "fcmp_ordered")
        flag = pack_of_flags if kind is pack else types.boolean
        return emit(flag, lambda builder, x, y: getattr(builder, name)(sign, x, y), as_kind(kind, a), as_kind(kind, b))

    return compare


class Symbol:
    """A number, a pack, an integer, a flag or a pointer to such, whose value a kernel knows only when it runs."""

    __slots__ = ("kind", "value")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, kind: Any, value: Any) -> None:
        self.kind, self.value = kind, value

    __add__, __radd__ = _arithmetic("fadd", "add")
    __sub__, __rsub__ = _arithmetic("fsub", "sub")
    __mul__, __rmul__ = _arithmetic("fmul", "mul")
    __truediv__, __rtruediv__ = _arithmetic("fdiv", None)
    __mod__, __rmod__ = _arithmetic(None, "srem")
    __and__, __rand__ = _arithmetic(None, "and_")
    __or__, __ror__ = _arithmetic(None, "or_")
    __lshift__, __rlshift__ = _arithmetic(None, "shl")
    __lt__, __gt__, __le__, __ge__ = (_comparison(sign) for sign in ("<", ">", "<=", ">="))
    __eq__, __ne__ = _comparison("=="), _comparison("!=")

    def __neg__(self):
        return emit(self.kind, lambda builder, x: (builder.neg if self.kind is types.int64 else builder.fneg)(x), self)

    def __getitem__(self, place):
        place = as_kind(types.int64, place)
        return emit(self.kind.dtype, lambda builder, x, k: builder.load(builder.gep(x, [k])), self, place)

    def __setitem__(self, place, value):
        place, value = as_kind(types.int64, place), as_kind(self.kind.dtype, value)
        emit(None, lambda builder, x, k, v: builder.store(v, builder.gep(x, [k])), self, place, value)

    def __bool__(self):
        raise TypeError("a traced function cannot branch on a number that is known only when it runs")


def _common(*values):
    """Return the kind that numbers take where they meet."""
    kinds = [v.kind if isinstance(v, Symbol) else (types.int64 if isinstance(v, int) else types.float64) for v in values]
    return next((kind for kind in (types.boolean, pack, types.float64) if kind in kinds), types.int64)


def as_kind(kind, value):
    """Return a number as a symbol of a kind."""
    if not isinstance(value, Symbol):
        if kind is pack:
            return Symbol(pack, ir.Constant(_VECTOR, [float(value)] * PACK))
        return Symbol(kind, ir.Constant(_INT, value) if kind is types.int64 else ir.Constant(_FLOAT, float(value)))
    if value.kind is kind:
        return value
    if (value.kind, kind) == (types.int64, types.float64):
        return emit(kind, lambda builder, x: builder.sitofp(x, _FLOAT), value)
    if kind is not pack:
        raise TypeError(f"expected a value of kind {kind}, got one of kind {value.kind}")
    return emit(pack, _spread, as_kind(types.float64, value))


def _spread(builder, x):
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(nothing, x, _LANE(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(_LANE, PACK), [0] * PACK))


def kind_of(result):
    """Return the type of what a traced function returns."""
    if result is None:
        return types.none
    if isinstance(result, tuple):
        return types.BaseTuple.from_types([kind_of(x) for x in result])
    return _common(result) if not isinstance(result, Symbol) else result.kind


def _symbols(context, builder, kind, value):
    """Return an argument of a traced function as symbols."""
    kinds = _parts(kind)
    if kinds is None:
        return Symbol(kind, value)
    values = [None] * len(kinds) if builder is None else cgutils.unpack_tuple(builder, value)
    return tuple(_symbols(context, builder, k, v) for k, v in zip(kinds, values, strict=True))


def _value(context, builder, kind, result):
    """Return the value of what a traced function returns."""
    kinds = _parts(kind)
    if kinds is None:
        return context.get_dummy_value() if kind is types.none else as_kind(kind, result).value
    return context.make_tuple(builder, kind, [_value(context, builder, k, x) for k, x in zip(kinds, result, strict=True)])


def _parts(kind: Any) -> Any:
    """Return the kinds of a tuple's parts; None for what is no tuple."""
    return kind.types if isinstance(kind, types.Tuple | types.UniTuple) else None


def _register(key, function, kinds=None):
    """Let kernels trace a function, which Numba is to know by a key, of arguments of any kinds or of these alone."""

    def run(context, builder, given, values):
        return function(*(_symbols(context, builder, k, v) for k, v in zip(given, values, strict=True)))

    @cache
    def typed(given):
        traces.builders.append(None)
        try:
            return signature(kind_of(run(None, None, given, [None] * len(given))), *given)
        finally:
            traces.builders.pop()

    @infer_global(function, typing_key=key)
    class _Signature(AbstractTemplate):
        def generic(self, args, kws):
            given = tuple(types.int64 if isinstance(a, types.Integer) else types.unliteral(a) for a in args)
            return typed(given) if kinds is None or given in kinds else None

    def lower(context, builder, sig, args):
        traces.builders.append(builder)
        try:
            return _value(context, builder, sig.return_type, run(context, builder, sig.args, args))
        finally:
            traces.builders.pop()

    for given in ((types.VarArg(types.Any),),) if kinds is None else kinds:
        lower_builtin(key, *given)(lower)


for _operation in (
    operator.add, operator.sub, operator.mul, operator.truediv, operator.iadd, operator.isub, operator.imul,
):  # fmt: skip
    _register(_operation, _operation, ((pack, pack), (pack, types.float64), (types.float64, pack)))
_register(operator.neg, operator.neg, ((pack,),))


def traced(function: Function) -> Function:
    """Let kernels trace a function, see above; its arguments and results are what a `Symbol` is, or tuples of such."""
    _register(object(), function)
    return function


@traced
def spread(x):
    """Return a pack of four times a number."""
    return as_kind(pack, x) if traces.builders else x


@traced
def choose(a, b, x, y):
    """Return x where a < b, and y where not or where a or b is not a number."""
    return where(a < b, x, y)


@traced
def where(flag, x, y):
    """Return x where a flag is set, and y elsewhere."""
    if not isinstance(flag, Symbol):
        return x if flag else y
    if isinstance(x, tuple):
        return tuple(where(flag, *both) for both in zip(x, y, strict=True))
    kind = pack if flag.kind is pack_of_flags else _common(x, y)
    return emit(kind, lambda builder, *values: builder.select(*values), flag, as_kind(kind, x), as_kind(kind, y))


def _function(name, plain):
    @traced
    def apply(x):
        if not isinstance(x, Symbol):
            return plain(x)
        vector = f"v{PACK}" if x.kind is pack else ""

        def write(builder, value):
            kind = ir.FunctionType(value.type, [value.type])
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{vector}f64"), [value])

        return emit(x.kind, write, x)

    return apply


root = _function("sqrt", sqrt)
size = _function("fabs", abs)
cosine = _function("cos", cos)
sine = _function("sin", sin)


@traced
def part(x, lane):
    """Return the number of one arm."""

    def write(builder, value, k):
        return builder.extract_element(value, builder.trunc(k, _LANE))

    return emit(types.float64, write, x, as_kind(types.int64, lane))
