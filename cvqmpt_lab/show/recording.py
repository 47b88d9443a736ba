"""Recordings of solutions and tasks for rerun. The only module that imports rerun.

Entities of a solution: ``world/scene``, ``world/start``, ``world/goals``, ``world/path``,
``world/robot``, ``trees`` and ``plots``; timeline "path_state" counts states of the path,
"vertices" those of the growing trees. Of a task: ``world/scene``, ``world/moving`` (doors, carried
objects), ``world/robot`` and ``phase``; timeline "task_time" [s].
"""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import replacing
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import (
    Box,
    ConvexMesh,
    Cylinder,
    OccupancyMap,
    PointCloud,
    Shape,
    Sphere,
)
from cvqmpt_lab.search.result import JointPath, Tree
from cvqmpt_lab.show.curves import Plot, plots_along
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
    map_boxes,
    poses_along,
)
from cvqmpt_lab.show.picture import with_load
from cvqmpt_lab.show.task_frames import Frame, moving_poses, piece_poses, solved_frames
from cvqmpt_lab.show.viewer import check_viewer, open_viewer
from cvqmpt_lab.tasks.solve import TaskSolution

TIMELINE = "path_state"
GROWTH = "vertices"
TASK_TIMELINE = "task_time"
GROWTH_STEPS = 60  # in which trees grow
GOALS_SHOWN = 3
GHOST_OPACITY = 0.35
GROUND_HALF_SIDE = 2.5  # [m] shown of a floor, around its middle
RAW_COLOUR: Colour = (0.55, 0.55, 0.58)
TREE_COLOURS: tuple[Colour, ...] = (GHOST_COLOUR, GOAL_COLOUR)


def log_solution(
    solution: Solution,
    save: Path | None = None,
    view: bool = False,
    carried: Sequence[Attachment] = (),
) -> None:
    """Write a solution to a .rrd file, show it in the rerun viewer, or both; carried:
    as for `draw_solution`.
    """
    if save is None and not view:
        raise InvalidInputError(
            "nothing to do with the recording: give save=<file.rrd>, view=True or both"
        )
    if view:
        check_viewer()
    path = (
        Path(save)
        if save is not None
        else Path(tempfile.mkdtemp(prefix="cvqmpt-")) / "solution.rrd"
    )
    problem = with_load(solution.problem, carried)
    states = None if solution.simplified is None else solution.simplified.path.states
    plots = () if states is None else plots_along(solution.problem, states)
    save_recording(
        path,
        _blueprint(plots),
        lambda recording: _log_everything(recording, solution, problem, plots),
    )
    if view:
        open_viewer(path)


def save_recording(
    path: Path, blueprint: rrb.Blueprint, log: Callable[[rr.RecordingStream], None]
) -> None:
    """Log to a file, which is there only when it is complete."""
    recording = rr.RecordingStream("cvqmpt_lab")
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    try:
        with replacing(path) as temporary:
            recording.save(temporary, default_blueprint=blueprint)
            log(recording)
            recording.flush()
            recording.disconnect()
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(
            f"cannot write recording {path}: {reason}; name a file in a folder that exists"
        ) from error


def _blueprint(plots: Sequence[Plot]) -> rrb.Blueprint:
    """The world and the trees on the left, the plots on the right, timelines below."""
    eye = rrb.EyeControls3D(
        position=(-1.7, -2.0, 1.75), look_target=(0.4, -0.1, 0.5), eye_up=(0.0, 0.0, 1.0)
    )
    world = rrb.Spatial3DView(
        origin="/", contents="world/**", name="motion (timeline path_state)", eye_controls=eye
    )
    still = ["world/scene/**", "world/start/**", "world/goals/**", "trees/**"]
    trees = rrb.Spatial3DView(
        origin="/", contents=still, name="trees (timeline vertices)", eye_controls=eye
    )
    views = [
        rrb.TimeSeriesView(
            origin=f"plots/{plot.name}",
            name=plot.title,
            axis_y=rrb.ScalarAxis(range=plot.range),
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
        )
        for plot in plots
    ]
    left = rrb.Tabs(world, trees, active_tab=0)
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*views), column_shares=[2, 1]) if views else left,
        rrb.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )


def _log_everything(
    recording: rr.RecordingStream,
    solution: Solution,
    problem: PlanningProblem,
    plots: Sequence[Plot],
) -> None:
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    log_scene(recording, problem.scene)
    log_ghosts(recording, problem)
    log_growth(recording, problem.robot, solution.plan.trees)
    if solution.plan.path is not None:
        log_path(recording, "raw", problem.robot, solution.plan.path, RAW_COLOUR, 0.002)
    if solution.simplified is not None:
        log_path(
            recording, "simplified", problem.robot, solution.simplified.path, TRACE_COLOUR, 0.005
        )
        log_motion(recording, problem, solution.simplified.path.states)
    for plot in plots:
        log_plot(recording, plot)


def log_scene(recording: rr.RecordingStream, scene: Scene) -> None:
    """The scene's objects by name; "a/b" becomes entity b below a."""
    for item in scene:
        entity = rr.new_entity_path(["world", "scene", *item.name.split("/")])
        recording.log(entity, _transform(item.T_world_object), object_archetype(item), static=True)


def log_ghosts(recording: rr.RecordingStream, problem: PlanningProblem) -> None:
    """The robot at the start and at the first goals, translucent."""
    ghosts = {"world/start": (problem.start, ROBOT_COLOUR)}
    ghosts |= {
        f"world/goals/{k}": (goal, GOAL_COLOUR)
        for k, goal in enumerate(problem.goals[:GOALS_SHOWN])
    }
    for entity, (q, colour) in ghosts.items():
        log_robot(recording, entity, problem, colour, GHOST_OPACITY)
        for link, T_world_link in enumerate(poses_along(problem.robot, q[None])[0][0]):
            recording.log(f"{entity}/{link}", _transform(T_world_link), static=True)


