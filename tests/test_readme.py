"""The README and the pages beside it: examples run, and numbers are those of the data that they come from."""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from study import size
from study.__main__ import STUDIES
from study.scenes import SCENES
from study.speed_accuracy import OURS, beaten, ratio, spread
from study.timing import Point
from tca_envs import registry

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
USING = (ROOT / "docs/using.md").read_text(encoding="utf-8")
MEASURED = " ".join((ROOT / "docs/measurements.md").read_text(encoding="utf-8").split())
EXAMPLES = re.findall(r"```python\n(.*?)```", README + USING, re.S)
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
ENTRIES = [entry for entry in registry.entries() if registry.load(entry.task).__module__.startswith("tca_envs.")]
TASKS = [entry.name for entry in ENTRIES]

PAPER, BVP = "the paper's shooting", "boundary value problem (SciPy solve_bvp)"
PEERS = [
    "relaxed dynamic rod (PyElastica)",
    "relaxed dynamic rod (PyElastica, this law)",
    "geometric variable strain (SoRoMoX)",
]
BEATEN_BY: list[tuple[str, str, str]] = [("one-degree", "passive muscles ignored", "default")]
"""Scene, method and setting of points on the charts that are both faster and more accurate than one of this package's."""


def test_there_are_examples():
    assert len(EXAMPLES) == 7
    first, robot, *_ = EXAMPLES
    assert len(first.splitlines()) <= 10
    assert len(robot.splitlines()) <= 20


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 250


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_lines_are_short(path):
    assert not [line for line in path.read_text(encoding="utf-8").splitlines() if len(line) > 120]


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_run(example):
    done = subprocess.run([sys.executable, "-W", "error", "-c", example], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout
    if "ReachController" in example:
        assert done.stdout.startswith("True")
    if "policy.zip" in example:
        assert done.stdout.startswith("success 100.0 %")


def test_files_that_it_names_exist():
    for name in re.findall(r"\]\(([\w/.-]+)\)", README) + re.findall(r'src="([\w/.-]+)"', README):
        assert (ROOT / name).exists(), name
    for path in PAGES:
        for name in re.findall(r"(?:python|pytest) ([\w/]+\.py)", path.read_text(encoding="utf-8")):
            assert name == "my_script.py" or (ROOT / name).exists(), (path, name)


def homes_of(name: str) -> list[Path]:
    """Return what a path in code font may mean, of what exists."""
    homes = (ROOT, ROOT / "tca_envs", ROOT / "tca_envs" / "mechanics")
    return [home / name for home in homes if (home / name).exists()]


def test_rooms_that_are_named_exist():
    """Paths in code font, such as `mechanics/laws.py`; rooms of `tca_envs` and of `mechanics` go without that name, too."""
    room = r"`((?:tca_envs|mechanics|solver|tasks|robots|agents|study|tests)/[\w/.]*)`"
    for path in PAGES:
        for name in re.findall(room, path.read_text(encoding="utf-8")):
            assert homes_of(name), (path.name, name)


@pytest.mark.parametrize("page", ["solver", "developing"])
def test_the_table_of_places_leads_to_what_it_names(page):
    """In every row each name in code font is a word of a file in that row."""
    text = (ROOT / f"docs/{page}.md").read_text(encoding="utf-8")
    table = text.partition("## Where to find what")[2].partition("\n## ")[0]
    rows = [re.findall(r"`([^`]+)`", line) for line in table.splitlines() if line.startswith("| ") and "`" in line]
    assert len(rows) > 5
    for row in rows:
        files = [path for name in row for path in homes_of(name) if path.is_file()]
        sources = "".join(path.read_text(encoding="utf-8") for path in files)
        for name in row:
            if not homes_of(name):
                assert re.search(rf"\b{name.rpartition('.')[2]}\b", sources), row


def test_the_kernel_that_is_shown_is_the_solvers():
    shown = re.findall(r"```python\n(.*?)```", (ROOT / "docs/solver.md").read_text(encoding="utf-8"), re.S)
    kernels = (ROOT / "tca_envs/mechanics/solver/statics.py").read_text(encoding="utf-8")
    assert shown and all(line in kernels for lines in shown for line in lines.splitlines())


def test_the_studies_are_listed():
    page = " ".join((ROOT / "docs/developing.md").read_text(encoding="utf-8").split())
    *names, last = sorted(f"`{study.name}`" for study in STUDIES)
    assert f"The studies are {', '.join(names)} and {last}." in page


def test_animated_pictures_are_small_and_move():
    image = pytest.importorskip("PIL.Image")
    for task in TASKS:
        path = ROOT / "docs" / f"{task}.webp"
        assert f"docs/{path.name}" in README and path.stat().st_size < 3e6
        with image.open(path) as film:
            first = np.asarray(film.convert("RGB"), dtype=int)
            assert film.n_frames > 50 and film.info["duration"] == 100
            film.seek(20)
            assert np.abs(np.asarray(film.convert("RGB"), dtype=int) - first).max() > 100


def test_commands_that_install_name_extras_that_exist():
    project = (ROOT / "pyproject.toml").read_text()
    for path in PAGES:
        for extras in re.findall(r'pip install -e "\.\[([\w,]+)\]"', path.read_text(encoding="utf-8")):
            for extra in extras.split(","):
                assert re.search(rf"^{extra} = \[", project, re.M), (path.name, extra)


def test_every_registered_environment_is_listed():
    for entry in ENTRIES:
        assert entry.page and all(f"`{name}`" in README for name in entry.ids.values()), entry


def test_mechanics_knows_no_gymnasium():
    for path in (ROOT / "tca_envs" / "mechanics").rglob("*.py"):
        assert "gymnasium" not in path.read_text(), path


def test_every_task_has_a_report():
    assert {path.parent.name for path in ROOT.glob("agents/pretrained/*/report.json")} == set(TASKS)


def test_results_are_those_of_the_benchmark():
    tables = re.findall(r"^\|.*\|$", (ROOT / "docs/benchmark/benchmark.md").read_text(), re.M)
    assert len(tables) == 3 * (2 + 6)  # of each task a header and its line, four learners and what they are compared with
    shown = {" ".join(line.split()) for line in README.splitlines()}
    for line in tables:
        if not set(line) <= set("|-: "):
            assert " ".join(line.split()) in shown, line


def test_the_table_of_throughput_is_that_of_the_study():
    with (ROOT / "docs/study/throughput.csv").open(newline="", encoding="utf-8") as file:
        rates = {
            (row["task"], row["kind"], row["threads"], row["environments"]): f"{float(row['median_steps_per_s']):,.0f}"
            for row in csv.DictReader(file)
        }
    for label, *key in (
        ("1024 arms, two threads", "native", "2", "1024"),
        ("1024 arms, one thread", "native", "1", "1024"),
        ("64 arms, one thread", "native", "1", "64"),
        ("16 arms in Gymnasium's own `SyncVectorEnv`", "sync", "1", "16"),
        ("4 arms in its `AsyncVectorEnv`", "async", "1", "4"),
        ("one arm, `gym.make`", "single", "1", "1"),
    ):
        assert f"| {label} | {' | '.join(rates[task, *key] for task in TASKS)} |" in USING


@pytest.mark.parametrize("folder", sorted(ROOT.glob("agents/pretrained/*")), ids=lambda path: path.name)
def test_policies_that_come_along_are_those_of_the_benchmark(folder):
    described = json.loads((folder / "report.json").read_text())
    with (ROOT / "docs/benchmark/runs.csv").open(newline="", encoding="utf-8") as file:
        run = next(
            row
            for row in csv.DictReader(file)
            if (row["task"], row["policy"], int(row["seed"])) == (folder.name, described["algo"], described["seed"])
        )
    assert run["default"] == "True"
    assert int(run["successes"]) == described["held_out"][described["algo"]]["successes"]


def test_the_table_of_tolerances_is_that_of_the_study():
    with (ROOT / "docs/study/tolerance.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    by_key = {(row["task"], float(row["tolerance_m"])): row for row in rows}
    for tolerance in sorted({key[1] for key in by_key}, reverse=True):
        cells = []
        for task in tasks:
            row = by_key[task, tolerance]
            ratio = float(row["solve_s"]) / float(by_key[task, 1e-6]["solve_s"])
            cells.append(f"{row['grids'].replace(' x ', ' × ')}; {ratio:.2f}")
        line = f"| {tolerance:.0e} m | " + " | ".join(cells) + " |"
        assert line in MEASURED, line
    least = min(float(row["share_within"]) for row in rows)
    assert least == 1.0 and "in all of 2,000 random states" in MEASURED
    assert {row["states"] for row in rows} == {"2000"}


def measured():
    """Return all points of both runs of the speed-accuracy study, warm and cold."""
    points = []
    for folder in ("docs/study", "docs/study/harder"):
        with (ROOT / folder / "speed_accuracy.csv").open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                cases, rate = int(row["cases"]), float(row["failure_rate"])
                failed = round(rate * cases) if cases else 0
                time, error = float(row["median_time_s"]), float(row["median_error_m"])
                point = Point(row["scene"], row["method"], row["knob"], row["setting"], row["start"], cases, failed, time)
                points.append(point._replace(error=error))
    return points


def test_exponents_of_size_are_those_of_the_study():
    with (ROOT / "docs/study/size.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for sweep, column in ((size.MODULES, "modules"), (size.MUSCLES, "muscles_of_a_module"), (size.LANES, "lanes")):
        mine = [row for row in rows if row["varied"] == sweep.name]
        assert tuple(int(row[column]) for row in mine) == sweep.values
        exponent, _ = sweep._replace(seconds=tuple(float(row["median_time_s"]) for row in mine)).fit
        assert f"{sweep.name}^{exponent:.2f}" in MEASURED


def test_the_chart_covers_all_scenes():
    assert {point.scene for point in measured()} == set(SCENES)


def warm_ratios(method: str) -> dict[str, list[float]]:
    """Return by scene: times of warm solves by a method's settings over this package's, at equal or better accuracy."""
    points = [point for point in measured() if point.start == "warm"]
    ratios = {}
    for scene in SCENES:
        ours = [point for point in points if point.scene == scene and point.method == OURS]
        theirs = [point for point in points if point.scene == scene and point.method == method and point.solved]
        ratios[scene] = [value for value in (ratio(ours, point) for point in theirs) if value > 0.0]
    return ratios


@pytest.mark.parametrize(
    "sentence, methods, scenes",
    [
        ("The paper's method takes {} times as long", [PAPER], SCENES),
        ("with compiled equations and analytic derivatives, takes {} times as long", [BVP], SCENES),
        ("The peer packages, which are made for dynamics, take {} times as long", PEERS, SCENES),
        ("errs by a millimetre and takes {} times as long on the tasks", ["piecewise constant curvature"], TASKS),
        ("single shooting on the wrench, which takes {} times as long on the tasks", ["wrench shooting, RK4"], TASKS),
    ],
)
def test_ratios_are_those_of_the_chart(sentence, methods, scenes):
    """Of warm solves at equal or better accuracy."""
    ratios = [value for method in methods for scene in scenes for value in warm_ratios(method)[scene]]
    assert sentence.format(spread(min(ratios), max(ratios))) in MEASURED, spread(min(ratios), max(ratios))


@pytest.mark.parametrize(
    "scene",
    [
        *(name for name in SCENES if name not in ("cold", "long", "heavy")),
        pytest.param(
            "heavy", marks=pytest.mark.xfail(strict=True, reason="920 at the loosest setting: certificates cost time")
        ),
    ],
)
def test_the_papers_method_takes_a_thousand_times_as_long(scene):
    """Cold and on the long rod its warm solves have nothing to compare."""
    assert min(warm_ratios(PAPER)[scene]) > 1000.0


def test_who_beats_this_package_is_known():
    points = measured()
    winners = set()
    for scene in SCENES:
        ours = [point for point in points if point.scene == scene and point.method == OURS]
        theirs = [point for point in points if point.scene == scene and point.method != OURS]
        winners |= {(scene, point.method, point.setting) for point, _ in beaten(ours, theirs)}
    assert sorted(winners) == sorted(BEATEN_BY)


def test_where_methods_fail_is_that_of_the_study():
    with (ROOT / "docs/study/stability.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = list(dict.fromkeys(row["method"] for row in rows))
    by_name = {name: [row for row in rows if row["method"] == name and not row["lost"] + row["doubt"]] for name in names}

    def share(name: str, outcome: str) -> float:
        return 100.0 * sum(row["outcome"] == outcome for row in by_name[name]) / len(by_name[name])

    mine = names[0]
    assert f"*{sum(row['method'] == mine for row in rows)} cells" in MEASURED
    assert f"Of the {len(by_name[mine])} cells that have a right answer" in MEASURED
    assert share(mine, "right") == 100.0
    unstable = "ends on an unstable equilibrium on"
    assert f"wrench shooting {unstable} {share('wrench shooting, RK4', 'unstable'):.0f} % of the cells" in MEASURED
    assert f"`solve_bvp` {unstable} {share(BVP, 'unstable'):.0f} %, and is right on {share(BVP, 'right'):.0f} %" in MEASURED
    straight, good = (100.0 - share(name, "right") for name in (PAPER, f"{PAPER}, good start"))
    assert f"is not right on {straight:.0f} % from a straight start, and on {good:.0f} % with a good" in MEASURED
    median = float(np.median([float(row["seconds"]) for row in by_name[mine]]))
    assert f"is right on all of them, in a median of {1e3 * median:.1f} ms" in MEASURED
    with (ROOT / "docs/study/torture.csv").open(newline="", encoding="utf-8") as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == 15 and all(int(run["steps"]) >= 100_000 for run in runs)
    assert all(int(run["failed"]) == int(run["not_finite"]) == 0 for run in runs)
    assert f"{sum(int(run['steps']) for run in runs):,} steps" in MEASURED
    assert f"took {1e3 * max(float(run['max_cpu_s']) for run in runs):.1f} ms of processor time" in MEASURED
