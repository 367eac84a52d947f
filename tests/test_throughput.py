"""The study of how fast environments are stepped."""

import csv
import sys

import gymnasium as gym
import numba
import numpy as np
import pytest

from study import __main__ as command
from study import throughput
from study.throughput import Effort, Rate, Start


@pytest.fixture(scope="module")
def found():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(throughput.MOST, "async", 1)
        patch.setitem(throughput.MOST, "sync", 3)
        effort = Effort((1, 3, 5), 2, 60.0, 4)
        yield [rate for lanes in effort.lanes for rate in throughput.rates("reach", lanes, effort)]


def test_every_kind_is_measured_up_to_its_largest_batch(found):
    native = [("native", threads) for threads in throughput.THREADS if threads <= numba.config.NUMBA_NUM_THREADS]
    measured = {lanes: [(r.kind, r.threads) for r in found if r.lanes == lanes] for lanes in (1, 3, 5)}
    assert measured == {1: [*native, ("sync", 1), ("async", 1), ("single", 1)], 3: [*native, ("sync", 1)], 5: native}
    for r in found:
        assert r.steps == 4 * r.lanes and len(r.seconds) == 2
        assert min(r.seconds) > 0.0 and r.rate == pytest.approx(r.steps / np.mean(r.seconds))


def test_a_window_is_a_reset_and_an_episode():
    env = gym.make_vec("TCAReach-v0", num_envs=2, max_episode_steps=4)
    done, reset, step = [], env.reset, env.step
    env.reset = lambda: done.append("reset") or reset()
    env.step = lambda action: done.append(step(action)[3].all())
    throughput.play(env, np.zeros((3, 2, 3)), 4)
    assert done == ["reset", False, False, False, True]


def test_no_window_is_begun_without_patience():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(throughput, "batches", lambda *sizes: {("single", 1): lambda: gym.make("TCAReach-v0")})
        (only,) = throughput.rates("reach", 1, Effort((1,), 9, 0.0, 2))
    assert len(only.seconds) == 1


def test_memory_of_an_environment_holds_at_least_its_state():
    env = gym.make_vec("TCAPickAndPlace-v0", num_envs=1)
    env.reset(seed=0)
    state = sum(value.nbytes for name, value in env.get_state().items() if name != "rng")
    assert state < throughput.memory("pick-and-place", 8, 40) < 50e3


def test_the_script_of_a_first_step_says_two_times(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["-c", "TCAReach-v0"])
    exec(throughput.FIRST_STEP, {})
    imported, stepped = (float(word) for word in capsys.readouterr().out.split())
    assert 0.0 <= imported < stepped < 600.0


def test_the_first_step_uses_the_cache_that_it_is_given(monkeypatch, tmp_path):
    monkeypatch.setattr(throughput, "FIRST_STEP", "import os, sys; print(len(sys.argv[1]), os.environ['NUMBA_CACHE_DIR'][-1])")
    assert throughput.first_step("TCAReach-v0", tmp_path / "7") == (11.0, 7.0)


def test_a_cold_start_comes_before_the_warm_one(monkeypatch):
    asked = []

    def first_step(name, cache):
        asked.append((name, cache, list(cache.iterdir())))
        (cache / "compiled").touch()
        return (0.5, 10.0) if len(asked) == 1 else (0.4, 1.0)

    monkeypatch.setattr(throughput, "first_step", first_step)
    assert throughput.start("reach") == Start("reach", 0.4, 10.0, 1.0)
    (_, cold, empty), (_, warm, filled) = asked
    assert cold == warm and not empty and len(filled) == 1


def test_the_command_writes_table_figure_and_page(monkeypatch, tmp_path, capsys):
    def rates(task, lanes, effort):
        kinds = (("native", 1), ("native", 2), ("sync", 1), ("single", 1))
        return [Rate(task, *kind, lanes, (0.5, 0.1, 0.2), 100 * lanes) for kind in kinds]

    monkeypatch.setattr(throughput, "rates", rates)
    monkeypatch.setattr(throughput, "memory", lambda task: 12_345.0)
    monkeypatch.setattr(throughput, "start", lambda task: Start(task, 0.4, 10.0, 1.0))
    assert command.main(["throughput", "--out", str(tmp_path), "--quick"]) == 0
    with (tmp_path / "throughput.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 3 * 4
    assert [float(rows[0][f"{name}_steps_per_s"]) for name in ("median", "slowest", "fastest")] == [500.0, 200.0, 1000.0]
    page = (tmp_path / "throughput.md").read_text(encoding="utf-8")
    assert page in capsys.readouterr().out
    assert "| reach          | 64 | 32,000           | 32,000            | 32,000         |" in page
    assert "| reach | 32,000" in page and "| 12.3 " in page and "| 10.00 " in page
    assert (tmp_path / "throughput.png").stat().st_size > 10_000
