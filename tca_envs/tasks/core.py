"""The clock of every environment: heat -> solve -> observe, for N lanes at once.

A lane is one arm in one episode. Everything that it owns is a row of the arrays of a `Record`, its warm start included, so a
copy of the rows is a snapshot, and equal rows under equal actions stay equal.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import Arm, thermal
from tca_envs.mechanics.collocation import FAILED, solve_lanes
from tca_envs.mechanics.thermal import HARD_LIMIT, Heater

Array = NDArray[np.float64]

STEP_S = 0.1
"""Duration of a step [s]."""
CUT_OFF = HARD_LIMIT - 2.0
"""Temperature [degC] that the heaters' firmware never lets a TCA exceed."""

RAMPS = (5, 16)
"""Coarse and fine steps in which `Core.settle` heats."""
SAME_TIP = 1e-5
"""Tips within this distance [m] are the same equilibrium."""


@dataclass
class Record:
    """N lanes of an arm with n muscles."""

    temperature: Array
    """(N, n) [degC]."""
    power: Array
    """(N, n) heating power of the last step after the cut-off [W]."""
    energy: Array
    """(N,) electrical energy since the episode's start [J]."""
    strain: Array
    """(N, G, 6) strain at the arm's nodes: the warm start."""
    tension: Array
    """(N, n) [N]."""
    drive: Array
    """(N, n) temperatures at which strain and tension are in equilibrium [degC]."""
    load: Array
    """(N, LOAD) load at which they are."""
    tip: Array
    """(N, 4, 4) pose of the tip [m]."""
    length: Array
    """(N, n) path lengths of the muscles [m]."""
    goal: Array
    """(N, k) the task's goal."""

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


class Core:
    """N lanes of one arm.

    Parameters
    ----------
    arm : Arm
        Its muscles are TCAs.
    heater : Heater
        Thermal constants of a 45 mm TCA.
    lanes : int
        N.
    goal_size : int
        Numbers in the task's goal.
    """

    def __init__(self, arm: Arm, heater: Heater, lanes: int, goal_size: int) -> None:
        self.arm = arm
        self.heating = heater.scaled(arm.rest_lengths)
        self._load = arm.load()[np.newaxis]
        self.rest, self.rest_report = self._rest(goal_size)
        self.record = self.rest.rows(np.zeros(lanes, dtype=np.intp))

    def _rest(self, goal_size: int) -> tuple[Record, Array]:
        """Return the one-lane record of the arm at ambient temperature, where every episode starts, and its solve (1, 3)."""
        n = len(self.arm.muscles)
        temperature = np.full((1, n), self.heating.ambient)
        strain, tension, drive, load = (values[np.newaxis] for values in self.arm.unloaded())
        tip, length = np.eye(4)[np.newaxis].copy(), np.zeros((1, n))
        record = Record(
            temperature,
            np.zeros((1, n)),
            np.zeros(1),
            strain,
            tension,
            drive,
            load,
            tip,
            length,
            np.zeros((1, goal_size)),
        )
        report = self._solve(record, temperature.copy())
        if report[0, 0] == FAILED:
            raise RuntimeError(f"the arm has no equilibrium at {self.heating.ambient:g} degC to start from")
        return record, report

    def _solve(self, record: Record, temperature: Array) -> Array:
        """Bring lanes to equilibrium at `temperature`; where there is none, keep them as they are. Returns (N, 3)."""
        report = np.empty((len(temperature), 3))
        load = np.repeat(self._load, len(temperature), axis=0)
        solve_lanes(
            self.arm.model, record.strain, record.tension, record.drive, record.load, temperature, load,
            record.tip, record.length, report,
        )  # fmt: skip
        good = report[:, 0] != FAILED
        record.temperature[good] = temperature[good]
        return report

    def reset(self, lanes: NDArray[np.intp], goals: Array) -> None:
        """Put lanes at rest with new goals (len(lanes), k); nothing of their past remains."""
        self.record.assign(lanes, self.rest)
        self.record.goal[lanes] = goals

    def step(self, action: Array) -> Array:
        """Heat for one step and find the equilibrium.

        Parameters
        ----------
        action : (N, n) array
            Heating power in [-1, 1]: none to full.

        Returns
        -------
        (N, 3) array
            Rung, residual, iterations of the solver, see `solve_lanes`. A lane without equilibrium stays as it was.
        """
        record, heating = self.record, self.heating
        asked = 0.5 * (np.clip(action, -1.0, 1.0) + 1.0) * heating.max_power
        allowed = thermal.power_to_reach(record.temperature, CUT_OFF, STEP_S, heating)
        power = np.minimum(asked, np.maximum(allowed, 0.0))
        report = self._solve(record, thermal.step(record.temperature, power, STEP_S, heating))
        good = report[:, 0] != FAILED
        record.power[good] = power[good]
        record.energy[good] += power[good].sum(axis=1) * STEP_S
        return report

    def settle(self, temperature: Array) -> tuple[Record, NDArray[np.bool_]]:
        """Heat arms from rest to steady temperatures, as constant powers do.

        The way there is part of the answer: near 150 degC an arm with one hot TCA has several equilibria, because it can
        buckle to either side. Each way is taken in coarse and in fine steps; where these end apart, so could an arm.

        Parameters
        ----------
        temperature : (N, n) array
            Steady temperatures [degC].

        Returns
        -------
        tuple
            The settled lanes and whether each one's end is beyond doubt, (N,).
        """
        good = np.ones(len(temperature), dtype=bool)
        tips = []
        for steps in RAMPS:
            record = self.rest.rows(np.zeros(len(temperature), dtype=np.intp))
            for done in np.arange(1, steps + 1) / steps:
                report = self._solve(record, self.heating.ambient + done * (temperature - self.heating.ambient))
                good &= report[:, 0] != FAILED
            tips.append(record.tip[:, :3, 3])
        good &= np.linalg.norm(tips[0] - tips[1], axis=1) < SAME_TIP
        return record, good
