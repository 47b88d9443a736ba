"""Visible bodies of a scene, robot, solution or task, with a mesh, a colour and poses.

Pictures, films, web pages and recordings show them without knowing planners or constraints.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegionChain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.show.curves import Plot, plots_along, tilt_plots
from cvqmpt_lab.show.meshes import (
    Colour,
    Mesh,
    beads,
    cone,
    hull_mesh,
    joined,
    rod,
    shape_mesh,
    travelled_along,
)
from cvqmpt_lab.tasks.solve import TaskSolution
from cvqmpt_lab.tasks.task import PlannedPhase
from cvqmpt_lab.tasks.world import Load, World

ROBOT, GHOST, GOAL = (0.90, 0.90, 0.92), (0.25, 0.50, 0.90), (0.16, 0.68, 0.38)
LOAD, TRACE, CONSTRAINT = (0.86, 0.24, 0.20), (0.96, 0.55, 0.05), (0.60, 0.25, 0.72)
# x, y, z
AXES: tuple[Colour, ...] = ((0.85, 0.15, 0.15), (0.15, 0.60, 0.15), (0.15, 0.30, 0.85))
# of scene objects with a word that begins so; the first that fits counts
KIND_COLOURS: Mapping[str, Colour] = {
    "floor": (0.88, 0.87, 0.85),
    "wall": (0.93, 0.92, 0.89),
    "handle": (0.52, 0.54, 0.57),
    "countertop": (0.55, 0.45, 0.37),
    "plate": (0.16, 0.16, 0.18),
    "knob": (0.20, 0.20, 0.22),
    "range": (0.45, 0.47, 0.50),
    "panel": (0.96, 0.95, 0.92),
    "hood": (0.70, 0.72, 0.75),
    "pedestal": (0.36, 0.38, 0.42),
    "cracker": (0.80, 0.45, 0.25),
    "mustard": (0.93, 0.78, 0.22),
    "can": (0.86, 0.24, 0.20),
}
HIDDEN = ("walls/right",)  # objects between the usual viewpoint and the robot


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh in one colour, and its pose at every state."""

    group: str  # what it is, in legends
    layer: str  # what is drawn together: "scene", "goals/0", "path"
    name: str
    mesh: Mesh  # in its own frame
    colour: Colour
    # (m, 4, 4) in the world [m], or (1, 4, 4) of what stands still
    poses: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    opacity: float = 1.0
    behind: float = 0.0  # opacity where something solid is in front of it

    def at(self, state: int = 0) -> Mesh:
        """Its triangles in the world at a state of the path."""
        return self.mesh.placed(self.poses[state if len(self.poses) > 1 else 0], self.colour)


@dataclass(frozen=True, eq=False)
class Seen:
    """Everything that is shown of a problem, a solution or a task."""

    title: str
    scene: Sequence[Body]  # what stands still
    ground: float | None  # height of the highest floor [m]
    moving: Sequence[Body]  # the robot, and what it moves: m poses each
    over: Sequence[Body]  # start, goals, trace, constraint and axes, drawn over the rest
    labels: Sequence[str]  # one a state
    seconds: float = 6.0  # that the whole is played in
    times: np.ndarray | None = None  # (m,) of a task's states [s]
    plots: Sequence[Plot] = ()
    lines: Sequence[str] = ()  # of text

    def layers(self, *names: str) -> dict[str, list[Body]]:
        """The bodies of `over` by their layer, of layers whose first word is among the names."""
        found: dict[str, list[Body]] = {}
        for body in self.over:
            if body.layer.split("/")[0] in names:
                found.setdefault(body.layer, []).append(body)
        return found


def colour_of(name: str, other: Colour = (0.87, 0.77, 0.62)) -> Colour:
    """Colour of a scene object, by its name."""
    words = re.split("[^a-z]+", name.lower())
    fits = (kind for kind in KIND_COLOURS if any(word.startswith(kind) for word in words))
    return KIND_COLOURS.get(next(fits, ""), other)


