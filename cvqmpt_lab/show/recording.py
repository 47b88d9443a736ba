"""Showing a solution in rerun: scene, robot, trees, paths and plots. With task_viewer.py the only door to rerun.

Entities: ``world/scene``, ``world/start``, ``world/goals``, ``world/trees``, ``world/path``, ``world/robot``
(moving along the path) and ``plots``. The timeline "path_state" counts the states of the path shown.
"""

import shutil
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.planning.result import Path as JointPath
from cvqmpt_lab.planning.result import Tree
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Shape, Sphere
from cvqmpt_lab.show.meshes import (
    GHOST_COLOUR,
    GOAL_COLOUR,
    LOAD_COLOUR,
    ROBOT_COLOUR,
    TRACE_COLOUR,
    Colour,
    Mesh,
    colour_of,
    hull_mesh,
    is_ground,
    poses_along,
)

TIMELINE = "path_state"
GOALS_SHOWN = 3
GHOST_OPACITY = 0.35
GROUND_HALF_SIDE = 2.5  # [m] shown of a floor, around its middle
FLUSH_SECONDS = 10.0
RAW_COLOUR: Colour = (0.55, 0.55, 0.58)
TREE_COLOURS: tuple[Colour, ...] = (GHOST_COLOUR, GOAL_COLOUR)


def log_solution(solution: Solution, save: Path | None = None, view: bool = False) -> None:
    """Write a solution to a .rrd file, show it in the rerun viewer, or both; works without a display to save.

    Raises
    ------
    InvalidInputError: neither was asked for, the file cannot be written, or no viewer can be opened.
    """
    if save is None and not view:
        raise InvalidInputError("nothing to do with the recording: give save=<file.rrd>, view=True or both")
    if save is not None:
        save_recording(Path(save), _blueprint(), lambda recording: _log_everything(recording, solution))
    if view:
        _view(solution)


def save_recording(path: Path, blueprint: rrb.Blueprint, log: Callable[[rr.RecordingStream], None]) -> None:
    """Log to a file that takes its name only when it is complete."""
    recording = _recording()
    temporary = path.with_name(path.name + ".tmp")
    try:
        recording.save(temporary, default_blueprint=blueprint)
        log(recording)
        recording.flush()
        recording.disconnect()
        temporary.replace(path)
    except (OSError, RuntimeError) as error:
        with suppress(OSError):
            temporary.unlink()
        reason = " ".join(str(error).split())
        raise InvalidInputError(
            f"cannot write recording {path}: {reason}; name a file in a folder that exists"
        ) from error


def _view(solution: Solution) -> None:
    """Open the viewer that came with rerun-sdk, also from an environment that is not activated."""
    recording = _recording()
    beside_python = shutil.which("rerun", path=str(Path(sys.executable).parent))
    try:
        rr.spawn(recording=recording, executable_path=beside_python, default_blueprint=_blueprint())
        _log_everything(recording, solution)
        recording.flush(timeout_sec=FLUSH_SECONDS)
    except RuntimeError as error:
        reason = str(error).split("\n")[0]
        raise InvalidInputError(
            f"cannot open the rerun viewer ({reason}): without a display, save a file and open it elsewhere"
        ) from error


def _recording() -> rr.RecordingStream:
    recording = rr.RecordingStream("cvqmpt_lab")
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    return recording


def _blueprint() -> rrb.Blueprint:
    """The world on the left, the plots on the right, the path's timeline below."""
    eye = rrb.EyeControls3D(position=(-1.7, -2.0, 1.75), look_target=(0.4, -0.1, 0.5), eye_up=(0.0, 0.0, 1.0))
    plots = [
        rrb.TimeSeriesView(origin="plots/violation", name="constraint violation [rad], [m]"),
        rrb.TimeSeriesView(origin="plots/joints", name="joint values [rad or m]"),
    ]
    world = rrb.Spatial3DView(origin="world", name="world", eye_controls=eye)
    return rrb.Blueprint(
        rrb.Horizontal(world, rrb.Vertical(*plots), column_shares=[3, 1]),
        rrb.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )


