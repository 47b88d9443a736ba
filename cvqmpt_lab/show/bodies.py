"""Bodies to draw of a scene, robot, solution or task, each with a mesh, a colour and poses.

Pictures, films, web pages and recordings draw only these, so they need not know what a planner or
constraint is.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.planning.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.show.curves import Plot, plots_along, plots_over
from cvqmpt_lab.show.meshes import (
    Colour,
    Mesh,
    axes_marks,
    beads,
    constraint_marks,
    hull_mesh,
    joined,
    shape_mesh,
    travelled_along,
)
from cvqmpt_lab.tasks.solve import TaskSolution
from cvqmpt_lab.tasks.task import PlannedPhase
from cvqmpt_lab.tasks.world import Load, World

# red, green, blue in [0, 1]; GHOST: poses between start and goal; TRACE: path of the hand
ROBOT, GHOST, GOAL = (0.90, 0.90, 0.92), (0.25, 0.50, 0.90), (0.16, 0.68, 0.38)
LOAD, TRACE, CONSTRAINT = (0.86, 0.24, 0.20), (0.96, 0.55, 0.05), (0.60, 0.25, 0.72)
# of scene objects, by the beginning of a word in their name; the first match is used
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
HIDDEN = ("walls/right",)  # objects not drawn: they hide the robot from the usual viewpoint


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh in one colour, and its pose at every state."""

    group: str  # its name in legends
    layer: str  # bodies drawn together: "scene", "goals/0", "path"
    name: str
    mesh: Mesh  # in its own frame
    colour: Colour
    # T_world_body (m, 4, 4) [m] at m states, or (1, 4, 4) if it does not move
    poses: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    opacity: float = 1.0
    behind: float = 0.0  # opacity where something solid is in front of it
    aside: bool = False  # a torso between two arms: a viewpoint is chosen for what it moves

    def at(self, state: int = 0) -> Mesh:
        """Its triangles in the world at a state of the path."""
        return self.mesh.placed(self.poses[state if len(self.poses) > 1 else 0], self.colour)


@dataclass(frozen=True, eq=False)
class Seen:
    """Everything that is shown of a problem, a solution or a task."""

    title: str
    scene: Sequence[Body]  # bodies that do not move
    ground: float | None  # height of the highest floor [m]
    moving: Sequence[Body]  # the robot and what it moves, with m poses each
    over: Sequence[Body]  # start, goals, trace, constraint and axes, drawn over the rest
    labels: Sequence[str]  # one per state
    times: np.ndarray | None = None  # (m,) of a task's states [s]
    plots: Sequence[Plot] = ()
    lines: Sequence[str] = ()  # of text, below the drawing of a web page

    @property
    def floor(self) -> list[Body]:
        """A square plate whose top is at height `ground`; none without ground."""
        if self.ground is None:
            return []
        mesh, T = shape_mesh(Box((5.0, 5.0, 0.02))), pose((0.0, 0.0, self.ground - 0.01))
        return [Body("floor", "scene", "floor", mesh, colour_of("floor"), T[None])]

    def bodies(self, *names: str) -> list[Body]:
        """Scene, floor, moving bodies, and those of `over` in the named layers, see `layers`."""
        over = [body for layer in self.layers(*names).values() for body in layer]
        return [*self.scene, *self.floor, *self.moving, *over]

    def layers(self, *names: str) -> dict[str, list[Body]]:
        """Bodies of `over` by layer, for layers whose part before "/" is among the names."""
        found: dict[str, list[Body]] = {}
        for body in self.over:
            if body.layer.split("/")[0] in names:
                found.setdefault(body.layer, []).append(body)
        return found


def colour_of(name: str, other: Colour = (0.87, 0.77, 0.62)) -> Colour:
    """Colour of a scene object by its name; `other` if no word of `KIND_COLOURS` matches."""
    words = re.split("[^a-z]+", name.lower())
    fits = (kind for kind in KIND_COLOURS if any(word.startswith(kind) for word in words))
    return KIND_COLOURS.get(next(fits, ""), other)


def scene_bodies(scene: Scene, hidden: Sequence[str] = HIDDEN) -> list[Body]:
    """The scene's objects without `hidden` ones and floors (boxes that are no obstacles)."""
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
    """Height of the top of the highest floor [m]; None without a floor."""
    tops = [
        item.T_world_object[2, 3] + 0.5 * item.shape.size[2]
        for item in scene
        if isinstance(item.shape, Box) and not item.obstacle
    ]
    return max(tops, default=None)


