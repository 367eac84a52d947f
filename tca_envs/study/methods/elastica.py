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
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tca_envs.mechanics import Arm, Equilibrium
from tca_envs.mechanics.algebra import axpy, cross, dot, entry, inner
from tca_envs.mechanics.muscle import TENDON, elongation
from tca_envs.study.method import Answer, Array, Method, State

SOCKET = 0.01
"""Length of the clamped element over that of the first one."""
COURANT = 0.7
"""Time step over that at which the stiffest element of the unloaded rod would become unstable."""
THINNING = 2.0
"""Reserve of the rotational inertia for sections that a contraction thickens (the package's law)."""
BLOCK = 20
"""Steps between two looks at damping and rest."""
MAX_STEPS = 40_000
REST = 2e-3
"""At rest when the way to go is less than REST h^2/L, with elements of length h: well below the error of discretisation."""


class Routes(NamedTuple):
    """Muscles, in elements of the rod; element 0 is the clamped one. n muscles, at most q elements to a muscle."""

    first: NDArray[np.int64]  # (n,) first element
    span: NDArray[np.int64]  # (n,) number of elements
    place: Array  # (n, q + 1, 4) x, y [m] and their derivatives between elements; at the ends: within half an element
    turn: Array  # (n, 4) cosine and sine of the muscle's turn over half an element, over a quarter
    share: Array  # (n, 2, 3) share of a muscle's couples in those across its first and last boundary, about x, y, z
    kind: NDArray[np.int64]  # (n,) as in `collocation.Model`
    parameters: Array
    rest_length: Array


class Rest(NamedTuple):
    """A rod at rest: what a solve starts from."""

    position: Array
    director: Array
    tension: Array


@inner
def to_body(directors, e, x):
    """Return the vector x of the base frame in the frame of element e."""
    return (
        directors[0, 0, e] * x[0] + directors[0, 1, e] * x[1] + directors[0, 2, e] * x[2],
        directors[1, 0, e] * x[0] + directors[1, 1, e] * x[1] + directors[1, 2, e] * x[2],
        directors[2, 0, e] * x[0] + directors[2, 1, e] * x[1] + directors[2, 2, e] * x[2],
    )


@inner
def tangent(routes, i, k, lengths, sigma, kappa, end):
    """Return p_i' = v + u x r + r' at place k of muscle i, and the length of rod that it stands for; `end` is u at the tip.

    Along a helical muscle v turns as the muscle does: a mean of elements is one in the frame that turns along.
    Extrapolating u, instead of taking the nearest, would feed energy into the rod: it flutters.
    """
    a, count = routes.first[i], routes.span[i]
    b = a + count
    if k == 0:
        v, width = turned(sigma, a, routes.turn[i, 2], -routes.turn[i, 3]), 0.5 * lengths[a]
        u = kappa[0, a], kappa[1, a], kappa[2, a]
        if a == 1:
            # All of the bend across the clamped element's end is in the half element beyond.
            grow = (lengths[0] + lengths[1]) / lengths[1]
            u = grow * kappa[0, 0], grow * kappa[1, 0], grow * kappa[2, 0]
    elif k == count:
        v, width = turned(sigma, b - 1, routes.turn[i, 2], routes.turn[i, 3]), 0.5 * lengths[b - 1]
        u = kappa[0, b - 2], kappa[1, b - 2], kappa[2, b - 2]
        if b == lengths.size:
            u = end
    else:
        e = a + k - 1
        below = turned(sigma, e, routes.turn[i, 0], routes.turn[i, 1])
        beyond = turned(sigma, e + 1, routes.turn[i, 0], -routes.turn[i, 1])
        v, width = (0.5 * (below[0] + beyond[0]), 0.5 * (below[1] + beyond[1]), 0.5 * (below[2] + beyond[2])), lengths[e]
        u = kappa[0, e], kappa[1, e], kappa[2, e]
    x, y = routes.place[i, k, 0], routes.place[i, k, 1]
    return (
        v[0] - u[2] * y + routes.place[i, k, 2],
        v[1] + u[2] * x + routes.place[i, k, 3],
        v[2] + 1.0 + u[0] * y - u[1] * x,
    ), width


@inner
def turned(x, e, c, s):
    """Return column e of x (3, ...), turned about z by the angle of cosine c and sine s."""
    return c * x[0, e] - s * x[1, e], s * x[0, e] + c * x[1, e], x[2, e]


@inner
def pull_on(e, force, c, s, lengths, sigma, directors, forces, torques):
    """Add the muscle's force on the cross sections of element e, turned about z by the angle of cosine c and sine s."""
    t = c * force[0] - s * force[1], s * force[0] + c * force[1], force[2]
    torque = cross((sigma[0, e], sigma[1, e], sigma[2, e] + 1.0), t)
    for d in range(3):
        torques[d, e] += lengths[e] * torque[d]
        part = directors[0, d, e] * t[0] + directors[1, d, e] * t[1] + directors[2, d, e] * t[2]
        forces[d, e] += part
        forces[d, e + 1] -= part


