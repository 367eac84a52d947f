"""The paper's Figs. 3 to 6 redrawn with the published points, and where model and paper agree.

Source: J. Sun and J. Zhao, "Modeling and Simulation of Soft Robots driven by Artificial Muscles: an Example using
Twisted-and-Coiled Actuators" ("the paper"), section IV.A.

The scene of Figs. 4 and 5 is the paper's: the bending module alone, hanging under its own weight, nothing below it. The
paper prints neither the module's weight nor all constants of its TCAs, so each figure is computed for several cases
(`CASES`): the hardware set and the paper set of the TCA's constants with the module's estimated weight, and the paper set
with the weight rho A L that eq. (9) gives for the effective section. What the weight and the rest of the arm change is a
table of its own. Fig. 6, which has no published points, is computed by `sequence`.

Sweeps are warm-started. Where no equilibrium is found the curve has a gap (NaN) and `agreement.md` says where.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import isfinite, isnan, nan, pi
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs import presets
from tca_envs.mechanics import TCA, Arm, Equilibrium, Payload
from tca_envs.mechanics.thermal import AMBIENT as ROOM
from tca_envs.study import output, sequence

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]


class Points(NamedTuple):
    """Published points of a curve, read off the paper's plot."""

    x: tuple[float, ...]
    """Force [N] or temperature [degC]."""
    y: tuple[float, ...]
    """Elongation or displacement of the tip along x [mm]."""


PUBLISHED_ELONGATION = Points((0.05, 0.1, 0.2, 0.4, 0.8), (4.51, 7.51, 11.40, 15.98, 22.10))
"""Paper, Fig. 3, predicted curve: passive elongation [mm] of a 45 mm TCA over its force [N]."""
PUBLISHED_WITH = Points((60, 80, 100, 120, 140, 159), (-0.55, -1.84, -3.64, -5.90, -8.64, -11.86))
"""Paper, Fig. 4, with the passive TCA: tip x [mm] over the temperature of TCA 2 and 3 [degC]."""
PUBLISHED_WITHOUT = Points((70, 110, 125, 140, 150, 160), (-1.94, -7.95, -10.8, -13.9, -16.0, -18.2))
"""Paper, Fig. 4, without the passive TCA: tip x [mm] over the temperature of TCA 2 and 3 [degC]."""
PUBLISHED_STIFFNESS = {
    75: Points((0.01, 0.02, 0.03, 0.04, 0.05), (3.45, 6.97, 10.3, 13.2, 15.6)),
    125: Points((0.01, 0.02, 0.03, 0.04, 0.05), (1.53, 3.08, 4.7, 6.28, 7.94)),
    150: Points((0.01, 0.02, 0.03, 0.04, 0.05), (0.11, 0.35, 0.68, 1.03, 1.47)),
}
"""Paper, Fig. 5: tip x [mm] over the force along x [N] at a temperature of all three TCAs [degC]."""
PUBLISHED_RATIO = 1.4
"""Paper, section IV.A: without the passive TCA the bending is "more than 40 %" larger."""

ABSOLUTE_TOLERANCE = 0.3
"""[mm]: about what can be read off the paper's plots."""
RELATIVE_TOLERANCE = 0.1

ECOFLEX_DENSITY = 1070.0
"""Ecoflex 00-30 [kg/m3] (manufacturer's data sheet: specific gravity 1.07)."""
EFFECTIVE_MASS = ECOFLEX_DENSITY * pi / 4.0 * presets.BODY_DIAMETER**2 * presets.BENDING_LENGTH
"""rho A L of the bending module [kg], as eq. (9) weighs its effective section: 0.77 g."""