def poses_along(robot: Robot, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T_world_link (m, n + 1, 4, 4), [:, 0] the world, and T_world_hand (m, 4, 4) at q (m, n)."""
    rotations, translations = link_poses(
        robot.kinematics, np.ascontiguousarray(states, dtype=float)
    )
    T_world_link = np.zeros((*translations.shape[:2], 4, 4))
    T_world_link[..., :3, :3], T_world_link[..., :3, 3] = rotations, translations
    T_world_link[..., 3, 3] = 1.0
    link, T_link_hand = robot.end_effector_link
    return T_world_link, T_world_link[:, link] @ T_link_hand


def scene_bodies(scene: Scene, hidden: Sequence[str] = HIDDEN) -> list[Body]:
    """The scene's objects but floors (boxes that are no obstacles) and those named in `hidden`."""
    return [
        Body(
            "scene",
            "scene",
            item.name,
            shape_mesh(item.shape),
            colour_of(item.name),
            item.T_world_object[None],
        )
        for item in scene
        if item.name not in hidden and (item.obstacle or not isinstance(item.shape, Box))
    ]


def ground_height(scene: Scene) -> float | None:
    """Top of the highest floor [m]; None without one."""
    tops = [
        item.T_world_object[2, 3] + 0.5 * item.shape.size[2]
        for item in scene
        if isinstance(item.shape, Box) and not item.obstacle
    ]
    return max(tops, default=None)


def floor_body(height: float, side: float = 5.0) -> Body:
    """A square of a floor whose top has a height [m]."""
    T = pose((0.0, 0.0, height - 0.01))[None]
    return Body(
        "floor", "scene", "floor", shape_mesh(Box((side, side, 0.02))), colour_of("floor"), T
    )


def robot_bodies(
    problem: PlanningProblem,
    states: np.ndarray,
    colour: Colour = ROBOT,
    group: str = "robot",
    layer: str = "robot",
    opacity: float = 1.0,
) -> list[Body]:
    """The robot's hulls and what it carries at states (m, n)."""
    T_world_link, T_world_hand = poses_along(problem.robot, states)
    found = []
    for part in problem.robot.links:
        poses = T_world_link[:, part.link] @ part.T_link_geometry
        mesh = hull_mesh(part.vertices)
        found.append(Body(group, layer, part.name, mesh, colour, poses, opacity))
    for item in problem.attachments:
        poses = T_world_hand @ item.T_hand_object
        name = item.name.replace("_", " ") if group in ("robot", "start") else group
        found.append(Body(name, layer, item.name, shape_mesh(item.shape), LOAD, poses, opacity))
    return found


def with_load(problem: PlanningProblem, carried: Sequence[Attachment]) -> PlanningProblem:
    """The problem with `carried` in the hand if it has no load itself."""
    return problem if problem.attachments else replace(problem, attachments=tuple(carried))


def seen_of_problem(
    problem: PlanningProblem,
    path: JointPath | None,
    most_states: int | None = None,
    ghosts: int = 4,
    goals: int = 1,
    hidden: Sequence[str] = HIDDEN,
) -> Seen:
    """What is shown of a problem, with or without a path.

    Args:
        problem: with the load in the hand.
        path: that is shown.
        most_states: of it; a longer one is sampled evenly. None: its own states.
        ghosts: number of poses shown between start and goal.
        goals: number of goals shown at most if there is no path.
        hidden: objects of the scene that are not shown.
    """
    states = problem.start[None] if path is None else path.states
    if path is not None and most_states is not None and len(states) > most_states:
        states = path.spaced(path.length / (most_states - 1))
    travelled = travelled_along(states)
    return Seen(
        problem.name,
        scene_bodies(problem.scene, hidden),
        ground_height(problem.scene),
        robot_bodies(problem, states),
        list(_over(problem, None if path is None else states, ghosts, goals)),
        [f"state {k} of {len(states) - 1}, {way:.2f} rad" for k, way in enumerate(travelled)],
    )


def _over(
    problem: PlanningProblem, path: np.ndarray | None, ghosts: int, goals: int
) -> Iterator[Body]:
    """Start, goals, ghosts, the hand's trace, constraint and axes; path: its states (m, n)."""
    states = problem.start[None] if path is None else path
    T_world_hand = poses_along(problem.robot, states)[1]
    yield from robot_bodies(problem, problem.start[None], ROBOT, "start", "start", 0.35)
    opacity = 0.5 if path is None else 0.55
    for k, goal in enumerate(problem.goals[:goals] if path is None else states[-1:]):
        yield from robot_bodies(problem, goal[None], GOAL, "goal", f"goals/{k}", opacity)
    if path is not None:
        travelled = travelled_along(path)
        for k in range(1, ghosts + 1):
            q = path[np.searchsorted(travelled, travelled[-1] * k / (ghosts + 1))]
            yield from robot_bodies(problem, q[None], GHOST, "on the way", f"way/{k}", 0.25)
        trace = beads(T_world_hand[:, :3, 3])
        yield Body("path of the hand", "path", "hand", trace, TRACE, behind=0.45)
    for k, mark in enumerate(constraint_marks(problem, states)):
        layer = f"constraint/{k}"
        yield Body("constraint", layer, "mark", mark, CONSTRAINT, opacity=0.3, behind=0.12)
    for at, T in zip(("start", "end"), T_world_hand[[0, -1]], strict=True):
        for colour, mesh in zip(AXES, _axes(problem.robot.reach, T), strict=True):
            yield Body("axes", "axes", at, mesh, colour, behind=0.5)
    T_hand_world = np.linalg.inv(T_world_hand[0])
    for name, colour, mesh in zip(
        "xyz", AXES, _axes(problem.robot.reach, T_world_hand[0]), strict=True
    ):
        mesh = mesh.placed(T_hand_world, colour)
        yield Body("axes of the hand", "hand", name, mesh, colour, T_world_hand)


def seen_of_solution(
    solution: Solution,
    carried: Sequence[Attachment] = (),
    most_states: int | None = None,
    plots: bool = False,
    goals: int = 1,
    hidden: Sequence[str] = HIDDEN,
) -> Seen:
    """What is shown of a solution; `carried`: load in the hand if the problem does not model it."""
    path = solution.simplified.path if solution.simplified else None
    problem = with_load(solution.problem, carried)
    seen = seen_of_problem(problem, path, most_states, goals=goals, hidden=hidden)
    verdict = "solved and certified" if solution.solved else "not solved"
    return titled(
        seen, solution.problem, verdict, repr(solution).splitlines(), path if plots else None
    )


def titled(
    seen: Seen,
    problem: PlanningProblem,
    verdict: str,
    lines: Sequence[str],
    path: JointPath | None,
) -> Seen:
    """The same with a title, lines of text, and plots along a path unless it is None."""
    plots: list[Plot] = []
    if path is not None:
        states = path.states
        if len(seen.labels) != len(states):
            states = path.spaced(path.length / (len(seen.labels) - 1))
        plots = [*tilt_plots(problem, states), *plots_along(problem, states)]
    title = f"{problem.name}: {problem.robot.name}, {verdict}"
    return replace(seen, title=title, lines=lines, plots=plots)


def constraint_marks(
    problem: PlanningProblem,
    states: np.ndarray,
    margin: float = 0.1,
    length: float = 0.13,
    sheet: float = 0.002,
    radius: float = 0.003,
    widest: float = 1.4,
) -> Iterator[Mesh]:
    """Planes, lines, arcs and cones of a problem's regions around a path.

    A plane or line shows where the origin of e in w may be. A cone, at both ends of the path,
    shows where an axis with free rotation about itself may point. An arc shows the path of a region
    that is attached to a door, over the door's range.

    Args:
        problem: with the regions.
        states: of the path (m, n), m >= 1.
        margin: by which planes and lines go on beyond the path [robot's reach].
        length: of cones [robot's reach].
        sheet: thickness of planes [m].
        radius: of lines [m].
        widest: half angle at which a cone is no longer drawn [rad].
    """
    reach = problem.robot.reach
    T_world_hand = poses_along(problem.robot, states)[1]
    for region in problem.constraint:
        if isinstance(region, TaskSpaceRegionChain):
            yield from _arc(problem.robot, region, states[0])
            continue
        T_world_w = T_world_hand @ np.linalg.inv(region.Tw_e)  # w, displaced
        rows = set(region.bounded_rows.tolist())
        fixed, free = ([k for k in range(3) if (k in rows) == bound] for bound in (True, False))
        if len(free) in (1, 2):
            R, t = region.T0_w[:3, :3], region.T0_w[:3, 3]
            at = T_world_w[:, :3, 3] @ R - R.T @ t
            low, high = at.min(axis=0) - margin * reach, at.max(axis=0) + margin * reach
            low[fixed], high[fixed] = region.Bw[fixed].clip(-reach, reach).T
            x, y, z = np.maximum(high - low, sheet if len(free) == 2 else 2.0 * radius).tolist()
            T = region.T0_w.copy()
            T[:3, 3] += R @ (0.5 * (low + high))
            yield shape_mesh(Box((x, y, z))).placed(T, CONSTRAINT)
        turning = [k for k in range(3) if k + 3 not in rows]
        tilt = float(np.abs(region.Bw[[k for k in rows if k > 2]]).max(initial=0.0))
        if len(turning) == 1 and tilt < widest:
            for T in T_world_w[[0, -1]]:
                yield cone(T[:3, 3], length * reach * region.T0_w[:3, turning[0]], tilt)
                yield rod(T[:3, 3], T[:3, 3] + length * reach * T[:3, turning[0]], radius)


def _arc(
    robot: Robot, region: TaskSpaceRegionChain, q: np.ndarray, count: int = 40
) -> Iterator[Mesh]:
    """Path of the region's frame while the joints that move it, not the hand, sweep their range."""
    row, _ = region.reference_link(robot)
    moved = np.flatnonzero(robot.kinematics.moves[:, row])
    if len(moved):
        states = np.repeat(q[None], count, axis=0)
        states[:, moved] = np.linspace(robot.lower[moved], robot.upper[moved], count)
        yield beads((region.reference_poses(robot, states) @ region.Tw_e)[:, :3, 3])


def _axes(reach: float, T: np.ndarray, length: float = 0.08, radius: float = 0.004) -> list[Mesh]:
    """Rods along x, y, z of a frame (4, 4); length and radius are shares of the robot's reach."""
    ends = (T[:3, 3] + length * reach * T[:3, k] for k in range(3))
    return [rod(T[:3, 3], end, radius * reach) for end in ends]


class Frame(NamedTuple):
    """A moment of a task: time [s], the phase it belongs to, the world."""

    time: float
    phase: str
    world: World


def frames(solution: TaskSolution, period: float = 0.1, pause: float = 0.5) -> list[Frame]:
    """Moments of a task in order, up to its end or the phase that failed.

    Args:
        solution: of the task.
        period: between two moments [s].
        pause: for fingers that open or close [s].
    """
    outcomes = {outcome.phase.name: outcome for outcome in solution.outcomes if outcome.solved}
    world, time, found = World.before(solution.task), 0.0, []
    for phase in solution.task.phases:
        if not isinstance(phase, PlannedPhase):
            world = world.after(phase)
            found.append(Frame(time, phase.name, world))
            time += pause
            continue
        if phase.name not in outcomes:
            break
        outcome = outcomes[phase.name]
        assert outcome.trajectory is not None and outcome.solution.simplified is not None
        motion = outcome.trajectory.sampled(period)
        for t, q in zip(motion.times, motion.positions, strict=True):
            found.append(Frame(time + float(t), phase.name, world.moved(q)))
        world = world.moved(outcome.solution.simplified.path.states[-1])
        time += motion.duration
    return found


def shown(world: World) -> PlanningProblem:
    """A problem to draw a world by: the arm alone, and a door it holds in the scene."""
    carried = (world.held.attachment,) if isinstance(world.held, Load) else ()
    return PlanningProblem(
        "shown", world.arm, world.scene, world.q, world.q[None], attachments=carried
    )


def seen_of_task(
    solution: TaskSolution, most: int | None = None, hidden: Sequence[str] = HIDDEN
) -> Seen:
    """What is shown of a task with at most `most` moments, up to the phase that failed.

    Raises InvalidInputError if nothing was done.
    """
    moments = frames(solution)
    if not moments:
        raise InvalidInputError(f"nothing to show of task {solution.task.name}: {solution.failure}")
    if most is not None and most < len(moments):
        moments = [moments[k] for k in np.linspace(0, len(moments) - 1, most).astype(int)]
    scene = solution.task.scene
    poses: dict[str, list[np.ndarray]] = {name: [] for name in scene.names}
    arm: dict[str, list[Body]] = {}
    for moment in moments:
        world, held = moment.world, moment.world.held
        placed = {item.name: item.T_world_object for item in world.scene}
        if isinstance(held, Load):
            placed[held.item.name] = world.arm.pose(world.q) @ held.attachment.T_hand_object
        for name, found in poses.items():
            found.append(placed[name])
        problem = replace(shown(world), attachments=())
        for body in robot_bodies(problem, world.q[None]):
            arm.setdefault(body.name, []).append(body)
    moving = [
        replace(pieces[0], poses=np.concatenate([piece.poses for piece in pieces]))
        for pieces in arm.values()
    ]
    moved = {
        name: np.array(Ts) for name, Ts in poses.items() if any((Ts[0] != T).any() for T in Ts)
    }
    for name, Ts in moved.items():
        mesh = shape_mesh(scene[name].shape)
        moving.append(Body("moved", "moving", name, mesh, colour_of(name), Ts))
    times = np.array([moment.time for moment in moments])
    verdict = "solved and certified" if solution.solved else solution.failure
    return Seen(
        f"task {solution.task.name}: {verdict}",
        scene_bodies(scene.without(*moved), hidden),
        ground_height(scene),
        moving,
        (),
        [moment.phase for moment in moments],
        max(float(times[-1]), 1.0),
        times,
        lines=repr(solution).splitlines(),
    )


def meshes_of(bodies: Iterable[Body], state: int = 0) -> list[Mesh]:
    """Their triangles in the world at a state."""
    return [body.at(state) for body in bodies]


def whole(bodies: Iterable[Body], state: int = 0) -> Mesh:
    """One mesh of several bodies at a state."""
    return joined(meshes_of(bodies, state))
