"""The paper's own method: single shooting on the strain at the base and the tensions of the muscles.

Sun & Zhao, section III and Algorithm 1, kept literal: eq. (25) is integrated by an explicit Runge-Kutta 4(5) and
the boundary residual, eq. (29), is driven to zero by a trust-region dogleg. It shares the arm and the muscle laws
with `Arm.equilibrium` but no numerics: it is an independent check, and the baseline to compare speed with.

Errata of the paper that are mended here (W = [m; n], F > 0 pulls):

* eqs. (11), (27), (29): the wrench inside the tip is W_ext - W_a, for a muscle anchored at the tip pulls back on
  it. The second row of the residual is xi(L) - [xi* + K^-1 (W_ext - W_a)].
* eqs. (23), (24), (29): tension lengthens a muscle; see `laws.elongation`.
* eq. (7): the last term is xi*', which is zero here: the reference strain of a module is uniform.
* eq. (9): gravity is written in the body frame.
* eq. (26) at a joint: the total wrench of rod and muscles is passed on, not the strain; see `cross_joint`.
* Algorithm 1: the unknowns are the strain at the base and the n tensions.

Single shooting has limits of its own: errors grow along the arm like exp(L sqrt(N/EI)), N being the axial force,
so heavy or long arms and cold starts under large tensions may fail. Such a solve returns `converged` False.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import OdeSolution, solve_ivp
from scipy.interpolate import BarycentricInterpolator
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from study.method import Array
from tca_envs.mechanics import check, continuation, loads, section, thermal
from tca_envs.mechanics.arm import ZERO, Arm, Module, Payload, pose
from tca_envs.mechanics.equilibrium import Equilibrium, Rung
from tca_envs.mechanics.laws import TENDON, elongation

Route = tuple[Array, Array, Array]

RTOL = 1e-6  # relative tolerance of the integration, unless another one is asked for
MAX_EVALUATIONS = 200  # residual evaluations (integrations of the whole arm) before the root finder gives up
MAX_RATES = 50.0
"""An integration gives up after MAX_RATES (1 + turns) rtol^-1/5 evaluations of eq. (25), some 25 times the usual."""
ACCURACY = 10.0  # an equilibrium is accepted when its residual is below ACCURACY rtol
REFUSED = 2.0  # residual of a trial point where the integration fails, over that of the first guess: the dogleg steps back

# MINPACK's difference steps, first trust radius and stopping rule are relative to the unknowns, which may be zero.
# Scaled unknowns start at ORIGIN and move by about one: these settings then mean absolute numbers.
ORIGIN = 10.0
TRUST = 1.0
DIFFERENCE = 0.03  # difference step over sqrt(rtol). The error of the integration itself hardly shows: it varies smoothly.

# The state of a module: quaternion h, position p, strain xi, and the path length of each of its muscles so far.
QUATERNION, POSITION, STRAIN, PATHS = slice(0, 4), slice(4, 7), slice(7, 13), slice(13, None)


class IntegrationError(ArithmeticError):
    """The initial value problem has no answer at the end of the arm."""


class Trajectory(NamedTuple):
    """Answer of the initial value problem."""

    tip_pose: Array  # (4, 4) [m]
    tip_strain: Array  # (6,) just inside the tip
    muscle_lengths: Array  # (n,) [m]
    pieces: tuple[Any, ...]  # OdeSolution: the states of each module along its length, where asked for


@dataclass(frozen=True, eq=False)
class Problem:
    """The boundary value problem of an arm at a drive (n,) and a load (as of `Arm.load`), integrated to `rtol`."""

    arm: Arm
    drive: Array
    load: Array
    rtol: float


def equilibrium(
    arm: Arm,
    drive: ArrayLike,
    tip_force: ArrayLike = ZERO,
    tip_moment: ArrayLike = ZERO,
    start: Equilibrium | None = None,
    rtol: float = RTOL,
    payload: Payload | None = None,
) -> Equilibrium:
    """Find an equilibrium of an arm by the paper's shooting method (Sun & Zhao, section III.B).

    Eqs. (6), (25), (28) and the path lengths of eq. (24) are integrated by SciPy's RK45, and the root of eq. (29) is found by
    MINPACK's Powell hybrid method, a trust-region dogleg with a difference quotient for its first Jacobian and rank-one updates
    after.

    Parameters
    ----------
    arm, drive, tip_force, tip_moment, payload
        As of `Arm.equilibrium`, and so are the errors.
    start : Equilibrium, optional
        Of this arm, from here or from `Arm.equilibrium`: its strain at the base and its tensions are the first guess. By
        default the reference strain and no tension (tendons: their drive).
    rtol : float
        Relative tolerance of the integration, in [1e-12, 0.1]; the root finder's follows it.

    Returns
    -------
    Equilibrium
        Of any stability. `residual` is the largest entry of eq. (29) as `residual` returns it, `iterations` counts its
        evaluations. Where the root finder or an integration failed: `converged` False, the reason in `message`, and the start's
        shape, without a start that of the unloaded arm.
    """
    if not isinstance(arm, Arm):
        raise ValueError(f"arm = {arm!r}: expected an Arm")
    rtol = check.scalar("rtol", rtol, 1e-12, 1e-1)
    problem = Problem(arm, arm.checked_drive(drive), arm.load(tip_force, tip_moment, payload), rtol)
    base = arm.modules[0].reference_strain
    if start is None:
        tendon = [muscle.law.kind == TENDON for muscle in arm.muscles]
        guess = np.concatenate([base, np.where(tendon, problem.drive, 0.0)])
    else:
        arm.restart(start)  # refuses a start of another arm
        guess = np.concatenate([start.strain([0.0])[0], start.tensions])
    with np.errstate(all="ignore"):
        unknowns, report = find_root(problem, guess)
        if report["converged"]:
            return _result(problem, problem, unknowns, report)
        if start is not None:
            return replace(start, drive=problem.drive, load=problem.load, nodes=None, rung=Rung.FAILED, jumped=False, **report)
        _, tension, neutral, no_load = arm.unloaded()
        return _result(problem, Problem(arm, neutral, no_load, rtol), np.concatenate([base, tension]), report)


def solve(arm: Arm, lanes: Any, drive: Array, load: Array, threads: int = 1, heat: Any = None) -> Any:
    """Bring lanes to equilibrium by the paper's shooting method: what `gym.make(id, solver="shooting")` steps with.

    Parameters
    ----------
    arm, lanes, drive, load, heat
        As of `continuation.solve`. A lane starts from its strain at the base and its tensions; its new strains stand at the
        nodes of the arm's grid, so that any other solver can go on from them.
    threads : int
        Makes no difference: lanes are solved one after the other.

    Returns
    -------
    (N,) structured array
        As of `continuation.solve`: rungs are WARM or FAILED, iterations are evaluations of eq. (29), nothing has jumped. Lanes
        without an answer stay as they were.
    """
    report = np.zeros(len(drive), dtype=continuation.REPORT)
    first = arm.node_arc[: arm.grids[0].nodes]
    for i in range(len(drive)):
        if heat is not None:
            for k in range(drive.shape[1]):
                drive[i, k], heat.power[i, k] = thermal.heated(heat.constants, k, heat.temperature[i, k], heat.action[i, k])
        base = BarycentricInterpolator(first, lanes.strain[i, : len(first)])(0.0)
        asked = drive[i, : len(arm.muscles)].copy()
        problem = Problem(arm, asked, load[i].copy(), RTOL)
        with np.errstate(all="ignore"):
            unknowns, told = find_root(problem, np.concatenate([base, lanes.tension[i]]))
            rung = Rung.WARM if told["converged"] else Rung.FAILED
            if told["converged"]:
                found = integrate(problem, unknowns, dense=True)
                strain = sample(arm, found.pieces, arm.node_arc)[1]
                answer = strain, unknowns[6:], asked, load[i], found.tip_pose, found.muscle_lengths
                for values, new in zip(lanes, answer, strict=True):
                    values[i] = new
        report[i]["rung"], report[i]["residual"], report[i]["iterations"] = rung, told["residual"], told["iterations"]
    return report


def route(module: Module, s: float) -> Route:
    """Return r_a, r_a' and r_a'' (m, 3) of a module's muscles in the body frame at `s` [m] from its base."""
    r, dr, ddr = np.zeros((3, len(module.muscles), 3))
    for i, muscle in enumerate(module.muscles):
        r[i, :2], dr[i, :2] = muscle.route(module.length, s / module.length).reshape(2, 2)
        ddr[i] = -((2.0 * np.pi * muscle.turns / module.length) ** 2) * r[i]
    return r, dr, ddr


def levers(r: Array) -> Array:
    """Return J = [-r^, 1] (m, 3, 6) of points r (m, 3): J maps a strain to a tangent, J^T a force to a wrench."""
    result = np.zeros((len(r), 3, 6))
    result[:, 0, 2], result[:, 1, 2] = -r[:, 1], r[:, 0]
    result[:, 2, 0], result[:, 2, 1] = r[:, 1], -r[:, 0]
    result[:, :, 3:] = np.eye(3)
    return result


def point_wrench(module: Module, s: float, strain: Array, tension: Array) -> Array:
    """Return W_a (6,), eqs. (19), (21): what a module's muscles carry through the section at `s`, body frame."""
    r, dr, _ = route(module, s)
    lever = levers(r)
    path = lever @ strain + dr
    pull = (tension / np.linalg.norm(path, axis=1))[:, np.newaxis] * path
    return (pull[:, np.newaxis] @ lever).sum(axis=(0, 1))


