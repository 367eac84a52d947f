"""Named fields: what kernels read and write, each with its kind, shape, unit and meaning, in one place.

`Arm` is what an arm is, the same for all lanes; `Rod` is what kernels work on, for the arms of one pack. In kernels a field is
an attribute: `rod.u[g]` is the curvature at node g, `arm.late[k, j, l]` a number, `rod.worst` a pack. Numba's type of each is a
`Struct`: a base address, and a table of where each field begins and of the sizes of its axes.

Axes: M modules, n muscles of the arm, G nodes, E elements, Q most nodes of an element, m most muscles of a module,
P numbers of a law, L numbers of a load. Indices: k module, e element, g node of the arm, j, l and r node of an
element (r = 0: its base), i muscle of the arm, c muscle of a module.
"""

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_getattr, infer_global, signature
from numba.extending import (
    lower_builtin,
    lower_getattr_generic,
    lower_setattr_generic,
    register_model,
)
from numpy.typing import NDArray

from tca_envs.mechanics.solver.simd import CLASSES, FIRST, LANES, Small, integer, mat, pack, quat, real, vec, written

_INT = ir.IntType(64)

ARM_FIELDS = """
modules      integer  -        1        modules
muscles      integer  -        1        muscles
nodes        integer  -        1        nodes
elements     integer  -        1        elements
lanes        integer  -        1        arms in a pack: LANES, but the compiler does not write loops to it out
tolerance    real     -        1        Newton stops where the dimensionless residual is below this
call         integer  4        -        addresses of the kernels
pieces       integer  M        1        elements of a module
width        integer  M        1        nodes of each of its elements
first        integer  M+1      1        first muscle of a module
kind         integer  n        1        law: TENDON, SPRING or COIL
weight       real     M,Q      m        h b_j, Gauss weights of an element of length h
inner        real     M,Q,Q    m        h a_jl, Gauss coefficients: integrals from an element's base to a node
late         real     M,Q+1,Q  m        h (b_l - a_rl): integrals from a node to the element's end; h b_l from its base (r = 0)
coupling     real     M,Q+1,QQ m2       late_rj inner_jl, by r and l q + j with q = width (QQ is Q^2)
x            real     G,m      m        a muscle's place in the cross section ...
y            real     G,m      m
dx           real     G,m      1        ... and its derivative in arc length
dy           real     G,m      1
mass_beyond  real     G        kg       of the arm beyond a node
law          real     n,P      -        numbers of the laws, see `laws`
rest         real     n        m        path length of a muscle in the unloaded arm
k_u          vec      M        N m2     bending and torsional stiffness
k_v          vec      M        N        shear and axial stiffness
rest_u       vec      M        1/m      curvature of the unloaded rod
rest_v       vec      M        1        stretch of the unloaded rod
unit_u       vec      M        1/(N m)  length/stiffness: makes an imbalance of moments an angle over the module
unit_v       vec      M        1/N      1/stiffness: makes an imbalance of forces a strain
"""

