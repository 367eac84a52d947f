"""Arguments that make no sense are refused with a ValueError that names the argument and the value."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tca_envs.mechanics import TCA, Arm, Equilibrium, Grid, Module, Muscle, Payload, Spring, Tendon

NAN, INF = float("nan"), float("inf")
STIFFNESS = (4e-5, 4e-5, 2.7e-5, 2.65, 2.65, 7.95)

NO_NUMBER = [NAN, INF, -INF, "x", "1.0", None, True, 1j, [1.0], np.array([1.0]), {}]
NO_POSITIVE_NUMBER = [*NO_NUMBER, 0.0, -1.0]
NO_VECTOR = [
    (0.0, 0.0),
    (0.0, 0.0, 0.0, 0.0),
    ((0.0, 0.0, 0.0),),
    0.0,
    (0.0, NAN, 0.0),
    (0.0, 0.0, INF),
    "xyz",
    ("1", "2", "x"),
    (None, 0.0, 0.0),
    ((0.0, 1.0), 0.0, 0.0),
    {},
]


def tendon() -> Muscle:
    return Muscle(0.004, 0.0, 0.0, Tendon())


def module(**changes: Any) -> Module:
    return Module(**{"length": 0.045, "stiffness": STIFFNESS, "muscles": [tendon()], **changes})


def cylinder(**changes: Any) -> Module:
    arguments = {"length": 0.045, "diameter": 0.009, "youngs_modulus": 1e5, "shear_modulus": 3e4, **changes}
    return Module.cylinder(**arguments)


def muscle(**changes: Any) -> Muscle:
    return Muscle(**{"offset": 0.004, "angle": 0.0, "turns": 0.0, "law": TCA(), **changes})


def payload(**changes: Any) -> Payload:
    return Payload(**{"mass": 1e-3, **changes})


def arm(**changes: Any) -> Arm:
    return Arm(**{"modules": [module()], **changes})


ARM, EASY = arm(), (0.1,)


def equilibrium(**changes: Any) -> Equilibrium:
    return ARM.equilibrium(**{"drive": EASY, **changes})


def heated(drive: Any) -> Equilibrium:
    return arm(modules=[module(muscles=[muscle()])]).equilibrium(drive)


def poses(**changes: Any) -> Any:
    return equilibrium().poses(**changes)


def strain(**changes: Any) -> Any:
    return equilibrium().strain(**changes)


def centerline(**changes: Any) -> Any:
    return equilibrium().centerline(**changes)


CASES: dict[tuple[Callable[..., Any], str], list[Any]] = {
    (module, "length"): NO_POSITIVE_NUMBER,
    (module, "stiffness"): [
        STIFFNESS[:5],
        (*STIFFNESS, 1.0),
        np.diag(STIFFNESS),
        (0.0, *STIFFNESS[1:]),
        (*STIFFNESS[:5], -1.0),
        (NAN, *STIFFNESS[1:]),
        (*STIFFNESS[:5], INF),
        1.0,
        None,
        "x",
    ],
    (module, "mass_per_length"): [*NO_NUMBER, -1e-9],
    (module, "muscles"): [0.0, None, tendon(), Tendon(), [tendon()] * 33],
    (module, "reference_strain"): [
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, 0.0, -1.0),
        (0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
        (0.0, NAN, 0.0, 0.0, 0.0, 1.0),
        (0.0, INF, 0.0, 0.0, 0.0, 1.0),
        None,
        "x",
    ],
    (cylinder, "length"): NO_POSITIVE_NUMBER,
    (cylinder, "diameter"): NO_POSITIVE_NUMBER,
    (cylinder, "youngs_modulus"): NO_POSITIVE_NUMBER,
    (cylinder, "shear_modulus"): NO_POSITIVE_NUMBER,
    (cylinder, "mass"): [*NO_NUMBER, -1e-9],
    (cylinder, "curvature"): NO_VECTOR,
    (cylinder, "muscles"): [0.0, None],
    (muscle, "offset"): [*NO_NUMBER, -0.004],
    (muscle, "angle"): NO_NUMBER,
    (muscle, "turns"): [*NO_NUMBER, 1e4, -1e4],
    (muscle, "law"): [None, TCA, "TCA", 1.0, "tendon"],
    (Spring, "rate"): NO_POSITIVE_NUMBER,
    (TCA, "untwist_gain"): [*NO_NUMBER, -1e-5],
    (TCA, "compliance_gain"): NO_POSITIVE_NUMBER,
    (TCA, "modulus"): [(1e6,), (1e6, 1e6, 1e6, 1e6), (NAN, 1e6, 0.0), (1e6, INF, 0.0), 1e6, None, "x"],
    (TCA, "untwist"): [(1.0,), (1.0, 2.0, 3.0), (NAN, 0.0), (0.0, INF), 1.0, None, "x"],
    (TCA, "max_tension"): NO_POSITIVE_NUMBER,
    (TCA, "temperature_offset"): NO_NUMBER,
    (TCA, "reference_temperature"): [*NO_NUMBER, -21.0, 301.0],
    (payload, "mass"): [*NO_NUMBER, -1e-9],
    (payload, "centre"): NO_VECTOR,
    (arm, "modules"): [[], module(), None, 1.0, [None], [module(), "x"], "x", Module],
    (arm, "gravity"): NO_VECTOR,
    (arm, "payload"): [1e-3, "x", (1e-3, (0.0, 0.0, 0.0)), Payload],
    (arm, "grids"): [
        [],
        [Grid(2, 8), Grid(2, 8)],
        [Grid(0, 8)],
        [Grid(-1, 8)],
        [Grid(2, 0)],
        [Grid(2, 17)],
        [Grid(1000, 16)],
        [(2,)],
        [(2, 8, 1)],
        [("a", "b")],
        [(2.5, 8)],
        [(NAN, 8)],
        [(INF, 8)],
        [None],
        Grid(2, 8),
        2,
        "x",
    ],
    (arm, "residual_tolerance"): [*NO_NUMBER, 0.0, -1e-9, 1e-13, 0.2],
    (equilibrium, "tip_force"): [*NO_VECTOR, None],
    (equilibrium, "time_limit_s"): [value for value in NO_POSITIVE_NUMBER if value is not None],
    (equilibrium, "tip_moment"): [*NO_VECTOR, None],
    (equilibrium, "payload"): [1e-3, "x", (1e-3, (0.0, 0.0, 0.0)), Payload],
    (equilibrium, "drive"): [(), (0.1, 0.1), ((0.1,),), 0.1, (NAN,), (INF,), (-0.1,), None, "x", ("x",), {}],
    (heated, "drive"): [(-20.1,), (300.1,), (1e9,), (NAN,), (), (25.0, 25.0)],
    (equilibrium, "start"): [1.0, "x", np.eye(4), ARM],
    (poses, "s"): [-1e-6, 0.0451, [0.0, NAN], INF, [[0.0, 0.01]], "x", None, {}],
    (strain, "s"): [-1e-6, 0.0451, [0.0, NAN], INF, [[0.0, 0.01]], "x", None, {}],
    (centerline, "points"): [1, 0, -3, 2.0, NAN, "x", None, True, [5]],
}
EVERY = [(make, name, value) for (make, name), values in CASES.items() for value in values]


def numbers(text: str) -> set[str]:
    """The numbers in a text, in one spelling: "2.0", "2." and "2" are the same."""
    return {f"{float(x):g}" for x in re.findall(r"-?(?:\d+\.?\d*(?:e[+-]?\d+)?|\bnan\b|\binf\b)", text)}


@pytest.mark.parametrize(
    ("make", "name", "value"),
    EVERY,
    ids=[f"{make.__name__}-{name}-{repr(value)[:40]}" for make, name, value in EVERY],
)
def test_a_bad_argument_is_refused_by_name_and_value(make, name, value):
    with pytest.raises(ValueError) as refusal:
        make(**{name: value})
    message = str(refusal.value)
    assert re.search(rf"\b{name}\b", message)
    assert "expected" in message
    assert numbers(repr(value)) <= numbers(message)
    if isinstance(value, str | None):
        assert repr(value) in message


@pytest.mark.parametrize("bad", [None, Tendon(), "x", 1.0, TCA()])
def test_every_muscle_of_a_module_must_be_one(bad):
    with pytest.raises(ValueError) as refusal:
        module(muscles=[tendon(), bad])
    assert f"muscles[1] = {bad!r}" in str(refusal.value)


@pytest.mark.parametrize(
    "changes",
    [
        # The muscle lies at the centre of curvature.
        {"reference_strain": (0.0, 250.0, 0.0, 0.0, 0.0, 1.0), "muscles": [tendon()]},
        # The one that does is not the first.
        {
            "reference_strain": (0.0, 250.0, 0.0, 0.0, 0.0, 1.0),
            "muscles": [Muscle(0.0, 0.0, 0.0, Tendon()), tendon()],
        },
    ],
)
def test_a_muscle_path_that_shrinks_to_a_point_is_refused(changes):
    with pytest.raises(ValueError, match="shrinks") as refusal:
        module(**changes)
    last = len(changes["muscles"]) - 1
    assert f"muscles[{last}] = " in str(refusal.value)
    assert "250.0" in str(refusal.value)


def test_a_muscle_path_that_shrinks_to_a_point_halfway_is_refused():
    """The twist cancels the winding; only halfway does the helix pass the centre of curvature."""
    with pytest.raises(ValueError, match="shrinks"):
        module(
            reference_strain=(0.0, 250.0, -2.0 * np.pi / 0.045, 0.0, 0.0, 1.0),
            muscles=[Muscle(0.004, np.pi, 1.0, Tendon())],
        )


def test_a_drive_names_its_muscle_and_range():
    """With several muscles the message must say which."""
    hot = arm(modules=[module(muscles=[muscle(), muscle(angle=2.0)]), module(muscles=[muscle(), tendon()])])
    for drive, shown in (
        ((25.0, 25.0, 301.0, 0.1), r"drive\[2\] = 301: expected a value in \[-20, 300\]"),
        ((25.0, 25.0, 25.0, -0.5), r"drive\[3\] = -0\.5: expected a value in \[0, inf\]"),
    ):
        with pytest.raises(ValueError, match=shown):
            hot.equilibrium(drive)


def test_the_ends_of_the_ranges_are_accepted():
    """Refusals must not eat into what is valid."""
    for temperature in (-20.0, 300.0):
        heated((temperature,))
    assert equilibrium(drive=[0]).converged
    result = equilibrium(drive=np.array([0.1], dtype=np.float32), tip_force=[0, 0, 0])
    assert result.poses([]).shape == (0, 4, 4)
    assert result.poses(0.045).shape == (1, 4, 4)
    assert result.centerline(np.int64(2)).shape == (2, 3)
    assert arm(residual_tolerance=1e-12, grids=[(1, np.int64(16))]).grids == (Grid(1, 16),)
    assert module(length=np.float64(0.045), mass_per_length=0).mass_per_length == 0.0


@pytest.mark.parametrize(
    "other",
    [
        arm(modules=[module(length=0.046)]),
        arm(modules=[module(muscles=[])]),
        arm(modules=[module(muscles=[tendon(), tendon()])]),
    ],
    ids=["length", "no muscle", "two muscles"],
)
def test_the_equilibrium_of_another_arm_is_no_start(other):
    start = other.equilibrium([0.1] * len(other.muscles))
    with pytest.raises(ValueError, match="start") as refusal:
        equilibrium(start=start)
    message = str(refusal.value)
    assert str(len(other.muscles)) in message
    assert f"{other.length:g}" in message


def test_a_wrong_call_changes_nothing():
    start = equilibrium()
    before = start.tip_pose.copy()
    with pytest.raises(ValueError, match="drive"):
        ARM.equilibrium((NAN,), start=start)
    again = equilibrium()
    assert np.array_equal(start.tip_pose, before)
    assert np.array_equal(again.tip_pose, before)


def test_arrays_are_copied():
    """What the caller does to them later is no longer checked."""
    stiffness, reference, gravity = np.array(STIFFNESS), np.array([0.0, 0, 0, 0, 0, 1]), np.array([0.0, 0, 9.81])
    body = module(stiffness=stiffness, reference_strain=reference)
    whole = arm(modules=[body], gravity=gravity)
    for values in (stiffness, reference, gravity):
        values[:] = NAN
    assert np.isfinite(body.stiffness).all() and np.isfinite(body.reference_strain).all()
    assert np.isfinite(whole.gravity).all()
    assert whole.equilibrium([0.1]).converged
    with pytest.raises(ValueError, match="read-only"):
        body.stiffness[0] = 0.0


@pytest.mark.parametrize("gravity", [("0", "0", "9.81"), (True, False, True), (0j, 0j, 1j), [[1.0], [1.0, 2.0]]])
def test_numbers_are_not_made_of_strings_truths_or_complex_numbers(gravity):
    with pytest.raises(ValueError, match=r"gravity = .*: expected finite numbers"):
        Arm([Module(0.01, np.ones(6))], gravity=gravity)
