"""What a robot is: an arm, how it is heated, its limits, what hangs from it, and how it is drawn."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs import geometry
from tca_envs.geometry import Parts
from tca_envs.mechanics import TCA, Arm, Gripper, Payload, check, discretise
from tca_envs.mechanics.continuation import Lane
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT, SOFT_LIMIT, Heater, Heating

Array = NDArray[np.float64]

TOLERANCE = 1e-5
"""Default tip error [m]: a hundredth of the smallest success radius."""
CUT_OFF = HARD_LIMIT - 2.0
"""Temperature [degC] that the heaters' firmware never lets a TCA exceed."""
STATES = 160
"""So many states of a robot decide on its discretisation."""
STRETCH = 1.2
"""No arm gets longer than this share of its length (estimate): a default for bounds and pictures ..."""
CLEARANCE = 10e-3
"""... where the ground is so far below that [m]."""


@dataclass(frozen=True)
class Limits:
    """Temperatures between which a robot works [degC].

    Parameters
    ----------
    ambient : float
        Of the air.
    soft : float
        Highest for long use: goals and the unit of observed temperatures.
    cut_off : float
        What the heaters' firmware never lets a TCA exceed.
    hard : float
        What is never reached.
    """

    ambient: float = AMBIENT
    soft: float = SOFT_LIMIT
    cut_off: float = CUT_OFF
    hard: float = HARD_LIMIT

    def __post_init__(self) -> None:
        check.scalar("ambient", self.ambient)
        for name, low in (("soft", self.ambient), ("cut_off", self.soft), ("hard", self.cut_off)):
            check.scalar(name, getattr(self, name), low, above=name == "soft")


@dataclass(frozen=True)
class Stage:
    """What moves the base up and down.

    Parameters
    ----------
    travel : float
        How far it lowers the base [m].
    speed : float
        [m/s].
    """

    travel: float
    speed: float

    def __post_init__(self) -> None:
        for name in ("travel", "speed"):
            check.scalar(name, getattr(self, name), 0.0, above=True)


@dataclass(frozen=True)
class RingGripper:
    """A ring that hangs from the arm's tip and that its TCA opens; its ends are the jaws.

    Parameters
    ----------
    ring : Gripper
        Its mechanics.
    width, thickness : float
        Of a jaw, across and along the direction in which it opens [m].
    mass : float
        [kg].
    centre : (3,) tuple
        Its centre of mass in the frame of the arm's tip [m].
    depth : float
        Distance of the jaws from the arm's tip [m].
    """

    ring: Gripper
    width: float
    thickness: float
    mass: float
    centre: tuple[float, float, float]
    depth: float

    def __post_init__(self) -> None:
        for name in ("width", "thickness", "mass", "depth"):
            check.scalar(name, getattr(self, name), 0.0, above=True)
        check.array("centre", self.centre, (3,))

    def carrying(self, mass: float, place: Array) -> Array:
        """Return mass [kg] and centre of mass [m] (..., 4) with an object of `mass`, its centre at `place` (..., 3) [m]."""
        both = self.mass + mass
        result = np.empty((*place.shape[:-1], 4))
        result[..., 0] = both
        result[..., 1:] = (self.mass * np.array(self.centre) + mass * place) / both
        return result

    def payload(self, mass: float, place: tuple[float, float, float] | None = None) -> Payload:
        """Return gripper and object as a payload of the arm, the object's centre at `place` or between the jaws [m]."""
        at = (0.0, 0.0, self.depth) if place is None else place
        both, x, y, z = self.carrying(mass, check.array("place", at, (3,))).tolist()
        return Payload(both, (x, y, z))

    def closed(self, mount: Array) -> Parts:
        """Return the surfaces of the closed ring at a tip's pose (4, 4)."""
        return geometry.ring_parts(mount, self.ring, (self.thickness, self.width))


class Posture(NamedTuple):
    """How a robot stands apart from its arm's shape."""

    lowered: float = 0.0
    """How far the stage is down [m]."""
    gap: float = 0.0
    """Distance of the jaws [m]."""


