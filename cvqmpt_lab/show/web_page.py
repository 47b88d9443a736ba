"""One html file that shows a solution or a task in 3-D, with a time slider and plots.

The file contains its own viewer (WebGL, `plan_page.html`) and needs no network.
"""

import json
import math
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.files import write_text
from cvqmpt_lab.planning.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.show.bodies import Seen, in_view, seen_of_problem, seen_of_solution, whole
from cvqmpt_lab.show.curves import Plot
from cvqmpt_lab.show.raster import clear_viewpoint
from cvqmpt_lab.tasks.solve import TaskSolution

TEMPLATE = Path(__file__).with_name("plan_page.html")
# the element of the template that receives the data in place of {}
PLACE = '<script type="application/json" id="data">{}</script>'


def save_page(
    solution: Solution | TaskSolution,
    path: Path,
    carried: Sequence[Attachment] = (),
    most_states: int = 400,
) -> None:
    """Write a solution or a task as one html file; a task is shown up to the phase that failed.

    Args:
        solution: what is shown.
        path: of the file.
        carried: objects shown in the hand if the problem has no attachments.
        most_states: a path of more states is resampled evenly to this number.
    """
    write_text(path, _html(seen_of_solution(solution, carried, most_states, plots=True)))


def path_html(
    problem: PlanningProblem,
    states: np.ndarray,
    verdict: str,
    carried: Sequence[Attachment] = (),
    most_states: int = 400,
) -> str:
    """Text of an html file like that of `save_page`, for a valid path.

    Args:
        problem: what the path solves.
        states: (m, n) [rad or m], of the path.
        verdict: last part of the title, e.g. "certified path of birrt".
        carried: objects shown in the hand if the problem has no attachments.
        most_states: a path of more states is resampled evenly to this number.
    """
    return _html(
        seen_of_problem(
            problem,
            JointPath(states),
            carried,
            most_states,
            plots=True,
            verdict=verdict,
            lines=repr(problem).splitlines(),
        )
    )


def _html(seen: Seen, size: tuple[int, int] = (1100, 600)) -> str:
    """Text of the html file.

    Args:
        seen: what is shown.
        size: width and height [pixels] for which the first viewpoint is chosen.
    """
    # the first view shows the robot at the start of a task, or at both ends of a path
    ends = (0,) if seen.times is not None else (0, len(seen.labels) - 1)
    robot = [body for body in seen.moving if body.layer == "robot"]
    views = [in_view(robot, k) for k in ends]
    # and holds the whole motion, at some ten states
    count = len(seen.labels)
    inside = [in_view(seen.moving, k) for k in range(0, count, max(1, count // 10))]
    torso = whole(body for body in robot if body.aside)
    viewpoint = clear_viewpoint(views, whole(seen.scene), size, inside, torso)
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
        # length of the animation
        "seconds": 6.0 if seen.times is None else max(float(seen.times[-1]), 1.0),
        "camera": {
            "target": list(map(float, viewpoint.target)),
            "distance": distance,
            "azimuth": math.atan2(offset[1], offset[0]),
            "elevation": math.asin(offset[2] / distance),
            "angle": viewpoint.height_angle,
        },
        "bodies": [
            {
                "group": body.group,
                "colour": list(map(float, body.colour)),
                "opacity": body.opacity,
                "positions": _base64(body.mesh.corners.astype("<f4")),
                # whole numbers from -127 to 127
                "normals": _base64(np.round(127 * body.mesh.normals).astype(np.int8)),
                "poses": _base64(body.poses[:, :3].astype("<f4")),
            }
            for body in bodies
        ],
        "plots": [_plot(plot) for plot in seen.plots],
    }
    # without this, "</script>" in a name would end the script element
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    return TEMPLATE.read_text(encoding="utf-8").replace(PLACE, PLACE.replace("{}", text))


def _base64(array: np.ndarray) -> str:
    return b64encode(array.tobytes()).decode()


def _plot(
    plot: Plot,
    palette: Sequence[str] = (
        "#1f6fb4", "#d1662a", "#2e8b57", "#8a4fa3", "#b8336a", "#8c6d1f", "#3aa6a6", "#70757d",
    ),
) -> dict[str, Any]:  # fmt: skip
    """A plot as json data; bounds are red, and numbers that are not finite become null."""
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
                "colour": "#cc3333" if bound else palette[k % len(palette)],
                "width": 1.0 if bound else plot.width,
                "bound": bound,
            }
        )
    return {"title": plot.title, "curves": curves, "low": bottom, "high": high + margin}
