"""The cells of the stability study, and on which branch of equilibria the right answer to each of them lies.

The right answer is what a slow change reaches. Drive and load go on a straight line from those of the start, the unloaded arm
for a cold start, to the asked ones, in steps so small that the tip hardly moves in any of them. Where the branch of equilibria
ends on the way, the arm jumps. A walk in half the steps on a finer grid has to end at the same place, and an independent solver
has to find the same equilibrium: otherwise the cell is in doubt and says nothing about anyone.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from math import ceil, cos, pi, radians, sin
from typing import NamedTuple

import numpy as np

from study.method import Array, State
from study.pattern import evenly as every
from study.reference import NoReference, reference
from study.scenes import LONG_DENSITY, Case
from tca_envs.mechanics import Arm, Equilibrium, Grid, Module, Muscle, Payload, Tendon, loads
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT
from tca_envs.robots import paper

ROD_LENGTH, ROD_RADIUS, ROD_OFFSET = 45e-3, 4.5e-3, 4e-3  # the rod of the closed forms in docs/solver.md and its tendon [m]
OFF_AXIS = 1.0
"""Gravity is so far off the planes of symmetry [deg]: no arm is mounted exactly, and a symmetric one may fall to any side."""
TURNED = 20.0  # azimuth of gravity where it is not along the arm [deg]: in no plane of symmetry of the three TCAs

TENSION, FORCE = 1.8, 0.6  # largest tension of the tendon and tip force [N]
FIXED_TENSION, FIXED_FORCE = 0.3, 0.05  # where the other one is on an axis of the map [N]
LENGTHS = (45.0, 60.0, 80.0, 105.0, 135.0, 170.0, 210.0, 250.0)  # [mm]
TILTS = (OFF_AXIS, 30.0, 60.0, 90.0, 120.0, 150.0, 165.0, 180.0 - OFF_AXIS)
"""Of gravity from the arm's axis [deg]: it hangs at 0, and would stand at 180."""
TEMPERATURES = (25.0, 45.0, 65.0, 85.0, 105.0, 125.0, 145.0, 160.0)  # [degC]
STEPS = (1.0, 2.0, 5.0, 10.0, 20.0, 45.0, 90.0, 135.0)
"""Of the temperatures [K]; the last one is from ambient to the hard limit."""

STRIDE = 0.02  # the tip moves at most so far in a step of the slow change, over the arm's length
MOST_JUMPS = 5  # a slow change that falls more often does not know where it is
SMALLEST = 1e-5  # smallest step of drive and load, over the whole change: what moves the tip farther is a jump
MAX_STEPS = 4000
ELEMENT = 15e-3  # length of the elements of the slow change [m]; those of the check are two thirds of that
NODES = 8
COLLAPSED = 0.02  # a muscle has shrunk to a point where a metre of the centerline takes less of it than this [m]
COLLAPSE = "a muscle's path shrinks to a point: the section collapses, as real coils would not let it"
AGREE = 5e-3  # ends of slow changes that are closer than this, over the arm's length, are the same equilibrium
CONFIRMED = 1e-5  # error of the independent solver that confirms them, over the arm's length


Made = Callable[[float, float], tuple[float, float, float]]


class Cell(NamedTuple):
    """A place on a map."""

    x: float
    y: float
    case: Case


class Family(NamedTuple):
    """A map."""

    name: str
    title: str
    x_label: str
    y_label: str
    cells: tuple[Cell, ...]

    @property
    def xs(self) -> list[float]:
        """Values along x, in order."""
        return sorted({cell.x for cell in self.cells})

    @property
    def ys(self) -> list[float]:
        """Values along y, in order."""
        return sorted({cell.y for cell in self.cells})


class Walk(NamedTuple):
    """Where a slow change ended."""

    found: Equilibrium | None  # none where the arm has no equilibrium in reach
    jumps: int  # so often it fell from the end of a branch
    lost: str  # why there is none


class Truth(NamedTuple):
    """What the right answer of a cell is."""

    before: Equilibrium | None  # equilibrium at the state before, for a warm start
    found: Equilibrium | None  # none where the slow change finds no equilibrium in reach
    jumps: int  # jumps on the way from the start
    lost: str  # why there is none
    doubt: str  # why all this is not to be trusted; empty where it is


# Cells


def rod(length: float) -> Arm:
    """Return a rod [m] with one straight tendon, gravity across it, on the side of the tendon."""
    muscle = Muscle(ROD_OFFSET, 0.0, 0.0, Tendon())
    mass = LONG_DENSITY * pi * ROD_RADIUS**2 * length
    module = Module.cylinder(length, 2.0 * ROD_RADIUS, paper.YOUNGS_MODULUS, paper.SHEAR_MODULUS, mass, [muscle])
    off = radians(OFF_AXIS)
    return Arm([module], paper.GRAVITY[2] * np.array([cos(off), sin(off), 0.0]), grids=grids([module]))


