"""Command line of the studies: python -m tca_envs.study STUDY --out DIR."""

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tca_envs.study import ablation, output, paper, size, speed_accuracy, stability, throughput, tolerance
from tca_envs.study.scenes import SCENES


class Study(NamedTuple):
    """A subcommand."""

    run: Callable[[argparse.Namespace], None]
    """Writes the study's files into the folder `out`, which exists."""
    help: str
    packages: tuple[str, ...] = ("matplotlib",)
    """What it needs beyond the package's dependencies."""
    add_options: Callable[[argparse.ArgumentParser], object] = lambda command: None
    """Adds its options beside --out."""


def _add_quick(command: argparse.ArgumentParser) -> None:
    command.add_argument("--quick", action="store_true", help="less of everything, within two minutes: for a look")


def _add_scenes(command: argparse.ArgumentParser) -> None:
    names = f"one of {', '.join(SCENES)}; may be repeated; default: all"
    command.add_argument("--scene", action="append", choices=SCENES, metavar="SCENE", help=names)
    _add_quick(command)


STUDIES = {
    "paper": Study(
        lambda options: paper.run(options.out), "redraw the paper's Figs. 3 to 6 and say where model and paper agree"
    ),
    "speed-accuracy": Study(
        lambda options: speed_accuracy.run(options.out, options.scene, options.quick),
        "chart time against tip error of ways to solve for equilibrium, on several scenes",
        ("matplotlib", "tqdm"),
        _add_scenes,
    ),
    "tolerance": Study(
        lambda options: tolerance.run(options.out, options.quick),
        "check that tasks keep the tip error that they are asked for, and what a looser one saves",
        ("matplotlib", "tqdm"),
        _add_quick,
    ),
    "stability": Study(
        lambda options: stability.run(options.out, options.quick),
        "map where methods find the equilibrium that the arm is on, and where and how they fail",
        ("matplotlib", "tqdm"),
        _add_quick,
    ),
    "size": Study(
        lambda options: size.run(options.out, options.quick),
        "chart the time of a solve against modules, muscles and lanes",
        ("matplotlib", "tqdm"),
        _add_quick,
    ),
    "throughput": Study(
        lambda options: throughput.run(options.out, options.quick),
        "chart environment steps per second against the number of environments; tell memory and the time of a first step",
        ("matplotlib", "tqdm"),
        _add_quick,
    ),
    "effects": Study(
        lambda options: ablation.run(options.out, options.quick),
        "tell which physical effects each scene needs: tip error and time without each of them",
        ("matplotlib", "tqdm"),
        _add_quick,
    ),
}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tca_envs.study", description="Studies on the arm: figures and tables.")
    commands = parser.add_subparsers(dest="study", required=True, metavar="STUDY")
    for name, study in STUDIES.items():
        command = commands.add_parser(name, help=study.help, description=study.help.capitalize() + ".")
        command.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write into; made if missing")
        study.add_options(command)
    options = parser.parse_args(arguments)
    study = STUDIES[options.study]
    try:
        for package in study.packages:
            output.require(package)
    except ModuleNotFoundError as error:
        parser.error(str(error))
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out {options.out}: expected a folder or a name that can become one ({error.strerror})")
    if not os.access(options.out, os.W_OK | os.X_OK):
        parser.error(f"--out {options.out}: expected a folder that can be written into")
    try:
        study.run(options)
    except ModuleNotFoundError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
