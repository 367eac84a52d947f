"""Geometric variable strain on the speed-accuracy chart: SoRoMoX, strains as Legendre series, in JAX.

Package: `soromox` (https://github.com/tud-phi/soromox), the strain parametrisation of Renda et al., IEEE Robotics and
Automation Letters 5(3), 2020. Poses, elastic and gravitational energy, threadlike actuators and their path lengths are the
package's own. It offers no static solver, no muscle law and no rigid body at the tip. So this file adds

* a damped Newton method on coefficients and tensions at once, whose residual and tangent are the first and second derivative
  of those energies by JAX, compiled into one call, and substeps of drive and load where that fails;
* the muscles' law in JAX (that of `laws.elongation`) on the package's path lengths: one equation for each tension;
* tip force and payload as a potential of the tip's pose.

Its segments take any diagonal stiffness, any mass and any route, so it solves this package's own model. A polynomial in the
body frame does not follow a helix over several turns: a module with helical muscles is one segment for each turn.

The package's backbone runs along x: its axes (x, y, z) are this package's (z, x, y), in vectors and strains alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from importlib.util import find_spec
from math import ceil, pi, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from study.method import Answer, Array, Method, State
from study.notation import most_turns
from tca_envs.mechanics import Arm, Equilibrium, Module, loads
from tca_envs.mechanics.laws import COIL, SPRING, TENDON

RESIDUAL = 1e-9  # Newton stops when its dimensionless residual, of the kind of `Equilibrium.residual`, is below this
MAX_EVALUATIONS = 40
MAX_HALVINGS = 6
MAX_BEND = 1.0  # a Newton step turns no coefficient's strain by more than this over the segment's length [rad]
MAX_SUBSTEPS = 60
SMALLEST_SUBSTEP = 1.0 / 256.0
LIGHT = 1e-9  # mass per length of a weightless module [kg/m]: the package wants a positive one
AXES = np.array([2, 0, 1])  # the package's x, y, z in this package's axes
STRAINS = np.concatenate([AXES, AXES + 3])


class Point(NamedTuple):
    """An equilibrium: what a solve starts from."""

    coefficients: Array  # of the strain, as the package orders them: segment, strain, order
    tension: Array  # (n,) [N]
    drive: Array
    load: Array


class Carry(NamedTuple):
    """What the compiled Newton loop keeps: the point, the step from it, the fraction of it to try next."""

    x: Any
    step: Any
    factor: Any
    norm: Any
    halvings: Any
    evaluations: Any
    found: Any


class Piece(NamedTuple):
    """A segment: a part of a module, in arc positions of the arm [m]."""

    module: int
    start: float
    length: float


@dataclass(frozen=True, eq=False)
class Strains:
    """A GVS model of an arm with strains of one order, and its compiled Newton method."""

    arm: Arm
    order: int
    pieces: tuple[Piece, ...]
    newton: Callable[..., Any]  # (coefficients, tension, drive, load) -> coefficients, tension, tip pose, whether it converged

    def cold(self) -> Point:
        """Return the unloaded arm."""
        drive = self.arm.unloaded()[2]
        size = len(self.pieces) * 6 * (self.order + 1)
        return Point(np.zeros(size), np.zeros(len(self.arm.muscles)), drive, np.zeros(loads.SIZE))

    @cached_property
    def projection(self) -> tuple[Array, Array]:
        """Gauss nodes on [0, 1] (g,), and the matrix (order + 1, g) from values there to Legendre coefficients."""
        x, w = np.polynomial.legendre.leggauss(self.order + 6)
        basis = np.polynomial.legendre.legvander(x, self.order).T
        return (x + 1.0) / 2.0, (2.0 * np.arange(self.order + 1) + 1.0)[:, np.newaxis] * basis * w / 2.0

    def near(self, known: Equilibrium, state: State) -> Point:
        """Return the least-squares fit to a known equilibrium's strains."""
        points, matrix = self.projection
        coefficients = []
        for piece in self.pieces:
            strain = known.strain(piece.start + piece.length * points) - self.arm.modules[piece.module].reference_strain
            coefficients.append((matrix @ strain[:, STRAINS]).T.ravel())
        return Point(np.concatenate(coefficients), known.tensions, state.drive, state.load)

    def solve(self, state: State, guess: Point) -> Answer:
        """Solve for the equilibrium at `state`, in substeps from the guess's drive and load where one step fails."""
        known, to, step = guess, 0.0, 1.0
        for _ in range(MAX_SUBSTEPS):
            aim = min(1.0, to + step)
            # Ends at the asked numbers themselves, not at sums that round.
            drive = state.drive if aim == 1.0 else guess.drive + aim * (state.drive - guess.drive)
            load = state.load if aim == 1.0 else guess.load + aim * (state.load - guess.load)
            coefficients, tension, pose, found = self.newton(known.coefficients, known.tension, drive, load)
            if found:
                known, to, step = Point(coefficients, tension, drive, load), aim, 2.0 * step
                if to == 1.0:
                    return Answer(True, np.asarray(pose), known)
            else:
                step *= 0.25
                if step < SMALLEST_SUBSTEP:
                    break
        return Answer(False, np.eye(4), None)


