"""The studies: what the figures show physically, what the command writes, gaps, bad arguments."""

import csv
import io
import subprocess
import sys
import tomllib
from contextlib import redirect_stdout
from dataclasses import replace
from fnmatch import fnmatch
from math import isnan, nan
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import matplotlib.image
import numpy as np
import pytest

from study import __main__ as command
from study import paper, pattern, sequence
from tca_envs.mechanics import TCA, Arm, grasp
from tca_envs.robots import paper as robot

COARSE = np.linspace(25.0, 160.0, 28)
"""[degC]"""
PAPER_FILES = {
    "fig3.png", "fig3.csv", "fig4.png", "fig4.csv", "fig5.png", "fig5.csv",
    "fig6.png", "fig6.csv", "agreement.md", "agreement.csv",
}  # fmt: skip


def read(path):
    """Header and rows of a CSV file."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return header, rows


def columns(rows, first):
    """The rows' numbers from column `first` on."""
    return np.array([[float(value) for value in row[first:]] for row in rows])


# What the figures show.


@pytest.mark.parametrize("case", [paper.HARDWARE, paper.PAPER])
def test_passive_elongation_meets_the_published_points(case):
    comparisons = paper.compare(paper.figure3(case))
    assert len(comparisons) == 5
    assert all(abs(c.difference) < 0.3 and c.agrees for c in comparisons)


def test_passive_elongation_is_the_same_for_both_sets():
    hardware, own = (paper.figure3(case).elongation for case in (paper.HARDWARE, paper.PAPER))
    np.testing.assert_allclose(hardware, own, atol=1e-12)


def test_without_the_passive_muscle_the_bend_angle_is_more_than_40_percent_larger():
    """Bending module alone under its own weight, hardware set."""
    data = paper.figure4(paper.HARDWARE, COARSE)
    asked = (data.temperature >= 60.0) & (data.temperature <= 100.0)
    assert asked.sum() == 9
    assert (data.ratio[asked] > 1.4).all() and (data.ratio[asked] < 1.8).all()
    assert (data.angle_with[asked] > 10.0).all()
    claim = paper.claim_antagonism(data)
    assert claim.holds and claim.found == "45 % to 68 % larger from 60 °C up"


def test_the_ratio_without_weight_is_that_of_three_springs():
    """Small angles, closed form: C_ij = 1/EA + r_i.r_j/EI couples the muscles, k = G_t(0)/C their rate; no shear, no weight."""
    case = replace(paper.HARDWARE, mass=0.0)
    ratio = paper.figure4(case, np.array([25.0, 30.0])).ratio[1]
    module = paper.bending_arm(case).modules[0]
    angles = [muscle.angle for muscle in module.muscles]
    x = 4e-3 * np.cos(angles)
    rate = case.law.modulus[0] / case.law.compliance_gain
    positions = 4e-3 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    coupling = 1.0 / module.stiffness[5] + positions @ positions.T / module.stiffness[0]

    def curvature(kept):
        flexibility = np.eye(len(kept)) / rate + module.length * coupling[np.ix_(kept, kept)]
        return x[kept] @ np.linalg.solve(flexibility, [0.0 if i == paper.PASSIVE else 1.0 for i in kept])

    assert ratio == pytest.approx(curvature([1, 2]) / curvature([0, 1, 2]), rel=2e-3)


@pytest.mark.parametrize("case", paper.CASES)
def test_hotter_is_stiffer(case):
    data = paper.figure5(case, force=np.linspace(0.0, 0.05, 11))
    assert np.abs(data.tip[:, 0]).max() < 1e-9
    assert (np.diff(data.tip, axis=1) > 0.0).all()
    assert (np.diff(data.tip[:, 1:], axis=0) < 0.0).all()
    hotter_is_stiffer, *amounts = paper.claims_stiffness(data)
    assert hotter_is_stiffer.holds
    assert not any(claim.holds for claim in amounts), "the published amounts are not reproduced, as agreement.md says"


