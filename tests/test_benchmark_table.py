"""The benchmark: each run once, resumable, and a table and curves that say what the runs came to."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

import train
from agents import benchmark, curve, training
from agents.benchmark import Run, each, over_fastest, rows, spread
from agents.evaluate import Episodes, wilson
from agents.hyperparameters import default_algorithm

TINY = {
    "env": "TCAReachDense-v0",
    "n_envs": 2,
    "n_timesteps": 120,
    "policy": "MultiInputPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "learning_rate": 0.001,
}
SETTINGS = {
    "reach": {
        "ppo": {**TINY, "n_steps": 30, "batch_size": 30, "n_epochs": 1},
        "sac": {**TINY, "buffer_size": 1000, "batch_size": 8, "learning_starts": 110},
    }
}


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A benchmark with tiny settings, and what it said."""
    out, said = tmp_path_factory.mktemp("benchmark"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "settings_of", SETTINGS.get)
        patch.setattr(benchmark, "EPISODES", 3)
        patch.setattr(training, "CURVE_EPISODES", 2)
        patch.setattr(training, "CURVE_INTERVAL", 60)
        patch.setattr(curve, "draw", lambda *_: None)  # of each run: takes time
        benchmark.benchmark(out, ["reach"], [0, 1], say=said.append)
        yield out, said


