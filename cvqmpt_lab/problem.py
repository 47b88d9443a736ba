"""Planning problems: a robot in a scene under a constraint, from a start to any of several goals.

A problem is data. Its checks by inverse kinematics, and of collision, are in `planning.usable`.

Problems are saved as json, schema ``cvqmpt-problem/1`` (for editors:
`base.json_schema`)::

    {"schema": "cvqmpt-problem/1", "name": "...",
     "robot": {"name": "panda", "finger_opening": 0.04}
           or {"urdf": "arm.urdf", "end_effector": "tool", "srdf": null, "locked": {"joint": 0.0}},
              either with "articulated": {...}  (see `ArticulatedObject`), or with several
              "end_effectors": ["left", "right"], whose joints then move together,
     "scene": {"name", "objects": [{"name", "shape", "T_world_object"}, ...]}  or  "scene.json",
     "attachments": [{"name", "shape", "T_hand_object", "end_effector", "also_held_by"}],
     "constraint": {"upright": 0.1}, or a list of such and of full regions
                   {"T0_w": pose, "Tw_e": pose, "Bw": 6 rows [lower, upper], null = free,
                    "tilt": 0.1 (not needed)},
                   with "base" a frame of the robot, T0_w is the pose of w in that frame; with
                   "end_effector", the region is about that one; {"function": "my_module:F",
                   ...fields} is a function of the user's own, see `constraints.function_files`,
     "start": configuration  or  "start_region": region,
     "goals": [configuration, ...]  and / or  "goal_region": region,
     "clearance": 0.01}

A configuration is n numbers, {"joint": value} or the name of a group_state in the robot's SRDF. A
pose is {"xyz", "rpy"}, {"xyz", "quaternion"} or a 4x4 matrix. Goals are drawn from the goal region
only if no goals are given.
"""

from __future__ import annotations  # so `help` shows forms by their names

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Protocol, Self

import numpy as np

from cvqmpt_lab.base.codec import Document, OneOrMore, digest_of, to_plain
from cvqmpt_lab.base.errors import InvalidProblemError, mapping, unique
from cvqmpt_lab.base.modules import provider
from cvqmpt_lab.base.poses import nearest_turn
from cvqmpt_lab.base.values import (
    FULL_TURN_RAD,
    Array,
    Condition,
    FloatArray,
    Name,
    frozen,
    other_units,
)
from cvqmpt_lab.constraints.named import Region, RegionForm
from cvqmpt_lab.constraints.region_constraint import (
    Member,
    RegionConstraint,
    constraint_text,
    functions_of,
    regions_of,
)
from cvqmpt_lab.constraints.report import refuse_free_bounds
from cvqmpt_lab.constraints.task_space_region import (
    TaskSpaceRegion,
    TaskSpaceRegionChain,
)
from cvqmpt_lab.robot.dynamics import Dynamics
from cvqmpt_lab.robot.load import SourceForm, State, numbers_of, robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.coal_shapes import loads_of
from cvqmpt_lab.scene.scene import (
    Attachment,
    NamedScene,
    log,
)
from cvqmpt_lab.scene.scene_files import with_files_read


class Checker(Protocol):
    """An exact collision checker: `collision.exact.CollisionChecker`."""

    def in_collision(self, q: np.ndarray) -> bool:
        """Return whether configuration q (n,) touches anything."""

    def in_collision_batch(self, states: np.ndarray) -> np.ndarray:
        """Return which of states (k, n) touch anything, (k,) bool."""

    def clearance(self, q: np.ndarray) -> float:
        """Return the least distance of all pairs at q (n,) [m]."""

    def contact(self, q: np.ndarray) -> str:
        """Return what touches at q (n,), in words."""


class RobotForm(SourceForm):
    """A robot in json: the source that loads it."""

    def read(self, value: Any, where: str) -> Robot:
        """Load the robot."""
        if isinstance(value, Robot):
            return value
        return robot_from_source(mapping(value, where, "'name', or 'urdf' and 'end_effector'"))

    def write(self, value: Robot) -> Any:
        """Its source."""
        return value.source