FORCES = np.linspace(0.0, 0.8, 81)
"""Fig. 3 [N]."""
TEMPERATURES = np.linspace(25.0, 160.0, 136)
"""Fig. 4 [degC]."""
TIP_FORCES = np.linspace(0.0, 0.05, 51)
"""Fig. 5 [N]."""
STIFFNESS_TEMPERATURES = (75.0, 100.0, 125.0, 150.0)
"""Fig. 5 [degC]."""
PASSIVE = 0
"""Index of TCA 1, which stays at room temperature in Fig. 4."""
SMALLEST_ANGLE = 1.0
"""[deg]: a ratio to a smaller bend angle says nothing."""


@dataclass(frozen=True)
class Case:
    """A set of the TCA's constants and what the bending module carries.

    Parameters
    ----------
    name : str
        In figures and tables.
    law : TCA
        The parameter set.
    mass : float
        Of the bending module [kg].
    payload : Payload, optional
        What hangs from the module's tip.
    """

    name: str
    law: TCA
    mass: float = presets.BENDING_MASS
    payload: Payload | None = None


HARDWARE = Case("hardware set", TCA.hardware())
PAPER = Case("paper set", TCA.paper())
PAPER_EFFECTIVE = Case("paper set, weight of eq. (9)", TCA.paper(), EFFECTIVE_MASS)
CASES = (HARDWARE, PAPER, PAPER_EFFECTIVE)


@dataclass(frozen=True, eq=False)
class Elongation:
    """Fig. 3 for one case: passive elongation of a 45 mm TCA."""

    case: Case
    force: Array
    """(k,) [N]."""
    elongation: Array
    """(k,) [mm]."""


@dataclass(frozen=True, eq=False)
class Bending:
    """Fig. 4 for one case: TCA 2 and 3 heated, with the passive TCA 1 and with it left out."""

    case: Case
    temperature: Array
    """Of TCA 2 and 3 (k,) [degC]."""
    tip_with: Array
    """Tip x with the passive TCA (k,) [mm]; NaN where no equilibrium was found, as in all of these."""
    tip_without: Array
    """Tip x without it (k,) [mm]."""
    angle_with: Array
    """Bend angle with the passive TCA (k,) [deg], see `bend_angle`."""
    angle_without: Array
    """Bend angle without it (k,) [deg]."""

    @property
    def ratio(self) -> Array:
        """Bend angle without over that with the passive TCA (k,); NaN where the latter is below `SMALLEST_ANGLE`."""
        large = np.where(np.abs(self.angle_with) < SMALLEST_ANGLE, nan, self.angle_with)
        return np.asarray(self.angle_without / large)


@dataclass(frozen=True, eq=False)
class Stiffness:
    """Fig. 5 for one case: a force along x at the tip, all three TCAs equally hot."""

    case: Case
    temperature: tuple[float, ...]
    """(t,) [degC]."""
    force: Array
    """(k,) [N]."""
    tip: Array
    """Tip x (t, k) [mm]; NaN where no equilibrium was found."""


def bending_arm(case: Case, removed: Sequence[int] = ()) -> Arm:
    """Return the bending module of `presets.bending_module` hanging under its own weight, without the muscles `removed`."""
    module = presets.bending_module(case.law)
    kept = [muscle for i, muscle in enumerate(module.muscles) if i not in removed]
    module = replace(module, muscles=kept, mass_per_length=case.mass / module.length)
    return Arm([module], presets.GRAVITY, case.payload)


def tip_poses(arm: Arm, drives: ArrayLike, tip_forces: ArrayLike, start: Equilibrium | None = None) -> Array:
    """Follow the arm along a path of drives and tip forces.

    Parameters
    ----------
    arm : Arm
        With n muscles.
    drives : (k, n) array
        Temperatures [degC].
    tip_forces : (k, 3) array
        In the base frame [N].
    start : Equilibrium, optional
        Where the first solve starts; by default the unloaded arm.

    Returns
    -------
    (k, 4, 4) array
        Poses of the tip [m]. Each solve starts from the last equilibrium; NaN where none was found.
    """
    steps = list(zip(np.asarray(drives), np.asarray(tip_forces), strict=True))
    poses = np.full((len(steps), 4, 4), nan)
    for pose, (drive, force) in zip(poses, steps, strict=True):
        equilibrium = arm.equilibrium(drive, tip_force=force, start=start)
        if equilibrium.converged:
            pose[:] = equilibrium.tip_pose
            start = equilibrium
    return poses


