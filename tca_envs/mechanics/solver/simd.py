"""Packs, vectors, quaternions and 3 x 3 matrices: the notation of the compiled kernels.

A `pack` is one number of each of LANES arms, in one register of the processor where it has such. `vec` (x, y, z), `quat`
(w, x, y, z) and `mat` (row by row) are made of packs, or of plain floats. Kernels write them as Python does: + - * / @,
comparisons, `abs`, `max`, `min` and the functions below; a float becomes a pack where it meets one.

Each formula stands here once. In Python it takes floats and is what it says, so that kernels run in an interpreter and a
debugger. For compiled code, by Numba's extension interface, it runs on `Symbol`s, and each operation writes one instruction.
The compiler sees one program for all lanes, so a lane's result does not depend on its neighbours, to the last bit.
"""

import math
import operator
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_getattr, infer_global, signature
from numba.extending import lower_builtin, lower_cast, lower_getattr_generic, register_model

LANES = 1 if config.DISABLE_JIT else 4
"""Arms in a pack. With 8, where AVX-512 has such registers, large batches would be faster and one arm slower."""
_FLOAT, _INDEX = ir.DoubleType(), ir.IntType(32)
_VECTOR, _FLAGS = ir.VectorType(_FLOAT, LANES), ir.VectorType(ir.IntType(1), LANES)


class Small(types.Type):
    """Numba's type of `size` numbers (0: a single one): packs, or floats."""

    def __init__(self, name: str, size: int, floats: bool, storage: Any) -> None:
        super().__init__(name)
        self.size, self.floats, self.storage = size, floats, storage

    def can_convert_from(self, context: Any, other: Any) -> Any:
        """Say that what is made of floats may stand where packs are expected."""
        return Conversion.safe if _in_packs(other) == self else None


@register_model(Small)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.storage)


real, integer, boolean = types.float64, types.int64, types.boolean
pack, mask = Small("pack", 0, False, _VECTOR), Small("mask", 0, False, _FLAGS)
vec, quat, mat = (Small(name, n, False, ir.ArrayType(_VECTOR, n)) for name, n in (("vec", 3), ("quat", 4), ("mat", 9)))
_PACKS = {kind.size: kind for kind in (vec, quat, mat)}
_FLOATS = {n: Small(f"{kind.name} of floats", n, True, ir.ArrayType(_FLOAT, n)) for n, kind in _PACKS.items()}


def _in_packs(kind: Any) -> Any:
    """Return what a type made of floats is in packs."""
    if kind in (real, integer, boolean):
        return mask if kind is boolean else pack
    return _PACKS[kind.size] if isinstance(kind, Small) and kind.floats else None


# The same in Python: tuples, so that a formula may take them apart, with arithmetic.
def _tuple(name: str, components: Any) -> Any:
    """Return a class of tuples with named components; a `namedtuple` Numba would take for one of its own."""
    parts = {part: property(operator.itemgetter(k)) for k, part in enumerate(components)}
    new = {"__new__": lambda cls, *numbers: tuple.__new__(cls, numbers), "components": tuple(components)}
    return type(name, (tuple,), {"__slots__": (), "__module__": __name__, **new, **parts})


Vec, Quat = _tuple("Vec", "xyz"), _tuple("Quat", "wxyz")
Mat = _tuple("Mat", [i + j for i in "xyz" for j in "xyz"])
CLASSES: dict[int, Any] = {3: Vec, 4: Quat, 9: Mat}
for _class in CLASSES.values():
    _class.__array_ufunc__ = None  # NumPy's floats leave c * a to us
    _class.__add__ = _class.__iadd__ = lambda a, b: type(a)(*map(operator.add, a, b))
    _class.__sub__ = _class.__isub__ = lambda a, b: type(a)(*map(operator.sub, a, b))
    _class.__neg__ = lambda a: type(a)(*map(operator.neg, a))
    _class.__rmul__ = lambda a, c: type(a)(*(c * x for x in a))