class GoalsForm(Array):
    """Configurations, perhaps none."""

    def read(self, value: Any, where: str) -> FloatArray:
        """An array (k, n); (0, 0) of an empty list."""
        return super().read(
            value if not isinstance(value, list) or value else np.empty((0, 0)), where
        )

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """The JSON schema of a list of configurations."""
        return schema_of(tuple[State, ...])


RobotOfSource = Annotated[Robot, RobotForm()]
States = Annotated[FloatArray, GoalsForm((None, None), "numbers [rad or m]")]


OneRegion = Annotated[TaskSpaceRegion, RegionForm(with_functions=True)]


class MemberForm:
    """A region, or a function of the user's own: {"function": "my_module:F", ...fields}."""

    def read(self, value: Any, where: str) -> Member:
        """Return the region or function."""
        if hasattr(value, "on"):
            return value
        if isinstance(value, Mapping) and "function" in value:
            member: Member = provider("function of an address")(value, where)
            return member
        return RegionForm(with_functions=True).read(value, where)

    def write(self, value: Any) -> Any:
        """Return the json of a region, or the address of a function."""
        if hasattr(value, "named"):
            return value.named
        if isinstance(value, TaskSpaceRegion) or not hasattr(value, "source"):
            return to_plain(value)
        # without an address, it cannot be read again: the error says what to write
        address, fields = value.source or (value.name, {})
        return {"function": address, **fields}

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema of a region, or of a function with any further fields."""
        address = {"description": "module:name, or the name of an entry point cvqmpt.constraints"}
        function = {
            "type": "object",
            "description": "A function of your own; its other fields are arguments of the function "
            "that makes it. Commands need --allow-code.",
            "properties": {"function": schema_of(str) | address},
            "required": ["function"],
        }
        return {"anyOf": [schema_of(OneRegion), function]}


OneMember = Annotated[Member, MemberForm()]
Members = Annotated[tuple[OneMember, ...], OneOrMore(OneMember)]
Clearance = Annotated[
    float,
    Condition(float, {"minimum": 0.0, "maximum": 0.2}, "a distance from 0 to 0.2 [m]"),
]


@dataclass(frozen=True, eq=False)
class PlanningProblem(Document):
    """One constrained motion planning problem."""

    SCHEMA: ClassVar[str] = "cvqmpt-problem/1"
    with_named_files = staticmethod(with_files_read)

    name: Name  # What it is called in results
    robot: RobotOfSource  # What moves; n is the number of its joints
    scene: NamedScene  # What it must not touch
    # (n,) [rad or m], drawn from `start_region` if empty
    start: State = field(default_factory=lambda: np.empty(0))
    # (k, n) [rad or m]; if there are none, each run draws them from `goal_region`, and this field
    # stays empty: `pipeline.with_drawn_goals` returns the problem with them
    goals: States = field(default_factory=lambda: np.empty((0, 0)))
    # Regions that the end effector must stay in, and functions of the user's own that stay 0
    constraint: Members = ()
    attachments: tuple[Attachment, ...] = ()  # What the hand carries
    goal_region: Region | None = None  # End-effector poses that count as a goal
    # End-effector poses from which the start is drawn, within the constraint
    start_region: Region | None = None
    # Distance that the robot and what it carries keep from obstacles [m]; planned and certified
    clearance: Clearance = 0.0

    def _check(self) -> None:
        self._check_regions()
        self._tell_functions_the_load()
        if (len(self.start) == 0) == (self.start_region is None):
            raise InvalidProblemError(
                f"{self.name}: give 'start' or 'start_region', one of the two"
            )
        if self.start_region is not None:
            object.__setattr__(self, "start", provider("drawn start")(self))
            object.__setattr__(self, "start_region", None)
        if len(self.goals) == 0:
            object.__setattr__(self, "goals", np.empty((0, self.robot.dof)))
        self._check_configurations()

    def __repr__(self) -> str:
        carried = ", ".join(item.name for item in self.attachments)
        region = " and a goal region" if self.goal_region is not None else ""
        return (
            f"PlanningProblem {self.name!r}: {len(self.goals)} goals{region}\n"
            f"robot       {self.robot.name}, {self.robot.dof} "
            f"joints{carried and ', carries ' + carried}\n"
            f"scene       {self.scene.name}, {len(self.scene.objects)} objects\n"
            f"constraint  {constraint_text(self.robot, self.constraint)}\n"
            f"start       {' '.join(f'{x:.3f}' for x in self.start)}"
        )

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Inverse of `to_dict`; starts, goals may be {"joint": value} or name an SRDF group_state.

        Refuses lengths that cannot be metres; warns when nothing of the scene is within reach.
        """
        problem = super().from_dict(_with_numbers(data))
        provider("checks of lengths")(problem)
        return problem

    def _check_regions(self, most: int = 32) -> None:
        unique((item.name for item in self.attachments), f"attachments of problem {self.name!r}")
        if len(self.goals) == 0 and self.goal_region is None:
            raise InvalidProblemError(
                f"{self.name}: give 'goals' (configurations) or a 'goal_region'"
            )
        for what, region in (
            ("start_region", self.start_region),
            ("goal_region", self.goal_region),
        ):
            if isinstance(region, TaskSpaceRegionChain):
                raise InvalidProblemError(
                    f"{self.name}: {what!r} hangs on {region.base!r}, which moves; give one in "
                    f"the world: TaskSpaceRegionChain.at(pose of {region.base!r})"
                )
        if len(self.constraint) > most:
            raise InvalidProblemError(
                f"{self.name}: a constraint of {len(self.constraint)} regions; at most "
                f"{most} can be kept at once: leave out those that others say already"
            )
        for k, member in enumerate(self.constraint):
            # refuses also frames that do not move, joints that do not exist, links without mass
            refuse_free_bounds(self.robot, member, f"{self.name}: constraint[{k}]")
        ends = [region for region in (self.start_region, self.goal_region) if region is not None]
        for name in (
            *(region.end_effector for region in ends),
            *(name for item in self.attachments for name in item.held_by),
        ):
            # refuses a frame that is no end effector
            self.robot.hand(name)
        for what, region in (
            ("start_region", self.start_region),
            ("goal_region", self.goal_region),
        ):
            if region is not None:
                refuse_free_bounds(self.robot, region, f"{self.name}: {what}")
        for item in self.attachments:
            hands = [name or self.robot.end_effector for name in item.held_by]
            unique(hands, f"end effectors that hold attachment {item.name!r}")

    def _check_configurations(self) -> None:
        n = self.robot.dof
        for what, array, shape in (
            ("start", self.start, f"({n},)"),
            ("goals", self.goals, f"(k, {n})"),
        ):
            if array.shape[-1] != n:
                raise InvalidProblemError(
                    f"{self.name}: {what} has shape {array.shape}, robot {self.robot.name} needs "
                    f"{shape}: one value each for {', '.join(self.robot.joint_names)}"
                )
        object.__setattr__(self, "start", self._within_limits("start", self.start))
        given, goals = self.goals, self._within_limits("goals", self.goals, self.start)
        object.__setattr__(self, "goals", goals)
        for label, q in self.labelled_configurations():
            outside = self.robot.joint_outside_limits(q)
            if outside is not None:
                cure = other_units(q) if outside[1] > FULL_TURN_RAD else "move it inside"
                if outside[0] in self.robot.soft_limited:
                    cure += ", or plan beyond the soft limits of the URDF: --hard-limits"
                raise InvalidProblemError(
                    f"{self.name}: {label} is outside the limits: {outside[0]} by "
                    f"{outside[1]:.4g}; {cure}"
                )
        if functions_of(self.constraint):
            object.__setattr__(self, "goals", provider("checks of functions")(self, given))

    def _tell_functions_the_load(self) -> None:
        """Tell constraints that depend on it what the robot carries."""
        if not any(hasattr(part, "carrying") for part in self.constraint):
            return
        for item in self.attachments:
            if item.mass is None:
                raise InvalidProblemError(
                    f"{self.name}: attachment {item.name!r} has no mass, which centre-of-mass "
                    "needs: give its 'mass' [kg]"
                )
        loads = tuple(loads_of(self.attachments))
        carrying = tuple(
            part.carrying(loads) if hasattr(part, "carrying") else part for part in self.constraint
        )
        object.__setattr__(self, "constraint", carrying)

    def _within_limits(
        self,
        what: str,
        states: FloatArray,
        near: FloatArray | None = None,
        rounding: float = 1e-6,
        largest: float = 100.0,
    ) -> FloatArray:
        """Return states with endless joints turned into the limits and tiny overshoots clipped.

        Args:
            what: noun for the states in the warning.
            states: (..., n) [rad or m].
            near: (n,), endless joints are turned to within half a turn of it [rad]; None: they are
                turned only if they are outside the limits.
            rounding: joints that are up to this outside a limit are moved to it [rad or m]; the
                certificate allows as much at the ends of a path.
            largest: larger values of endless joints are left as they are: degrees? [rad]
        """
        robot, moved = self.robot, states
        if robot.endless.any():
            outside = (states < robot.lower) | (states > robot.upper)
            wrapped = robot.endless & outside & (np.abs(states) <= largest)
            moved = np.where(wrapped, nearest_turn(states, 0.0), states)
            if wrapped.any():
                at = tuple(np.argwhere(wrapped)[0])
                log.warning(
                    f"{self.name}: {what}: joint {robot.joint_names[at[-1]]} turns without end; "
                    f"{states[at]:g} rad are taken as {moved[at]:.4g} rad ({other_units(states)})"
                )
            if near is not None:
                turned = nearest_turn(moved, near)
                fits = (turned >= robot.lower) & (turned <= robot.upper)
                moved = np.where(robot.endless & fits, turned, moved)
        inside = np.clip(moved, robot.lower, robot.upper)
        moved = np.where(np.abs(moved - inside) <= rounding, inside, moved)
        return states if np.array_equal(moved, states) else frozen(moved)

    def labelled_configurations(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield ("start", q), ("goal 0", q), ..."""
        yield "start", self.start
        for k, goal in enumerate(self.goals):
            yield f"goal {k}", goal

    @cached_property
    def manifold(self) -> RegionConstraint:
        """The constraint as a function F(q)."""
        return RegionConstraint(self.robot, self.constraint)

    @property
    def regions(self) -> tuple[TaskSpaceRegion, ...]:
        """The regions of the constraint."""
        return regions_of(self.constraint)

    @property
    def closed_chain(self) -> tuple[TaskSpaceRegion, ...]:
        """The regions that hold one end effector to another: the hands and the base form a ring."""
        hands = self.robot.end_effectors
        return tuple(
            part
            for part in self.regions
            if isinstance(part, TaskSpaceRegionChain) and part.base in hands
        )

    @cached_property
    def carried(self) -> tuple[Attachment, ...]:
        """The attachments; of the extra hands, only those that the constraint keeps in place."""
        return really_held(self.robot, self.attachments, self.regions)

    @cached_property
    def dynamics(self) -> Dynamics | None:
        """Dynamics of the robot and its load; None if no effort is limited."""
        return Dynamics.of(self.robot, loads_of(self.attachments))

    @property
    def notes(self) -> list[str]:
        """Lines on what is probably other than meant, e.g. how a file of the robot was read."""
        free = (
            f"constraint[{k}] binds nothing: every entry of its bounds is free"
            for k, member in enumerate(self.constraint)
            if isinstance(member, TaskSpaceRegion) and len(member.bounded_rows) == 0
        )
        return [*self.robot.notes, *self.scene.notes, *free, *self._loose_hands()]

    def _loose_hands(self) -> Iterator[str]:
        """Yield a line on each hand in `also_held_by` that the constraint does not keep there."""
        if not any(item.also_held_by for item in self.attachments):
            return
        from cvqmpt_lab.constraints.holding import MOST_PLAY_M, play_of_hand  # see `really_held`

        for item, really in zip(self.attachments, self.carried, strict=True):
            for name in item.also_held_by:
                if name in really.also_held_by:
                    continue
                play = play_of_hand(self.robot, self.regions, item.end_effector, name)
                how = (
                    f"bounds let its points move by up to {1e3 * play:.0f} mm against it; at most "
                    f"{1e3 * MOST_PLAY_M:.0f} mm is needed"
                    if np.isfinite(play)
                    else "no relative-pose bounds its position to the hand that carries it"
                )
                yield f"{name} does not hold attachment {item.name!r} and must not touch it: {how}"

    def random_stream(self, *keys: int) -> np.random.Generator:
        """Return a generator seeded by keys, such as a seed, and by the content of the problem.

        So two problems have different random numbers with the same seed. Name and given goals do
        not count: goals are often drawn by such a generator and then given.
        """
        return np.random.default_rng([*keys, *self._content_words])

    @cached_property
    def _content_words(self) -> np.ndarray:
        """SHA-256 digest (8,) of start, scene, constraint, loads and regions."""
        plain = [
            self.scene.digest.hex(),
            self.start.tolist(),
            [to_plain(region) for region in regions_of(self.constraint)],
            constraint_text(self.robot, functions_of(self.constraint)),
            [digest_of(item).hex() for item in self.attachments],
            [region and to_plain(region) for region in (self.goal_region, self.start_region)],
            self.clearance,
        ]
        return np.frombuffer(hashlib.sha256(json.dumps(plain).encode()).digest(), "<u4")

    def collision_checker(self, margin: float = 0.0) -> Checker:
        """Return the exact checker of this problem; distances below margin [m] are collisions."""
        checker: Checker = provider("world").of(self).checker(margin)
        return checker


def _with_numbers(data: Any) -> Any:
    """Replace configurations given by joint or by name of a group_state by numbers."""
    if not isinstance(data, Mapping):
        return data
    start, goals = data.get("start"), data.get("goals")
    several = goals if isinstance(goals, list) else []
    if not any(isinstance(q, str | Mapping) for q in (start, *several)):
        return data
    robot = RobotForm().read(data.get("robot"), "robot")
    read = {"start": numbers_of(robot, start, "start")} if start is not None else {}
    read |= (
        {"goals": [numbers_of(robot, q, f"goals[{k}]") for k, q in enumerate(several)]}
        if several
        else {}
    )
    return {**data, "robot": robot, **read}


def really_held(
    robot: Robot, attachments: tuple[Attachment, ...], regions: Sequence[TaskSpaceRegion]
) -> tuple[Attachment, ...]:
    """Attachments without the hands in `also_held_by` that no region keeps at them.

    A hand is kept if none of its points moves by more than 2 cm against the carrying hand, see
    `play_of_hand`.

    Args:
        robot: the robot.
        attachments: what it carries.
        regions: the constraint.
    """
    if not any(item.also_held_by for item in attachments):
        return attachments
    from cvqmpt_lab.constraints.holding import MOST_PLAY_M, play_of_hand  # few hands hold together

    def held(item: Attachment) -> Attachment:
        names = tuple(
            name
            for name in item.also_held_by
            if play_of_hand(robot, regions, item.end_effector, name) <= MOST_PLAY_M
        )
        return replace(item, also_held_by=names)

    return tuple(map(held, attachments))