def bend_angle(poses: Array) -> Array:
    """Return the angles (k,) [deg] by which the tip has turned from the vertical, towards -x, along a path in the x-z plane.

    It is the angle between the tip's tangent and the vertical, counted on beyond 180 degrees where the tip curls further; at a
    free tip the tangent is the body's z axis.
    """
    angle = np.arctan2(-poses[:, 0, 2], poses[:, 2, 2])
    known = np.isfinite(angle)
    angle[known] = np.unwrap(angle[known])
    return np.asarray(np.degrees(angle))


def figure3(case: Case, force: Array = FORCES) -> Elongation:
    """Compute Fig. 3: eqs. (23), (24) with their errata at room temperature, force in [N]."""
    return Elongation(case, force, np.array([1e3 * case.law.elongation(f, ROOM) for f in force]))


def figure4(case: Case, temperature: Array = TEMPERATURES) -> Bending:
    """Compute Fig. 4: TCA 2 and 3 at `temperature` [degC], TCA 1 passive at room temperature or left out."""
    drives = np.stack([np.full_like(temperature, ROOM), temperature, temperature], axis=1)
    no_force = np.zeros((temperature.size, 3))
    poses = tip_poses(bending_arm(case), drives, no_force)
    without = tip_poses(bending_arm(case, [PASSIVE]), np.delete(drives, PASSIVE, axis=1), no_force)
    return Bending(case, temperature, 1e3 * poses[:, 0, 3], 1e3 * without[:, 0, 3], bend_angle(poses), bend_angle(without))


def figure5(case: Case, temperature: tuple[float, ...] = STIFFNESS_TEMPERATURES, force: Array = TIP_FORCES) -> Stiffness:
    """Compute Fig. 5: tip x over the force along x [N], all three TCAs at each `temperature` [degC]."""
    arm = bending_arm(case)
    along_x = np.outer(force, [1.0, 0.0, 0.0])
    tip = [1e3 * tip_poses(arm, np.full((force.size, 3), t), along_x)[:, 0, 3] for t in temperature]
    return Stiffness(case, temperature, force, np.array(tip))


# Agreement with the published points


@dataclass(frozen=True)
class Comparison:
    """Model and paper at one published point."""

    figure: int
    case: str
    curve: str
    """Which curve of the figure; empty where there is but one."""
    x: float
    """Force [N] or temperature [degC] of the point."""
    published: float
    """[mm]."""
    model: float
    """[mm], NaN where no equilibrium was found."""

    @property
    def difference(self) -> float:
        """Model minus paper [mm]."""
        return self.model - self.published

    @property
    def agrees(self) -> bool:
        """Whether the difference is within `ABSOLUTE_TOLERANCE` or `RELATIVE_TOLERANCE` of the published value."""
        return abs(self.difference) <= max(ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE * abs(self.published))


def value_at(x: Array, y: Array, at: float) -> float:
    """Return the entry of y where x is `at`; ValueError if x has no such entry."""
    index = int(np.argmin(np.abs(x - at)))
    if not np.isclose(x[index], at, rtol=1e-9):
        raise ValueError(f"at = {at:g}: expected one of the computed abscissas, {x[0]:g} to {x[-1]:g}")
    return float(y[index])


def compare(figure: int, case: Case, curve: str, published: Points, x: Array, y: Array) -> list[Comparison]:
    """Compare a computed curve y(x) with published points."""
    return [Comparison(figure, case.name, curve, a, b, value_at(x, y, a)) for a, b in zip(*published, strict=True)]


def compare3(data: Elongation) -> list[Comparison]:
    """Compare Fig. 3."""
    return compare(3, data.case, "", PUBLISHED_ELONGATION, data.force, data.elongation)