@inner
def bent(u, s, x):
    """Return the vector x of the frame at s beyond, in the frame here: u is constant, and the turn up to second order."""
    once = cross(u, x)
    twice = cross(u, once)
    return axpy(s, once, axpy(0.5 * s * s, twice, x))


@inner
def pull_at(routes, i, length, tension, drive):
    """Return the tension that stretches muscle i to a path length, by Newton from a tension near it."""
    if routes.kind[i] == TENDON:
        return drive
    for _ in range(8):
        stretch, slope, _ = elongation(routes.kind[i], routes.parameters, i, routes.rest_length[i], tension, drive)
        step = (length - routes.rest_length[i] - stretch) / slope
        tension += step
        if abs(step) < 1e-9:
            break
    return tension


@inner
def share_of(share, i, end, couple):
    """Return a couple times its shares."""
    return couple[0] * share[i, end, 0], couple[1] * share[i, end, 1], couple[2] * share[i, end, 2]


@entry
def apply(
    routes, lengths, widths, weights, tip, drive, load, tension, sigma, kappa, directors, forces, torques
):  # fmt: skip
    """Add weight, tip load, payload and muscles to the external forces and torques of the rod; update the tensions.

    Parameters
    ----------
    routes : Routes
        The muscles.
    lengths, widths, weights : (e,), (e - 1,), (e + 1,) arrays
        Rest lengths of elements and of the spans between their middles [m], masses that weigh on the nodes [kg].
    tip : (10,) array
        B, u* and the power of e in the law at the tip, and u there, which this computes.
    drive, load, tension : (n,), (LOAD,), (n,) arrays
        As of `State`; tensions [N] are those of the last step.
    sigma, kappa, directors : (3, e), (3, e - 1), (3, 3, e) arrays
        The package's: v - e_z, u and R^T.
    forces, torques : (3, e + 1), (3, e) arrays
        The package's: in the base frame [N], in the body frame [N m].
    """
    elements = lengths.size
    last = elements - 1
    for node in range(2, elements + 1):
        for d in range(3):
            forces[d, node] += weights[node] * load[6 + d]
    weight = load[9] * load[6], load[9] * load[7], load[9] * load[8]
    for d in range(3):
        forces[d, elements] += load[d] + weight[d]
    # The tip's frame lies half an element beyond the last director, bent as its own moment bends it.
    arm = load[10], load[11], load[12]
    hangs = to_body(directors, last, weight)
    twists = to_body(directors, last, (load[3], load[4], load[5]))
    end = kappa[0, last - 1], kappa[1, last - 1], kappa[2, last - 1]
    moment = axpy(1.0, twists, cross(bent(end, 0.5 * lengths[last], arm), hangs))
    for i in range(routes.first.size):
        count = routes.span[i]
        if routes.first[i] + count == elements:
            t, _ = tangent(routes, i, count, lengths, sigma, kappa, end)
            x, y = routes.place[i, count, 0], routes.place[i, count, 1]
            scale = -tension[i] / sqrt(dot(t, t))
            moment = axpy(scale, (y * t[2], -x * t[2], x * t[1] - y * t[0]), moment)
    v = sigma[0, last], sigma[1, last], sigma[2, last] + 1.0
    softer = dot(v, v) ** (0.5 * tip[6])
    end = (
        tip[3] + softer * moment[0] / tip[0],
        tip[4] + softer * moment[1] / tip[1],
        tip[5] + softer * moment[2] / tip[2],
    )
    for d in range(3):
        tip[7 + d] = end[d]
    moment = axpy(1.0, twists, cross(bent(end, 0.5 * lengths[last], arm), hangs))
    for d in range(3):
        torques[d, last] += moment[d]

    for i in range(routes.first.size):
        a, count = routes.first[i], routes.span[i]
        b = a + count
        length = 0.0
        for k in range(count + 1):
            t, width = tangent(routes, i, k, lengths, sigma, kappa, end)
            length += width * sqrt(dot(t, t))
        pull = pull_at(routes, i, length, tension[i], drive[i])
        tension[i] = pull
        for k in range(count + 1):
            t, _ = tangent(routes, i, k, lengths, sigma, kappa, end)
            scale = pull / sqrt(dot(t, t))
            t = scale * t[0], scale * t[1], scale * t[2]
            # A force belongs to the elements that its place has v from: to each by half, for every element has two places.
            half = 0.5 * t[0], 0.5 * t[1], 0.5 * t[2]
            if k == 0:
                pull_on(a, half, routes.turn[i, 2], routes.turn[i, 3], lengths, sigma, directors, forces, torques)
            elif k == count:
                pull_on(b - 1, half, routes.turn[i, 2], -routes.turn[i, 3], lengths, sigma, directors, forces, torques)
            else:
                e = a + k - 1
                pull_on(e, half, routes.turn[i, 0], -routes.turn[i, 1], lengths, sigma, directors, forces, torques)
                pull_on(e + 1, half, routes.turn[i, 0], routes.turn[i, 1], lengths, sigma, directors, forces, torques)
            # A couple belongs to a boundary of elements; a muscle's end has its share. Nothing is beyond the tip.
            boundary = a - 1 + k
            if boundary == last:
                continue
            x, y = routes.place[i, k, 0], routes.place[i, k, 1]
            couple = y * t[2], -x * t[2], x * t[1] - y * t[0]
            if k == 0:
                couple = share_of(routes.share, i, 0, couple)
            elif k == count:
                couple = share_of(routes.share, i, 1, couple)
            turn = cross((kappa[0, boundary], kappa[1, boundary], kappa[2, boundary]), couple)
            for d in range(3):
                torques[d, boundary] += couple[d] + 0.5 * widths[boundary] * turn[d]
                torques[d, boundary + 1] += -couple[d] + 0.5 * widths[boundary] * turn[d]


