"""`cvqmpt`: one subcommand a file; each has add_arguments(parser) and run(args) -> exit code."""

import argparse
import importlib
import io
import os
import re
import sys
from collections.abc import Collection
from typing import Any, NoReturn

from cvqmpt_lab.errors import CvqmptError, InvalidInputError

COMMANDS = {
    "plan": "plan one problem and print a short report",
    "certify": "judge a path or trajectory, or every path of a run again",
    "reproduce": "run a suite of problems or tasks and write its rows and tables",
    "figure": "make a figure of the paper, with its numbers",
    "claims": "judge every claim of the paper by rows, and write the page that says so",
    "report": "write one html file about results: verdicts, tables, plots, rows",
    "compare": "say what changed between two runs of the same problems",
    "table": "render the tables of a results directory",
    "problems": "list or export the problems of a suite, or write one to start from",
    "scan": "make a clean cloud or a scene of depth images or clouds",
    "ik": "find configurations for a pose or region, for a problem file",
    "calibrate": "find where a depth camera stands, from the arm that it sees",
    "robot": "show what is understood of a robot's description, or list the arms that have a name",
    "check-tables": "re-run a tiny profile and compare with the committed expectations",
    "data": "make training paths",
    "train": "train the dictionary, the sequence model or MPNet",
    "model": "show weights, convert published ones",
    "bench": "measure the stages of planning, and a state check of the paper's simulator",
    "warmup": "compile all kernels ahead of time",
    "doctor": "tell what is installed here, what is missing and how to get it",
    "completion": "print what makes a shell complete commands, options and names",
}

# Small networks are several times slower on many threads, and runs share the cores already.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")

CLOSED_PIPE = 141  # exit code of a command whose reader has gone, as shells give it

EXAMPLES = """examples:
  cvqmpt plan place-task --problem 7 --planner birrt --seed 0
  cvqmpt plan --problem-file mine.json --planner birrt --save run.rrd
  cvqmpt reproduce place-task --problems 20 --seeds 1 --out runs/small
  cvqmpt table runs/small

cvqmpt COMMAND --help tells the rest."""


class Parser(argparse.ArgumentParser):
    """argparse whose errors are ours: one line, without the usage;
    -0.1,0.2 is a value and no option.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d|\.\d)[\d.,eE+-]*$")

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        raise InvalidInputError(f"{message}; {self.prog} --help lists what can be given")


class Version(argparse.Action):
    """Print the version and leave; it is read only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Do it."""
        from importlib.metadata import version

        print(f"cvqmpt_lab {version('cvqmpt-lab')}")
        parser.exit()


def _module(command: str):
    return importlib.import_module(f"cli.{command.replace('-', '_')}_command")


def parser_with(filled: Collection[str]) -> Parser:
    """The whole command line, with the options of some subcommands:
    only they pay for their imports.
    """
    parser = Parser(
        prog="cvqmpt",
        description="Constrained motion planning with learned sampling dictionaries: plan, "
        "measure, reproduce.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name in filled:
            module = _module(name)
            sub.epilog = "examples:\n" + "\n".join("  " + line for line in module.EXAMPLES)
            module.add_arguments(sub)
    return parser


def _parsed(argv: list[str]) -> argparse.Namespace:
    asked = next((word for word in argv if word in COMMANDS), None)
    if asked != "train":
        for variable in THREADS:
            os.environ.setdefault(variable, "1")
    args, unknown = parser_with([asked] if asked else ()).parse_known_args(argv)
    if unknown:
        raise InvalidInputError(
            f"unknown arguments: {' '.join(unknown)}; cvqmpt {args.command} --help lists what can "
            f"be given"
        )
    return args


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; errors of the package become one line and exit code 2."""
    try:
        args = _parsed(sys.argv[1:] if argv is None else argv)
        code = _module(args.command).run(args)
        sys.stdout.flush()
        return code
    except CvqmptError as error:
        print(f"cvqmpt: {error}", file=sys.stderr)
        return 2
    except MemoryError as error:
        print(f"cvqmpt: out of memory ({error}); what was finished is kept", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "cvqmpt: interrupted; what was finished is kept, the same command continues",
            file=sys.stderr,
        )
        return 130
    except BrokenPipeError:  # nobody reads on: not what a certificate says, so not 0
        _silence()
        return CLOSED_PIPE
    except OSError as error:
        print(f"cvqmpt: {error}", file=sys.stderr)
        _silence()
        return 2


def _silence() -> None:
    """Nothing more can be printed, and Python shall not try when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def entry_point() -> None:
    """Console script; letters that the terminal does not know are written as their numbers."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    sys.exit(main())


if __name__ == "__main__":
    entry_point()
