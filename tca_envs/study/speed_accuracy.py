"""How fast and how accurate ways to solve for equilibrium are: work-precision charts, a table, and who beats whom.

`scenes` says what is asked, `methods` who is asked, `timing` how it is measured, `chart` how it is drawn.
"""

from collections.abc import Callable, Sequence
from math import isfinite, nan
from pathlib import Path

import numpy as np

from tca_envs.study import chart, output
from tca_envs.study.method import Method
from tca_envs.study.methods import METHODS, collocation
from tca_envs.study.scenes import SCENES, TASKS, Scene
from tca_envs.study.timing import FULL, OTHER_EQUILIBRIUM, QUICK, SMALLEST_ERROR, Point, Referee, points

OURS = collocation.METHOD.name

HEADER = (
    "scene", "method", "knob", "setting", "start", "cases", "failure_rate", "median_time_s", "q25_time_s", "q75_time_s",
    "median_error_m", "p95_error_m", "max_error_m", "median_own_error_m", "note",
)  # fmt: skip


# Who beats whom


def front(candidates: Sequence[Point]) -> list[Point]:
    """Return the points that no other one beats in time without losing accuracy (the Pareto front), the fastest first."""
    kept: list[Point] = []
    for point in sorted((p for p in candidates if p.solved), key=lambda p: (p.time, p.error)):
        if not kept or point.error < kept[-1].error:
            kept.append(point)
    return kept


def rival(ours: Sequence[Point], theirs: Point) -> Point | None:
    """Return the fastest of our points that is at least as accurate as theirs and fails no more often; None if none is."""
    able = [p for p in ours if p.solved and p.error <= theirs.error and p.failure_rate <= theirs.failure_rate]
    return min(able, key=lambda p: p.time, default=None)


def ratio(ours: Sequence[Point], theirs: Point) -> float:
    """Return their time over our time at equal or better accuracy; nan if none of our points is as accurate."""
    match = rival(ours, theirs)
    return nan if match is None else theirs.time / match.time


def beaten(ours: Sequence[Point], theirs: Sequence[Point]) -> list[tuple[Point, Point]]:
    """Return all pairs of a point of theirs and one of our front that it beats: both faster and more accurate."""
    ahead = [(t, o) for t in theirs if t.solved for o in front(ours)]
    return [(t, o) for t, o in ahead if t.time < o.time and t.error < o.error]


# Writing


def write(measured: Sequence[Point], path: Path) -> None:
    """Write all points as CSV."""
    rows = [
        (
            p.scene, p.method, p.knob, p.setting, p.start, p.cases, p.failure_rate, p.time, p.time_q25, p.time_q75,
            p.error, p.error_p95, p.error_max, p.own_error, p.note,
        )
        for p in measured
    ]  # fmt: skip
    output.write_csv(path, HEADER, rows)


def report(measured: Sequence[Point], scenes: Sequence[Scene]) -> str:
    """Return speed_accuracy.md."""
    by_scene = {scene.name: [p for p in measured if p.scene == scene.name] for scene in scenes}
    parts = [
        "# Speed and accuracy of ways to solve for equilibrium",
        findings(measured, scenes),
        "## How it was made",
        protocol(scenes),
    ]
    for scene in scenes:
        group = by_scene[scene.name]
        parts += [f"## {scene.title[0].upper()}{scene.title[1:]}"]
        if any(p.solved for p in group):
            floor = si(max(p.floor for p in group if p.solved), "m")
            parts += [
                f"![{scene.title}](speed_accuracy_{scene.name}.png)",
                f"Estimated error of the reference: at most {floor}.",
                table([p for p in group if p.cases]),
            ]
        parts += ["\n".join(f"* {line}" for line in missing(group))]
    return "\n\n".join(part for part in parts if part) + "\n"


def findings(measured: Sequence[Point], scenes: Sequence[Scene]) -> str:
    """Return who beats whom, and the table of ratios."""
    by_scene = {scene.name: [p for p in measured if p.scene == scene.name] for scene in scenes}
    others = [name for name in dict.fromkeys(p.method for p in measured) if name != OURS]
    return "\n\n".join(
        [
            verdict(by_scene),
            "## Time of others over that of this package",
            "At equal or better accuracy: the time of a setting, over that of the fastest setting of this package's method "
            "that is at least as accurate and fails no more often; below 1 it is faster than any of those. The range is that "
            "over a method's settings; those that are more accurate than all of this package's are counted apart.",
            output.markdown_table(
                ["Method", *by_scene], [[name, *(ratios(group, name) for group in by_scene.values())] for name in others]
            ),
        ]
    )


