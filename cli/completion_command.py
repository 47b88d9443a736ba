"""`cvqmpt completion`: what makes a shell complete commands, options, names and files;
nothing runs at a prompt.
"""

import argparse
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import shtab

from cli.main import COMMANDS, parser_with
from cvqmpt_lab.benchmarks.suite import SUITES
from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.planners import CONTROLS, PLANNERS
from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.search.space import BACKENDS

EXAMPLES = (
    "cvqmpt completion bash > ~/.local/share/bash-completion/completions/cvqmpt",
    "cvqmpt completion zsh > ~/.zfunc/_cvqmpt      # ~/.zfunc in fpath",
)
NAMES: Mapping[str, Iterable[str]] = {  # what arguments of this name take
    "suite": SUITES,
    "planner": (*PLANNERS, *CONTROLS),
    "planners": (*PLANNERS, *CONTROLS),
    "robot": ARMS,
    "backend": BACKENDS,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which shell."""
    parser.add_argument("shell", help=f"one of {', '.join(shtab.SUPPORTED_SHELLS)}")


def run(args: argparse.Namespace) -> int:
    """Print the shell's script."""
    if args.shell not in shtab.SUPPORTED_SHELLS:
        raise UnknownChoiceError("shell", args.shell, shtab.SUPPORTED_SHELLS)
    parser = parser_with(COMMANDS)
    for action in _actions(parser):
        if action.dest in NAMES:
            action.choices = list(NAMES[action.dest])
        elif action.type is Path:
            action.complete = shtab.DIR if action.metavar == "DIR" else shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, args.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """All arguments and options, those of subcommands too."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from _actions(sub)