def wrench(module: Module, s: float, strain: Array, tension: Array) -> Array:
    """Return the total internal wrench (6,) [m; n] of rod and muscles at `s`, body frame."""
    return module.stiffness * (strain - module.reference_strain) + point_wrench(module, s, strain, tension)


def distributed_wrench(path: Route, strain: Array, tension: Array) -> tuple[Array, Array, Array]:
    """Return A_bar (6, 6) and B_bar (6,) of eqs. (18), (20), and |p_a'| (m,).

    The muscles press on the rod with A_bar xi' + B_bar per metre, body frame. With J of `levers`, eq. (18) reads
    A_bar = F J^T P J and B_bar = F J^T P (u x (R^T p_a' + r') + r'').
    """
    r, dr, ddr = path
    lever = levers(r)
    tangent = lever @ strain + dr  # r^T p_a', eq. (13)
    norm = np.sqrt((tangent * tangent).sum(axis=1))
    t = tangent / norm[:, np.newaxis]
    across = np.eye(3) - t[:, :, np.newaxis] * t[:, np.newaxis]
    pressure = lever.transpose(0, 2, 1) @ ((tension / norm)[:, np.newaxis, np.newaxis] * across)  # f J^T P, eq. (17)
    known = (tangent + dr) @ section.cross_matrix(strain[:3]).T + ddr
    return (pressure @ lever).sum(axis=0), (pressure @ known[:, :, np.newaxis]).sum(axis=(0, 2)), norm


