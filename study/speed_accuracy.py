"""How fast and how accurate ways to solve for equilibrium are: work-precision charts, a table, and who beats whom.

`scenes` says what is asked, `methods` who is asked, `timing` how it is measured, `chart` how it is drawn.
"""

from collections.abc import Iterator, Sequence
from math import isfinite, nan
from typing import TYPE_CHECKING, NamedTuple

from study import chart, pattern
from study.method import Method
from study.methods import METHODS, collocation
from study.pattern import Column, Study, in_metres, in_seconds, percent
from study.scenes import SCENES, TASKS, Scene
from study.timing import FULL, OTHER_EQUILIBRIUM, QUICK, SMALLEST_ERROR, Point, Referee, points

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OURS = collocation.METHOD.name

COLUMNS = (
    Column("scene", "scene"), Column("method", "method", "Method"), Column("knob", "knob", "Knob"),
    Column("setting", "setting", "Setting"), Column("start", "start"), Column("cases", "cases", "Cases"),
    Column("failure_rate", "failure_rate", "Fails", percent), Column("time", "median_time_s", "Median time", in_seconds),
    Column(lambda p: f"{in_seconds(p.time_q25)}, {in_seconds(p.time_q75)}" if p.solved else "--", "", "Quartiles"),
    Column("time_q25", "q25_time_s"), Column("time_q75", "q75_time_s"),
    Column("error", "median_error_m", "Median error", in_metres), Column("error_p95", "p95_error_m", "95 %", in_metres),
    Column("error_max", "max_error_m", "Largest", in_metres),
    Column("own_error", "median_own_error_m", "Against own finest", in_metres), Column("note", "note"),
)  # fmt: skip


class Found(NamedTuple):
    """What was measured: points of all methods on all scenes."""

    scenes: list[Scene]
    points: list[Point]
    names: list[str]  # of the methods

    def of(self, scene: Scene) -> list[Point]:
        """Return the points of a scene."""
        return [p for p in self.points if p.scene == scene.name]


# Who beats whom


def front(candidates: Sequence[Point]) -> list[Point]:
    """Return the points that no other one beats in time without losing accuracy (the Pareto front), the fastest first."""
    kept: list[Point] = []
    for point in sorted((p for p in candidates if p.solved), key=lambda p: (p.time, p.error)):
        if not kept or point.error < kept[-1].error:
            kept.append(point)
    return kept


def ratio(ours: Sequence[Point], theirs: Point) -> float:
    """Return their time over that of our fastest point which is as accurate and fails no more often; nan if there is none."""
    able = [p.time for p in ours if p.solved and p.error <= theirs.error and p.failure_rate <= theirs.failure_rate]
    return theirs.time / min(able) if able else nan


def beaten(ours: Sequence[Point], theirs: Sequence[Point]) -> list[tuple[Point, Point]]:
    """Return all pairs of a point of theirs and one of our front that it beats: both faster and more accurate."""
    ahead = [(t, o) for t in theirs if t.solved for o in front(ours)]
    return [(t, o) for t, o in ahead if t.time < o.time and t.error < o.error]


# The page


def report(found: Found) -> str:
    """Return the page."""
    parts = [
        "# Speed and accuracy of ways to solve for equilibrium", findings(found), "## How it was made", protocol(found.scenes),
    ]  # fmt: skip
    for scene in found.scenes:
        group = found.of(scene)
        parts += [f"## {scene.title[0].upper()}{scene.title[1:]}"]
        if any(p.solved for p in group):
            own = any(isfinite(p.own_error) for p in group)
            columns = [column for column in COLUMNS if own or column.value != "own_error"]
            floor = in_metres(max(p.floor for p in group if p.solved))
            parts += [
                f"![{scene.title}](speed_accuracy_{scene.name}.png)",
                f"Estimated error of the reference: at most {floor}.",
                pattern.table(columns, [p for p in group if p.cases]),
            ]
        parts += [pattern.bullets(missing(group))]
    return pattern.page(*parts)