def compare4(data: Bending) -> list[Comparison]:
    """Compare Fig. 4."""
    return [
        *compare(4, data.case, "with passive TCA", PUBLISHED_WITH, data.temperature, data.tip_with),
        *compare(4, data.case, "without passive TCA", PUBLISHED_WITHOUT, data.temperature, data.tip_without),
    ]


def compare5(data: Stiffness) -> list[Comparison]:
    """Compare Fig. 5."""
    tips = dict(zip(data.temperature, data.tip, strict=True))
    return [
        comparison
        for t, published in PUBLISHED_STIFFNESS.items()
        for comparison in compare(5, data.case, f"{t} °C", published, data.force, tips[t])
    ]


def verdict(comparisons: Sequence[Comparison]) -> str:
    """Return in words whether a curve agrees: at all points, at half of them or more, or not."""
    total, agreeing = len(comparisons), sum(c.agrees for c in comparisons)
    missing = sum(isnan(c.model) for c in comparisons)
    words = "agrees" if agreeing == total else "agrees in part" if 2 * agreeing >= total else "does not agree"
    return f"{words} ({agreeing} of {total} points)" + (f"; no equilibrium at {missing}" if missing else "")


def gaps(name: str, unit: str, x: Array, y: Array) -> list[str]:
    """Return a line that says where a curve has no equilibrium, or nothing."""
    missing = x[np.isnan(y)]
    return [f"{name}: {', '.join(f'{value:g}' for value in missing)} {unit}"] if missing.size else []


def all_gaps(bendings: Iterable[Bending], stiffnesses: Iterable[Stiffness]) -> list[str]:
    """Return one line for each curve of Figs. 4 and 5 with solves that did not converge."""
    lines = []
    for b in bendings:
        for curve, tip in (("with", b.tip_with), ("without", b.tip_without)):
            lines += gaps(f"Fig. 4, {b.case.name}, {curve} passive TCA", "°C", b.temperature, tip)
    for s in stiffnesses:
        for t, tip in zip(s.temperature, s.tip, strict=True):
            lines += gaps(f"Fig. 5, {s.case.name}, {t:g} °C", "N", s.force, tip)
    return lines


class Claim(NamedTuple):
    """A statement of the paper, tested on one case."""

    text: str
    case: str
    found: str
    """What the model says."""
    holds: bool | None
    """None where missing equilibria leave it open."""


def decide(known: Array) -> bool | None:
    """Return whether all of `known` (1 true, 0 false, NaN missing) hold: False if one does not, else None if one is missing."""
    return False if (known == 0.0).any() else None if np.isnan(known).any() or not known.size else True


def above(values: Array, limit: float) -> Array:
    """Return 1 where values exceed `limit`, 0 where not, NaN where they are missing."""
    return np.where(np.isnan(values), nan, values > limit)


def claim_antagonism(data: Bending) -> Claim:
    """Test Fig. 4's statement on the bend angles from 60 degC up."""
    ratio = data.ratio[data.temperature >= 60.0]
    known = ratio[np.isfinite(ratio)]
    found = f"{100 * (known.min() - 1):.0f} % to {100 * (known.max() - 1):.0f} % larger from 60 °C up" if known.size else "--"
    text = "Fig. 4: without the passive TCA it bends more than 40 % more"
    return Claim(text, data.case.name, found, decide(above(ratio, PUBLISHED_RATIO)))


def stiffening(low: ArrayLike, high: ArrayLike) -> float:
    """Return by how much displacements shrink from `low` to `high` temperature, mean over the forces [%]."""
    return 100.0 * (1.0 - float(np.mean(np.asarray(high) / np.asarray(low))))