def tilted(tilt: float) -> Arm:
    """Return the paper's bending module with the rest of the arm on its end, gravity `tilt` [deg] from its axis."""
    angle, turned = radians(tilt), radians(TURNED)
    gravity = np.array([sin(angle) * cos(turned), sin(angle) * sin(turned), cos(angle)])
    module = paper.bending_module()
    return Arm([module], paper.GRAVITY[2] * gravity, paper.BELOW_BENDING, grids([module]))


def grids(modules: Sequence[Module], finer: float = 1.0) -> list[Grid]:
    """Return grids with elements of `ELEMENT`/finer."""
    return [Grid(ceil(finer * module.length / ELEMENT), NODES) for module in modules]


def rods(name: str, title: str, axes: tuple[str, str], xs: Sequence[float], ys: Sequence[float], made: Made) -> Family:
    """Return cold starts of rods: `made` gives the length [mm], tension and tip force [N] of a place on the map."""
    cells = []
    for x in xs:
        arm = rod(1e-3 * made(x, ys[0])[0])
        for y in ys:
            _, tension, force = made(x, y)
            # The tip force is across both tendon and gravity.
            cells.append(Cell(x, y, Case(None, State(arm, np.array([tension]), (0.0, force, 0.0)))))
    return Family(name, title, *axes, tuple(cells))


def loaded_rods(name: str, count: int) -> Family:
    """Return a map of cold starts of rods over two of length, tension and tip force."""
    tensions, forces = (np.linspace(0.0, most, count).tolist() for most in (TENSION, FORCE))
    length, tension, force = ("length [mm]", every(LENGTHS, count)), ("tension [N]", tensions), ("tip force [N]", forces)
    title, x, y, made = {
        "tension-force": ("cold start,\nrod of 45 mm", tension, force, lambda x, y: (1e3 * ROD_LENGTH, x, y)),
        "length-tension": (
            f"cold start, rods,\ntip force {FIXED_FORCE:g} N",
            length,
            tension,
            lambda x, y: (x, y, FIXED_FORCE),
        ),
        "length-force": (f"cold start, rods,\ntension {FIXED_TENSION:g} N", length, force, lambda x, y: (x, FIXED_TENSION, y)),
    }[name]
    return rods(name, title, (x[0], y[0]), x[1], y[1], made)


def tilts(name: str, title: str, y_label: str, ys: Sequence[float], count: int, case: Callable[[Arm, float], Case]) -> Family:
    """Return cases of the paper's bending module over the tilt of gravity."""
    cells = [Cell(tilt, y, case(arm, y)) for tilt in every(TILTS, count) for arm in [tilted(tilt)] for y in every(ys, count)]
    return Family(name, title, "gravity, from down to up [deg]", y_label, tuple(cells))


def cold_tilt(count: int) -> Family:
    """Return cold starts of the paper's bending module with two TCAs hot."""

    def case(arm: Arm, hot: float) -> Case:
        return Case(None, State(arm, np.array([AMBIENT, hot, hot])))

    return tilts("cold-tilt", "cold start,\n4.5 mm arm,\ntwo TCAs hot", "TCAs [°C]", TEMPERATURES, count, case)


def step_tilt(count: int) -> Family:
    """Return steps of one TCA up from ambient."""
    befores: dict[Arm, State] = {}

    def case(arm: Arm, step: float) -> Case:
        before = befores.setdefault(arm, State(arm, np.full(3, AMBIENT)))
        return Case(before, State(arm, np.array([AMBIENT + step, AMBIENT, AMBIENT])))

    return tilts("step-tilt", "step from 25 °C,\n4.5 mm arm,\none TCA", "step [K]", STEPS, count, case)


def random_tilt(count: int) -> Family:
    """Return steps of all three TCAs, each up or down, from random temperatures."""
    rng = np.random.default_rng(0)

    def case(arm: Arm, step: float) -> Case:
        lowest = rng.uniform(AMBIENT, HARD_LIMIT - step, 3)
        up = rng.random(3) < 0.5
        before, after = np.where(up, lowest, lowest + step), np.where(up, lowest + step, lowest)
        return Case(State(arm, before), State(arm, after))

    return tilts("random-tilt", "step from a random\nstate, 4.5 mm arm,\nthree TCAs", "step [K]", STEPS, count, case)


