"""The arm as data: muscles in modules, modules in series, what hangs from the tip; and its equilibrium."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil
from operator import index as as_integer
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import check, continuation, loads, section
from tca_envs.mechanics.continuation import Lane
from tca_envs.mechanics.equilibrium import Equilibrium
from tca_envs.mechanics.grid import MAX_NODES, Grid, carried, gauss, integrals
from tca_envs.mechanics.laws import PARAMETERS
from tca_envs.mechanics.loads import Payload
from tca_envs.mechanics.module import Module
from tca_envs.mechanics.rungs import Rung
from tca_envs.mechanics.solver import Model, Problem, linearise, prepare

Array = NDArray[np.float64]
ZERO = (0.0, 0.0, 0.0)
HOW = {
    Rung.SUBSTEPS: "substeps in drive and load",
    Rung.FINER: "substeps on a finer grid",
    Rung.DESCENT: "a fall from the end of the start's branch",
}
FINE_ENOUGH = 1000
"""Nodes of an arm beyond which `Arm.finer` is no finer."""
MOST_NODES = 10_000
"""Of an arm: a few iterations of Newton still fit into a second."""


@dataclass(frozen=True)
class Discretisation:
    """How an arm is discretised, and how accurate that is.

    Attributes
    ----------
    grids : tuple of Grid
        One for each module.
    residual_tolerance : float
        Newton stops when `Equilibrium.residual` is below it.
    tolerance, error : float or None
        Tip error that was asked for and its estimate [m]; None if grids were given and nothing was estimated.
    states : int
        On so many states the estimate rests.
    """

    grids: tuple[Grid, ...]
    residual_tolerance: float
    tolerance: float | None = None
    error: float | None = None
    states: int = 0

    def __str__(self) -> str:
        lines = [f"module {k}: {e} x {q} Gauss nodes" for k, (e, q) in enumerate(self.grids)]
        lines.append(f"Newton stops at a residual of {self.residual_tolerance:.1e}")
        if self.tolerance is None or self.error is None:
            lines.append("tip error: not estimated, the grids were given")
        else:
            lines.append(f"tip error: {self.error:.1e} m estimated from {self.states} states, {self.tolerance:.1e} m asked")
        return "\n".join(lines)


def default_grid(module: Module) -> Grid:
    """Return a grid that resolves a muscle-driven or moderately loaded module to below 1e-6 of its length.

    Helical muscles turn the local strain, so an element spans at most half a turn; a curved reference at most two radians.
    """
    turns = max((abs(muscle.turns) for muscle in module.muscles), default=0.0)
    bend = module.length * float(np.linalg.norm(module.reference_strain[:3]))
    return Grid(max(2, ceil(2.0 * turns), ceil(bend / 2.0)), 5 if turns > 1.0 else 8)


class Piece(NamedTuple):
    """An element of an arm's grid, and which of some arc positions it holds."""

    module: int
    number: int  # of the element in its module
    node: int  # its first node
    length: float  # [m]
    inside: NDArray[np.intp]  # indices of the positions
    fraction: Array  # their places in the element, 0 to 1