ROD_FIELDS = """
u            vec      G        1/m      curvature and twist: with v, tension and drive the state
v            vec      G        1        shear and stretch
tension      pack     n        N        positive when the muscle pulls
drive        pack     n        -        temperature, tension or rest length
push         vec      -        N        the load: tip force in the global frame ...
twist        vec      -        N m      ... tip moment ...
gravity      vec      -        m/s2     ... gravity ...
mass         pack     -        kg       ... payload ...
centre       vec      -        m        ... and the payload's centre in the tip's frame
load         pack     L        -        the five above as one array (overlays push)
active       pack     -        1        1 where `evaluate` is to work, else 0: the arm keeps its quaternions
moved        pack     -        1        1 where drive or load are not those of the start
worst        pack     -        1        dimensionless residual, see `evaluate`; inf where the state is no configuration
total        pack     -        1        sum of squares of all that it is the largest of: not finite where one is not
negative     pack     -        1        negative eigenvalues of the tangent, see `eliminate`
rotated      pack     -        rad      largest rotation of a step
sheared      pack     -        1        largest change of v of a step
converged    pack     -        1        1 where Newton has an answer
iterations   pack     -        1        Newton steps taken
slowness     pack     -        1        largest ratio of a Newton step to the one before; 0 where the first was short
h            quat     G        1        rotation at the nodes ...
rate         quat     Q        1/m      ... and its derivative, h o u/2
h_end        quat     E+1      1        rotation at the elements' ends, the base first
p_end        vec      E+1      m        position there
R            mat      G        1        rotation matrix at the nodes
tangent      vec      G        1        p' = R v, global frame
force        vec      G        N        total force, body frame
moment       vec      G        N m      total moment, global frame
spin         vec      G        N        p' x n, global frame: what the moment loses per length
off_u        vec      G        N m      imbalance of a section, moments ...
off_v        vec      G        N        ... and forces, body frame
t            vec      G,m      1        unit tangent of a muscle's path
r_x_t        vec      G,m      m        its moment about the centerline
stretch      pack     G,m      1        length of the path per length of the centerline
path         pack     n        m        path length
gap          pack     n        m        path length less rest length less elongation (tendon: asked less given tension [N])
softness     pack     n        m/N      d elongation/d tension (tendon: 1)
compliance   mat      G        1/N      B = H_vv^-1 of a section
slide        mat      G        m        B H_vu
M            mat      Q        N m2     section blocks of an element, global frame, see `linearise_section`
N            mat      Q        N m
X            mat      Q        N
Y            mat      Q        N m
e            vec      Q,m      m        moment of a muscle at constant force ...
z            vec      Q,m      1        ... and what it adds to the spin
A            mat      G,Q      N m2     an element's matrix, by node and column, then its factors
by_phi       mat      G        1/m      w at a node from the rotation at the element's base
to_base      mat      G        N m2     moment at the element's base from w at a node
pulled       vec      G,m      1/(N m)  w at a node from a muscle's tension
by_w         vec      G,m      m2       path length from w at a node
Q            vec      m        m        moment handed on from a muscle's tension
new_Q        vec      m        m
alpha        vec      m        m        path length from the rotation at the element's base
new_alpha    vec      m        m
beta         pack     m,m      m/N      path length from tensions
muscle_A     pack     M,m,m    m/N      factors of a module's muscles
muscle_phi   vec      M,m      N        tension from the rotation at the module's base
muscle_moment vec     M,m      m        moment at the module's base from a tension
column       vec      m        m        right-hand sides of the muscles, one for each axis of the rotation
gamma        pack     m        m        path length from the imbalance
rho          vec      Q        N m      right-hand side of a node, global frame
zeta         vec      Q        N        force imbalance's share of the spin
w            vec      G        1/m      change of curvature, global frame
phi          vec      G        rad      rotation of a node by the step
bend         vec      G        1/m      change of u ...
shear        vec      G        1        ... of v ...
pull         pack     n        N        ... and of tension by the step
tip_turn     vec      -        rad      rotation of the tip by the step, global frame
energy       pack     -        J        `linearise`: of rod, muscles and loads
work         pack     -        J        of a step against the imbalance, g . dx ...
size         pack     -        J        ... and its square in the metric of the rod's stiffness, dx . K dx
"""


class Field(types.Type):
    """Numba's type of an array of one kind: a pointer and, for each axis but the first, its size."""

    def __init__(self, kind: Any, ndim: int) -> None:
        super().__init__(f"Field({kind}, {ndim})")
        self.kind, self.ndim = kind, ndim


class Struct(types.Type):
    """Numba's type of named fields, from a table as above."""

    def __init__(self, name: str, text: str) -> None:
        super().__init__(name)
        rows = [line.split(None, 4) for line in text.strip().splitlines()]
        self.shapes = {field: [] if shape == "-" else shape.split(",") for field, _, shape, *_ in rows}
        self.fields = {field: Field(_KINDS[kind], len(self.shapes[field])) for field, kind, *_ in rows}

    def shape(self, name: str, sizes: dict[str, int]) -> tuple[int, ...]:
        """Return a field's shape where axes have these sizes."""
        return tuple(int(axis) if axis.isdigit() else sizes[axis] for axis in self.shapes[name])


_KINDS = {"integer": integer, "real": real, "pack": pack, "vec": vec, "quat": quat, "mat": mat}
Arm, Rod = Struct("Arm", ARM_FIELDS), Struct("Rod", ROD_FIELDS)
OVERLAYS = {"load": "push"}  # fields that are where another one begins
ROW = 3  # integers of a field in a table: where it begins [bytes], sizes of its second and its third axis