@dataclass(frozen=True, eq=False)
class Robot:
    """What a task moves. An arm is enough: `Robot(Arm([module]))`.

    Parameters
    ----------
    arm : Arm
        Its muscles are TCAs. Each tip tolerance gets a discretisation of its own, see `built`.
    heater : Heater
        Thermal constants of a 45 mm TCA.
    limits : Limits
        Temperatures of air, goals and cut-off.
    gripper : RingGripper, optional
        Hangs from the tip and is heated: its TCA comes after those of the arm. Its weight is in the arm's payload.
    stage : Stage, optional
        Moves the base.
    carries : Payload, optional
        What may hang from the tip instead of the arm's payload, such as a gripper with an object: the arm's discretisation
        does for both.
    reach_cm : float, optional
        No coordinate of the tip, or of what it carries, is larger [cm]; by default an arm gets a fifth longer at most.
    tail : function, optional
        Returns the surfaces of what hangs from a tip of pose (4, 4): for pictures where no gripper is heated, and of goals.
    floor : float, optional
        Depth of the ground in pictures under the base [m]; by default somewhat below the arm.

    Raises
    ------
    ValueError
        For an arm without muscles, or with one that is no TCA or does not take the limits' temperatures.
    """

    arm: Arm
    heater: Heater = field(default_factory=Heater)
    limits: Limits = field(default_factory=Limits)
    gripper: RingGripper | None = None
    stage: Stage | None = None
    carries: Payload | None = None
    reach_cm: float | None = None
    tail: Callable[[Array], Parts] | None = None
    floor: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.arm, Arm) or not self.arm.muscles:
            raise ValueError(f"arm = {self.arm!r}: expected an Arm with muscles")
        for i, muscle in enumerate(self.arm.muscles):
            low, high = muscle.law.drive_range()
            if not isinstance(muscle.law, TCA) or not low <= self.limits.ambient <= self.limits.hard <= high:
                raise ValueError(f"arm.muscles[{i}].law = {muscle.law!r}: expected a TCA that takes all of {self.limits}")
        for name in ("reach_cm", "floor"):
            if getattr(self, name) is not None:
                check.scalar(name, getattr(self, name), 0.0, above=True)

    @property
    def bound_cm(self) -> float:
        """Bound of all coordinates in goals and observations [cm]."""
        return float(ceil(100.0 * STRETCH * self.arm.length)) if self.reach_cm is None else self.reach_cm

    @property
    def ground(self) -> float:
        """Depth of the ground in pictures under the base [m]."""
        return STRETCH * self.arm.length + CLEARANCE if self.floor is None else self.floor

    @property
    def heated(self) -> int:
        """How many TCAs are heated: the arm's, and the gripper's."""
        return len(self.arm.muscles) + (self.gripper is not None)

    def heating(self) -> Heating:
        """Return the thermal constants of all heated TCAs."""
        others = [] if self.gripper is None else [self.gripper.ring.rest_length]
        heating = self.heater.scaled(np.append(self.arm.rest_lengths, others))
        return heating._replace(ambient=self.limits.ambient)

    def built(self, tolerance: float = TOLERANCE) -> Arm:
        """Return the arm with the cheapest discretisation whose tip error is at most `tolerance` [m].

        It holds for all temperatures up to the hard limit, with the arm's own payload and with what it `carries`.
        """
        return _built(self, tolerance)

    def draw(self, arm: Arm, lane: Lane, tip: Array, temperature: Array, posture: Posture) -> dict[str, geometry.Part]:
        """Return the surfaces of arm and what hangs from it.

        Parameters
        ----------
        arm : Arm
            As built.
        lane : Lane
            Its equilibrium.
        tip : (4, 4) array
            Its tip's pose.
        temperature : (m,) array
            Of the heated TCAs [degC].
        posture : Posture
            Of stage and jaws.
        """
        result = geometry.arm_parts(arm, lane)
        if self.gripper is not None:
            section, gap = (self.gripper.thickness, self.gripper.width), posture.gap
            result |= geometry.ring_parts(tip, self.gripper.ring, section, gap)
            result["gripper coil"] = geometry.ring_coil(tip, self.gripper.ring, gap, float(temperature[-1]))
        elif self.tail is not None:
            result |= self.tail(tip)
        down = np.array([0.0, 0.0, posture.lowered])
        return {name: geometry.moved(part, down) for name, part in result.items()}


@lru_cache(maxsize=64)
def carrying(robot: Robot, payload: Payload) -> Robot:
    """Return a robot whose arm is built for another payload beside its own: see `Robot.carries`."""
    return robot if robot.carries == payload else replace(robot, carries=payload)


@lru_cache(maxsize=64)
def _built(robot: Robot, tolerance: float) -> Arm:
    """Return a robot's arm as of `Robot.built`: corners of its temperatures and random ones, its payloads in turn."""
    arm, limits = robot.arm, robot.limits
    rng, count = np.random.default_rng(0), len(arm.muscles)
    if 2**count <= STATES // 2:
        corners = np.array(list(product((limits.ambient, limits.hard), repeat=count)))
    else:
        corners = rng.choice((limits.ambient, limits.hard), (STATES // 2, count))
    drives = np.vstack([corners, rng.uniform(limits.ambient, limits.hard, (STATES - len(corners), count))])
    loads = [arm.load(payload=robot.carries if i % 2 else None) for i in range(STATES)]
    return discretise(arm, tolerance, drives, np.array(loads))
