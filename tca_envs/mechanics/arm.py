"""The arm as data: muscles in modules, modules in series, what hangs from the tip; and its equilibrium."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from math import ceil
from operator import index as as_integer
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import check, closed_form, kernels, ladder, section
from tca_envs.mechanics.collocation import JACOBIAN, SHAPE, Model, compile_kernels, flat, linearise, solve_lanes
from tca_envs.mechanics.equilibrium import Equilibrium, Rung
from tca_envs.mechanics.kernels import CLOSED_FORM, DESCENT, FAILED, FINER, LOAD, PAYLOAD_MASS, REPORT, SUBSTEPS, WARM
from tca_envs.mechanics.ladder import TIME_LIMIT_S, Lane
from tca_envs.mechanics.muscle import PARAMETERS, Muscle

Array = NDArray[np.float64]
ArrayOf3 = tuple[float, float, float]
ZERO: ArrayOf3 = (0.0, 0.0, 0.0)
EYE = np.eye(4)[np.newaxis]
LADDER = tuple(Rung)
RUNGS = {
    SUBSTEPS: "substeps in drive and load",
    FINER: "substeps on a finer grid",
    DESCENT: "a fall from the end of the start's branch",
}
STRAIGHT = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Module:
    """A soft rod with muscles in it.

    Parameters
    ----------
    length : float
        Length of the unloaded centerline [m].
    stiffness : (6,) array
        Diagonal of K: EI_x, EI_y, GJ [N m2], GA, GA, EA [N], eq. (3).
    mass_per_length : float
        [kg/m].
    muscles : sequence of Muscle
        Each runs from the module's base to its end.
    reference_strain : (6,) array
        xi* = [u*; v*], uniform: strain of the unloaded rod [1/m, 1].

    Raises
    ------
    ValueError
        For a non-positive length or stiffness, a negative mass, non-finite numbers, wrong shapes, or a muscle whose path
        shrinks to a point in the unloaded rod.
    """

    length: float
    stiffness: Array
    mass_per_length: float = 0.0
    muscles: Sequence[Muscle] = ()
    reference_strain: Array = field(default_factory=lambda: np.array(STRAIGHT))

    def __post_init__(self) -> None:
        object.__setattr__(self, "length", check.scalar("length", self.length, 0.0, above=True))
        stiffness = check.array("stiffness", self.stiffness, (6,))
        if not (stiffness > 0.0).all():
            raise ValueError(f"stiffness = {self.stiffness!r}: expected six positive numbers EI_x, EI_y, GJ, GA, GA, EA")
        reference = check.array("reference_strain", self.reference_strain, (6,))
        if not reference[5] > 0.0:
            raise ValueError(f"reference_strain = {self.reference_strain!r}: expected v*_z > 0, the rod's own direction")
        object.__setattr__(self, "mass_per_length", check.scalar("mass_per_length", self.mass_per_length, 0.0))
        try:
            muscles = tuple(self.muscles)
        except TypeError:
            raise ValueError(f"muscles = {self.muscles!r}: expected a sequence of Muscle") from None
        for i, muscle in enumerate(muscles):
            if not isinstance(muscle, Muscle):
                raise ValueError(f"muscles[{i}] = {muscle!r}: expected a Muscle")
        if len(muscles) > MOST_MUSCLES:
            raise ValueError(f"muscles = {self.muscles!r}: expected at most {MOST_MUSCLES} in a module")
        for values in (stiffness, reference):
            values.setflags(write=False)
        object.__setattr__(self, "stiffness", stiffness)
        object.__setattr__(self, "reference_strain", reference)
        object.__setattr__(self, "muscles", muscles)
        fractions = np.linspace(0.0, 1.0, 181)
        for i, muscle in enumerate(muscles):
            shortest = self._stretch(muscle, fractions).min()
            if not shortest > 1e-3:
                raise ValueError(
                    f"muscles[{i}] = {muscle!r}: expected a path that runs along the module; with reference_strain "
                    f"{reference.tolist()} it shrinks to {shortest:.3g} m per metre of centerline"
                )

    @classmethod
    def cylinder(
        cls,
        length: float,
        diameter: float,
        youngs_modulus: float,
        shear_modulus: float,
        mass: float = 0.0,
        muscles: Sequence[Muscle] = (),
        curvature: ArrayOf3 = ZERO,
    ) -> "Module":
        """Return a module of round section: EI = E pi d^4/64, GJ = G pi d^4/32, GA, EA with A = pi d^2/4.

        Parameters
        ----------
        length, diameter : float
            [m].
        youngs_modulus, shear_modulus : float
            [Pa].
        mass : float
            Of the whole module [kg].
        muscles : sequence of Muscle
            Each runs from the module's base to its end.
        curvature : (3,) array
            u* [1/m]: curvature of the unloaded rod about x, y and its twist.
        """
        length = check.scalar("length", length, 0.0, above=True)
        diameter = check.scalar("diameter", diameter, 0.0, above=True)
        e = check.scalar("youngs_modulus", youngs_modulus, 0.0, above=True)
        g = check.scalar("shear_modulus", shear_modulus, 0.0, above=True)
        mass = check.scalar("mass", mass, 0.0)
        u = check.array("curvature", curvature, (3,))
        area, inertia = np.pi * diameter**2 / 4.0, np.pi * diameter**4 / 64.0
        stiffness = np.array([e * inertia, e * inertia, 2.0 * g * inertia, g * area, g * area, e * area])
        return cls(length, stiffness, mass / length, muscles, np.array([*u, 0.0, 0.0, 1.0]))

    def route(self, muscle: Muscle, fraction: float | Array) -> Array:
        """Return x, y [m] of a muscle in the section and their derivatives in s, at s = fraction * length; (..., 4)."""
        rate = 2.0 * np.pi * muscle.turns / self.length
        angle = muscle.angle + rate * self.length * fraction
        x, y = muscle.offset * np.cos(angle), muscle.offset * np.sin(angle)
        return np.stack([x, y, -rate * y, rate * x], axis=-1)

    def _stretch(self, muscle: Muscle, fractions: Array) -> Array:
        """Return |p_a'| of the unloaded rod, eq. (13)."""
        x, y, dx, dy = self.route(muscle, fractions).T
        u, v = self.reference_strain[:3], self.reference_strain[3:]
        return np.linalg.norm([v[0] - u[2] * y + dx, v[1] + u[2] * x + dy, v[2] + u[0] * y - u[1] * x], axis=0)

    def rest_length(self, muscle: Muscle) -> float:
        """Return the path length of a muscle in the unloaded rod [m], l* of eq. (24), by Gauss quadrature."""
        points, weights = legendre_nodes(64)
        return 0.5 * self.length * float(weights @ self._stretch(muscle, 0.5 * (points + 1.0)))


