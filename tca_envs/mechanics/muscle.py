"""Muscles: where they run in a module, and their laws (elongation as a function of tension and drive).

A law is one class here with three parts: a `kind`, the numbers that the compiled kernels read (`parameters`) and its formula
in `law`. Another muscle (an SMA wire, a pneumatic one) is one class and one formula more; nothing else changes.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import check
from tca_envs.mechanics.algebra import entry
from tca_envs.mechanics.packs import pointer_to_floats
from tca_envs.mechanics.traced import choose, size, traced, where
from tca_envs.mechanics.written import written

TENDON, SPRING, COIL = 0, 1, 2
PARAMETERS = 11

REFERENCE_LENGTH = 0.045
"""Rest length of the TCA that the paper's constants describe [m] (Sun & Zhao, section IV)."""


@entry
def elongation(kind, parameters, i, rest_length, tension, drive):
    """Elongation of a muscle over its rest length, and its derivatives (compiled).

    Parameters
    ----------
    kind : int
        Kind of the law: TENDON, SPRING or COIL.
    parameters : (n, PARAMETERS) array
        The laws' numbers.
    i : int
        Row of `parameters`.
    rest_length : float
        Path length in the module's reference configuration [m].
    tension : float
        Tension F [N], positive when it pulls.
    drive : float
        Temperature [degC] of a TCA, rest length [m] of a spring.

    Returns
    -------
    tuple of float
        Elongation [m], d elongation/d tension [m/N], d elongation/d drive. A tendon has no elongation law: zeros.
    """
    return law(kind, pointer_to_floats(parameters), PARAMETERS * i, rest_length, tension, drive)


@traced
def _within(tension, most):
    """Return the tension of the measured range, 0 to `most`, that is nearest."""
    return choose(tension, 0.0, 0.0, choose(most, tension, most, tension))


@traced
def law(kind, f, at, rest_length, tension, drive):
    """Return what `elongation` returns for kernels, of numbers or packs; the law's numbers begin at place `at` of `f`.

    All laws are computed, and the results of those that a muscle does not follow are dropped.
    """
    gain, compliance, g0, g1, g2 = f[at + 1], f[at + 2], f[at + 3], f[at + 4], f[at + 5]
    a, b, most, zero = f[at + 6], f[at + 7], f[at + 8], f[at + 9]
    # Erratum of eqs. (23), (24): tension lengthens the coil, hence "+ C F/G_t".
    scale = rest_length / f[at]
    x, x0 = drive - zero, f[at + 10] - zero
    heated = gain * ((a * x + b) * x - (a * x0 + b) * x0)
    # Beyond the measured range the tangent at its end continues the curve: the law stays monotone.
    inside = _within(tension, most)
    modulus = g0 + (g1 + g2 * inside) * inside
    slope = compliance * (g0 - g2 * inside * inside) / (modulus * modulus)
    stretch = compliance * inside / modulus + slope * (tension - inside)
    coil, spring, rate = kind == COIL, kind == SPRING, 1.0 / f[at]
    return (
        where(coil, scale * (heated + stretch), where(spring, drive + tension * rate - rest_length, 0.0)),
        where(coil, scale * slope, where(spring, rate, 0.0)),
        where(coil, scale * (gain * (2.0 * a * x + b)), where(spring, 1.0, 0.0)),
    )


@written
def pull(kind, f, at, rest_length, length, drive, guess):
    """Return the tension [N] at which a muscle, no tendon, has a path length [m]: Newton, for elongation grows with tension."""
    tension = guess
    for _ in range(60):
        delta, softness, _ = law(kind, f, at, rest_length, tension, drive)
        step = (length - rest_length - delta) / softness
        tension += step
        if size(step) <= 1e-14 + 1e-13 * size(tension):
            break
    return tension