def claims_stiffness(data: Stiffness) -> list[Claim]:
    """Test Fig. 5's statements: hotter is stiffer, and by how much from 75 degC on."""
    decrease = -np.diff(data.tip[:, data.force > 0.0], axis=0)
    ordered = decide(above(decrease, 0.0))
    words = {
        True: "smaller displacement when hotter at every force",
        False: "not at every force",
        None: "so where there is an equilibrium",
    }
    claims = [Claim("Fig. 5: hotter is stiffer", data.case.name, words[ordered], ordered)]
    tips = dict(zip(data.temperature, data.tip, strict=True))
    first = PUBLISHED_STIFFNESS[75]
    reference = [value_at(data.force, tips[75], f) for f in first.x]
    for t in (125, 150):
        published = stiffening(first.y, PUBLISHED_STIFFNESS[t].y)
        model = stiffening(reference, [value_at(data.force, tips[t], f) for f in first.x])
        holds = None if isnan(model) else abs(model - published) <= 10.0
        text = f"Fig. 5: from 75 to {t} °C the displacement shrinks by {published:.0f} %"
        claims.append(Claim(text, data.case.name, f"{number(model, '.0f')} %", holds))
    return claims


def weights() -> list[tuple[str, str, float, float]]:
    """Compute what the weight changes.

    Returns
    -------
    list of tuple
        Set of constants, weight, tip x [mm] of Fig. 4 at 100 degC with the passive TCA and of Fig. 5 at 75 degC and 0.01 N.
    """
    rows = []
    for case in (HARDWARE, PAPER):
        for name, mass, payload in (
            ("none", 0.0, None),
            (f"of eq. (9), {1e3 * EFFECTIVE_MASS:.2f} g", EFFECTIVE_MASS, None),
            (f"module, {1e3 * presets.BENDING_MASS:.1f} g", presets.BENDING_MASS, None),
            (f"module and the rest of the arm, {1e3 * presets.BELOW_BENDING.mass:.1f} g more",
             presets.BENDING_MASS, presets.BELOW_BENDING),
        ):  # fmt: skip
            arm = bending_arm(replace(case, mass=mass, payload=payload))
            bent = tip_poses(arm, [[ROOM, 100.0, 100.0]], [[0.0, 0.0, 0.0]])
            pushed = tip_poses(arm, [[75.0] * 3], [[0.01, 0.0, 0.0]])
            rows.append((case.name, name, 1e3 * float(bent[0, 0, 3]), 1e3 * float(pushed[0, 0, 3])))
    return rows


def number(value: float, form: str = ".2f") -> str:
    """Return a number for a table, -- where it is missing."""
    return format(value, form) if isfinite(value) else "--"


def by_curve(comparisons: Iterable[Comparison]) -> dict[tuple[int, str, str], list[Comparison]]:
    """Return the comparisons of each figure, case and curve."""
    groups: dict[tuple[int, str, str], list[Comparison]] = {}
    for c in comparisons:
        groups.setdefault((c.figure, c.case, c.curve), []).append(c)
    return groups


def summary_table(comparisons: Sequence[Comparison]) -> str:
    """Return the table of verdicts, a line for each curve."""
    rows = []
    for (figure, case, curve), group in by_curve(comparisons).items():
        known = [c for c in group if isfinite(c.model)]
        worst = max(known, key=lambda c: abs(c.difference), default=None)
        rows.append(
            [
                f"Fig. {figure}",
                case,
                curve,
                "--" if worst is None else f"{worst.difference:+.2f} mm (paper {worst.published:.2f})",
                number(float(np.median([c.model / c.published for c in known])) if known else nan),
                verdict(group),
            ]
        )
    return output.markdown_table(
        ["Figure", "Case", "Curve", "Largest difference, model minus paper", "Median of model/paper", "Verdict"], rows
    )