def robot_bodies(
    problem: PlanningProblem,
    states: np.ndarray,
    colour: Colour = ROBOT,
    group: str = "robot",
    layer: str = "robot",
    opacity: float = 1.0,
) -> list[Body]:
    """Convex hulls of the robot's links, and attached objects, at states (m, n) [rad or m]."""
    states = np.ascontiguousarray(states, dtype=float)
    rotations, translations = link_poses(problem.robot.kinematics, states)
    T_world_link = np.tile(np.eye(4), (*translations.shape[:2], 1, 1))
    T_world_link[..., :3, :3], T_world_link[..., :3, 3] = rotations, translations
    found, several = [], len(problem.robot.end_effectors) > 1
    for part in problem.robot.links:
        poses = T_world_link[:, part.link] @ part.T_link_geometry
        mesh, aside = hull_mesh(part.vertices), several and part.link == 0
        found.append(Body(group, layer, part.name, mesh, colour, poses, opacity, aside=aside))
    for item in problem.attachments:
        poses = problem.robot.poses(states, item.end_effector) @ item.T_hand_object
        name = item.name.replace("_", " ") if group in ("robot", "start") else group
        found.append(Body(name, layer, item.name, shape_mesh(item.shape), LOAD, poses, opacity))
    return found


def seen_of_problem(
    problem: PlanningProblem,
    path: JointPath | None,
    carried: Sequence[Attachment] = (),
    most_states: int | None = None,
    ghosts: int = 4,
    goals: int = 1,
    hidden: Sequence[str] = HIDDEN,
    plots: bool = False,
    verdict: str = "",
    lines: Sequence[str] = (),
) -> Seen:
    """What is shown of a problem, with or without a path.

    Args:
        problem: what is shown.
        path: that is shown; None: only start and goals.
        carried: objects shown in the hand if the problem has no attachments.
        most_states: a path of more states is resampled evenly; None: it is shown as it is.
        ghosts: number of translucent robots shown between start and goal.
        goals: number of goals shown at most if there is no path.
        hidden: objects of the scene that are not shown.
        plots: whether there are plots along the path.
        verdict: last part of the title, e.g. "not solved".
        lines: of text, below the drawing of a web page.
    """
    loaded = replace(problem, attachments=problem.attachments or tuple(carried))
    states = problem.start[None] if path is None else path.states
    if path is not None and most_states is not None and len(states) > most_states:
        states = path.spaced(path.length / (most_states - 1))
    travelled = travelled_along(states)
    return Seen(
        f"{problem.name}: {problem.robot.name}, {verdict}",
        scene_bodies(problem.scene, hidden),
        ground_height(problem.scene),
        robot_bodies(loaded, states),
        list(_over(loaded, None if path is None else states, ghosts, goals)),
        [f"state {k} of {len(states) - 1}, {way:.2f} rad" for k, way in enumerate(travelled)],
        plots=plots_along(problem, states) if plots and path is not None else (),
        lines=lines,
    )


def _over(
    problem: PlanningProblem, path: np.ndarray | None, ghosts: int, goals: int
) -> Iterator[Body]:
    """Start, goals, ghosts, the hand's trace, constraint and axes; path: its states (m, n)."""
    states = problem.start[None] if path is None else path
    names = problem.robot.end_effectors
    # what bodies of each hand are called; those of one hand as ever
    hands = {
        f"{name}/" if len(names) > 1 else "": problem.robot.poses(states, name) for name in names
    }
    yield from robot_bodies(problem, problem.start[None], ROBOT, "start", "start", 0.35)
    opacity = 0.5 if path is None else 0.55
    for k, goal in enumerate(problem.goals[:goals] if path is None else states[-1:]):
        yield from robot_bodies(problem, goal[None], GOAL, "goal", f"goals/{k}", opacity)
    if path is not None:
        travelled = travelled_along(path)
        for k in range(1, ghosts + 1):
            q = path[np.searchsorted(travelled, travelled[-1] * k / (ghosts + 1))]
            yield from robot_bodies(problem, q[None], GHOST, "on the way", f"way/{k}", 0.25)
        for whose, T_world_hand in hands.items():
            trace = beads(T_world_hand[:, :3, 3])
            yield Body("path of the hand", "path", f"{whose}hand", trace, TRACE, behind=0.45)
    for k, mark in enumerate(constraint_marks(problem, states)):
        layer = f"constraint/{k}"
        yield Body("constraint", layer, "mark", mark, CONSTRAINT, opacity=0.3, behind=0.12)
    marks = axes_marks(problem.robot.reach)
    for (name, colour, mesh), (whose, T_world_hand) in product(marks, hands.items()):
        yield Body("axes of the hand", "hand", whose + name, mesh, colour, T_world_hand)
        for T in T_world_hand[[0, -1]]:
            yield Body("axes", "axes", name, mesh, colour, T[None], behind=0.5)


def seen_of_solution(
    solution: Solution | TaskSolution,
    carried: Sequence[Attachment] = (),
    most_states: int | None = None,
    plots: bool = False,
    goals: int = 1,
    hidden: Sequence[str] = HIDDEN,
) -> Seen:
    """What is shown of a solution, or of a task; see `seen_of_problem`."""
    if isinstance(solution, TaskSolution):
        return seen_of_task(solution, hidden=hidden, plots=plots)
    return seen_of_problem(
        solution.problem,
        solution.path,
        carried,
        most_states,
        goals=goals,
        hidden=hidden,
        plots=plots,
        verdict="solved and certified" if solution.solved else "not solved",
        lines=repr(solution).splitlines(),
    )


