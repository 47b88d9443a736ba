"""The suites by name: each is an ordered set of problems or tasks.

A folder of problem files is one by its path: every ``*.json`` is a problem, in order of file names.
Modules of suites other than the place task are imported when their first problem is made, so that
`cvqmpt plan` need not import them.
"""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import read_json_object
from cvqmpt_lab.benchmarks.item import SensedProblem, UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import (
    ENVIRONMENTS,
    MORE_ENVIRONMENTS,
    carried_can,
    door_problem,
    mirrored_problem,
    multi_sequence_task,
    place_problem,
    single_goal_problem,
)
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import cell_text, natural_key
from cvqmpt_lab.robot.robot import SLOW_SPEED
from cvqmpt_lab.robot.source import content_digest
from cvqmpt_lab.scene.families import FAMILIES
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.scene_files import named_files
from cvqmpt_lab.tasks.task import Task

SuiteItem = PlanningProblem | UnsolvableProblem | SensedProblem | Task


@dataclass(frozen=True)
class Suite:
    """A named, ordered set of problems or tasks; make(i) builds the one with index i."""

    name: str
    problems: Sequence[Any]  # indices, or names of the problems of a folder
    make: Callable[[Any], SuiteItem]
    # in the hand in pictures, where its problems do not model it
    carried: tuple[Attachment, ...] = ()
    # every planner computes its own distance field and edge costs of a cloud
    new_scenes: bool = True
    # what else decides its rows, as json values
    settings: Mapping[str, object] = field(default_factory=dict)
    # sha256 of a folder's problems, by name
    digests: Mapping[str, str] = field(default_factory=dict)

    def item(self, index: int | str) -> SuiteItem:
        """Problem or task `index`; InvalidInputError names the valid range."""
        if index not in self.problems:
            raise InvalidInputError(
                f"unknown problem {index} of suite {self.name}; valid indices: {self.problems[0]} "
                f"to {self.problems[-1]}"
            )
        return self.make(index)

    def solvable(self, index: int | str) -> PlanningProblem | Task:
        """The same, of a scanned scene in its map; InvalidInputError where there is no problem."""
        item = self.item(index)
        if isinstance(item, UnsolvableProblem):
            raise InvalidInputError(
                f"problem {index} of {self.name} has no solution: {item.reason}"
            )
        return item.problem if isinstance(item, SensedProblem) else item


def _item(suite: str, index: int) -> SuiteItem:
    """Problem or task of a suite whose module is imported when its first item is made."""
    from cvqmpt_lab.benchmarks import family_task, motion_bench, passages, sensor_task, two_arms

    if suite.startswith("family-"):
        return family_task.held_out_problem(suite.removeprefix("family-"), index)
    makers: Mapping[str, Callable[[int], SuiteItem]] = {
        "constraints": family_task.constraint_problem,
        "motion-bench": motion_bench.motion_bench_problem,
        "motion-bench-upright": motion_bench.level_problem,
        "passages": passages.passage_problem,
        "peers-two-arms": two_arms.peers_problem,
        "robots": family_task.robots_problem,
        "sensor": sensor_task.sensor_problem,
        "two-arms": two_arms.two_arms_problem,
        "unconstrained": family_task.unconstrained_problem,
    }
    return makers[suite](index)


_CAN = (carried_can(),)
_CONSTRAINED = partial(_item, "constraints")
SUITES: Mapping[str, Suite] = {
    suite.name: suite
    for suite in (
        Suite("place-task", ENVIRONMENTS, place_problem, _CAN),
        Suite("place-task-more", MORE_ENVIRONMENTS, place_problem, _CAN),
        Suite("place-task-with-can", ENVIRONMENTS, partial(place_problem, with_can=True)),
        Suite("place-task-single-goal", range(30), single_goal_problem, _CAN),
        Suite("place-task-mirrored", range(60), mirrored_problem, _CAN),
        *(Suite(f"family-{n}", range(50), partial(_item, f"family-{n}")) for n in FAMILIES),
        Suite("constraints", range(160), _CONSTRAINED),
        Suite("factorial", range(60), place_problem),
        Suite("factorial-constraints", range(80), _CONSTRAINED),
        Suite("open-door", range(10), door_problem, new_scenes=False),
        Suite("passages", range(160), partial(_item, "passages")),
        Suite("robots", range(180), partial(_item, "robots")),
        Suite("peers", range(30), single_goal_problem, _CAN, new_scenes=False),
        Suite("peers-two-arms", range(20), partial(_item, "peers-two-arms")),
        Suite("sensor", range(98), partial(_item, "sensor")),
        Suite("two-arms", range(180), partial(_item, "two-arms")),
        Suite("unconstrained", range(120), partial(_item, "unconstrained")),
        *(
            Suite(name, range(2100), partial(_item, name))
            for name in ("motion-bench", "motion-bench-upright")
        ),
        *(
            Suite(
                name, tasks, multi_sequence_task, new_scenes=False, settings={"speed": SLOW_SPEED}
            )
            for name, tasks in (
                ("multi-sequence", range(66)),
                ("multi-sequence-more", range(66, 816)),
            )
        ),
    )
}


