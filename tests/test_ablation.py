"""What leaving an effect out does: the simpler arms, the numbers made of them, and that the default models agree."""

import csv
from dataclasses import replace
from math import nan

import matplotlib.image
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from study import __main__ as command
from study import ablation, effects, pattern
from study.ablation import ABSENT, FREE, LEFT_OUT, MISSED, NEEDED, SPARE, Row
from study.effects import AS_IT_IS, COUPLING, EFFECTS, NAMES, Effect
from study.method import State
from study.scenes import SCENES, Case
from tca_envs.mechanics import Arm, Payload
from tca_envs.robots import paper

STATES = 6
COMMON = {effect.name: effect for effect in effects.COMMON}


def only(name, scene):
    """The effect of that name."""
    (effect,) = (effect for effect in EFFECTS[scene] if effect.name == name)
    return effect


def case(arm, drive, payload=None):
    """From 2 K less to a drive."""
    drive = np.array(drive)
    return Case(State(arm, drive - 2.0, payload=payload), State(arm, drive, payload=payload))


# The simpler arms.


def test_the_rest_of_an_arm_has_its_mass_and_centre():
    """Twisting module from 0 to 16 mm, gripper below, centre by hand."""
    body, tip = effects.rigid_rest(paper.whole_arm())
    mass = paper.TWISTING_MASS + paper.GRIPPER_MASS
    gripper = paper.TWISTING_LENGTH + paper.GRIPPER_CENTRE[2]
    centre = (paper.TWISTING_MASS * 0.5 * paper.TWISTING_LENGTH + paper.GRIPPER_MASS * gripper) / mass
    assert body.mass == pytest.approx(mass)
    np.testing.assert_allclose(body.centre, (0.0, 0.0, centre), atol=1e-12)
    np.testing.assert_allclose(tip[:3, 3], (0.0, 0.0, paper.TWISTING_LENGTH), atol=1e-12)


def test_without_coupling_the_arm_is_that_with_a_stiff_cold_rest():
    whole, payload = paper.whole_arm(), paper.with_object()
    bending, twisting = whole.modules
    stiff = Arm([bending, replace(twisting, stiffness=1e6 * twisting.stiffness)], whole.gravity, residual_tolerance=1e-9)
    drive = np.array([100.0, 60.0, 40.0, 25.0])
    expected = stiff.equilibrium(drive, payload=payload)
    assert expected.converged
    hot = drive + np.array([0.0, 0.0, 0.0, 100.0])  # not driven either
    view = only(COUPLING, "twist-align").without(case(whole, hot, payload))
    np.testing.assert_allclose(ablation.pose(view), expected.tip_pose, atol=2e-6)


def test_the_opposite_in_reach_is_the_whole_arm_up_to_the_bending_modules_end():
    bending, whole = paper.bending_arm(), paper.whole_arm(tolerance=1e-8)
    view = only(COUPLING, "reach").complete(case(bending, [120.0, 40.0, 50.0]))
    expected = whole.equilibrium([120.0, 40.0, 50.0, 25.0]).poses([0.045])[0]
    np.testing.assert_allclose(ablation.pose(view), expected, atol=1e-6)


def test_muscles_are_left_out_by_the_state_that_is_asked_for():
    arm = paper.bending_arm()
    warm, cool = np.array([90.0, 41.0, 25.0]), np.array([90.0, 39.0, 25.0])
    for before, now, kept in ((warm, cool, 1), (cool, warm, 2)):
        view = only("cool muscles", "reach").without(Case(State(arm, before), State(arm, now)))
        assert len(view.now.arm.muscles) == kept and view.before.arm is view.now.arm
        assert view.before.drive.tolist() == before[:kept].tolist() and view.now.drive.tolist() == now[:kept].tolist()
    passive = only("passive muscles", "reach").without(Case(State(arm, warm), State(arm, cool)))
    assert len(passive.now.arm.muscles) == 2


def test_states_have_effects_or_not():
    arm = paper.whole_arm()
    hot, cold = State(arm, np.full(4, 60.0)), State(arm, np.array([60.0, 60.0, 60.0, 25.0]))
    carrying = replace(hot, payload=paper.with_object())
    empty = replace(hot, payload=Payload(arm.payload.mass, arm.payload.centre))
    of = {effect.name: effect.present for effect in EFFECTS["pick-and-place"]}
    for name in ("passive muscles", "cool muscles"):
        assert of[name](cold) and not of[name](hot)
    assert of["object's weight"](carrying) and not of["object's weight"](hot) and not of["object's weight"](empty)


