"""The speed-accuracy and size studies: scenes, what counts as a failure, who beats whom, what the commands write."""

import csv
import time
from dataclasses import replace
from functools import partial
from math import isnan, nan
from typing import NamedTuple

import matplotlib.image
import numpy as np
import pytest

from study import __main__ as command
from study import chart, pattern, scenes, size, speed_accuracy, timing
from study.method import Answer, Method
from study.methods import METHODS, collocation
from study.timing import Effort, Point, Referee
from tca_envs.mechanics import Payload

COUNT = 6
"""Cases of a scene."""
BRIEF = Effort(cases=COUNT, budget=np.inf, least=1, patience=np.inf)
"""All cases of a scene."""


@pytest.fixture(scope="module", params=scenes.SCENES)
def scene(request):
    return scenes.SCENES[request.param](COUNT)


# Scenes.


def test_scenes_have_the_cases_that_are_asked_for(scene):
    assert len(scene.cases) == COUNT
    assert scene.start == ("cold" if scene.name == "cold" else "warm")
    for case in scene.cases:
        assert case.state.arm is scene.arm
        assert (case.before is None) == (scene.start == "cold")
        if case.before is not None:
            assert not np.array_equal(case.before.drive, case.state.drive) or case.before.payload != case.state.payload


def test_scenes_are_the_same_every_time(scene):
    again = scenes.SCENES[scene.name](COUNT)
    for one, other in zip(scene.cases, again.cases, strict=True):
        for a, b in zip(one, other, strict=True):
            assert (a is None) == (b is None)
            if a is not None:
                np.testing.assert_array_equal(a.drive, b.drive)
                np.testing.assert_array_equal(a.load, b.load)


def test_states_of_scenes_have_equilibria_that_this_package_finds(scene):
    referee = Referee(scene)
    for index, (before, state) in enumerate(scene.cases):
        start = None if before is None else timing.equilibrium(scene.arm, before)
        tip = timing.equilibrium(scene.arm, state, start).tip_pose[:3, 3]
        assert np.linalg.norm(tip - referee(index).tip) < 1e-5


def test_one_degree_changes_every_tca_by_one_degree_between_the_limits():
    cases = scenes.one_degree(250).cases
    change = np.array([case.state.drive - case.before.drive for case in cases])
    np.testing.assert_array_equal(np.abs(change), 1.0)
    drives = np.array([case.state.drive for case in cases])
    assert drives.min() == 25.0 and drives.max() == 150.0
    assert np.ptp(drives, axis=1).min() > 10.0, "the arm is bent"


def test_recorded_states_change_temperature_and_payload_as_the_task_does():
    cases = scenes.SCENES["pick-and-place"](30).cases
    change = np.array([np.abs(case.state.drive - case.before.drive).max() for case in cases])
    assert ((change > scenes.LEAST_CHANGE) | [case.before.payload != case.state.payload for case in cases]).all()
    assert change.max() < 15.0
    masses = {round(1e3 * case.state.payload.mass, 3) for case in cases}
    assert masses == {0.9, 2.4}, "without and with the object"


def test_evenly_keeps_the_ends():
    assert pattern.evenly(list(range(10)), 4) == [0, 3, 6, 9]
    assert pattern.evenly([1, 2], 5) == [1, 2]