class Arm:
    """Soft modules in series, base at the origin, z along the unloaded arm.

    Parameters
    ----------
    modules : sequence of Module
        Base to tip.
    gravity : (3,) array
        Gravitational acceleration in the base frame [m/s2]; (0, 0, 9.81) hangs the arm.
    payload : Payload, optional
        A rigid body that hangs from the tip.
    grids : sequence of Grid, optional
        Discretisation, one for each module; by default `default_grid`.
    residual_tolerance : float
        Newton stops when `Equilibrium.residual` is below it. With 1e-6 the tip of the bending module is solved to some
        nanometres.

    Raises
    ------
    ValueError
        If there is no module or an argument is not of its kind.
    """

    def __init__(
        self,
        modules: Sequence[Module],
        gravity: ArrayLike = ZERO,
        payload: Payload | None = None,
        grids: Sequence[Grid] | None = None,
        residual_tolerance: float = 1e-9,
    ) -> None:
        try:
            self.modules = tuple(modules)
        except TypeError:
            raise ValueError(f"modules = {modules!r}: expected a sequence of Module") from None
        if not self.modules or not all(isinstance(module, Module) for module in self.modules):
            raise ValueError(f"modules = {modules!r}: expected at least one Module and nothing else")
        self.gravity = check.array("gravity", gravity, (3,))
        self.payload = payload
        self.grids = tuple(default_grid(m) for m in self.modules) if grids is None else _checked(grids, len(self.modules))
        nodes = sum(elements * q for elements, q in self.grids)
        if nodes > MOST_NODES:
            raise ValueError(f"grids = {self.grids!r}: expected at most {MOST_NODES} nodes in all, got {nodes}")
        self.residual_tolerance = check.scalar("residual_tolerance", residual_tolerance, 1e-12, 1e-1)
        self.length = sum(module.length for module in self.modules)
        self.muscles = tuple(muscle for module in self.modules for muscle in module.muscles)
        self.model, self.node_arc = _model(self.modules, self.grids, self.residual_tolerance)
        self.discretisation = Discretisation(self.grids, self.residual_tolerance)
        ranges = [muscle.law.drive_range() for muscle in self.muscles]
        self._lowest, self._highest = [low for low, _ in ranges], [high for _, high in ranges]
        self._found = f"converged below {self.residual_tolerance:g}"
        self._neutral = np.array(
            [m.law.neutral_drive(rest) for m, rest in zip(self.muscles, self.model.rest_length, strict=True)]
        )
        self._load = np.zeros(loads.SIZE)
        self._load[loads.GRAVITY] = self.gravity
        if payload is not None:
            self._load[loads.PAYLOAD] = _flat(payload)
        per_module = [grid.elements * grid.nodes for grid in self.grids]
        self._unloaded_strain = np.repeat(self.model.reference, per_module, axis=0)

    @cached_property
    def problem(self) -> Problem:
        """The arm as the compiled kernels read it."""
        return prepare(self.model)

    @property
    def rest_lengths(self) -> Array:
        """Path lengths of the muscles in the unloaded arm (n,) [m]."""
        return self.model.rest_length.copy()

    @cached_property
    def finer(self) -> "Arm":
        """The same arm with twice the elements, unless they are many already."""
        if len(self.node_arc) > FINE_ENOUGH:
            return self
        grids = [Grid(2 * elements, nodes) for elements, nodes in self.grids]
        return Arm(self.modules, self.gravity, self.payload, grids, self.residual_tolerance)

    def on(self, other: "Arm", lane: Lane) -> Lane:
        """Return an equilibrium of this arm on the grids of another one with the same modules."""
        return lane if other is self else lane._replace(strain=carried(self.grids, lane.strain, other.grids))

    def load(self, tip_force: ArrayLike = ZERO, tip_moment: ArrayLike = ZERO, payload: Payload | None = None) -> Array:
        """Return the external load as an array (loads.SIZE,), see `loads`."""
        load = self._load.copy()
        if payload is not None:
            load[loads.PAYLOAD] = _flat(payload)
        if tip_force is not ZERO:
            load[loads.FORCE] = check.array("tip_force", tip_force, (3,))
        if tip_moment is not ZERO:
            load[loads.MOMENT] = check.array("tip_moment", tip_moment, (3,))
        return load

    def unloaded(self) -> Lane:
        """Return strain (G, 6), tension (n,), drive (n,) and load of the unloaded arm: where every cold start begins."""
        return Lane(self._unloaded_strain.copy(), np.zeros(len(self.muscles)), self._neutral.copy(), np.zeros(loads.SIZE))

    def equilibrium(
        self,
        drive: ArrayLike,
        tip_force: ArrayLike = ZERO,
        tip_moment: ArrayLike = ZERO,
        start: Equilibrium | None = None,
        payload: Payload | None = None,
        time_limit_s: float | None = None,
    ) -> Equilibrium:
        """Find the stable equilibrium to which slow heating and loading take the arm from `start`, or from the unloaded arm.

        Parameters
        ----------
        drive : (n,) array
            Temperature [degC] of a TCA, tension [N] of a tendon, rest length [m] of a spring; modules base to tip.
        tip_force, tip_moment : (3,) arrays
            Load on the last centroid in the base frame [N], [N m].
        start : Equilibrium, optional
            An earlier equilibrium of this arm: a warm start.
        payload : Payload, optional
            What hangs from the tip instead of the arm's own payload.
        time_limit_s : float, optional
            A solve that takes longer is given up [s]; compiling the kernels at the very first one does not count. Without a
            limit counted iterations bound the work, so that the same bits come out however busy the machine is.

        Returns
        -------
        Equilibrium
            Stable; with `converged` False, and the start's shape, where none was found.

        Raises
        ------
        ValueError
            For a wrong shape, non-finite numbers, a drive outside its law's range or a start with another number of muscles or
            another length.

        Notes
        -----
        Gauss collocation of the strain, by a ladder: Newton straight from the start, its first step the tangent's prediction;
        then substeps in drive and load; then those on a finer grid; then, where the branch ends, the fall down the hill of the
        total energy, and on from there. See `solver.newton` and `continuation`.
        """
        drive = self.checked_drive(drive)
        load = self.load(tip_force, tip_moment, payload)
        if time_limit_s is not None:
            time_limit_s = check.scalar("time_limit_s", time_limit_s, 0.0, above=True)
        lane = self.unloaded() if start is None else self.restart(start)
        found = continuation.solve_one(self, lane, drive, load, time_limit_s)
        on, lane, rung = found.arm, found.lane, found.rung
        if rung == Rung.FAILED:
            message = f"no equilibrium found: Newton does not go straight to one; {found.message}; this is the start's shape"
        elif rung == Rung.WARM:
            message = self._found
        else:
            message = "; ".join([f"{self._found} by {HOW[rung]}", *filter(None, [found.message])])
        state = _Shape(on, lane)
        return Equilibrium(
            tip_pose=found.tip, tensions=lane.tension, muscle_lengths=found.lengths, drive=drive, converged=rung != Rung.FAILED,
            rung=rung, jumped=found.jumped, residual=found.residual, iterations=found.iterations, message=message,
            length=self.length, load=load, known=(lane.drive, lane.load), sample=state.sample, certify=state.certify,
            differentiate=state.differentiate, nodes=(on.model, lane.strain),
        )  # fmt: skip

    def tip_of(self, lane: Lane) -> tuple[Array, Array]:
        """Return the tip pose (4, 4) [m] and the muscles' path lengths (n,) [m] of a state."""
        shape = linearise(self.problem, *lane, "shape")
        return pose(shape.h_end[-1], shape.p_end[-1]), shape.path

    def pieces(self, s: Array) -> Iterator[Piece]:
        """Yield the elements, base to tip, with those of the arc positions `s` (k,) [m] that they hold."""
        base, node = 0.0, 0
        for k, (module, (elements, q)) in enumerate(zip(self.modules, self.grids, strict=True)):
            h = module.length / elements
            for number in range(elements):
                low, high = (base + module.length * (n / elements) for n in (number, number + 1))
                last = k == len(self.modules) - 1 and number == elements - 1
                inside = np.flatnonzero((s >= low - 1e-15) & ((s < high - 1e-15) | last))
                yield Piece(k, number, node, h, inside, (s[inside] - low) / h)
                node += q
            base += module.length

    def poses(self, lane: Lane, s: Array) -> Array:
        """Return the poses (k, 4, 4) of the cross sections of an equilibrium at arc positions `s` (k,) in [0, length] [m]."""
        shape = linearise(self.problem, *lane, "shape")
        turns, places = np.empty((s.size, 4)), np.empty((s.size, 3))
        for e, piece in enumerate(self.pieces(s)):
            q = self.grids[piece.module].nodes
            nodes = slice(piece.node, piece.node + q)
            a = piece.length * integrals(gauss(q)[2], piece.fraction)
            turns[piece.inside] = shape.h_end[e] + a @ _half_product(shape.h[nodes], lane.strain[nodes, :3])
            places[piece.inside] = shape.p_end[e] + a @ shape.tangent[nodes]
        return pose(turns, places)

    def checked_drive(self, drive: ArrayLike) -> Array:
        """Return `drive` as (n,) floats; ValueError for a wrong shape, non-finite numbers or values out of a law's range."""
        result = check.array("drive", drive, (len(self.muscles),))
        for i, (low, value, high) in enumerate(zip(self._lowest, result.tolist(), self._highest, strict=True)):
            if not low <= value <= high:
                raise ValueError(
                    f"drive[{i}] = {value:g}: expected a value in [{low:g}, {high:g}] for {type(self.muscles[i].law).__name__}"
                )
        return result

    def restart(self, start: Equilibrium) -> Lane:
        """Return strain (G, 6) on this arm's grid, tension (n,), drive (n,) and load of an equilibrium, as copies.

        Raises
        ------
        ValueError
            For a start with another number of muscles or another length.
        """
        if not isinstance(start, Equilibrium):
            raise ValueError(f"start = {start!r}: expected an Equilibrium or None")
        if start.tensions.shape != (len(self.muscles),) or abs(start.length - self.length) > 1e-9 * self.length:
            raise ValueError(
                f"start has {start.tensions.size} muscles and length {start.length:g} m: expected an equilibrium of this "
                f"arm, with {len(self.muscles)} and {self.length:g} m"
            )
        from_drive, from_load = start.known
        if start.nodes is None:
            strain = start.strain(self.node_arc)
        else:
            model, nodes = start.nodes
            if model is self.model:
                strain = nodes.copy()
            elif np.array_equal(model.length, self.model.length):
                strain = carried([Grid(e, q) for e, q in zip(model.elements, model.nodes, strict=True)], nodes, self.grids)
            else:
                strain = start.strain(self.node_arc)
        return Lane(strain, start.tensions.copy(), from_drive.copy(), from_load.copy())