def build(arm: Arm, order: int, states: Sequence[State]) -> Strains:
    """Return the model with strains of polynomial order `order`, compiled."""
    modules = tuple(
        (m.length, tuple(m.stiffness), m.mass_per_length, m.muscles, tuple(m.reference_strain)) for m in arm.modules
    )
    solver = Strains(arm, order, _pieces(arm), _compiled(modules, tuple(arm.gravity), order))
    for state in states[:1]:
        solver.solve(state, solver.cold())
    return solver


@cache
def _compiled(modules: tuple[Any, ...], gravity: tuple[float, ...], order: int) -> Callable[..., Any]:
    """Return the Newton method of an arm with these numbers.

    They are constants in what is compiled: as arguments they would let arms share it, but cost a third of the speed.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    arm = Arm(
        [Module(length, np.array(k), mass, muscles, np.array(strain)) for length, k, mass, muscles, strain in modules], gravity
    )
    pieces = _pieces(arm)
    bends = np.repeat([1.0, 0.0], 3 * (order + 1))
    lengths = np.array([piece.length for piece in pieces])[:, np.newaxis]
    # A coefficient of curvature counts by the angle that it turns its segment, one of stretch as it is.
    angle = np.where(bends, lengths, 1.0).ravel()
    unit = np.concatenate([angle / np.concatenate(_stiffness(arm, order, pieces)), 1.0 / arm.rest_lengths])
    numbers = Numbers(unit, (bends * lengths).ravel(), arm.rest_lengths, arm.model.kind, arm.model.parameters)
    return jax.jit(partial(_newton(), _robot(arm, order, pieces), numbers))


def _pieces(arm: Arm) -> tuple[Piece, ...]:
    pieces = []
    start = 0.0
    for k, module in enumerate(arm.modules):
        parts = max(1, ceil(most_turns(module.muscles)))
        pieces += [Piece(k, start + module.length * i / parts, module.length / parts) for i in range(parts)]
        start += module.length
    return tuple(pieces)


def _stiffness(arm: Arm, order: int, pieces: Sequence[Piece]) -> list[Array]:
    """Return the diagonals of the segments' generalised stiffness: Legendre polynomials are orthogonal."""
    norms = 1.0 / (2.0 * np.arange(order + 1) + 1.0)
    return [piece.length * np.outer(arm.modules[piece.module].stiffness[STRAINS], norms).ravel() for piece in pieces]


class Numbers(NamedTuple):
    """An arm's numbers that the Newton method reads beside the package's model."""

    unit: Array  # what makes residuals dimensionless: of forces (coefficients,), then of lengths (n,)
    turn: Array  # angle by which a coefficient turns its segment (coefficients,) [rad m]; 0 for stretch
    rest: Array
    kind: NDArray[np.int64]
    parameters: Array


