"""`cvqmpt`: each module has in COMMANDS what runs its commands, and their tables of options."""

import argparse
import gc
import importlib
import io
import os
import re
import sys
import traceback
from collections.abc import Collection
from pathlib import Path
from typing import Any, NoReturn

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, UnknownChoiceError, nearest

COMMANDS = {  # by name: the module cvqmpt_lab.cli.NAME_command that has it, and a summary
    "plan": ("plan", "plan one problem and print a short report"),
    "certify": ("certify", "judge a path or trajectory, or every path of a run again"),
    "execute": ("execute", "execute a motion or task in a physics simulation"),
    "studio": ("plan", "drag start, goal and obstacles in the browser; the path follows"),
    "reproduce": ("reproduce", "run a suite of problems or tasks and write its rows and tables"),
    "figure": ("reproduce", "make a figure of the paper, with its numbers"),
    "claims": ("tables", "judge every claim of the paper by rows, and write the page that says so"),
    "report": ("tables", "write one html file about results: verdicts, tables, plots, rows"),
    "compare": ("tables", "say what changed between two runs of the same problems"),
    "table": ("tables", "render the tables of a results directory"),
    "problems": ("problems", "list or export the problems of a suite, or write one to start from"),
    "scan": ("scan", "make a clean cloud or a scene of depth images or clouds"),
    "ik": ("problems", "find configurations for a pose or region, for a problem file"),
    "robot": (
        "robot",
        "show what is understood of a robot's description, or list the arms that have a name",
    ),
    "check-tables": ("tables", "run a little again and compare with what is expected"),
    "data": ("data", "make training paths"),
    "train": ("model", "train the dictionary, the sequence model or MPNet"),
    "model": ("model", "show weights, convert published ones"),
    "bench": (
        "setup",
        "measure the stages of planning, and a state check of the paper's simulator",
    ),
    "warmup": ("setup", "compile all kernels ahead of time"),
    "doctor": ("setup", "tell what is installed here, what is missing and how to get it"),
}

# Words of other programs, and ours.
OTHER_WORDS = {
    "--timeout": "--cutoff",
    "--time-limit": "--cutoff",
    "--max-time": "--cutoff",
    "--output": "--save --out",
    "-o": "--save --out",
    "-p": "--planner",
    "--algorithm": "--planner",
    "--threads": "--jobs",
    "--gui": "--save run.html",
}
# Options that `cvqmpt plan --help` shows; --help-all shows all.
SHORT = {
    "plan": "-h suite --problem --robot --planner --cutoff --seed --start --goal --goal-pose "
    "--constraint --cloud --picture --save --trajectory"
}

# Small networks are several times slower on many threads, and runs share the cores already.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


EXAMPLES = """examples:
  cvqmpt plan place-task --problem 7 --planner birrt --seed 0
  cvqmpt plan --problem-file mine.json --planner birrt --save run.rrd
  cvqmpt reproduce place-task --problems 20 --seeds 1 --out runs/small
  cvqmpt table runs/small

cvqmpt COMMAND --help tells the rest."""


class Parser(argparse.ArgumentParser):
    """argparse whose errors are ours, one line without the usage; -0.1,0.2 is a value."""

    whole = False  # whether helps show every option

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d|\.\d)[\d.,eE+-]*$")

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        raise InvalidInputError(f"{message}; {self.prog} --help lists what can be given")

    def format_help(self) -> str:
        """The help of a command, with its examples."""
        command = self.prog.partition(" ")[2]
        if command in SHORT and not self.whole:
            known = SHORT[command].split()
            self.usage = f"{self.prog} [SUITE|FILE] [options]; --help-all shows every option"
            for action in self._actions:
                if not {*action.option_strings, action.dest} & {*known}:
                    action.help = argparse.SUPPRESS
        if command:
            self.epilog = "\n  ".join(["examples:", *examples_of(command)])
        return super().format_help()


class Version(argparse.Action):
    """Print the version and exit; it is looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Print the version and exit."""
        from importlib.metadata import version

        print(f"cvqmpt_lab {version('cvqmpt-lab')}")
        parser.exit()


def command_named(name: str) -> tuple[Any, Any]:
    """Function and options of a command (see `options.add_options`); imports its module."""
    module = importlib.import_module(f"cvqmpt_lab.cli.{COMMANDS[name][0]}_command")
    return module.COMMANDS[name]


def examples_of(command: str) -> list[str]:
    """The examples of a command's help."""
    import tomllib  # for helps alone

    text = (Path(__file__).parent / "examples.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)[command]


def parser_with(filled: Collection[str]) -> Parser:
    """The whole command line, with the options of some subcommands, which are imported."""
    parser = Parser(
        prog="cvqmpt",
        description="Constrained motion planning with learned sampling dictionaries: plan, "
        "measure, reproduce.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (_, summary) in COMMANDS.items():
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name in filled:
            from cvqmpt_lab.cli.options import add_options

            add_options(sub, command_named(name)[1])
    return parser


def _parsed(argv: list[str]) -> argparse.Namespace:
    asked = next((word for word in argv if word in COMMANDS), None)
    if asked != "train":
        for variable in THREADS:
            os.environ.setdefault(variable, "1")
    first = next((word for word in argv if not word.startswith("-")), None)
    if asked is None and first is not None:
        raise UnknownChoiceError("command", first, COMMANDS)
    Parser.whole = "--help-all" in argv
    if Parser.whole:
        argv = ["--help" if word == "--help-all" else word for word in argv]
    parser = parser_with([asked] if asked else ())
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        raise InvalidInputError(
            f"unknown arguments: {' '.join(unknown)}{_meant(parser, args.command, unknown[0])}; "
            f"cvqmpt {args.command} --help lists what can be given"
        )
    return args


def _meant(parser: Parser, command: str, word: str) -> str:
    """The option that was meant by a word, as "; did you mean ...?", or ""."""
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    actions = commands.choices[command]._actions
    known = [name for action in actions for name in action.option_strings]
    ours = [name for name in OTHER_WORDS.get(word, "").split() if name in known]
    return f"; did you mean {ours[0]!r}?" if ours else nearest(word, known)


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; errors of the package become one line and exit code 2."""
    try:
        args = _parsed(sys.argv[1:] if argv is None else argv)
        if not gc.isenabled():  # see entry_point
            gc.freeze()
            gc.enable()
        code = command_named(args.command)[0](args)
        sys.stdout.flush()
        return code or 0  # most commands say nothing else
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
        return 141  # as shells give it
    except OSError as error:
        print(f"cvqmpt: {error}", file=sys.stderr)
        _silence()
        return 2


def _silence() -> None:
    """Discard further output: Python must not write at exit to a closed pipe."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def entry_point() -> None:
    """Console script; letters outside the terminal's encoding are escaped.

    Exit code 2, not Python's 1, after an error that is a fault of this package: 1 is a verdict.
    """
    # what is imported is no garbage: looking for some in it takes a tenth of a short command, most
    # of that at its end
    gc.disable()
    if sys.stderr is None:  # closed
        sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115
    if sys.stdout is None:
        print("cvqmpt: standard output is closed; give one, such as /dev/null", file=sys.stderr)
        sys.exit(2)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        sys.exit(main())
    except Exception:
        traceback.print_exc()
        sys.exit(2)


if __name__ == "__main__":
    entry_point()
