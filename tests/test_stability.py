"""Whether what the solver calls an equilibrium is one, a stable one, and the one that the loading path leads to.

The judge is an energy of the whole arm written here, on a fine uniform grid of its own: it shares the modules' numbers with
the solver and nothing else. Arms are drawn at random: up to four modules of unlike stiffness, up to six muscles in each.
"""

import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh
from scipy.optimize import brentq

from study import shooting
from tca_envs.mechanics import TCA, Arm, Equilibrium, Grid, Module, Muscle, Payload, Rung, Spring, Tendon
from tca_envs.mechanics.solver import batch
from tca_envs.mechanics.thermal import AMBIENT
from tca_envs.robots import CUT_OFF
from tca_envs.robots.paper import BELOW_BENDING, GRAVITY, bending_arm, bending_module

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

# The same examples in every run: a verdict on the code, not on the draw. Shrinking would take minutes.
same = settings(
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
on_random_arms = pytest.mark.parametrize("count", [12, pytest.param(300, marks=pytest.mark.slow)])

RADIUS, E = 0.0045, 0.125e6


# Random arms, as plain numbers: what a failing example prints can be pasted.


class Fibre(NamedTuple):
    """A muscle and how strongly it is driven, from 0 (relaxed) to 1."""

    law: Tendon | Spring | TCA
    offset: float
    angle: float
    turns: float
    effort: float


class Piece(NamedTuple):
    """A module: round, stiffer about x than about y by `flat`."""

    length: float
    modulus: float
    mass: float
    flat: float
    curvature: Vector
    fibres: tuple[Fibre, ...]

    def module(self) -> Module:
        muscles = [Muscle(f.offset, f.angle, f.turns, f.law) for f in self.fibres]
        module = Module.cylinder(
            self.length, 2.0 * RADIUS, self.modulus, self.modulus / 3.0, self.mass, muscles, self.curvature
        )
        return replace(module, stiffness=module.stiffness * [self.flat, 1.0, 1.0, 1.0, 1.0, 1.0])

    def drive(self) -> list[float]:
        module, values = self.module(), []
        for fibre, muscle in zip(self.fibres, module.muscles, strict=True):
            if isinstance(fibre.law, TCA):
                values.append(25.0 + 135.0 * fibre.effort)
            elif isinstance(fibre.law, Spring):
                values.append(module.rest_length(muscle) * (1.1 - 0.5 * fibre.effort))
            else:
                # A part of the tension at which a straight one collapses the module: six of them may come close to it.
                values.append(0.15 * fibre.effort / (1.0 / module.stiffness[5] + fibre.offset**2 / module.stiffness[1]))
        return values


class Scene(NamedTuple):
    """An arm and its load: tip force and moment relative to what bends the whole arm by about a radian."""

    pieces: tuple[Piece, ...]
    gravity: Vector
    push: Vector
    turn: Vector
    weight: float  # of the payload [kg]
    centre: Vector

    def arm(self, finer: int = 1) -> Arm:
        coarse = Arm([piece.module() for piece in self.pieces], self.gravity, Payload(self.weight, self.centre))
        if finer == 1:
            return coarse
        grids = [Grid(finer * elements, nodes) for elements, nodes in coarse.grids]
        return Arm(coarse.modules, coarse.gravity, coarse.payload, grids, 1e-11)

    def drive(self) -> list[float]:
        return [value for piece in self.pieces for value in piece.drive()]

    def before(self) -> "Scene":
        """Return where the arm comes from: pushed the other way, what was driven relaxed and what was relaxed driven."""
        pieces = [p._replace(fibres=tuple(f._replace(effort=1.0 - f.effort) for f in p.fibres)) for p in self.pieces]
        return self._replace(pieces=tuple(pieces), push=tuple(-x for x in self.push))

    def turned(self, frame: Array, fibre: Callable[[Fibre], Fibre]) -> "Scene":
        """Return this scene in the frame (3, 3), a rotation about z or a reflection, muscle by muscle as `fibre` says."""
        axial = np.linalg.det(frame) * frame  # moments and curvatures are axial vectors
        pieces = [
            piece._replace(fibres=tuple(map(fibre, piece.fibres)), curvature=tuple(axial @ piece.curvature))
            for piece in self.pieces
        ]
        polar = {name: tuple(frame @ getattr(self, name)) for name in ("gravity", "push", "centre")}
        return self._replace(pieces=tuple(pieces), turn=tuple(axial @ self.turn), **polar)

    def tip(self) -> tuple[Array, Array]:
        """Tip force [N] and moment [N m]."""
        modules = [piece.module() for piece in self.pieces]
        length = sum(module.length for module in modules)
        moment = 1.0 / sum(module.length / module.stiffness[1] for module in modules)
        return moment / length * np.array(self.push), moment * np.array(self.turn)

    def solve(self, finer: int = 1, **kw: Any) -> Equilibrium:
        return self.arm(finer).equilibrium(self.drive(), *self.tip(), **kw)

    def energy(self, grid: "Fine", strain: Sequence[Array]) -> Array:
        return grid.energy(strain, self.drive(), self.tip()[0], Payload(self.weight, self.centre))


def vector(size: float) -> st.SearchStrategy[Vector]:
    return st.tuples(*[st.floats(-size, size)] * 3)


def several(items: st.SearchStrategy[Any], least: int, most: int) -> st.SearchStrategy[tuple[Any, ...]]:
    """As many of each number as of another: lists would mostly be short."""
    return st.integers(least, most).flatmap(lambda count: st.tuples(*[items] * count))


none = st.just((0.0, 0.0, 0.0))
laws = st.one_of(st.just(Tendon()), st.just(TCA()), st.floats(0.0, 2.5).map(lambda power: Spring(10.0**power)))
tendons = st.just(Tendon())
moments = vector(1.0)


def fibres(law: st.SearchStrategy[Any]) -> st.SearchStrategy[Fibre]:
    turns = st.one_of(st.just(0.0), st.floats(-2.0, 2.0))
    return st.builds(Fibre, law, st.floats(0.0, 0.005), st.floats(-np.pi, np.pi), turns, st.floats(0.0, 1.0))


def pieces(
    law: st.SearchStrategy[Any], flat: st.SearchStrategy[float], curved: st.SearchStrategy[Vector]
) -> st.SearchStrategy[Piece]:
    return st.builds(
        Piece,
        st.floats(0.01, 0.05),
        st.floats(-1.0, 2.0).map(lambda power: E * 10.0**power),
        st.floats(0.0, 4e-3),
        flat,
        curved,
        several(fibres(law), 0, 6),
    )


def scenes(
    law: st.SearchStrategy[Any] = laws,
    flat: st.SearchStrategy[float] = st.floats(0.5, 2.0),  # noqa: B008
    moment: st.SearchStrategy[Vector] = none,
) -> st.SearchStrategy[Scene]:
    curved = st.one_of(none, vector(20.0))
    return st.builds(
        Scene,
        several(pieces(law, flat, curved), 1, 4),
        vector(9.81),
        vector(6.0),  # a column buckles at 2.5
        moment,
        st.floats(0.0, 2e-3),
        vector(0.01),
    )


# The energy of an arm.


def cross(a: Array, b: Array) -> Array:
    return np.cross(a, b, axis=-1)


def exponential(twist: Array) -> tuple[Array, Array]:
    """Rotation (..., 3, 3) and position (..., 3) at the end of a unit of arc with a constant body twist (..., 6)."""
    u, v = twist[..., :3], twist[..., 3:]
    angle = np.linalg.norm(u, axis=-1)[..., np.newaxis]
    small = angle < 1e-2
    x = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6.0 + angle**4 / 120.0, np.sin(x) / x)
    b = np.where(small, 0.5 - angle**2 / 24.0 + angle**4 / 720.0, (1.0 - np.cos(x)) / x**2)
    c = np.where(small, 1.0 / 6.0 - angle**2 / 120.0 + angle**4 / 5040.0, (x - np.sin(x)) / x**3)

    def turned(y: Array) -> Array:
        return y + a * cross(u, y) + b * cross(u, cross(u, y))

    position = v + b * cross(u, v) + c * cross(u, cross(u, v))
    return np.stack([turned(np.broadcast_to(axis, u.shape)) for axis in np.eye(3)], axis=-1), position