def strain_rate(module: Module, path: Route, strain: Array, tension: Array, weight: Array) -> tuple[Array, Array]:
    """Return xi' (6,), eq. (25), and |p_a'| (m,) under a weight per metre (3,) in the body frame [N/m]."""
    a_bar, b_bar, norm = distributed_wrench(path, strain, tension)
    carried = module.stiffness * (strain - module.reference_strain)
    u, v = section.cross_matrix(strain[:3]), section.cross_matrix(strain[3:])
    load = -b_bar  # and now ad_xi^T K (xi - xi*) - W_grav; xi*' = 0
    load[:3] -= u @ carried[:3] + v @ carried[3:]
    load[3:] -= u @ carried[3:] + weight
    return np.asarray(np.linalg.solve(np.diag(module.stiffness) + a_bar, load), dtype=float), norm


def quaternion_rate(h: Array, u: Array) -> Array:
    """Return h' = Omega h/2, eq. (28). The norm of h may drift: `pose` divides by it."""
    x, y, z = u
    omega = np.array([[0.0, -x, -y, -z], [x, 0.0, z, -y], [y, -z, 0.0, x], [z, y, -x, 0.0]])
    return 0.5 * omega @ h


def integrate_module(
    module: Module, state: Array, tension: Array, gravity: Array, rtol: float, dense: bool = False
) -> tuple[Array, OdeSolution | None]:
    """Integrate eqs. (6), (25), (28) and the path lengths from a module's base to its end.

    `state` (13,) is quaternion, position [m] and strain at its base, `gravity` (3,) in the base frame [m/s2]; tolerances are
    rtol times one, the length and `strain_unit`. Returns the state (13 + m,) at the end and, if `dense`, that as a function of
    s; IntegrationError if the integration does not get there.
    """
    turns = max((abs(muscle.turns) for muscle in module.muscles), default=0.0)
    # Straight muscles keep their place in the cross section.
    straight = route(module, 0.0) if turns == 0.0 else None
    budget = MAX_RATES * (1.0 + turns) * rtol**-0.2

    def rate(s: float, y: Array) -> Array:
        nonlocal budget
        budget -= 1.0
        rotation = pose(y[QUATERNION], y[POSITION])[:3, :3]
        strain = y[STRAIN]
        weight = module.mass_per_length * gravity @ rotation  # r^T g, erratum of eq. (9)
        change, stretch = strain_rate(module, straight or route(module, s), strain, tension, weight)
        result = np.concatenate([quaternion_rate(y[QUATERNION], strain[:3]), rotation @ strain[3:], change, stretch])
        # SciPy's step control would go on for ever: a strain that curls up takes ever smaller steps, and it does not
        # notice numbers that are not finite.
        if budget < 0.0 or not np.isfinite(result).all():
            raise IntegrationError(f"the strain diverges {s:.3g} m from the base of a module of {module.length:g} m")
        return result

    lengths = np.full(len(tension), module.length)
    scale = np.concatenate([np.ones(4), np.full(3, module.length), strain_unit(module), lengths])
    first = np.concatenate([state, np.zeros(len(tension))])
    span = (0.0, module.length)
    if not np.isfinite(first).all():
        raise IntegrationError("the strain or the tensions to start from are not finite")
    try:
        answer = solve_ivp(rate, span, first, method="RK45", rtol=rtol, atol=rtol * scale, dense_output=dense)
    except np.linalg.LinAlgError:
        raise IntegrationError("K + A_bar of eq. (25) is singular") from None
    if not answer.success:
        raise IntegrationError(answer.message)
    return answer.y[:, -1], answer.sol


