"""The study that drives the tasks' arms with policies that no controller is."""

import csv
import time

import numpy as np
import pytest

from study import pattern, torture
from tca_envs import registry
from tca_envs.mechanics import Rung, continuation, thermal
from tca_envs.robots import CUT_OFF
from tca_envs.tasks import core
from tca_envs.tasks.reach import Reach

SOLVE = continuation.solve
TASKS = [entry.name for entry in registry.entries()]


class Heated(core.Core):
    """A core whose arm does nothing: its temperatures are all that a policy looks at."""

    def __init__(self, task):
        vars(self).update(vars(task.core(torture.LANES)))

    def _solve(self, record, temperature, external, heat=None):
        asked = 0.5 * (heat.action + 1.0) * self.heating.max_power
        allowed = thermal.power_to_reach(record.temperature, CUT_OFF, core.STEP_S, self.heating)
        power = np.clip(allowed, 0.0, asked)
        record.temperature[:] = thermal.step(record.temperature, power, core.STEP_S, self.heating)
        return np.zeros(len(temperature), dtype=continuation.REPORT)


@pytest.fixture(scope="module")
def histories():
    """Temperatures of TCATwistAlign's TCAs (steps, lanes, 4) under each policy, in episodes of 100 steps."""
    task, result = registry.entry("twist-align").new(), {}
    for name, policy in torture.POLICIES.items():
        heated, steps = Heated(task), []
        act = policy(np.random.default_rng(1), torture.LANES, task.actions, 4)
        for step in range(1500):
            if step % 100 == 0:
                heated.record.temperature[:] = 25.0
            action = act(heated, np.full(torture.LANES, step % 100))
            assert action.shape == (torture.LANES, 4) and np.abs(action).max() <= 1.0
            heated.step(action)
            steps.append(heated.record.temperature.copy())
        result[name] = np.array(steps)
    return result


@pytest.fixture
def no_goals(monkeypatch):
    """Episodes without a goal: none has to be solved for."""
    monkeypatch.setattr(Reach, "sample", lambda task, core, rngs: (np.zeros((len(rngs), 3)), np.empty((len(rngs), 0))))


def changes(history):
    """Return the size of the temperature steps within episodes."""
    return np.linalg.norm(np.diff(history.reshape(-1, 100, torture.LANES, 4), axis=1), axis=-1)


def test_the_adversary_makes_larger_temperature_steps_than_random_powers(histories):
    largest = {name: np.quantile(changes(history), [0.5, 0.99]) for name, history in histories.items()}
    assert (largest["adversary"] > 1.1 * largest["random"]).all()
    assert largest["adversary"][0] > 2.0 * max(largest["all-on"][0], largest["all-off"][0])


def test_the_adversary_sets_hot_against_cold(histories):
    """Up to three TCAs near the cut-off while others are cold: every way of it. Random powers never do that."""

    def extremes(history):
        hot, cold = history > 150.0, history < 50.0
        return {tuple(row) for row in hot[(hot | cold).all(axis=2)].tolist()}

    assert len(extremes(histories["adversary"])) == 16
    assert len(extremes(histories["random"])) == 1


def test_the_adversary_takes_the_largest_steps_first(monkeypatch):
    monkeypatch.setattr(torture, "GREEDY", 0.0)
    act = torture.adversary(np.random.default_rng(0), torture.LANES, 4, 4)
    heated = (act(Heated(registry.entry("twist-align").new()), np.zeros(torture.LANES, dtype=int)) > 0.0).sum(axis=1)
    assert heated.tolist() == [4, 3, 3, 3, 3, 2, 2, 2, 2, 2]


def test_all_on_and_all_off_go_on_to_their_ends_from_random_states(histories):
    for name, end in (("all-on", 158.0), ("all-off", 29.9)):
        cycles = histories[name].reshape(-1, torture.CYCLE, torture.LANES, 4)
        assert np.abs(cycles[:, -1] - end).max() < 5.0
        assert np.ptp(cycles[:, 20], axis=(0, 1)).min() > 100.0


def test_half_of_the_lanes_of_bang_bang_hold_their_powers(histories):
    rises = np.diff(histories["bang-bang"].reshape(-1, 100, torture.LANES, 4), axis=1) > 0.0
    turns = (rises[:, 1:] != rises[:, :-1]).mean(axis=(0, 1, 3))
    assert (turns[0::2] > 0.4).all() and (turns[1::2] < 0.2).all()


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("policy", torture.POLICIES)
def test_nothing_fails(task, policy):
    run = torture.drive(task, policy, 95)
    assert run.cpu.shape == run.wall.shape == run.change.shape == run.finite.shape == (100,)
    assert run.rungs.sum() == 100 and len(run.failed) == 0
    assert run.finite.all() and (run.cpu > 0.0).all() and run.change.max() > 5.0