@pytest.mark.parametrize("count", [1, 2, 3, 12, 13])
def test_the_order_spreads_every_beginning(count):
    order = timing.spread(count)
    assert sorted(order) == list(range(count))
    assert order[0] == 0 and (count < 8 or order[1] >= count // 2)


# Failures.


class Fake(NamedTuple):
    """A solver whose answers are those of the package's, spoilt on some calls."""

    inner: object
    spoil: object
    """(answer, state) -> answer"""

    def cold(self):
        return self.inner.cold()

    def near(self, known, state):
        return self.inner.near(known, state)

    def solve(self, state, guess):
        return self.spoil(self.inner.solve(state, guess), state)


def fake(spoil, **options):
    def build(arm, setting, states):
        return Fake(collocation.Collocation(arm), spoil)

    return Method("fake", "knob", (1,), build, **options)


def failed(answer, state):
    return Answer(False, answer.tip, None)


def moved(by):
    def spoil(answer, state):
        tip = answer.tip.copy()
        tip[0, 3] += by
        return Answer(True, tip, answer.guess)

    return spoil


@pytest.fixture(scope="module")
def bending():
    return scenes.cold(4)


def measured(scene, method, effort=BRIEF):
    (point,) = timing.points(scene, method, Referee(scene), effort)
    return point


def test_a_good_method_has_times_and_errors(bending):
    point = measured(bending, fake(lambda answer, state: answer))
    assert (point.cases, point.failed, point.failure_rate, point.note) == (4, 0, 0.0, "")
    assert 0.0 < point.time_q25 <= point.time <= point.time_q75 < 1.0
    assert 0.0 < point.error <= point.error_p95 <= point.error_max < 1e-6
    assert isnan(point.own_error) and point.start == "cold"


def test_errors_are_distances_of_the_tip(bending):
    assert measured(bending, fake(moved(1e-4))).error == pytest.approx(1e-4, rel=1e-3)


@pytest.mark.parametrize("spoil", [failed, moved(nan), moved(np.inf), moved(0.11 * 45e-3)], ids=["said", "nan", "inf", "far"])
def test_what_fails_on_all_cases_has_no_numbers(bending, spoil):
    point = measured(bending, fake(spoil))
    assert (point.cases, point.failed, point.failure_rate) == (4, 4, 1.0)
    assert isnan(point.time) and isnan(point.error)
    assert point.note == "fails on all cases" and not point.solved


def test_a_near_or_a_reduced_answer_is_no_failure(bending):
    assert measured(bending, fake(moved(0.09 * 45e-3))).failed == 0
    far = measured(bending, fake(moved(0.2 * 45e-3), reduced=True))
    assert far.failed == 0 and far.error == pytest.approx(0.2 * 45e-3, rel=1e-3)


def test_failed_cases_count_and_enter_no_median(bending):
    fails = {tuple(case.state.drive) for case in bending.cases[:1]}

    def spoil(answer, state):
        if tuple(state.drive) not in fails:
            return answer
        time.sleep(0.02)
        return moved(1.0)(answer, state)

    point = measured(bending, fake(spoil))
    assert (point.cases, point.failed, point.failure_rate) == (4, 1, 0.25)
    assert point.error_max < 1e-6 and point.time_q75 < 0.02 and point.solved


def test_a_method_that_fails_at_the_state_before_fails():
    scene = scenes.heavy(2)
    befores = {tuple(case.before.drive) for case in scene.cases}
    point = measured(scene, fake(lambda answer, state: failed(answer, state) if tuple(state.drive) in befores else answer))
    assert (point.cases, point.failed) == (2, 2)


def test_a_method_that_refuses_the_arm_is_noted(bending):
    def build(arm, setting, states):
        raise ValueError("one TCA at most")

    point = measured(bending, replace(fake(failed), build=build))
    assert point.cases == 0 and isnan(point.failure_rate) and not point.solved
    assert point.note == "cannot model this arm: one TCA at most"


def test_a_method_whose_package_is_missing_is_noted(bending):
    point = measured(bending, fake(failed, available=lambda: False))
    assert (point.cases, point.note) == (0, "not installed")


def test_the_budget_ends_a_point_and_patience_a_method(bending):
    def slow(answer, state):
        time.sleep(0.03)
        return answer

    method = replace(fake(slow), settings=(1, 2))
    first, second = timing.points(bending, method, Referee(bending), Effort(4, 0.02, 2, 0.05))
    assert first.cases == 2
    assert second.cases == 0 and second.note.startswith("not run")


def test_what_builds_slowly_is_left_out_when_there_is_no_time(bending):
    built = []

    def build(arm, setting, states):
        built.append(setting)
        time.sleep(0.02)
        return collocation.Collocation(arm)

    method = Method("fake", "knob", (1, 2, 3), build, builds_slowly=True)
    for building, settings in ((0.0, []), (0.03, [1, 2]), (np.inf, [1, 2, 3])):
        built.clear()
        found = timing.points(bending, method, Referee(bending), BRIEF._replace(building=building))
        assert built == settings and [p.solved for p in found] == [s in settings for s in (1, 2, 3)]
        assert all(p.note.startswith("not run") for p in found if not p.solved)
    quickly = replace(method, builds_slowly=False)
    assert all(p.solved for p in timing.points(bending, quickly, Referee(bending), BRIEF._replace(building=0.0)))


def test_the_error_against_the_finest_setting(bending):
    def build(arm, setting, states):
        return Fake(collocation.Collocation(arm), moved(setting))

    method = Method("fake", "shift", (3e-3, 2e-3), build, own_limit=True)
    coarse, fine = timing.points(bending, method, Referee(bending), BRIEF)
    assert coarse.error == pytest.approx(3e-3, rel=1e-3)
    assert coarse.own_error == pytest.approx(1e-3, rel=1e-9) and fine.own_error == 0.0


def test_a_warm_start_continues_the_methods_own_answer():
    scene, asked = scenes.heavy(1), []

    class Recorder(NamedTuple):
        def cold(self):
            raise AssertionError("warm starts only")

        def near(self, known, state):
            asked.append(("near", tuple(known.drive), tuple(state.drive)))
            return "near"

        def solve(self, state, guess):
            asked.append((guess, tuple(state.drive)))
            return Answer(True, np.eye(4), "own")

    measured(scene, Method("fake", "knob", (1,), lambda arm, setting, states: Recorder(), reduced=True))
    before, after = (tuple(state.drive) for state in scene.cases[0])
    *first, asked_last = asked
    assert first[:2] == [("near", before, before), ("near", before)]
    assert set(asked) == {*first[:2], ("own", after)} and asked_last == ("own", after)


# Who beats whom.


def point(error, seconds, failed=0, method="theirs", setting="1", note=""):
    return Point("s", method, "knob", setting, "warm", 10, failed, seconds, seconds, seconds, error, error, error, note=note)


NOTHING = Point("s", "theirs", "knob", "1", "warm", 10, 10, note="fails on all cases")
OURS = [point(1e-4, 1.0), point(1e-6, 2.0), point(1e-5, 3.0), point(1e-8, 4.0)]


def test_the_front_is_what_nothing_beats():
    assert speed_accuracy.front([*reversed(OURS), NOTHING]) == [OURS[0], OURS[1], OURS[3]]
    assert speed_accuracy.front([point(1.0, 1.0), point(0.5, 1.0)]) == [point(0.5, 1.0)]
    assert speed_accuracy.front([point(0.5, 2.0), point(0.5, 1.0)]) == [point(0.5, 1.0)]
    assert speed_accuracy.front([]) == []


@pytest.mark.parametrize(("error", "expected"), [(1e-3, 10.0), (1e-4, 10.0), (9e-5, 5.0), (1e-8, 2.5), (1e-9, nan)])
def test_ratios_are_to_the_fastest_that_is_as_accurate(error, expected):
    assert speed_accuracy.ratio(OURS, point(error, 10.0)) == pytest.approx(expected, nan_ok=True)


def test_a_rival_fails_no_more_often():
    ours = [point(1e-6, 1.0, failed=2), point(1e-6, 4.0)]
    assert speed_accuracy.ratio(ours, point(1e-5, 8.0)) == 2.0
    assert speed_accuracy.ratio(ours, point(1e-5, 8.0, failed=2)) == 8.0


def test_beaten_needs_both_faster_and_more_accurate():
    assert speed_accuracy.beaten(OURS, [point(1e-7, 2.5), point(1e-5, 0.5), NOTHING]) == [(point(1e-5, 0.5), OURS[0])]
    assert speed_accuracy.beaten(OURS, [point(1e-4, 0.5), point(1e-5, 1.0), point(1e-9, 9.0)]) == []


def test_the_verdict_names_who_beats_us():
    ours = [p._replace(method=speed_accuracy.OURS) for p in OURS]
    calm = speed_accuracy.verdict({"s": [*ours, point(1e-7, 9.0)]})
    assert calm.startswith("No point of another method")
    beaten = speed_accuracy.verdict({"s": [*ours, point(1e-5, 0.5, failed=3)]})
    assert "* s: theirs at knob 1 (500 ms, 10 µm, fails on 30 %) beats 1 (1 s, 100 µm)" in beaten


def test_cells_of_the_table_of_ratios():
    ours = [p._replace(method=speed_accuracy.OURS) for p in OURS]
    theirs = [point(1e-3, 10.0), point(1e-7, 40.0, failed=1), point(1e-9, 90.0), NOTHING]
    assert speed_accuracy.ratios([*ours, *theirs], "theirs") == "10; 1 of 3 more accurate; fails on up to 100 %"
    assert speed_accuracy.ratios([*ours, NOTHING], "theirs") == "fails on all cases"
    refused = NOTHING._replace(cases=0, failed=0, note="cannot model this arm: one module")
    assert speed_accuracy.ratios([*ours, refused], "theirs") == "cannot model this arm"


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.5, "1.5 s"), (0.0, "0 s"), (1e-3, "1 ms"), (2.346e-5, "23.5 µs"), (1e-13, "100 fs"), (1e-18, "0.001 fs"), (nan, "--")],
)
def test_numbers_with_prefixes(value, text):
    assert pattern.si(value, "s") == text


