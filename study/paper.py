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

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import isfinite, isnan, nan, pi
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from study import pattern, sequence
from study.method import Array
from study.pattern import COLOURS, Column, Study, fixed, numbered
from tca_envs.mechanics import TCA, Arm, Equilibrium, Payload
from tca_envs.mechanics.thermal import AMBIENT as ROOM
from tca_envs.robots import paper as robot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Points(NamedTuple):
    """Published points of a curve, read off the paper's plot."""

    x: tuple[float, ...]  # force [N] or temperature [degC]
    y: tuple[float, ...]  # elongation or displacement of the tip along x [mm]


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
}  # Paper, Fig. 5: tip x [mm] over the force along x [N] at a temperature of all three TCAs [degC].
PUBLISHED_RATIO = 1.4  # paper, section IV.A: without the passive TCA the bending is "more than 40 %" larger

ABSOLUTE_TOLERANCE = 0.3  # [mm]: about what can be read off the paper's plots
RELATIVE_TOLERANCE = 0.1

ECOFLEX_DENSITY = 1070.0  # Ecoflex 00-30 [kg/m3] (manufacturer's data sheet: specific gravity 1.07)
EFFECTIVE_MASS = ECOFLEX_DENSITY * pi / 4.0 * robot.BODY_DIAMETER**2 * robot.BENDING_LENGTH
"""rho A L of the bending module [kg], as eq. (9) weighs its effective section: 0.77 g."""

FORCES = np.linspace(0.0, 0.8, 81)  # Fig. 3 [N].
TEMPERATURES = np.linspace(25.0, 160.0, 136)  # Fig. 4 [degC].
TIP_FORCES = np.linspace(0.0, 0.05, 51)  # Fig. 5 [N].
STIFFNESS_TEMPERATURES = (75.0, 100.0, 125.0, 150.0)  # Fig. 5 [degC].
PASSIVE = 0  # index of TCA 1, which stays at room temperature in Fig. 4.
SMALLEST_ANGLE = 1.0  # [deg]: a ratio to a smaller bend angle says nothing


@dataclass(frozen=True)
class Case:
    """A set of the TCA's constants and what the bending module carries."""

    name: str  # in figures and tables
    law: TCA
    mass: float = robot.BENDING_MASS  # of the bending module [kg]
    payload: Payload | None = None  # what hangs from its tip


HARDWARE = Case("hardware set", TCA.hardware())
PAPER = Case("paper set", TCA.paper())
PAPER_EFFECTIVE = Case("paper set, weight of eq. (9)", TCA.paper(), EFFECTIVE_MASS)
CASES = (HARDWARE, PAPER, PAPER_EFFECTIVE)


@dataclass(frozen=True, eq=False)
class Elongation:
    """Fig. 3 for one case: passive elongation of a 45 mm TCA."""

    case: Case
    force: Array  # (k,) [N]
    elongation: Array  # (k,) [mm]


@dataclass(frozen=True, eq=False)
class Bending:
    """Fig. 4 for one case: TCA 2 and 3 heated, with the passive TCA 1 and with it left out."""

    case: Case
    temperature: Array  # of TCA 2 and 3 (k,) [degC]
    tip_with: Array  # tip x with the passive TCA (k,) [mm]; NaN where no equilibrium was found, as in all of these
    tip_without: Array  # tip x without it (k,) [mm]
    angle_with: Array  # bend angle with the passive TCA (k,) [deg], see `bend_angle`
    angle_without: Array  # bend angle without it (k,) [deg]

    @property
    def ratio(self) -> Array:
        """Bend angle without over that with the passive TCA (k,); NaN where the latter is below `SMALLEST_ANGLE`."""
        large = np.where(np.abs(self.angle_with) < SMALLEST_ANGLE, nan, self.angle_with)
        return np.asarray(self.angle_without / large)


@dataclass(frozen=True, eq=False)
class Stiffness:
    """Fig. 5 for one case: a force along x at the tip, all three TCAs equally hot."""

    case: Case
    temperature: tuple[float, ...]  # (t,) [degC]
    force: Array  # (k,) [N]
    tip: Array  # tip x (t, k) [mm]; NaN where no equilibrium was found