def protocol(scenes: Sequence[Scene]) -> str:
    """Return what was done, in words."""
    lines = [
        "Every method solves the same states of the same arms at each of its settings, with one thread, the cases in the same "
        "order, whose every beginning is spread evenly over them.",
        "Warm: a method is told the equilibrium at the state before and solves for that state itself (neither is timed); from "
        "its own answer it solves for the next state (timed). Cold: it starts from the unloaded arm (timed).",
        f"Time is the median over the cases of the time of a solve, which is repeated where it is fast. A point ends after "
        f"{FULL.budget:g} s and at least {FULL.least} cases (`--quick`: {QUICK.budget:g} s, {QUICK.least}), so slow methods "
        f"meet fewer cases.",
        "This package's solver is called as its environments call it, a batch of one, and the other compiled methods likewise, "
        "without checks of arguments; `Arm.equilibrium` checks them and builds a result, which takes time, too.",
        "The reference is another formulation at near round-off (`tca_envs.study.reference`): the wrench form of the rod as "
        "an initial value problem, integrated by Runge-Kutta steps of order 8 over short segments from base to tip (multiple "
        "shooting); Newton on the mismatches between segments, started on the branch of equilibria that the state before "
        "belongs to; steps are halved until the tip stays. It shares arm and muscle laws with this package's solver and no "
        "numerics. Tests hold it against the closed forms (constant tensions, springs, a helical muscle, elastica, Timoshenko) "
        "to 1e-11 m or to their printed digits; its own estimate of its error stands with each scene.",
        f"Error is the distance of the tip from that of the reference; errors below {SMALLEST_ERROR:g} m count as "
        f"{SMALLEST_ERROR:g} m.",
        f"A solve fails if it says so, returns numbers that are not finite, or ends on another equilibrium: a tip farther than "
        f"{100 * OTHER_EQUILIBRIUM:g} % of the arm's length from the reference. (That does not apply to methods that solve a "
        f"simpler model: their errors do not vanish.) Failed cases count in the failure rate and in no median. A hollow "
        f"marker in a figure is a setting that fails on some cases.",
        "Times are those of one machine; ratios within a run say more.",
    ]
    asked = [f"* {scene.name}: {scene.title}, {len(scene.cases)} cases, {scene.start}" for scene in scenes]
    return "\n\n".join([*lines, "\n".join(asked)])


def verdict(by_scene: dict[str, list[Point]]) -> str:
    """Return whether any method is faster and more accurate than this package's, in words."""
    lines = []
    for name, group in by_scene.items():
        ours, theirs = [p for p in group if p.method == OURS], [p for p in group if p.method != OURS]
        pairs = beaten(ours, theirs)
        for winner in dict.fromkeys(t for t, _ in pairs):
            losers = ", ".join(f"{o.setting} ({si(o.time, 's')}, {si(o.error, 'm')})" for t, o in pairs if t is winner)
            lines.append(
                f"* {name}: {winner.method} at {winner.knob} {winner.setting} ({si(winner.time, 's')}, {si(winner.error, 'm')}"
                f"{failing(winner)}) beats {losers}"
            )
    if not lines:
        return f"No point of another method is both faster and more accurate than one of the Pareto front of {OURS}."
    head = f"Points of other methods that are both faster and more accurate than points of the Pareto front of {OURS}:"
    return "\n".join([head, "", *lines])


def failing(point: Point) -> str:
    """Return a remark on failed cases, if there are any."""
    return f", fails on {percent(point.failure_rate)}" if point.failed else ""


def percent(share: float) -> str:
    """Return a share in per cent, never rounded to none or all."""
    return f"{min(max(round(100.0 * share), 1), 99) if 0.0 < share < 1.0 else round(100.0 * share)} %"


