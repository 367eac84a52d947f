"""The clock of every environment: heat -> solve -> observe, for N lanes at once.

A lane is one arm in one episode. Everything that it owns is a row of the arrays of a `Record`, its warm start included, so a
copy of the rows is a snapshot, and equal rows under equal actions stay equal.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import Rung, continuation, loads, thermal
from tca_envs.mechanics.continuation import Lanes
from tca_envs.mechanics.thermal import Heat
from tca_envs.robots import Robot

Array = NDArray[np.float64]
Solve = Callable[..., Any]
"""What brings lanes to equilibrium: a function with the signature of `continuation.solve`."""

STEP_S = 0.1
"""Default duration of a step [s]."""

RAMP = (0.4, 0.7, 0.85, 0.99, 1.0)
"""Shares of the way in which `Core.settle` heats. The hotter, the more the arm bends: longer steps there take the solver
longer, and it doubts that it is on the branch that it began on. The last one is short, so that little is left of Newton's
residual."""


@dataclass
class Record:
    """N lanes of a robot whose arm has n muscles, and of m >= n heated TCAs: the arm's come first."""

    temperature: Array
    """(N, m) [degC]."""
    power: Array
    """(N, m) heating power of the last step after the cut-off [W]."""
    energy: Array
    """(N,) electrical energy since the episode's start [J]."""
    steps: NDArray[np.int64]
    """(N,) since the episode's start."""
    strain: Array
    """(N, G, 6) strain at the arm's nodes: the warm start."""
    tension: Array
    """(N, n) [N]."""
    drive: Array
    """(N, n) temperatures at which strain and tension are in equilibrium [degC]."""
    load: Array
    """(N, loads.SIZE) load at which they are."""
    payload: Array
    """(N, 4) what hangs from the tip: mass [kg] and its centre in the tip's frame [m]."""
    tip: Array
    """(N, 4, 4) pose of the tip [m]."""
    length: Array
    """(N, n) path lengths of the muscles [m]."""
    goal: Array
    """(N, k) the task's goal."""
    scene: Array
    """(N, s) what else the task keeps, such as an object's place."""

    def copy(self) -> "Record":
        """Return a copy that shares nothing with this record."""
        return Record(*(getattr(self, f.name).copy() for f in fields(self)))

    def rows(self, lanes: NDArray[np.intp]) -> "Record":
        """Return a copy of some lanes."""
        return Record(*(getattr(self, f.name)[lanes] for f in fields(self)))

    def assign(self, lanes: NDArray[np.intp] | NDArray[np.bool_], source: "Record") -> None:
        """Overwrite some lanes with those of `source` (which broadcasts)."""
        for f in fields(self):
            getattr(self, f.name)[lanes] = getattr(source, f.name)


def solved(report: Any) -> NDArray[np.bool_]:
    """Return which lanes of a report (...,) of `Core.step` have an equilibrium."""
    return np.asarray(report["rung"] != Rung.FAILED)