def points_table(comparisons: Sequence[Comparison]) -> str:
    """Return the table of all published points, one column for each case."""
    units = {3: "N", 4: "°C", 5: "N"}
    lines: dict[tuple[int, str, float], dict[str, Comparison]] = {}
    for c in comparisons:
        lines.setdefault((c.figure, c.curve, c.x), {})[c.case] = c
    names = list(dict.fromkeys(c.case for c in comparisons))
    rows = [
        [
            f"Fig. {figure}",
            curve,
            f"{x:g} {units[figure]}",
            f"{next(iter(line.values())).published:.2f}",
            *(cell(line.get(name)) for name in names),
        ]
        for (figure, curve, x), line in lines.items()
    ]
    return output.markdown_table(["Figure", "Curve", "At", "Paper", *names], rows)


def cell(comparison: Comparison | None) -> str:
    """Return model value and difference for `points_table`; a star marks agreement."""
    if comparison is None:
        return ""
    if isnan(comparison.model):
        return "no equilibrium"
    return f"{comparison.model:.2f} ({comparison.difference:+.2f}){' *' if comparison.agrees else ''}"


def report(
    comparisons: Sequence[Comparison],
    claims: Sequence[Claim],
    weight_rows: Iterable[tuple[str, str, float, float]],
    missing: Sequence[str],
) -> str:
    """Return agreement.md."""
    at_100 = dict(zip(*PUBLISHED_WITH, strict=True))[100]
    at_75 = PUBLISHED_STIFFNESS[75].y[0]
    criteria = (
        f"Published points were read off the paper's plots. A point agrees if model and paper differ by at most "
        f"{ABSOLUTE_TOLERANCE:g} mm or {100 * RELATIVE_TOLERANCE:.0f} % of the published value, whichever is larger. A curve "
        f"agrees if all its points do, and in part if half of them do."
    )
    scene = (
        f"Figs. 4 and 5 show the bending module alone under its own weight. The cases: the hardware set and the paper set of "
        f"the TCA's constants with the module's estimated weight ({1e3 * presets.BENDING_MASS:.1f} g), and the paper set with "
        f"the weight rho A L that eq. (9) gives for the effective section ({1e3 * EFFECTIVE_MASS:.2f} g). Fig. 3 depends on "
        f"no weight."
    )
    caveat = (
        "Agreement is not always independent evidence: the polynomial of the coils' modulus, misprinted in the paper, is "
        "corrected so that Fig. 3 comes out; and the paper does not print A, while the paper set's argument T - 25 is inferred "
        "from Fig. 4."
    )
    antagonism = (
        "The statement on Fig. 4 is tested on bend angles. At low temperatures their ratio grows with the weight and says "
        "little of antagonism: with one TCA left out the other two carry the module off its axis, and it is bent when cold."
    )
    stiffening_note = (
        "Percentages of Fig. 5 are means over the forces of its published points; they hold if the model's lie within 10 "
        "percentage points."
    )
    weight_note = (
        f"Tip x in mm, in Fig. 4 with the passive TCA at 100 °C (paper: {at_100:.2f}), in Fig. 5 at 75 °C and 0.01 N "
        f"(paper: {at_75:.2f})."
    )
    answers = {True: "yes", False: "no", None: "open: equilibria are missing"}
    claim_rows = [[c.text, c.case, c.found, answers[c.holds]] for c in claims]
    weight_cells = [[name, weight, number(bent), number(pushed)] for name, weight, bent, pushed in weight_rows]
    parts = [
        "# Where model and paper agree",
        criteria,
        scene,
        caveat,
        "## Curves",
        summary_table(comparisons),
        "## Statements of the paper",
        antagonism,
        stiffening_note,
        output.markdown_table(["Statement", "Case", "Model", "Holds"], claim_rows),
        "## What the weight changes",
        weight_note,
        output.markdown_table(["Constants", "Weight", "Fig. 4", "Fig. 5"], weight_cells),
        "## Published points",
        "Values in mm, in brackets model minus paper; a star marks agreement.",
        points_table(comparisons),
        "## Solves without an equilibrium",
        "\n".join(f"* {line}" for line in missing) or "None.",
    ]
    return "\n\n".join(parts) + "\n"


# Drawing