class _Shape(NamedTuple):
    """A known equilibrium, and what follows from it where it is asked for."""

    arm: Arm
    lane: Lane

    def differentiate(self) -> Array:
        """Return d tip/d drive (6, n)."""
        return linearise(self.arm.problem, *self.lane, "jacobian").tip

    def certify(self) -> float:
        """Return the smallest eigenvalue of the tangent."""
        return continuation.smallest_eigenvalue(self.arm.problem, self.lane)

    def sample(self, s: Array) -> tuple[Array, Array]:
        """Return poses and strains at `s`: collocation polynomials for pose and moment, section balance for the strain."""
        arm, model = self.arm, self.arm.model
        strain, tension, _, load = self.lane
        shape = linearise(arm.problem, *self.lane, "shape")
        spin, gravity = shape.spin, load[loads.GRAVITY]
        rotation = pose(shape.h_end[-1], shape.p_end[-1])[:3, :3]
        weight = load[loads.MASS] * gravity
        force_tip, moment = load[loads.FORCE] + weight, load[loads.MOMENT] + np.cross(rotation @ load[loads.CENTRE], weight)
        poses, strains = arm.poses(self.lane, s), np.empty((s.size, 6))
        mass = 0.0
        for piece in reversed(list(arm.pieces(s))):
            module, q = arm.modules[piece.module], arm.grids[piece.module].nodes
            _, b, c = gauss(q)
            muscles = slice(model.first_muscle[piece.module], model.first_muscle[piece.module + 1])
            nodes = slice(piece.node, piece.node + q)
            coefficients = piece.length * integrals(c, piece.fraction)
            for index, a, here in zip(piece.inside, coefficients, piece.fraction, strict=True):
                r = poses[index, :3, :3]
                below = mass + module.mass_per_length * piece.length * (1.0 - here)
                moments, forces = moment + (piece.length * b - a) @ spin[nodes], force_tip + below * gravity
                fraction = (piece.number + here) / arm.grids[piece.module].elements
                route = np.array([m.route(module.length, fraction) for m in module.muscles]).reshape(-1, 4)
                nearest = strain[piece.node + int(np.argmin(np.abs(c - here)))]
                wrench, properties = np.concatenate([r.T @ moments, r.T @ forces]), (module.stiffness, module.reference_strain)
                strains[index] = section.solve(*properties, route, tension[muscles], wrench, nearest)
            moment = moment + piece.length * b @ spin[nodes]
            mass += module.mass_per_length * piece.length
        return poses, strains