def _log_everything(recording: rr.RecordingStream, solution: Solution) -> None:
    problem = solution.problem
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    log_scene(recording, problem.scene)
    log_ghosts(recording, problem)
    log_trees(recording, problem.robot, solution.plan.trees)
    if solution.plan.path is not None:
        log_path(recording, "raw", problem.robot, solution.plan.path, RAW_COLOUR, 0.002)
    if solution.simplified is not None:
        log_path(recording, "simplified", problem.robot, solution.simplified.path, TRACE_COLOUR, 0.005)
        log_motion(recording, problem, solution.simplified.path.states)
        log_plots(recording, problem, solution.simplified.path.states)


def log_scene(recording: rr.RecordingStream, scene: Scene) -> None:
    """Every object of the scene by its name; "a/b" becomes entity b below a."""
    for item in scene:
        entity = rr.new_entity_path(["world", "scene", *item.name.split("/")])
        recording.log(entity, _transform(item.T_world_object), object_archetype(item), static=True)


def log_ghosts(recording: rr.RecordingStream, problem: PlanningProblem) -> None:
    """The robot at the start and at the first goals, translucent."""
    ghosts = {"world/start": (problem.start, ROBOT_COLOUR)}
    ghosts |= {f"world/goals/{k}": (goal, GOAL_COLOUR) for k, goal in enumerate(problem.goals[:GOALS_SHOWN])}
    for entity, (q, colour) in ghosts.items():
        log_robot(recording, entity, problem, colour, GHOST_OPACITY)
        for link, T_world_link in enumerate(poses_along(problem.robot, q[None])[0][0]):
            recording.log(f"{entity}/{link}", _transform(T_world_link), static=True)


def log_robot(
    recording: rr.RecordingStream, entity: str, problem: PlanningProblem, colour: Colour, opacity: float = 1.0
) -> None:
    """The robot's hulls and what it carries, each below ``entity/<pose row>``; links are posed elsewhere."""
    robot = problem.robot
    for part in robot.links:
        at = rr.new_entity_path([*entity.split("/"), part.link, part.name])
        mesh = hull_mesh(part.vertices)
        recording.log(
            at, _transform(part.T_link_geometry), mesh_archetype(mesh, colour, opacity), static=True
        )
    link, T_link_hand = robot.end_effector_link
    for item in problem.attachments:
        at = rr.new_entity_path([*entity.split("/"), link, item.name])
        T_link_object = T_link_hand @ item.T_hand_object
        recording.log(
            at, _transform(T_link_object), _archetype(item.shape, LOAD_COLOUR, opacity), static=True
        )


def log_trees(recording: rr.RecordingStream, robot: Robot, trees: tuple[Tree, ...]) -> None:
    """Hand positions of the nodes of each tree, and the edges between them; not on the timeline."""
    for k, tree in enumerate(trees):
        if len(tree.nodes) == 0:
            continue
        colour = _rgba(TREE_COLOURS[k % len(TREE_COLOURS)])
        hand = _hand_positions(robot, tree.nodes)
        child = np.flatnonzero(tree.parent >= 0)
        edges = np.stack([hand[child], hand[tree.parent[child]]], axis=1)
        recording.log(f"world/trees/{k}/nodes", rr.Points3D(hand, radii=0.003, colors=colour), static=True)
        recording.log(
            f"world/trees/{k}/edges", rr.LineStrips3D(edges, radii=0.0008, colors=colour), static=True
        )


def log_path(
    recording: rr.RecordingStream, name: str, robot: Robot, path: JointPath, colour: Colour, radius: float
) -> None:
    """The hand's trace along a path, a line of the given radius [m]."""
    line = rr.LineStrips3D([_hand_positions(robot, path.states)], radii=radius, colors=_rgba(colour))
    recording.log(f"world/path/{name}", line, static=True)


