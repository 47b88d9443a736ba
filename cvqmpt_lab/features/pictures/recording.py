"""Recordings of solutions and tasks for rerun. The only module that imports rerun.

All recordings have the entities `world/scene`, `world/robot` and `plots`. A task also has
`world/moving` (doors, carried objects) and `phase`; a solution has `world/start`, `world/goals`,
`world/path`, `world/constraint` and `trees`. Timelines: "path_state" is the index of a state of the
path, "vertices" the number of vertices of a growing tree, "task_time" the time [s].
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import replacing
from cvqmpt_lab.features.pictures.bodies import BODY_COLOURS, Body, Drawing, drawing_of_solution
from cvqmpt_lab.features.pictures.meshes import Colour
from cvqmpt_lab.features.pictures.raster import Viewpoint
from cvqmpt_lab.features.tasks.solve import TaskSolution
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.scene.scene import Attachment


def log_solution(
    solution: Solution | TaskSolution, path: Path, carried: Sequence[Attachment] = ()
) -> None:
    """Write a solution or a task to a .rrd file.

    Args:
        solution: a solution of a problem or task.
        path: the file to write.
        carried: objects drawn in the hand if the problem has no attachments.
    """
    drawing = drawing_of_solution(solution, carried, plots=True, goals=3, hidden=())
    package = __name__.partition(".")[0]
    recording = rr.RecordingStream(package)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    try:
        with replacing(path) as temporary:
            recording.save(temporary, default_blueprint=_blueprint(drawing))
            _log_drawing(recording, drawing)
            if isinstance(solution, Solution):
                _log_search(recording, solution)
            recording.flush()
            recording.disconnect()
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(
            f"cannot write recording {path}: {reason}; name a file in a folder that exists"
        ) from error


def _blueprint(drawing: Drawing) -> rrb.Blueprint:
    """Layout: the world and the trees on the left, the plots on the right, timelines below."""
    usual = Viewpoint()
    eye = rrb.EyeControls3D(position=usual.eye, look_target=usual.target, eye_up=(0.0, 0.0, 1.0))
    timeline = "path_state" if drawing.times is None else "task_time"
    views = [
        rrb.Spatial3DView(
            origin="/", contents="world/**", name=f"motion (timeline {timeline})", eye_controls=eye
        )
    ]
    if drawing.times is None:
        still = ["world/scene/**", "world/start/**", "world/goals/**", "trees/**"]
        name = "trees (timeline vertices)"
        views.append(rrb.Spatial3DView(origin="/", contents=still, name=name, eye_controls=eye))
    plots = []
    for plot in drawing.plots:
        low, high = plot.extremes
        height = max(high - low, 1e-3)
        span = low - 0.05 * height, high + 0.45 * height  # the legend is above the curves
        plots.append(
            rrb.TimeSeriesView(
                origin=f"plots/{plot.name}",
                name=plot.title,
                axis_y=rrb.ScalarAxis(range=span),
                plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
            )
        )
    left = rrb.Tabs(*views, active_tab=0)
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*plots), column_shares=[2, 1]) if plots else left,
        rrb.TimePanel(timeline=timeline),
        collapse_panels=True,
    )


def _log_drawing(recording: rr.RecordingStream, drawing: Drawing) -> None:
    """Log bodies, phases of a task, and plots."""
    if drawing.times is None:
        time = rr.TimeColumn("path_state", sequence=np.arange(len(drawing.labels)))
    else:
        time = rr.TimeColumn("task_time", duration=drawing.times)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for body in drawing.bodies("start", "goals", "path", "constraint", "hand"):
        _log_body(recording, body, time)
    for k, name in enumerate(drawing.labels):
        if drawing.times is not None and (k == 0 or name != drawing.labels[k - 1]):
            recording.set_time("task_time", duration=drawing.times[k])
            recording.log("phase", rr.TextLog(name))
    recording.reset_time()
    for plot in drawing.plots:
        for name, values in plot.lines.items():
            entity = f"plots/{plot.name}/{name.replace(' ', '_')}"
            style: dict[str, Any] = {"widths": plot.width}
            if name in plot.bounds:
                style = {"widths": 1.0, "colors": [204, 51, 51, 255]}
            recording.log(entity, rr.SeriesLines(names=name, **style), static=True)
            recording.send_columns(entity, [time], rr.Scalars.columns(scalars=values))


def _log_body(recording: rr.RecordingStream, body: Body, time: rr.TimeColumn) -> None:
    """Log a body as an entity below `world/<its layer>`; "a/b" becomes entity b below a."""
    entity = rr.new_entity_path(["world", *body.layer.split("/"), *body.name.split("/")])
    mesh = rr.Mesh3D(
        vertex_positions=body.mesh.corners.reshape(-1, 3),
        vertex_normals=body.mesh.normals.reshape(-1, 3),
        albedo_factor=_rgba(body.colour, body.opacity),
    )
    recording.log(entity, mesh, static=True)
    turns, shifts = body.poses[:, :3, :3], body.poses[:, :3, 3]
    if len(body.poses) > 1:
        columns = rr.Transform3D.columns(translation=shifts, mat3x3=turns)
        recording.send_columns(entity, [time], columns)
    else:
        still = rr.Transform3D(translation=shifts[0], mat3x3=turns[0])
        recording.log(entity, still, static=True)


def _log_search(recording: rr.RecordingStream, solution: Solution, steps: int = 60) -> None:
    """Log the hand's path before shortening, and the growing trees in a number of steps."""
    robot = solution.problem.robot
    for k, tree in enumerate(solution.plan.trees):
        hand = robot.poses(tree.nodes)[:, :3, 3]
        colour = _rgba(BODY_COLOURS["ghost" if k % 2 == 0 else "goal"])
        for step, added in enumerate(np.array_split(np.arange(len(hand)), min(steps, len(hand)))):
            child = added[tree.parent[added] >= 0]
            edges = np.stack([hand[child], hand[tree.parent[child]]], axis=1)
            recording.set_time("vertices", sequence=int(added[-1]) + 1)
            nodes = rr.Points3D(hand[added], radii=0.003, colors=colour)
            recording.log(f"trees/{k}/nodes/{step}", nodes)
            lines = rr.LineStrips3D(edges, radii=0.0008, colors=colour)
            recording.log(f"trees/{k}/edges/{step}", lines)
    recording.reset_time()
    if solution.plan.path is not None:
        hand = robot.poses(solution.plan.path.states)[:, :3, 3]
        line = rr.LineStrips3D([hand], radii=0.002, colors=_rgba((0.55, 0.55, 0.58)))
        recording.log("world/path/raw", line, static=True)


def _rgba(colour: Colour, opacity: float = 1.0) -> list[int]:
    """Red, green, blue and opacity from 0 to 255."""
    return [round(255 * part) for part in (*colour, opacity)]
