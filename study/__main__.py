"""Command line of the studies: python -m study STUDY --out DIR."""

import argparse
import os
import sys
from pathlib import Path

from study import ablation, paper, pattern, size, speed_accuracy, stability, throughput, tolerance
from study.scenes import SCENES

STUDIES = (
    paper.STUDY, speed_accuracy.STUDY, tolerance.STUDY, stability.STUDY, size.STUDY, throughput.STUDY, ablation.STUDY,
)  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m study", description="Studies on the arm: figures and tables.")
    commands = parser.add_subparsers(dest="study", required=True, metavar="STUDY")
    for study in STUDIES:
        command = commands.add_parser(study.name, help=study.help, description=study.help.capitalize() + ".")
        command.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write into; made if missing")
        if "scenes" in study.options:
            which = f"one of {', '.join(SCENES)}; may be repeated; default: all"
            command.add_argument("--scene", dest="scenes", action="append", choices=SCENES, metavar="SCENE", help=which)
        if "quick" in study.options:
            command.add_argument("--quick", action="store_true", help="less of everything, within two minutes: for a look")
    options = parser.parse_args(arguments)
    (study,) = (study for study in STUDIES if study.name == options.study)
    try:
        for package in study.packages:
            pattern.require(package)
        options.out.mkdir(parents=True, exist_ok=True)
        if not os.access(options.out, os.W_OK | os.X_OK):
            parser.error(f"--out {options.out}: expected a folder that can be written into")
        pattern.run(study, options.out, **{name: getattr(options, name) for name in study.options})
    except ModuleNotFoundError as error:
        parser.error(str(error))
    except (FileExistsError, NotADirectoryError, PermissionError) as error:
        parser.error(f"--out {options.out}: expected a folder or a name that can become one ({error.strerror})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