FAMILIES: dict[str, Callable[[int], Family]] = {
    **{name: partial(loaded_rods, name) for name in ("tension-force", "length-tension", "length-force")},
    "cold-tilt": cold_tilt, "step-tilt": step_tilt, "random-tilt": random_tilt,
}  # fmt: skip
"""Name -> builder of a map of so many cells a side."""


# The right branch


def follow(state: State, start: Equilibrium | None, stride: float = STRIDE, finer: float = 1.0) -> Walk:
    """Go slowly from an equilibrium, or from the unloaded arm, to a state.

    The tip moves at most `stride` in a step, over the arm's length; the grid is so much finer than the usual one.
    """
    arm = state.arm
    if start is None:
        _, _, from_drive, from_load = arm.unloaded()
        tip = np.array([0.0, 0.0, arm.length])
    else:
        from_drive, from_load = start.known
        tip = start.tip_pose[:3, 3]
    grid, jumps, done, step = grids(arm.modules, finer), 0, 0.0, 1e-3
    for _ in range(MAX_STEPS):
        here = min(1.0, done + step)
        drive, load = from_drive + here * (state.drive - from_drive), from_load + here * (state.load - from_load)
        found = at(arm, load, grid).equilibrium(drive, load[loads.FORCE], load[loads.MOMENT], start=start)
        moved = float(np.linalg.norm(found.tip_pose[:3, 3] - tip)) / (stride * arm.length)
        smooth = found.converged and not found.jumped and moved <= 1.0
        if not smooth and step > SMALLEST:
            step = max((0.1 if found.jumped or not found.converged else 0.25) * step, SMALLEST)
            continue
        if not found.converged:
            collapses = start is not None and narrowest(start) < COLLAPSED
            return Walk(None, jumps, COLLAPSE if collapses else found.message)
        jumps += not smooth
        if jumps > MOST_JUMPS:
            return Walk(None, jumps, f"it falls more than {MOST_JUMPS} times on its way")
        start, tip, done = found, found.tip_pose[:3, 3], here
        if here == 1.0:
            return Walk(found, jumps, "")
        step *= min(2.0, 0.8 / max(moved, 1e-3))
    return Walk(None, jumps, f"not there after {MAX_STEPS} steps")


def narrowest(known: Equilibrium) -> float:
    """Return the smallest |p'| of a muscle at the nodes of an equilibrium, 1 for a straight one in an unloaded rod."""
    assert known.nodes is not None
    model, strain = known.nodes
    u, v = strain[:, np.newaxis, :3], strain[:, np.newaxis, 3:]
    x, y, dx, dy = np.moveaxis(model.route, -1, 0)
    path = [v[..., 0] - u[..., 2] * y + dx, v[..., 1] + u[..., 2] * x + dy, v[..., 2] + u[..., 0] * y - u[..., 1] * x]
    return float(np.linalg.norm(path, axis=0).min())


def at(arm: Arm, load: Array, grid: Sequence[Grid]) -> Arm:
    """Return the arm with the gravity and the payload of a load."""
    mass, x, y, z = load[loads.PAYLOAD].tolist()
    return Arm(arm.modules, load[loads.GRAVITY], Payload(mass, (x, y, z)), grid)


class Referee:
    """Tells the right answers; states before, which many cells share, are gone to once."""

    def __init__(self) -> None:
        self.follow = cache(follow)

    def __call__(self, case: Case) -> Truth:
        """Return the right answer of a cell."""
        ends, start = [], None
        for stride, finer in ((STRIDE, 1.0), (0.5 * STRIDE, 1.5)):
            if case.before is not None:
                before = self.follow(case.before, None, stride, finer)
                start = before.found
                if start is None:
                    return Truth(None, None, before.jumps, f"where the step starts: {before.lost}", _uncollapsed(before))
            ends.append(follow(case.state, start, stride, finer))
        return Truth(start, *ends[1], doubt(case.state, *ends))


def doubt(state: State, one: Walk, other: Walk) -> str:
    """Return why two slow changes to a state, the second on a finer grid, are not to be trusted; empty if they are."""
    if one.found is None or other.found is None:
        if one.found is not other.found:
            return "only one of two slow changes finds an equilibrium"
        return _uncollapsed(other)
    apart = float(np.linalg.norm(one.found.tip_pose[:3, 3] - other.found.tip_pose[:3, 3])) / state.arm.length
    if apart > AGREE:
        return f"slow changes end {apart:.1%} of the length apart"
    try:
        moved = reference(state, other.found, CONFIRMED).moved / state.arm.length
    except NoReference as reason:
        return f"not confirmed: {reason}"
    return "" if moved < AGREE else f"confirmed {moved:.1%} of the length away"


def _uncollapsed(walk: Walk) -> str:
    return "" if walk.lost == COLLAPSE else f"no equilibrium, though nothing collapses: {walk.lost}"
