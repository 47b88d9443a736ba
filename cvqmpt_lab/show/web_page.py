"""One html file that shows a plan or a task in three dimensions, with a slider along it and plots
below.

It holds its own viewer (WebGL, `plan_page.html`), loads nothing and opens from a disk without a
network. Scenes of more than MOST_TRIANGLES are drawn with fewer, and the page says so.
"""

import json
import math
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.files import write_text
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.show.curves import BOUND_COLOUR, Plot, plots_along, tilt_plots
from cvqmpt_lab.show.marks import AXIS_COLOURS, CONSTRAINT_COLOUR, constraint_marks, hand_axes
from cvqmpt_lab.show.meshes import (
    GOAL_COLOUR,
    LOAD_COLOUR,
    ROBOT_COLOUR,
    TRACE_COLOUR,
    Colour,
    Mesh,
    Viewpoint,
    beads,
    colour_of,
    ground_height,
    hull_mesh,
    joined,
    poses_along,
    robot_meshes,
    shape_mesh,
    travelled_along,
)
from cvqmpt_lab.show.picture import HIDDEN, with_load
from cvqmpt_lab.show.stage import clear_viewpoint
from cvqmpt_lab.show.task_frames import moving_poses, piece_poses, solved_frames
from cvqmpt_lab.tasks.solve import TaskSolution

TEMPLATE = Path(__file__).with_name("plan_page.html")
PLACE = '<script type="application/json" id="data">{}</script>'  # of the data in the template
MOST_STATES = 400  # of a path; a longer one is shown at as many even places
MOST_TRIANGLES = 60_000  # 60 bytes each in the file
COARSE = 60  # triangles of an object that is never drawn with fewer
SECONDS = 6.0  # that a path is played in
FLOOR_SIDE = 5.0  # [m] shown of a floor
SIZE = (1100, 600)  # [pixels] for which the first viewpoint is chosen
PALETTE = ("#1f6fb4", "#d1662a", "#2e8b57", "#8a4fa3", "#b8336a", "#8c6d1f", "#3aa6a6", "#70757d")
STILL = np.eye(4)[None]


class Body(NamedTuple):
    """A mesh in one colour, and where it is at every state."""

    group: str  # in the legend, where it can be hidden
    mesh: Mesh
    colour: Colour
    poses: np.ndarray = STILL  # (m, 4, 4), or (1, 4, 4) of what stands still
    opacity: float = 1.0


@dataclass(frozen=True)
class Page:
    """What is shown."""

    title: str
    bodies: Sequence[Body]
    labels: Sequence[str]  # one a state, beside the slider
    viewpoint: Viewpoint
    seconds: float = SECONDS
    plots: Sequence[Plot] = ()
    lines: Sequence[str] = ()  # below the plots


def save_page(solution: Solution, path: Path, carried: Sequence[Attachment] = ()) -> list[str]:
    """Write a solution as one html file; what a reader should know of it. carried:
    as for `draw_solution`.
    """
    shown = solution.simplified.path if solution.simplified else None
    verdict = "solved and certified" if solution.solved else "not solved"
    return write_page(
        _page_of(solution.problem, shown, verdict, repr(solution).splitlines(), carried), path
    )


def path_html(
    problem: PlanningProblem, states: np.ndarray, verdict: str, carried: Sequence[Attachment] = ()
) -> str:
    """The same html of states (m, n) [rad or m] of a path that is known to solve a problem, with a
    verdict in words.
    """
    return _html(
        _page_of(problem, JointPath(states), verdict, repr(problem).splitlines(), carried)
    )[0]