@dataclass(frozen=True)
class Payload:
    """A rigid body that hangs from the tip.

    Parameters
    ----------
    mass : float
        [kg].
    centre : (3,) tuple
        Its centre of mass in the frame of the arm's last cross section [m].
    """

    mass: float
    centre: ArrayOf3 = ZERO

    def __post_init__(self) -> None:
        check.scalar("mass", self.mass, 0.0)
        check.array("centre", self.centre, (3,))


class Grid(NamedTuple):
    """How a module is discretised: `elements` of equal length with `nodes` Gauss nodes each."""

    elements: int
    nodes: int


MAX_NODES = 16
FINE_ENOUGH = 1000
"""Nodes of an arm beyond which `Arm.finer` is no finer."""
MOST_NODES = 10_000
"""Of an arm: a few iterations of Newton still fit into a second."""
MOST_MUSCLES = 32
"""Of a module, for the same reason."""


@dataclass(frozen=True)
class Discretisation:
    """How an arm is discretised, and how accurate that is.

    Attributes
    ----------
    grids : tuple of Grid
        One for each module.
    residual_tolerance : float
        Newton stops when `Equilibrium.residual` is below it.
    closed_form : bool
        Whether nothing is integrated where nothing loads the arm.
    tolerance, error : float or None
        Tip error that was asked for and its estimate [m]; None if grids were given and nothing was estimated.
    states : int
        On so many states the estimate rests.
    """

    grids: tuple[Grid, ...]
    residual_tolerance: float
    closed_form: bool
    tolerance: float | None = None
    error: float | None = None
    states: int = 0

    def __str__(self) -> str:
        lines = [f"module {k}: {e} x {q} Gauss nodes" for k, (e, q) in enumerate(self.grids)]
        lines.append(f"Newton stops at a residual of {self.residual_tolerance:.1e}")
        lines.append(f"closed form without load: {'yes' if self.closed_form else 'no'}")
        if self.tolerance is None or self.error is None:
            lines.append("tip error: not estimated, the grids were given")
        else:
            lines.append(f"tip error: {self.error:.1e} m estimated from {self.states} states, {self.tolerance:.1e} m asked")
        return "\n".join(lines)


