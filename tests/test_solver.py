"""The notation of the kernels, their twin in an interpreter, how they are compiled and kept, and who may call them."""

import ast
import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

import tca_envs.mechanics
from tca_envs.mechanics import Arm, Payload, laws, thermal
from tca_envs.mechanics.laws import COIL, TCA
from tca_envs.mechanics.solver import batch as calls
from tca_envs.mechanics.solver import cache, compiled, fields, linearise, simd, solve
from tca_envs.mechanics.solver.newton import EVALUATE, newton
from tca_envs.mechanics.solver.simd import LANES, Mat, Quat, Vec
from tca_envs.robots import paper

PACKAGE = Path(tca_envs.mechanics.__file__).parents[1]
SOLVER = PACKAGE / "mechanics" / "solver"
RNG = np.random.default_rng(0)
A, B = RNG.normal(size=(2, 3, 3))
P, Q = RNG.normal(size=(2, 3))
H = RNG.normal(size=4)
S = A @ A.T - 0.5 * np.eye(3)  # symmetric, indefinite


def hat(x):
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def turned_by(q):
    """Rotation matrix of a quaternion, by another formula."""
    w, v = q[0] / np.linalg.norm(q), q[1:] / np.linalg.norm(q)
    return np.eye(3) + 2.0 * w * hat(v) + 2.0 * hat(v) @ hat(v)


def small(x):
    x = np.asarray(x)
    return {(3,): Vec, (4,): Quat, (3, 3): Mat}[x.shape](*x.ravel())


LEVER = np.array([P[0], P[1], 0.0])
FORMULAS = {
    "dot": (simd.dot, (P, Q), P @ Q),
    "cross": (simd.cross, (P, Q), np.cross(P, Q)),
    "cross of a matrix": (simd.cross, (P, A), hat(P) @ A),
    "times": (simd.times, (P, Q), P * Q),
    "outer": (simd.outer, (P, Q), np.outer(P, Q)),
    "transpose": (simd.transpose, (A,), A.T),
    "hat": (simd.hat, (P,), hat(P)),
    "lever": (simd.lever, (P[0], P[1], Q), np.cross(LEVER, Q)),
    "lever of a matrix": (simd.lever, (P[0], P[1], A), hat(LEVER) @ A),
    "diagonal": (simd.diagonal, tuple(P), np.diag(P)),
    "inverse": (simd.inverse, (A,), np.linalg.inv(A)),
    "negatives": (simd.negatives, (S,), float((np.linalg.eigvalsh(S) < 0.0).sum())),
    "product": (simd.product, (H, P), np.array([-H[1:] @ P, *(H[0] * P + np.cross(H[1:], P))])),
    "turned": (simd.turned, (P, H), H + np.array([-H[1:] @ P, *(H[0] * P + np.cross(P, H[1:]))])),
    "square": (simd.square, (H,), H @ H),
    "norm1": (simd.norm1, (H,), np.abs(H).sum()),
    "rotation": (simd.rotation, (H,), turned_by(H)),
    "sqrt": (simd.sqrt, (2.5,), np.sqrt(2.5)),
    "matrix by vector": (lambda a, x: a @ x, (A, P), A @ P),
    "matrix by matrix": (lambda a, b: a @ b, (A, B), A @ B),
    "sums": (lambda a, b: a + 2.0 * b - -a, (A, B), 2.0 * A + 2.0 * B),
}