class Fine(NamedTuple):
    """A uniform grid over an arm: cells of each module with two Gauss points, an even number of them."""

    arm: Arm
    cells: tuple[int, ...]

    @classmethod
    def over(cls, arm: Arm, finer: int = 1) -> "Fine":
        waves = [max([abs(muscle.turns) for muscle in module.muscles] + [1.0]) for module in arm.modules]
        return cls(arm, tuple(2 * finer * int(np.ceil(12.0 * wave)) for wave in waves))

    def points(self) -> list[Array]:
        """Arc positions (2 N,) of the Gauss points in each module, from its own base [m]."""
        gauss = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
        return [
            (module.length / n * (np.arange(n)[:, np.newaxis] + gauss)).ravel()
            for module, n in zip(self.arm.modules, self.cells, strict=True)
        ]

    def sampled(self, result: Equilibrium) -> list[Array]:
        """Strain (2 N, 6) of an equilibrium at the points of each module."""
        bases = np.cumsum([0.0] + [module.length for module in self.arm.modules[:-1]])
        return [result.strain(base + s) for base, s in zip(bases, self.points(), strict=True)]

    def shape(self, strain: Sequence[Array]) -> list[tuple[Array, Array]]:
        """Rotations (B, N + 1, 3, 3) and positions (B, N + 1, 3) at the cells' ends of each module, from strains (B, 2 N, 6).

        Each cell is one exponential, of fourth order by its two Gauss points.
        """
        batch = strain[0].shape[0]
        rotation, position = np.broadcast_to(np.eye(3), (batch, 3, 3)), np.zeros((batch, 3))
        shapes = []
        for module, n, xi in zip(self.arm.modules, self.cells, strain, strict=True):
            h = module.length / n
            one, two = xi[:, 0::2], xi[:, 1::2]
            bracket = np.concatenate(
                [
                    cross(one[..., :3], two[..., :3]),
                    cross(one[..., :3], two[..., 3:]) - cross(two[..., :3], one[..., 3:]),
                ],
                axis=-1,
            )
            turn, move = exponential(h / 2.0 * (one + two) + np.sqrt(3.0) / 12.0 * h**2 * bracket)
            rotations, positions = [rotation], [position]
            for j in range(n):
                position = position + (rotation @ move[:, j, :, np.newaxis])[..., 0]
                rotation = rotation @ turn[:, j]
                rotations.append(rotation)
                positions.append(position)
            shapes.append((np.stack(rotations, axis=1), np.stack(positions, axis=1)))
        return shapes

    def paths(self, strain: Sequence[Array]) -> Array:
        """Muscle lengths (B, n) [m]."""
        lengths = []
        for module, s, xi in zip(self.arm.modules, self.points(), strain, strict=True):
            for muscle in module.muscles:
                r, dr = place(module, muscle, s)
                stretch = np.linalg.norm(xi[..., 3:] + cross(xi[..., :3], r) + dr, axis=-1)
                lengths.append(module.length * stretch.mean(axis=-1))
        return np.stack(lengths, axis=-1) if lengths else np.zeros((strain[0].shape[0], 0))

    def energy(self, strain: Sequence[Array], drive: ArrayLike, force: ArrayLike, payload: Payload) -> Array:
        """Energy (B,) [J] of the arm with strains (B, 2 N, 6) at the points of its modules: rod, muscles, load, weight."""
        shapes = self.shape(strain)
        rotation, position = shapes[-1][0][:, -1], shapes[-1][1][:, -1]
        gravity = self.arm.gravity
        total = -position @ np.asarray(force) - payload.mass * ((position + rotation @ np.asarray(payload.centre)) @ gravity)
        for module, xi, (_, positions) in zip(self.arm.modules, strain, shapes, strict=True):
            excess = xi - module.reference_strain
            total = total + 0.5 * module.length * (excess**2 @ module.stiffness).mean(axis=-1)
            total = total - module.mass_per_length * module.length * simpson(positions @ gravity)
        lengths = self.paths(strain).T
        for muscle, rest, value, length in zip(
            self.arm.muscles, self.arm.rest_lengths, np.asarray(drive), lengths, strict=True
        ):
            total = total + stored(muscle.law, rest, value, length)
        return np.asarray(total, dtype=float)