def log_motion(recording: rr.RecordingStream, problem: PlanningProblem, states: np.ndarray) -> None:
    """The robot moving through states (m, n) along the timeline."""
    log_robot(recording, "world/robot", problem, ROBOT_COLOUR)
    T_world_link, _ = poses_along(problem.robot, states)
    for link in range(T_world_link.shape[1]):
        T = T_world_link[:, link]
        columns = rr.Transform3D.columns(translation=T[:, :3, 3], mat3x3=T[:, :3, :3])
        recording.send_columns(f"world/robot/{link}", [_time(len(states))], columns)


def log_plots(recording: rr.RecordingStream, problem: PlanningProblem, states: np.ndarray) -> None:
    """Constraint violation and joint values at states (m, n)."""
    curves = {f"plots/violation/{unit}": values for unit, values in violations(problem, states).items()}
    curves |= {f"plots/joints/{name}": states[:, j] for j, name in enumerate(problem.robot.joint_names)}
    for entity, values in curves.items():
        recording.log(entity, rr.SeriesLines(names=entity.split("/")[-1]), static=True)
        recording.send_columns(entity, [_time(len(states))], rr.Scalars.columns(scalars=values))


def violations(problem: PlanningProblem, states: np.ndarray) -> Mapping[str, np.ndarray]:
    """Largest distance (m,) outside the constraint's bounds at states (m, n), under "rad" and "m"."""
    manifold = problem.manifold
    outside = np.abs(manifold.residual(states)).reshape(len(states), manifold.dim)
    turns = manifold.regions().axis >= 3
    return {
        "rad": outside[:, turns].max(axis=1, initial=0.0),
        "m": outside[:, ~turns].max(axis=1, initial=0.0),
    }


def _hand_positions(robot: Robot, states: np.ndarray) -> np.ndarray:
    """Positions (m, 3) [m] of the end effector at states (m, n)."""
    return poses_along(robot, states)[1][:, :3, 3]


def _time(count: int) -> rr.TimeColumn:
    return rr.TimeColumn(TIMELINE, sequence=np.arange(count))


def _transform(T: np.ndarray) -> rr.Transform3D:
    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


def _rgba(colour: Colour, opacity: float = 1.0) -> list[int]:
    return [round(255 * part) for part in (*colour, opacity)]


def object_archetype(item: SceneObject) -> rr.AsComponents:
    """A scene object in its own frame; of a floor, only a square of its top."""
    if isinstance(item.shape, Box) and is_ground(item):
        x, y = np.minimum(0.5 * np.array(item.shape.size[:2]), GROUND_HALF_SIDE)
        corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
        top = np.array([(*corner, 0.5 * item.shape.size[2]) for corner in corners])
        return rr.Mesh3D(
            vertex_positions=top,
            triangle_indices=[(0, 1, 2), (0, 2, 3)],
            albedo_factor=_rgba(colour_of(item.name)),
        )
    return _archetype(item.shape, colour_of(item.name))


def _archetype(shape: Shape, colour: Colour, opacity: float = 1.0) -> rr.AsComponents:
    """A shape in its own frame."""
    rgba, solid = _rgba(colour, opacity), rr.components.FillMode.Solid
    match shape:
        case Box(size):
            return rr.Boxes3D(sizes=[size], colors=rgba, fill_mode=solid)
        case Cylinder(radius, height):
            return rr.Cylinders3D(lengths=[height], radii=[radius], colors=rgba, fill_mode=solid)
        case Sphere(radius):
            return rr.Ellipsoids3D(radii=[radius], colors=rgba, fill_mode=solid)
        case PointCloud(points, radius):
            return rr.Points3D(points, radii=radius, colors=rgba)
        case ConvexMesh(vertices):
            return mesh_archetype(hull_mesh(vertices), colour, opacity)


def mesh_archetype(mesh: Mesh, colour: Colour, opacity: float = 1.0) -> rr.Mesh3D:
    """Triangles in one colour."""
    return rr.Mesh3D(
        vertex_positions=mesh.corners.reshape(-1, 3),
        vertex_normals=mesh.normals.reshape(-1, 3),
        albedo_factor=_rgba(colour, opacity),
    )
