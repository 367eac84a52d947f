"""Command line of the studies: python -m tca_envs.study STUDY --out DIR."""

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tca_envs.study import output, paper


class Study(NamedTuple):
    """A subcommand."""

    run: Callable[[Path], None]
    """Writes the study's files into a folder that exists."""
    help: str


STUDIES = {
    "paper": Study(paper.run, "redraw the paper's Figs. 3 to 6 and say where model and paper agree"),
}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tca_envs.study", description="Studies on the arm: figures and tables.")
    commands = parser.add_subparsers(dest="study", required=True, metavar="STUDY")
    for name, study in STUDIES.items():
        command = commands.add_parser(name, help=study.help, description=study.help.capitalize() + ".")
        command.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write into; made if missing")
    options = parser.parse_args(arguments)
    try:
        output.require_matplotlib()
    except ModuleNotFoundError as error:
        parser.error(str(error))
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out {options.out}: expected a folder or a name that can become one ({error.strerror})")
    if not os.access(options.out, os.W_OK | os.X_OK):
        parser.error(f"--out {options.out}: expected a folder that can be written into")
    STUDIES[options.study].run(options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