def simpson(values: Array) -> Array:
    """Mean over an even number of cells from values (..., N + 1) at their ends."""
    n = values.shape[-1] - 1
    return (values[..., 0] + values[..., -1] + 4.0 * values[..., 1::2].sum(-1) + 2.0 * values[..., 2:-1:2].sum(-1)) / (3.0 * n)


def place(module: Module, muscle: Muscle, s: Array) -> tuple[Array, Array]:
    """Where a muscle runs in the section, (N, 3), and its derivative."""
    rate = 2.0 * np.pi * muscle.turns / module.length
    angle = muscle.angle + rate * s
    zero = np.zeros_like(s)
    r = muscle.offset * np.stack([np.cos(angle), np.sin(angle), zero], axis=-1)
    return r, rate * np.stack([-r[:, 1], r[:, 0], zero], axis=-1)


def stretched(law: Spring | TCA, rest: float, drive: float, tension: Array) -> Array:
    """Path lengths [m] of an elastic muscle at some tensions: the laws once more, from their physics alone."""
    if isinstance(law, Spring):
        return drive + tension / law.rate

    def modulus(f: Array) -> Array:
        return 20.85e6 + 111.33e6 * f - 37.58e6 * f**2

    inside = np.clip(tension, 0.0, 0.8)
    slope = (20.85e6 + 37.58e6 * inside**2) / modulus(inside) ** 2
    heated = 5.116e-5 * (-0.0161 * (drive**2 - 25.0**2) + 0.3338 * (drive - 25.0))
    return rest + rest / 0.045 * (heated + 2.3725e6 * (inside / modulus(inside) + slope * (tension - inside)))


def stored(law: Any, rest: float, drive: float, length: Array) -> Array:
    """Energy [J] of a muscle at some path lengths, but for a constant: F l - integral of l dF from zero tension."""
    if isinstance(law, Tendon):
        return drive * length
    low, high = np.full_like(length, -100.0), np.full_like(length, 100.0)
    for _ in range(62):
        middle = 0.5 * (low + high)
        short = stretched(law, rest, drive, middle) < length
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    tension = 0.5 * (low + high)
    result = tension * length
    kink = np.minimum(tension, 0.8)
    for begin, end in ((np.zeros_like(kink), kink), (kink, tension)):
        for x, w in zip(*np.polynomial.legendre.leggauss(12), strict=True):
            result = result - 0.5 * w * (end - begin) * stretched(law, rest, drive, 0.5 * (begin + end + x * (end - begin)))
    return result


# Equilibria of random arms.

FINER = 2  # than the default grid: what is compared between the nodes shall not show the grid
STEP = 1e-4  # size of a perturbation: about so many radians over a module


def whole_arm_modes(arm: Arm, grid: Fine) -> list[Array]:
    """Bending and twist of the whole arm in its three lowest Legendre polynomials, (9, 2 N, 6): what arms buckle into."""
    fields, begin = [], 0.0
    for module, s in zip(arm.modules, grid.points(), strict=True):
        low = np.polynomial.legendre.legvander(2.0 * (begin + s) / arm.length - 1.0, 2)
        fields.append(np.einsum("np,jk->jpnk", low, np.eye(3, 6)).reshape(9, -1, 6) / arm.length)
        begin += module.length
    return fields


def random_modes(arm: Arm, grid: Fine, count: int) -> list[Array]:
    """Random smooth strains (count, 2 N, 6) of each module, shear and extension at the energy that bending has."""
    rng, fields = np.random.default_rng(0), []
    for module, s in zip(arm.modules, grid.points(), strict=True):
        low = np.polynomial.legendre.legvander(2.0 * s / module.length - 1.0, 4)
        unit = np.sqrt(module.stiffness[:2].min() / module.stiffness) / module.length
        fields.append(np.einsum("np,bpk->bnk", low, rng.normal(size=(count, 5, 6)) / np.sqrt(30.0)) * unit)
    return fields


def rod_metric(arm: Arm, one: Sequence[Array], other: Sequence[Array]) -> Array:
    """Integrals (A, B) of x^T K y over the arm for strain fields (A, 2 N, 6) and (B, 2 N, 6)."""
    return np.asarray(
        sum(
            module.length * np.einsum("ank,bnk,k->ab", x, y, module.stiffness) / x.shape[1]
            for module, x, y in zip(arm.modules, one, other, strict=True)
        )
    )