@cache
def _newton() -> Callable[..., Any]:
    """Return (model, numbers, coefficients, tension, drive, load) -> coefficients, tension, tip pose, whether it converged."""
    import jax
    import jax.numpy as jnp
    from jax import lax

    def energy(q: Any, tension: Any, load: Any, robot: Any, rest: Any) -> tuple[Any, Any]:
        """Return the potential energy, muscles counted as tension times elongation of the path, and those elongations."""
        tip = robot.forward_kinematics_tips(q)[-1]
        weight = load[loads.MASS] * load[loads.GRAVITY][AXES]
        hanging = (load[loads.FORCE][AXES] + weight) @ tip[:3, 3] + weight @ (tip[:3, :3] @ load[loads.CENTRE][AXES])
        path = robot.actuators[0].path_lengths(robot, q) - rest if rest.size else rest
        # The protected energy: the public one brings its own derivative, which carries Jacobians and takes twice the time.
        return 0.5 * q @ robot.elastic_force(q) + robot._gravitational_energy(q) - hanging + tension @ path, path

    def residual(x: Any, drive: Any, load: Any, robot: Any, numbers: Numbers) -> Any:
        size = numbers.turn.size
        tension = x[size:]
        forces, path = jax.grad(energy, has_aux=True)(x[:size], tension, load, robot, numbers.rest)
        # A tendon's own law is its whole equation.
        gap = jnp.where(numbers.kind == TENDON, 0.0, path)
        gap = gap - elongation(numbers.kind, numbers.parameters, numbers.rest, tension, drive)
        return numbers.unit * jnp.concatenate([forces, gap])

    def newton(robot: Any, numbers: Numbers, q: Any, tension: Any, drive: Any, load: Any) -> Any:
        def tangent_step(x: Any, r: Any) -> tuple[Any, Any]:
            step = jnp.linalg.solve(jax.jacfwd(residual)(x, drive, load, robot, numbers), r)
            return step, jnp.minimum(1.0, MAX_BEND / jnp.max(numbers.turn * jnp.abs(step[: q.size])))

        # One residual and one tangent in the compiled loop, not one for each place where Newton looks: that compiles faster.
        def iterate(carry: Carry) -> Carry:
            trial = carry.x - carry.factor * carry.step
            r = residual(trial, drive, load, robot, numbers)
            norm = jnp.linalg.norm(r)
            better = norm < (1.0 - 0.1 * carry.factor) * carry.norm
            found = better & (jnp.max(jnp.abs(r)) <= RESIDUAL)
            step, factor = lax.cond(better & ~found, lambda: tangent_step(trial, r), lambda: (carry.step, 0.5 * carry.factor))
            x, norm = jnp.where(better, trial, carry.x), jnp.where(better, norm, carry.norm)
            return Carry(x, step, factor, norm, jnp.where(better, 0, carry.halvings + 1), carry.evaluations + 1, found)

        def goes_on(carry: Carry) -> Any:
            return ~carry.found & (carry.halvings <= MAX_HALVINGS) & (carry.evaluations < MAX_EVALUATIONS)

        start = jnp.concatenate([q, tension])
        end = lax.while_loop(goes_on, iterate, Carry(start, jnp.zeros_like(start), 0.0, jnp.inf, 0, 0, False))
        pose = robot.forward_kinematics_tips(end.x[: q.size])[-1]
        back = np.argsort(np.append(AXES, 3))
        return end.x[: q.size], end.x[q.size :], pose[back][:, back], end.found

    return newton


@cache
def _paths() -> Callable[..., Any]:
    """Return (offset, angle, rate, base, first segment, last segment), all (n,) -> the package's routes of muscles."""
    import equinox as eqx
    import jax.numpy as jnp
    from soromox.actuation import ThreadlikeRouting
    from soromox.actuation.threadlike import BaseThreadlikeRoutingParams

    class Helices(BaseThreadlikeRoutingParams):
        """Routes of all muscles: offset [m], angle [rad] at the module's base and rate [rad/m], base of the module [m]."""

        offset: jnp.ndarray
        angle: jnp.ndarray
        rate: jnp.ndarray
        base: jnp.ndarray
        start_segment_index: tuple[int, ...] = eqx.field(static=True)
        end_segment_index: tuple[int, ...] = eqx.field(static=True)
        num_paths = property(lambda self: len(self.start_segment_index))

        def validate_structure(self) -> None:
            pass

        def validate_values(self) -> None:
            pass

    def offset(path: Any, s: Any) -> Any:
        a = path.angle + path.rate * (s - path.base)
        return path.offset * jnp.array([0.0, jnp.cos(a), jnp.sin(a)])

    def derivative(path: Any, s: Any) -> Any:
        a = path.angle + path.rate * (s - path.base)
        return path.offset * path.rate * jnp.array([0.0, -jnp.sin(a), jnp.cos(a)])

    def paths(*numbers: Any) -> Any:
        arrays = [jnp.asarray(column, dtype=jnp.float64) for column in numbers[:4]]
        return ThreadlikeRouting(Helices(*arrays, *numbers[4:]), offset, derivative)

    return paths


