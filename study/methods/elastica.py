"""Relaxation of an explicit dynamic rod on the speed-accuracy chart: PyElastica.

Package: `pyelastica` (https://github.com/GazzolaLab/PyElastica), Gazzola et al., Royal Society Open Science 5, 171628, 2018.
Rod, internal forces and the position Verlet stepper are the package's own; it has no static solver. So this file adds

* the clamp: a short element that does not move, so that the base is where it should be (a rod that is clamped at its first
  element's middle is too short by half an element, an error of first order);
* muscles, payload and weight as a forcing of the rod: each muscle adds F t to the force and F r x t to the couple of the
  cross sections, discretised as the package does its own, and its tension follows from path length and law at every step;
* relaxation to rest: masses of no meaning, equal highest frequencies all over the rod, and damping that is critical for the
  slowest motion seen, estimated from how accelerations change with positions (Rayleigh's quotient).

The package's law is another one than this project's: its sections keep their volume, so that n = S (v - v*)/e and
m = B (u - u*)/e^3 with the stretch e. `METHOD` takes that law as it is: it converges to another tip. `MATCHED` scales S by e
and B by e^3 at every step and so solves this project's model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from math import cos, inf, pi, sin, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from study.method import Answer, Array, Method, State

from study.notation import (  # isort: skip
    CENTRE, FORCE, GRAVITY, MASS, MOMENT, TENDON, Integers, inline, kernel, mismatch, put1, vec, vec1,
)  # fmt: skip
from study.notation import routes as routes_of
from tca_envs.mechanics import Arm, Equilibrium, compiled
from tca_envs.mechanics.solver.simd import Mat, Vec, cross, dot, times, transpose

SOCKET = 0.01  # length of the clamped element over that of the first one
COURANT = 0.7  # time step over that at which the stiffest element of the unloaded rod would become unstable
THINNING = 2.0  # reserve of the rotational inertia for sections that a contraction thickens (the package's law)
BLOCK = 20  # steps between two looks at damping and rest
MAX_STEPS = 40_000
REST = 2e-3
"""At rest when the way to go is less than REST h^2/L, with elements of length h: well below the error of discretisation."""


class Routes(NamedTuple):
    """Muscles, in elements of the rod; element 0 is the clamped one. n muscles, at most q elements to a muscle."""

    first: Integers  # (n,) first element
    span: Integers  # (n,) number of elements
    place: Array  # (n, q + 1, 4) x, y [m] and their derivatives between elements; at the ends: within half an element
    turn: Array  # (n, 4) cosine and sine of the muscle's turn over half an element, over a quarter
    share: Array  # (n, 2, 3) share of a muscle's couples in those across its first and last boundary, about x, y, z


class Rest(NamedTuple):
    """A rod at rest: what a solve starts from."""

    position: Array
    director: Array
    tension: Array


@inline
def at(x, e):
    """Return column e of an array (3, ...)."""
    return Vec(x[0, e], x[1, e], x[2, e])


@inline
def add_at(x, e, y):
    """Add a vector to column e of an array (3, ...)."""
    x[0, e] += y.x
    x[1, e] += y.y
    x[2, e] += y.z


@inline
def frame(directors, e):
    """Return R^T of element e."""
    d = directors
    return Mat(d[0, 0, e], d[0, 1, e], d[0, 2, e], d[1, 0, e], d[1, 1, e], d[1, 2, e], d[2, 0, e], d[2, 1, e], d[2, 2, e])


@inline
def turned(x, c, s):
    """Return x turned about z by the angle of cosine c and sine s."""
    return Vec(c * x.x - s * x.y, s * x.x + c * x.y, x.z)


@inline
def tangent(routes, i, k, lengths, sigma, kappa, end):
    """Return p_i' = v + u x r + r' at place k of muscle i, and the length of rod that it stands for; `end` is u at the tip.

    Along a helical muscle v turns as the muscle does: a mean of elements is one in the frame that turns along.
    Extrapolating u, instead of taking the nearest, would feed energy into the rod: it flutters.
    """
    a, count = routes.first[i], routes.span[i]
    b = a + count
    if k == 0:
        v, width, u = turned(at(sigma, a), routes.turn[i, 2], -routes.turn[i, 3]), 0.5 * lengths[a], at(kappa, a)
        if a == 1:
            # All of the bend across the clamped element's end is in the half element beyond.
            u = (lengths[0] + lengths[1]) / lengths[1] * at(kappa, 0)
    elif k == count:
        v, width = turned(at(sigma, b - 1), routes.turn[i, 2], routes.turn[i, 3]), 0.5 * lengths[b - 1]
        u = at(kappa, b - 2)
        if b == lengths.size:
            u = end
    else:
        e = a + k - 1
        below = turned(at(sigma, e), routes.turn[i, 0], routes.turn[i, 1])
        v, width = 0.5 * (below + turned(at(sigma, e + 1), routes.turn[i, 0], -routes.turn[i, 1])), lengths[e]
        u = at(kappa, e)
    x, y = routes.place[i, k, 0], routes.place[i, k, 1]
    change = Vec(routes.place[i, k, 2] - u.z * y, routes.place[i, k, 3] + u.z * x, 1.0 + u.x * y - u.y * x)
    return v + change, width


@inline
def lever_of(routes, i, k, t):
    """Return r x t at place k of muscle i."""
    x, y = routes.place[i, k, 0], routes.place[i, k, 1]
    return Vec(y * t.z, -x * t.z, x * t.y - y * t.x)


@inline
def pull_on(e, force, c, s, lengths, sigma, directors, forces, torques):
    """Add the muscle's force on the cross sections of element e, turned about z by the angle of cosine c and sine s."""
    t = turned(force, c, s)
    add_at(torques, e, lengths[e] * cross(at(sigma, e) + Vec(0.0, 0.0, 1.0), t))
    part = transpose(frame(directors, e)) @ t
    add_at(forces, e, part)
    add_at(forces, e + 1, -part)


