"""Planning problems: a robot in a scene under a constraint, from a start to any of several goals.

`PlanningProblem` checks its own shape; `check_problem` checks it against the world (collision,
manifold) and names the culprit. Problems are saved as json, schema ``cvqmpt-problem/1``:

    {"schema": "cvqmpt-problem/1", "name": "...",
     "robot": {"name": "panda", "finger_opening": 0.04}
           or {"urdf": "arm.urdf", "end_effector": "tool", "srdf": null, "locked": {"joint": 0.0}},
              either with "articulated": {...}  (see ArticulatedObject.to_dict),
     "scene": {...}  (see Scene.to_dict),
     "attachments": [{"name", "shape", "T_hand_object"}],
     "constraint": [{"T0_w": 4x4, "Tw_e": 4x4, "Bw": 6x2, null = free}],
                    (with "base": a frame of the robot, T0_w is the pose of w in that frame, see TaskSpaceRegionChain)
     "start": [n numbers],
     "goals": [[n numbers], ...]  and / or  "goal_region": {"T0_w", "Tw_e", "Bw"}}
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TOLERANCE, RegionConstraint, TaskSpaceRegion
from cvqmpt_lab.constraints.task_space_region_chain import TaskSpaceRegionChain, region_from_dict
from cvqmpt_lab.errors import CvqmptError, InvalidInputError, InvalidProblemError
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.attachment import Attachment
from cvqmpt_lab.scene.exact_checker import CollisionChecker
from cvqmpt_lab.scene.scene import Scene

SCHEMA = "cvqmpt-problem/1"


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """One constrained motion planning problem.

    Attributes
    ----------
    constraint: regions that the end effector must stay in (their intersection; none = unconstrained).
    start: (n,). goals: (k, n), k >= 0 [rad or m].
    goal_region: end-effector poses that count as a goal, or None; sampled when goals is empty.
    """

    name: str
    robot: Robot
    scene: Scene
    start: np.ndarray
    goals: np.ndarray
    constraint: tuple[TaskSpaceRegion, ...] = ()
    attachments: tuple[Attachment, ...] = ()
    goal_region: TaskSpaceRegion | None = None

    def __post_init__(self) -> None:
        n = self.robot.dof
        start = np.array(self.start, dtype=float)
        goals = np.array(self.goals, dtype=float) if np.size(self.goals) else np.empty((0, n))
        if goals.ndim != 2 or goals.shape[1] != n:
            raise InvalidProblemError(
                f"{self.name}: goals have shape {goals.shape}, robot {self.robot.name} needs (k, {n})"
            )
        if start.shape != (n,):
            raise InvalidProblemError(
                f"{self.name}: start has shape {start.shape}, robot {self.robot.name} needs ({n},)"
            )
        if len(goals) == 0 and self.goal_region is None:
            raise InvalidProblemError(f"{self.name}: give 'goals' (configurations) or a 'goal_region'")
        if isinstance(self.goal_region, TaskSpaceRegionChain):
            raise InvalidProblemError(
                f"{self.name}: 'goal_region' hangs on {self.goal_region.base!r}, which moves; give one in the world: "
                f"TaskSpaceRegionChain.at(pose of {self.goal_region.base!r})"
            )
        for region in self.constraint:
            region.reference_link(self.robot)  # raises UnknownChoiceError for a frame that does not exist
        for label, q in self._labelled(start, goals):
            if not np.isfinite(q).all():
                raise InvalidProblemError(
                    f"{self.name}: {label} has a NaN or infinite entry at joint {int(np.argmin(np.isfinite(q)))}"
                )
            outside = self.robot.joint_outside_limits(q)
            if outside is not None:
                raise InvalidProblemError(
                    f"{self.name}: {label} is outside the limits: {outside[0]} by {outside[1]:.4f}; move it inside"
                )
        for array in (start, goals):
            array.setflags(write=False)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "goals", goals)

    @staticmethod
    def _labelled(start: np.ndarray, goals: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
        yield "start", start
        for k, goal in enumerate(goals):
            yield f"goal {k}", goal

    def labelled_configurations(self) -> Iterator[tuple[str, np.ndarray]]:
        """("start", q), ("goal 0", q), ..."""
        return self._labelled(self.start, self.goals)

    @cached_property
    def manifold(self) -> RegionConstraint:
        """The constraint as a function F(q)."""
        return RegionConstraint(self.robot, self.constraint)

    def with_goals(self, goals: np.ndarray) -> "PlanningProblem":
        """The same problem with goal configurations (k, n)."""
        return replace(self, goals=goals)

    def collision_checker(self, margin: float = 0.0) -> CollisionChecker:
        """The exact checker of this problem's world; closer than margin [m] counts as touching."""
        return _collision_checker(self.robot, self.scene, self.attachments, margin)

    def to_dict(self) -> dict:
        """Plain json form."""
        return {
            "schema": SCHEMA,
            "name": self.name,
            "robot": self.robot.source,
            "scene": self.scene.to_dict(),
            "attachments": [item.to_dict() for item in self.attachments],
            "constraint": [region.to_dict() for region in self.constraint],
            "start": self.start.tolist(),
            "goals": self.goals.tolist(),
            "goal_region": self.goal_region.to_dict() if self.goal_region else None,
        }

    @staticmethod
    def from_dict(data: dict) -> "PlanningProblem":
        """Inverse of to_dict.

        Raises
        ------
        InvalidInputError: names the missing or malformed field.
        """
        if not isinstance(data, dict):
            raise InvalidInputError(f"a problem must be a json object, not {type(data).__name__}")
        if data.get("schema") != SCHEMA:
            raise InvalidInputError(
                f"problem field 'schema' is {data.get('schema')!r}; this version reads {SCHEMA!r}"
            )
        for field in ("name", "robot", "scene", "start"):
            if field not in data:
                raise InvalidInputError(f"problem field {field!r} is missing")
        if not isinstance(data["name"], str | int):
            raise InvalidInputError(f"problem field 'name' must be a string, not {data['name']!r}")
        region = data.get("goal_region")
        return PlanningProblem(
            name=str(data["name"]),
            robot=robot_from_source(_mapping(data["robot"], "robot")),
            scene=Scene.from_dict(_mapping(data["scene"], "scene")),
            start=_numbers(data["start"], "start"),
            goals=_numbers(data.get("goals", []), "goals"),
            constraint=tuple(region_from_dict(_mapping(r, "constraint")) for r in _list(data, "constraint")),
            attachments=tuple(
                Attachment.from_dict(_mapping(a, "attachments")) for a in _list(data, "attachments")
            ),
            goal_region=region_from_dict(_mapping(region, "goal_region")) if region is not None else None,
        )

    def save(self, path: Path | str) -> None:
        """Write the json form; a half-written file never takes the name."""
        path = Path(path)
        temporary = path.with_name(path.name + ".tmp")
        try:
            temporary.write_text(json.dumps(self.to_dict(), indent=1) + "\n")
            temporary.replace(path)
        except OSError as error:
            raise InvalidInputError(f"cannot write {path}: {error.strerror}; choose another place") from error

    @staticmethod
    def load(path: Path | str, robot: dict | None = None) -> "PlanningProblem":
        """Read a problem file; errors name the file and the field.

        robot: what the file's field 'robot' is replaced by, before start and goals are checked against it.
        """
        try:
            data = json.loads(Path(path).read_text())
        except OSError as error:
            raise InvalidInputError(f"cannot read problem file {path}: {error.strerror}") from error
        except ValueError as error:
            raise InvalidInputError(f"{path} is not json: {error}") from error
        except RecursionError as error:
            raise InvalidInputError(f"{path} is no problem file: its json is nested too deeply") from error
        if robot is not None and isinstance(data, dict):
            data["robot"] = robot
        try:
            return PlanningProblem.from_dict(data)
        except InvalidInputError as error:
            raise type(error)(f"{path}: {error}") from error
        except CvqmptError as error:
            raise InvalidInputError(f"{path}: {error}") from error