COLOURS = {HARDWARE.name: "#0072B2", PAPER.name: "#D55E00", PAPER_EFFECTIVE.name: "#009E73"}
DASHES = {HARDWARE.name: "-", PAPER.name: "--", PAPER_EFFECTIVE.name: "-."}
MARKERS = {"marker": "o", "ls": "none", "ms": 5.0, "mfc": "white", "mew": 1.3, "zorder": 3, "clip_on": False}


def draw_published(axes: "Axes", points: Points, **options: object) -> None:
    """Draw published points as markers."""
    axes.plot(*points, **{"color": "black", **MARKERS, **options})  # type: ignore[arg-type]


def draw_case(axes: "Axes", case: Case, x: Array, y: Array) -> None:
    """Draw a model's curve in its case's line."""
    axes.plot(x, y, DASHES[case.name], color=COLOURS[case.name], linewidth=1.8, label=case.name)


def draw3(curves: Iterable[Elongation], path: Path) -> None:
    """Draw Fig. 3 into a PNG file."""
    figure, (axes,) = output.new_figure(1, 4.8, 3.6)
    for c in curves:
        draw_case(axes, c.case, c.force, c.elongation)
    draw_published(axes, PUBLISHED_ELONGATION, label="paper, Fig. 3")
    axes.set(xlabel="tension [N]", ylabel="passive elongation of a 45 mm TCA [mm]", xlim=(0.0, 0.82), ylim=(0.0, 24.0))
    axes.legend(loc="lower right", frameon=False)
    output.save_figure(figure, path)


def draw4(curves: Sequence[Bending], path: Path) -> None:
    """Draw Fig. 4 into a PNG file: tip x with and without the passive TCA, and the ratio of bend angles."""
    figure, (left, middle, right) = output.new_figure(3, 11.0, 4.0)
    middle.sharey(left)
    middle.tick_params(labelleft=False)
    for c in curves:
        draw_case(left, c.case, c.temperature, c.tip_with)
        draw_case(middle, c.case, c.temperature, c.tip_without)
        draw_case(right, c.case, c.temperature, c.ratio)
    draw_published(left, PUBLISHED_WITH, label="paper, Fig. 4")
    draw_published(middle, PUBLISHED_WITHOUT)
    left.set(title="with the passive TCA", ylabel="tip x [mm]")
    middle.set(title="without the passive TCA")
    right.set(title="bend angle without / with", ylabel="ratio", ylim=(1.0, 3.0))
    right.axhline(PUBLISHED_RATIO, color="black", linewidth=1.0, linestyle=":")
    right.text(26.0, PUBLISHED_RATIO - 0.03, 'paper: "more than 40 %"', va="top", fontsize=9)
    for axes in (left, middle, right):
        axes.set(xlabel="temperature of TCA 2 and 3 [°C]", xlim=(22.0, 163.0))
        axes.title.set_fontsize(11)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    output.save_figure(figure, path)


def draw5(curves: Sequence[Stiffness], path: Path) -> None:
    """Draw Fig. 5 into a PNG file: a panel for each case, a colour for each temperature."""
    from matplotlib import colormaps
    from matplotlib.lines import Line2D

    figure, panels = output.new_figure(len(curves), 11.0, 4.2, sharey=True)
    shades = {t: colormaps["plasma"](0.85 * (t - 75.0) / 75.0) for t in STIFFNESS_TEMPERATURES}
    for axes, c in zip(panels, curves, strict=True):
        for t, tip in zip(c.temperature, c.tip, strict=True):
            axes.plot(c.force, tip, color=shades[t], linewidth=1.8, label=f"{t:g} °C")
        for t, published in PUBLISHED_STIFFNESS.items():
            draw_published(axes, published, color=shades[t])
        axes.set(title=c.case.name, xlabel="force along x [N]", xlim=(0.0, 0.052), ylim=(0.0, 42.0))
        axes.title.set_fontsize(11)
    panels[0].set_ylabel("tip x [mm]")
    handles, labels = panels[0].get_legend_handles_labels()
    handles.append(Line2D([], [], color="0.3", **MARKERS))  # type: ignore[arg-type]
    figure.legend(handles, [*labels, "paper, Fig. 5"], loc="outside lower center", ncols=5, frameon=False)
    output.save_figure(figure, path)