@written
def stored(kind, f, at, rest_length, tension, length):
    """Return the energy [J] in a muscle at a tension: int F dl over the lengths, which is int f (dl/df) df; F l of a tendon."""
    energy = tension * length
    if kind != TENDON:
        # Simpson's rule inside the measured range; the law is linear outside.
        inside = _within(tension, f[at + 8]) if kind == COIL else tension
        h, total = inside / 32.0, 0.0
        for k in range(33):
            weight = 1.0 if (k == 0) | (k == 32) else (4.0 if k % 2 == 1 else 2.0)
            _, softness, _ = law(kind, f, at, rest_length, k * h, 0.0)
            total += weight * k * h * softness
        _, softness, _ = law(kind, f, at, rest_length, tension, 0.0)
        energy = total * h / 3.0 + 0.5 * softness * (tension * tension - inside * inside)
    return energy


class Law(Protocol):
    """What a module asks of a muscle law."""

    kind: ClassVar[int]
    """Branch of `elongation`."""

    def parameters(self) -> NDArray[np.float64]:
        """Return the law's numbers, (PARAMETERS,), as `elongation` reads them."""

    def drive_range(self) -> tuple[float, float]:
        """Return the smallest and the largest drive that the law accepts."""

    def neutral_drive(self, rest_length: float) -> float:
        """Return the drive at which a muscle of rest length `rest_length` [m] carries nothing at that length."""


def _pack(*values: float) -> NDArray[np.float64]:
    return np.array(values + (0.0,) * (PARAMETERS - len(values)))


@dataclass(frozen=True)
class Tendon:
    """A tendon whose tension [N] is the drive; it does not push."""

    kind: ClassVar[int] = TENDON

    def parameters(self) -> NDArray[np.float64]:
        """Return no numbers: the drive is the tension."""
        return _pack()

    def drive_range(self) -> tuple[float, float]:
        """Return the range of tensions [N]."""
        return 0.0, np.inf

    def neutral_drive(self, rest_length: float) -> float:
        """Return zero tension [N]."""
        return 0.0


@dataclass(frozen=True)
class Spring:
    """A linear spring whose rest length [m] is the drive.

    Parameters
    ----------
    rate : float
        Spring rate [N/m].
    """

    rate: float
    kind: ClassVar[int] = SPRING

    def __post_init__(self) -> None:
        check.scalar("rate", self.rate, 0.0, above=True)

    def parameters(self) -> NDArray[np.float64]:
        """Return the rate."""
        return _pack(self.rate)

    def drive_range(self) -> tuple[float, float]:
        """Return the range of rest lengths [m]."""
        return 0.0, np.inf

    def neutral_drive(self, rest_length: float) -> float:
        """Return the path length [m]."""
        return rest_length


