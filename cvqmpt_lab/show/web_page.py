"""One html file that shows a plan or task in 3-D, with a time slider and plots.

It contains its viewer (WebGL, `plan_page.html`) and works without a network. Scenes of too many
triangles are drawn with fewer, and the page says so.
"""

import json
import math
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import replace
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
from cvqmpt_lab.show.meshes import Mesh
from cvqmpt_lab.show.raster import clear_viewpoint
from cvqmpt_lab.tasks.solve import TaskSolution

TEMPLATE = Path(__file__).with_name("plan_page.html")
PLACE = '<script type="application/json" id="data">{}</script>'  # of the data in the template
MOST_STATES = 400  # of a path; a longer one is shown at as many even places


def save_page(
    solution: Solution | TaskSolution, path: Path, carried: Sequence[Attachment] = ()
) -> list[str]:
    """Write a solution or a task, up to the phase that failed, as one html file.

    Args:
        solution: what is shown.
        path: of the file.
        carried: load in the hand if the problem does not model it.

    Returns: messages for the reader.
    """
    html, note = _html(seen_of_solution(solution, carried, MOST_STATES, plots=True))
    write_text(Path(path), html)
    return note


def path_html(
    problem: PlanningProblem, states: np.ndarray, verdict: str, carried: Sequence[Attachment] = ()
) -> str:
    """The same page for a valid path of states (m, n) [rad or m], with a verdict in words."""
    seen = seen_of_problem(
        problem,
        JointPath(states),
        carried,
        MOST_STATES,
        plots=True,
        verdict=verdict,
        lines=repr(problem).splitlines(),
    )
    return _html(seen)[0]


def _html(seen: Seen, size: tuple[int, int] = (1100, 600)) -> tuple[str, list[str]]:
    """Text of a page with a first view of `size` [pixels], and a message on reduced triangles."""
    ends = (0,) if seen.times is not None else (0, len(seen.labels) - 1)
    robot = [body for body in seen.moving if body.layer == "robot"]
    viewpoint = clear_viewpoint([whole(robot, k) for k in ends], whole(seen.scene), size)
    bodies, note = _reduced(seen.bodies("goals", "path", "constraint", "hand"))
    offset = np.subtract(viewpoint.eye, viewpoint.target)
    distance = float(np.linalg.norm(offset))
    labels = list(seen.labels)
    if seen.times is not None:
        labels = [f"{name}, {t:.1f} s" for name, t in zip(labels, seen.times, strict=True)]
    data = {
        "title": seen.title,
        "lines": [*seen.lines, *note],
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
    return TEMPLATE.read_text(encoding="utf-8").replace(PLACE, PLACE.replace("{}", text)), note


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


def _reduced(
    bodies: Sequence[Body], most: int = 60_000, coarse: int = 60
) -> tuple[list[Body], list[str]]:
    """Bodies with about `most` triangles at most (60 bytes each in the file), and a message.

    Finer bodies of the scene keep the same share of triangles, but at least `coarse`.
    """
    sizes = np.array([len(body.mesh.corners) for body in bodies])
    fine = (sizes > coarse) & [body.group == "scene" for body in bodies]
    share = (most - sizes[~fine].sum()) / max(sizes[fine].sum(), 1)
    found = list(bodies)
    if share >= 1.0:
        return found, []
    for k in np.flatnonzero(fine):
        mesh = _with_fewer(found[k].mesh, max(coarse, int(share * sizes[k])))
        found[k] = replace(found[k], mesh=mesh)
    left = sum(len(body.mesh.corners) for body in found)
    return found, [
        f"drawn with {left} of {sizes.sum()} triangles: close corners of the scene are merged"
    ]


def _with_fewer(mesh: Mesh, most: int) -> Mesh:
    """A mesh of at most so many triangles, with the finest grid of a few that leaves no more."""
    # a closed surface has some 10 n^2 triangles of n cells along it
    cell = float(np.ptp(mesh.corners, axis=(0, 1)).max()) / (2.0 * math.sqrt(most))
    found = mesh
    while len(found.corners) > most:
        found, cell = clustered(mesh, cell), 1.3 * cell
    return found


def clustered(mesh: Mesh, cell: float) -> Mesh:
    """Replace the corners in each cell [m] of a grid by their mean; drop triangles without area."""
    corners = mesh.corners.reshape(-1, 3)
    which = np.unique(_numbered(np.floor(corners / cell).astype(np.int64)), return_inverse=True)[1]
    sums = np.stack([np.bincount(which, axis) for axis in corners.T], axis=1)
    merged = (sums / np.bincount(which)[:, None])[which].reshape(-1, 3, 3)
    ends = np.sort(which.reshape(-1, 3), axis=1)
    first = np.unique(_numbered(ends), return_index=True)[1]
    wide = first[(np.diff(ends[first], axis=1) > 0).all(axis=1)]
    return Mesh(merged[wide], mesh.normals[wide], mesh.colours[wide], mesh.piece[wide])


def _numbered(rows: np.ndarray) -> np.ndarray:
    """Keys (m,) of integer rows (m, 3), equal for equal rows; sorting them is ten times faster."""
    return np.ravel_multi_index((rows - rows.min(axis=0)).T, np.ptp(rows, axis=0) + 1)