class Local(NamedTuple):
    """The energy around an equilibrium in some directions, by central differences."""

    fall: float
    """Most that it falls below that of the equilibrium [J]."""
    slope: Array
    """First derivatives (B,)."""
    curvature: Array
    """Second derivatives (B, B)."""
    metric: Array
    """(B, B), see `rod_metric`."""

    def softest(self) -> float:
        """Smallest second derivative relative to the rod's own: an upper bound of the arm's stability."""
        return float(eigh(self.curvature, self.metric, eigvals_only=True)[0])


def around(
    scene_energy: Callable[[Sequence[Array]], Array], strain: Sequence[Array], metric: Array, modes: list[Array]
) -> Local:
    """Return the energy's behaviour around `strain`, (2 N, 6) in each module, along `modes` (B, 2 N, 6)."""
    count = len(modes[0])
    first, second = np.triu_indices(count, 1)
    fields = [STEP * np.concatenate([y, -y, y[first] + y[second]]) for y in modes]
    rest = scene_energy([x[np.newaxis] for x in strain])[0]
    change = scene_energy([x + y for x, y in zip(strain, fields, strict=True)]) - rest
    up, down, both = change[:count], change[count : 2 * count], change[2 * count :]
    curvature = np.diag(up + down)
    curvature[first, second] = curvature[second, first] = both - up[first] - up[second]
    return Local(-change.min(), (up - down) / (2.0 * STEP), curvature / STEP**2, metric)


def local(scene: Scene, result: Equilibrium) -> tuple[Local, float]:
    """The energy around an equilibrium in a few directions, and the arm's softest module [J]."""
    arm = scene.arm(FINER)
    grid = Fine.over(arm)
    modes = [np.concatenate(pair) for pair in zip(whole_arm_modes(arm, grid), random_modes(arm, grid, 3), strict=True)]
    found = around(lambda strain: scene.energy(grid, strain), grid.sampled(result), rod_metric(arm, modes, modes), modes)
    return found, min(module.stiffness[:2].min() / module.length for module in arm.modules)


@on_random_arms
def test_an_equilibrium_is_a_minimum_of_the_energy(count):
    """Nothing that the arm does in a small neighbourhood lowers its energy, wherever it came from.

    The errors of the grids of the test and of the solver leave a slope, of 1e-5 at most in a thousand arms.
    """

    @settings(same, max_examples=count)
    @given(scenes())
    def check(scene: Scene) -> None:
        result = scene.solve(FINER, start=scene.before().solve(FINER))
        assume(result.converged)
        here, unit = local(scene, result)
        size = np.sqrt(np.diag(here.metric))
        assert (np.abs(here.slope) < 1e-4 * size * np.sqrt(unit)).all()
        assert here.fall < 1e-4 * STEP * 2.0 * size.max() * np.sqrt(unit)
        assert 0.0 < result.stability < 1.01 * here.softest() + 1e-4

    check()


@on_random_arms
def test_rod_and_muscles_carry_the_loads(count):
    """Kinematics, balance and muscle laws of the returned shape, by the test's own integration of the returned strain.

    `Equilibrium.strain` balances the wrench at its section by construction, with the moment from the solver's own quadrature
    and between its nodes: what is left is the error of the discretisation.
    """

    @settings(same, max_examples=count)
    @given(scenes(moment=moments))
    def check(scene: Scene) -> None:
        result = scene.solve(FINER)
        assume(result.converged)
        arm = scene.arm(FINER)
        grid = Fine.over(arm, 2)
        strain = [x[np.newaxis] for x in grid.sampled(result)]
        shapes = grid.shape(strain)
        rotation, position = (shapes[-1][k][0, -1] for k in (0, 1))
        assert result.tip_pose[:3, 3] == pytest.approx(position, abs=1e-5 * arm.length)
        assert result.tip_pose[:3, :3] == pytest.approx(rotation, abs=1e-5)
        lengths = grid.paths(strain)[0]
        assert result.muscle_lengths == pytest.approx(lengths, abs=1e-6 * arm.length)
        for muscle, rest, drive, length, tension in zip(
            arm.muscles, arm.rest_lengths, scene.drive(), lengths, result.tensions, strict=True
        ):
            if isinstance(muscle.law, Tendon):
                assert tension == drive
            else:
                assert stretched(muscle.law, rest, drive, tension) == pytest.approx(length, abs=1e-6 * arm.length)
        for module, s, xi, tensions, frame, load in sections(scene, arm, grid, shapes, result):
            carried = module.stiffness * (xi - module.reference_strain)
            for muscle, tension in zip(module.muscles, tensions, strict=True):
                (r,), (slope,) = place(module, muscle, s)
                t = xi[3:] + np.cross(xi[:3], r) + slope
                t /= np.linalg.norm(t)
                carried = carried + tension * np.concatenate([np.cross(r, t), t])
            error = np.abs(carried - np.concatenate([load[:3] @ frame, load[3:] @ frame])) / module.stiffness
            assert (error * ([module.length] * 3 + [1.0] * 3)).max() < 1e-4

    check()