@dataclass(frozen=True)
class TCA:
    """Twisted-and-coiled actuator: delta = A (f(T) - f(25 degC)) + C F/G_t(F), eqs. (23), (24) with their errata.

    T is the drive [degC], F the tension [N], f(x) = a x^2 + b x the thermal untwist of the fibre and
    G_t(F) = g0 + g1 F + g2 F^2 its shear modulus. A and C are those of a 45 mm muscle and scale with the rest length.
    Outside 0..`max_tension` the curve goes on with its tangent: below zero the coil is slack and carries almost nothing.

    Parameters
    ----------
    untwist_gain : float
        A of a 45 mm muscle [m^2]: 144.5 mm of fibre, coil radius 0.3725 mm, pitch angle 18.14 deg.
    compliance_gain : float
        C of a 45 mm muscle [1/m].
    modulus : tuple of float
        g0 [Pa], g1 [Pa/N], g2 [Pa/N^2]. The paper prints -g2 and 0.85 MPa: a misprint, see docs/model.md.
    untwist : tuple of float
        a [rad/m/K^2], b [rad/m/K] (paper, section II.C).
    max_tension : float
        End of the measured range [N]; the muscle breaks at 0.78 N.
    temperature_offset : float
        Subtracted from T in f [K]: 0, or 25 in the authors' own figures.
    reference_temperature : float
        Temperature without elongation [degC].

    See Also
    --------
    TCA.hardware : the measured set (the default).
    TCA.paper : the set behind the paper's Fig. 4.
    """

    untwist_gain: float = 5.116e-5
    compliance_gain: float = 2.3725e6
    modulus: tuple[float, float, float] = (20.85e6, 111.33e6, -37.58e6)
    untwist: tuple[float, float] = (-0.0161, 0.3338)
    max_tension: float = 0.8
    temperature_offset: float = 0.0
    reference_temperature: float = 25.0
    kind: ClassVar[int] = COIL

    def __post_init__(self) -> None:
        check.scalar("untwist_gain", self.untwist_gain, 0.0)
        check.scalar("compliance_gain", self.compliance_gain, 0.0, above=True)
        check.scalar("max_tension", self.max_tension, 0.0, above=True)
        check.scalar("temperature_offset", self.temperature_offset)
        check.scalar("reference_temperature", self.reference_temperature, -20.0, 300.0)
        check.array("untwist", self.untwist, (2,))
        g0, g1, g2 = check.array("modulus", self.modulus, (3,))
        # d(F/G)/dF = (g0 - g2 F^2)/G^2: a law that turns over has no unique tension.
        tension = np.linspace(0.0, self.max_tension, 257)
        if (g0 + g1 * tension + g2 * tension**2 <= 0.0).any() or g0 <= g2 * self.max_tension**2:
            raise ValueError(
                f"modulus = {self.modulus!r}: expected G_t > 0 and F/G_t(F) increasing up to max_tension = "
                f"{self.max_tension!r} N; this law turns over, so its tension would not be unique"
            )

    @classmethod
    def hardware(cls) -> "TCA":
        """Return the measured set."""
        return cls()

    @classmethod
    def paper(cls) -> "TCA":
        """Return the set behind the paper's Fig. 4: A = 2.1e-5 m^2 and the argument T - 25 in f."""
        return cls(untwist_gain=2.1e-5, temperature_offset=25.0)

    def parameters(self) -> NDArray[np.float64]:
        """Return the numbers in the order that `elongation` reads."""
        return _pack(
            REFERENCE_LENGTH, self.untwist_gain, self.compliance_gain, *self.modulus, *self.untwist,
            self.max_tension, self.temperature_offset, self.reference_temperature,
        )  # fmt: skip

    def drive_range(self) -> tuple[float, float]:
        """Return the range of temperatures [degC]."""
        return -20.0, 300.0

    def neutral_drive(self, rest_length: float) -> float:
        """Return the temperature without elongation [degC]."""
        return self.reference_temperature

    def elongation(self, tension: float, temperature: float, rest_length: float = REFERENCE_LENGTH) -> float:
        """Return the elongation [m] at a tension [N] and a temperature [degC], for a rest length [m]."""
        return float(elongation(COIL, self.parameters()[np.newaxis], 0, rest_length, tension, temperature)[0])


@dataclass(frozen=True)
class Muscle:
    """A muscle's route in its module, r(s) = offset (cos a, sin a, 0) with a = angle + 2 pi turns s/L, and its law.

    Parameters
    ----------
    offset : float
        Distance from the centerline [m].
    angle : float
        Angle at the module's base [rad].
    turns : float
        Helical turns over the module, signed; 0 is a straight muscle.
    law : Law
        `TCA`, `Tendon` or `Spring`.
    """

    offset: float
    angle: float
    turns: float
    law: Law

    def __post_init__(self) -> None:
        check.scalar("offset", self.offset, 0.0)
        check.scalar("angle", self.angle)
        check.scalar("turns", self.turns, -1000.0, 1000.0)
        if isinstance(self.law, type) or not isinstance(getattr(self.law, "kind", None), int):
            raise ValueError(f"law = {self.law!r}: expected a muscle law such as TCA(), Tendon() or Spring(rate)")
