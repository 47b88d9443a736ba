"""Execute a motion or a task in simulation, and judge the result.

Contacts in a simulation depend on the settings of its solver. An outcome therefore counts only if
it is the same at two contact times, see `agreed`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import finite
from cvqmpt_lab.base.polyline import nearest_places
from cvqmpt_lab.certificate.certificate import CERTIFICATE_TOLERANCE
from cvqmpt_lab.collision.solids import solids
from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.constraints.task_space_region import UNITS, displacements, excess
from cvqmpt_lab.features.motion.trajectory import Trajectory
from cvqmpt_lab.features.physics.mjcf import LOAD_BODY, Physics
from cvqmpt_lab.features.physics.simulation import (
    GRIP_FORCE_N,
    OPEN_FORCE_N,
    Contact,
    Controller,
    Rest,
    Sample,
    Simulation,
)
from cvqmpt_lab.features.tasks.solve import TaskSolution
from cvqmpt_lab.features.tasks.task import Grasp, HandPhase, Hold, Phase, Release
from cvqmpt_lab.features.tasks.world import World
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.coal_shapes import coal_shape, loads_of, shape_distance
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Shape

CONTACT_TIMES_S = 0.004, 0.001  # an outcome must be the same at both
SETTLING_TIME_S = 0.3  # standing still before and after a motion


class Outcome(StrEnum):
    """Outcome of executing a motion or task.

    EXECUTED: at every contact time no fault was found, see `Execution.faults`. NOT_EXECUTED: at
    every contact time the same pairs touched, and a fault was found. UNDECIDED: the contact times
    disagree about contacts, faults or where the load ended. See `agreed`.
    """

    EXECUTED = "executed as planned"
    NOT_EXECUTED = "not executed as planned"
    UNDECIDED = "undecided"


class FunctionUse(NamedTuple):
    """Largest violation of a function of the constraint, such as a coupling of joints.

    Entries whose bounds have width 0 cannot be kept exactly by a controller: they are no fault.
    """

    name: str  # the function in words, with its bounds
    outside: float  # of bounds of positive width [unit of the function]; nan: there are none
    off: float  # of bounds of width 0 [unit of the function]; nan: there are none

    @classmethod
    def of(cls, function: Constraint, states: np.ndarray) -> "FunctionUse":
        """Return the violation at states (m, n)."""
        F, rows = np.abs(function.own_residual(states)).max(axis=0), function.rows
        F[np.isnan(F)] = np.inf  # where a user's function has no value
        wide = rows.lower < rows.upper
        outside, off = (float(F[k].max()) if k.any() else np.nan for k in (wide, ~wide))
        return cls(function.describe(), outside, off)


@dataclass(frozen=True)
class Execution:
    """Result of executing a motion or task once."""

    name: str  # of the problem or task
    controller: str  # a name of `simulation.CONTROLLERS`
    contact_time: float  # [s]
    seconds: float  # simulated time [s]
    off_path_m: float  # largest distance of the hand from its planned path
    off_rad: float  # largest tracking error |q_d - q| of a joint [rad or m]
    outside_rad: float  # largest violation of a bound of rotation or tilt of positive width
    outside_m: float  # largest violation of a bound of position of positive width
    # largest distance from values that bounds of width 0 fix, which no controller keeps exactly;
    # nan: none is fixed
    fixed_off_rad: float
    fixed_off_m: float
    tilt_rad: float  # largest absolute value of a bounded rotation; nan: none is bounded
    contacts: tuple[Contact, ...]  # unwanted ones: grasping and placing are not among them
    saturated_s: float  # time during which some joint was at its effort limit
    scene: Scene  # at the beginning, with the load
    samples: tuple[Sample, ...]  # every 10 ms
    drift_m: float | None = None  # of the load in the hand; None: it is welded, or there is none
    placed: bool | None = None  # whether the load ends at its place; None: it is not put down
    placed_off_m: float | None = None  # distance of the load from its place
    arrival_rad: float = 0.0  # largest distance of a joint from the end of the motion [rad or m]
    functions: tuple[FunctionUse, ...] = ()  # of the constraint, in its order

    @property
    def faults(self) -> list[str]:
        """Reasons why it was not executed as planned; none: it was."""
        lost_m = 0.05  # a load that has moved so far in the hand counts as lost
        found = [
            f"{contact.first} touches {contact.second}, {1e3 * contact.depth_m:.2g} mm deep, at "
            f"{contact.time_s:.2f} s"
            for contact in self.contacts
        ]
        if max(self.outside_rad, self.outside_m) > CERTIFICATE_TOLERANCE:
            found.append(
                f"the constraint is broken by {self.outside_rad:.2g} rad, {self.outside_m:.2g} m"
            )
        found += [
            f"{one.name} is broken by {one.outside:.2g}"
            for one in self.functions
            if one.outside > CERTIFICATE_TOLERANCE
        ]
        # without a fault the hand stays within 3 mm, the position servo is 0.1 s behind (0.3 rad),
        # and arms arrive within some mrad
        if self.off_path_m > 0.02:
            found.append(f"the hand is {1e3 * self.off_path_m:.0f} mm off its path")
        if self.off_rad > 0.5:
            found.append(f"the arm does not follow: a joint is {self.off_rad:.2g} rad behind")
        if self.arrival_rad > 0.05:
            found.append(f"the arm does not arrive: a joint ends {self.arrival_rad:.2g} rad away")
        if self.drift_m is not None and self.drift_m > lost_m:
            found.append("the load left the hand")
        if self.placed is False:
            found.append(f"the load ends {1e3 * (self.placed_off_m or 0.0):.0f} mm from its place")
        return found

    @property
    def pairs(self) -> set[tuple[str, str]]:
        """Contact pairs: names of the bodies that touched."""
        return {(contact.first, contact.second) for contact in self.contacts}

    @property
    def data(self) -> dict[str, Any]:
        """The result as plain data for json, without scene and samples."""
        listed = {
            "contacts": [contact._asdict() for contact in self.contacts],
            "functions": [function._asdict() for function in self.functions],
        }
        left_out = "scene", "samples", *listed
        plain = {name: value for name, value in vars(self).items() if name not in left_out}
        return finite(plain | listed)

    @property
    def moments(self) -> Iterator[tuple[float, str, World]]:
        """Time [s], name of the phase and world every 0.1 s, for films."""
        for sample in self.samples[::10]:
            scene = self.scene
            for name, value in sample.doors.items():
                joint = scene.articulation(name)
                scene = scene.with_joint(name, float(np.clip(value, joint.lower, joint.upper)))
            if sample.T_world_load is not None:
                load = self.scene.objects[-1]
                scene = scene.without(load.name)
                scene = scene.with_objects(replace(load, T_world_object=sample.T_world_load))
            arm = robot_from_source(sample.source)
            q = np.clip(sample.q, arm.lower, arm.upper)
            yield sample.time, sample.phase, World(sample.source, scene, q)


def agreed(executions: Iterable[Execution]) -> tuple[Outcome, str]:
    """Outcome of the same motion or task executed at several contact times, and the reason."""
    first, *others = executions
    for other in others:
        if first.pairs != other.pairs or first.placed != other.placed:
            a, b = (1e3 * one.contact_time for one in (first, other))
            different = sorted(first.pairs ^ other.pairs)
            what = f"{' and '.join(different[0])} touch" if different else "the load is placed"
            return Outcome.UNDECIDED, f"{what} at one of the contact times {a:g} and {b:g} ms"
        if bool(first.faults) != bool(other.faults):
            return Outcome.UNDECIDED, "bounds are kept at one of the contact times"
    faults = first.faults
    return (Outcome.NOT_EXECUTED if faults else Outcome.EXECUTED), "; ".join(faults)


def require_simulated(problem: PlanningProblem) -> None:
    """Refuse a problem in which the arm holds a door, or two hands hold one load."""
    if "articulated" in problem.robot.source:
        raise InvalidInputError("a motion that holds a door is executed as part of a task")
    for item in problem.attachments:
        if item.also_held_by:
            raise InvalidInputError(
                f"{item.name} is held by {len(item.held_by)} hands: the simulation holds a load in "
                "one; cvqmpt certify judges such a motion, with its limits and contacts"
            )


def execute_motion(
    problem: PlanningProblem,
    motion: Trajectory,
    controller: str,
    contact_time: float = CONTACT_TIMES_S[0],
    friction: bool = False,
) -> Execution:
    """Execute a certified motion.

    Args:
        problem: the problem that the motion solves.
        motion: trajectory of the problem's robot.
        controller: a name of `simulation.CONTROLLERS`.
        contact_time: time constant of contacts in the simulation [s].
        friction: whether the fingers hold the load by friction; else it is welded to the hand.
    """
    require_simulated(problem)
    if motion.joint_names != problem.robot.joint_names:
        raise InvalidInputError(
            f"the motion is of joints {', '.join(motion.joint_names)}, the problem's robot has "
            f"{', '.join(problem.robot.joint_names)}: give a motion of this robot"
        )
    if motion.times[0] != 0.0:  # of a part of a motion
        motion = replace(motion, times=motion.times - motion.times[0])
    loads = problem.attachments
    q = motion.positions[0]
    physics = Physics(contact_time, welded=loads)
    if friction:
        if len(loads) != 1:
            held = f"{len(loads)} things" if loads else "nothing"
            raise InvalidInputError(
                f"--hold friction: the problem has {held} in the hand and fingers hold one thing; "
                "use --hold weld"
            )
        (load,) = loads
        T = problem.robot.pose(q) @ load.T_hand_object
        item = SceneObject(load.name, load.shape, T, mass=_mass(load))
        physics = Physics(contact_time, free=item)
    control = Controller(controller, problem.robot)
    control.carry(loads_of(problem.attachments))
    world = Simulation(problem.robot, problem.scene, q, control, physics, friction)
    world.phase = problem.name
    if loads:
        first, last = (
            _rest(
                world,
                problem.scene,
                [
                    (x.shape, problem.robot.pose(end, x.end_effector) @ x.T_hand_object)
                    for x in loads
                ],
            )
            for end in motion.positions[[0, -1]]
        )
        world.rests = first, last
    if friction:
        world.allow(_hand_pieces(problem.robot), None)
        world.force = GRIP_FORCE_N
    world.hold(q, SETTLING_TIME_S)
    before = _in_hand(world) if friction else np.eye(4)
    world.saturated, world.errors = 0, []
    world.follow(motion)
    world.hold(motion.positions[-1], SETTLING_TIME_S)
    moved = [sample for sample in world.samples if sample.time > SETTLING_TIME_S]
    found = _judged(problem.name, world, [(problem, motion, moved)])
    if friction:
        found = replace(found, drift_m=float(np.linalg.norm((_in_hand(world) - before)[:3, 3])))
    return found


def execute_task(
    solution: TaskSolution, controller: str, contact_time: float = CONTACT_TIMES_S[0]
) -> Execution:
    """Execute a solved task: fingers hold objects by friction, doors move by contact.

    Args:
        solution: the solved task.
        controller: a name of `simulation.CONTROLLERS`.
        contact_time: time constant of contacts in the simulation [s].
    """
    if not solution.solved:
        raise InvalidInputError(f"task {solution.task.name} is not solved: {solution.failure}")
    task, start = solution.task, World.before(solution.task)
    grasps = [phase.object for phase in task.phases if isinstance(phase, Grasp)]
    if len(grasps) > 1:
        raise InvalidInputError(
            f"task {task.name} grasps {', '.join(grasps)}: only tasks that grasp one object are "
            "simulated"
        )
    load = task.scene[grasps[0]] if grasps else None
    if load is not None:
        load = replace(load, mass=_mass(load))
    doors = tuple(phase.articulation for phase in task.phases if isinstance(phase, Hold))
    scene = task.scene.without(*grasps)
    physics = Physics(contact_time, doors=tuple(dict.fromkeys(doors)), free=load)
    control = Controller(controller, start.arm)
    world = Simulation(start.arm, scene, task.start, control, physics, gripper=True)
    if load is not None:
        ends = (start.scene, solution.world.scene)
        first, last = (
            _rest(world, one.without(load.name), [(load.shape, one[load.name].T_world_object)])
            for one in ends
        )
        world.rests = first, last
    world.hold(task.start, SETTLING_TIME_S)
    q, parts = task.start, []
    before, drift = None, None  # pose of the load in the hand when grasped [m]; its drift [m]
    for phase, outcome in solution.steps:
        world.phase = phase.name
        if outcome is None:
            if isinstance(phase, Release) and before is not None:
                drift = float(np.linalg.norm((_in_hand(world) - before)[:3, 3]))
            _move_fingers(world, phase, q, scene, start.arm, load)
            before = _in_hand(world) if isinstance(phase, Grasp) else before
            continue
        motion, began = outcome.arm_trajectory, len(world.samples)
        assert motion is not None
        world.follow(motion)
        q = motion.positions[-1]
        world.hold(q, 0.1)
        parts.append((outcome.solution.problem, motion, world.samples[began:]))
    world.hold(q, SETTLING_TIME_S)
    found = _judged(task.name, world, parts)
    if load is None or not isinstance(task.phases[-1], Release):
        return replace(found, drift_m=drift)
    there, T = solution.world.scene[load.name].T_world_object, world.T_world_load
    assert T is not None
    off = float(np.linalg.norm((T - there)[:2, 3]))
    lean = float(np.arccos(np.clip(T[:3, 2] @ there[:3, 2], -1.0, 1.0)))
    placed = off < 0.03 and lean < 0.1  # [m], [rad]
    return replace(found, drift_m=drift, placed=placed, placed_off_m=off)


def _mass(load: Attachment | SceneObject) -> float:
    """Mass of a load [kg]; InvalidInputError if it has none."""
    if load.mass is None:
        raise InvalidInputError(f"{load.name!r} has no mass: state it in kg, 'mass' in its file")
    return load.mass


def _move_fingers(
    world: Simulation,
    phase: Phase,
    q: np.ndarray,
    scene: Scene,
    arm: Robot,
    load: SceneObject | None,
) -> None:
    """Close or open the fingers in 0.4 s; from then on the held object may touch the hand."""
    closes = isinstance(phase, Hold | Grasp)
    if isinstance(phase, HandPhase):
        world.source = {**world.source, **phase.gripper}
    world.force = GRIP_FORCE_N if closes else OPEN_FORCE_N
    if isinstance(phase, Hold):
        held = scene.articulation(phase.articulation).moves
        world.allow(_hand_pieces(arm), held)
    elif isinstance(phase, Grasp) and load is not None:
        world.allow(_hand_pieces(arm), None)
        item = Attachment(LOAD_BODY, load.shape, _in_hand(world), load.mass)
        world.controller.carry(loads_of([item]))
    else:
        world.controller.carry(())
    world.hold(q, 0.4)


def _hand_pieces(arm: Robot) -> list[str]:
    """Names of the pieces of the hand's link, fingers included."""
    row = arm.hand()[0]
    return [piece.name for piece in arm.links if piece.link == row]