@pytest.mark.parametrize("name", FORMULAS)
def test_a_formula_is_what_numpy_has_in_python_compiled_and_in_packs(name):
    formula, given, expected = FORMULAS[name]
    given = [small(x) if np.ndim(x) else float(x) for x in given]
    np.testing.assert_allclose(np.ravel(formula(*given)), np.ravel(expected), rtol=1e-12, atol=1e-12)

    # Compiled, of floats and of packs; the lanes of a pack hold this number times 1, 2, 3, ... in its first argument.
    first, *rest = given
    size = len(first) if isinstance(first, tuple) else 0
    shapes = {"x": (size or 1, LANES), "y": (9, LANES)}
    source = f"def run(data, out, places):\n    it = fields_of(data, places)\n    x = {_read('it.x', size)}\n"
    arguments = ", ".join(
        ["x", *(f"{type(x).__name__}{tuple(map(float, x))}" if isinstance(x, tuple) else repr(x) for x in rest)]
    )
    source += f"    r = formula({arguments})\n" + _write(np.size(expected))
    struct = fields.Struct(f"Test of {name}", f"x pack {max(size, 1)} 1 given\ny pack 9 1 result")
    table, floats = fields.table_of(struct, {})
    data = calls._aligned(floats)
    views = fields.views(struct, {}, table, data)
    numbers = np.ravel(first).astype(float)
    views["x"][:, 0] = numbers[:, None] * np.arange(1, LANES + 1)
    names = {
        "fields_of": fields.struct_of(struct),
        "formula": compiled(formula) if name.startswith(("matrix", "sums")) else formula,
    }
    exec(source, names | {kind.__name__: kind for kind in (Vec, Quat, Mat)}, names)
    njit(names["run"], error_model="numpy")(data, None, table)
    assert shapes["y"] == views["y"][:, 0].shape
    for lane in range(LANES):
        scaled = numbers * (lane + 1.0)
        alone = formula(small(scaled.reshape(np.shape(first) if size != 9 else (3, 3))) if size else scaled[0], *rest)
        found = views["y"][: np.size(expected), 0, lane]
        np.testing.assert_allclose(found, np.ravel(alone), rtol=1e-12, atol=1e-12)


def _read(field, size):
    parts = ", ".join(f"{field}[{k}]" for k in range(max(size, 1)))
    return f"{ {3: 'Vec', 4: 'Quat', 9: 'Mat'}[size] }({parts})" if size else parts


def _write(size):
    names = {1: [""], 3: [f".{n}" for n in "xyz"], 4: [f".{n}" for n in "wxyz"], 9: [f".{i}{j}" for i in "xyz" for j in "xyz"]}[
        size
    ]
    return "".join(f"    it.y[{k}] = r{name}\n" for k, name in enumerate(names))


# --- the twin ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arm():
    return Arm([paper.bending_module(), paper.twisting_module()], paper.GRAVITY, Payload(1e-3, (0.0, 1e-3, 5e-3)))


def test_a_law_is_one_text_for_floats_and_packs():
    row = TCA().parameters()[np.newaxis]
    compiled_law = njit(lambda law, tension, drive: laws_elongation(COIL, law, 0, 0.045, tension, drive))
    for tension, drive in ((-0.1, 30.0), (0.2, 90.0), (0.9, 150.0)):
        np.testing.assert_allclose(
            compiled_law(row, tension, drive), laws.elongation(COIL, row, 0, 0.045, tension, drive), rtol=1e-13
        )


laws_elongation = laws.elongation