def table_of(struct: Struct, sizes: dict[str, int]) -> tuple[NDArray[np.int64], int]:
    """Return the table of fields that lie in one array of floats, and how many floats they take."""
    table, end = np.zeros((len(struct.fields), ROW), dtype=np.int64), 0
    begins: dict[str, int] = {}
    for row, (name, field) in zip(table, struct.fields.items(), strict=True):
        shape = struct.shape(name, sizes)
        begins[name] = begins[OVERLAYS[name]] if name in OVERLAYS else end
        row[:] = (8 * begins[name], *shape[1:], 0, 0)[:ROW]
        end = max(end, begins[name] + int(np.prod(shape)) * _floats(field.kind))
        end = -(-end // LANES) * LANES  # packs lie at multiples of their size
    return table.ravel(), end


def views(struct: Struct, sizes: dict[str, int], table: NDArray[np.int64], data: NDArray[np.float64]) -> dict[str, Any]:
    """Return the fields in an array of floats as arrays of their shapes; packs have two axes more, numbers and lanes."""
    result: dict[str, Any] = {}
    for begin, (name, field) in zip(table[::ROW] // 8, struct.fields.items(), strict=True):
        shape = struct.shape(name, sizes)
        if isinstance(field.kind, Small):
            shape = (*shape, max(1, field.kind.size), LANES)
        values = data[begin : begin + int(np.prod(shape))].reshape(shape)
        result[name] = values.view(np.int64) if field.kind is integer else values
    return result


def _floats(kind: Any) -> int:
    return LANES * max(1, kind.size) if isinstance(kind, Small) else 1


class Twin:
    """Fields in Python: what a kernel gets that runs in an interpreter, for the first lane."""

    def __init__(self, struct: Struct, arrays: dict[str, Any], **others: Any) -> None:
        self.__dict__.update(others)
        for name, field in struct.fields.items():
            if name in arrays:
                packs = isinstance(field.kind, Small)
                self.__dict__["_" + name] = _Column(field, arrays[name][..., 0] if packs else arrays[name])

    def __getattr__(self, name: str) -> Any:
        column = self.__dict__.get("_" + name)
        if column is None:
            raise AttributeError(name)
        return column if column.field.ndim else column[()]

    def __setattr__(self, name: str, value: Any) -> None:
        self.__dict__["_" + name][()] = value


class _Column:
    """A field in Python."""

    def __init__(self, field: Field, array: Any) -> None:
        self.field, self.array, self.size = field, array, getattr(field.kind, "size", None)

    def __getitem__(self, place: Any) -> Any:
        value = self.array[place]
        return value if self.size is None else (CLASSES[self.size](*value) if self.size else value[0])

    def __setitem__(self, place: Any, value: Any) -> None:
        self.array[place] = value


# What Numba asks of a type: how it is stored, what `a.b`, `a[i, j]` and assignments to these mean.
@register_model(Field)
class _FieldModel(models.StructModel):
    def __init__(self, manager: Any, field: Any) -> None:
        sizes = [(f"size{d}", integer) for d in range(1, field.ndim)]
        super().__init__(manager, field, [("data", types.CPointer(field.kind)), *sizes])


@register_model(Struct)
class _StructModel(models.StructModel):
    def __init__(self, manager: Any, struct: Any) -> None:
        super().__init__(manager, struct, [("base", types.voidptr), ("table", types.CPointer(integer))])


def _pointer(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Return the pointer to an element of a field."""
    field, index = sig.args[0], sig.args[1]
    it = cgutils.create_struct_proxy(field)(context, builder, args[0])
    kinds, parts = ([index], [args[1]]) if field.ndim == 1 else (list(index), cgutils.unpack_tuple(builder, args[1]))
    at = None
    for d, (kind, part) in enumerate(zip(kinds, parts, strict=True)):
        part = context.cast(builder, part, kind, integer)
        at = part if at is None else builder.add(builder.mul(at, getattr(it, f"size{d}")), part)
    return builder.gep(it.data, [at])


def _indexes(field: Any, index: Any) -> bool:
    parts = [index] if field.ndim == 1 else list(index) if isinstance(index, types.BaseTuple) else []
    return len(parts) == field.ndim and all(isinstance(part, types.Integer) for part in parts)


@infer_global(operator.getitem)
class _Get(AbstractTemplate):
    metadata = FIRST

    def generic(self, args: Any, kws: Any) -> Any:
        if isinstance(args[0], Field) and _indexes(*args):
            return signature(args[0].kind, *args)


@infer_global(operator.setitem)
class _Set(AbstractTemplate):
    metadata = FIRST

    def generic(self, args: Any, kws: Any) -> Any:
        if isinstance(args[0], Field) and _indexes(*args[:2]):
            return signature(types.none, args[0], args[1], args[0].kind)


@lower_builtin(operator.getitem, Field, types.Any)
def _get(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.load(_pointer(context, builder, sig, args))


@lower_builtin(operator.setitem, Field, types.Any, types.Any)
def _set(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    builder.store(args[2], _pointer(context, builder, sig, args))
    return context.get_dummy_value()


@infer_getattr
class _Fields(AttributeTemplate):
    key = Struct

    def generic_resolve(self, struct: Any, name: str) -> Any:
        field = struct.fields.get(name)
        return field if field is None or field.ndim else field.kind


def _field(context: Any, builder: Any, struct: Any, value: Any, name: str) -> Any:
    """Return a field of a struct: a pointer and sizes."""
    it, field = cgutils.create_struct_proxy(struct)(context, builder, value), struct.fields[name]
    first = ROW * list(struct.fields).index(name)

    def known(k: int) -> Any:
        load = builder.load(builder.gep(it.table, [_INT(first + k)]))
        load.set_metadata("invariant.load", builder.module.add_metadata([]))  # so loops need not read it again
        return load

    result = cgutils.create_struct_proxy(field)(context, builder)
    result.data = builder.bitcast(builder.gep(it.base, [known(0)]), context.get_value_type(types.CPointer(field.kind)))
    for d in range(1, field.ndim):
        setattr(result, f"size{d}", known(d))
    return result


@lower_getattr_generic(Struct)
def _get_field(context: Any, builder: Any, struct: Any, value: Any, name: str) -> Any:
    it = _field(context, builder, struct, value, name)
    return it._getvalue() if struct.fields[name].ndim else builder.load(it.data)


@lower_setattr_generic(Struct)
def _set_field(context: Any, builder: Any, sig: Any, args: Any, name: str) -> Any:
    value = context.cast(builder, args[1], sig.args[1], sig.args[0].fields[name].kind)
    builder.store(value, _field(context, builder, sig.args[0], args[0], name).data)


def struct_of(struct: Struct) -> Any:
    """Return a compiled function of an array of floats and a table that returns the fields in it; of a `Twin`, that."""

    def fields_in(base: Any, table: Any) -> Any:
        return base

    @written(fields_in, lambda base, table: struct)
    def _fields_in(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        it = cgutils.create_struct_proxy(struct)(context, builder)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        it.base = builder.bitcast(data, context.get_value_type(types.voidptr))
        it.table = context.make_array(sig.args[1])(context, builder, args[1]).data
        return it._getvalue()

    return fields_in


def _lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Return the pointer to a lane's number."""
    pointer = _pointer(context, builder, sig, args)
    at = builder.add(builder.mul(args[2], _INT(LANES)), args[3])
    return builder.gep(builder.bitcast(pointer, ir.DoubleType().as_pointer()), [at])


def load_lane(field: Any, place: Any, number: int, lane: int) -> float:
    """Return one lane's number (0, 1, ... of a vector) at a place of a field of packs."""
    return field.array[place][number]


def store_lane(field: Any, place: Any, number: int, lane: int, value: float) -> None:
    """Set one lane's number at a place of a field of packs."""
    field.array[place][number] = value


@written(load_lane, lambda *given: real)
def _load_lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.load(_lane(context, builder, sig, args))


@written(store_lane, lambda *given: types.none)
def _store_lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    builder.store(args[4], _lane(context, builder, sig, args))
    return context.get_dummy_value()


def call(kernel: Any, *arguments: Any) -> None:
    """Call a kernel by its address, so that it is compiled once and not for each of its callers."""
    kernel(*arguments)


@written(call, lambda *given: types.none)
def _call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind = ir.FunctionType(ir.VoidType(), [context.get_value_type(k) for k in sig.args[1:]])
    builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])
    return context.get_dummy_value()