def test_a_broken_solver_is_found_out(monkeypatch, no_goals):
    """One that gives up above 60 degC: each failure is counted, told with its temperatures, and ends the episode."""

    def gives_up(arm, lanes, drive, load, threads=1, heat=None):
        before = [values.copy() for values in lanes]
        report = SOLVE(arm, lanes, drive, load, threads, heat)
        if drive.max() > 60.0:
            for values, kept in zip(lanes, before, strict=True):
                values[:] = kept
            report["rung"] = Rung.FAILED
        return report

    monkeypatch.setattr(continuation, "solve", gives_up)
    run = torture.drive("reach", "all-on", 400)
    assert 400 - run.rungs.sum() == len(run.failed)
    assert 20 < len(run.failed) <= 100
    for start, end, payload in run.failed:
        assert end.max() > 60.0 >= start.max() > 49.0 and payload == 2.1e-3
    (column,) = (column for column in torture.COLUMNS if column.name == "failed")
    assert column.of(run) == len(run.failed)
    assert f"{len(run.failed)} solves failed" in torture.report([run])


def test_falls_are_counted_and_looked_at(monkeypatch):
    """One TCA alone: near 145 degC the arm buckles, in each lane once; it would come back the same way."""
    monkeypatch.setitem(torture.POLICIES, "one", lambda rng, lanes, *_: lambda core, age: np.tile([1.0, -1, -1], (lanes, 1)))
    run = torture.drive("reach", "one", 30 * torture.LANES)
    assert run.rungs[torture.RUNGS.index(Rung.DESCENT)] == torture.LANES
    assert run.jumps == 0
    assert run.stability.size in (torture.LANES + 1, torture.LANES + 2) and 0.0 < run.stability.min() < 0.5


def test_stability_is_that_of_the_equilibrium():
    lanes = registry.entry("reach").new().core(2)
    for _ in range(10):
        lanes.step(np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, 0.0]]))
    record = lanes.record
    for lane, temperature in enumerate(record.temperature):
        expected = lanes.arm.equilibrium(temperature).stability
        assert 0.0 < expected < 1.0 and torture.stability_of(lanes, lane) == pytest.approx(expected, abs=1e-4)
    # What is no equilibrium on this grid is looked at on a finer one.
    record.strain[1, :, 0] += 5.0
    finer = lanes.arm.finer.equilibrium(record.temperature[1]).stability
    assert abs(finer - expected) > 1e-3 and torture.stability_of(lanes, 1) == pytest.approx(finer, abs=1e-4)


def test_numbers_that_are_not_finite_are_found(monkeypatch, no_goals):
    def breaks(arm, lanes, drive, load, threads=1, heat=None):
        report = SOLVE(arm, lanes, drive, load, threads, heat)
        if drive.max() > 130.0:
            lanes.length[:] = np.nan  # path lengths, which are not observed
        return report

    monkeypatch.setattr(continuation, "solve", breaks)
    run = torture.drive("reach", "random", 1000)
    assert 0 < (~run.finite).sum() < 1000
    assert f"{(~run.finite).sum()} steps left a number that is not finite" in torture.report([run])


def test_a_slow_solve_is_found_with_its_temperatures(monkeypatch, no_goals):
    """Time that the solver computes counts; time that it only waits does not, but on the clock."""
    slow = []

    def dawdles(arm, lanes, drive, load, threads=1, heat=None):
        start = lanes.drive[0].copy()
        report = SOLVE(arm, lanes, drive, load, threads, heat)
        end = drive[0].copy()
        if end.max() > 60.0 and not slow:
            slow.append((start, end))
            begun = time.thread_time()
            while time.thread_time() < begun + 0.03:
                pass
        if end.max() > 80.0 and len(slow) == 1:
            slow.append(end)
            time.sleep(0.08)
        return report

    monkeypatch.setattr(continuation, "solve", dawdles)
    run = torture.drive("reach", "all-on", 300)
    assert 0.03 <= run.cpu.max() < 0.06 and run.wall.max() > 0.08
    assert np.array_equal(run.slowest.start, slow[0][0]) and np.array_equal(run.slowest.end, slow[0][1])
    assert "1 took 20 ms or longer" in torture.report([run])


def test_the_study_writes_a_table_and_a_page(tmp_path, monkeypatch):
    monkeypatch.setattr(torture, "QUICK", 20)
    runs = torture.measure(quick=True)
    page = torture.report(runs)
    pattern.save_table(tmp_path / "torture.csv", torture.COLUMNS, runs)
    with (tmp_path / "torture.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["task"], row["policy"]) for row in rows] == [(task, policy) for task in TASKS for policy in torture.POLICIES]
    for row in rows:
        assert row["steps"] == "20" and row["failed"] == row["not_finite"] == row["jumped"] == "0"
        assert sum(int(row[rung.name.lower()]) for rung in torture.RUNGS) == 20
        assert len(row["slowest_to_degC"].split()) == (3 if row["task"] == "reach" else 4)
        cells = next(
            line for line in page.splitlines() if line.startswith(f"| {row['task']} ") and f" {row['policy']} " in line
        )
        assert f"{1e3 * float(row['max_cpu_s']):.2f}" in cells
    assert "In 300 steps, at least 20 of each task under each policy: 0 solves failed" in page