# Writing


def write3(curves: Iterable[Elongation], path: Path) -> None:
    """Write Fig. 3 as CSV."""
    rows = [(c.case.name, *row) for c in curves for row in zip(c.force, c.elongation, strict=True)]
    output.write_csv(path, ["case", "force_N", "elongation_mm"], rows)


def write4(curves: Iterable[Bending], path: Path) -> None:
    """Write Fig. 4 as CSV."""
    header = [
        "case", "temperature_degC", "tip_x_with_mm", "tip_x_without_mm", "angle_with_deg", "angle_without_deg", "angle_ratio",
    ]  # fmt: skip
    rows = [
        (c.case.name, *row)
        for c in curves
        for row in zip(c.temperature, c.tip_with, c.tip_without, c.angle_with, c.angle_without, c.ratio, strict=True)
    ]
    output.write_csv(path, header, rows)


def write5(curves: Iterable[Stiffness], path: Path) -> None:
    """Write Fig. 5 as CSV."""
    rows = [
        (c.case.name, t, force, x)
        for c in curves
        for t, tip in zip(c.temperature, c.tip, strict=True)
        for force, x in zip(c.force, tip, strict=True)
    ]
    output.write_csv(path, ["case", "temperature_degC", "force_N", "tip_x_mm"], rows)


def write_agreement(comparisons: Iterable[Comparison], path: Path) -> None:
    """Write the published points beside the model's as CSV."""
    header = ["figure", "case", "curve", "x", "x_unit", "published_mm", "model_mm", "difference_mm", "agrees"]
    units = {3: "N", 4: "degC", 5: "N"}
    rows = [
        (c.figure, c.case, c.curve, float(c.x), units[c.figure], c.published, c.model, c.difference, int(c.agrees))
        for c in comparisons
    ]
    output.write_csv(path, header, rows)


def run(out: Path, say: Callable[[str], object] = print) -> None:
    """Write fig3 to fig6 (.png, .csv) and agreement (.md, .csv) into the folder `out`, and print the agreement."""
    elongations = [figure3(case) for case in (HARDWARE, PAPER)]
    bendings = [figure4(case) for case in CASES]
    stiffnesses = [figure5(case) for case in CASES]
    laws = {case.name: case.law for case in (HARDWARE, PAPER)}
    sequences = {name: sequence.figure6(law) for name, law in laws.items()}
    draw3(elongations, out / "fig3.png")
    draw4(bendings, out / "fig4.png")
    draw5(stiffnesses, out / "fig5.png")
    sequence.draw6(sequences, out / "fig6.png")
    write3(elongations, out / "fig3.csv")
    write4(bendings, out / "fig4.csv")
    write5(stiffnesses, out / "fig5.csv")
    sequence.write6(sequences, out / "fig6.csv")
    comparisons = [
        *(c for data in elongations for c in compare3(data)),
        *(c for data in bendings for c in compare4(data)),
        *(c for data in stiffnesses for c in compare5(data)),
    ]
    claims = [
        *map(claim_antagonism, bendings),
        *(c for data in stiffnesses for c in claims_stiffness(data)),
        *(Claim(*row) for row in sequence.agreement(sequences, laws.values())),
    ]
    missing = [*all_gaps(bendings, stiffnesses), *sequence.gaps(sequences)]
    text = report(comparisons, claims, weights(), missing)
    write_agreement(comparisons, out / "agreement.csv")
    (out / "agreement.md").write_text(text, encoding="utf-8")
    say(text)
    say(f"wrote fig3 to fig6 (.png, .csv) and agreement (.md, .csv) in {out}")
