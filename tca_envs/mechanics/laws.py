"""Muscle laws: elongation as a function of tension and drive.

A law is a class, with a `kind`, the numbers that its formula reads (`parameters`) and the range of its drive, and a branch of
`elongation`, which is the same text for Python's floats and for the compiled kernels. A new law is a class and a branch.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import check

TENDON, SPRING, COIL = KINDS = 0, 1, 2
"""Kinds of laws."""
LENGTH, GAIN, COMPLIANCE, G0, G1, G2, UNTWIST_2, UNTWIST_1, MAX_TENSION, OFFSET, REFERENCE = range(11)
"""Places of a TCA's numbers in a row of a table of laws ..."""
RATE = 0
"""... and of a spring's."""
PARAMETERS = 11
"""Numbers in a row."""

REFERENCE_LENGTH = 0.045
"""Rest length of the TCA that the paper's constants describe [m] (Sun & Zhao, section IV)."""


def elongation(kind: int, law: Any, i: int, rest_length: Any, tension: Any, drive: Any) -> tuple[Any, Any, Any]:
    """Elongation of a muscle over its rest length, and its derivatives.

    Parameters
    ----------
    kind : int
        TENDON, SPRING or COIL; a tendon has no elongation law: zeros.
    law : (n, PARAMETERS) array
        The laws' numbers.
    i : int
        Row of `law`.
    rest_length : float
        Path length in the module's reference configuration [m].
    tension : float
        Tension F [N], positive when it pulls.
    drive : float
        Temperature [degC] of a TCA, rest length [m] of a spring.

    Returns
    -------
    tuple of float
        Elongation [m], d elongation/d tension [m/N], d elongation/d drive.
    """
    if kind == COIL:
        return coil(law, i, rest_length, tension, drive)
    if kind == SPRING:
        rate = law[i, RATE]
        return drive + tension / rate - rest_length, 1.0 / rate, 1.0
    return 0.0, 0.0, 0.0


def coil(law: Any, i: int, rest_length: Any, tension: Any, drive: Any) -> tuple[Any, Any, Any]:
    """Return `elongation` of a TCA, eqs. (23), (24), "+ C F/G_t" by their erratum: tension lengthens the coil."""
    scale = rest_length / law[i, LENGTH]
    a, b, x, x0 = law[i, UNTWIST_2], law[i, UNTWIST_1], drive - law[i, OFFSET], law[i, REFERENCE] - law[i, OFFSET]
    heated = law[i, GAIN] * ((a * x + b) * x - (a * x0 + b) * x0)
    # Beyond the measured range the tangent at its end continues the curve: the law stays monotone.
    inside = min(max(tension, 0.0), law[i, MAX_TENSION])
    g0, g2, compliance = law[i, G0], law[i, G2], law[i, COMPLIANCE]
    modulus = g0 + (law[i, G1] + g2 * inside) * inside
    slope = compliance * (g0 - g2 * inside * inside) / (modulus * modulus)
    stretched = compliance * inside / modulus + slope * (tension - inside)
    return scale * (heated + stretched), scale * slope, scale * law[i, GAIN] * (2.0 * a * x + b)


def stored_energy(kind: int, law: Any, i: int, rest_length: Any, tension: Any, length: Any) -> Any:
    """Return the energy [J] in a muscle at a tension: int F dl over the lengths, which is int f (dl/df) df; F l of a tendon."""
    if kind == TENDON:
        return tension * length
    # No law's dl/df depends on the drive.
    # Simpson's rule inside the measured range; the law is linear outside.
    inside = min(max(tension, 0.0), law[i, MAX_TENSION]) if kind == COIL else tension
    h, total, nothing = inside / 32.0, 0.0, 0.0 * tension
    for k in range(33):
        weight = 1.0 if k == 0 or k == 32 else (4.0 if k % 2 == 1 else 2.0)
        _delta, softness, _slope = elongation(kind, law, i, rest_length, k * h, nothing)
        total += weight * k * h * softness
    _delta, softness, _slope = elongation(kind, law, i, rest_length, tension, nothing)
    return total * h / 3.0 + 0.5 * softness * (tension * tension - inside * inside)


class Law(Protocol):
    """What a module asks of a muscle law."""

    kind: ClassVar[int]  # branch of `elongation`

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
        return float(coil(self.parameters()[np.newaxis], 0, rest_length, tension, temperature)[0])