def log_robot(
    recording: rr.RecordingStream,
    entity: str,
    problem: PlanningProblem,
    colour: Colour,
    opacity: float = 1.0,
) -> None:
    """The robot's hulls and what it carries, each below ``entity/<pose row>``;
    links are posed elsewhere.
    """
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


def log_growth(recording: rr.RecordingStream, robot: Robot, trees: tuple[Tree, ...]) -> None:
    """Hand positions of the trees' nodes and the edges between them, in steps as they grow."""
    for k, tree in enumerate(trees):
        if len(tree.nodes) == 0:
            continue
        colour = _rgba(TREE_COLOURS[k % len(TREE_COLOURS)])
        hand = _hand_positions(robot, tree.nodes)
        for step, added in enumerate(
            np.array_split(np.arange(len(hand)), min(GROWTH_STEPS, len(hand)))
        ):
            child = added[tree.parent[added] >= 0]
            edges = np.stack([hand[child], hand[tree.parent[child]]], axis=1)
            recording.set_time(GROWTH, sequence=int(added[-1]) + 1)
            recording.log(
                f"trees/{k}/nodes/{step}", rr.Points3D(hand[added], radii=0.003, colors=colour)
            )
            recording.log(
                f"trees/{k}/edges/{step}", rr.LineStrips3D(edges, radii=0.0008, colors=colour)
            )
    recording.reset_time()


def log_path(
    recording: rr.RecordingStream,
    name: str,
    robot: Robot,
    path: JointPath,
    colour: Colour,
    radius: float,
) -> None:
    """The hand's trace along a path, a line of the given radius [m]."""
    line = rr.LineStrips3D(
        [_hand_positions(robot, path.states)], radii=radius, colors=_rgba(colour)
    )
    recording.log(f"world/path/{name}", line, static=True)


def log_motion(recording: rr.RecordingStream, problem: PlanningProblem, states: np.ndarray) -> None:
    """The robot moving through states (m, n) along the timeline."""
    log_robot(recording, "world/robot", problem, ROBOT_COLOUR)
    T_world_link, _ = poses_along(problem.robot, states)
    for link in range(T_world_link.shape[1]):
        _send_poses(recording, f"world/robot/{link}", _time(len(states)), T_world_link[:, link])


def log_plot(recording: rr.RecordingStream, plot: Plot) -> None:
    """A plot's curves."""
    for name, curve in plot.curves.items():
        entity = f"plots/{plot.name}/{name.replace(' ', '_')}"
        colour = None if curve.colour is None else _rgba(curve.colour)
        recording.log(
            entity, rr.SeriesLines(names=name, colors=colour, widths=curve.width), static=True
        )
        columns = rr.Scalars.columns(scalars=curve.values)
        recording.send_columns(entity, [_time(len(curve.values))], columns)


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
        case OccupancyMap():
            centres, edges = map_boxes(shape)
            return rr.Boxes3D(centers=centres, sizes=edges, colors=rgba, fill_mode=solid)
        case ConvexMesh(vertices):
            return mesh_archetype(hull_mesh(vertices), colour, opacity)


def mesh_archetype(mesh: Mesh, colour: Colour, opacity: float = 1.0) -> rr.Mesh3D:
    """Triangles in one colour."""
    return rr.Mesh3D(
        vertex_positions=mesh.corners.reshape(-1, 3),
        vertex_normals=mesh.normals.reshape(-1, 3),
        albedo_factor=_rgba(colour, opacity),
    )


def log_task(solution: TaskSolution, save: Path) -> None:
    """Write a task to a .rrd file."""
    shown = solved_frames(solution)
    eye = rrb.EyeControls3D(
        position=(-1.35, -1.75, 1.55), look_target=(0.3, -0.2, 0.5), eye_up=(0, 0, 1)
    )
    blueprint = rrb.Blueprint(
        rrb.Spatial3DView(origin="world", name="world", eye_controls=eye),
        rrb.TimePanel(timeline=TASK_TIMELINE),
        collapse_panels=True,
    )
    save_recording(Path(save), blueprint, lambda recording: _log_task(recording, solution, shown))


def _log_task(recording: rr.RecordingStream, solution: TaskSolution, shown: list[Frame]) -> None:
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    first = solution.task.scene
    moving = moving_poses(first.names, shown)
    log_scene(recording, first.without(*moving))
    times = np.array([frame.time for frame in shown])
    timeline = rr.TimeColumn(TASK_TIMELINE, duration=times)
    for name, poses in moving.items():
        entity = rr.new_entity_path(["world", "moving", *name.split("/")])
        recording.log(entity, object_archetype(first[name]), static=True)
        _send_poses(recording, entity, timeline, poses)
    for piece, poses in piece_poses(shown).items():
        entity = rr.new_entity_path(["world", "robot", piece])
        vertices = next(part.vertices for part in shown[0].world.arm.links if part.name == piece)
        recording.log(entity, mesh_archetype(hull_mesh(vertices), ROBOT_COLOUR), static=True)
        _send_poses(recording, entity, timeline, poses)
    names = [frame.phase for frame in shown]
    for k, name in enumerate(names):
        if k == 0 or name != names[k - 1]:
            recording.set_time(TASK_TIMELINE, duration=times[k])
            recording.log("phase", rr.TextLog(name))


def _send_poses(
    recording: rr.RecordingStream, entity: str, time: rr.TimeColumn, poses: np.ndarray
) -> None:
    """Poses (k, 4, 4) of an entity at k times."""
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], mat3x3=poses[:, :3, :3])
    recording.send_columns(entity, [time], columns)