@cache
def legendre_nodes(count: int) -> tuple[Array, Array]:
    """Return nodes and weights of Gauss quadrature on [-1, 1]."""
    return np.polynomial.legendre.leggauss(count)


@cache
def gauss(nodes: int) -> tuple[Array, Array, Array]:
    """Return the Gauss collocation coefficients a (q, q), weights b (q,) and nodes c (q,) on [0, 1]."""
    x, w = legendre_nodes(nodes)
    return integrals((x + 1.0) / 2.0, (x + 1.0) / 2.0), w / 2.0, (x + 1.0) / 2.0


def integrals(c: Array, x: Array) -> Array:
    """Return A (len(x), q): integrals from 0 to x of the Lagrange polynomials on the nodes c in [0, 1]."""
    q = len(c)
    legendre = np.polynomial.legendre
    vandermonde = legendre.legvander(2.0 * c - 1.0, q - 1)
    columns = legendre.legval(2.0 * x - 1.0, legendre.legint(np.eye(q), lbnd=-1.0)) / 2.0
    return np.asarray(np.linalg.solve(vandermonde.T, columns).T, dtype=np.float64)


@cache
def interpolation(here: Grid, there: Grid) -> tuple[NDArray[np.int64], Array]:
    """Return what takes values at the nodes of one grid of a module to those of another, `interpolated`.

    Nodes (G', q) of the element that each new node lies in, and the values of their Lagrange polynomials there (G', q).
    """
    vandermonde = np.polynomial.legendre.legvander
    x = ((np.arange(there.elements)[:, np.newaxis] + gauss(there.nodes)[2]) / there.elements * here.elements).ravel()
    element = np.minimum(x.astype(np.int64), here.elements - 1)
    basis = vandermonde(2.0 * gauss(here.nodes)[2] - 1.0, here.nodes - 1)
    values = vandermonde(2.0 * (x - element) - 1.0, here.nodes - 1)
    weights = np.asarray(np.linalg.solve(basis.T, values.T).T, dtype=np.float64)
    return element[:, np.newaxis] * here.nodes + np.arange(here.nodes), weights


def interpolated(here: Grid, values: Array, there: Grid) -> Array:
    """Return values (..., G, d) at the nodes of one grid of a module interpolated to those of another, (..., G', d)."""
    nodes, weights = interpolation(here, there)
    return np.einsum("gq,...gqd->...gd", weights, values[..., nodes, :])