def test_heating_all_three_lifts_the_tip_straight_up():
    drives = np.repeat(COARSE[:, np.newaxis], 3, axis=1)
    poses = paper.tip_poses(paper.bending_arm(paper.HARDWARE), drives, np.zeros((COARSE.size, 3)))
    x, y, z = 1e3 * poses[:, :3, 3].T
    assert np.abs(x).max() < 1e-6 and np.abs(y).max() < 1e-6
    assert (np.diff(z) < 0.0).all()
    assert z[0] - z[-1] > 5.0


def test_the_weight_of_equation_9_brings_the_papers_set_to_figure_4():
    """Density times effective section: within 1 mm everywhere, while the estimated weight misses by up to 7.5 mm."""
    light = paper.compare(paper.figure4(paper.PAPER_EFFECTIVE))
    heavy = paper.compare(paper.figure4(paper.PAPER))
    assert max(abs(c.difference) for c in light) < 1.0
    assert sum(c.agrees for c in light) == 10
    assert not any(c.agrees for c in heavy)
    assert pytest.approx(0.766e-3, abs=1e-6) == paper.EFFECTIVE_MASS


def test_the_table_of_weights_holds_the_figures_own_values():
    rows = {(name, weight): values for name, weight, *values in paper.weights()}
    assert len(rows) == 8
    for case, weight in (
        (paper.HARDWARE, "module, 3.9 g"),
        (paper.PAPER, "module, 3.9 g"),
        (paper.PAPER_EFFECTIVE, "of eq. (9), 0.77 g"),
    ):
        bent = paper.figure4(case, np.array([100.0])).tip_with[0]
        pushed = paper.figure5(case, (75.0,), np.array([0.01])).tip[0, 0]
        assert rows[case.name.split(",")[0], weight] == pytest.approx([bent, pushed], rel=1e-6)
    # Weight straightens and stiffens.
    for name in (paper.HARDWARE.name, paper.PAPER.name):
        values = np.abs([values for key, values in rows.items() if key[0] == name])
        assert (np.diff(values, axis=0) < 0.0).all()


# Sweeps and angles.


def fake_arm(fails):
    """An arm of one muscle whose tip stands at z = drive; it finds nothing at the drives `fails`. Records each start."""
    starts = []

    def equilibrium(drive, tip_force, start):
        starts.append(None if start is None else start.drive)
        pose = np.eye(4)
        pose[2, 3] = drive[0]
        return SimpleNamespace(converged=drive[0] not in fails, tip_pose=pose, drive=drive[0])

    return SimpleNamespace(equilibrium=equilibrium), starts


def test_a_solve_that_fails_leaves_a_gap_and_starts_nothing():
    arm, starts = fake_arm({2.0, 3.0})
    poses = paper.tip_poses(arm, [[1.0], [2.0], [3.0], [4.0]], np.zeros((4, 3)))
    np.testing.assert_array_equal(poses[:, 2, 3], [1.0, nan, nan, 4.0])
    assert np.isnan(poses[1:3]).all()
    assert starts == [None, 1.0, 1.0, 1.0]


def test_bend_angles_count_on_beyond_180_degrees_and_over_gaps():
    angle = np.radians([0.0, 60.0, 120.0, 170.0, 200.0, 250.0])
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 2], poses[:, 2, 2] = -np.sin(angle), np.cos(angle)
    np.testing.assert_allclose(paper.bend_angle(poses), np.degrees(angle), atol=1e-9)
    poses[3] = nan
    np.testing.assert_allclose(paper.bend_angle(poses), [0.0, 60.0, 120.0, nan, 200.0, 250.0], atol=1e-9)


def test_no_ratio_to_an_angle_near_zero():
    zero = np.zeros(3)
    data = paper.Bending(paper.PAPER, zero, zero, zero, np.array([0.5, -0.5, 20.0]), np.array([3.0, 3.0, 30.0]))
    np.testing.assert_array_equal(data.ratio, [nan, nan, 1.5])