_FOLDERS: dict[str, Suite] = {}  # by full path; workers that are forked find what was read before


def folder_suite(folder: Path) -> Suite:
    """The problems of a folder as they are now, as a suite with the folder's name.

    `suite_named` finds it by full path. A problem's digest is the sha256 over the file and all that
    it names: scene, clouds, meshes, URDF, SRDF.

    Left out are hidden files, json schemas for editors, expectations of `cvqmpt check-tables`, and
    scenes that a problem of the folder names. InvalidInputError names the file that is no problem,
    and what is wrong in it; two of one name; an empty folder; a folder of the name of a suite.
    """
    contents, path = _contents(folder), folder.resolve()
    named = [data["scene"] for data in contents.values() if isinstance(data.get("scene"), str)]
    scenes = {(folder / scene).resolve() for scene in named}
    problems: dict[str, PlanningProblem] = {}
    digests, paths = dict[str, str](), dict[str, Path]()
    for file, data in contents.items():
        if file.resolve() in scenes or str(data.get("schema")).startswith("cvqmpt-expectations/"):
            continue
        problem = PlanningProblem.load(file)
        # a slash, after which rows name the phase of a task, becomes a hyphen
        name = problem.name.replace("/", "-")
        if cell_text(name) != name:
            raise InvalidInputError(
                f"{file}: name {name!r} cannot stand in a table: no =, +, - or @ first, no blanks "
                "around or in a row"
            )
        if name in paths:
            raise InvalidInputError(
                f"{paths[name]} and {file} are both named {name!r}, and rows "
                "go by names: give one of them another 'name'"
            )
        digest = hashlib.sha256(content_digest(str(file)).encode())
        for other in named_files(data, file.parent):
            digest.update(content_digest(str(other)).encode())
        for _, content in problem.robot.files:
            digest.update(content.encode())
        # most have their name already, and a change checks the whole problem again
        problems[name] = problem if name == problem.name else problem.changed(name=name)
        digests[name], paths[name] = digest.hexdigest(), file
    if not problems:
        raise InvalidInputError(
            f"{folder} holds no problem files (*.json); write one with: cvqmpt problems new "
            f"{folder / 'mine.json'}"
        )
    if path.name in SUITES or not path.name:
        raise InvalidInputError(
            f"folder {path}: its rows would be called {path.name!r}, as a suite of ours; give it "
            "another name"
        )
    _FOLDERS[str(path)] = suite = Suite(
        path.name, tuple(problems), problems.__getitem__, digests=digests
    )
    return suite


def _contents(folder: Path) -> dict[Path, dict[str, Any]]:
    """Json of the files that may be problems."""
    try:
        paths = [
            path for path in folder.iterdir() if path.suffix == ".json" and path.name[0] != "."
        ]
    except OSError as error:
        raise InvalidInputError(
            f"cannot read folder {folder}: {error.strerror}; name a folder of problem files, or "
            "one file by --problem-file"
        ) from error
    paths = sorted(paths, key=lambda path: natural_key(path.name))
    # `cvqmpt problems new` writes a schema beside the problem, for editors
    problems = [path for path in paths if not path.name.endswith(".schema.json")]
    return {path: read_json_object(path) for path in problems}


def suite_named(name: str) -> Suite:
    """The suite of a name or of a folder's full path; UnknownChoiceError lists the names."""
    if os.sep in name:
        return _FOLDERS.get(name) or folder_suite(Path(name))
    if name == "sensor-robustness":
        raise InvalidInputError(
            "suite sensor-robustness was removed, its last table is in docs/training_log.md; "
            "suite sensor plans from noisy cameras"
        )
    return SUITES[require_choice("suite", name, SUITES)]