def _page_of(
    problem: PlanningProblem,
    path: JointPath | None,
    verdict: str,
    lines: Sequence[str],
    carried: Sequence[Attachment],
) -> Page:
    """A problem with a path, or with none; lines: of text below the plots."""
    bare, problem = problem, with_load(problem, carried)
    states, plots = problem.start[None], []
    if path is not None:
        states = _few(path)
        plots = [*tilt_plots(problem, states), *plots_along(bare, states)]
    T_world_link, T_world_hand = poses_along(problem.robot, states)
    bodies = _scene(problem.scene)
    for part in problem.robot.links:
        poses = T_world_link[:, part.link] @ part.T_link_geometry
        bodies.append(Body("robot", hull_mesh(part.vertices), ROBOT_COLOUR, poses))
    for item in problem.attachments:
        bodies.append(
            Body(item.name, shape_mesh(item.shape), LOAD_COLOUR, T_world_hand @ item.T_hand_object)
        )
    end = problem.goals[:1] if path is None else states[-1:]
    for mesh in (mesh for q in end for mesh in robot_meshes(problem, q, GOAL_COLOUR)):
        bodies.append(Body("goal", mesh, GOAL_COLOUR, opacity=0.35))
    if path is not None:
        bodies.append(
            Body("path of the hand", beads(T_world_hand[:, :3, 3], TRACE_COLOUR), TRACE_COLOUR)
        )
    for mark in constraint_marks(problem, states):
        bodies.append(Body("constraint", mark, CONSTRAINT_COLOUR, opacity=0.35))
    axes = hand_axes(problem, states[0]).placed(np.linalg.inv(T_world_hand[0]), (1.0, 1.0, 1.0))
    for k, colour in enumerate(AXIS_COLOURS):
        bodies.append(Body("axes of the hand", _part(axes, axes.piece == k), colour, T_world_hand))
    seen = [joined(robot_meshes(problem, q, ROBOT_COLOUR)) for q in (states[0], states[-1])]
    still = [body.mesh for body in bodies if body.group == "scene"]
    return Page(
        f"{problem.name}: {problem.robot.name}, {verdict}",
        bodies,
        [
            f"state {k} of {len(states) - 1}, {way:.2f} rad"
            for k, way in enumerate(travelled_along(states))
        ],
        clear_viewpoint(seen, still, SIZE),
        plots=plots,
        lines=lines,
    )


def save_task_page(solution: TaskSolution, path: Path) -> list[str]:
    """Write a solved task as one html file, up to the phase that failed;
    what a reader should know of it.
    """
    shown = solved_frames(solution)
    scene, arm = solution.task.scene, shown[0].world.arm
    moving = moving_poses(scene.names, shown)
    bodies = _scene(scene.without(*moving))
    for name, poses in moving.items():
        bodies.append(Body("moved", shape_mesh(scene[name].shape), colour_of(name), poses))
    vertices = {part.name: part.vertices for part in arm.links}
    for name, poses in piece_poses(shown).items():
        bodies.append(Body("robot", hull_mesh(vertices[name]), ROBOT_COLOUR, poses))
    seen = [
        body.mesh.placed(body.poses[0], ROBOT_COLOUR) for body in bodies if body.group == "robot"
    ]
    still = [body.mesh for body in bodies if body.group == "scene"]
    labels = [f"{frame.phase}, {frame.time:.1f} s" for frame in shown]
    duration = max(shown[-1].time, 1.0)
    page = Page(
        f"task {solution.task.name}: "
        f"{'solved and certified' if solution.solved else solution.failure}",
        bodies,
        labels,
        clear_viewpoint([joined(seen)], still, SIZE),
        seconds=duration,
        lines=repr(solution).splitlines(),
    )
    return write_page(page, path)


def write_page(page: Page, path: Path | str) -> list[str]:
    """Write a page with few enough triangles; a line that says so where they were reduced."""
    html, note = _html(page)
    write_text(Path(path), html)
    return note


def _html(page: Page) -> tuple[str, list[str]]:
    """The text of a page, and a line that says so where triangles were reduced."""
    bodies, note = _reduced(page.bodies)
    offset = np.subtract(page.viewpoint.eye, page.viewpoint.target)
    distance = float(np.linalg.norm(offset))
    data = {
        "title": page.title,
        "lines": [*page.lines, *note],
        "states": len(page.labels),
        "labels": list(page.labels),
        "seconds": page.seconds,
        "camera": {
            "target": list(map(float, page.viewpoint.target)),
            "distance": distance,
            "azimuth": math.atan2(offset[1], offset[0]),
            "elevation": math.asin(offset[2] / distance),
            "angle": page.viewpoint.height_angle,
        },
        "bodies": [_body(body) for body in bodies],
        "plots": [_plot(plot) for plot in page.plots],
    }
    # else a name could end the script
    text = json.dumps(data, allow_nan=False).replace("</", "<\\/")
    return TEMPLATE.read_text(encoding="utf-8").replace(PLACE, PLACE.replace("{}", text)), note


def _few(path: JointPath) -> np.ndarray:
    """The path's states (m, n), or as many even ones as are shown."""
    return (
        path.states
        if len(path.states) <= MOST_STATES
        else path.spaced(path.length / (MOST_STATES - 1))
    )


