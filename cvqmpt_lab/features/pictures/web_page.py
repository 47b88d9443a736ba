"""Html page that shows a solution or a task in 3-D, with a time slider and plots.

It is one file that contains its own viewer (WebGL, `plan_page.html`) and needs no network.
"""

import json
import math
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cvqmpt_lab.base.files import write_text
from cvqmpt_lab.features.pictures.bodies import (
    Drawing,
    drawing_of_problem,
    drawing_of_solution,
    mesh_in_view,
    mesh_of,
)
from cvqmpt_lab.features.pictures.curves import Plot
from cvqmpt_lab.features.pictures.meshes import Mesh, shape_mesh
from cvqmpt_lab.features.pictures.raster import Viewpoint, clear_viewpoint
from cvqmpt_lab.features.tasks.solve import TaskSolution
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import JointPath

if TYPE_CHECKING:
    from cvqmpt_lab.features.motion.trajectory import Trajectory

PAGE_TEMPLATE = Path(__file__).with_name("plan_page.html")
# element of the template; {} is replaced by the data
PAGE_DATA_ELEMENT = '<script type="application/json" id="data">{}</script>'

# colours of curves, and of their bounds
PALETTE = (
    "#1f6fb4", "#d1662a", "#2e8b57", "#8a4fa3", "#b8336a", "#8c6d1f", "#3aa6a6", "#70757d",
)  # fmt: skip
BOUND_COLOUR = "#cc3333"


def save_page(
    solution: Solution | TaskSolution,
    path: Path | str,
    carried: Sequence[Attachment] = (),
    most_states: int = 400,
    motion: "Trajectory | None" = None,
    name: str = "",
) -> None:
    """Write a solution or a task as one html file; a task is shown up to the phase that failed.

    Args:
        solution: a solution of a problem or task.
        path: the file to write.
        carried: objects drawn in the hand if the problem has no attachments.
        most_states: a path of more states is resampled to this number, at equal distances.
        motion: motion along the path of a problem, shown over its seconds; None: the path.
        name: first words of the title; "": the name of the problem or task.
    """
    if motion is not None and isinstance(solution, Solution):
        # a tenth of a second between states, or longer
        sampled = motion.sampled(max(0.1, motion.duration / (most_states - 1)))
        drawing = drawing_of_solution(
            solution, carried, plots=True, path=JointPath(sampled.positions)
        )
        drawing = replace(drawing, times=sampled.times)
    else:
        drawing = drawing_of_solution(solution, carried, most_states, plots=True)
    if name:
        drawing = replace(drawing, title=f"{name}: {drawing.title.partition(': ')[2]}")
    write_text(Path(path), _html(drawing))


def path_html(
    problem: PlanningProblem,
    states: np.ndarray,
    verdict: str,
    carried: Sequence[Attachment] = (),
    most_states: int = 400,
    times: np.ndarray | None = None,
    lines: Sequence[str] = (),
) -> str:
    """Text of an html page, as `save_page` writes it, for a path or the states of a motion.

    Args:
        problem: the problem that the path solves.
        states: states (m, n) of the path [rad or m].
        verdict: last part of the title, e.g. "certified path of birrt".
        carried: objects drawn in the hand if the problem has no attachments.
        most_states: a path of more states is resampled to this number, at equal distances.
        times: (m,) of at most `most_states` states, evenly [s]; None: a path has none.
        lines: text below the drawing; empty: the problem's text.
    """
    drawing = drawing_of_problem(
        problem,
        JointPath(states),
        carried,
        most_states,
        plots=True,
        verdict=verdict,
        lines=lines or repr(problem).splitlines(),
    )
    return _html(drawing if times is None else replace(drawing, times=times))


def _html(drawing: Drawing) -> str:
    """Text of the html page."""
    # "<" is escaped, because "</script>" in a name would end the script element
    text = json.dumps(page_data(drawing), allow_nan=False).replace("<", "\\u003c")
    page = PAGE_TEMPLATE.read_text(encoding="utf-8")
    return page.replace(PAGE_DATA_ELEMENT, PAGE_DATA_ELEMENT.replace("{}", text))