@entry
def match(stretch, width_stretch, shear, bend, shear_stretched, bend_stretched):
    """Set S e and B e^3, the stiffness with which the package's law becomes n = S (v - v*), m = B (u - u*).

    Arguments are e (e,) of elements and (e - 1,) between them, S (3, 3, e) and B (3, 3, e - 1), and where the results go.
    """
    for d in range(3):
        for k in range(stretch.size):
            shear_stretched[d, d, k] = shear[d, d, k] * stretch[k]
        for k in range(width_stretch.size):
            bend_stretched[d, d, k] = bend[d, d, k] * width_stretch[k] ** 3


@entry
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
    slowest: float = inf
    """Frequency of the slowest motion in the solve that `build` tries [rad/s]."""
    last: float = inf
    """The same of the last solve."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """A rod of the package in a simulator, made ready for one arm."""

    arm: Arm
    rod: Any
    step: Any
    """() -> None: one time step."""
    inputs: Inputs
    stiffness: tuple[Array, Array]
    """S and B of the unloaded rod."""
    matched: bool
    tip: Array
    """As of `apply`."""
    time_step: float
    way: float
    """At rest when no node has farther to go [m]."""
    unloaded: Rest
    arcs: tuple[Array, Array]
    """Of the nodes and of the elements' middles, the clamped element's left out [m]."""

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
                match(rod.dilatation, rod.voronoi_dilatation, *self.stiffness, rod.shear_matrix, rod.bend_matrix)
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
    routes = _routes(arm, elements, rod, widths)
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
                routes, lengths, widths, weights, tip, drive, load, tension, system.sigma, system.kappa,
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
    rod.mass_second_moment_of_inertia[:] = 0.0
    rod.inv_mass_second_moment_of_inertia[:] = 0.0
    for d in range(3):
        rod.mass_second_moment_of_inertia[d, d] = rotary * lengths
        rod.inv_mass_second_moment_of_inertia[d, d] = 1.0 / (rotary * lengths)
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
        spans = [
            (v, widths[v] / rod.bend_matrix[range(3), range(3), v])
            for v in (start - 1, start + elements - 1)
            if v < widths.size
        ]
        share = np.ones((2, 3))
        for end, (_, whole) in enumerate(spans):
            share[end] = compliance / whole
        for muscle in module.muscles:
            first.append(start)
            place.append([module.route(muscle, x) for x in places])
            half = pi * muscle.turns / elements
            turn.append([cos(half), sin(half), cos(0.5 * half), sin(0.5 * half)])
            shares.append(share)
    n = len(first)
    return Routes(
        first=np.array(first, dtype=np.int64),
        span=np.full(n, elements, dtype=np.int64),
        place=np.array(place).reshape(n, elements + 1, 4),
        turn=np.array(turn).reshape(n, 4),
        share=np.array(shares).reshape(n, 2, 3),
        kind=arm.model.kind,
        parameters=arm.model.parameters,
        rest_length=arm.rest_lengths,
    )


def installed() -> bool:
    """Return whether the package is there."""
    return find_spec("elastica") is not None


METHOD = Method(
    "relaxed dynamic rod (PyElastica)",
    "elements",
    (10, 20, 40, 80),
    partial(build, matched=False),
    available=installed,
    own_limit=True,
)

MATCHED = Method(
    "relaxed dynamic rod (PyElastica, this law)",
    "elements",
    (10, 20, 40, 80),
    partial(build, matched=True),
    available=installed,
)