def _matmul(a: Any, b: Any) -> Any:
    rows = [a[3 * i : 3 * i + 3] for i in range(3)]
    return (
        Vec(*(_dot(row, b) for row in rows))
        if isinstance(b, Vec)
        else Mat(*(_dot(row, b[j::3]) for row in rows for j in range(3)))
    )


Mat.__matmul__ = _matmul


def _arithmetic(name: str, turned: bool = False) -> Any:
    def operate(self: "Symbol", other: Any) -> Any:
        if isinstance(other, tuple):
            return NotImplemented
        a, b = self.alike(self, other)
        a, b = (b, a) if turned else (a, b)
        return a.write(a.kind, lambda builder, x, y: getattr(builder, name)(x, y), b)

    return operate


def _comparison(sign: str) -> Any:
    def compare(self: "Symbol", other: Any) -> "Symbol":
        a, b = self.alike(self, other)
        return a.write(mask if a.kind is pack else boolean, lambda builder, x, y: builder.fcmp_ordered(sign, x, y), b)

    return compare


class Symbol:
    """A number of a kind whose value a kernel knows only when it runs; without a builder only the kind is asked for."""

    __slots__ = ("builder", "kind", "value")

    def __init__(self, builder: Any, kind: Any, value: Any) -> None:
        self.builder, self.kind, self.value = builder, kind, value

    def write(self, kind: Any, instruction: Callable[..., Any], *others: "Symbol") -> "Symbol":
        """Return the symbol of an instruction on this and other symbols."""
        values = (self.value, *(other.value for other in others))
        return Symbol(self.builder, kind, None if self.builder is None else instruction(self.builder, *values))

    def of_kind(self, other: Any, kind: Any) -> "Symbol":
        """Return another symbol or number as one of a kind."""
        if not isinstance(other, Symbol):
            constant = [float(other)] * LANES if kind is pack else float(other)
            return Symbol(self.builder, kind, ir.Constant(_VECTOR if kind is pack else _FLOAT, constant))
        return other.write(pack, _broadcast) if kind is pack and other.kind is real else other

    def alike(self, *numbers: Any, packs: bool = False) -> "list[Symbol]":
        """Return symbols and numbers as symbols of one kind."""
        packs |= any(isinstance(x, Symbol) and x.kind is pack for x in numbers)
        return [self.of_kind(x, pack if packs else real) for x in numbers]

    __add__, __radd__ = _arithmetic("fadd"), _arithmetic("fadd", True)
    __sub__, __rsub__ = _arithmetic("fsub"), _arithmetic("fsub", True)
    __mul__, __rmul__ = _arithmetic("fmul"), _arithmetic("fmul", True)
    __truediv__, __rtruediv__ = _arithmetic("fdiv"), _arithmetic("fdiv", True)
    __lt__, __gt__, __le__, __ge__ = _comparison("<"), _comparison(">"), _comparison("<="), _comparison(">=")

    def __and__(self, other: "Symbol") -> "Symbol":
        return self.write(self.kind, lambda builder, x, y: builder.and_(x, y), other)

    def __or__(self, other: "Symbol") -> "Symbol":
        return self.write(self.kind, lambda builder, x, y: builder.or_(x, y), other)

    def __neg__(self) -> "Symbol":
        return self.write(self.kind, lambda builder, x: builder.fneg(x))

    def __abs__(self) -> "Symbol":
        return self.write(self.kind, _library("fabs"))

    def sqrt(self) -> "Symbol":
        """Return the square root."""
        return self.write(self.kind, _library("sqrt"))


def _broadcast(builder: Any, x: Any) -> Any:
    nothing = ir.Constant(ir.VectorType(x.type, LANES), ir.Undefined)
    one = builder.insert_element(nothing, x, _INDEX(0))
    return builder.shuffle_vector(one, nothing, ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES))