def cross_joint(module: Module, beyond: Module, strain: Array, tension: Array, tension_beyond: Array) -> Array:
    """Return the strain (6,) where the module `beyond` starts, from that where `module` ends: erratum of eq. (26).

    The muscles of both end at the joint, so the total internal wrench K (xi - xi*) + W_a is continuous and the strain is not.
    """
    passed = wrench(module, module.length, strain, tension)
    places = np.array([muscle.route(beyond.length, 0.0) for muscle in beyond.muscles]).reshape(-1, 4)
    rod = (beyond.stiffness, beyond.reference_strain, places, tension_beyond)
    try:
        result = section.solve(*rod, passed, beyond.reference_strain)
    except np.linalg.LinAlgError:
        result = np.full(6, np.nan)
    mismatch = np.abs(section.balance(*rod, result, passed)[0]) / beyond.stiffness
    if not (mismatch <= 1e-9 * strain_unit(beyond)).all():
        raise IntegrationError("no strain beyond a joint carries the wrench")
    return result


def integrate(problem: Problem, unknowns: Array, dense: bool = False) -> Trajectory:
    """Integrate the arm, module after module as in Algorithm 1, from the unknowns [xi(0); F] (6 + n,)."""
    modules, gravity = problem.arm.modules, problem.load[loads.GRAVITY]
    tensions = _by_module(problem.arm, unknowns[6:])
    state = np.concatenate([[1.0], np.zeros(6), unknowns[:6]])
    lengths, pieces = [], []
    for k, module in enumerate(modules):
        if k > 0:
            state[STRAIN] = cross_joint(modules[k - 1], module, state[STRAIN], tensions[k - 1], tensions[k])
        end, piece = integrate_module(module, state, tensions[k], gravity, problem.rtol, dense)
        lengths.append(end[PATHS])
        pieces.append(piece)
        state = end[:13].copy()
    tip_pose = pose(state[QUATERNION], state[POSITION])
    return Trajectory(tip_pose, state[STRAIN], np.concatenate(lengths), tuple(pieces))


def external_wrench(load: Array, rotation: Array) -> Array:
    """Return W_ext (6,) at the tip in its body frame: tip force and moment, and the payload's weight at its centre."""
    weight = load[loads.MASS] * load[loads.GRAVITY]
    force = load[loads.FORCE] + weight
    moment = load[loads.MOMENT] + np.cross(rotation @ load[loads.CENTRE], weight)
    return np.concatenate([moment @ rotation, force @ rotation])