def _robot(arm: Arm, order: int, pieces: Sequence[Piece]) -> Any:
    """Return the package's model of an arm."""
    import jax.numpy as jnp
    from soromox.actuation import ThreadlikeActuator
    from soromox.systems.components import JointSpec, LinkSpec
    from soromox.systems.gvs import GVS, GVSSegment, StrainBasisSpec

    basis = StrainBasisSpec("legendre", [1] * 6, order)
    segments = []
    for piece, stiffness in zip(pieces, _stiffness(arm, order, pieces), strict=True):
        module = arm.modules[piece.module]
        # The section only carries the mass here: stiffness is given.
        radius = 2.0 * sqrt(module.stiffness[:2].mean() / module.stiffness[5])
        density = max(module.mass_per_length, LIGHT) / (pi * radius**2)
        link = LinkSpec.circular(
            length=piece.length, radius=radius, density=density, stiffness=np.diag(stiffness),
            reference_strain=module.reference_strain[STRAINS].tolist(),
        )  # fmt: skip
        segments.append(GVSSegment(link, JointSpec.fixed(), basis, num_gauss_points=max(5, 2 * order + 2)))
    routes, spans = [], []
    base = 0.0
    for k, module in enumerate(arm.modules):
        mine = [i for i, piece in enumerate(pieces) if piece.module == k]
        for muscle in module.muscles:
            routes.append((muscle.offset, muscle.angle, 2.0 * pi * muscle.turns / module.length, base))
            spans.append((mine[0], mine[-1]))
        base += module.length
    actuators: Any = ()
    if routes:
        paths = _paths()(*zip(*routes, strict=True), *zip(*spans, strict=True))
        actuators = (ThreadlikeActuator.muscles(paths),)
    base_pose = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    gravity = jnp.asarray(arm.gravity[AXES])
    return GVS.from_segments(segments, gravity=gravity, base_pose=base_pose, actuators=actuators, backend="jax")


def elongation(kind: NDArray[np.int64], parameters: Array, rest: Array, tension: Any, drive: Any) -> Any:
    """Return the elongations (n,) [m] of `laws.elongation`, in JAX; of a tendon (tension - drive), a law that asks for it.

    * `kind`, `parameters`, `rest`: (n,), (n, PARAMETERS), (n,) arrays; as in `solver.Model`.
    * `tension`, `drive`: (n,) JAX arrays; [N]; temperature [degC], rest length [m] or tension [N].
    """
    import jax.numpy as jnp

    length, gain, compliance, g0, g1, g2, a, b, highest, offset, reference = parameters.T
    x, x0 = drive - offset, reference - offset
    heated = gain * ((a * x + b) * x - (a * x0 + b) * x0)
    inside = jnp.clip(tension, 0.0, highest)
    # Rows of other laws hold other numbers: nothing there may divide by zero, or derivatives become NaN.
    coil = kind == COIL
    modulus = jnp.where(coil, g0 + (g1 + g2 * inside) * inside, 1.0)
    slope = compliance * (g0 - g2 * inside**2) / modulus**2
    coiled = rest / jnp.where(coil, length, 1.0) * (heated + compliance * inside / modulus + slope * (tension - inside))
    sprung = drive + tension / jnp.where(kind == SPRING, length, 1.0) - rest
    return jnp.where(coil, coiled, jnp.where(kind == SPRING, sprung, tension - drive))


METHOD = Method(
    "geometric variable strain (SoRoMoX)", "order", (1, 3, 5), build, builds_slowly=True,
    available=lambda: find_spec("soromox") is not None,
)  # fmt: skip
