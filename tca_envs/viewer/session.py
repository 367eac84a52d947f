"""What one visitor plays with: an environment, what drives it, the world around it and its last half minute; no page."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from math import cos, degrees, radians, sin
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tca_envs import registry
from tca_envs.env import ArmEnv
from tca_envs.geometry import Part
from tca_envs.mechanics import Rung, check, continuation, loads
from tca_envs.mechanics.discretisation import COARSEST, FINEST
from tca_envs.mechanics.rungs import NEUTRAL
from tca_envs.robots import TOLERANCE

Array = NDArray[np.float64]

HISTORY_S = 30.0
"""So much of the past is kept [s]."""
MOST_GRAVITY = 1.0
"""[g]: beyond that an upright arm folds."""
MOST_TILT = 90.0
"""[deg]."""
MOST_PAYLOAD = 5.0
"""[g], nearly the arm's own weight."""
MANUAL, SCRIPTED, PRETRAINED = "manual", "scripted", "pretrained"
"""What can drive the arm."""


class Policy(Protocol):
    """What drives the arm instead of the visitor."""

    def predict(self, observation: dict[str, NDArray[Any]], *, deterministic: bool) -> tuple[NDArray[Any], Any]:
        """Return the action for an observation, and what nobody reads."""


class Control(NamedTuple):
    """A number of the action, as a visitor sets it."""

    label: str
    unit: str
    most: float
    """It goes from 0 to this."""


@dataclass(frozen=True)
class World:
    """What the task leaves alone and a visitor may change.

    Parameters
    ----------
    gravity : float
        In units of the task's own, -1 to 1; negative is upwards. It acts on the arm; an object on the table stays there.
    tilt : float
        Angle between gravity and the vertical, towards +x, -90 to 90 [deg].
    payload : float
        What hangs from the tip in addition, 0 to 5 [g].
    """

    gravity: float = 1.0
    tilt: float = 0.0
    payload: float = 0.0

    def __post_init__(self) -> None:
        check.scalar("gravity", self.gravity, -MOST_GRAVITY, MOST_GRAVITY)
        check.scalar("tilt", self.tilt, -MOST_TILT, MOST_TILT)
        check.scalar("payload", self.payload, 0.0, MOST_PAYLOAD)

    def acceleration(self, own: Array) -> Array:
        """Return gravity (3,) [m/s2] where the task's is `own`, straight down."""
        tilt = radians(self.tilt)
        return self.gravity * float(np.linalg.norm(own)) * np.array([sin(tilt), 0.0, cos(tilt)])


class Solve(NamedTuple):
    """What the solver did in the last step."""

    milliseconds: float
    """Of the whole step: heating, equilibrium, task."""
    rung: Rung
    iterations: int
    residual: float
    converged: bool
    jumped: bool
    stability: float
    """Of the equilibrium, see `Equilibrium.stability`."""

    @property
    def stable(self) -> bool:
        """See `Equilibrium.stable`."""
        return self.stability > -NEUTRAL