def residual(problem: Problem, unknowns: Array, trajectory: Trajectory) -> Array:
    """Return eq. (29) with its errata, dimensionless (6 + n,).

    First the imbalance of the strain at the tip over `strain_unit` of the last module; then for each muscle the length mismatch
    over the rest length, for tendons the tension mismatch over `tension_units`.
    """
    tip, tension = problem.arm.modules[-1], unknowns[6:]
    # Erratum of eqs. (11), (27), (29): minus.
    muscles = point_wrench(tip, tip.length, trajectory.tip_strain, _by_module(problem.arm, tension)[-1])
    inside = external_wrench(problem.load, trajectory.tip_pose[:3, :3]) - muscles
    boundary = trajectory.tip_strain - (tip.reference_strain + inside / tip.stiffness)
    rows, _ = compatibility(problem, tension, trajectory.muscle_lengths)
    return np.concatenate([boundary / strain_unit(tip), rows])


def compatibility(problem: Problem, tension: Array, lengths: Array) -> tuple[Array, Array]:
    """Return the rows of eq. (29) for the muscles (n,), dimensionless, and their derivatives in the drives (n,)."""
    arm = problem.arm
    units, rests = tension_units(arm), arm.rest_lengths
    rows, by_drive = np.empty((2, len(tension)))
    for i, muscle in enumerate(arm.muscles):
        law, force, drive, rest = muscle.law, tension[i], problem.drive[i], rests[i]
        if law.kind == TENDON:
            rows[i], by_drive[i] = (force - drive) / units[i], -1.0 / units[i]
        else:
            delta, _, slope = elongation(law.kind, law.parameters()[np.newaxis], 0, rest, force, drive)
            rows[i], by_drive[i] = (lengths[i] - rest - delta) / rest, -slope / rest
    return rows, by_drive


def strain_unit(module: Module) -> Array:
    """Return the strain (6,) that the moments EI/L and the forces EI/L^2 bring about, which bend a module by a radian.

    A force counts by its bending: it hardly shears or stretches a rod that is almost inextensible.
    """
    moment = module.stiffness[:2].min() / module.length
    return np.repeat([moment, moment / module.length], 3) / module.stiffness


def tension_units(arm: Arm) -> Array:
    """Return the tensions (n,) [N] at which straight muscles would collapse their modules, 1/(1/EA + r^2/EI)."""
    pairs = [(module, muscle) for module in arm.modules for muscle in module.muscles]
    return np.array([1.0 / (1.0 / m.stiffness[5] + muscle.offset**2 / m.stiffness[:2].min()) for m, muscle in pairs])


def units(arm: Arm) -> Array:
    """Return what the unknowns [xi(0); F] are scaled with (6 + n,)."""
    return np.concatenate([strain_unit(arm.modules[0]), tension_units(arm)])


def find_root(problem: Problem, guess: Array) -> tuple[Array, dict[str, Any]]:
    """Return the unknowns [xi(0); F] (6 + n,) where eq. (29) vanishes, searched for from `guess`, and how it went."""
    unit = units(problem.arm)
    evaluations, failure, first = 0, "", np.empty(0)

    def function(scaled: Array) -> Array:
        nonlocal evaluations, failure, first
        evaluations += 1
        try:
            rows = _end(problem, guess + unit * (scaled - ORIGIN))[1]
        except IntegrationError as error:
            if first.size == 0:
                raise
            failure = f"; an integration failed: {error}"
            # Not more than it takes to be refused: the dogleg learns its Jacobian from refused points too.
            return REFUSED * first
        if first.size == 0:
            first = rows
        return rows

    options = {
        "xtol": problem.rtol / ORIGIN, "eps": (DIFFERENCE / ORIGIN) ** 2 * problem.rtol, "factor": TRUST / ORIGIN,
        "maxfev": MAX_EVALUATIONS,
    }  # fmt: skip
    try:
        found = root(function, np.full(len(guess), ORIGIN), method="hybr", options=options)
    except IntegrationError as error:
        message = f"no equilibrium found: an integration failed at the first guess: {error}"
        return guess, dict(converged=False, residual=np.inf, iterations=evaluations, message=message)
    size, limit = float(np.abs(found.fun).max()), ACCURACY * problem.rtol
    converged = bool(found.success) and size <= limit
    if converged:
        message = f"converged below {limit:g}"
    else:
        why = f"it stopped at {size:.1e}" if found.success else " ".join(found.message.split())
        message = f"no equilibrium found with a residual below {limit:g}: {why}{failure}"
    unknowns = guess + unit * (found.x - ORIGIN)
    return unknowns, dict(converged=converged, residual=size, iterations=evaluations, message=message)