class Core:
    """N lanes of one robot.

    Parameters
    ----------
    robot : Robot
        What is heated.
    tolerance : float
        Largest error of the arm's tip [m].
    lanes : int
        N.
    goal_size, scene_size : int
        Numbers in the task's goal and scene.
    step_s : float
        Duration of a step [s].
    solve : function
        Brings lanes to equilibrium.
    """

    def __init__(
        self,
        robot: Robot,
        tolerance: float,
        lanes: int,
        goal_size: int,
        scene_size: int = 0,
        step_s: float = STEP_S,
        solve: Solve = continuation.solve,
    ) -> None:
        self.arm = robot.built(tolerance)
        self.threads = 1  # that share the lanes
        self.step_s = step_s
        self.solve = solve
        self.heating = robot.heating()
        self._heating = thermal.constants(step_s, robot.limits.cut_off, self.heating)
        self.load = self.arm.load()
        """Gravity, and forces on the tips if any, see `loads`, of steps; may be changed between them."""
        self.rest, self.rest_report = self._rest(goal_size, scene_size)
        self.record = self.rest.rows(np.zeros(lanes, dtype=np.intp))

    def _rest(self, goal_size: int, scene_size: int) -> tuple[Record, Any]:
        """Return the one-lane record of the arm at ambient temperature, where episodes start, and its report (1,)."""
        ambient = np.full((1, self.heating.loss.size), self.heating.ambient)
        strain, tension, drive, load = (values[np.newaxis] for values in self.arm.unloaded())
        record = Record(
            temperature=ambient,
            power=np.zeros_like(ambient),
            energy=np.zeros(1),
            steps=np.zeros(1, dtype=np.int64),
            strain=strain,
            tension=tension,
            drive=drive,
            load=load,
            payload=self.arm.load()[np.newaxis, loads.PAYLOAD],
            tip=np.eye(4)[np.newaxis].copy(),
            length=np.zeros_like(tension),
            goal=np.zeros((1, goal_size)),
            scene=np.zeros((1, scene_size)),
        )
        report = self._solve(record, ambient.copy(), self.arm.load())
        if not solved(report).all():
            raise RuntimeError(f"the arm has no equilibrium at {self.heating.ambient:g} degC to start from")
        return record, report

    def _solve(self, record: Record, temperature: Array, external: Array, heat: Heat | None = None) -> Any:
        """Bring lanes to equilibrium at `temperature` (N, m), or at what `heat` makes of it; returns the report (N,).

        Where there is none, they stay as they are. `external` (loads.SIZE,) is their load but for their payloads.
        """
        load = np.empty((len(temperature), loads.SIZE))
        load[:] = external
        load[:, loads.PAYLOAD] = record.payload
        lanes = Lanes(record.strain, record.tension, record.drive, record.load, record.tip, record.length)
        report = self.solve(self.arm, lanes, temperature, load, self.threads, heat)
        good = solved(report)
        rows = slice(None) if good.all() else good
        record.temperature[rows] = temperature[rows]
        if heat is not None:
            record.power[rows] = heat.power[rows]
            record.energy[rows] += self.step_s * np.add.reduce(heat.power[rows], axis=1)
        return report

    def reset(self, lanes: NDArray[np.intp], goals: Array | float, scenes: Array | float) -> None:
        """Put lanes at rest with new goals (len(lanes), k) and scenes (len(lanes), s); nothing of their past remains."""
        self.record.assign(lanes, self.rest)
        self.record.goal[lanes] = goals
        self.record.scene[lanes] = scenes

    def step(self, action: Array) -> Any:
        """Heat for one step and find the equilibrium.

        Parameters
        ----------
        action : (N, m) array
            Heating power in [-1, 1]: none to full.

        Returns
        -------
        (N,) structured array
            Rung, residual, iterations and jumped of the solver, see `Equilibrium`. A lane without equilibrium stays as it was.
        """
        record = self.record
        power, temperature = np.empty_like(record.power), np.empty_like(record.temperature)
        action = np.ascontiguousarray(action, dtype=np.float64)
        record.steps += 1
        return self._solve(record, temperature, self.load, Heat(action, record.temperature, power, self._heating))

    def settle(self, temperature: Array, payload: Array | None = None) -> tuple[Record, NDArray[np.bool_]]:
        """Heat arms from rest to steady temperatures under their own load, as constant powers do.

        The way there is part of the answer: near 150 degC an arm with one hot TCA has several equilibria, because it can
        buckle to either side. Where the branch of equilibria ends on the way, so that the arm falls, it is in doubt which.

        Parameters
        ----------
        temperature : (N, n) array
            Steady temperatures of the arm's TCAs [degC]; others stay at ambient.
        payload : (4,) or (N, 4) array, optional
            Another payload than the arm's, see `Record.payload`.

        Returns
        -------
        tuple
            The settled lanes and whether each one's end is beyond doubt, (N,).
        """
        lanes = len(temperature)
        good = np.ones(lanes, dtype=bool)
        target = np.full((lanes, self.heating.loss.size), self.heating.ambient)
        target[:, : temperature.shape[1]] = temperature
        record = self.rest.rows(np.zeros(lanes, dtype=np.intp))
        if payload is not None:
            record.payload[:] = payload
        for done in RAMP:
            report = self._solve(record, self.heating.ambient + done * (target - self.heating.ambient), self.arm.load())
            good &= solved(report) & (~report["jumped"])
        return record, good