def test_values_are_those_computed_and_none_between():
    x, y = np.array([0.0, 0.1, 0.2]), np.array([1.0, nan, 3.0])
    assert paper.value_at(x, y, 0.2) == 3.0
    assert isnan(paper.value_at(x, y, 0.1))
    with pytest.raises(ValueError, match=r"at = 0\.15: expected one of the computed abscissas"):
        paper.value_at(x, y, 0.15)


@pytest.mark.parametrize(
    ("published", "model", "agrees"),
    [(1.0, 1.29, True), (1.0, 1.31, False), (-10.0, -10.99, True), (-10.0, -11.01, False), (1.0, nan, False)],
)
def test_points_agree_within_a_third_of_a_millimetre_or_a_tenth(published, model, agrees):
    assert paper.Comparison(4, "", "", 60.0, published, model).agrees is agrees


def points(*models):
    return [paper.Comparison(4, "a case", "a curve", float(i), 10.0, model) for i, model in enumerate(models)]


@pytest.mark.parametrize(
    ("models", "words"),
    [
        ((10.0, 10.5), "agrees (2 of 2 points)"),
        ((10.0, 12.0), "agrees in part (1 of 2 points)"),
        ((10.0, 12.0, 12.0), "does not agree (1 of 3 points)"),
        ((10.0, nan), "agrees in part (1 of 2 points); no equilibrium at 1"),
        ((nan, nan), "does not agree (0 of 2 points); no equilibrium at 2"),
    ],
)
def test_verdicts(models, words):
    assert paper.verdict(points(*models)) == words
    assert words in paper.summary_table(points(*models))


@pytest.mark.parametrize(
    ("known", "holds"), [([1.0, 1.0], True), ([1.0, 0.0], False), ([1.0, nan], None), ([0.0, nan], False), ([], None)]
)
def test_statements_hold_fail_or_stay_open(known, holds):
    assert paper.decide(np.array(known)) is holds


def test_a_ratio_below_the_papers_refutes_the_statement_on_antagonism():
    t = np.array([50.0, 60.0, 70.0])
    for angles, holds in (([10.0, 15.0, 13.0], False), ([10.0, 15.0, 16.0], True), ([nan, 15.0, nan], None)):
        data = paper.Bending(paper.PAPER, t, t, t, np.full(3, 10.0), np.array(angles))
        assert paper.claim_antagonism(data).holds is holds