def tip_jacobian(problem: Problem, unknowns: Array) -> Array:
    """Return d(tip position, tip rotation vector)/d drive (6, n) by the implicit function theorem.

    With x the unknowns, d tip/d drive = -(d tip/dx) (d residual/dx)^-1 (d residual/d drive); derivatives in x are
    central differences of the integration.
    """
    arm = problem.arm
    steps = DIFFERENCE * problem.rtol**0.5 * units(arm)
    tip, rows = np.empty((6, len(steps))), np.empty((len(steps), len(steps)))
    with np.errstate(all="ignore"):
        for j, step in enumerate(np.diag(steps)):
            (up, rows_up), (down, rows_down) = _end(problem, unknowns + step), _end(problem, unknowns - step)
            tip[:3, j] = up[:3, 3] - down[:3, 3]
            tip[3:, j] = Rotation.from_matrix(up[:3, :3] @ down[:3, :3].T).as_rotvec()
            rows[:, j] = rows_up - rows_down
        by_drive = np.zeros((len(steps), len(steps) - 6))
        by_drive[6:] = np.diag(compatibility(problem, unknowns[6:], arm.rest_lengths)[1])  # at any lengths
        return -tip @ np.linalg.solve(rows, by_drive)


def sample(arm: Arm, pieces: Sequence[OdeSolution], s: Array) -> tuple[Array, Array]:
    """Return poses (k, 4, 4) and strains (k, 6) at arc positions (k,) [m]; at a joint, those beyond it."""
    lengths = arm.model.length
    bases = np.cumsum(lengths) - lengths
    states = np.empty((s.size, 13))
    module = np.searchsorted(bases, s + 1e-15, side="right") - 1
    for k, piece in enumerate(pieces):
        here = module == k
        if here.any():
            states[here] = piece(np.clip(s[here] - bases[k], 0.0, lengths[k]))[:13].T
    return pose(states[:, QUATERNION], states[:, POSITION]), states[:, STRAIN]


def _end(problem: Problem, unknowns: Array) -> tuple[Array, Array]:
    """Return the tip's pose (4, 4) and the residual (6 + n,)."""
    trajectory = integrate(problem, unknowns)
    rows = residual(problem, unknowns, trajectory)
    if not np.isfinite(rows).all():
        raise IntegrationError("the residual at the tip is not finite")
    return trajectory.tip_pose, rows


def stability(problem: Problem, pieces: Sequence[OdeSolution], tension: Array) -> float:
    """Return `Equilibrium.stability` of a solved problem, by the tangent on the arm's own grid."""
    strain = sample(problem.arm, pieces, problem.arm.node_arc)[1]
    return continuation.smallest_eigenvalue(
        problem.arm.problem, continuation.Lane(strain, tension, problem.drive, problem.load)
    )


def _by_module(arm: Arm, tension: Array) -> list[Array]:
    """Return the tensions (n,) split into those of each module."""
    return np.split(tension, np.cumsum([len(module.muscles) for module in arm.modules])[:-1])


def _result(problem: Problem, solved: Problem, unknowns: Array, report: dict[str, Any]) -> Equilibrium:
    """Return the answer to `problem`: the shape that solves `solved`, which is another one where none was found."""
    shape = integrate(solved, unknowns, dense=True)
    return Equilibrium(
        tip_pose=shape.tip_pose, tensions=unknowns[6:], muscle_lengths=shape.muscle_lengths, drive=problem.drive,
        length=problem.arm.length, load=problem.load, known=(solved.drive, solved.load), jumped=False,
        rung=Rung.WARM if report["converged"] else Rung.FAILED, sample=partial(sample, problem.arm, shape.pieces),
        differentiate=partial(tip_jacobian, solved, unknowns), certify=partial(stability, solved, shape.pieces, unknowns[6:]),
        **report,
    )  # fmt: skip