def read(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_there_is_a_row_for_each_policy_with_what_its_runs_came_to(done):
    out, _ = done
    table = read(out / "benchmark.csv")
    assert [row["policy"] for row in table] == ["random", "scripted", "ppo", "sac"]
    by_name = {row["policy"]: row for row in table}
    scripted = by_name["scripted"]
    assert (scripted["successes"], scripted["episodes"]) == ("6", "6")
    assert [float(scripted[name]) for name in ("low", "high")] == pytest.approx(wilson(6, 6))
    assert 1.0 <= float(scripted["over_fastest"]) < 1.3
    assert scripted["minutes"] == "nan" and float(by_name["ppo"]["minutes"]) > 0.0 and by_name["ppo"]["steps"] == "120"
    assert by_name["random"]["over_fastest"] == "nan"
    assert [row["policy"] for row in table if row["default"] == "True"] == [default_algorithm("reach")]
    page = (out / "benchmark.md").read_text(encoding="utf-8")
    assert page.count("100.0 % (61.0-100.0 %)") == 1 and "**PPO**" in page


def test_every_run_is_listed_and_the_rows_are_their_means(done):
    out, _ = done
    runs, table = read(out / "runs.csv"), read(out / "benchmark.csv")
    assert len(runs) == 8
    for row in table:
        mine = [run for run in runs if run["policy"] == row["policy"]]
        assert {run["seed"] for run in mine} == {"0", "1"}
        for name in ("final_distance_mm", "energy_J"):
            assert float(row[name]) == pytest.approx(np.mean([float(run[name]) for run in mine]), rel=1e-6)


def test_policies_of_a_seed_meet_the_same_goals_and_other_seeds_others(done):
    out, _ = done
    reports = [json.loads(path.read_text()) for path in sorted(out.glob("runs/*/report.json"))]
    goals = {(report["seed"], report["evaluation_seed"]) for report in reports}
    assert goals == {(0, training.EVALUATION_SEED), (1, training.EVALUATION_SEED + benchmark.GOALS_APART)}
    distances = [report["held_out"]["random"]["final_distance_mm"] for report in reports if report["algo"] == "random"]
    assert distances[0] != distances[1]


def test_curves_are_kept_and_drawn(done):
    out, _ = done
    points = read(out / "curves.csv")
    assert {(point["policy"], point["seed"]) for point in points} == {(a, s) for a in ("ppo", "sac") for s in "01"}
    assert [float(p["steps"]) for p in points if (p["policy"], p["seed"]) == ("ppo", "0")] == [60.0, 120.0]
    assert matplotlib.image.imread(out / "curves.png").shape[0] > 500


def test_an_interrupted_benchmark_goes_on_with_what_is_missing(done):
    out, said = done
    assert len([line for line in said if "success" in line]) == 8
    before = {path: path.stat().st_mtime_ns for path in out.glob("runs/*/report.json")}
    lost = out / "runs" / "reach-sac-seed1" / "report.json"
    lost.unlink()
    again = []
    benchmark.benchmark(out, ["reach"], [0, 1], say=again.append)
    assert [line.partition(":")[0] for line in again if "success" in line] == ["reach-sac-seed1"]
    after = {path: path.stat().st_mtime_ns for path in out.glob("runs/*/report.json")}
    assert [path for path in before if after[path] != before[path]] == [lost]


def test_runs_side_by_side_are_those_one_by_one(tmp_path):
    ours = [Run("reach", policy, 0, True, tmp_path) for policy in ("scripted", "random")]
    for one in ours:
        benchmark.least_times(one)
    found = sorted(each(benchmark.perform, ours, jobs=2), key=ours.index)
    assert found == ours
    alone = benchmark.reference(replace(ours[1], out=tmp_path / "alone"))
    assert json.loads(ours[1].report.read_text()) == json.loads(json.dumps(alone))


def test_time_over_the_fastest_is_that_of_the_episodes_that_succeed():
    blank = np.zeros(3)
    success = np.array([True, False, True])
    episodes = Episodes(success, np.array([2.0, 9.0, 4.0]), blank, blank, blank, blank, success)
    assert over_fastest(episodes, np.array([1.0, 1.0, 3.0])) == 1.5
    assert over_fastest(replace(episodes, success=~success & success), np.ones(3)) is None


def test_rows_pool_episodes_and_average_what_is_known(tmp_path):
    for seed, (successes, ratio) in enumerate([(0, None), (2, 1.2)]):
        one = Run("twist-align", "sac", seed, False, tmp_path)
        one.folder.mkdir(parents=True)
        found = {
            "episodes": 2,
            "successes": successes,
            "final_distance_mm": 1.0 + seed,
            "final_yaw_error_deg": 4.0,
            "time_to_success_s": ratio,
            "over_fastest": ratio,
            "energy_J": 10.0,
        }
        one.report.write_text(json.dumps({"held_out": {"sac": found}, "training_seconds": 60.0 * (1 + seed), "steps": 7}))
    (row,) = rows([Run("twist-align", "sac", seed, False, tmp_path) for seed in (0, 1)])
    assert (row.successes, row.episodes, row.seeds, row.steps) == (2, 4, 2, 7)
    assert (row.final_distance_mm, row.final_yaw_error_deg, row.minutes, row.over_fastest) == (1.5, 4.0, 1.5, 1.2)


def test_spread_is_over_what_all_seeds_have():
    points = [
        {"seed": seed, "steps": str(steps), "success_rate": str(rate)}
        for seed, curve in (("0", [(0, 0.0), (10, 1.0)]), ("1", [(2, 0.5), (12, 0.5)]))
        for steps, rate in curve
    ]
    at, low, mean, high = spread(points, "steps")
    np.testing.assert_allclose(at, [2, 10])
    np.testing.assert_allclose([low, mean, high], [[0.2, 0.5], [0.35, 0.75], [0.5, 1.0]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--jobs", "0"], "--jobs 0: expected"), (["--seeds", "-1"], "--seeds -1: expected")],
)
def test_the_command_line_refuses_what_makes_no_sense(arguments, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        train.main(["--benchmark", *arguments])
    assert message in capsys.readouterr().err


PUBLISHED = Path(train.__file__).parent / "docs" / "benchmark" / "benchmark.csv"
LEAST = {"reach": (0.98, 5.0), "twist-align": (0.95, 15.0), "pick-and-place": (0.9, 60.0)}
"""Success rate that the default of a task has to come to, and in how many minutes."""


@pytest.mark.skipif(not PUBLISHED.exists(), reason="no benchmark was run here: python train.py --benchmark")
@pytest.mark.parametrize("task", LEAST)
def test_the_published_defaults_are_the_best_and_good_enough(task):
    table = [row for row in read(PUBLISHED) if row["task"] == task and row["policy"] not in benchmark.REFERENCES]
    (default,) = [row for row in table if row["default"] == "True"]
    rate, minutes = LEAST[task]
    assert int(default["successes"]) >= rate * int(default["episodes"]) and float(default["minutes"]) < minutes
    assert int(default["seeds"]) >= 3
    best = max(table, key=lambda row: (int(row["successes"]), -float(row["over_fastest"])))
    # A rate within the interval of the best one is no worse.
    assert default == best or int(default["successes"]) >= float(best["low"]) * int(best["episodes"])