def carried(here: Sequence[Grid], strain: Array, there: Sequence[Grid]) -> Array:
    """Return strains (..., G, 6) at the nodes of an arm's grids `here` interpolated to those of other grids, (..., G', 6)."""
    parts, first = [], 0
    for old, new in zip(here, there, strict=True):
        last = first + old.elements * old.nodes
        parts.append(interpolated(old, strain[..., first:last, :], new))
        first = last
    return np.ascontiguousarray(np.concatenate(parts, axis=-2))  # kernels are compiled for this layout alone


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
    number: int
    """Of the element in its module."""
    node: int
    """Its first node."""
    length: float
    """[m]."""
    inside: NDArray[np.intp]
    """Indices of the positions."""
    fraction: Array
    """Their places in the element, 0 to 1."""


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
        self.model, self.node_arc = _compile(self.modules, self.grids, self.residual_tolerance)
        self.sections = _sections(self.modules, self.grids, self.node_arc)
        massless = not any(module.mass_per_length for module in self.modules)
        self._weightless = self.sections is not None and (massless or not self.gravity.any())
        self.discretisation = Discretisation(self.grids, self.residual_tolerance, self.sections is not None)
        ranges = [muscle.law.drive_range() for muscle in self.muscles]
        self._lowest, self._highest = [low for low, _ in ranges], [high for _, high in ranges]
        self._found = f"converged below {self.residual_tolerance:g}"
        self._neutral = np.array(
            [m.law.neutral_drive(rest) for m, rest in zip(self.muscles, self.model.rest_length, strict=True)]
        )
        self._load = np.zeros(LOAD)
        self._load[6:9] = self.gravity
        if payload is not None:
            self._load[PAYLOAD_MASS:] = _flat(payload)
        per_module = [grid.elements * grid.nodes for grid in self.grids]
        self._unloaded_strain = np.repeat(self.model.reference, per_module, axis=0)

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
        """Return the external load as the flat array of `kernels.LOAD` numbers that the kernels read."""
        load = self._load.copy()
        if payload is not None:
            load[PAYLOAD_MASS:] = _flat(payload)
        if tip_force is not ZERO:
            load[0:3] = check.array("tip_force", tip_force, (3,))
        if tip_moment is not ZERO:
            load[3:6] = check.array("tip_moment", tip_moment, (3,))
        return load

    def unstressed(self, load: Array) -> bool:
        """Return whether `closed_form` applies: nothing loads the arm, and its modules' strains are uniform then."""
        return self._weightless and not load[:6].any() and not (load[PAYLOAD_MASS] and self.gravity.any())

    def unloaded(self) -> Lane:
        """Return strain (G, 6), tension (n,), drive (n,) and load of the unloaded arm: where every cold start begins."""
        return Lane(self._unloaded_strain.copy(), np.zeros(len(self.muscles)), self._neutral.copy(), np.zeros(LOAD))

    def equilibrium(
        self,
        drive: ArrayLike,
        tip_force: ArrayLike = ZERO,
        tip_moment: ArrayLike = ZERO,
        start: Equilibrium | None = None,
        payload: Payload | None = None,
        time_limit_s: float = TIME_LIMIT_S,
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
        time_limit_s : float
            A solve that takes longer is given up [s]; the compiling of the kernels at the very first one does not count.

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
        total energy, and on from there. See `kernels.newton`, `kernels.follow` and `ladder`.
        """
        drive = self.checked_drive(drive)
        load = self.load(tip_force, tip_moment, payload)
        if time_limit_s is not TIME_LIMIT_S:
            time_limit_s = check.scalar("time_limit_s", time_limit_s, 0.0, above=True)
        lane = self.unloaded() if start is None else self.restart(start)
        tip, lengths, report = EYE.copy(), np.empty((1, drive.size)), np.empty((1, REPORT))
        asked = (drive[np.newaxis], load[np.newaxis])
        on, message = self, ""
        if not (self.unstressed(load) and self._closed_form(lane, *asked, tip, lengths, report)):
            compile_kernels()
            begun = time.perf_counter()
            strain, tension, from_drive, from_load = lane
            solve_lanes(
                self.model, strain[np.newaxis], tension[np.newaxis], from_drive[np.newaxis], from_load[np.newaxis], *asked,
                tip, lengths, report,
            )  # fmt: skip
            if report[0, 0] == FAILED:
                here = self.unloaded() if start is None else self.restart(start)
                climbed = ladder.climb(self, here, lane, drive, load, report[0, 3], begun, time_limit_s)
                message, on, lane = climbed.message, climbed.arm, climbed.lane
                tip[0], lengths[0], iterations = climbed.tip, climbed.lengths, report[0, 2] + climbed.iterations
                report[0, :4] = climbed.rung, climbed.residual, iterations, climbed.jumped
            elif report[0, 0] == SUBSTEPS or report[0, 4] > ladder.DOUBT:
                here = self.unloaded() if start is None else self.restart(start)
                report[0, 3] = not ladder.returns(self.model, lane, here, begun + time_limit_s)
        rung, residual, iterations, jumped, _ = report[0].tolist()
        if rung == FAILED:
            on, lane = self, here
            ends, _, position, _, _, lengths[0] = on.shape(lane)
            tip[0] = pose(ends[-1], position[-1])
            message = f"no equilibrium found: Newton does not go straight to one; {message}; this is the start's shape"
        elif rung == CLOSED_FORM:
            message = "closed form: nothing loads the arm"
        elif rung == WARM:
            message = self._found
        else:
            message = "; ".join([f"{self._found} by {RUNGS[rung]}", *filter(None, [message])])
        state = _Shape(on, lane)
        return Equilibrium(
            tip_pose=tip[0],
            tensions=lane.tension,
            muscle_lengths=lengths[0],
            drive=drive,
            converged=rung != FAILED,
            rung=LADDER[int(rung)],
            jumped=bool(jumped),
            residual=residual,
            iterations=int(iterations),
            message=message,
            length=self.length,
            load=load,
            known=(lane.drive, lane.load),
            sample=state.sample,
            differentiate=state.differentiate,
            certify=state.certify,
            nodes=(on.model, lane.strain),
        )

    def _closed_form(self, lane: Lane, drive: Array, load: Array, tip: Array, lengths: Array, report: Array) -> bool:
        """Solve in closed form, in place; False where that is no answer, or where the lane is left as it was."""
        strain, tension, at_drive, at_load = (values.copy() for values in lane)
        known = (strain[np.newaxis], tension[np.newaxis], at_drive[np.newaxis], at_load[np.newaxis])
        if not closed_form.solve_lane(self.model, self.sections, *known, drive, load, tip, lengths, report):
            return False
        # Where nothing pushes the energy is convex; but a muscle may, and a coarse grid may not hold the shape.
        if ladder.negative_eigenvalues(self.model, strain, tension, at_drive, at_load, kernels.NEUTRAL):
            return False
        for values, new in zip(lane, (strain, tension, at_drive, at_load), strict=True):
            values[...] = new
        return True

    def shape(self, lane: Lane) -> tuple[Array, ...]:
        """Return quaternions at elements' ends and nodes, positions at ends [m], p' and p' x n at nodes, path lengths [m]."""
        strain, tension, drive, load = lane
        return linearise(self.model, strain, tension.copy(), drive, load, 0.0, False, SHAPE, strain)[1:7]

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
        ends, quaternion, position, tangent, _, _ = self.shape(lane)
        turns, places = np.empty((s.size, 4)), np.empty((s.size, 3))
        for e, piece in enumerate(self.pieces(s)):
            q = self.grids[piece.module].nodes
            nodes = slice(piece.node, piece.node + q)
            a = piece.length * integrals(gauss(q)[2], piece.fraction)
            turns[piece.inside] = ends[e] + a @ _half_product(quaternion[nodes], lane.strain[nodes, :3])
            places[piece.inside] = position[e] + a @ tangent[nodes]
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
        strain, tension, drive, load = self.lane
        return linearise(self.arm.model, strain, tension.copy(), drive, load, 0.0, False, JACOBIAN, strain)[-1]

    def certify(self) -> float:
        """Return the smallest eigenvalue of the tangent."""
        return ladder.smallest_eigenvalue(self.arm.model, *self.lane)

    def sample(self, s: Array) -> tuple[Array, Array]:
        """Return poses and strains at `s`: collocation polynomials for pose and moment, section balance for the strain."""
        arm, model = self.arm, self.arm.model
        strain, tension, _, load = self.lane
        ends, _, position, _, spin, _ = arm.shape(self.lane)
        rotation = pose(ends[-1], position[-1])[:3, :3]
        force_tip = load[0:3] + load[9] * load[6:9]
        moment = load[3:6] + np.cross(rotation @ load[10:13], load[9] * load[6:9])
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
                wrench = np.concatenate(
                    [
                        r.T @ (moment + (piece.length * b - a) @ spin[nodes]),
                        r.T @ (force_tip + below * load[6:9]),
                    ]
                )
                fraction = (piece.number + here) / arm.grids[piece.module].elements
                route = np.array([module.route(m, fraction) for m in module.muscles]).reshape(-1, 4)
                nearest = strain[piece.node + int(np.argmin(np.abs(c - here)))]
                strains[index] = section.solve(
                    module.stiffness,
                    module.reference_strain,
                    route,
                    tension[muscles],
                    wrench,
                    nearest,
                )
            moment = moment + piece.length * b @ spin[nodes]
            mass += module.mass_per_length * piece.length
        return poses, strains


def pose(quaternion: Array, position: Array) -> Array:
    """Return the (..., 4, 4) poses of quaternions (..., 4), w x y z, of any norm, and positions (..., 3)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0) / np.sqrt(np.sum(quaternion**2, axis=-1))
    result = np.zeros((*np.shape(w), 4, 4))
    result[..., 0, 0], result[..., 0, 1], result[..., 0, 2] = (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
    )
    result[..., 1, 0], result[..., 1, 1], result[..., 1, 2] = (
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
    )
    result[..., 2, 0], result[..., 2, 1], result[..., 2, 2] = (
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )
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


def _sections(modules: tuple[Module, ...], grids: tuple[Grid, ...], node_arc: Array) -> closed_form.Sections | None:
    """Return the modules' sections for `closed_form`, or None where a module's strain is not uniform without load.

    It is where all muscles run straight, and also where all turn at the same rate around a rod that looks alike from all sides.
    """
    turn = np.zeros(len(modules))
    for k, module in enumerate(modules):
        turns = {muscle.turns for muscle in module.muscles if muscle.offset > 0.0}
        axial = not module.reference_strain[[0, 1, 3, 4]].any()
        alike = axial and module.stiffness[0] == module.stiffness[1] and module.stiffness[3] == module.stiffness[4]
        if len(turns) > 1 or (any(turns) and not alike):
            return None
        turn[k] = 2.0 * np.pi * sum(turns) / module.length
    route = np.array([module.route(muscle, 0.0) for module in modules for muscle in module.muscles]).reshape(-1, 4)
    bases = np.cumsum([0.0, *(module.length for module in modules[:-1])])
    arc = node_arc - np.repeat(bases, [grid.elements * grid.nodes for grid in grids])
    return closed_form.Sections(route, turn, arc)


def _compile(modules: tuple[Module, ...], grids: tuple[Grid, ...], tolerance: float) -> tuple[Model, Array]:
    """Return the arm as plain arrays for the kernels, and the arc positions of its nodes (G,) [m]."""
    most_nodes = max(grid.nodes for grid in grids)
    most_muscles = max(len(module.muscles) for module in modules)
    a, b = np.zeros((len(modules), most_nodes, most_nodes)), np.zeros((len(modules), most_nodes))
    routes: list[Array] = []
    mass_below: list[Array] = []
    arc: list[Array] = []
    base = 0.0
    for k, (module, (elements, q)) in enumerate(zip(modules, grids, strict=True)):
        a[k, :q, :q], b[k, :q], c = gauss(q)
        beyond = sum(m.mass_per_length * m.length for m in modules[k + 1 :])
        x = ((np.arange(elements)[:, np.newaxis] + c) / elements).ravel()
        route = np.zeros((len(x), most_muscles, 4))
        for i, muscle in enumerate(module.muscles):
            route[:, i] = module.route(muscle, x)
        routes.append(route)
        mass_below.append(beyond + module.mass_per_length * module.length * (1.0 - x))
        arc.append(base + module.length * x)
        base += module.length
    muscles = [(module, muscle) for module in modules for muscle in module.muscles]
    fields: dict[str, Any] = dict(
        elements=np.array([grid.elements for grid in grids], dtype=np.int64),
        nodes=np.array([grid.nodes for grid in grids], dtype=np.int64),
        length=np.array([module.length for module in modules]),
        a=a,
        b=b,
        stiffness=np.array([module.stiffness for module in modules]),
        reference=np.array([module.reference_strain for module in modules]),
        first_muscle=np.cumsum([0] + [len(module.muscles) for module in modules]).astype(np.int64),
        route=np.concatenate(routes),
        mass_below=np.concatenate(mass_below),
        kind=np.array([muscle.law.kind for _, muscle in muscles], dtype=np.int64),
        parameters=np.array([muscle.law.parameters() for _, muscle in muscles]).reshape(-1, PARAMETERS),
        rest_length=np.array([module.rest_length(muscle) for module, muscle in muscles]),
        tolerance=tolerance,
    )
    f, i = flat(**fields)
    return Model(**fields, ladder=True, f=f, i=i), np.concatenate(arc)
