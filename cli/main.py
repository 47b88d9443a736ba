"""The command line `cvqmpt`: find a command's module, parse its options and run it.

A module `NAME_command` has a table COMMANDS: function and options of each of its commands.
"""

import argparse
import gc
import importlib
import io
import os
import re
import sys
import textwrap
import traceback
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NoReturn

import cvqmpt_lab
from cvqmpt_lab.base.arithmetic import without_library_tuning
from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, UnknownChoiceError, nearest
from cvqmpt_lab.cli.options import NOTES

# By heading of `cvqmpt --help` and by name: NAME of the module cvqmpt_lab.cli.NAME_command, and a
# summary.
HEADINGS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "make a problem": {
        "problems": ("problems", "list or export the problems of a suite, or write a template"),
        "scan": ("scan", "make a clean cloud or a scene from depth images or clouds"),
        "robot": (
            "robot",
            "print a robot's model, write a robot file, or list the robots known by name",
        ),
        "fk": ("problems", "print the pose of the hand at a configuration"),
        "ik": ("problems", "find configurations for a pose or region, for a problem file"),
    },
    "plan": {
        "plan": ("plan", "plan one problem and print a short report"),
        "follow": ("follow", "move the hand along straight lines through poses"),
        "studio": (
            "plan",
            "drag start, goal and obstacles in the browser; the path is planned again",
        ),
    },
    "judge and run": {
        "certify": ("certify", "certify a path or trajectory, or all paths of a run again"),
        "audit": ("audit", "judge every episode of a data set for one robot"),
        "execute": ("execute", "execute a motion or task in a physics simulation"),
    },
    "reproduce": {
        "reproduce": (
            "reproduce",
            "run a suite of problems or tasks and write its rows and tables",
        ),
        "figure": ("reproduce", "make a figure of the paper, with its numbers"),
        "claims": (
            "tables",
            "judge every claim of the paper by rows, and write the page of claims",
        ),
        "report": ("tables", "write one html file about results: verdicts, tables, plots, rows"),
        "compare": ("tables", "list what changed between two runs of the same problems"),
        "table": ("tables", "render the tables of a results directory"),
        "check-tables": (
            "tables",
            "repeat a few runs and compare them with committed expectations",
        ),
        "bench": (
            "setup",
            "measure the times of planning stages, and of a check in the paper's simulator",
        ),
        "warmup": ("setup", "compile all kernels ahead of time"),
        "completion": ("setup", "print the completion of commands and options for a shell"),
        "doctor": ("setup", "list what is installed, what is missing and how to install it"),
    },
    "learn": {
        "data": ("data", "make training paths"),
        "train": ("model", "train the dictionary, the sequence model or MPNet"),
        "model": ("model", "show weights, convert published ones"),
    },
}
COMMANDS = {name: told for commands in HEADINGS.values() for name, told in commands.items()}

# Options of other programs, and the options here with the same meaning.
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
    "--constraint --cloud --scene --picture --save --trajectory"
}

# Commands that go on where they were interrupted.
CONTINUED = ("reproduce", "data", "train", "audit")

# Small networks are several times slower on many threads, and runs share the cores already.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


