"""Imports point one way: no cycle between files, and each room knows only those below it."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [
    ROOT / "train.py",
    *(path for room in ("agents", "study", "tca_envs") for path in sorted(ROOT.glob(f"{room}/**/*.py"))),
]
ABOVE_MECHANICS = [f"tca_envs.{name}" for name in ("tasks", "robots", "registry", "batch", "env", "vector", "render", "viewer")]


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


def imported(module: str) -> Iterator[str]:
    """Every name that a file imports, in functions, too, as "package.module" or "package.module.attribute"."""

    def walk(node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            nodes = node.orelse
        else:
            nodes = list(ast.iter_child_nodes(node))
        for child in nodes:
            if isinstance(child, ast.Import):
                yield from (alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                package = module.split(".")
                if child.level:  # a package's own file counts as one of its modules
                    up = child.level - (MODULES[module].name == "__init__.py")
                    package = package[: len(package) - up]
                source = ".".join([*(package if child.level else []), *([child.module] if child.module else [])])
                yield from (f"{source}.{alias.name}" for alias in child.names)
            else:
                yield from walk(child)

    return walk(ast.parse(MODULES[module].read_text(encoding="utf-8")))


def file_of(name: str) -> str | None:
    """The module of ours that is imported by a name, if any: `a.b.c` is the module, or the attribute c of `a.b`."""
    return next((known for known in (name, name.rpartition(".")[0]) if known in MODULES), None)


IMPORTS = {module: set(imported(module)) for module in MODULES}
EDGES = {module: {file for name in names if (file := file_of(name)) and file != module} for module, names in IMPORTS.items()}


def test_what_is_walked_is_there():
    assert {"train", "agents.training", "tca_envs", "tca_envs.mechanics", "tca_envs.mechanics.arm"} <= set(MODULES)
    assert "agents.training" in EDGES["train"]
    assert "agents.curve" in EDGES["agents.training"]  # in a function
    assert "tca_envs.registry" in EDGES["tca_envs"]


def test_there_is_no_cycle_between_files():
    TopologicalSorter(EDGES).prepare()  # CycleError names the files


def importers(room: str, *forbidden: str) -> list[str]:
    """Imports in files of a room that lead into another one."""
    inside = [module for module in MODULES if module == room or module.startswith(f"{room}.")]
    assert inside
    return [
        f"{module} imports {name}"
        for module in inside
        for name in sorted(IMPORTS[module])
        if any(f"{name}.".startswith(f"{place}.") for place in forbidden)
    ]


@pytest.mark.parametrize(
    ("room", "forbidden"),
    [
        ("agents", ("train", "study", "tca_envs.study")),
        ("tca_envs", ("train", "agents", "study", "tca_envs.study")),
        ("tca_envs.mechanics", ("gymnasium", *ABOVE_MECHANICS)),
    ],
)
def test_a_room_knows_only_rooms_below_it(room, forbidden):
    assert importers(room, *forbidden) == []