def page_data(
    drawing: Drawing,
    size: tuple[int, int] = (940, 720),
    layers: Sequence[str] = ("start", "goals", "path", "constraint", "hand"),
) -> dict[str, Any]:
    """Return what the page's viewer reads, as plain data.

    Args:
        drawing: the drawing.
        size: width and height [pixels] for which the initial viewpoint is chosen.
        layers: what is drawn beside robot and scene.
    """
    viewpoint = _viewpoint(drawing, size)
    bodies = [*drawing.scene, *drawing.moving]
    for layer in drawing.layers(*layers).values():
        bodies += layer
    square = shape_mesh(Box((40.0, 40.0, 1e-3)))
    meshes = list(dict.fromkeys((square, *(body.mesh for body in bodies))))
    offset = np.subtract(viewpoint.eye, viewpoint.target)
    distance = float(np.linalg.norm(offset))
    times = drawing.times
    return {
        "title": drawing.title,
        "lines": list(drawing.lines),
        "unseen": list(drawing.unseen),
        "states": len(drawing.labels),
        "labels": _labels(drawing),
        "times": None if times is None else [round(float(t), 4) for t in times],
        # duration of the animation [s]
        "seconds": 6.0 if times is None else max(float(np.ptp(times)), 1.0),
        "camera": {
            "target": list(map(float, viewpoint.target)),
            "distance": distance,
            "azimuth": math.atan2(offset[1], offset[0]),
            "elevation": math.asin(offset[2] / distance),
            "angle": viewpoint.height_angle,
            "aspect": size[0] / size[1],
        },
        "ground": drawing.under,
        "square": 0,  # index of the mesh of the ground
        "box": _shadowed(drawing),
        "meshes": [_mesh(mesh) for mesh in meshes],
        "bodies": [
            {
                "group": body.group,
                "layer": body.layer.split("/")[0],
                "colour": [round(float(part), 4) for part in body.colour],
                "opacity": body.opacity,
                "mesh": meshes.index(body.mesh),
                "poses": _base64(body.poses[:, :3].astype("<f4")),
            }
            for body in bodies
        ],
        "plots": [_plot(plot) for plot in drawing.plots],
    }


def _viewpoint(drawing: Drawing, size: tuple[int, int]) -> Viewpoint:
    """Viewpoint that shows the robot at the start of a timed motion, or at both ends of a path.

    The whole motion is in the picture, tested at about ten states.
    """
    count = len(drawing.labels)
    ends = (0,) if drawing.times is not None else (0, count - 1)
    robot = [body for body in drawing.moving if body.layer == "robot"]
    views = [mesh_in_view(robot, k) for k in ends]
    inside = [mesh_in_view(drawing.moving, k) for k in range(0, count, max(1, count // 10))]
    torso = mesh_of(body for body in robot if body.torso)
    return clear_viewpoint(views, mesh_of(drawing.scene), size, inside, torso)


def _labels(drawing: Drawing) -> list[str]:
    """Text beside the slider at each state: seconds where the motion is timed."""
    if drawing.times is None:
        return list(drawing.labels)
    end = drawing.times[-1]
    names = (f", {name}" if not name.startswith("state ") else "" for name in drawing.labels)
    times = drawing.times.tolist()
    return [f"{t:.1f} of {end:.1f} s{name}" for t, name in zip(times, names, strict=True)]


def _shadowed(drawing: Drawing) -> dict[str, Any]:
    """Ball in which bodies cast shadows: around scene and robot, at most 2.6 m in radius."""
    corners = mesh_of([*drawing.scene, *drawing.moving]).corners
    robot = mesh_of(drawing.moving).corners
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    middle = 0.5 * (robot.min(axis=(0, 1)) + robot.max(axis=(0, 1)))
    away = np.maximum(high - middle, middle - low)
    return {"middle": middle.tolist(), "radius": min(float(np.linalg.norm(away)), 2.6)}


def _mesh(mesh: Mesh) -> dict[str, Any]:
    """Mesh as plain data for json: positions as shares of its box, in 16 bits."""
    points, normals, faces = mesh.shared
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 1e-9)
    wide = len(points) > 65_535
    return {
        "low": [float(f"{x:.7g}") for x in low],
        "size": [float(f"{x:.7g}") for x in size],
        "positions": _base64(np.round(65_535 * (points - low) / size).astype("<u2")),
        "normals": _base64(np.round(127 * normals).astype(np.int8)),
        "faces": _base64(faces.astype("<u4" if wide else "<u2")),
        "wide": wide,  # whether indices have 32 bits
    }


def _base64(array: np.ndarray) -> str:
    """Base64 text of an array's bytes."""
    return b64encode(array.tobytes()).decode()


def _plot(plot: Plot) -> dict[str, Any]:
    """Plot as plain data for json; bounds are red, and numbers that are not finite become null."""
    low, high = plot.extremes
    margin = 0.08 * max(high - low, 1e-3)
    bottom = low if plot.from_zero and low == 0.0 else low - margin
    curves = []
    for k, (name, values) in enumerate(plot.lines.items()):
        bound = name in plot.bounds
        curves.append(
            {
                "name": name,
                "values": [float(f"{x:.6g}") if math.isfinite(x) else None for x in values],
                "colour": BOUND_COLOUR if bound else PALETTE[k % len(PALETTE)],
                "width": 1.0 if bound else plot.width,
                "bound": bound,
            }
        )
    return {"title": plot.title, "curves": curves, "low": bottom, "high": high + margin}
