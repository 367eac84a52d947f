"""The result of a solve."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import check
from tca_envs.mechanics.rungs import NEUTRAL, Rung
from tca_envs.mechanics.solver import Model

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """An equilibrium of an arm, as `Arm.equilibrium` returns it.

    Attributes
    ----------
    tip_pose : (4, 4) array
        Pose of the last cross section in the base frame [m].
    tensions : (n,) array
        Muscle tensions [N], positive when they pull.
    muscle_lengths : (n,) array
        Muscle path lengths [m].
    drive : (n,) array
        The drives: temperature [degC], tension [N] or rest length [m].
    converged : bool
        Whether this is an equilibrium at the asked drive and load. Otherwise the shape is that of the start.
    rung : Rung
        Which rung of the ladder answered. The paper's shooting knows none: WARM or FAILED.
    jumped : bool
        Whether the start's branch of equilibria ends on the way to the asked drive and load, and the arm fell to another one
        and would not come back on the same way (a fold, a snap-through). Answers without a jump are on the start's branch.
    residual : float
        Dimensionless: the largest of |moment imbalance| L/EI (an angle over the module; GJ in torsion), |force
        imbalance|/GA (a strain; EA along the axis) and |muscle length mismatch|/rest length over all nodes and muscles.
        The paper's shooting scales its own. Where nothing was found, that of the last try.
    iterations : int
        Newton iterations (evaluations of the residual for shooting).
    message : str
        What happened: why the rungs before the one that answered did not.
    """

    tip_pose: Array
    tensions: Array
    muscle_lengths: Array
    drive: Array
    converged: bool
    rung: Rung
    jumped: bool
    residual: float
    iterations: int
    message: str
    length: float = field(repr=False)
    load: Array = field(repr=False)
    known: tuple[Array, Array] = field(repr=False)
    """Drive and load at which this shape is in equilibrium: where none was found, not those asked but the start's."""
    sample: Callable[[Array], tuple[Array, Array]] = field(repr=False)
    """Arc positions (k,) -> poses (k, 4, 4), strains (k, 6)."""
    differentiate: Callable[[], Array] = field(repr=False)
    """() -> d(tip position, tip rotation vector)/d drive (6, n)."""
    certify: Callable[[], float] = field(repr=False)
    """() -> `stability`."""
    nodes: tuple[Model, Array] | None = field(default=None, repr=False)
    """The arm's compiled model and the strains at its nodes: what a warm start reads."""

    def poses(self, s: ArrayLike) -> Array:
        """Return the poses (len(s), 4, 4) of the cross sections at arc positions `s` in [0, length] of the unloaded arm [m]."""
        return self.sample(self._arc(s))[0]

    def strain(self, s: ArrayLike) -> Array:
        """Return the strains (len(s), 6), [u; v] in the body frame [1/m, 1], at `s` [m]; at a joint, those beyond it."""
        return self.sample(self._arc(s))[1]

    def centerline(self, points: int = 50) -> Array:
        """Return `points` positions (points, 3) [m] evenly spaced along the arm, base to tip."""
        if not isinstance(points, int | np.integer) or points < 2:
            raise ValueError(f"points = {points!r}: expected an integer of at least 2")
        return self.poses(np.linspace(0.0, self.length, points))[:, :3, 3]

    @cached_property
    def tip_jacobian(self) -> Array:
        """d(tip position [m], tip rotation vector [rad])/d drive, (6, n); the rotation is that added in the base frame."""
        return self.differentiate()

    @cached_property
    def stability(self) -> float:
        """Smallest eigenvalue lambda of T x = lambda K x, dimensionless: positive at a stable equilibrium.

        T is the second variation of the total energy in the strain x, the muscles' tensions following from their lengths, and K
        the rod's stiffness, eq. (3): 1 for the unloaded rod, 0 at a fold or a bifurcation. It is also the rate at which a
        disturbance of a rod with viscosity K (in units of time) dies out. A tip moment has no potential: T is that of its work
        then, not symmetric, and the criterion that of static instability (divergence).
        """
        return self.certify()

    @property
    def stable(self) -> bool:
        """Whether this equilibrium is stable: `stability` > 0; or 0 within 1e-5, as where an arm can turn without any work."""
        return self.stability > -NEUTRAL

    def _arc(self, s: ArrayLike) -> Array:
        positions = check.array("s", [s] if isinstance(s, int | float) else s, (None,))
        if positions.size and (positions.min() < 0.0 or positions.max() > self.length * (1.0 + 1e-12)):
            raise ValueError(f"s = {s!r}: expected arc positions in [0, {self.length:g}] m")
        return np.minimum(positions, self.length)