def findings(found: Found) -> str:
    """Return who beats whom, and the table of ratios."""
    by_scene = {scene.name: found.of(scene) for scene in found.scenes}
    others = [name for name in found.names if name != OURS]
    rows = [[name, *(ratios(group, name) for group in by_scene.values())] for name in others]
    return "\n\n".join(
        [
            verdict(by_scene),
            "## Time of others over that of this package",
            "At equal or better accuracy: the time of a setting, over that of the fastest setting of this package's method "
            "that is at least as accurate and fails no more often; below 1 it is faster than any of those. The range is that "
            "over a method's settings; those that are more accurate than all of this package's are counted apart.",
            pattern.markdown_table(["Method", *by_scene], rows),
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
        "The reference is another formulation at near round-off (`study.reference`): the wrench form of the rod as "
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
    asked = [f"{scene.name}: {scene.title}, {len(scene.cases)} cases, {scene.start}" for scene in scenes]
    return "\n\n".join([*lines, pattern.bullets(asked)])


def verdict(by_scene: dict[str, list[Point]]) -> str:
    """Return whether any method is faster and more accurate than this package's, in words."""
    lines = []
    for name, group in by_scene.items():
        ours, theirs = [p for p in group if p.method == OURS], [p for p in group if p.method != OURS]
        pairs = beaten(ours, theirs)
        for winner in dict.fromkeys(t for t, _ in pairs):
            fails = f", fails on {percent(winner.failure_rate)}" if winner.failed else ""
            losers = ", ".join(f"{o.setting} ({in_seconds(o.time)}, {in_metres(o.error)})" for t, o in pairs if t is winner)
            lines.append(
                f"* {name}: {winner.method} at {winner.knob} {winner.setting} ({in_seconds(winner.time)}, "
                f"{in_metres(winner.error)}{fails}) beats {losers}"
            )
    if not lines:
        return f"No point of another method is both faster and more accurate than one of the Pareto front of {OURS}."
    head = f"Points of other methods that are both faster and more accurate than points of the Pareto front of {OURS}:"
    return "\n".join([head, "", *lines])


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


def missing(group: Sequence[Point]) -> list[str]:
    """Return a line for each method and reason for which settings have nothing to show."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for p in group:
        if not p.solved:
            reasons.setdefault((p.method, p.note), []).append(p.setting)
    return [f"{method} at {', '.join(settings)}: {note}" for (method, note), settings in reasons.items()]


def measure(scenes: Sequence[str] | None, quick: bool, methods: Sequence[Method] = METHODS) -> Found:
    """Measure methods on scenes, keys of `SCENES`, by default on all."""
    effort = QUICK if quick else FULL
    built = [SCENES[name](effort.cases) for name in (scenes or SCENES)]
    found: list[Point] = []
    referees = {scene.name: Referee(scene) for scene in built}
    for scene, method in pattern.progress([(scene, method) for scene in built for method in methods], unit="method"):
        found += points(scene, method, referees[scene.name], effort)
    return Found(built, found, [method.name for method in methods])


def draw(found: Found) -> "Iterator[tuple[str, Figure]]":
    """Draw the chart of each scene, and the tasks' side by side."""
    for scene in found.scenes:
        yield f"speed_accuracy_{scene.name}.png", chart.draw_scene(scene, found.of(scene), found.names, OURS)
    shown = [scene for scene in found.scenes if scene.name in TASKS] or found.scenes[:3]
    yield "speed_accuracy.png", chart.draw_overview(shown, found.points, found.names, OURS)


STUDY = Study(
    "speed-accuracy",
    "chart time against tip error of ways to solve for equilibrium, on several scenes",
    measure,
    options=("scenes", "quick"),
    tables={"speed_accuracy.csv": (COLUMNS, lambda found: found.points)},
    figures=draw,
    page=("speed_accuracy.md", report),
    findings=findings,
)