@inline
def bent(u, s, x):
    """Return the vector x of the frame at s beyond, in the frame here: u is constant, and the turn up to second order."""
    once = cross(u, x)
    return x + s * once + 0.5 * s * s * cross(u, once)


@inline
def pull_at(arm, i, length, tension, drive):
    """Return the tension that stretches muscle i to a path length, by Newton from a tension near it."""
    if arm.kind[i] == TENDON:
        return drive
    for _ in range(8):
        gap, slope = mismatch(arm, i, length, tension, drive)
        tension -= gap / slope
        if abs(gap / slope) < 1e-9:
            break
    return tension


@kernel
def load_tip(routes, lengths, weights, tip, load, tension, sigma, kappa, directors, forces, torques):
    """Add weight, tip load and payload; returns u at the tip, which the load and the muscles there bend the rod to.

    The tip's frame lies half an element beyond the last director, bent as its own moment bends it.
    """
    last = lengths.size - 1
    gravity, weight = vec1(load, GRAVITY), load[MASS] * vec1(load, GRAVITY)
    for node in range(2, last + 2):
        add_at(forces, node, weights[node] * gravity)
    add_at(forces, last + 1, vec1(load, FORCE) + weight)
    back, arm, end = frame(directors, last), vec1(load, CENTRE), at(kappa, last - 1)
    hangs, twists = back @ weight, back @ vec1(load, MOMENT)
    moment = twists + cross(bent(end, 0.5 * lengths[last], arm), hangs)
    for i in range(routes.first.size):
        count = routes.span[i]
        if routes.first[i] + count == lengths.size:
            t, _ = tangent(routes, i, count, lengths, sigma, kappa, end)
            moment -= tension[i] / sqrt(dot(t, t)) * lever_of(routes, i, count, t)
    v = at(sigma, last) + Vec(0.0, 0.0, 1.0)
    softer = dot(v, v) ** (0.5 * tip[6])
    end = vec1(tip, 3) + softer * Vec(moment.x / tip[0], moment.y / tip[1], moment.z / tip[2])
    put1(tip, 7, end)
    add_at(torques, last, twists + cross(bent(end, 0.5 * lengths[last], arm), hangs))
    return end


@kernel
def pull_along(routes, i, pull, end, lengths, widths, sigma, kappa, directors, forces, torques):
    """Add what muscle i does to the rod along its way at a tension [N]."""
    a, count = routes.first[i], routes.span[i]
    b = a + count
    c, s, ce, se = routes.turn[i, 0], routes.turn[i, 1], routes.turn[i, 2], routes.turn[i, 3]
    for k in range(count + 1):
        t, _ = tangent(routes, i, k, lengths, sigma, kappa, end)
        t = pull / sqrt(dot(t, t)) * t
        # A force belongs to the elements that its place has v from: to each by half, for every element has two places.
        half = 0.5 * t
        if k == 0:
            pull_on(a, half, ce, se, lengths, sigma, directors, forces, torques)
        elif k == count:
            pull_on(b - 1, half, ce, -se, lengths, sigma, directors, forces, torques)
        else:
            pull_on(a + k - 1, half, c, -s, lengths, sigma, directors, forces, torques)
            pull_on(a + k, half, c, s, lengths, sigma, directors, forces, torques)
        # A couple belongs to a boundary of elements; a muscle's end has its share. Nothing is beyond the tip.
        boundary = a - 1 + k
        if boundary < lengths.size - 1:
            couple = lever_of(routes, i, k, t)
            if k == 0 or k == count:
                couple = times(vec(routes.share[i], 0 if k == 0 else 1, 0), couple)
            turn = 0.5 * widths[boundary] * cross(at(kappa, boundary), couple)
            add_at(torques, boundary, turn + couple)
            add_at(torques, boundary + 1, turn - couple)