def sections(
    scene: Scene, arm: Arm, grid: Fine, shapes: Sequence[tuple[Array, Array]], result: Equilibrium
) -> Iterator[tuple[Module, Array, Array, Array, Array, Array]]:
    """At the ends of every other cell, tip to base: what to balance there.

    The module and the place (1,) in it, the strain that `result` has there, the tensions of the module's muscles, the frame
    (3, 3) and the wrench [m; n] in the base frame of all loads beyond.
    """
    force, moment = scene.tip()
    tip = shapes[-1][1][0, -1]
    centre = tip + shapes[-1][0][0, -1] @ np.array(scene.centre)
    mass, first_moment = 0.0, np.zeros(3)
    base, last = arm.length, len(arm.muscles)
    for module, cells, (rotations, positions) in zip(arm.modules[::-1], grid.cells[::-1], shapes[::-1], strict=True):
        base -= module.length
        tensions = result.tensions[last - len(module.muscles) : last]
        last -= len(module.muscles)
        # At a joint the returned strain is the one beyond it.
        places = np.clip(np.linspace(0.0, module.length, cells + 1), 1e-9 * module.length, (1.0 - 1e-9) * module.length)
        strain = result.strain(base + places[::2])
        part = module.mass_per_length * module.length / cells
        for j in range(cells, -1, -2):
            p = positions[0, j]
            if j < cells:
                mass += 2.0 * part
                first_moment = first_moment + part / 3.0 * (p + 4.0 * positions[0, j + 1] + positions[0, j + 2])
            load = force + (mass + scene.weight) * arm.gravity
            hanging = scene.weight * (centre - p) + first_moment - mass * p
            torque = moment + np.cross(tip - p, force) + np.cross(hanging, arm.gravity)
            yield module, places[j : j + 1], strain[j // 2], tensions, rotations[0, j], np.concatenate([torque, load])


def agree(result: Equilibrium, other: Equilibrium, frame: Array) -> None:
    """The other equilibrium is the first one in the frame (3, 3), a rotation or a reflection."""
    length = result.length
    s = np.linspace(0.0, length, 5)
    assert other.converged
    here, there = result.poses(s), other.poses(s)
    assert there[:, :3, 3] == pytest.approx(here[:, :3, 3] @ frame.T, abs=1e-7 * length)
    assert there[:, :3, :3] == pytest.approx(frame @ here[:, :3, :3] @ frame.T, abs=1e-6)
    assert other.tensions == pytest.approx(result.tensions, abs=1e-7 * max(1.0, np.abs(result.tensions).max(initial=0.0)))
    assert other.muscle_lengths == pytest.approx(result.muscle_lengths, abs=1e-7 * length)


def firm(result: Equilibrium) -> bool:
    """Whether an equilibrium continues the start's branch and is not about to leave it: then the setup alone decides on it."""
    return bool(result.converged and not result.jumped and result.stability > 0.02)


@on_random_arms
def test_turning_the_setup_turns_the_equilibrium(count):
    @settings(same, max_examples=count)
    @given(scenes(flat=st.just(1.0), moment=moments), st.floats(-np.pi, np.pi))
    def check(scene: Scene, angle: float) -> None:
        c, s = np.cos(angle), np.sin(angle)
        frame = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        turned = scene.turned(frame, lambda fibre: fibre._replace(angle=fibre.angle + angle))
        before = scene.before().solve()
        result = scene.solve(start=before)
        assume(firm(before) and firm(result))
        agree(result, turned.solve(start=turned.before().solve()), frame)

    check()


@on_random_arms
def test_mirroring_the_setup_mirrors_the_equilibrium(count):
    @settings(same, max_examples=count)
    @given(scenes(moment=moments))
    def check(scene: Scene) -> None:
        frame = np.diag([1.0, -1.0, 1.0])
        mirrored = scene.turned(frame, lambda fibre: fibre._replace(angle=-fibre.angle, turns=-fibre.turns))
        before = scene.before().solve()
        result = scene.solve(start=before)
        assume(firm(before) and firm(result))
        agree(result, mirrored.solve(start=mirrored.before().solve()), frame)

    check()


@on_random_arms
def test_cutting_every_module_in_two_changes_nothing(count):
    """With tendons: two elastic muscles in series are not one. One half of a helix starts where the other ends."""

    @settings(same, max_examples=count)
    @given(scenes(tendons), st.floats(0.2, 0.8))
    def check(scene: Scene, at: float) -> None:
        cut = scene._replace(pieces=tuple(half for piece in scene.pieces for half in halves(piece, at)))
        result = scene.solve(FINER)
        assume(firm(result))
        other = cut.solve(FINER)
        assert other.converged
        s = np.linspace(0.0, result.length, 7)
        assert other.poses(s)[:, :3, 3] == pytest.approx(result.poses(s)[:, :3, 3], abs=1e-6 * result.length)
        pairs = np.split(other.muscle_lengths, np.cumsum([2 * len(piece.fibres) for piece in scene.pieces])[:-1])
        lengths = np.concatenate([pair.reshape(2, -1).sum(axis=0) for pair in pairs])
        assert lengths == pytest.approx(result.muscle_lengths, abs=1e-6 * result.length)

    check()


def halves(piece: Piece, at: float) -> tuple[Piece, Piece]:
    lower = tuple(f._replace(turns=f.turns * at) for f in piece.fibres)
    upper = tuple(f._replace(angle=f.angle + 2.0 * np.pi * f.turns * at, turns=f.turns * (1.0 - at)) for f in piece.fibres)
    return (
        piece._replace(length=at * piece.length, mass=at * piece.mass, fibres=lower),
        piece._replace(length=(1.0 - at) * piece.length, mass=(1.0 - at) * piece.mass, fibres=upper),
    )


# Whatever is asked.

LIMIT, PATIENCE = 1.0, 3.0  # [s], and how much longer a busy machine may take


@on_random_arms
def test_whatever_is_asked_the_answer_is_sound(count):
    """Loads up to a hundred thousand times what bends the arm: an equilibrium that is stable, or the start's shape and why."""

    @settings(same, max_examples=count)
    @given(scenes(moment=moments), st.floats(0.0, 5.0), st.booleans())
    def check(scene: Scene, size: float, cold: bool) -> None:
        arm = scene.arm()
        start = None if cold else scene.before().solve()
        force, moment = scene.tip()
        begin = perf_counter()
        result = arm.equilibrium(scene.drive(), 10.0**size * force, 10.0**size * moment, start, time_limit_s=LIMIT)
        assert perf_counter() - begin < PATIENCE * LIMIT
        s = np.linspace(0.0, arm.length, 4)
        for values in (result.tip_pose, result.tensions, result.muscle_lengths, result.poses(s), result.strain(s)):
            assert np.isfinite(values).all()
        assert result.message
        if result.converged:
            assert result.residual <= arm.residual_tolerance
            assert result.rung != Rung.FAILED
            assert result.stable and result.stability > 0.0
        else:
            assert result.rung == Rung.FAILED
            assert not result.jumped
            assert result.message.startswith("no equilibrium found: ")
            known = start or unloaded(arm)
            assert result.poses(s) == pytest.approx(known.poses(s), abs=1e-9)
            assert result.tensions == pytest.approx(known.tensions, abs=1e-9)

    check()


def unloaded(arm: Arm) -> Equilibrium:
    neutral = [muscle.law.neutral_drive(rest) for muscle, rest in zip(arm.muscles, arm.rest_lengths, strict=True)]
    return Arm(arm.modules).equilibrium(neutral)


# Buckling. The test rod of the closed forms: L = 45 mm, radius 4.5 mm.

L = 0.045
EI, GA, EA = 4.025779179727e-5, 2.650718801, 7.952156404
WEIGHT = 0.667771  # [N/m]
G0 = 9.81
EULER = np.pi**2 * EI / (4.0 * L**2)


def column(length: float = L, mass: float = 0.0, slender: bool = False, flat: float = 1.0) -> Module:
    """The test rod, `slender`: without shear and extension, `flat`: so much stiffer about x than about y."""
    module = Module.cylinder(length, 2.0 * RADIUS, E, E / 3.0, mass)
    return replace(module, stiffness=module.stiffness * ([flat, 1.0, 1.0] + [1e5 if slender else 1.0] * 3))


def straight(result: Equilibrium) -> bool:
    return bool(np.linalg.norm(result.tip_pose[:2, 3]) < 1e-6 * result.length)


@pytest.mark.parametrize("part", [-1.0, 0.0, 0.2, 0.5, 0.9, 0.99, 0.999])
def test_the_stability_of_a_column_falls_in_proportion_to_its_load(part):
    """Second variation of an inextensible column over its bending energy: 1 - P/P_c, and 1 where it hangs."""
    result = Arm([column(slender=True)]).equilibrium([], (0.0, 0.0, -part * EULER))
    assert result.converged and straight(result)
    assert result.stability == pytest.approx(min(1.0, 1.0 - part), abs=1e-4)


def switch(stands: Callable[[float], bool], low: float, high: float) -> float:
    """Bisect for where it no longer stands."""
    assert stands(low) and not stands(high)
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stands(middle) else (low, middle)
    return 0.5 * (low + high)


def stands(result: Equilibrium) -> bool:
    """Whether the rod is straight. Where it cannot stand so, it has buckled: it is never returned straight and unstable.

    It bends little just above the critical load, and unbends below: the arm leaves its branch, but does not jump.
    """
    assert result.converged and result.stability > 0.0 and not result.jumped
    assert straight(result) or result.rung == Rung.DESCENT
    return straight(result)


SHEAR = 1.0 / GA - 1.0 / EA
FLAT = 4.0  # a round column may turn about its axis once it has buckled: neither stable nor unstable


def test_a_column_buckles_at_the_critical_tip_weight():
    """P (1 + P (1/GA - 1/EA)) = pi^2 EI/(4 L^2): shear softens the column, compression shortens it."""
    critical = (np.sqrt(1.0 + 4.0 * EULER * SHEAR) - 1.0) / (2.0 * SHEAR)
    assert critical == pytest.approx(0.048462219, abs=1e-9)
    arm = Arm([column(flat=FLAT)])
    found = switch(lambda weight: stands(arm.equilibrium([], (0.0, 0.0, -weight))), 0.03, 0.06)
    assert found == pytest.approx(critical, rel=1e-3)
    # As a payload too, gravity upright.
    arm = Arm([column(flat=FLAT)], (0.0, 0.0, -G0))
    assert stands(arm.equilibrium([], payload=Payload(0.999 * critical / G0)))
    assert not stands(arm.equilibrium([], payload=Payload(1.001 * critical / G0)))


def test_a_rod_that_is_pulled_buckles_too():
    """The other root, P < 0: sections that shear more easily than they stretch turn, and let the pull out in shear."""
    critical = (np.sqrt(1.0 + 4.0 * EULER * SHEAR) + 1.0) / (2.0 * SHEAR)
    arm = Arm([column(flat=FLAT)])
    found = switch(lambda pull: stands(arm.equilibrium([], (0.0, 0.0, pull))), 3.5, 4.5)
    assert found == pytest.approx(critical, rel=1e-3)


def test_the_stability_vanishes_at_the_critical_tip_weight():
    """Through zero: the paper's shooting keeps to the straight column beyond, and its answer says that it is unstable."""
    arm = Arm([column()])

    def answer(weight: float) -> Equilibrium:
        result = shooting.equilibrium(arm, [], (0.0, 0.0, -weight))
        assert result.converged and straight(result)
        return result

    found = brentq(lambda weight: answer(weight).stability, 0.03, 0.06, rtol=1e-4)
    assert found == pytest.approx(0.048462219, rel=1e-3)
    assert answer(0.999 * found).stable and not answer(1.001 * found).stable


def test_a_rod_buckles_under_its_own_weight_at_greenhills_length():
    def upright(length: float) -> Equilibrium:
        module = column(length, WEIGHT / G0 * length, slender=True, flat=FLAT)
        return Arm([module], (0.0, 0.0, -G0)).equilibrium([])

    found = switch(lambda length: stands(upright(length)), 0.06, 0.1)
    assert found == pytest.approx(0.077886787, rel=1e-3)


# Stability against the Hessian of the test's own energy.

ORDER = 6


class Loaded(NamedTuple):
    arm: Arm
    drive: list[float]
    force: Vector = (0.0, 0.0, 0.0)


def tendons_and_springs() -> Loaded:
    muscles = [Muscle(0.004, 0.0, 0.0, Tendon()), Muscle(0.003, 2.0, 0.8, Spring(30.0)), Muscle(0.004, 4.0, 0.0, TCA())]
    module = Module.cylinder(L, 2.0 * RADIUS, E, E / 3.0, 2e-3, muscles)
    return Loaded(Arm([module], (0.0, 3.0, -G0), Payload(1e-3, (0.002, 0.0, 0.01))), [0.2, 0.9 * L, 110.0], (0.0, 0.01, -0.02))


LOADED = {
    "a bent column": lambda: Loaded(Arm([column(flat=1.5)]), [], (0.01, 0.004, -0.05)),
    "a hanging bending module, two hot TCAs": lambda: Loaded(
        Arm([bending_module()], GRAVITY, BELOW_BENDING), [30.0, 150.0, 145.0]
    ),
    "an upright rod with muscles": tendons_and_springs,
    "two unlike modules": lambda: Loaded(
        Arm([column(0.03, 1e-3), column(0.02, 1e-3, flat=0.5)], (G0, 0.0, 0.0), Payload(2e-3)), [], (0.0, 0.02, -0.02)
    ),
}


@pytest.mark.parametrize("name", LOADED)
def test_the_stability_is_that_of_an_independent_energy(name):
    """The energy's second differences along every Legendre polynomial of low order of every strain: a Ritz value."""
    arm, drive, force = LOADED[name]()
    fine = Arm(arm.modules, arm.gravity, arm.payload, [Grid(2 * e, q) for e, q in arm.grids], 1e-11)
    result = fine.equilibrium(drive, force)
    assert result.converged
    grid = Fine.over(fine)
    modes = []
    for k, (module, s) in enumerate(zip(fine.modules, grid.points(), strict=True)):
        low = np.polynomial.legendre.legvander(2.0 * s / module.length - 1.0, ORDER - 1)
        unit = np.sqrt(module.stiffness[:2].min() / module.stiffness) / module.length
        field = np.zeros((len(fine.modules), 6, ORDER, len(s), 6))
        field[k] = np.einsum("np,jk->jpnk", low, np.diag(unit))
        modes.append(field.reshape(-1, len(s), 6))
    payload = fine.payload or Payload(0.0)
    metric = rod_metric(fine, modes, modes)
    here = around(lambda strain: grid.energy(strain, drive, force, payload), grid.sampled(result), metric, modes)
    assert result.stability == pytest.approx(here.softest(), rel=0.01)
    assert result.stability < 0.9  # not that of an arm that hardly bears anything


# Hysteresis.


def sweep(ask: Callable[[float, Equilibrium | None], Equilibrium], values: Array, start: Equilibrium) -> list[Equilibrium]:
    """Go through `values`, each solve from the one before; every one of them stable."""
    results = []
    for value in values:
        start = ask(value, start)
        assert start.converged and start.stable, start.message
        results.append(start)
    return results


def loop(ask: Callable[[float, Equilibrium | None], Equilibrium], values: Array, start: Equilibrium) -> tuple[Array, Array]:
    """Sweep there and back; return the tips (N, 3) both ways, in the order of `values`. One jump each way."""
    there = sweep(ask, values, start)
    back = sweep(ask, values[::-1], there[-1])
    assert [sum(result.jumped for result in results) for results in (there, back)] == [1, 1]
    return np.array([r.tip_pose[:3, 3] for r in there]), np.array([r.tip_pose[:3, 3] for r in back[::-1]])


def test_a_buckled_column_pushed_to_and_fro_snaps_through_once_each_way():
    """A flat one: a round column would swing about its axis instead. The two ways mirror each other."""
    arm, weight = Arm([column(flat=4.0)]), 1.2 * 0.048462219
    start = arm.equilibrium([], (-0.01, 0.0, -weight))
    values = np.linspace(-0.01, 0.01, 41)
    there, back = loop(lambda push, r: arm.equilibrium([], (push, 0.0, -weight), start=r), values, start)
    apart = np.linalg.norm(there - back, axis=1) > 0.1 * L
    assert 5 <= apart.sum() <= 35 and not apart[[0, -1]].any()
    assert (np.diff(np.flatnonzero(apart)) == 1).all()
    assert there[:, 0] == pytest.approx(-back[::-1, 0], abs=1e-6 * L)


def test_two_hot_muscles_of_a_hanging_arm_have_two_answers():
    """One of them cools and heats up again, then the other: with both at the cut-off, the arm is on the side it came from."""
    arm = Arm([bending_module()], GRAVITY, BELOW_BENDING)

    def ask(cooler: float, start: Equilibrium | None) -> Equilibrium:
        return arm.equilibrium((25.0, CUT_OFF - max(-cooler, 0.0), CUT_OFF - max(cooler, 0.0)), start=start)

    values = np.linspace(-20.0, 20.0, 21)
    there, back = loop(ask, values, ask(values[0], None))
    assert there[:, 1] == pytest.approx(-back[::-1, 1], abs=1e-6 * L)
    assert back[10, 1] - there[10, 1] == pytest.approx(2.0 * 1.63e-3, abs=0.02e-3)


def test_a_solve_keeps_its_time_limit():
    """A long soft arm that falls over takes seconds; given less, it says so."""
    muscles = [Muscle(0.004, angle, 1.0, TCA()) for angle in (0.0, 2.0)]
    arm = Arm([replace(column(0.1, 4e-3), muscles=muscles)] * 4, (0.0, 0.0, -G0), Payload(5e-3))
    arm.equilibrium([120.0] * 8, (0.5, 0.0, 0.0))  # compiles
    for limit in (1e-3, 0.2):
        begin = perf_counter()
        result = arm.equilibrium([120.0] * 8, time_limit_s=limit)
        assert perf_counter() - begin < limit + 0.5
        assert not result.converged
        assert "time limit" in result.message


@pytest.mark.parametrize(("hot", "critical"), [((0,), 141.0), ((0, 1), 156.0)])
def test_the_hanging_arm_buckles_sideways_where_its_symmetric_shape_turns_unstable(hot, critical):
    """A pitchfork: it leaves to one side, goes on from there without a jump and comes back the same way.

    On the way back a jump may be reported, as nothing settles to which side the arm would go again.
    """
    arm = bending_arm()
    across = np.array([[0.0, 1.0], [np.sqrt(0.75), -0.5]][len(hot) - 1])  # to the plane of symmetry
    sides = []
    state = None
    ways = [*np.linspace(critical - 6.0, critical + 2.0, 17), *np.linspace(critical + 2.0, critical - 6.0, 17)[1:]]
    for i, temperature in enumerate(ways):
        drive = np.full(3, AMBIENT)
        drive[list(hot)] = temperature
        state = arm.equilibrium(drive, start=state)
        assert state.converged and state.stable and not (state.jumped and i < 17)
        sides.append(abs(across @ state.tip_pose[:2, 3]))
        assert (sides[-1] > 1e-5) == (temperature > critical + 0.4) or abs(temperature - critical) < 0.6
    assert max(sides) > 5e-4 and sides[-1] < 1e-6


def test_there_and_back_is_where_it_was_or_a_jump_is_reported():
    """Full-range steps and back: an arm that is not back where it was has left its branch on the way, and says so."""
    arm, rng = bending_arm(), np.random.default_rng(3)
    cases = [([157.41, 37.54, 58.73], [100.59, 147.86, 25.23]), *rng.uniform(AMBIENT, CUT_OFF, (120, 2, 3)).tolist()]
    lost = 0
    for before, after in cases:
        start = arm.equilibrium(before)
        there = arm.equilibrium(after, start=start)
        back = arm.equilibrium(before, start=there)
        assert there.converged and back.converged
        if np.linalg.norm(back.tip_pose[:3, 3] - start.tip_pose[:3, 3]) > 2e-4:
            lost += 1
            assert there.jumped or back.jumped
    assert lost > 0, "none of the cases tests anything"


@pytest.mark.parametrize("pieces", [1, 20])
def test_a_snap_is_one_however_many_modules_the_column_is_cut_into(pieces):
    stiffness = np.array([4.0 * 4.0258e-5, 4.0258e-5, 2.6839e-5, 2.6507, 2.6507, 7.9522])
    arm = Arm([Module(0.045 / pieces, stiffness) for _ in range(pieces)])
    weight = 1.02 * 0.048462219
    state = None
    for side, down in ((2e-3, 0.0), (2e-3, weight), (1e-5, weight)):
        state = arm.equilibrium([], (side, 0.0, -down), start=state)
    snapped = arm.equilibrium([], (-2e-3, 0.0, -weight), start=state)
    assert state.tip_pose[0, 3] > 5e-3 and snapped.tip_pose[0, 3] < -5e-3
    assert snapped.converged and snapped.jumped


def test_a_grid_that_cannot_hold_the_shape_is_not_said_to_hold_it():
    muscle = Muscle(0.004, 0.0, 0.0, Tendon())
    arm = Arm([Module.cylinder(0.1, 0.009, 0.125e6, 0.125e6 / 3.0, muscles=[muscle])], grids=[Grid(1, 1)])
    result = arm.equilibrium([1.2])
    assert not result.converged or result.stable
    assert np.isfinite(result.centerline(20)).all() and np.isfinite(result.stability)
    assert Arm(arm.modules).equilibrium([1.2]).converged


def test_results_survive_pickling():
    arm = bending_arm()
    for found in (arm.equilibrium([60.0, 30.0, 30.0]), shooting.equilibrium(arm, [60.0, 30.0, 30.0], rtol=1e-3)):
        again = pickle.loads(pickle.dumps(found))
        assert (again.stability, again.rung, again.jumped) == (found.stability, found.rung, found.jumped)
        assert np.array_equal(again.tip_jacobian, found.tip_jacobian)


def test_the_kernels_are_compiled_once():
    """Of another layout of its arrays a kernel is another one, and half a minute to compile."""
    bending_arm()
    assert len(batch._solve_packs.signatures) == len(batch._linearise.signatures) == 1