def _rest(world: Simulation, scene: Scene, loads: Sequence[tuple[Shape, np.ndarray]]) -> Rest:
    """Find what loads stand on: obstacles that they would enter if they were 5 mm lower.

    Args:
        world: the simulation, which numbers the obstacles.
        scene: the obstacles.
        loads: shapes and their poses (4, 4) [m].
    """
    down, supports = np.zeros((4, 4)), set()
    down[2, 3] = 0.005
    for shape, T in loads:
        solid = coal_shape(shape)
        for item in scene.obstacles:
            parts = solids(item.name, item.shape, item.T_world_object)
            for geom, (_, *other) in zip(world.obstacles[item.name], parts, strict=True):
                lowered = shape_distance(solid, T - down, *other)
                # beside a wall, the distance stays the same
                if lowered < min(0.0, shape_distance(solid, T, *other) - 0.0025):
                    supports.add(geom)
    return Rest(loads[0][1][:3, 3], frozenset(supports))


def _in_hand(world: Simulation) -> np.ndarray:
    """Pose (4, 4) of the load in the hand."""
    T = world.T_world_load
    assert T is not None
    return np.linalg.inv(world.T_world_hand) @ T


def _judged(
    name: str,
    world: Simulation,
    parts: list[tuple[PlanningProblem, Trajectory, list[Sample]]],
) -> Execution:
    """Compare the samples of each motion with its plan, and return the result.

    parts: problem, planned motion and samples of each motion.
    """
    off, tilt = 0.0, np.nan
    outside, fixed_off = np.zeros(2), np.full(2, np.nan)  # [rad], [m]
    functions = dict[str, FunctionUse]()
    for problem, motion, samples in parts:
        executed = np.array([sample.q for sample in samples])
        planned = motion.sampled(0.01).positions
        if executed.shape[1] < problem.robot.dof:
            (door,) = (name for name in samples[0].doors if name in problem.robot.joint_names)
            executed = np.column_stack([executed, [sample.doors[door] for sample in samples]])
            planned = np.column_stack([planned, np.zeros(len(planned))])
        hands, planned_hands = (problem.robot.poses(q)[:, :3, 3] for q in (executed, planned))
        off = max(off, float(nearest_places(planned_hands, hands)[1].max()))
        for region in problem.regions:
            x = displacements(problem.robot, region, executed)
            beyond = excess(region, x).max(axis=0)
            for k, unit in enumerate(("rad", "m")):
                wide = (unit == UNITS) & region.wide
                fixed = (unit == UNITS) & ~region.wide
                outside[k] = beyond[wide].max(initial=outside[k])
                if fixed.any():
                    fixed_off[k] = beyond[fixed].max(initial=np.nan_to_num(fixed_off[k]))
            rows = [k for k in region.bounded_rows if region.wide[k] and 3 <= k <= 6]
            if rows:
                tilt = float(np.nanmax([tilt, np.abs(x[:, rows]).max()]))
        for function in problem.manifold.functions:
            use = FunctionUse.of(function, executed)
            before = functions.get(use.name, use)
            functions[use.name] = FunctionUse(use.name, *np.fmax(before[1:], use[1:]).tolist())
    scene, first = world.scene, world.samples[0]
    load = world.physics.free or next(iter(world.physics.welded), None)
    if load is not None and first.T_world_load is not None:
        item = SceneObject(load.name, load.shape, first.T_world_load, obstacle=False)
        scene = scene.with_objects(item)
    return Execution(
        name=name,
        controller=world.controller.name,
        contact_time=world.physics.contact_time,
        seconds=float(world.data.time),
        off_path_m=off,
        off_rad=max(world.errors),
        arrival_rad=world.errors[-1],
        outside_rad=float(outside[0]),
        outside_m=float(outside[1]),
        fixed_off_rad=float(fixed_off[0]),
        fixed_off_m=float(fixed_off[1]),
        tilt_rad=tilt,
        contacts=tuple(world.touched.values()),
        saturated_s=1e-3 * world.saturated,
        scene=scene,
        samples=tuple(world.samples),
        functions=tuple(functions.values()),
    )
