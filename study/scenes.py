"""The states that the speed-accuracy study asks for: arms as the tasks meet them, and harder ones."""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from math import ceil, pi
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from agents.scripted import RandomPolicy, controller_of
from study.method import State
from study.pattern import evenly
from tca_envs import registry
from tca_envs.mechanics import Arm, Equilibrium, Grid, Module, Muscle, Payload, Tendon, loads
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT
from tca_envs.robots import paper

STEPS_OF_AN_EPISODE = 10  # drawn from an episode, on average; a scripted controller of TCAReach takes little more to its goal
LEAST_CHANGE = 0.1
"""[K]: a step that changes no temperature by more, of an arm that holds its goal, costs no solver anything: it is left out."""
STEP = 5.0
"""Largest change of a temperature from one state to the next in the scenes that are no recordings [K], about a step's."""

HEAVY = Payload(10e-3, (0.0, 0.0, 12e-3))  # five times what hangs from the bending module in the arm

LONG_LENGTH, LONG_RADIUS, LONG_OFFSET = 0.25, 4.5e-3, 4e-3  # the long rod and its tendons [m]
LONG_DENSITY = 1070.0  # Ecoflex 00-30 [kg/m3] (manufacturer's data sheet)
LONG_TENSION, LONG_FORCE = 0.15, 0.03
"""Largest tension of a tendon, largest component of the tip force [N]; at both the rod hangs in a moderate bow."""
LONG_CHANGE = 0.03  # relative change of all loads from one state to the next


class Case(NamedTuple):
    """A state to solve for, and the one before it, where a warm start comes from; None for a cold start."""

    before: State | None
    state: State

    def start(self, arm: Arm) -> Equilibrium | None:
        """Return the equilibrium at the state before, of an arm on other grids; None for a cold start."""
        return None if self.before is None else self.before.on(arm)


class Scene(NamedTuple):
    """Cases of one arm."""

    name: str
    title: str
    arm: Arm
    cases: tuple[Case, ...]

    @property
    def start(self) -> str:
        """Whether its cases start "cold" or "warm"."""
        return "cold" if self.cases[0].before is None else "warm"


# What the tasks meet