def ratios(group: Sequence[Point], name: str) -> str:
    """Return the cell of a method in the table of ratios."""
    ours, theirs = [p for p in group if p.method == OURS], [p for p in group if p.method == name]
    tried = [p for p in theirs if p.solved]
    if not tried:
        notes = [p.note for p in theirs]
        return notes[0].split(":")[0] if notes else "--"
    known = [value for value in (ratio(ours, p) for p in tried) if isfinite(value)]
    beyond = len(tried) - len(known)
    words = [] if not known else [spread(min(known), max(known))]
    words += [f"{beyond} of {len(tried)} more accurate"] if beyond else []
    worst = max(p.failure_rate for p in theirs if p.cases)
    words += [f"fails on up to {percent(worst)}"] if worst else []
    return "; ".join(words)


def spread(low: float, high: float) -> str:
    """Return a range of ratios with two significant digits."""
    a, b = (f"{float(f'{value:.2g}'):,g}" if value < 1e6 else f"{value:.1e}" for value in (low, high))
    return a if a == b else f"{a} to {b}"


def si(value: float, unit: str) -> str:
    """Return a number with three significant digits and a unit with its prefix, -- where it is missing."""
    if not isfinite(value):
        return "--"
    power = 0 if value == 0.0 else int(np.clip(np.floor(np.log10(abs(value)) / 3.0 + 1e-9), -5, 0))
    return f"{value / 1e3**power:.3g} {['', 'm', 'µ', 'n', 'p', 'f'][-power]}{unit}"


def table(group: Sequence[Point]) -> str:
    """Return the table of a scene's points."""
    own = any(isfinite(p.own_error) for p in group)
    header = ["Method", "Knob", "Setting", "Cases", "Fails", "Median time", "Quartiles", "Median error", "95 %", "Largest"]
    rows = [
        [
            p.method, p.knob, p.setting, str(p.cases), percent(p.failure_rate), si(p.time, "s"),
            f"{si(p.time_q25, 's')}, {si(p.time_q75, 's')}" if p.solved else "--",
            si(p.error, "m"), si(p.error_p95, "m"), si(p.error_max, "m"), *([si(p.own_error, "m")] if own else []),
        ]
        for p in group
    ]  # fmt: skip
    return output.markdown_table([*header, *(["Against own finest"] if own else [])], rows)


def missing(group: Sequence[Point]) -> list[str]:
    """Return a line for each method and reason for which settings have nothing to show."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for p in group:
        if not p.solved:
            reasons.setdefault((p.method, p.note), []).append(p.setting)
    return [f"{method} at {', '.join(settings)}: {note}" for (method, note), settings in reasons.items()]


def run(
    out: Path,
    scenes: Sequence[str] | None = None,
    quick: bool = False,
    methods: Sequence[Method] = METHODS,
    say: Callable[[str], object] = print,
) -> None:
    """Measure, and write speed_accuracy.csv, speed_accuracy.md and the figures into the folder `out`.

    Parameters
    ----------
    out : Path
        A folder that exists.
    scenes : sequence of str, optional
        Names in `scenes.SCENES`; by default all.
    quick : bool
        Few cases and a short time for each: for a look.
    methods : sequence of Method
        Whom to compare.
    say : callable
        Told what was found and written.
    """
    from tqdm import tqdm

    effort = QUICK if quick else FULL
    built = [SCENES[name](effort.cases) for name in (scenes or SCENES)]
    measured: list[Point] = []
    with tqdm(total=len(built) * sum(len(method.settings) for method in methods), unit="point") as bar:
        for scene in built:
            referee = Referee(scene)
            for method in methods:
                bar.set_description(f"{scene.name}, {method.name}")
                measured += points(scene, method, referee, effort, bar.update)
    write(measured, out / "speed_accuracy.csv")
    names = [method.name for method in methods]
    for scene in built:
        group = [p for p in measured if p.scene == scene.name]
        chart.draw_scene(scene, group, names, OURS, out / f"speed_accuracy_{scene.name}.png")
    shown = [scene for scene in built if scene.name in TASKS] or built[:3]
    chart.draw_overview(shown, measured, names, OURS, out / "speed_accuracy.png")
    (out / "speed_accuracy.md").write_text(report(measured, built), encoding="utf-8")
    say(findings(measured, built))
    say(f"wrote speed_accuracy (.png, .csv, .md) and a figure for each scene in {out}")
