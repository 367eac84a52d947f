"""The study of where methods fail."""

import csv
from math import nan

import numpy as np
import pytest

from study import __main__ as command
from study import pattern, stability, stability_cells
from study.method import Answer, State
from study.methods import bvp, paper, wrench_shooting
from study.scenes import Case
from study.stability import Result
from study.stability_judge import WORDS, Outcome, outcome

OURS, WRENCH = stability.OURS.name, wrench_shooting.METHOD.name


def row(method, what, x=0.0, lost="", doubt="", seconds=1e-3, jumps=0, note=""):
    return Result("tension-force", x, 0.0, method, what, seconds, nan, jumps, lost, doubt, note)


def test_the_maps_cover_what_was_asked_for():
    families = [build(4) for build in stability_cells.FAMILIES.values()]
    assert all(len(family.cells) == 16 and len(family.xs) == len(family.ys) == 4 for family in families)
    by_name = {family.name: family for family in families}
    assert by_name["tension-force"].xs[-1] == 1.8 and by_name["tension-force"].ys[-1] == 0.6
    assert by_name["length-tension"].xs == [45.0, 80.0, 170.0, 250.0]
    assert by_name["step-tilt"].ys[0] == 1.0 and by_name["step-tilt"].ys[-1] == 135.0
    cases = [cell.case for cell in by_name["random-tilt"].cells if cell.y == 135.0]
    assert all(np.abs(case.state.drive - case.before.drive) == pytest.approx(135.0) for case in cases)
    down, up = by_name["cold-tilt"].cells[0], by_name["cold-tilt"].cells[-1]
    assert down.case.state.load[8] > 9.8 and up.case.state.load[8] < -9.8


def test_a_slow_change_follows_its_branch_and_says_where_it_jumps():
    arm = stability_cells.rod(45e-3)
    easy = State(arm, np.array([0.3]), (0.0, 0.02, 0.0))
    walk = stability_cells.follow(easy, None)
    assert walk.jumps == 0
    assert walk.found.tip_pose == pytest.approx(arm.equilibrium([0.3], (0.0, 0.02, 0.0)).tip_pose, abs=1e-6)
    # A long rod snaps through.
    arm = stability_cells.rod(135e-3)
    walk = stability_cells.follow(State(arm, np.array([0.77]), (0.0, 0.05, 0.0)), None)
    assert walk.jumps == 1 and walk.found.stable


def test_a_collapsed_section_is_no_equilibrium():
    """A straight tendon collapses this rod at 1.91 N, without any load."""
    arm = stability_cells.Arm(stability_cells.rod(45e-3).modules)
    walk = stability_cells.follow(State(arm, np.array([1.95])), None)
    assert walk.found is None and walk.lost == stability_cells.COLLAPSE


def test_slow_changes_that_disagree_are_in_doubt():
    arm = stability_cells.rod(45e-3)
    state = State(arm, np.array([0.3]))
    here, there = (stability_cells.Walk(arm.equilibrium([tension]), 0, "") for tension in (0.3, 0.2))
    collapsed, lost = (stability_cells.Walk(None, 0, why) for why in (stability_cells.COLLAPSE, "too long"))
    assert stability_cells.doubt(state, here, here) == "" == stability_cells.doubt(state, collapsed, collapsed)
    assert "only one" in stability_cells.doubt(state, here, collapsed)
    assert "nothing collapses: too long" in stability_cells.doubt(state, lost, lost)
    assert "apart" in stability_cells.doubt(state, here, there)
    assert "confirmed" in stability_cells.doubt(state, there, there)


def test_answers_are_told_apart():
    """Of an arm that stands on end, methods that go straight to an answer find it standing."""
    arm = stability_cells.tilted(179.0)
    state = State(arm, np.full(3, 25.0))
    fallen = stability.ours(arm, "", []).solve(state, None)
    right = fallen.guess
    assert outcome(state, fallen, right, arm) is Outcome.RIGHT
    assert outcome(state, fallen, None, arm) is Outcome.OTHER
    assert outcome(state, Answer(False, np.eye(4), None), right, arm) is Outcome.NOTHING
    for method, setting in ((wrench_shooting.METHOD, 16), (bvp.METHOD, 1e-3), (paper.METHODS[0], 1e-3)):
        solver = method.build(arm, setting, [state])
        assert outcome(state, solver.solve(state, solver.cold()), right, arm) is Outcome.UNSTABLE
    hot = State(arm, np.array([25.0, 25.0, 80.0]))
    assert outcome(hot, fallen, None, arm) is Outcome.WRONG  # nothing is found from there
    arm = stability_cells.tilted(1.0)
    hanging = stability.ours(arm, "", []).solve(State(arm, np.full(3, 25.0)), None)
    for temperature, what in ((30.0, Outcome.OTHER), (110.0, Outcome.WRONG)):
        warmer = State(arm, np.array([temperature, 25.0, 25.0]))
        assert outcome(warmer, hanging, None, arm) is what
    inaccurate = State(arm, np.array([55.0, 25.0, 25.0]))
    right = stability.ours(arm, "", []).solve(inaccurate, None).guess
    off = np.linalg.norm(right.tip_pose[:3, 3] - hanging.tip[:3, 3]) / arm.length
    assert 0.01 < off < 0.02 and outcome(inaccurate, hanging, right, arm) is Outcome.RIGHT