def recorded(task: str, count: int) -> Scene:
    """Return steps of a task's episodes: half of them of its scripted controller, half of random actions."""
    env: gymnasium.Env[Any, Any] = gymnasium.make(registry.entry(task).ids["sparse"])
    core = env.unwrapped.core  # type: ignore[attr-defined]
    arm, record = core.arm, core.record

    def state() -> State:
        mass, x, y, z = record.load[0, loads.PAYLOAD].tolist()
        return State(arm, record.drive[0].copy(), payload=Payload(mass, (x, y, z)))

    cases: list[Case] = []
    random = RandomPolicy(len(env.action_space.sample()))
    for policy, share in ((controller_of(task), count - count // 2), (random, count // 2)):
        steps: list[Case] = []
        for episode in range(max(2, ceil(share / STEPS_OF_AN_EPISODE))):
            observation, _ = env.reset(seed=episode)
            before, over = state(), False
            while not over:
                observation, _, _, over, _ = env.step(policy.predict(observation)[0])
                after = state()
                changed = np.abs(after.drive - before.drive).max() > LEAST_CHANGE or after.payload != before.payload
                if changed:
                    steps.append(Case(before, after))
                before = after
        cases += evenly(steps, share)
    env.close()
    return Scene(task, TITLES[task], arm, tuple(cases))


TITLES = {
    "reach": "TCAReach: bending module, 3 TCAs",
    "twist-align": "TCATwistAlign: whole arm, 4 TCAs",
    "pick-and-place": "TCAPickAndPlace: whole arm, 4 TCAs",  # the payload changes where the object is grasped and released
}


# Others


def heated(arm: Arm, count: int, seed: int) -> tuple[Case, ...]:
    """Return steps of up to `STEP` from random temperatures up to the soft limit."""
    rng, n = np.random.default_rng(seed), len(arm.muscles)
    cases = []
    for _ in range(count):
        before = rng.uniform(AMBIENT, SOFT_LIMIT, n)
        after = np.clip(before + rng.uniform(-STEP, STEP, n), AMBIENT, SOFT_LIMIT)
        cases.append(Case(State(arm, before), State(arm, after)))
    return tuple(cases)


def cold(count: int) -> Scene:
    """Return cold starts of the bending arm at random temperatures."""
    arm = paper.bending_arm()
    cases = tuple(Case(None, case.state) for case in heated(arm, count, 1))
    return Scene("cold", "random temperatures: bending module, 3 TCAs", arm, cases)


def heavy(count: int) -> Scene:
    """Return steps of the bending module under `HEAVY`."""
    arm = Arm([paper.bending_module()], paper.GRAVITY, HEAVY, [Grid(2, 8)], residual_tolerance=1e-6)
    return Scene("heavy", "heavy: bending module with 10 g", arm, heated(arm, count, 2))


def helix(count: int) -> Scene:
    """Return steps of the twisting module alone, with the gripper's weight."""
    arm = Arm([paper.twisting_module()], paper.GRAVITY, paper.EMPTY, [Grid(6, 4)], residual_tolerance=1e-6)
    return Scene("helix", "helix: twisting module, 5 turns in 16 mm", arm, heated(arm, count, 3))


def long(count: int) -> Scene:
    """Return a hanging rod of 250 mm with three tendons and a tip force; all loads change by a few per cent."""
    muscles = [Muscle(LONG_OFFSET, angle, 0.0, Tendon()) for angle in paper.BENDING_ANGLES]
    mass = LONG_DENSITY * pi * LONG_RADIUS**2 * LONG_LENGTH
    module = Module.cylinder(LONG_LENGTH, 2.0 * LONG_RADIUS, paper.YOUNGS_MODULUS, paper.SHEAR_MODULUS, mass, muscles)
    arm = Arm([module], paper.GRAVITY, grids=[Grid(10, 6)], residual_tolerance=1e-6)
    rng = np.random.default_rng(4)
    cases = []
    for _ in range(count):
        tension, force = rng.uniform(0.0, LONG_TENSION, 3), rng.uniform(-LONG_FORCE, LONG_FORCE, 3)
        more = 1.0 + LONG_CHANGE * rng.choice([-1.0, 1.0])
        cases.append(Case(State(arm, tension, force), State(arm, more * tension, more * force)))
    return Scene("long", "long: rod of 250 mm, 3 tendons, tip force", arm, tuple(cases))


def one_degree(count: int) -> Scene:
    """Return steps of 1 degC of all TCAs of the whole arm, up from ambient to the soft limit and down again.

    Each TCA is a quarter of a cycle ahead of the last one, so the arm bends and twists on the way.
    """
    arm = paper.whole_arm()
    half = round(SOFT_LIMIT - AMBIENT)
    phase = np.arange(2 * half + 1)[:, np.newaxis] + half // 2 * np.arange(len(arm.muscles))
    states = [State(arm, AMBIENT + row) for row in np.abs((phase + half) % (2 * half) - half).astype(float)]
    steps = [Case(*pair) for pair in pairwise(states)]
    return Scene("one-degree", "steps of 1 °C: whole arm, all TCAs", arm, tuple(evenly(steps, count)))


reach, twist_align, pick_and_place = (partial(recorded, task) for task in TITLES)
TASKS: dict[str, Callable[[int], Scene]] = {e.name: registry.load(e.scene) for e in registry.entries() if e.scene is not None}
SCENES: dict[str, Callable[[int], Scene]] = {
    **TASKS, "cold": cold, "heavy": heavy, "long": long, "helix": helix, "one-degree": one_degree,
}  # fmt: skip
"""Name -> builder of a scene of so many cases."""
