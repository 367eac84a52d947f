"""The study of what tolerances promise and cost."""

import csv

import numpy as np
import pytest

from study import __main__ as command
from study import pattern, tolerance
from study.method import State
from tca_envs.mechanics import Arm, Grid
from tca_envs.robots import paper


@pytest.fixture(scope="module")
def kept():
    return tolerance.measure("pick-and-place", 6, 3)


def test_a_task_is_measured_at_every_tolerance(kept):
    assert [k.tolerance for k in kept] == list(tolerance.TOLERANCES)
    for k in kept:
        assert k.error.shape == (6,) and k.within == 1.0
        assert k.arm.discretisation.tolerance == k.tolerance
        assert 0.0 < k.solve < 1.0 and 0.0 < k.step < 1.0
    medians = [np.median(k.error) for k in kept]
    assert medians == sorted(medians, reverse=True) and medians[0] > 1e-7 and 0.0 < medians[-1] < 1e-8


def test_every_second_state_holds_the_object():
    cases = tolerance.random_cases(paper.whole_arm(), True, 6)
    assert [case.state.payload is not None for case in cases] == [False, True] * 3
    assert all(case.state.payload is None for case in tolerance.random_cases(paper.whole_arm(), False, 6))
    assert all(np.abs(case.state.drive - case.before.drive).max() <= tolerance.CHANGE for case in cases)


def test_a_wrong_arm_is_found_out():
    """The truth does not come from the arms that are judged: a coarse grid's error shows, a failure counts as outside."""
    arm = paper.bending_arm()
    coarse = Arm(arm.modules, arm.gravity, arm.payload, [Grid(1, 3)], 1e-9)
    case = tolerance.Case(*(State(arm, np.array([hot, 30.0, 30.0])) for hot in (100.0, 105.0)))
    fine = tolerance.finer(arm)
    near, far = tolerance.true_errors([arm, coarse], fine, case)
    assert near < 1e-5 < far < 1e-3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tolerance, "reference", fails)
        assert tolerance.true_errors([arm], fine, case) == [np.inf]
    lost = tolerance.Kept("reach", arm, 1e-5, np.array([np.inf, 1e-6, 1e-4, 1e-5]), 1.0, 1.0)
    assert lost.within == 0.5


def fails(*arguments):
    raise tolerance.NoReference("none")


def test_the_study_writes_table_figure_and_page(kept, tmp_path):
    pattern.run(tolerance.STUDY._replace(measure=lambda: kept), tmp_path, lambda words: None)
    with (tmp_path / "tolerance.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["tolerance_m"]) for row in rows] == list(tolerance.TOLERANCES)
    assert rows[0]["grids"] == kept[0].grids and float(rows[0]["share_within"]) == 1.0
    assert (tmp_path / "tolerance.png").stat().st_size > 10_000
    page = (tmp_path / "tolerance.md").read_text(encoding="utf-8")
    assert page.count("| pick-and-place |") == len(kept) and "at least 100.00 %" in page


def test_the_command_takes_no_other_option(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main(["tolerance", "--out", str(tmp_path), "--scene", "reach"])
    assert "--scene" in capsys.readouterr().err