@compiled
def apply(
    arm, routes, lengths, widths, weights, tip, drive, load, tension, sigma, kappa, directors, forces, torques
):  # fmt: skip
    """Add weight, tip load, payload and muscles to the external forces and torques of the rod; update the tensions [N].

    `lengths` (e,) and `widths` (e - 1,) are rest lengths of elements and of the spans between their middles [m], `weights` (e +
    1,) the masses on the nodes [kg]. `tip` (10,) holds B, u* and the power of e in the law at the tip, and u there, which this
    computes. The package's `sigma`, `kappa`, `directors` are v - e_z, u and R^T; forces are in the base frame, torques in the
    body's.
    """
    end = load_tip(routes, lengths, weights, tip, load, tension, sigma, kappa, directors, forces, torques)
    for i in range(routes.first.size):
        length = 0.0
        for k in range(routes.span[i] + 1):
            t, width = tangent(routes, i, k, lengths, sigma, kappa, end)
            length += width * sqrt(dot(t, t))
        tension[i] = pull_at(arm, i, length, tension[i], drive[i])
        pull_along(routes, i, tension[i], end, lengths, widths, sigma, kappa, directors, forces, torques)


@compiled
def still(velocity, omega, factor):
    """Damp all velocities by a factor, those of the clamped element to zero."""
    for d in range(3):
        for k in range(velocity.shape[1]):
            velocity[d, k] *= factor
        for k in range(omega.shape[1]):
            omega[d, k] *= factor
        velocity[d, 0] = velocity[d, 1] = omega[d, 0] = 0.0


@dataclass
class Inputs:
    """What forcing and damping read at each step."""

    drive: Array
    load: Array
    tension: Array
    factor: float = 1.0
    slowest: float = inf  # frequency of the slowest motion in the solve that `build` tries [rad/s]
    last: float = inf  # the same of the last solve