def test_no_weight_at_the_tip_is_none_of_gripper_and_object():
    arm = paper.whole_arm()
    asked = case(arm, [80.0, 25.0, 25.0, 25.0], paper.with_object())
    bare = Arm(arm.modules, arm.gravity, residual_tolerance=1e-9).equilibrium(asked.state.drive)
    np.testing.assert_allclose(ablation.pose(COMMON["weight at the tip"].without(asked)), bare.tip_pose, atol=1e-6)
    gripper = Arm(arm.modules, arm.gravity, arm.payload, residual_tolerance=1e-9).equilibrium(asked.state.drive)
    without = only("object's weight", "pick-and-place").without(asked)
    np.testing.assert_allclose(ablation.pose(without), gripper.tip_pose, atol=1e-6)


@pytest.mark.parametrize(("name", "strains"), [("shear", slice(3, 5)), ("extension", slice(5, 6))])
def test_strains_that_are_left_out_are_those_of_the_reference(name, strains):
    view = COMMON[name].without(case(paper.bending_arm(), [120.0, 25.0, 70.0]))
    found = view.now.on(ablation.fine(view.now.arm))
    strain = found.strain(np.linspace(0.0, 0.045, 5))
    np.testing.assert_allclose(
        strain[:, strains], np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])[strains] * np.ones((5, 1)), atol=1e-5
    )
    others = np.delete(strain - [0.0, 0.0, 0.0, 0.0, 0.0, 1.0], [2, *range(6)[strains]], axis=1)
    assert (np.abs(others).max(axis=0) > 1e-3).all()


# Numbers.


def moved(distance, angle, fails=lambda found: False):
    """An effect that moves and turns the tip, and has no equilibrium where `fails`."""
    change = np.eye(4)
    change[:3, :3], change[0, 3] = Rotation.from_rotvec([0.0, 0.0, np.radians(angle)]).as_matrix(), distance

    def point(found):
        return np.full((4, 4), nan) if fails(found) else found.tip_pose @ change

    return Effect("moved", lambda case: AS_IT_IS(case)._replace(point=point), AS_IT_IS)


@pytest.fixture(scope="module")
def some():
    """Cases of the bending module."""
    return [case(paper.bending_arm(), [T, 40.0, 30.0]) for T in (50.0, 70.0, 90.0, 110.0)]


def test_errors_are_distances_and_yaws(some):
    row = ablation.measure("helix", moved(2e-3, -170.0), some)
    np.testing.assert_allclose([row.error, row.error_p95, row.error_max], 2e-3)
    assert row.turn_p95 == pytest.approx(170.0)
    assert (row.states, row.present, row.unsolved) == (4, 4, 0)
    assert 0.5 < row.time < 2.0 and row.contained and row.verdict == NEEDED


def test_what_changes_nothing_is_not_in_the_arm(some):
    row = ablation.measure("helix", moved(0.0, 0.0), some)
    assert row.error_max == 0.0 and not row.contained and row.verdict == LEFT_OUT


def test_states_without_an_equilibrium_are_counted(some):
    row = ablation.measure("reach", moved(1e-6, 0.0, lambda found: found.drive[0] > 100.0), some)
    assert row.unsolved == 1 and row.error_max == pytest.approx(1e-6) and row.verdict == NEEDED
    row = ablation.measure("reach", moved(1e-6, 0.0, lambda found: True), some)
    assert row.unsolved == 4 and np.isnan(row.error) and row.verdict == NEEDED


def test_an_effect_that_no_state_has(some):
    row = ablation.measure("reach", moved(1e-3, 0.0)._replace(present=lambda state: False), some)
    assert row.present == 0 and np.isnan(row.error) and row.verdict == ABSENT


def test_what_is_solved_faster_has_a_smaller_ratio():
    """One module instead of two."""
    cases = [case(paper.whole_arm(), [T, 40.0, 30.0, T]) for T in (50.0, 70.0, 90.0, 110.0)]
    coupling = only(COUPLING, "twist-align")
    complete, without = [coupling.complete(c) for c in cases], [coupling.without(c) for c in cases]
    assert ablation.time_ratio(complete, without, ablation.fine) < 0.5
    assert ablation.time_ratio(without, complete, ablation.fine) > 2.0


@pytest.mark.parametrize(
    ("p95", "turn", "time", "contained", "verdict"),
    [
        (0.16e-3, 0.0, 1.0, True, NEEDED), (0.14e-3, 0.0, 1.0, True, FREE), (0.14e-3, 0.0, 0.91, True, FREE),
        (0.14e-3, 0.0, 0.89, True, SPARE), (0.14e-3, 0.6, 1.0, True, NEEDED), (0.14e-3, 0.4, 1.0, True, FREE),
        (0.16e-3, 0.0, 0.5, False, MISSED), (0.14e-3, 0.0, 0.5, False, LEFT_OUT),
    ],
)  # fmt: skip
def test_verdicts_go_by_a_tenth_of_what_the_task_asks(p95, turn, time, contained, verdict):
    """TwistAlign: 1.5 mm and 5 degrees."""
    assert Row("twist-align", "shear", 9, 9, 0, p95, p95, p95, turn, time, contained).verdict == verdict