@lru_cache(maxsize=4)
def _collision_checker(
    robot: Robot, scene: Scene, attachments: tuple[Attachment, ...], margin: float
) -> CollisionChecker:
    """Building one takes 10 ms, and a problem is checked several times."""
    return CollisionChecker(robot, scene, attachments, margin)


def _mapping(value: object, field: str) -> dict:
    if not isinstance(value, dict):
        raise InvalidInputError(f"problem field {field!r} must be a json object, not {type(value).__name__}")
    return value


def _list(data: dict, field: str) -> list:
    value = data.get(field, [])
    if not isinstance(value, list):
        raise InvalidInputError(f"problem field {field!r} must be a list, not {type(value).__name__}")
    return value


def _numbers(value: object, field: str) -> np.ndarray:
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"problem field {field!r} must hold numbers: {error}") from error


def check_problem(problem: PlanningProblem, checker: CollisionChecker | None = None) -> None:
    """Raise InvalidProblemError when the start or a goal collides or is off the manifold.

    The message names the configuration and the colliding pair, or by how much the constraint is violated.
    """
    checker = checker or problem.collision_checker()
    for label, q in problem.labelled_configurations():
        if checker.in_collision(q):
            pair = checker.colliding_pair(q)
            raise InvalidProblemError(
                f"{problem.name}: {label} is in collision: {pair}; choose another configuration"
            )
        residual = problem.manifold.residual(q)
        if np.linalg.norm(residual) > TOLERANCE:
            raise InvalidProblemError(
                f"{problem.name}: {label} is off the constraint manifold by {np.abs(residual).max():.4f} (rad or m); "
                f"project it first"
            )
