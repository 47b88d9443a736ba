"""One html file that shows a plan or task in 3-D, with a time slider and plots.

It contains its viewer (WebGL, `plan_page.html`) and works without a network.
"""

import json
import math
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.files import write_text
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.show.bodies import Body, Seen, seen_of_problem, seen_of_solution, whole
from cvqmpt_lab.show.curves import Plot
from cvqmpt_lab.show.raster import clear_viewpoint
from cvqmpt_lab.tasks.solve import TaskSolution

TEMPLATE = Path(__file__).with_name("plan_page.html")
PLACE = '<script type="application/json" id="data">{}</script>'  # of the data in the template


def save_page(
    solution: Solution | TaskSolution,
    path: Path,
    carried: Sequence[Attachment] = (),
    most_states: int = 400,
) -> None:
    """Write a solution or a task, up to the phase that failed, as one html file.

    Args:
        solution: what is shown.
        path: of the file.
        carried: load in the hand if the problem does not model it.
        most_states: a longer path is shown at as many even places.
    """
    write_text(path, _html(seen_of_solution(solution, carried, most_states, plots=True)))


def path_html(
    problem: PlanningProblem,
    states: np.ndarray,
    verdict: str,
    carried: Sequence[Attachment] = (),
    most_states: int = 400,
) -> str:
    """The same page for a valid path of states (m, n) [rad or m], with a verdict in words."""
    seen = seen_of_problem(
        problem,
        JointPath(states),
        carried,
        most_states,
        plots=True,
        verdict=verdict,
        lines=repr(problem).splitlines(),
    )
    return _html(seen)


def _html(seen: Seen, size: tuple[int, int] = (1100, 600)) -> str:
    """Text of a page with a first view of `size` [pixels]."""
    ends = (0,) if seen.times is not None else (0, len(seen.labels) - 1)
    robot = [body for body in seen.moving if body.layer == "robot"]
    viewpoint = clear_viewpoint([whole(robot, k) for k in ends], whole(seen.scene), size)
    bodies = seen.bodies("goals", "path", "constraint", "hand")
    offset = np.subtract(viewpoint.eye, viewpoint.target)
    distance = float(np.linalg.norm(offset))
    labels = list(seen.labels)
    if seen.times is not None:
        labels = [f"{name}, {t:.1f} s" for name, t in zip(labels, seen.times, strict=True)]
    data = {
        "title": seen.title,
        "lines": list(seen.lines),
        "states": len(labels),
        "labels": labels,
        "seconds": 6.0 if seen.times is None else max(float(seen.times[-1]), 1.0),
        "camera": {
            "target": list(map(float, viewpoint.target)),
            "distance": distance,
            "azimuth": math.atan2(offset[1], offset[0]),
            "elevation": math.asin(offset[2] / distance),
            "angle": viewpoint.height_angle,
        },
        "bodies": [_body(body) for body in bodies],
        "plots": [_plot(plot) for plot in seen.plots],
    }
    # else a name could end the script, or begin another in it
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    return TEMPLATE.read_text(encoding="utf-8").replace(PLACE, PLACE.replace("{}", text))


def _body(body: Body) -> dict[str, Any]:
    poses = body.poses[:, :3].reshape(len(body.poses), 12)
    return {
        "group": body.group,
        "colour": list(map(float, body.colour)),
        "opacity": body.opacity,
        "positions": _text(body.mesh.corners.astype("<f4")),
        "normals": _text(np.round(127 * body.mesh.normals).astype(np.int8)),
        "poses": _text(poses.astype("<f4")),
    }


def _text(array: np.ndarray) -> str:
    return b64encode(array.tobytes()).decode()


def _plot(
    plot: Plot,
    palette: Sequence[str] = (
        "#1f6fb4", "#d1662a", "#2e8b57", "#8a4fa3", "#b8336a", "#8c6d1f", "#3aa6a6", "#70757d",
    ),
) -> dict[str, Any]:  # fmt: skip
    low, high = plot.extremes
    room = 0.08 * max(high - low, 1e-3)
    curves = []
    for k, (name, values) in enumerate(plot.lines.items()):
        bound = name in plot.bounds
        curves.append(
            {
                "name": name,
                "values": [float(f"{x:.6g}") if math.isfinite(x) else None for x in values],
                "colour": "#cc3333" if bound else palette[k % len(palette)],
                "width": 1.0 if bound else plot.width,
                "bound": bound,
            }
        )
    return {"title": plot.title, "curves": curves, "low": low - room, "high": high + room}