def pose(quaternion: Array, position: Array) -> Array:
    """Return the (..., 4, 4) poses of quaternions (..., 4), w x y z, of any norm, and positions (..., 3)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0) / np.sqrt(np.sum(quaternion**2, axis=-1))
    result = np.zeros((*np.shape(w), 4, 4))
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    result[..., :3, :3] = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    result[..., :3, 3], result[..., 3, 3] = position, 1.0
    return result


def _flat(payload: Payload) -> tuple[float, ...]:
    if not isinstance(payload, Payload):
        raise ValueError(f"payload = {payload!r}: expected a Payload or None")
    return (payload.mass, *payload.centre)


def _half_product(q: Array, u: Array) -> Array:
    """Return (q o [0, u])/2 of (..., 4) and (..., 3), eq. (28)."""
    (w, x, y, z), (a, b, c) = np.moveaxis(q, -1, 0), np.moveaxis(u, -1, 0)
    product = [-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]
    return 0.5 * np.stack(product, axis=-1)


def _checked(grids: Sequence[Grid], modules: int) -> tuple[Grid, ...]:
    expected = f"{modules} of Grid(elements >= 1, nodes in 1..{MAX_NODES}), one for each module"
    try:
        result = tuple(Grid(*(as_integer(n) for n in grid)) for grid in grids)
    except TypeError:
        raise ValueError(f"grids = {grids!r}: expected {expected}") from None
    if len(result) != modules or any(g.elements < 1 or not 1 <= g.nodes <= MAX_NODES for g in result):
        raise ValueError(f"grids = {grids!r}: expected {expected}")
    return result


def _model(modules: tuple[Module, ...], grids: tuple[Grid, ...], tolerance: float) -> tuple[Model, Array]:
    """Return the arm as plain arrays for the kernels, and the arc positions of its nodes (G,) [m]."""
    most_nodes = max(grid.nodes for grid in grids)
    most_muscles = max(len(module.muscles) for module in modules)
    a, b = np.zeros((len(modules), most_nodes, most_nodes)), np.zeros((len(modules), most_nodes))
    routes: list[Array] = []
    mass_beyond: list[Array] = []
    arc: list[Array] = []
    base = 0.0
    for k, (module, (elements, q)) in enumerate(zip(modules, grids, strict=True)):
        a[k, :q, :q], b[k, :q], c = gauss(q)
        beyond = sum(m.mass_per_length * m.length for m in modules[k + 1 :])
        x = ((np.arange(elements)[:, np.newaxis] + c) / elements).ravel()
        route = np.zeros((len(x), most_muscles, 4))
        for i, muscle in enumerate(module.muscles):
            route[:, i] = muscle.route(module.length, x)
        routes.append(route)
        mass_beyond.append(beyond + module.mass_per_length * module.length * (1.0 - x))
        arc.append(base + module.length * x)
        base += module.length
    muscles = [(module, muscle) for module in modules for muscle in module.muscles]
    model = Model(
        elements=np.array([grid.elements for grid in grids], dtype=np.int64),
        nodes=np.array([grid.nodes for grid in grids], dtype=np.int64),
        length=np.array([module.length for module in modules]), a=a, b=b,
        stiffness=np.array([module.stiffness for module in modules]),
        reference=np.array([module.reference_strain for module in modules]),
        first_muscle=np.cumsum([0] + [len(module.muscles) for module in modules]).astype(np.int64),
        route=np.concatenate(routes), mass_beyond=np.concatenate(mass_beyond),
        kind=np.array([muscle.law.kind for _, muscle in muscles], dtype=np.int64),
        parameters=np.array([muscle.law.parameters() for _, muscle in muscles]).reshape(-1, PARAMETERS),
        rest_length=np.array([module.rest_length(muscle) for module, muscle in muscles]), tolerance=tolerance,
    )  # fmt: skip
    return model, np.concatenate(arc)
