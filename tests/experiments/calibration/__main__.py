"""Make machines nobody here made, and judge what `abbe solve` says of them.

``python -m tests.experiments.calibration make FOLDER [--families gp,walk] [--n 6] [--seed 1]``
``python -m tests.experiments.calibration plates FOLDER [--families gp,walk] [--n 20] [--seed 1]``
``python -m tests.experiments.calibration judge FOLDER [--answers DIR] [--jobs 2] [--options "--model auto"]``

`plates` makes campaigns of artefacts (`tests.experiments.calibration.plates`), one kind after the other; ``plates_score.py`` of the shared
data judges them. FOLDER is laid out like the practice set (`tests.experiments.calibration.folder`), so `judge` takes that too. What is
judged: `tests.experiments.calibration.judging`. Cases that have an answer in DIR (default FOLDER/answers) are not solved again.
"""

import argparse
import sys
from pathlib import Path

from tests.experiments.calibration import plates
from tests.experiments.calibration.families import FAMILIES
from tests.experiments.calibration.folder import write_case
from tests.experiments.calibration.judging import judge, table


def main() -> None:
    """Run one of the two commands."""
    args = _arguments()
    if args.command in ("make", "plates"):
        for family in args.families.split(","):
            for number in range(args.n):
                if args.command == "make":
                    made = write_case(args.folder, family, number, args.seed)
                else:
                    made = plates.write_case(args.folder, family, plates.KINDS[number % len(plates.KINDS)], number, args.seed)
                _tell(f"\r{made}  ")
        _tell("\n")
        return
    answers = args.answers or args.folder / "answers"
    figures = judge(args.folder, answers, jobs=args.jobs, options=args.options.split(), told=_tell)
    sys.stdout.write(table(figures) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="calibration", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for command, families in (("make", tuple(FAMILIES)), ("plates", plates.FAMILIES)):
        make = commands.add_parser(command, help="write campaigns, points and truths")
        make.add_argument("folder", type=Path)
        make.add_argument("--families", default=",".join(families))
        make.add_argument("--n", type=int, default=6 if command == "make" else 20, help="machines of each family")
        make.add_argument("--seed", type=int, default=1)
    solve = commands.add_parser("judge", help="solve every campaign and compare with the truth")
    solve.add_argument("folder", type=Path)
    solve.add_argument("--answers", type=Path, default=None)
    solve.add_argument("--jobs", type=int, default=1, help="processes at a time")
    solve.add_argument("--options", default="", help="passed to abbe solve")
    args = parser.parse_args()
    unknown = [f for f in getattr(args, "families", "").split(",") if f and f not in FAMILIES]
    if unknown:
        parser.error(f"--families: no family {', '.join(unknown)}; there are {', '.join(FAMILIES)}")
    return args


def _tell(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()


if __name__ == "__main__":
    main()