def test_rates_and_times_leave_out_what_says_nothing():
    rows = [
        row(OURS, Outcome.RIGHT), row(OURS, Outcome.OTHER, 1.0, seconds=5e-3), row(OURS, Outcome.NOTHING, 2.0, lost="collapse"),
        row(OURS, Outcome.NOTHING, 3.0, doubt="two ends", seconds=nan),
    ]  # fmt: skip
    assert stability.failure_rate(rows) == 0.5
    assert stability.times(rows) == (1e-3, 5e-3)
    assert np.isnan(stability.failure_rate(rows[2:])) and np.isnan(stability.times(rows[3:])).all()
    line = stability.table(rows).splitlines()[-1].replace(" ", "")
    assert line == f"|{OURS}|50%|50%|1|1ms|5ms|5ms|5ms|".replace(" ", "")


def test_the_verdict_follows_from_the_cells():
    good = [
        row(OURS, Outcome.RIGHT),
        row(WRENCH, Outcome.RIGHT),
        row(OURS, Outcome.NOTHING, 1.0),
        row(WRENCH, Outcome.OTHER, 1.0),
    ]
    assert stability.verdict(good).startswith("On every one of 1 cells")
    bad = [*good, row(OURS, Outcome.OTHER, 2.0, note="DESCENT"), row(WRENCH, Outcome.RIGHT, 2.0)]
    text = stability.verdict(bad)
    assert text.startswith("On 1 of 2 cells")
    assert f"tension-force at 2, 0: {WORDS[Outcome.OTHER]} (DESCENT); found by {WRENCH}" in text
    in_doubt = [*good, row(OURS, Outcome.OTHER, 2.0, doubt="two ends"), row(WRENCH, Outcome.RIGHT, 2.0, doubt="two ends")]
    assert stability.verdict(in_doubt) == stability.verdict(good)
    sound = stability.soundness([*(r for r in good if r.method == OURS), row(OURS, Outcome.NOTHING, 2.0, seconds=nan)])
    assert "All 1 answers" in sound and "on 1 cells it says" in sound and "1 steps have nothing" in sound
    assert "1 of 1 answers" in stability.soundness([row(OURS, Outcome.UNSTABLE)])


def test_the_study_writes_maps_chart_table_and_page(tmp_path, monkeypatch):
    family = stability_cells.FAMILIES["tension-force"](2)
    monkeypatch.setattr(stability, "FAMILIES", {family.name: lambda count: family})
    monkeypatch.setattr(stability, "COMPARED", (stability.COMPARED[0], (wrench_shooting.METHOD, 16)))
    monkeypatch.setattr(stability.torture, "measure", lambda quick: [quick])
    monkeypatch.setattr(stability.torture, "report", lambda runs: f"## Policies\n\n{runs}\n")
    said = []
    tables = {"stability.csv": stability.STUDY.tables["stability.csv"]}
    pattern.run(stability.STUDY._replace(tables=tables), tmp_path, said.append, quick=True)
    with (tmp_path / "stability.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 and {r["method"] for r in rows} == {OURS, WRENCH}
    mine = [r for r in rows if r["method"] == OURS]
    assert all(
        r["outcome"] == "right" and float(r["tip_off_relative"]) < 1e-4 and 0.0 < float(r["seconds"]) < 1.0 for r in mine
    )
    assert (tmp_path / "stability_map.png").stat().st_size > 10_000 < (tmp_path / "failure_rate.png").stat().st_size
    page = (tmp_path / "stability.md").read_text(encoding="utf-8")
    assert "4 cells, 4 with a right answer" in page and "On every one of" in page and f"| {OURS} " in page
    assert said[0] in page and page.endswith("\n\n## Policies\n\n[True]\n")


def test_a_step_starts_from_the_methods_own_answer():
    arm = stability_cells.tilted(60.0)
    before, state = State(arm, np.full(3, 25.0)), State(arm, np.array([30.0, 25.0, 25.0]))
    cell = stability_cells.Cell(0.0, 0.0, Case(before, state))
    family = stability_cells.Family("step", "", "", "", (cell,))
    methods = (stability.COMPARED[0], (wrench_shooting.METHOD, 32))
    mine, other = stability.measure(family, methods, stability_cells.Referee())
    assert mine.right and mine.note == "WARM" and other.right and other.note == ""


def test_the_command_takes_no_other_option(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main(["stability", "--out", str(tmp_path), "--scene", "reach"])
    assert "--scene" in capsys.readouterr().err