@dataclass(frozen=True, eq=False)
class Relaxation:
    """A rod of the package in a simulator, made ready for one arm."""

    arm: Arm
    rod: Any
    step: Any  # () -> None: one time step
    inputs: Inputs
    stiffness: tuple[Array, Array]  # S and B of the unloaded rod
    matched: bool
    tip: Array  # as of `apply`
    time_step: float
    way: float  # at rest when no node has farther to go [m]
    unloaded: Rest
    arcs: tuple[Array, Array]  # of the nodes and of the elements' middles, the clamped element's left out [m]

    def cold(self) -> Rest:
        """Return the straight rod."""
        return self.unloaded

    def near(self, known: Equilibrium, state: State) -> Rest:
        """Return the rod in a known shape."""
        position, director = self.unloaded.position.copy(), self.unloaded.director.copy()
        nodes, middles = self.arcs
        position[:, 1:] = known.poses(nodes)[:, :3, 3].T
        director[:, :, 1:] = known.poses(middles)[:, :3, :3].transpose(2, 1, 0)
        return Rest(position, director, known.tensions)

    def solve(self, state: State, guess: Rest) -> Answer:
        """Relax to rest at `state`."""
        rod, inputs = self.rod, self.inputs
        rod.position_collection[:] = guess.position
        rod.director_collection[:] = guess.director
        rod.velocity_collection[:] = 0.0
        rod.omega_collection[:] = 0.0
        inputs.tension[:], inputs.drive[:], inputs.load[:] = guess.tension, state.drive, state.load
        with np.errstate(all="ignore"):
            try:
                rests = self._relax()
            except ZeroDivisionError:
                rests = False
        if not rests:
            return Answer(False, np.eye(4), None)
        found = Rest(rod.position_collection.copy(), rod.director_collection.copy(), inputs.tension.copy())
        return Answer(True, self._tip(), found)

    def _relax(self) -> bool:
        """Step until nothing moves; whether it came to rest."""
        rod, inputs = self.rod, self.inputs
        position, acceleration = rod.position_collection, rod.acceleration_collection
        # The slowest motion is not known yet: light damping lets it show.
        slowest = 0.01 / self.time_step
        before: tuple[Array, Array] | None = None
        for _ in range(MAX_STEPS // BLOCK):
            inputs.factor = np.exp(-2.0 * slowest * self.time_step)
            if self.matched:
                # Not at every step: stiffness that lags behind a fast motion by one step drives it.
                shear, bend = self.stiffness  # S e and B e^3 make the package's law n = S (v - v*), m = B (u - u*)
                rod.shear_matrix[:], rod.bend_matrix[:] = shear * rod.dilatation, bend * rod.voronoi_dilatation**3
            for _ in range(BLOCK):
                self.step()
            # The clamped nodes feel forces but do not move.
            here, there = position[:, 2:].copy(), acceleration[:, 2:].copy()
            if not np.isfinite(there).all():
                return False
            if before is not None:
                moved = here - before[0]
                squared = float((moved * moved * rod.mass[2:]).sum())
                stiffness = -float((moved * (there - before[1]) * rod.mass[2:]).sum())
                if squared > 0.0 and stiffness > 0.0:
                    slowest = min(sqrt(stiffness / squared), 0.2 / self.time_step)
            # What accelerates or still moves has a way to go; at a turning point only one of them shows. At first faster
            # motions may hide the slow one: then the way is that of the slowest known.
            slow = min(slowest, inputs.slowest)
            way = float(np.abs(there).max()) / slow**2 + float(np.abs(rod.velocity_collection).max()) / slow
            if before is not None and way < self.way:
                inputs.last = slowest
                return True
            before = here, there
        return False

    def _tip(self) -> Array:
        """Return the pose of the tip: the last element's, turned on over its second half."""
        rod = self.rod
        turn = Rotation.from_rotvec(0.5 * rod.rest_lengths[-1] * self.tip[7:])
        pose = np.eye(4)
        pose[:3, :3] = rod.director_collection[:, :, -1].T @ turn.as_matrix()
        pose[:3, 3] = rod.position_collection[:, -1]
        return pose


def build(arm: Arm, elements: int, states: Sequence[State], matched: bool) -> Relaxation:
    """Return the rod with `elements` elements in each module, compiled."""
    import elastica

    rod, widths, arcs = _rod(elastica, arm, elements)
    numbers, routes = arm.model, _routes(arm, elements, rod, widths)
    weights = np.zeros(rod.n_nodes)
    for k, module in enumerate(arm.modules):
        mass = module.mass_per_length * module.length / elements
        mine = 1 + k * elements + np.arange(elements)
        weights[mine] += 0.5 * mass
        weights[mine + 1] += 0.5 * mass
    tension, drive, load = np.zeros(len(arm.muscles)), arm.unloaded()[2], arm.unloaded()[3]
    inputs = Inputs(drive, load, tension)
    lengths, stiffness = rod.rest_lengths.copy(), (rod.shear_matrix.copy(), rod.bend_matrix.copy())
    time_step = _time_step(rod)
    tip = np.concatenate([stiffness[1][range(3), range(3), -1], rod.rest_kappa[:, -1], [0.0 if matched else 3.0], np.zeros(3)])

    class Load(elastica.NoForces):
        def apply_forces(self, system: Any, time: float = 0.0) -> None:
            apply(
                numbers, routes, lengths, widths, weights, tip, drive, load, tension, system.sigma, system.kappa,
                system.director_collection, system.external_forces, system.external_torques,
            )  # fmt: skip

    class Damper(elastica.DamperBase):
        def dampen_rates(self, system: Any, time: float) -> None:
            still(system.velocity_collection, system.omega_collection, inputs.factor)

    class Simulator(elastica.BaseSystemCollection, elastica.Forcing, elastica.Damping):
        pass

    simulator = Simulator()
    simulator.append(rod)
    simulator.add_forcing_to(rod).using(Load)
    simulator.dampen(rod).using(Damper)
    simulator.finalize()
    unloaded = Rest(rod.position_collection.copy(), rod.director_collection.copy(), tension.copy())
    step = partial(elastica.PositionVerlet().step, simulator, 0.0, time_step)
    way = REST * (arm.length / elements) ** 2 / arm.length
    solver = Relaxation(arm, rod, step, inputs, stiffness, matched, tip, time_step, way, unloaded, arcs)
    for state in states[:1]:
        solver.solve(state, solver.cold())
        inputs.slowest = inputs.last
    return solver


def _rod(elastica: Any, arm: Arm, elements: int) -> tuple[Any, Array, tuple[Array, Array]]:
    """Return the package's rod, the lengths between its elements' middles, and its arc positions."""
    steps = np.concatenate([np.full(elements, module.length / elements) for module in arm.modules])
    nodes = np.concatenate([[0.0], np.cumsum(steps)])
    socket = SOCKET * steps[0]
    lengths = np.append(socket, steps)
    position = np.zeros((3, nodes.size + 1))
    position[2] = np.append(-socket, nodes)
    rod = elastica.CosseratRod.straight_rod(
        lengths.size, position[:, 0], np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), lengths.sum(),
        # Numbers of no meaning: masses and stiffness follow.
        base_radius=1e-3, density=1e6, youngs_modulus=1e6, shear_modulus=1e6, position=position,
    )  # fmt: skip
    per_element = np.repeat([module.stiffness for module in arm.modules], elements, axis=0)
    per_element = np.vstack([per_element[:1], per_element])
    strain = np.repeat([module.reference_strain for module in arm.modules], elements, axis=0)
    strain = np.vstack([strain[:1], strain])
    # Compliances of half elements add up; the clamped one has none.
    halves = 0.5 * lengths[:, np.newaxis] / per_element[:, :3]
    halves[0] = 0.0
    widths = 0.5 * (lengths[1:] + lengths[:-1])
    for d in range(3):
        rod.shear_matrix[d, d] = per_element[:, 3 + d]
        rod.bend_matrix[d, d] = widths / (halves[1:, d] + halves[:-1, d])
    rod.rest_sigma[:] = (strain[:, 3:] - [0.0, 0.0, 1.0]).T
    turns = 0.5 * lengths[:, np.newaxis] * strain[:, :3]
    turns[0] = 0.0
    rod.rest_kappa[:] = ((turns[1:] + turns[:-1]) / widths[:, np.newaxis]).T
    # One highest frequency all over: masses per length go with 1/h^2. The first module has 1 kg/m.
    axial = per_element[:, 3:].max(axis=1)
    density = axial / axial[1] * (lengths[1] / lengths) ** 2
    density[0] = density[1]
    rod.mass[:] = 0.0
    rod.mass[:-1] += 0.5 * density * lengths
    rod.mass[1:] += 0.5 * density * lengths
    rotary = THINNING * density * (4.0 * per_element[:, :3].max(axis=1) + axial * lengths**2) / (4.0 * axial)
    unit = np.eye(3)[:, :, np.newaxis]
    rod.mass_second_moment_of_inertia[:] = unit * rotary * lengths
    rod.inv_mass_second_moment_of_inertia[:] = unit / (rotary * lengths)
    return rod, widths, (nodes, 0.5 * (nodes[1:] + nodes[:-1]))