def bending_arm(case: Case, removed: Sequence[int] = ()) -> Arm:
    """Return the bending module of `robot.bending_module` hanging under its own weight, without the muscles `removed`."""
    module = robot.bending_module(case.law)
    kept = [muscle for i, muscle in enumerate(module.muscles) if i not in removed]
    module = replace(module, muscles=kept, mass_per_length=case.mass / module.length)
    return Arm([module], robot.GRAVITY, case.payload)


def tip_poses(arm: Arm, drives: ArrayLike, tip_forces: ArrayLike, start: Equilibrium | None = None) -> Array:
    """Return the tip's poses (k, 4, 4) [m] along a path of drives (k, n) [degC] and tip forces (k, 3) [N], base frame.

    Each solve starts from the last equilibrium, the first one from `start` or the unloaded arm; NaN where none was found.
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


class Curve(NamedTuple):
    """A computed curve, and the published points on it, where there are any."""

    figure: int
    name: str  # empty where the figure has but one
    x: Array  # force [N] or temperature [degC]
    y: Array  # [mm]; NaN where no equilibrium was found
    published: Points | None


def curves_of(data: Elongation | Bending | Stiffness) -> list[Curve]:
    """Return the curves of a figure."""
    if isinstance(data, Elongation):
        return [Curve(3, "", data.force, data.elongation, PUBLISHED_ELONGATION)]
    if isinstance(data, Bending):
        return [
            Curve(4, "with passive TCA", data.temperature, data.tip_with, PUBLISHED_WITH),
            Curve(4, "without passive TCA", data.temperature, data.tip_without, PUBLISHED_WITHOUT),
        ]
    pairs = zip(data.temperature, data.tip, strict=True)
    return [Curve(5, f"{t:g} °C", data.force, tip, PUBLISHED_STIFFNESS.get(round(t))) for t, tip in pairs]


@dataclass(frozen=True)
class Comparison:
    """Model and paper at one published point."""

    figure: int
    case: str
    curve: str  # which curve of the figure; empty where there is but one
    x: float  # force [N] or temperature [degC] of the point
    published: float  # [mm]
    model: float  # [mm], NaN where no equilibrium was found

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


def compare(data: Any) -> list[Comparison]:
    """Compare the curves of a figure with their published points."""
    return [
        Comparison(curve.figure, data.case.name, curve.name, x, y, value_at(curve.x, curve.y, x))
        for curve in curves_of(data)
        for x, y in zip(*(curve.published or ((), ())), strict=True)
    ]


def comparisons_of(found: "Found") -> list[Comparison]:
    """Compare all published points."""
    return [c for data in (*found.elongations, *found.bendings, *found.stiffnesses) for c in compare(data)]


def verdict(comparisons: Sequence[Comparison]) -> str:
    """Return in words whether a curve agrees: at all points, at half of them or more, or not."""
    total, agreeing = len(comparisons), sum(c.agrees for c in comparisons)
    missing = sum(isnan(c.model) for c in comparisons)
    words = "agrees" if agreeing == total else "agrees in part" if 2 * agreeing >= total else "does not agree"
    return f"{words} ({agreeing} of {total} points)" + (f"; no equilibrium at {missing}" if missing else "")


def gaps(data: Any) -> list[str]:
    """Return one line for each curve of a figure with solves that did not converge."""
    lines = []
    for curve in curves_of(data):
        missing = ", ".join(f"{x:g}" for x in curve.x[np.isnan(curve.y)])
        lines += [f"Fig. {curve.figure}, {data.case.name}, {curve.name}: {missing} {UNITS[curve.figure][0]}"] if missing else []
    return lines


class Claim(NamedTuple):
    """A statement of the paper, tested on one case."""

    text: str
    case: str
    found: str  # what the model says
    holds: bool | None  # none where missing equilibria leave it open


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
        claims.append(Claim(text, data.case.name, f"{fixed('.0f')(model)} %", holds))
    return claims


def weights() -> list[tuple[str, str, float, float]]:
    """Return what the weight changes: the set of constants, the weight, and tip x [mm].

    That is tip x of Fig. 4 at 100 degC with the passive TCA and of Fig. 5 at 75 degC and 0.01 N.
    """
    rows = []
    for case in (HARDWARE, PAPER):
        for name, mass, payload in (
            ("none", 0.0, None),
            (f"of eq. (9), {1e3 * EFFECTIVE_MASS:.2f} g", EFFECTIVE_MASS, None),
            (f"module, {1e3 * robot.BENDING_MASS:.1f} g", robot.BENDING_MASS, None),
            (f"module and the rest of the arm, {1e3 * robot.BELOW_BENDING.mass:.1f} g more",
             robot.BENDING_MASS, robot.BELOW_BENDING),
        ):  # fmt: skip
            arm = bending_arm(replace(case, mass=mass, payload=payload))
            bent = tip_poses(arm, [[ROOM, 100.0, 100.0]], [[0.0, 0.0, 0.0]])
            pushed = tip_poses(arm, [[75.0] * 3], [[0.01, 0.0, 0.0]])
            rows.append((case.name, name, 1e3 * float(bent[0, 0, 3]), 1e3 * float(pushed[0, 0, 3])))
    return rows


class Verdict(NamedTuple):
    """The comparisons of a curve."""

    figure: int
    case: str
    curve: str
    points: list[Comparison]

    @property
    def worst(self) -> str:
        """The largest difference, in words."""
        known = [c for c in self.points if isfinite(c.model)]
        worst = max(known, key=lambda c: abs(c.difference), default=None)
        return "--" if worst is None else f"{worst.difference:+.2f} mm (paper {worst.published:.2f})"

    @property
    def ratio(self) -> float:
        """Median of model over paper."""
        known = [c.model / c.published for c in self.points if isfinite(c.model)]
        return float(np.median(known)) if known else nan


def summary_table(comparisons: Sequence[Comparison]) -> str:
    """Return the table of verdicts, a line for each curve."""
    columns = [
        Column("figure", "", "Figure", "Fig. {}".format), Column("case", "", "Case"), Column("curve", "", "Curve"),
        Column("worst", "", "Largest difference, model minus paper"),
        Column("ratio", "", "Median of model/paper", fixed(".2f")), Column("points", "", "Verdict", verdict),
    ]  # fmt: skip
    groups: dict[tuple[int, str, str], list[Comparison]] = {}
    for c in comparisons:
        groups.setdefault((c.figure, c.case, c.curve), []).append(c)
    return pattern.table(columns, [Verdict(*key, group) for key, group in groups.items()])


UNITS = {3: ("N", "N"), 4: ("°C", "degC"), 5: ("N", "N")}  # of a figure's abscissa, in tables and in files


def points_table(comparisons: Sequence[Comparison]) -> str:
    """Return the table of all published points, one column for each case."""
    lines: dict[tuple[int, str, float, float], dict[str, Comparison]] = {}
    for c in comparisons:
        lines.setdefault((c.figure, c.curve, c.x, c.published), {})[c.case] = c
    cases = pattern.names(comparisons, "case")
    rows = [
        [f"Fig. {figure}", curve, f"{x:g} {UNITS[figure][0]}", f"{published:.2f}", *(cell(line.get(case)) for case in cases)]
        for (figure, curve, x, published), line in lines.items()
    ]
    return pattern.markdown_table(["Figure", "Curve", "At", "Paper", *cases], rows)


def cell(comparison: Comparison | None) -> str:
    """Return model value and difference for `points_table`; a star marks agreement."""
    if comparison is None:
        return ""
    if isnan(comparison.model):
        return "no equilibrium"
    return f"{comparison.model:.2f} ({comparison.difference:+.2f}){' *' if comparison.agrees else ''}"


def report(found: "Found") -> str:
    """Return agreement.md."""
    comparisons, (estimate, effective) = comparisons_of(found), (1e3 * robot.BENDING_MASS, 1e3 * EFFECTIVE_MASS)
    at_100, at_75 = dict(zip(*PUBLISHED_WITH, strict=True))[100], PUBLISHED_STIFFNESS[75].y[0]
    answers = {True: "yes", False: "no", None: "open: equilibria are missing"}
    statements = [
        Column("text", "", "Statement"), Column("case", "", "Case"), Column("found", "", "Model"),
        Column("holds", "", "Holds", answers.__getitem__),
    ]  # fmt: skip
    claims = [
        *map(claim_antagonism, found.bendings), *(c for data in found.stiffnesses for c in claims_stiffness(data)),
        *(Claim(*row) for row in sequence.agreement(found.sequences, LAWS.values())),
    ]  # fmt: skip
    missing = [line for data in (*found.bendings, *found.stiffnesses) for line in gaps(data)] + sequence.gaps(found.sequences)
    number = fixed(".2f")
    return pattern.page(
        "# Where model and paper agree",
        f"Published points were read off the paper's plots. A point agrees if model and paper differ by at most "
        f"{ABSOLUTE_TOLERANCE:g} mm or {100 * RELATIVE_TOLERANCE:.0f} % of the published value, whichever is larger. A curve "
        f"agrees if all its points do, and in part if half of them do.",
        f"Figs. 4 and 5 show the bending module alone under its own weight. The cases: the hardware set and the paper set of "
        f"the TCA's constants with the module's estimated weight ({estimate:.1f} g), and the paper set with "
        f"the weight rho A L that eq. (9) gives for the effective section ({effective:.2f} g). Fig. 3 depends on "
        f"no weight.",
        "Agreement is not always independent evidence: the polynomial of the coils' modulus, misprinted in the paper, is "
        "corrected so that Fig. 3 comes out; and the paper does not print A, while the paper set's argument T - 25 is inferred "
        "from Fig. 4.",
        "## Curves",
        summary_table(comparisons),
        "## Statements of the paper",
        "The statement on Fig. 4 is tested on bend angles. At low temperatures their ratio grows with the weight and says "
        "little of antagonism: with one TCA left out the other two carry the module off its axis, and it is bent when cold.",
        "Percentages of Fig. 5 are means over the forces of its published points; they hold if the model's lie within 10 "
        "percentage points.",
        pattern.table(statements, claims),
        "## What the weight changes",
        f"Tip x in mm, in Fig. 4 with the passive TCA at 100 °C (paper: {at_100:.2f}), in Fig. 5 at 75 °C and 0.01 N "
        f"(paper: {at_75:.2f}).",
        pattern.markdown_table(
            ["Constants", "Weight", "Fig. 4", "Fig. 5"], [[*row[:2], *map(number, row[2:])] for row in found.weights]
        ),
        "## Published points",
        "Values in mm, in brackets model minus paper; a star marks agreement.",
        points_table(comparisons),
        "## Solves without an equilibrium",
        pattern.bullets(missing) or "None.",
    )


# Drawing

LINES = dict(zip((case.name for case in CASES), zip(COLOURS, ("-", "--", "-."), strict=False), strict=True))
MARKERS = {"marker": "o", "ls": "none", "ms": 5.0, "mfc": "white", "mew": 1.3, "zorder": 3, "clip_on": False}


def draw_published(axes: "Axes", points: Points, **options: object) -> None:
    """Draw published points as markers."""
    axes.plot(*points, **{"color": "black", **MARKERS, **options})  # type: ignore[arg-type]


def draw_case(axes: "Axes", case: Case, x: Array, y: Array) -> None:
    """Draw a model's curve in its case's line."""
    colour, dashes = LINES[case.name]
    axes.plot(x, y, dashes, color=colour, linewidth=1.8, label=case.name)


def draw3(curves: Iterable[Elongation]) -> "Figure":
    """Draw Fig. 3."""
    figure, (axes,) = pattern.new_figure(1, 4.8, 3.6)
    for c in curves:
        draw_case(axes, c.case, c.force, c.elongation)
    draw_published(axes, PUBLISHED_ELONGATION, label="paper, Fig. 3")
    axes.set(xlabel="tension [N]", ylabel="passive elongation of a 45 mm TCA [mm]", xlim=(0.0, 0.82), ylim=(0.0, 24.0))
    axes.legend(loc="lower right", frameon=False)
    return figure


def draw4(curves: Sequence[Bending]) -> "Figure":
    """Draw Fig. 4: tip x with and without the passive TCA, and the ratio of bend angles."""
    figure, (left, middle, right) = pattern.new_figure(3, 11.0, 4.0)
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
    return figure


def draw5(curves: Sequence[Stiffness]) -> "Figure":
    """Draw Fig. 5: a panel for each case, a colour for each temperature."""
    from matplotlib import colormaps
    from matplotlib.lines import Line2D

    figure, panels = pattern.new_figure(len(curves), 11.0, 4.2, sharey=True)
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
    return figure


# The command


class Found(NamedTuple):
    """All that is computed."""

    elongations: list[Elongation]
    bendings: list[Bending]
    stiffnesses: list[Stiffness]
    sequences: dict[str, list[sequence.Frame]]
    weights: list[tuple[str, str, float, float]]


LAWS = {case.name: case.law for case in (HARDWARE, PAPER)}


def measure() -> Found:
    """Compute Figs. 3 to 6."""
    sequences = {name: sequence.figure6(law) for name, law in LAWS.items()}
    return Found([figure3(HARDWARE), figure3(PAPER)], [*map(figure4, CASES)], [*map(figure5, CASES)], sequences, weights())


def draw(found: Found) -> "Iterator[tuple[str, Figure]]":
    """Draw the figures."""
    yield "fig3.png", draw3(found.elongations)
    yield "fig4.png", draw4(found.bendings)
    yield "fig5.png", draw5(found.stiffnesses)
    yield "fig6.png", sequence.draw6(found.sequences)


def rows(figures: Iterable[Any], columns: Callable[[Any], tuple[Array, ...]]) -> list[tuple[Any, ...]]:
    """Return the rows of a figure's file."""
    return [(data.case.name, *row) for data in figures for row in zip(*columns(data), strict=True)]