def test_newton_in_an_interpreter_comes_to_what_compiled_newton_comes_to(arm):
    """A few steps from the same start: strains, tensions, residual, stability, all by the same text."""
    start = arm.equilibrium([60.0, 40.0, 30.0, 50.0])
    lane = (start.nodes[1], start.tensions, *start.known)
    asked, load = np.array([75.0, 45.0, 30.0, 60.0]), arm.load()
    lanes = calls.Lanes(*(x[np.newaxis].copy() for x in lane), np.eye(4)[np.newaxis].copy(), np.empty((1, 4)))
    report = solve(arm.problem, lanes, asked[np.newaxis], load[np.newaxis], substeps=False)[0]
    linearise(arm.problem, *lane[:2], asked, load, "shape")  # puts the state where the twin finds it
    arm_twin, rod = calls.twins(arm.problem)
    rod.moved = 1.0
    newton(arm_twin, rod, 0.0)
    assert rod.converged == 1.0 and rod.iterations == report["iterations"] and rod.slowness == pytest.approx(report["slowness"])
    strain = np.hstack([[rod.u[g] for g in range(arm_twin.nodes)], [rod.v[g] for g in range(arm_twin.nodes)]])
    np.testing.assert_allclose(strain, lanes.strain[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose([rod.tension[i] for i in range(4)], lanes.tension[0], rtol=1e-9)
    np.testing.assert_allclose(rod.p_end[arm_twin.elements], lanes.tip[0, :3, 3], atol=1e-12)


def test_an_evaluation_in_an_interpreter_is_the_compiled_one(arm):
    state = (arm.unloaded().strain + 0.3, np.full(4, 0.05), np.array([90.0, 30.0, 50.0, 120.0]), arm.load())
    state[0][:, 5] = 1.1
    found = linearise(arm.problem, *state, "shape")
    arm_twin, rod = calls.twins(arm.problem)
    arm_twin.call[EVALUATE](arm_twin, rod, 0.0)
    assert rod.worst == pytest.approx(found.residual, rel=1e-12)
    np.testing.assert_allclose([rod.spin[g] for g in range(arm_twin.nodes)], found.spin, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose([rod.path[i] for i in range(4)], found.path, rtol=1e-13)


INTERPRETED = """
import gymnasium, numpy as np, tca_envs, sys
from tca_envs.robots import paper
from tca_envs.mechanics import Arm
arm = Arm([paper.bending_module()], paper.GRAVITY, paper.BELOW_BENDING, [(1, 5)], 1e-6)
state, tips = arm.equilibrium([60.0, 25.0, 25.0]), []
for drive in ([125.0, 30.0, 25.0], [158.0, 158.0, 39.0]):
    state = arm.equilibrium(drive, start=state)
    tips += [*state.tip_pose.ravel(), *state.tensions, *state.tip_jacobian.ravel(), state.stability, state.rung]
np.savetxt(sys.argv[1], tips)
"""


def test_without_compiling_the_whole_ladder_runs_in_python(tmp_path):
    """Newton, substeps, a jump to another branch, derivatives, stability."""
    found = []
    for disabled in ("0", "1"):
        path = tmp_path / disabled
        env = {**os.environ, "NUMBA_DISABLE_JIT": disabled, "PYTHONPATH": str(PACKAGE.parent)}
        subprocess.run([sys.executable, "-c", INTERPRETED, str(path)], check=True, env=env)
        found.append(np.loadtxt(path))
    assert found[0].size == 2 * (16 + 3 + 18 + 2)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6, atol=1e-6)


# --- the schema and the code ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("struct", [fields.Arm, fields.Rod], ids=str)
def test_every_field_has_a_kind_a_shape_and_a_unit_and_is_used(struct):
    text = {"Arm": fields.ARM_FIELDS, "Rod": fields.ROD_FIELDS}[struct.name]
    code = "".join(path.read_text() for path in SOLVER.glob("*.py") if path.name != "fields.py")
    for line in text.strip().splitlines():
        name, kind, shape, unit, *_ = line.split(None, 4)
        assert kind in ("integer", "real", "pack", "vec", "quat", "mat") and unit
        assert len(struct.shapes[name]) <= 3 and (shape == "-") == (struct.shapes[name] == [])
        assert any(f"{owner}.{name}" in code for owner in ("arm", "rod")) or f'"{name}"' in code, name


def test_fields_do_not_overlap_but_for_the_load():
    sizes = {"M": 2, "M+1": 3, "n": 4, "G": 13, "E+1": 4, "Q": 7, "Q+1": 8, "QQ": 49, "m": 3, "P": 11, "L": 13}
    for struct in (fields.Arm, fields.Rod):
        table, floats = fields.table_of(struct, sizes)
        views = fields.views(struct, sizes, table, np.zeros(floats))
        for k, view in enumerate(views.values()):
            view[...] = k + 1
        assert all((view == k + 1).all() for k, (name, view) in enumerate(views.items()) if name not in ROD_LOAD)


ROD_LOAD = ("push", "twist", "gravity", "mass", "centre")


def functions(path):
    tree = ast.parse(path.read_text())
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


@pytest.mark.parametrize("path", sorted(PACKAGE.glob("mechanics/**/*.py")), ids=lambda path: path.name)
def test_functions_are_short_and_take_few_arguments(path):
    for function in functions(path):
        first = function.body[0]
        documented = isinstance(first, ast.Expr) and isinstance(getattr(first, "value", None), ast.Constant)
        lines = function.end_lineno - function.lineno + 1 - (first.end_lineno - first.lineno + 1 if documented else 0)
        assert lines <= 60, f"{function.name} has {lines} lines"
        if path.parent == SOLVER:
            required = len(function.args.args) - len(function.args.defaults)
            assert required <= 8, f"{function.name} takes {required} arguments"


def test_the_solver_is_called_through_a_few_names():
    """Only what `solver` exports, and the notation where something else is compiled."""
    root = PACKAGE.parent
    for path in [*PACKAGE.rglob("*.py"), *root.glob("agents/**/*.py"), *root.glob("study/**/*.py"), root / "train.py"]:
        if path.parent == SOLVER:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("tca_envs.mechanics.solver"):
                inside = node.module.removeprefix("tca_envs.mechanics.solver")
                names = {alias.name for alias in node.names}
                assert names <= set(tca_envs.mechanics.solver.__all__) if inside == "" else inside == ".simd", (path, names)


def test_heat_is_one_text_for_python_and_the_kernels():
    assert calls.heated is thermal.heated and inspect.getsource(thermal.heated).count("min(") == 2


# --- compiled code is kept --------------------------------------------------------------------------------------------------


def double(x):
    return 2.0 * x


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "folders", lambda: [tmp_path])
    return tmp_path


def hits(function=double):
    """Compile a function anew, or read it; return whether it was read."""
    made = compiled(function)
    assert made(2.0) == 4.0
    return sum(made.stats.cache_hits.values()) == 1


def test_compiled_code_is_read_again(folder):
    assert not hits() and hits()
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("harm", ["truncated", "empty", "foreign", "unreadable pickle", "a folder"])
def test_files_that_are_none_of_ours_are_a_miss(folder, harm):
    hits()
    (path,) = folder.iterdir()
    content = path.read_bytes()
    path.unlink()
    if harm == "a folder":
        path.mkdir()
    else:
        foreign = b"\x80\x05N."  # a pickle of None
        path.write_bytes(
            {
                "truncated": content[:-100],
                "empty": b"",
                "foreign": b"\x00" * 5000,
                "unreadable pickle": cache._digest(foreign).encode() + foreign,
            }[harm]
        )
    assert not hits()
    assert hits() or harm == "a folder"


def test_without_a_folder_that_can_be_written_into_it_compiles(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setattr(cache, "folders", lambda: [blocked / "inside", Path("/proc/nowhere")])
    assert not hits() and not hits()


def test_the_second_folder_serves_where_the_first_cannot(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "folders", lambda: [Path("/proc/nowhere"), tmp_path])
    assert not hits() and hits()


def test_a_full_disk_is_a_miss_and_leaves_nothing(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache.os, "replace", full)
    assert not hits() and not hits()
    assert list(folder.iterdir()) == []


def test_an_edit_of_any_source_is_a_miss_and_takes_the_old_file_away(folder, monkeypatch):
    hits()
    before = {path.name for path in folder.iterdir()}
    monkeypatch.setattr(cache, "_sources", lambda root: "edited")
    assert not hits() and hits()
    after = {path.name for path in folder.iterdir()}
    assert len(after) == 1 and not before & after


def test_the_digest_is_of_every_source(tmp_path):
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "law.py").write_text("rate = 1")
    first = cache._sources(tmp_path)
    cache._sources.cache_clear()
    (tmp_path / "inside" / "law.py").write_text("rate = 2")
    assert cache._sources(tmp_path) != first


def test_functions_of_one_name_do_not_get_each_others_code(folder):
    one, other = (lambda x: 2.0 * x), (lambda x: x + 2.0)
    assert compiled(one)(5.0) == 10.0 and compiled(other)(5.0) == 7.0
    assert compiled(one)(5.0) == 10.0


def test_options_and_defaults_make_another_code(folder):
    assert not hits()
    made = compiled(double, fastmath=False)
    assert made(2.0) == 4.0 and not made.stats.cache_hits
    one = compiled(lambda x, factor=2.0: factor * x)
    other = compiled(lambda x, factor=3.0: factor * x)
    assert (one(2.0), other(2.0)) == (4.0, 6.0)


@pytest.mark.parametrize(
    "name", ["tca_envs.batch:_look", "tca_envs.mechanics.gripper:ring_tension", "tca_envs.mechanics.solver.batch:_linearise"]
)
def test_a_functions_file_has_one_name_whenever_it_is_asked_for(name):
    """Of one source, in this process and in another one."""
    code = (
        "import sys; from importlib import import_module; module, function = sys.argv[1].split(':');"
        "print(getattr(import_module(module), function)._cache.sources)"
    )
    env = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    found = [
        subprocess.run([sys.executable, "-c", code, name], check=True, env=env, capture_output=True, text=True)
        for _ in range(2)
    ]
    here = getattr(importlib.import_module(name.split(":")[0]), name.split(":")[1])
    assert {one.stdout.strip() for one in found} == {here._cache.sources}


def test_the_digest_is_that_of_what_was_imported(folder, monkeypatch):
    """An edit between import and the first call must not be taken for what is compiled then."""
    made = compiled(double)
    monkeypatch.setattr(cache, "_sources", lambda root: "edited")
    assert made(2.0) == 4.0
    assert not hits()


def test_files_may_be_read_by_whom_the_umask_lets(folder):
    hits()
    (path,) = folder.iterdir()
    mask = os.umask(0)
    os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask


def test_a_closure_is_compiled_for_itself(folder):
    def scaled(factor):
        return compiled(lambda x: factor * x)

    assert scaled(2.0)(5.0) == 10.0 and scaled(3.0)(5.0) == 15.0


@pytest.mark.slow
def test_after_an_edit_of_a_law_the_kernels_follow_it(tmp_path):
    """A copy of the package, solved, edited in laws.py, solved again with its cache there."""
    import shutil

    shutil.copytree(PACKAGE, tmp_path / "tca_envs", ignore=shutil.ignore_patterns("__pycache__"))
    code = (
        "from tca_envs.mechanics import *; muscle = Muscle(.004, 0., 0., TCA());"
        "a = Arm([Module.cylinder(.045, .0045, 125e3, 42e3, muscles=[muscle])]);"
        "print(a.equilibrium([100.]).tensions[0])"
    )
    found = []
    for factor in ("1.0", "1.0", "0.5"):
        path = tmp_path / "tca_envs" / "mechanics" / "laws.py"
        text = path.read_text()
        path.write_text(
            text.replace("    heated = law[i, GAIN]", f"    heated = {factor} * law[i, GAIN]") if factor != "1.0" else text
        )
        env = {**os.environ, "PYTHONPATH": str(tmp_path)}
        env.pop("NUMBA_CACHE_DIR", None)
        done = subprocess.run([sys.executable, "-c", code], check=True, env=env, cwd=tmp_path, capture_output=True, text=True)
        found.append(float(done.stdout))
    assert found[0] == found[1] and found[2] < 0.7 * found[1]