class Session:
    """A visitor's environment.

    Parameters
    ----------
    task : str
        Name of a task in `tca_envs.registry`, or "module:name".
    tolerance : float
        Largest error of the arm's tip [m], 1e-9 to 1e-3.
    seed : int
        Of the first episode.

    Raises
    ------
    ValueError
        If an argument is none of these.
    """

    def __init__(self, task: str = "reach", tolerance: float = TOLERANCE, seed: int = 0) -> None:
        self.env = ArmEnv(task, "dense", tolerance=check.scalar("tolerance", tolerance, FINEST, COARSEST))
        self.task = registry.entry(task).name
        self.core = self.env.core
        self.controls = _controls(self.env)
        self.command = np.zeros(len(self.controls))
        """What the visitor asks for (a,), in the controls' units; what was done, where a policy drives."""
        self.world = World()
        self.controller = MANUAL
        self._policy: Policy | None = None
        self._gravity = self.core.load[loads.GRAVITY].copy()
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Start the episode that belongs to a seed; what drives the arm and the world stay as they are."""
        if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
            raise ValueError(f"seed = {seed!r}: expected an integer of at least 0")
        self.observation, self.info = self.env.reset(seed=seed)
        self.seed = seed
        self.command = np.zeros(len(self.controls))
        self.drive_by(self.controller)
        self._past: deque[tuple[Array, Array]] = deque(maxlen=round(HISTORY_S / self.core.step_s) + 1)
        self._remember()
        self.solve = self._solved(0.0)

    def drive_by(self, controller: str) -> None:
        """Let the visitor ("manual"), the scripted controller or the pretrained policy drive.

        Raises
        ------
        ValueError
            If there is no such controller here.
        """
        there = controllers(self.task)
        if controller not in there:
            raise ValueError(f"controller = {controller!r}: expected one of {', '.join(map(repr, there))}")
        # A new one each time: a scripted controller remembers its plans.
        self._policy = CONTROLLERS[controller].load(self.task)
        self.controller = controller

    def step(self) -> None:
        """Let the time of one step pass."""
        record = self.core.record
        action = self._action() if self._policy is None else self._policy.predict(self.observation, deterministic=True)[0]
        self.core.load[loads.GRAVITY] = self.world.acceleration(self._gravity)
        own = record.payload.copy()
        record.payload[:, 0] += 1e-3 * self.world.payload
        loaded = record.payload.copy()
        begun = time.perf_counter()
        self.observation, _, _, _, self.info = self.env.step(action)
        taken = time.perf_counter() - begun
        if np.array_equal(record.payload, loaded):  # a task may have hung another one there
            record.payload[:] = own
        self._remember()
        self.solve = self._solved(1e3 * taken)
        if self._policy is not None:
            powers = record.power.shape[1]
            self.command[:powers] = record.power[0]
            self.command[powers:] = self._stage()

    @property
    def time(self) -> float:
        """Time since the episode's start [s]."""
        return self.core.step_s * float(self.core.record.steps[0])

    def history(self) -> tuple[Array, Array, Array]:
        """Return the last half minute: times (k,) [s], temperatures (k, m) [degC], tensions (k, n) [mN]; now is last."""
        times = self.time + self.core.step_s * np.arange(1.0 - len(self._past), 1.0)
        return times, np.array([t for t, _ in self._past]), 1e3 * np.array([f for _, f in self._past])

    def parts(self) -> dict[str, Part]:
        """Return what is to be seen, see `Task.parts`."""
        return self.env.task.parts(self.core)

    def discretisation(self) -> str:
        """Return how the arm is discretised, in a line."""
        chosen = self.env.arm.discretisation
        return " + ".join(f"{elements} × {nodes}" for elements, nodes in chosen.grids) + " Gauss nodes"

    def _action(self) -> Array:
        """Return the action (a,) in [-1, 1] for the visitor's command."""
        most = np.array([control.most for control in self.controls])
        action = 2.0 * np.clip(self.command / most, 0.0, 1.0) - 1.0
        stage, powers = self.env.task.robot.stage, self.core.heating.max_power.size
        if stage is not None:  # the action is its speed; a visitor says where it shall be
            action[powers:] = 1e-3 * (self.command[powers:] - self._stage()) / (stage.speed * self.core.step_s)
        return np.clip(action, -1.0, 1.0)

    def _stage(self) -> float:
        """Return how far the stage is lowered [mm]; 0 where there is none."""
        return 1e3 * self.env.task.posture(self.core.record).lowered

    def _remember(self) -> None:
        self._past.append((self.core.record.temperature[0].copy(), self.core.record.tension[0].copy()))

    def _solved(self, milliseconds: float) -> Solve:
        told, record = self.info["solver"], self.core.record
        lane = continuation.Lane(record.strain[0], record.tension[0], record.drive[0], record.load[0])
        stability = continuation.smallest_eigenvalue(self.env.arm.problem, lane)
        return Solve(
            milliseconds, Rung(told["rung"]), told["iterations"], told["residual"], told["converged"], told["jumped"], stability
        )


def _controls(env: ArmEnv) -> list[Control]:
    """Return the controls of an environment: a heating power for each TCA, the stage, and what else a task acts by."""
    muscles, robot = env.arm.muscles, env.task.robot
    names = [f"Bend {degrees(m.angle):.0f}°" if m.turns == 0.0 else "Twist" for m in muscles]
    powers = env.core.heating.max_power
    names += ["Grip"] * (powers.size - len(muscles))
    result = [Control(name, "W", float(power)) for name, power in zip(names, powers, strict=True)]
    others = range(powers.size, env.task.actions)
    if robot.stage is not None:
        return result + [Control("Stage", "mm", 1e3 * robot.stage.travel)] * len(others)
    return result + [Control(f"Action {i}", "share", 1.0) for i in others]


class Kind(NamedTuple):
    """A kind of controller."""

    load: Callable[[str], Policy | None]
    """Task -> one of it."""
    missing: Callable[[str], str]
    """Task -> what is missing to have it here, "" where nothing is."""


def controllers(task: str) -> tuple[str, ...]:
    """Return what can drive a task here."""
    return tuple(name for name, kind in CONTROLLERS.items() if not kind.missing(task))


def _scripted(task: str) -> Policy:
    policy: Policy = registry.load(registry.entry(task).controller)()
    return policy


def _no_script(task: str) -> str:
    controller = registry.entry(task).controller
    if controller is None:
        return "this task has none"
    # Others have a package `agents`, too.
    module = controller.partition(":")[0] if isinstance(controller, str) else None
    there = module is None or (find_spec(module.partition(".")[0]) and find_spec(module))
    return "" if there else f"needs the package `{str(module).partition('.')[0]}` of a checkout"


@cache
def _pretrained(task: str) -> Policy:
    """Return the policy that comes along for a task; it remembers nothing, so that visitors share it."""
    policy: Policy = registry.load("agents.training:pretrained")(task)
    return policy


def _no_policy(task: str) -> str:
    if not (find_spec("agents") and find_spec("agents.training")):
        return "needs the package `agents` of a checkout"
    if not (registry.load("agents.training:PRETRAINED") / task).is_dir():
        return f"needs agents/pretrained/{task} of a checkout"
    return "" if find_spec("stable_baselines3") else 'needs pip install "tca_envs[train]"'


CONTROLLERS = {
    MANUAL: Kind(lambda task: None, lambda task: ""),
    SCRIPTED: Kind(_scripted, _no_script),
    PRETRAINED: Kind(_pretrained, _no_policy),
}
"""What can drive the arm, by name."""