def _time_step(rod: Any) -> float:
    """Return COURANT times the limit 2/omega of the stiffest element's stretching."""
    axial = np.array([rod.shear_matrix[d, d] for d in range(3)]).max(axis=0)
    inside = slice(1, None)
    return float(COURANT * (rod.rest_lengths[inside] * np.sqrt(rod.mass[1:-1] / (rod.rest_lengths * axial)[inside])).min())


def _routes(arm: Arm, elements: int, rod: Any, widths: Array) -> Routes:
    """Return the muscles' places in the rod."""
    places = np.arange(elements + 1.0) / elements
    places[0], places[-1] = 0.25 / elements, 1.0 - 0.25 / elements
    first, place, turn, shares = [], [], [], []
    for k, module in enumerate(arm.modules):
        start = 1 + k * elements
        compliance = 0.5 * module.length / elements / module.stiffness[:3]
        share = np.ones((2, 3))
        for end, v in enumerate((start - 1, start + elements - 1)):
            if v < widths.size:
                share[end] = compliance * rod.bend_matrix[range(3), range(3), v] / widths[v]
        place += list(np.moveaxis(routes_of(module, places), 1, 0))
        for muscle in module.muscles:
            first.append(start)
            half = pi * muscle.turns / elements
            turn.append([cos(half), sin(half), cos(0.5 * half), sin(0.5 * half)])
            shares.append(share)
    n, whole = len(first), np.int64
    numbers = (np.array(x).reshape(n, *shape) for x, *shape in ((place, elements + 1, 4), (turn, 4), (shares, 2, 3)))
    return Routes(np.array(first, dtype=whole), np.full(n, elements, dtype=whole), *numbers)


def installed() -> bool:
    """Return whether the package is there."""
    return find_spec("elastica") is not None


_method = partial(Method, knob="elements", settings=(10, 20, 40, 80), available=installed)
METHOD = _method("relaxed dynamic rod (PyElastica)", build=partial(build, matched=False), own_limit=True)
MATCHED = _method("relaxed dynamic rod (PyElastica, this law)", build=partial(build, matched=True))