def test_reach_asks_for_no_yaw():
    assert Row("reach", "shear", 9, 9, 0, 1e-5, 1e-5, 1e-5, 90.0, 1.0).verdict == FREE


# The study, and whether the default models agree with it.


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A run on few states: folder, what was said, rows by scene and effect."""
    folder, said = tmp_path_factory.mktemp("effects"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "QUICK", STATES)
        pattern.run(ablation.STUDY, folder, said.append, quick=True)
    with (folder / "effects.csv").open(encoding="utf-8") as file:
        rows = {(row["scene"], row["effect"]): row for row in csv.DictReader(file)}
    return folder, "\n".join(said), rows


def test_the_run_writes_every_effect_of_every_scene(written):
    folder, _, rows = written
    assert {path.name for path in folder.iterdir()} == {"effects.png", "effects.csv", "effects.md"}
    assert list(rows) == [(s, name) for s in EFFECTS for name in NAMES if name in {effect.name for effect in EFFECTS[s]}]
    assert list(next(iter(rows.values()))) == [column.name for column in ablation.COLUMNS if column.name]
    for row in rows.values():
        assert int(row["states"]) == STATES and int(row["unsolved"]) == 0
        if row["verdict"] != ABSENT:
            errors = [float(row[f"{which}_error_m"]) for which in ("median", "p95", "max")]
            assert errors == sorted(errors) and 0.0 < float(row["time_ratio"]) < 3.0
    height, width, _ = matplotlib.image.imread(folder / "effects.png").shape
    assert height > 600 and width > 1800


def test_what_a_scene_needs_is_in_its_default_model(written):
    """Reach alone leaves something out: the rest of the arm hangs from it as dead weight, by definition of the task."""
    _, _, rows = written
    assert {key for key, row in rows.items() if row["in_default_model"] == "no"} == {("reach", COUPLING)}
    needed = {key for key, row in rows.items() if row["verdict"] == NEEDED}
    assert needed >= {
        (task, name) for task in SCENES if task in EFFECTS and task != "helix" for name in ("gravity", "extension")
    }
    assert needed >= {(task, name) for task in ("twist-align", "pick-and-place") for name in (COUPLING, "shear")}
    assert all(rows[key]["in_default_model"] == "yes" for key in needed)


def test_what_reach_leaves_out_is_less_than_its_success_radius_and_more_than_its_tolerance(written):
    folder, said, rows = written
    row = rows["reach", COUPLING]
    assert row["verdict"] == MISSED
    assert paper.TOLERANCE < float(row["p95_error_m"]) <= float(row["max_error_m"]) < ablation.RADIUS["reach"]
    words = f"{ablation.mm(float(row['max_error_m']))} mm (largest)"
    text = (folder / "effects.md").read_text(encoding="utf-8")
    assert words in text and words in said and "not negligible" in said


def test_the_page_has_the_tables_and_says_why(written):
    folder, said, _ = written
    text = (folder / "effects.md").read_text(encoding="utf-8")
    assert said.split("\nwrote")[0] in text and "](effects.png)" in text
    assert "leaves out module coupling" in text and "but for reach: module coupling." in text
    assert sum(line.startswith("| shear") for line in text.splitlines()) == len(EFFECTS)
    assert "success radius of 1.5 mm and a yaw of 5°" in text


def test_agreement_of_all_is_said():
    rows = [
        Row("reach", "gravity", 9, 9, 0, 1e-3, 1e-3, 1e-3, 0.0, 0.5),
        Row("reach", "shear", 9, 9, 0, 1e-6, 1e-6, 1e-6, 0.0, 0.5),
    ]
    text = ablation.findings(rows, 0.5)
    assert "none leaves anything out" in text and "default model of its scene.\n" in text
    assert "* Needed: reach: gravity." in text and "kept: reach: shear." in text


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (None, "does not apply"), (Row("reach", "x", 9), "in no state"),
        (Row("reach", "x", 9, 9, 9), "no equilibrium without it"),
        (Row("reach", "x", 9, 9, 0, 1e-9, 1e-9, 1e-9), "below 0.001 mm"), (Row("reach", "x", 9, 9, 0, 1e-9, 1e-9, 1e-5), ""),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_told_in_the_figure(row, words):
    assert ablation.remark(row) == words


def test_options_reach_the_study(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(pattern, "run", lambda study, out, **options: asked.append((study.name, out, options["quick"])))
    assert (
        command.main(["effects", "--out", str(tmp_path), "--quick"]) == command.main(["effects", "--out", str(tmp_path)]) == 0
    )
    assert asked == [("effects", tmp_path, True), ("effects", tmp_path, False)]