# What the command writes.


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder that the command writes, two levels below one that exists."""
    folder = tmp_path_factory.mktemp("study") / "new" / "paper"
    with redirect_stdout(io.StringIO()) as printed:
        assert command.main(["paper", "--out", str(folder)]) == 0
    (folder.parent / "printed.txt").write_text(printed.getvalue(), encoding="utf-8")
    return folder


def test_the_command_writes_all_files(written):
    assert {path.name for path in written.iterdir()} == PAPER_FILES
    for path in written.glob("*.png"):
        height, width, _ = matplotlib.image.imread(path).shape
        assert height > 600 and width > 800


def test_figure_3_is_written_as_computed(written):
    header, rows = read(written / "fig3.csv")
    assert header == ["case", "force_N", "elongation_mm"]
    for case in (paper.HARDWARE, paper.PAPER):
        data = paper.figure3(case)
        found = columns([row for row in rows if row[0] == case.name], 1)
        np.testing.assert_allclose(found.T, [data.force, data.elongation], rtol=1e-8, atol=1e-9)


def test_figure_4_is_written_as_computed(written):
    header, rows = read(written / "fig4.csv")
    assert len(header) == 7 and {row[0] for row in rows} == {case.name for case in paper.CASES}
    for case in paper.CASES:
        d = paper.figure4(case)
        expected = [d.temperature, d.tip_with, d.tip_without, d.angle_with, d.angle_without, d.ratio]
        found = columns([row for row in rows if row[0] == case.name], 1)
        np.testing.assert_allclose(found.T, expected, rtol=1e-8, atol=1e-9)


def test_figure_5_is_written_as_computed(written):
    header, rows = read(written / "fig5.csv")
    assert header == ["case", "temperature_degC", "force_N", "tip_x_mm"]
    for case in paper.CASES:
        data = paper.figure5(case)
        found = columns([row for row in rows if row[0] == case.name], 1)
        np.testing.assert_allclose(found[:, 2], data.tip.ravel(), rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(found[:, 0], np.repeat(data.temperature, data.force.size))
        np.testing.assert_allclose(found[:, 1], np.tile(data.force, len(data.temperature)))


def test_every_published_point_is_compared_in_every_case(written):
    _, rows = read(written / "agreement.csv")
    assert len(rows) == 2 * 5 + 3 * (12 + 15)
    for figure, *_, unit, published, model, difference, agrees in rows:
        assert unit == ("degC" if figure == "4" else "N")
        assert float(model) - float(published) == pytest.approx(float(difference), abs=1e-6)
        assert agrees == str(int(abs(float(difference)) <= max(0.3, 0.1 * abs(float(published)))))
    known = {(row[0], row[1], row[2], float(row[3])): float(row[6]) for row in rows}
    at_100 = paper.figure4(paper.HARDWARE, np.array([100.0])).tip_with[0]
    assert known["4", paper.HARDWARE.name, "with passive TCA", 100.0] == pytest.approx(at_100, rel=1e-6)


def test_the_agreement_says_where_model_and_paper_part(written):
    text = (written / "agreement.md").read_text(encoding="utf-8")
    lines = text.splitlines()
    verdicts = {
        (figure, case, curve): line
        for line in lines
        for figure, case, curve in [[part.strip() for part in line.split("|")[1:4]] if line.count("|") == 7 else [""] * 3]
    }
    for case in (paper.HARDWARE, paper.PAPER):
        assert " agrees (5 of 5 points)" in verdicts["Fig. 3", case.name, ""]
        for curve in ("with passive TCA", "without passive TCA"):
            assert "does not agree" in verdicts["Fig. 4", case.name, curve]
        for temperature in (75, 125, 150):
            assert "does not agree (0 of 5 points)" in verdicts["Fig. 5", case.name, f"{temperature} °C"]
    assert " agrees (6 of 6 points)" in verdicts["Fig. 4", paper.PAPER_EFFECTIVE.name, "without passive TCA"]
    assert text.rstrip().endswith("None."), "every solve finds its equilibrium"


def test_the_agreement_is_printed(written):
    printed = (written.parent / "printed.txt").read_text(encoding="utf-8")
    assert printed.startswith((written / "agreement.md").read_text(encoding="utf-8"))
    assert str(written) in printed.splitlines()[-1]


def test_gaps_are_drawn_written_and_told(tmp_path, monkeypatch, capsys):
    """Where solves fail, nothing is hidden and nothing breaks."""
    solve = Arm.equilibrium

    def failing(arm, drive, **rest):
        result = solve(arm, drive, **rest)
        # TCA 2 at 100 degC in Fig. 4, every solve at 150 degC in Fig. 5, the paper set's helix at 100 degC in Fig. 6.
        fails = len(drive) > 1 and (drive[-1] == 100.0 or np.all(np.asarray(drive) == 150.0))
        return replace(result, converged=False) if fails else result

    monkeypatch.setattr(Arm, "equilibrium", failing)
    assert command.main(["paper", "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    for case in paper.CASES:
        assert f"* Fig. 4, {case.name}, with passive TCA: 100 °C" in text
        assert f"* Fig. 5, {case.name}, 150 °C: 0, 0.001, 0.002," in text
    assert "* Fig. 6, paper set: on the way to panels b, f\n" in text
    assert "no equilibrium at 5" in text and "no equilibrium at 1" in text
    _, rows = read(tmp_path / "fig4.csv")
    missing = [row for row in rows if row[2] == "nan"]
    assert [float(row[1]) for row in missing] == [100.0] * 3
    _, rows = read(tmp_path / "fig5.csv")
    assert {row[1] for row in rows if row[3] == "nan"} == {"100", "150"}
    assert {path.name for path in tmp_path.iterdir()} == PAPER_FILES
    undecided = [line for line in text.splitlines() if "hotter is stiffer" in line]
    assert len(undecided) == 3 and all("| open: equilibria are missing" in line for line in undecided)


# Bad arguments.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "required: STUDY"),
        (["figures", "--out", "x"], "invalid choice: 'figures'"),
        (["paper"], "required: --out"),
        (["paper", "--out", "x", "--fast"], "unrecognized arguments: --fast"),
    ],
)
def test_bad_arguments_are_told(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        command.main(arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("below", [".", "deeper"])
def test_a_file_in_place_of_the_folder_is_told(below, tmp_path, capsys):
    (tmp_path / "taken").write_text("kept")
    with pytest.raises(SystemExit) as stop:
        command.main(["paper", "--out", str(tmp_path / "taken" / below)])
    assert stop.value.code == 2
    assert "taken" in (error := capsys.readouterr().err) and "expected a folder" in error
    assert (tmp_path / "taken").read_text() == "kept"


def test_missing_matplotlib_is_told_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pattern, "find_spec", lambda name: None)
    with pytest.raises(SystemExit) as stop:
        command.main(["paper", "--out", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert "pip install 'tca_envs[train]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_studies_load_without_matplotlib_and_pyplot_stays_untouched():
    code = (
        "import sys; from study import __main__ as m, pattern; assert 'matplotlib' not in sys.modules;"
        "pattern.new_figure(1, 2, 2); assert 'matplotlib.pyplot' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


# Fig. 6.


@pytest.fixture(scope="module")
def frames():
    return sequence.figure6(TCA.hardware())


def test_figure_6_picks_up_and_puts_down(frames):
    assert [frame.label for frame in frames] == ["start", "twist", "open", "lower, close", "lift", "untwist", "bend, open"]
    start, twist, opened, closed, lifted, untwisted, placed = frames
    height = robot.OBJECT.height
    assert twist.yaw == pytest.approx(sequence.OBJECT_YAW, abs=1.0)
    assert start.gap == pytest.approx(0.0, abs=1e-9) and opened.gap > robot.OBJECT.width
    assert [frame.scene[grasp.HELD] for frame in frames] == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    for frame in (start, twist, opened, closed, placed):
        assert frame.scene[grasp.Z] == pytest.approx(robot.TABLE - 0.5 * height, abs=1e-6)
    assert closed.scene[grasp.Z] - lifted.scene[grasp.Z] == pytest.approx(closed.scene[grasp.STAGE], abs=1e-5)
    assert closed.scene[grasp.STAGE] == pytest.approx(sequence.LOWERED, rel=0.1)
    assert untwisted.yaw == pytest.approx(0.0, abs=1.0)
    # The object turns with the gripper.
    turned = np.degrees(untwisted.scene[grasp.YAW] - lifted.scene[grasp.YAW])
    assert turned == pytest.approx(untwisted.yaw - lifted.yaw, abs=1e-6)
    assert 2.0 * robot.OBJECT.friction * lifted.pinch > robot.OBJECT.mass * 9.81
    assert placed.scene[grasp.X] > 5e-3 and abs(placed.scene[grasp.Y]) < 1e-3


def test_figure_6_fails_with_the_papers_set_because_the_gripper_opens_too_little():
    frames = sequence.figure6(TCA.paper())
    assert max(frame.gap for frame in frames) < robot.OBJECT.width
    assert not any(frame.scene[grasp.HELD] for frame in frames)
    # The stage stops where the jaws stand on the object.
    top = robot.TABLE - robot.OBJECT.height
    assert sequence.place(frames[3].arm)[0][2] + frames[3].scene[grasp.STAGE] == pytest.approx(top, abs=1e-9)
    assert (frames[-1].scene[grasp.X : grasp.YAW + 1] == frames[0].scene[grasp.X : grasp.YAW + 1]).all()


def test_figure_6_is_written_as_computed(written, frames):
    header, rows = read(written / "fig6.csv")
    assert len(rows) == 2 * len(frames)
    for row, frame in zip(rows, frames, strict=False):
        line = dict(zip(header, row, strict=True))
        assert (line["case"], line["panel"]) == (paper.HARDWARE.name, frame.label)
        assert float(line["yaw_deg"]) == pytest.approx(frame.yaw, abs=1e-6)
        assert float(line["gap_mm"]) == pytest.approx(1e3 * frame.gap, abs=1e-6)
        assert float(line["object_x_mm"]) == pytest.approx(1e3 * frame.scene[grasp.X], abs=1e-6)
        assert float(line["tip_z_mm"]) == pytest.approx(1e3 * frame.arm.tip_pose[2, 3], abs=1e-6)


def test_the_table_says_that_figure_6_works_with_the_hardware_set_only(written):
    lines = [line for line in (written / "agreement.md").read_text(encoding="utf-8").splitlines() if "| Fig. 6" in line]
    assert len(lines) == 10
    for line in lines:
        assert line.rstrip(" |").endswith("yes" if paper.HARDWARE.name in line else "no"), line
        if "one way only" in line and paper.PAPER.name in line:  # the argument T - 25 has its turning point at 35.4 degC
            assert "the other way up to 35 °C" in line


@pytest.mark.parametrize("gap", [0.0, 3e-3, 7e-3])
def test_the_drawn_ring_has_its_length_and_gap(gap):
    ring = robot.ring()
    left, right = (sequence.ring(ring, gap, side, 400) for side in (-1.0, 1.0))
    assert np.linalg.norm(np.diff(left, axis=0), axis=1).sum() == pytest.approx(0.5 * ring.length, rel=1e-4)
    assert right[-1, 0] - left[-1, 0] == pytest.approx(gap, abs=1e-9)


# The pattern of the studies.


def test_studies_are_not_installed():
    settings = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    assert not any(fnmatch("study", name) for name in settings["setuptools"]["packages"]["find"]["include"])
    assert "study" in settings["mypy"]["files"]


def test_a_study_writes_its_columns_figures_and_page(tmp_path):
    """Rows with a name are in the file, those with a heading in the table; numbers with nine digits, missing ones as nan."""

    class Row(NamedTuple):
        name: str
        length: float

    columns = [
        pattern.Column("name", "name", "Name"), pattern.Column("length", "length_m", "Length", pattern.in_metres),
        pattern.Column(lambda row: 2.0 * row.length, "twice_m"), pattern.Column("length", "", "Share", pattern.percent),
    ]  # fmt: skip
    asked, said = [], []
    study = pattern.Study(
        "toy",
        "a toy",
        lambda quick: asked.append(quick) or [Row("a", 1.0 / 3.0), Row("b", nan)],
        tables={"toy.csv": (columns, lambda found: found)},
        figures=lambda found: iter([("toy.png", pattern.new_figure(1, 2.0, 2.0)[0])]),
        page=("toy.md", lambda found: pattern.page("# Toy", "", pattern.table(columns, found))),
        findings=lambda found: f"{len(found)} rows",
    )
    pattern.run(study, tmp_path, said.append, quick=True)
    assert asked == [True] and said == ["2 rows", f"wrote toy.csv, toy.png, toy.md in {tmp_path}"]
    assert (tmp_path / "toy.csv").read_text() == "name,length_m,twice_m\na,0.333333333,0.666666667\nb,nan,nan\n"
    page = (tmp_path / "toy.md").read_text(encoding="utf-8")
    rule, first, second = page.removeprefix("# Toy\n\n| Name | Length | Share |\n").splitlines()
    assert (rule, first) == ("|------|--------|-------|", "| a    | 333 mm | 33 %  |")
    assert second.split() == ["|", "b", "|", "--", "|", "--", "|"]
    assert (tmp_path / "toy.png").stat().st_size > 1_000


def test_every_study_states_what_it_writes():
    assert [study.name for study in command.STUDIES] == [
        "paper", "speed-accuracy", "tolerance", "stability", "size", "throughput", "effects",
    ]  # fmt: skip
    for study in command.STUDIES:
        for columns, _ in study.tables.values():
            names = [column.name for column in columns if column.name]
            assert len(set(names)) == len(names)