class Frame(NamedTuple):
    """A moment of a task: time [s], name of the phase, state of the world, clearance."""

    time: float
    phase: str
    world: World
    clearance: float = math.nan  # [m], nan where nothing is planned


def seen_of_task(
    solution: TaskSolution,
    most: int | None = None,
    hidden: Sequence[str] = HIDDEN,
    plots: bool = False,
) -> Seen:
    """What is shown of a task up to the phase that failed; InvalidInputError where nothing is."""
    task, found = solution.task, frames(solution, clearance=plots)
    if not found:
        raise InvalidInputError(f"nothing to show of task {task.name}: {solution.failure}")
    verdict = "solved and certified" if solution.solved else solution.failure
    title, lines = f"task {task.name}: {verdict}", repr(solution).splitlines()
    return seen_of_frames(title, task.scene, found, lines, most, hidden, plots)


def frames(
    solution: TaskSolution, period: float = 0.1, pause: float = 0.5, clearance: bool = False
) -> list[Frame]:
    """Moments of a task in order, up to its end or the phase that failed.

    Args:
        solution: of the task.
        period: time between two moments of a motion [s].
        pause: time for opening or closing the fingers [s].
        clearance: whether that of moments in motion is computed.
    """
    world, time, found = World.before(solution.task), 0.0, []
    for phase, outcome in solution.steps:
        if not isinstance(phase, PlannedPhase):
            world = world.after(phase)
            found.append(Frame(time, phase.name, world))
            time += pause
            continue
        if outcome is None or outcome.trajectory is None or outcome.solution.path is None:
            break
        motion = outcome.trajectory.sampled(period)
        checker = outcome.solution.problem.collision_checker()
        for t, q in zip(motion.times, motion.positions, strict=True):
            free = checker.clearance(q) if clearance else math.nan
            found.append(Frame(time + float(t), phase.name, world.moved(q), free))
        world = world.moved(outcome.solution.path.states[-1])
        time += motion.duration
    return found


def shown(world: World) -> PlanningProblem:
    """A problem that shows a world: the arm, and in the scene also a door that the arm holds."""
    carried = (world.held.attachment,) if isinstance(world.held, Load) else ()
    return PlanningProblem(
        "shown", world.arm, world.scene, world.q, world.q[None], attachments=carried
    )


def seen_of_frames(
    title: str,
    scene: Scene,
    moments: Sequence[Frame],
    lines: Sequence[str] = (),
    most: int | None = None,
    hidden: Sequence[str] = HIDDEN,
    plots: bool = False,
) -> Seen:
    """What is shown of moments, of at most `most` of them, without `hidden` objects.

    scene: at the beginning.
    lines: of text, below the drawing of a web page.
    """
    if most is not None and most < len(moments):
        moments = [moments[k] for k in np.linspace(0, len(moments) - 1, most).astype(int)]
    arms, placed = [], []
    for moment in moments:
        world, held = moment.world, moment.world.held
        there = {item.name: item.T_world_object for item in world.scene}
        if isinstance(held, Load):
            there[held.item.name] = world.arm.pose(world.q) @ held.attachment.T_hand_object
        placed.append(there)
        arms.append(robot_bodies(replace(shown(world), attachments=()), world.q[None]))
    moving = [
        replace(pieces[0], poses=np.concatenate([piece.poses for piece in pieces]))
        for pieces in zip(*arms, strict=True)
    ]
    poses = {name: np.array([there[name] for there in placed]) for name in scene.names}
    moved = {name: Ts for name, Ts in poses.items() if (Ts != Ts[0]).any()}
    moving += [
        Body("moved", "moving", name, shape_mesh(scene[name].shape), colour_of(name), Ts)
        for name, Ts in moved.items()
    ]
    motion = [(moment.world.arm, moment.world.q, moment.clearance) for moment in moments]
    hand = beads(np.array([arm.pose(q)[:3, 3] for arm, q, _ in motion]))
    trace = Body("path of the hand", "path", "hand", hand, TRACE, behind=0.45)
    return Seen(
        title,
        scene_bodies(scene.without(*moved), hidden),
        ground_height(scene),
        moving,
        (trace,) if plots else (),
        [moment.phase for moment in moments],
        np.array([moment.time for moment in moments]),
        plots_over(motion) if plots else (),
        lines=lines,
    )


def whole(bodies: Iterable[Body], state: int = 0) -> Mesh:
    """One mesh of several bodies at a state."""
    return joined(body.at(state) for body in bodies)


def in_view(bodies: Iterable[Body], state: int = 0) -> Mesh:
    """`whole`, without bodies that a viewpoint is not chosen for."""
    return whole((body for body in bodies if not body.aside), state)