def _library(name: str) -> Callable[[Any, Any], Any]:
    def call(builder: Any, x: Any) -> Any:
        suffix = f"v{LANES}f64" if x.type == _VECTOR else "f64"
        kind = ir.FunctionType(x.type, [x.type])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{suffix}"), [x])

    return call


def _opened(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return a compiled value as what a formula works on."""
    if isinstance(kind, Small) and kind.size:
        of = real if kind.floats else pack
        parts = (None if builder is None else builder.extract_value(value, k) for k in range(kind.size))
        return CLASSES[kind.size](*(Symbol(builder, of, x) for x in parts))
    if isinstance(kind, types.Integer | types.Float):
        return Symbol(builder, real, None if builder is None else context.cast(builder, value, kind, real))
    return Symbol(builder, kind, value)


def _kind(result: Any) -> Any:
    """Return the type of what a formula returns."""
    if isinstance(result, Symbol):
        return result.kind
    if isinstance(result, Vec | Quat | Mat):
        packs = any(isinstance(x, Symbol) and x.kind is pack for x in result)
        return (_PACKS if packs else _FLOATS)[len(result)]
    return real


def _closed(context: Any, builder: Any, kind: Any, result: Any) -> Any:
    """Return what a formula returns as a compiled value of a type."""
    if kind is mask and result.kind is boolean:
        return _broadcast(builder, result.value)
    of = pack if kind is pack or (isinstance(kind, Small) and not kind.floats) else real
    if not (isinstance(kind, Small) and kind.size):
        return Symbol(builder, of, None).of_kind(result, of).value if kind in (pack, real) else result.value
    aggregate = ir.Constant(kind.storage, ir.Undefined)
    for k, x in enumerate(result):
        aggregate = builder.insert_value(aggregate, Symbol(builder, of, None).of_kind(x, of).value, k)
    return aggregate


def _known(kind: Any) -> bool:
    return isinstance(kind, Small | types.Integer | types.Float | types.Boolean)


FIRST = {"target": "cpu"}
"""Lets Numba try a template before its own, which takes it half of the time otherwise."""


def _register(name: Any, key: Any, function: Callable[..., Any], lowered: tuple[Any, ...]) -> None:
    """Let compiled code call `name`, known to Numba by `key`, as `function`; among numbers of types of its own if several."""

    @cache
    def result(given: tuple[Any, ...]) -> Any:
        return _kind(function(*(_opened(None, None, k, None) for k in given)))

    @infer_global(name, typing_key=key)
    class _Typed(AbstractTemplate):
        metadata = FIRST

        def generic(self, args: Any, kws: Any) -> Any:
            given = tuple(types.unliteral(a) for a in args)
            if not all(map(_known, given)) or (len(lowered) > 1 and not any(isinstance(k, Small) for k in given)):
                return None
            return signature(result(given), *given)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        given = (_opened(context, builder, k, a) for k, a in zip(sig.args, args, strict=True))
        return _closed(context, builder, sig.return_type, function(*given))

    for kinds in lowered:
        lower_builtin(key, *kinds)(lower)


_PAIRS = ((Small, Small), (Small, types.Number), (types.Number, Small))
_PLAIN = (operator.add, operator.sub, operator.mul, operator.truediv, operator.matmul, operator.and_, operator.or_)
_SIGNS = (operator.lt, operator.gt, operator.le, operator.ge)
for _key, _plain in (
    *((op, op) for op in (*_PLAIN, *_SIGNS)),
    (operator.iadd, operator.add), (operator.isub, operator.sub),
    (max, lambda x, y: where(y > x, y, x)), (min, lambda x, y: where(y < x, y, x)),
):  # fmt: skip
    _register(_key, _key, _plain, _PAIRS)
for _function in (operator.neg, abs):
    _register(_function, _function, _function, ((Small,), (Small,)))


def formula(function: Any) -> Any:
    """Let compiled code call a function of numbers, vectors, quaternions and matrices without branches on numbers."""
    _register(function, object(), function, ((types.VarArg(types.Any),),))
    return function


for _class in CLASSES.values():
    formula(_class)


def written(function: Any, result: Callable[..., Any]) -> Any:
    """Let compiled code call a function by the instructions that the decorated one writes; `result` is of argument types."""
    key = object()

    @infer_global(function, typing_key=key)
    class _Typed(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            return signature(result(*args), *(integer if isinstance(k, types.Integer) else types.unliteral(k) for k in args))

    return lower_builtin(key, types.VarArg(types.Any))


@lower_cast(types.Float, Small)
@lower_cast(Small, Small)
def _cast(context: Any, builder: Any, given: Any, kind: Any, value: Any) -> Any:
    return _closed(context, builder, kind, _opened(context, builder, given, value))


@infer_getattr
class _Components(AttributeTemplate):
    key = Small

    def generic_resolve(self, kind: Any, name: str) -> Any:
        if kind.size and name in CLASSES[kind.size].components:
            return real if kind.floats else pack


@lower_getattr_generic(Small)
def _component(context: Any, builder: Any, kind: Any, value: Any, name: str) -> Any:
    return builder.extract_value(value, CLASSES[kind.size].components.index(name))


@formula
def spread(x):
    """Return a float as a pack; a variable that is bound to packs later on is best bound to one at first, too."""
    return x.of_kind(x, pack) if isinstance(x, Symbol) else x


@formula
def where(flag, x, y):
    """Return x where a flag is set, and y elsewhere."""
    if not isinstance(flag, Symbol):
        return x if flag else y
    if isinstance(x, tuple):
        return type(x)(*(where(flag, *both) for both in zip(x, y, strict=True)))
    x, y = flag.alike(x, y, packs=flag.kind is mask)
    return flag.write(x.kind, lambda builder, *values: builder.select(*values), x, y)


@formula
def sqrt(x):
    """Return the square root."""
    return x.sqrt() if isinstance(x, Symbol) else np.sqrt(x)


def any_lane(flags):
    """Return whether a flag is set for any arm."""
    return bool(flags)


@written(any_lane, lambda flags: boolean)
def _any_lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.icmp_unsigned("!=", builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(LANES)(0))


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@formula
def dot(a, b):
    """Return a . b."""
    return _dot(a, b)


@formula
def cross(a, b):
    """Return a x b, of a matrix b column by column."""
    if isinstance(b, Mat):
        columns = [cross(a, b[j::3]) for j in range(3)]
        return Mat(*(columns[j][i] for i in range(3) for j in range(3)))
    return Vec(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@formula
def lever(x, y, a):
    """Return [r] a with r = (x, y, 0), of a vector or a matrix: the compiler may not drop products with zero by itself."""
    if isinstance(a, Mat):
        first, second, third = a[0:3], a[3:6], a[6:9]
        last = (x * p - y * q for p, q in zip(second, first, strict=True))
        return Mat(*(y * p for p in third), *(-x * p for p in third), *last)
    return Vec(y * a[2], -x * a[2], x * a[1] - y * a[0])


@formula
def times(a, b):
    """Return the products of two vectors' components."""
    return Vec(a[0] * b[0], a[1] * b[1], a[2] * b[2])


@formula
def outer(a, b):
    """Return a b^T."""
    return Mat(*(x * y for x in a for y in b))


@formula
def transpose(a):
    """Return a^T."""
    return Mat(*(a[3 * j + i] for i in range(3) for j in range(3)))


@formula
def hat(a):
    """Return [a] with [a] b = a x b."""
    return Mat(0.0, -a[2], a[1], a[2], 0.0, -a[0], -a[1], a[0], 0.0)


@formula
def diagonal(x, y, z):
    """Return a diagonal matrix."""
    return Mat(x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z)


@formula
def inverse(a):
    """Return the inverse of a matrix, by cofactors."""
    c0, c3, c6 = a[4] * a[8] - a[5] * a[7], a[5] * a[6] - a[3] * a[8], a[3] * a[7] - a[4] * a[6]
    d = 1.0 / (a[0] * c0 + a[1] * c3 + a[2] * c6)
    return Mat(
        d * c0, d * (a[2] * a[7] - a[1] * a[8]), d * (a[1] * a[5] - a[2] * a[4]),
        d * c3, d * (a[0] * a[8] - a[2] * a[6]), d * (a[2] * a[3] - a[0] * a[5]),
        d * c6, d * (a[1] * a[6] - a[0] * a[7]), d * (a[0] * a[4] - a[1] * a[3]),
    )  # fmt: skip


@formula
def negatives(a):
    """Return how many eigenvalues of a symmetric matrix are negative, by Descartes' rule; 3 if it is not finite."""
    trace = a[0] + a[4] + a[8]
    minors = a[0] * a[4] - a[1] * a[3] + a[0] * a[8] - a[2] * a[6] + a[4] * a[8] - a[5] * a[7]
    det = a[0] * (a[4] * a[8] - a[5] * a[7]) - a[1] * (a[3] * a[8] - a[5] * a[6]) + a[2] * (a[3] * a[7] - a[4] * a[6])
    first, second, third = (where(x < 0.0, 1.0, 0.0) for x in (trace, minors, det))
    return where(abs(det) < math.inf, first + abs(first - second) + abs(second - third), 3.0)


@formula
def product(q, x):
    """Return q o [0, x]: twice the rate of a quaternion whose body turns at x, eq. (28)."""
    return Quat(
        -q[1] * x[0] - q[2] * x[1] - q[3] * x[2],
        q[0] * x[0] + q[2] * x[2] - q[3] * x[1],
        q[0] * x[1] - q[1] * x[2] + q[3] * x[0],
        q[0] * x[2] + q[1] * x[1] - q[2] * x[0],
    )


@formula
def turned(x, q):
    """Return [1, x] o q: q turned by about 2 x in the global frame."""
    return Quat(
        q[0] - x[0] * q[1] - x[1] * q[2] - x[2] * q[3],
        q[1] + q[0] * x[0] + x[1] * q[3] - x[2] * q[2],
        q[2] + q[0] * x[1] + x[2] * q[1] - x[0] * q[3],
        q[3] + q[0] * x[2] + x[0] * q[2] - x[1] * q[1],
    )


@formula
def square(q):
    """Return the squared norm of a quaternion."""
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]


@formula
def norm1(q):
    """Return the sum of a quaternion's absolute components."""
    return abs(q[0]) + abs(q[1]) + abs(q[2]) + abs(q[3])


@formula
def rotation(q):
    """Return the rotation matrix of a quaternion of any norm."""
    s = 2.0 / square(q)
    wx, wy, wz = s * q[0] * q[1], s * q[0] * q[2], s * q[0] * q[3]
    xx, xy, xz = s * q[1] * q[1], s * q[1] * q[2], s * q[1] * q[3]
    yy, yz, zz = s * q[2] * q[2], s * q[2] * q[3], s * q[3] * q[3]
    return Mat(1.0 - yy - zz, xy - wz, xz + wy, xy + wz, 1.0 - xx - zz, yz - wx, xz - wy, yz + wx, 1.0 - xx - yy)


def lane_of(x: Any, lane: int) -> float:
    """Return one lane's number of a pack."""
    return x


@written(lane_of, lambda x, lane: real)
def _lane_of(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.extract_element(args[0], args[1])


def with_lane(x: Any, lane: int, value: float) -> Any:
    """Return a pack with another number in one lane."""
    return value


@written(with_lane, lambda x, lane, value: pack)
def _with_lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.insert_element(args[0], args[2], args[1])