def _scene(scene: Scene) -> list[Body]:
    """The scene's objects as pictures show them, and a part of the floor."""
    found = [
        Body(
            "scene",
            shape_mesh(item.shape).placed(item.T_world_object, (1.0, 1.0, 1.0)),
            colour_of(item.name),
        )
        for item in scene
        if item.obstacle and item.name not in HIDDEN
    ]
    height = ground_height(scene)
    if height is not None:
        floor = shape_mesh(Box((FLOOR_SIDE, FLOOR_SIDE, 0.02)))
        found.append(
            Body("floor", floor, colour_of("floor"), pose((0.0, 0.0, height - 0.01))[None])
        )
    return found


def _part(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """The triangles that are chosen (f,)."""
    return Mesh(
        mesh.corners[chosen], mesh.normals[chosen], mesh.colours[chosen], mesh.piece[chosen]
    )


def _reduced(bodies: Sequence[Body]) -> tuple[list[Body], list[str]]:
    """Bodies with about MOST_TRIANGLES at most, of the scene's finer ones the same share;
    what was done to them.
    """
    counts = [len(body.mesh.corners) for body in bodies]
    fine = [
        body.group == "scene" and count > COARSE for body, count in zip(bodies, counts, strict=True)
    ]
    finer = sum(count for count, is_fine in zip(counts, fine, strict=True) if is_fine)
    share = (MOST_TRIANGLES - (sum(counts) - finer)) / max(finer, 1)
    if share >= 1.0:
        return list(bodies), []
    found = [
        body._replace(mesh=_with_fewer(body.mesh, max(COARSE, int(share * count))))
        if is_fine
        else body
        for body, count, is_fine in zip(bodies, counts, fine, strict=True)
    ]
    left = sum(len(body.mesh.corners) for body in found)
    return found, [
        f"drawn with {left} of {sum(counts)} triangles: close corners of the scene are merged"
    ]


def _with_fewer(mesh: Mesh, most: int) -> Mesh:
    """A mesh of at most so many triangles, with the finest grid of a few that leaves no more."""
    cells = 2.0 * math.sqrt(most)  # along it; a closed surface has some 10 n^2 of n along it
    cell, found = float(np.ptp(mesh.corners, axis=(0, 1)).max()) / cells, mesh
    while len(found.corners) > most:
        found, cell = clustered(mesh, cell), 1.3 * cell
    return found


def clustered(mesh: Mesh, cell: float) -> Mesh:
    """A mesh whose corners in one cell of a grid with edges of `cell` [m] are their mean;
    triangles without area go.
    """
    corners = mesh.corners.reshape(-1, 3)
    which = np.unique(_numbered(np.floor(corners / cell).astype(np.int64)), return_inverse=True)[1]
    sums = np.stack([np.bincount(which, axis) for axis in corners.T], axis=1)
    merged = (sums / np.bincount(which)[:, None])[which].reshape(-1, 3, 3)
    ends = np.sort(which.reshape(-1, 3), axis=1)
    first = np.unique(_numbered(ends), return_index=True)[1]
    wide = first[(np.diff(ends[first], axis=1) > 0).all(axis=1)]
    return replace(_part(mesh, wide), corners=merged[wide])


def _numbered(rows: np.ndarray) -> np.ndarray:
    """A number (m,) for each row (m, 3) of whole numbers, the same for the same rows;
    sorted ten times as fast.
    """
    rows = rows - rows.min(axis=0)
    x, y, z = rows.T
    return (x * (rows[:, 1].max() + 1) + y) * (rows[:, 2].max() + 1) + z


def _body(body: Body) -> dict[str, Any]:
    poses = body.poses[:, :3].reshape(len(body.poses), 12)
    return {
        "group": body.group.replace("_", " "),
        "colour": list(map(float, body.colour)),
        "opacity": body.opacity,
        "positions": _text(body.mesh.corners.astype("<f4")),
        "normals": _text(np.round(127 * body.mesh.normals).astype(np.int8)),
        "poses": _text(poses.astype("<f4")),
    }


def _text(array: np.ndarray) -> str:
    return b64encode(array.tobytes()).decode()


def _plot(plot: Plot) -> dict[str, Any]:
    low, high = plot.extremes
    room = 0.08 * max(high - low, 1e-3)
    curves = [
        {
            "name": name,
            "values": [float(f"{x:.6g}") if math.isfinite(x) else None for x in curve.values],
            "colour": _css(curve.colour) if curve.colour else PALETTE[k % len(PALETTE)],
            "width": curve.width,
            "bound": curve.colour == BOUND_COLOUR,
        }
        for k, (name, curve) in enumerate(plot.curves.items())
    ]
    return {"title": plot.title, "curves": curves, "low": low - room, "high": high + room}


def _css(colour: Colour) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour)