def columns5(data: Stiffness) -> tuple[Array, ...]:
    """Return what is written of Fig. 5."""
    return np.repeat(data.temperature, data.force.size), np.tile(data.force, len(data.temperature)), data.tip.ravel()


FIGURE5 = ("case", "temperature_degC", "force_N", "tip_x_mm")
FIGURE4 = (
    "case", "temperature_degC", "tip_x_with_mm", "tip_x_without_mm", "angle_with_deg", "angle_without_deg", "angle_ratio",
)  # fmt: skip
COLUMNS4 = attrgetter("temperature", "tip_with", "tip_without", "angle_with", "angle_without", "ratio")
AGREEMENT = (
    Column("figure", "figure"), Column("case", "case"), Column("curve", "curve"), Column(lambda c: float(c.x), "x"),
    Column(lambda c: UNITS[c.figure][1], "x_unit"), Column("published", "published_mm"), Column("model", "model_mm"),
    Column("difference", "difference_mm"), Column(lambda c: int(c.agrees), "agrees"),
)  # fmt: skip
STUDY = Study(
    "paper",
    "redraw the paper's Figs. 3 to 6 and say where model and paper agree",
    measure,
    options=(),
    tables={
        "fig3.csv": (
            numbered("case", "force_N", "elongation_mm"),
            lambda found: rows(found.elongations, attrgetter("force", "elongation")),
        ),
        "fig4.csv": (numbered(*FIGURE4), lambda found: rows(found.bendings, COLUMNS4)),
        "fig5.csv": (numbered(*FIGURE5), lambda found: rows(found.stiffnesses, columns5)),
        "fig6.csv": (sequence.COLUMNS, lambda found: sequence.rows(found.sequences)),
        "agreement.csv": (AGREEMENT, comparisons_of),
    },
    figures=draw,
    page=("agreement.md", report),
    findings=report,
    packages=("matplotlib",),
)
