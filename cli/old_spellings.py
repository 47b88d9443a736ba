"""Options of earlier versions: each is refused in one line, with its new spelling."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise, takewhile
from typing import NamedTuple

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.declarations import SUITES

ONE_OR_MORE = 2
# options that describe a robot, and their number of values: 0, 1 or ONE_OR_MORE
ROBOT_OPTIONS: Mapping[str, int] = {
    "--urdf": 1,
    "--end-effector": 1,
    "--end-effectors": ONE_OR_MORE,
    "--srdf": 1,
    "--package-dir": 1,
    "--lock": 1,
    "--base": 1,
    "--tool": 1,
    "--joint-limits": 1,
    "--velocity": 1,
    "--acceleration": 1,
    "--jerk": 1,
    "--effort": 1,
    "--hard-limits": 0,
    "--visual-as-collision": 0,
    "--skip-missing-meshes": 0,
    "--bodies": 1,
    "--tool-speed": 1,
}
# options that describe a scan; all have one value
SCAN_OPTIONS = (
    *("--intrinsics", "--extrinsics", "--scale", "--level", "--down", "--front", "--crop"),
    *("--voxel", "--robot-margin", "--arm-at", "--neighbours", "--plane", "--map", "--padding"),
    *("--unknown", "--radius"),
)
FILES = ("--problem-file", "--task-file", "--json")  # a file may follow them
_NUMBER = re.compile(r"-(\d|\.\d)[\d.,eE+-]*$")


class Given(NamedTuple):
    """An option as it was given."""

    name: str
    values: tuple[str, ...]

    @property
    def spelled(self) -> str:
        """The words of the command line."""
        return " ".join((self.name, *map(_quoted, self.values)))


class Line(NamedTuple):
    """A command line with an option of an earlier version."""

    command: str
    words: Sequence[str]

    def options(self, names: Collection[str]) -> list[Given]:
        """Return the given options among `names`, in order."""
        found = []
        for k, word in enumerate(self.words):
            name, equals, value = word.partition("=")
            if name not in names:
                continue
            following = [value] if equals else [*takewhile(_is_value, self.words[k + 1 :])]
            most = ROBOT_OPTIONS.get(name, 1)
            found.append(Given(name, tuple(following if most == 2 else following[:most])))
        return found

    def value(self, *names: str, otherwise: str) -> str:
        """Return the value of the first given option among `names`."""
        given = (option.values for option in self.options(names))
        return next((values[0] for values in given if values), otherwise)

    @property
    def file(self) -> str | None:
        """The problem file that is named, if any."""
        named = [
            word
            for before, word in pairwise(self.words)
            if word.endswith(".json") and (not before.startswith("-") or before in FILES)
        ]
        return named[-1] if named else None

    @property
    def suite(self) -> str | None:
        """The suite that is named, if any."""
        return next((word for word in self.words if word in SUITES), None)


def _is_value(word: str) -> bool:
    return not word.startswith("-") or bool(_NUMBER.match(word))


def _quoted(word: str) -> str:
    return f'"{word}"' if " " in word else word


def _alone(line: Line, given: Given) -> str:
    """Return the advice for an option whose value is now written without the option."""
    value = given.values[0] if given.values else "FILE"
    more = {"certify": "PATH ", "scan": "SCAN ", "follow": "POSES.csv "}.get(line.command, "")
    return f"write {value} alone: cvqmpt {line.command} {more}{value}"


def _robot(line: Line, given: Given) -> str:
    """Return the advice for an option that describes a robot."""
    urdf = line.value("--urdf", otherwise="")
    details = [x for x in line.options(ROBOT_OPTIONS) if x.name != "--urdf"]
    if not details:
        return f"write --robot {urdf or 'ARM.urdf'}"
    robot = urdf or line.value("--robot", otherwise=line.file or "NAME|URDF|FILE")
    words = " ".join(option.spelled for option in details)
    export = ""
    if (suite := line.suite) and robot == "NAME|URDF|FILE":
        export = f"cvqmpt problems export {suite} --out {suite}; "
        robot = f"{suite}/{suite}-{line.value('--problem', otherwise='0'):0>3}.json"
    return (
        f"write a robot file: {export}cvqmpt robot {robot} {words} --out robot.json; then give "
        "--robot robot.json"
    )


def _scan(line: Line, given: Given) -> str:
    """Return the cure of an option that describes a scan, in the command plan."""
    files = [value for option in line.options(("--cloud",)) for value in option.values]
    options = line.options(SCAN_OPTIONS)
    words = [option.spelled for option in options]
    if all(option.name != "--arm-at" for option in options):
        words.append(f"--arm-at {line.value('--start', otherwise='Q')}")
    if line.file is not None and not files:
        return (
            f"write cvqmpt scan SCAN {' '.join(words)} --out scene.json; then name it in "
            f'{line.file}: "scene": "scene.json"'
        )
    motion = line.options(("--start", "--start-pose", "--goal", "--goal-pose"))
    kind, out = ("--scene", "scene.json") if motion else ("--cloud", "clean.pcd")
    instead = "" if kind == "--cloud" else " instead of --cloud"
    return (
        f"write cvqmpt scan {' '.join(files) or 'SCAN'} {' '.join(words)} --out {out}; then give "
        f"{kind} {out}{instead}"
    )


def _prices(line: Line, given: Given) -> str:
    value = given.values[0] if given.values else "NAME"
    return f"write --cost {line.value('--cost', otherwise='S')}:{value}"


def _margin_angle(line: Line, given: Given) -> str:
    value = given.values[0] if given.values else "RAD"
    return f"write --margin {line.value('--margin', otherwise='0.002')},{value}"


def _save(line: Line, given: Given) -> str:
    value = given.values[0] if given.values else "PATH.csv"
    return f"write --save {value}"


Cure = Callable[[Line, Given], str]
WITH_ROBOT = (
    *("plan", "execute", "certify", "scan", "studio", "follow", "data", "ik", "problems", "fk"),
)
# by option: the commands that had it, and its cure
OLD: Mapping[str, tuple[Collection[str], Cure]] = {
    **dict.fromkeys(ROBOT_OPTIONS, (WITH_ROBOT, _robot)),
    "--problem-file": (
        ("plan", "execute", "certify", "studio", "ik", "fk", "scan", "follow"),
        _alone,
    ),
    "--task-file": (("plan", "execute", "certify"), _alone),
    "--problems-dir": (("certify", "reproduce"), _alone),
    **dict.fromkeys(SCAN_OPTIONS, (("plan",), _scan)),
    "--prices": (("plan", "execute", "reproduce"), _prices),
    "--margin-angle": (("plan", "execute"), _margin_angle),
    "--save-path": (("plan",), _save),
    "--clearance-out": (("certify",), _save),
    "--json": (("bench",), lambda line, given: f"write --json > {given.values[0]}"),
    "--door": (("problems",), lambda line, given: "write --task door"),
}


def _whole(word: str, names: Collection[str], known: Collection[str]) -> str:
    """Return the option of earlier versions that a word abbreviates, or the word.

    Args:
        word: a word of the command line.
        names: options of earlier versions.
        known: options of the command, whose abbreviations stay.
    """
    begin, equals, value = word.partition("=")
    if len(begin) < 4 or not begin.startswith("--") or begin in names:
        return word
    found = [name for name in names if name.startswith(begin)]
    if len(found) != 1 or any(name.startswith(begin) for name in known):
        return word
    return f"{found[0]}{equals}{value}"


def refuse_old(command: str, words: Sequence[str], known: Collection[str]) -> None:
    """Refuse the first option of an earlier version, with its new spelling.

    Args:
        command: the command's name.
        words: the command line.
        known: options of the command, which are not refused.
    """
    names = {name for name, (commands, _) in OLD.items() if command in commands}
    line = Line(command, [_whole(word, names, known) for word in words])
    for given in line.options(names):
        if given.name in known and (given.name != "--json" or not given.values):
            continue
        cure = OLD[given.name][1](line, given)
        raise InvalidInputError(f"unknown option {given.spelled}; {cure}")