@pytest.mark.parametrize(("share", "text"), [(0.0, "0 %"), (0.001, "1 %"), (0.999, "99 %"), (1.0, "100 %"), (0.333, "33 %")])
def test_percentages_are_none_or_all_only_if_they_are(share, text):
    assert pattern.percent(share) == text


# What is written.


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A run with this package's method, coarse and fine, and fakes, on a scene; returns folder and what was said."""
    folder = tmp_path_factory.mktemp("study")
    said = []
    bad = replace(fake(failed), name="bad", settings=(0.5, 1))
    some = replace(fake(lambda answer, state: failed(answer, state) if state.drive[0] > 80.0 else answer), name="some")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed_accuracy, "QUICK", Effort(4, np.inf, 1, np.inf))
        ours = replace(METHODS[0], settings=METHODS[0].settings[:2])
        study = speed_accuracy.STUDY._replace(measure=partial(speed_accuracy.measure, methods=[ours, bad, some]))
        pattern.run(study, folder, said.append, scenes=["cold"], quick=True)
    return folder, "\n".join(said)


def test_the_run_writes_every_point(written):
    folder, _ = written
    assert {path.name for path in folder.iterdir()} == {
        "speed_accuracy.png", "speed_accuracy_cold.png", "speed_accuracy.csv", "speed_accuracy.md",
    }  # fmt: skip
    with (folder / "speed_accuracy.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [column.name for column in speed_accuracy.COLUMNS if column.name]
    coarse, fine = map(timing.label, METHODS[0].settings[:2])
    asked = [(METHODS[0].name, coarse), (METHODS[0].name, fine), ("bad", "0.5"), ("bad", "1"), ("some", "1")]
    assert [(row["method"], row["setting"], row["cases"]) for row in rows] == [(*pair, "4") for pair in asked]
    assert {row["scene"] for row in rows} == {"cold"} and {row["start"] for row in rows} == {"cold"}
    ours, *_, bad, some = rows
    assert float(ours["failure_rate"]) == 0.0 and 0.0 < float(ours["median_time_s"]) < 1.0
    assert float(ours["median_error_m"]) < 1e-3 and ours["median_own_error_m"] == "nan"
    assert float(bad["failure_rate"]) == 1.0 and bad["median_time_s"] == "nan" and bad["note"] == "fails on all cases"
    assert 0.0 < float(some["failure_rate"]) < 1.0 and float(some["median_error_m"]) < 1e-6


def test_the_page_says_who_fails(written):
    folder, said = written
    text = (folder / "speed_accuracy.md").read_text(encoding="utf-8")
    assert "* bad at 0.5, 1: fails on all cases" in text
    assert "| bad    | fails on all cases" in text and "| bad    | fails on all cases" in said
    assert "](speed_accuracy_cold.png)" in text


def test_figures_are_drawn(written):
    folder, _ = written
    for path in folder.glob("*.png"):
        height, width, _ = matplotlib.image.imread(path).shape
        assert height > 600 and width > 600


def test_methods_are_told_apart_and_drawn_alike_everywhere():
    names = [f"method {i}" for i in range(12)]
    styles = chart.styles([*names[:4], "ours", *names[4:]], "ours")
    assert styles == chart.styles(["ours", *names], "ours")
    looks = {(style["color"], style["marker"], style.get("linestyle", "-")) for style in styles.values()}
    assert len(looks) == 13


def test_what_is_not_drawn_is_told_in_the_figure():
    group = [
        point(1e-3, 1.0), NOTHING._replace(method="a", setting="5"), point(1e-3, 1.0, method="a"),
        NOTHING._replace(method="b", cases=0, failed=0, note="cannot model this arm: long story"),
    ]  # fmt: skip
    assert chart.absent(group, 50) == "Fails on all cases:\n– a: 5\nCannot model this arm:\n– b: all settings"


def test_sizes_are_written_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(size, "QUICK_S", 0.02)
    for name in ("MODULES", "MUSCLES", "LANES"):
        monkeypatch.setattr(size, name, getattr(size, name)._replace(values=(1, 2, 3)))
    said = []
    pattern.run(size.STUDY, tmp_path, said.append, quick=True)
    assert {path.name for path in tmp_path.iterdir()} == {"size.png", "size.csv"}
    with (tmp_path / "size.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    columns = ("varied", "modules", "muscles_of_a_module", "lanes")
    assert [tuple(row[name] for name in columns) for row in rows] == [
        *(("modules", str(k), "3", "1") for k in (1, 2, 3)),
        *(("muscles", "1", str(k), "1") for k in (1, 2, 3)),
        *(("lanes", "1", "3", str(k)) for k in (1, 2, 3)),
    ]  # fmt: skip
    for row in rows:
        whole, each = float(row["median_time_s"]), float(row["median_time_of_a_lane_s"])
        assert 0.0 < whole < 1.0 and each == pytest.approx(whole / int(row["lanes"]))
        assert float(row["iterations"]) > 0.0
    assert said[0].count("time ~") == 3 and "size.png" in said[1]


def test_the_fit_is_through_the_larger_half():
    sweep = size.LANES._replace(values=(1, 2, 4, 8, 16), seconds=(9.0, 9.0, 8.0, 32.0, 128.0))
    assert sweep.fit == pytest.approx((2.0, 0.5))


# The command line.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["speed-accuracy"], "required: --out"),
        (["speed-accuracy", "--out", "x", "--scene", "mars"], "invalid choice: 'mars'"),
        (["speed-accuracy", "--out", "x", "--scene"], "expected one argument"),
        (["size", "--out", "x", "--scene", "cold"], "unrecognized arguments: --scene"),
        (["paper", "--out", "x", "--quick"], "unrecognized arguments: --quick"),
    ],
)
def test_bad_arguments_are_told(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        command.main(arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_options_reach_the_study(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(pattern, "run", lambda study, out, **options: asked.append((study.name, out, options)))
    assert command.main(["speed-accuracy", "--out", str(tmp_path), "--scene", "cold", "--scene", "long", "--quick"]) == 0
    assert command.main(["speed-accuracy", "--out", str(tmp_path)]) == 0
    assert command.main(["size", "--out", str(tmp_path), "--quick"]) == 0
    assert asked == [
        ("speed-accuracy", tmp_path, {"scenes": ["cold", "long"], "quick": True}),
        ("speed-accuracy", tmp_path, {"scenes": None, "quick": False}),
        ("size", tmp_path, {"quick": True}),
    ]


def test_missing_packages_are_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pattern, "find_spec", lambda name: None if name == "tqdm" else name)
    with pytest.raises(SystemExit) as stop:
        command.main(["speed-accuracy", "--out", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert "needs tqdm" in (error := capsys.readouterr().err) and "pip install 'tca_envs[train]'" in error
    assert not (tmp_path / "out").exists()


def test_payloads_compare_by_value():
    """The recorder leaves out steps that change nothing by it."""
    assert Payload(1e-3, (0.0, 0.0, 1e-3)) == Payload(1e-3, (0.0, 0.0, 1e-3)) != Payload(2e-3)
