"""Drawings of scenes, robots, solutions and tasks: bodies with a mesh, a colour and poses.

Pictures, films, web pages and recordings use only drawings, so they do not depend on planners and
constraints.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.polyline import distances_along
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.features.pictures.curves import Plot, plots_along, plots_over
from cvqmpt_lab.features.pictures.meshes import (
    Colour,
    Mesh,
    axes_marks,
    beads,
    constraint_marks,
    joined,
    shape_mesh,
)
from cvqmpt_lab.features.pictures.visuals import drawn_pieces
from cvqmpt_lab.features.tasks.solve import TaskSolution
from cvqmpt_lab.features.tasks.task import PlannedPhase
from cvqmpt_lab.features.tasks.world import Load, World
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import JointPath

# "ghost": robot between start and goal; "trace": path of the hand
BODY_COLOURS: Mapping[str, Colour] = {
    "robot": (0.90, 0.90, 0.92),
    "ghost": (0.25, 0.50, 0.90),
    "goal": (0.16, 0.68, 0.38),
    "load": (0.86, 0.24, 0.20),
    "trace": (0.96, 0.55, 0.05),
    "constraint": (0.60, 0.25, 0.72),
    "chosen": (0.93, 0.16, 0.55),  # outline of what is chosen in the studio
}
# colours of scene objects by the beginning of a word in their name; the first match is used
OBJECT_COLOURS: Mapping[str, Colour] = {
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
HIDDEN_OBJECTS = ("walls/right",)  # not drawn: they would hide the robot from the usual viewpoint


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh in one colour, and its pose at every state."""

    group: str  # name in legends
    layer: str  # name of the bodies that are drawn together: "scene", "goals/0", "path"
    name: str
    mesh: Mesh  # in its own frame
    colour: Colour
    # T_world_body (m, 4, 4) [m] at m states, or (1, 4, 4) if it does not move
    poses: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    opacity: float = 1.0
    behind: float = 0.0  # opacity where a solid body is in front of it
    torso: bool = False  # torso between two arms: viewpoints are chosen for the arms alone

    def at(self, state: int = 0) -> Mesh:
        """Mesh in the world frame at a state of the path."""
        return self.mesh.placed(self.poses[state if len(self.poses) > 1 else 0], self.colour)


