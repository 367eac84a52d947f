"""The clock of every environment: heat -> solve -> observe, for N lanes at once.

A lane is one arm in one episode. Everything that it owns is a row of the arrays of a `Record`, its warm start included, so a
copy of the rows is a snapshot, and equal rows under equal actions stay equal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import Arm, ladder, thermal
from tca_envs.mechanics.collocation import Heat
from tca_envs.mechanics.kernels import FAILED, LOAD, PAYLOAD_MASS, REPORT
from tca_envs.mechanics.thermal import HARD_LIMIT, Heater

Array = NDArray[np.float64]

STEP_S = 0.1
"""Duration of a step [s]."""
CUT_OFF = HARD_LIMIT - 2.0
"""Temperature [degC] that the heaters' firmware never lets a TCA exceed."""

RAMP = (0.4, 0.7, 0.85, 0.99, 1.0)
"""Shares of the way in which `Core.settle` heats. The hotter, the more the arm bends: longer steps there take the solver
longer, and it doubts that it is on the branch that it began on. The last one is short, so that little is left of Newton's
residual."""


@dataclass
class Record:
    """N lanes of an arm with n muscles, and of m >= n heated TCAs: the arm's come first."""

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
    """(N, LOAD) load at which they are."""
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


def solved(report: Array) -> NDArray[np.bool_]:
    """Return which lanes of a report (..., REPORT) of `Core.step` have an equilibrium."""
    return np.asarray(report[..., 0] != FAILED)


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
    goal_size, scene_size : int
        Numbers in the task's goal and scene.
    others : sequence of float
        Rest lengths of heated TCAs that are not the arm's [m].
    """

    def __init__(
        self, arm: Arm, heater: Heater, lanes: int, goal_size: int, scene_size: int = 0, others: Sequence[float] = ()
    ) -> None:
        self.arm = arm
        self.threads = 1  # that share the lanes
        self.heating = heater.scaled(np.append(arm.rest_lengths, others))
        self._heating = thermal.constants(STEP_S, CUT_OFF, self.heating)
        self.load = arm.load()
        """Gravity, and forces on the tips if any, as `kernels.LOAD` numbers, of steps; may be changed between them."""
        self.rest, self.rest_report = self._rest(goal_size, scene_size)
        self.record = self.rest.rows(np.zeros(lanes, dtype=np.intp))

    def _rest(self, goal_size: int, scene_size: int) -> tuple[Record, Array]:
        """Return the one-lane record of the arm at ambient temperature, where episodes start, and its report (1, REPORT)."""
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
            payload=self.arm.load()[np.newaxis, PAYLOAD_MASS:],
            tip=np.eye(4)[np.newaxis].copy(),
            length=np.zeros_like(tension),
            goal=np.zeros((1, goal_size)),
            scene=np.zeros((1, scene_size)),
        )
        report = self._solve(record, ambient.copy(), self.arm.load())
        if not solved(report).all():
            raise RuntimeError(f"the arm has no equilibrium at {self.heating.ambient:g} degC to start from")
        return record, report

    def _solve(self, record: Record, temperature: Array, external: Array, heat: Heat | None = None) -> Array:
        """Bring lanes to equilibrium at `temperature` (N, m), or at what `heat` makes of it; returns the report (N, REPORT).

        Where there is none, they stay as they are. `external` (LOAD,) is their load but for their payloads.
        """
        report = np.empty((len(temperature), REPORT))
        load = np.empty((len(temperature), LOAD))
        load[:] = external
        load[:, PAYLOAD_MASS:] = record.payload
        ladder.solve(
            self.arm, record.strain, record.tension, record.drive, record.load, temperature, load,
            record.tip, record.length, report, self.threads, heat,
        )  # fmt: skip
        good = solved(report)
        rows = slice(None) if good.all() else good
        record.temperature[rows] = temperature[rows]
        if heat is not None:
            record.power[rows] = heat.power[rows]
            record.energy[rows] += STEP_S * np.add.reduce(heat.power[rows], axis=1)
        return report

    def reset(self, lanes: NDArray[np.intp], goals: Array | float, scenes: Array | float) -> None:
        """Put lanes at rest with new goals (len(lanes), k) and scenes (len(lanes), s); nothing of their past remains."""
        self.record.assign(lanes, self.rest)
        self.record.goal[lanes] = goals
        self.record.scene[lanes] = scenes

    def step(self, action: Array) -> Array:
        """Heat for one step and find the equilibrium.

        Parameters
        ----------
        action : (N, m) array
            Heating power in [-1, 1]: none to full.

        Returns
        -------
        (N, REPORT) array
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
            good &= solved(report) & (report[:, 3] == 0.0)
        return record, good