EXAMPLES = """examples:
  cvqmpt plan place-task --problem 7 --planner birrt --seed 0
  cvqmpt plan mine.json --planner birrt --save run.rrd
  cvqmpt reproduce place-task --problems 20 --seeds 1 --out runs/small
  cvqmpt table runs/small

cvqmpt COMMAND --help lists options and examples."""


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line without the usage; it reads -0.1,0.2 as a value."""

    shows_all = False  # whether help texts show every option

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d|\.\d)[\d.,eE+-]*$")

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        raise InvalidInputError(f"{message}; {self.prog} --help lists all options")

    def format_help(self) -> str:
        """Return the help of a command, with its examples, or of all commands under headings."""
        command = self.prog.partition(" ")[2]
        if not command:
            return f"{self.format_usage()}\n{self.description}\n\n{_headings()}\n{self.epilog}\n"
        if command in SHORT and not self.shows_all:
            known = SHORT[command].split()
            self.usage = f"{self.prog} [SUITE|FILE] [options]; --help-all shows every option"
            for action in self._actions:
                if not {*action.option_strings, action.dest} & {*known}:
                    action.help = argparse.SUPPRESS
        self.epilog = "\n  ".join(["examples:", *examples_of(command)])
        return super().format_help()


def _headings() -> str:
    """Return the lines of the commands under their headings."""
    lines, wide = list[str](), 16
    for heading, commands in HEADINGS.items():
        lines.append(f"{heading}:")
        for name, (_, summary) in commands.items():
            text = textwrap.wrap(summary, 98 - wide)
            lines.append(f"  {name:{wide - 2}}{text[0]}")
            lines += [" " * wide + more for more in text[1:]]
        lines.append("")
    return "\n".join(lines)


class Version(argparse.Action):
    """Option that prints the version and exits; the version is looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Print the version and exit."""
        print(f"cvqmpt_lab {cvqmpt_lab.__version__}")
        parser.exit()


def command_named(name: str) -> tuple[Any, Any]:
    """Return function and options of a command (see `options.add_options`); import its module."""
    module = importlib.import_module(f"cvqmpt_lab.cli.{COMMANDS[name][0]}_command")
    return module.COMMANDS[name]


def examples_of(command: str) -> list[str]:
    """Return the examples of a command's help."""
    import tomllib  # needed for help texts only

    text = (Path(__file__).parent / "examples.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)[command]


def parser_with(filled: Collection[str]) -> Parser:
    """Return the parser of the command line; modules of the commands in `filled` are imported."""
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
    command = next((word for word in argv if word in COMMANDS), None)
    if command == "train":
        # threads that wait in a loop take the cores from other processes (twice the time for both)
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    else:
        for variable in THREADS:
            os.environ.setdefault(variable, "1")
    first = next((word for word in argv if not word.startswith("-")), None)
    if command is None and first is not None:
        raise UnknownChoiceError("command", first, COMMANDS)
    Parser.shows_all = "--help-all" in argv
    if Parser.shows_all:
        argv = ["--help" if word == "--help-all" else word for word in argv]
    parser = parser_with([command] if command else ())
    if command is not None:
        known = _options_of(parser, command)
        given = {word.partition("=")[0] for word in argv if word.startswith("--")}
        if given - {*known} or command == "bench":
            from cvqmpt_lab.cli.old_spellings import refuse_old  # few commands need it

            refuse_old(command, argv, known)
    args, unknown = parser.parse_known_args(argv)
    if unknown and command is not None:
        unknown = _placed(parser, args, unknown)
    if unknown:
        if getattr(args, "suite", None) is not None and not unknown[0].startswith("-"):
            raise InvalidInputError(f"{args.suite} and {unknown[0]}: give one suite or file")
        raise InvalidInputError(
            f"unknown arguments: {' '.join(unknown)}{_hint(parser, args.command, unknown[0])}; "
            f"cvqmpt {args.command} --help lists all options"
        )
    return args


def _placed(parser: Parser, args: argparse.Namespace, unknown: list[str]) -> list[str]:
    """Store words behind options as positionals, which argparse reads only before; return others.

    Args:
        parser: the parser.
        args: what it has read; it is changed.
        unknown: words that it has not read.
    """
    if any(word.startswith("-") for word in unknown):
        return unknown  # a word may be the value of an unknown option
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    left = list[str]()
    for word in unknown:
        for action in commands.choices[args.command]._actions:
            own = getattr(args, action.dest, None)
            kind: Any = action.type or str
            if action.option_strings or action.nargs not in ("?", "+"):
                continue
            if action.nargs == "+":
                setattr(args, action.dest, [*(own or ()), kind(word)])
                break
            if own == action.default:
                setattr(args, action.dest, kind(word))
                break
        else:
            left.append(word)
    return left


def _hint(parser: Parser, command: str, word: str) -> str:
    """Return "; did you mean OPTION?" for an unknown option that resembles one, or ""."""
    known = _options_of(parser, command)
    same = [name for name in OTHER_WORDS.get(word, "").split() if name in known]
    return f"; did you mean {same[0]!r}?" if same else nearest(word, known)


def _where(message: str, argv: list[str]) -> str:
    """Return the command that has the options of a message that this command lacks, or ""."""
    command = next((word for word in argv if word in COMMANDS), None)
    named = re.findall(r"(?<![\w-])--[a-z]+(?:-[a-z]+)*", message)
    told = ("cvqmpt robot", "cvqmpt scan", "unknown option", "unknown arguments")
    if command is None or not named or any(words in message for words in told):
        return ""
    from cvqmpt_lab.cli.old_spellings import ROBOT_OPTIONS, SCAN_OPTIONS, WITH_ROBOT, Line

    own = _options_of(parser_with([command]), command)
    for name in named:
        if name in ROBOT_OPTIONS and name not in own and command in WITH_ROBOT:
            robot = Line(command, argv).value("--robot", otherwise="") or Line(command, argv).file
            return (
                f"; write it into a robot file: cvqmpt robot {robot or 'NAME|URDF'} {name} ... "
                "--out robot.json; then give --robot robot.json"
            )
        if name in SCAN_OPTIONS and name not in own and command == "plan":
            return f"; {name} is an option of cvqmpt scan, whose --out plan reads"
    return ""


def _options_of(parser: Parser, command: str) -> list[str]:
    """Return the options of a command."""
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    actions = commands.choices[command]._actions
    return [name for action in actions for name in action.option_strings]


def main(argv: list[str] | None = None) -> int:
    """Run a command and return its exit code; errors of the package print one line and give 2."""
    argv = sys.argv[1:] if argv is None else argv
    NOTES.clear()
    try:
        args = _parsed(argv)
        if not gc.isenabled():  # see entry_point
            gc.freeze()
            gc.enable()
        if getattr(args, "allow_code", False):
            from cvqmpt_lab.base.modules import allow_code  # few commands do

            allow_code()
        code = command_named(args.command)[0](args)
        for note in NOTES:
            print(note, file=sys.stderr)
        sys.stdout.flush()
        return code or 0  # most commands return None
    except CvqmptError as error:
        print(f"cvqmpt: {error}{_where(str(error), argv)}", file=sys.stderr)
        return 2
    except MemoryError as error:
        print(f"cvqmpt: out of memory ({error}); {_kept(argv)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"cvqmpt: interrupted; {_kept(argv)}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader has gone; 0 would mean a valid certificate
        _silence()
        return 141  # as shells return it
    except OSError as error:
        print(f"cvqmpt: {error}", file=sys.stderr)
        _silence()
        return 2


def _kept(argv: list[str]) -> str:
    """Return what an interrupted command leaves behind."""
    command = next((word for word in argv if word in COMMANDS), "")
    if command in CONTINUED:
        return "finished results are kept, the same command continues"
    return "files that it has named as written are kept, nothing else; the same command begins anew"


def _silence() -> None:
    """Discard further output, so that Python does not write to a closed pipe at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _tell_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning as one line, without the line of the source that Python prints."""
    print(f"note: {' '.join(str(message).split())}", file=sys.stderr)


def entry_point() -> None:
    """Run the console script; characters outside the terminal's encoding are escaped.

    An internal error ends with exit code 2, not with Python's 1, which is a verdict.
    """
    without_library_tuning()
    # garbage collection during imports would take a tenth of a short command's time, most at exit
    gc.disable()
    if sys.stderr is None:  # closed
        sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115
    if sys.stdout is None:
        print(
            "cvqmpt: standard output is closed; redirect it, as to /dev/null",
            file=sys.stderr,
        )
        sys.exit(2)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    warnings.showwarning = _tell_warning
    try:
        sys.exit(main())
    except Exception:
        traceback.print_exc()
        sys.exit(2)


if __name__ == "__main__":
    entry_point()