@dataclass(frozen=True, eq=False)
class Drawing:
    """Bodies, labels and plots of a problem, a solution or a task."""

    title: str
    scene: Sequence[Body]  # bodies that do not move
    ground: float | None  # height of the highest floor [m]; None: no floor
    moving: Sequence[Body]  # the robot and the objects that it moves, with m poses each
    over: Sequence[Body]  # start, goals, trace, constraint and axes, drawn over the rest
    labels: Sequence[str]  # one per state
    times: np.ndarray | None = None  # (m,) of a task's states [s]
    plots: Sequence[Plot] = ()
    lines: Sequence[str] = ()  # text below the drawing on a web page
    unseen: Sequence[str] = ()  # lines on space that nobody saw, in amber on a web page

    @property
    def under(self) -> float:
        """Height of the ground [m]: the floor, or the lowest point of scene and motion."""
        some = range(0, len(self.labels), max(1, len(self.labels) // 10))
        meshes = (mesh_of(self.scene), *(mesh_of(self.moving, k) for k in some))
        return ground_under(self.ground, *meshes)

    @property
    def floor(self) -> list[Body]:
        """A square plate with its top at height `ground`; empty if there is no floor."""
        if self.ground is None:
            return []
        mesh, T = shape_mesh(Box((5.0, 5.0, 0.02))), pose((0.0, 0.0, self.ground - 0.01))
        return [Body("floor", "scene", "floor", mesh, colour_of("floor"), T[None])]

    def bodies(self, *names: str) -> list[Body]:
        """Bodies of the scene, floor, moving bodies, and bodies of `over` in the named layers."""
        over = [body for layer in self.layers(*names).values() for body in layer]
        return [*self.scene, *self.floor, *self.moving, *over]

    def layers(self, *names: str) -> dict[str, list[Body]]:
        """Bodies of `over` by layer, for the layers whose name before "/" is one of `names`."""
        found: dict[str, list[Body]] = {}
        for body in self.over:
            if body.layer.split("/")[0] in names:
                found.setdefault(body.layer, []).append(body)
        return found


def colour_of(name: str, other: Colour = (0.87, 0.77, 0.62)) -> Colour:
    """Colour of a scene object by its name; `other` if no word of `OBJECT_COLOURS` matches."""
    words = re.split("[^a-z]+", name.lower())
    for kind, colour in OBJECT_COLOURS.items():
        if any(word.startswith(kind) for word in words):
            return colour
    return other


def scene_bodies(scene: Scene, hidden: Sequence[str] = HIDDEN_OBJECTS) -> list[Body]:
    """Objects of the scene, without those in `hidden` and floors (boxes that are no obstacles)."""
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


def ground_under(floor: float | None, *meshes: Mesh) -> float:
    """Height of the ground [m]: the floor, or without one the lowest corner of meshes, or 0."""
    if floor is not None:
        return floor
    return min((float(m.corners[..., 2].min()) for m in meshes if len(m.corners)), default=0.0)


def robot_bodies(
    problem: PlanningProblem,
    states: np.ndarray,
    colour: Colour | None = None,
    group: str = "robot",
    layer: str = "robot",
    opacity: float = 1.0,
) -> list[Body]:
    """Visual meshes or hulls of the robot's links, and attached objects, at states.

    Args:
        problem: the problem with robot and attachments.
        states: (m, n) [rad or m].
        colour: colour of the robot; None: from the materials of its URDF, or light grey.
        group: name of the robot in legends.
        layer: layer of the bodies.
        opacity: opacity of the bodies, in [0, 1].
    """
    states = np.ascontiguousarray(states, dtype=float)
    rotations, translations = link_poses(problem.robot.kinematics, states)
    T_world_link = np.tile(np.eye(4), (*translations.shape[:2], 1, 1))
    T_world_link[..., :3, :3], T_world_link[..., :3, 3] = rotations, translations
    found = []
    two_arms = len(problem.robot.end_effectors) > 1
    for part in drawn_pieces(problem.robot):
        poses = T_world_link[:, part.link] @ part.T_link_mesh
        torso = two_arms and part.link == 0
        paint = colour or part.colour or BODY_COLOURS["robot"]
        found.append(Body(group, layer, part.name, part.mesh, paint, poses, opacity, torso=torso))
    for item in problem.attachments:
        poses = problem.robot.poses(states, item.end_effector) @ item.T_hand_object
        name = item.name.replace("_", " ") if group in ("robot", "start") else group
        mesh = shape_mesh(item.shape)
        found.append(Body(name, layer, item.name, mesh, BODY_COLOURS["load"], poses, opacity))
    return found


def drawing_of_problem(
    problem: PlanningProblem,
    path: JointPath | None,
    carried: Sequence[Attachment] = (),
    most_states: int | None = None,
    ghosts: int = 4,
    goals: int = 1,
    hidden: Sequence[str] = HIDDEN_OBJECTS,
    plots: bool = False,
    verdict: str = "",
    lines: Sequence[str] = (),
) -> Drawing:
    """Drawing of a problem, with or without a path.

    Args:
        problem: the problem.
        path: a path of the problem; None: only start and goals are drawn.
        carried: objects drawn in the hand if the problem has no attachments.
        most_states: a path of more states is resampled to about this number, at equal distances;
            None: it is kept.
        ghosts: number of translucent robots between start and goal.
        goals: largest number of goals drawn if there is no path.
        hidden: names of scene objects that are not drawn.
        plots: whether there are plots along the path.
        verdict: last part of the title, e.g. "not solved".
        lines: text below the drawing on a web page.
    """
    loaded = replace(problem, attachments=problem.attachments or tuple(carried))
    states = problem.start[None] if path is None else path.states
    if path is not None and most_states is not None and len(states) > most_states:
        states = path.spaced(path.length / (most_states - 1))
    travelled = distances_along(states)
    return Drawing(
        f"{problem.name}: {problem.robot.name}, {verdict}",
        scene_bodies(problem.scene, hidden),
        ground_height(problem.scene),
        robot_bodies(loaded, states),
        list(_over(loaded, None if path is None else states, ghosts, goals)),
        [f"state {k} of {len(states) - 1}, {s:.2f} rad" for k, s in enumerate(travelled)],
        plots=plots_along(problem, states) if plots and path is not None else (),
        lines=lines,
        unseen=problem.scene.notes,
    )


def _over(
    problem: PlanningProblem, path: np.ndarray | None, ghosts: int, goals: int
) -> Iterator[Body]:
    """Start, goals, ghosts, the hand's trace, constraint and axes.

    path: states (m, n) of the path, or None.
    """
    states = problem.start[None] if path is None else path
    names = problem.robot.end_effectors
    # poses of each hand, by the prefix of its bodies' names; a single hand has the prefix ""
    hands = {
        f"{name}/" if len(names) > 1 else "": problem.robot.poses(states, name) for name in names
    }
    colours = BODY_COLOURS
    start = problem.start[None]
    yield from robot_bodies(problem, start, None, "start", "start", 0.35)
    opacity = 0.5 if path is None else 0.55
    for k, goal in enumerate(problem.goals[:goals] if path is None else states[-1:]):
        yield from robot_bodies(problem, goal[None], colours["goal"], "goal", f"goals/{k}", opacity)
    if path is not None:
        travelled = distances_along(path)
        for k in range(1, ghosts + 1):
            q = path[np.searchsorted(travelled, travelled[-1] * k / (ghosts + 1))][None]
            yield from robot_bodies(problem, q, colours["ghost"], "on the way", f"way/{k}", 0.25)
        for prefix, T_world_hand in hands.items():
            trace, name = beads(T_world_hand[:, :3, 3]), f"{prefix}hand"
            yield Body("path of the hand", "path", name, trace, colours["trace"], behind=0.45)
    for k, mark in enumerate(constraint_marks(problem, states)):
        layer, colour = f"constraint/{k}", colours["constraint"]
        yield Body("constraint", layer, "mark", mark, colour, opacity=0.3, behind=0.12)
    marks = axes_marks(problem.robot.reach)
    for (name, colour, mesh), (prefix, T_world_hand) in product(marks, hands.items()):
        yield Body("axes of the hand", "hand", prefix + name, mesh, colour, T_world_hand)
        for T in T_world_hand[[0, -1]]:
            yield Body("axes", "axes", name, mesh, colour, T[None], behind=0.5)


def drawing_of_solution(
    solution: Solution | TaskSolution,
    carried: Sequence[Attachment] = (),
    most_states: int | None = None,
    plots: bool = False,
    goals: int = 1,
    hidden: Sequence[str] = HIDDEN_OBJECTS,
    path: JointPath | None = None,
) -> Drawing:
    """Drawing of a solution of a problem or task.

    Args:
        solution: solved or not.
        carried: objects drawn in the hand if the problem has no attachments.
        most_states: a path of more states is resampled to about this number, at equal distances;
            None: it is kept.
        plots: whether there are plots along the path or task.
        goals: largest number of goals drawn if there is no path.
        hidden: names of scene objects that are not drawn.
        path: states of a motion along the path of a problem; None: the path.
    """
    if isinstance(solution, TaskSolution):
        return drawing_of_task(solution, hidden=hidden, plots=plots)
    return drawing_of_problem(
        solution.problem,
        path or solution.path,
        carried,
        most_states,
        goals=goals,
        hidden=hidden,
        plots=plots,
        verdict=solution.verdict or "not solved",
        lines=[*repr(solution).splitlines(), *solution.report().only("uncompared").lines],
    )


class Frame(NamedTuple):
    """State of a task at one time."""

    time: float  # [s]
    phase: str  # name of the phase
    world: World
    clearance: float = math.nan  # [m]; nan in hand phases, or if it was not computed


def drawing_of_task(
    solution: TaskSolution,
    most: int | None = None,
    hidden: Sequence[str] = HIDDEN_OBJECTS,
    plots: bool = False,
) -> Drawing:
    """Drawing of a task up to the phase that failed.

    Args:
        solution: solved or not.
        most: largest number of frames, chosen evenly; None: all.
        hidden: names of scene objects that are not drawn.
        plots: whether there are plots over the task.

    Raises InvalidInputError if the first phase failed, so that there is nothing to draw.
    """
    task, found = solution.task, frames(solution, clearance=plots)
    if not found:
        raise InvalidInputError(f"nothing to show of task {task.name}: {solution.failure}")
    verdict = "solved and certified" if solution.solved else solution.failure
    title, lines = f"task {task.name}: {verdict}", repr(solution).splitlines()
    return drawing_of_frames(title, task.scene, found, lines, most, hidden, plots)


def frames(
    solution: TaskSolution, period: float = 0.1, pause: float = 0.5, clearance: bool = False
) -> list[Frame]:
    """Frames of a task in order, up to its end or the phase that failed.

    Args:
        solution: the task's solution.
        period: largest time between two frames of a motion [s].
        pause: duration of a phase that opens or closes the fingers [s].
        clearance: whether the clearance during motions is computed.
    """
    found = []
    world, time = World.before(solution.task), 0.0
    for phase, outcome in solution.steps:
        if not isinstance(phase, PlannedPhase):
            world = world.after(phase)
            found.append(Frame(time, phase.name, world))
            time += pause
            continue
        if outcome is None or outcome.trajectory is None or outcome.solution.path is None:
            break
        motion = outcome.trajectory.sampled(period)
        checker = checker_of(outcome.solution.problem)
        for t, q in zip(motion.times, motion.positions, strict=True):
            distance = checker.clearance(q) if clearance else math.nan
            found.append(Frame(time + float(t), phase.name, world.moved(q), distance))
        world = world.moved(outcome.solution.path.states[-1])
        time += motion.duration
    return found


def problem_of(world: World) -> PlanningProblem:
    """Problem for drawing a task's state: the arm, its load, and the scene with all doors."""
    carried = (world.held.attachment,) if isinstance(world.held, Load) else ()
    return PlanningProblem(
        "shown", world.arm, world.scene, world.q, world.q[None], attachments=carried
    )


def drawing_of_frames(
    title: str,
    scene: Scene,
    frames: Sequence[Frame],
    lines: Sequence[str] = (),
    most: int | None = None,
    hidden: Sequence[str] = HIDDEN_OBJECTS,
    plots: bool = False,
) -> Drawing:
    """Drawing of the frames of a task or execution.

    Args:
        title: title of the drawing.
        scene: the scene at the beginning.
        frames: states of the world, in order of time.
        lines: text below the drawing on a web page.
        most: largest number of frames, chosen evenly; None: all.
        hidden: names of scene objects that are not drawn.
        plots: whether to add plots over time and the trace of the hand.
    """
    if most is not None and most < len(frames):
        frames = [frames[k] for k in np.linspace(0, len(frames) - 1, most).astype(int)]
    arms, placed = [], []
    for frame in frames:
        world, held = frame.world, frame.world.held
        pose_of = {item.name: item.T_world_object for item in world.scene}
        if isinstance(held, Load):
            pose_of[held.item.name] = world.arm.pose(world.q) @ held.attachment.T_hand_object
        placed.append(pose_of)
        arms.append(robot_bodies(replace(problem_of(world), attachments=()), world.q[None]))
    moving = [
        replace(pieces[0], poses=np.concatenate([piece.poses for piece in pieces]))
        for pieces in zip(*arms, strict=True)
    ]
    poses = {name: np.array([pose_of[name] for pose_of in placed]) for name in scene.names}
    moved = {name: Ts for name, Ts in poses.items() if (Ts != Ts[0]).any()}
    moving += [
        Body("moved", "moving", name, shape_mesh(scene[name].shape), colour_of(name), Ts)
        for name, Ts in moved.items()
    ]
    motion = [(frame.world.arm, frame.world.q, frame.clearance) for frame in frames]
    hand = beads(np.array([arm.pose(q)[:3, 3] for arm, q, _ in motion]))
    trace = Body("path of the hand", "path", "hand", hand, BODY_COLOURS["trace"], behind=0.45)
    return Drawing(
        title,
        scene_bodies(scene.without(*moved), hidden),
        ground_height(scene),
        moving,
        (trace,) if plots else (),
        [frame.phase for frame in frames],
        np.array([frame.time for frame in frames]),
        plots_over(motion) if plots else (),
        lines=lines,
        unseen=scene.notes,
    )


def mesh_of(bodies: Iterable[Body], state: int = 0) -> Mesh:
    """One mesh of several bodies at a state."""
    return joined(body.at(state) for body in bodies)


def mesh_in_view(bodies: Iterable[Body], state: int = 0) -> Mesh:
    """One mesh of several bodies at a state, without the torso; viewpoints must contain it."""
    return mesh_of((body for body in bodies if not body.torso), state)
