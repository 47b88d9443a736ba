"""A still picture of a solution, drawn by a small z-buffer rasteriser: no display or graphics library needed.

Everything drawn is triangles. The solid layer (scene, robot at the start) gets outlines and shadows; ghosts
of the robot along the path and at the goal, and the hand's trace, are blended over it.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from PIL import Image

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.show.meshes import (
    GHOST_COLOUR,
    GOAL_COLOUR,
    ROBOT_COLOUR,
    TRACE_COLOUR,
    Mesh,
    beads,
    ground_height,
    joined,
    poses_along,
    robot_meshes,
    scene_meshes,
    travelled_along,
)
from cvqmpt_lab.show.rasteriser import Viewpoint, rasterise, shaded, solid_image

SUPERSAMPLING = 2


def draw_solution(
    solution: Solution,
    path: Path,
    size: tuple[int, int] = (1200, 800),
    ghosts: int = 4,
    viewpoint: Viewpoint | None = None,
    hidden: Sequence[str] = ("walls/right",),
) -> None:
    """Write a PNG of scene, robot at the start, ghosts along the path and at the goal, and the hand's trace.

    Parameters
    ----------
    size: width and height [pixels].
    ghosts: number of poses shown between start and goal.
    hidden: names of scene objects left out because they stand in the way.

    Raises
    ------
    InvalidInputError: a size without pixels, or a path that cannot be written.
    """
    if min(size) < 1:
        raise InvalidInputError(f"picture size {size} must be at least 1 x 1 pixels")
    problem, viewpoint = solution.problem, viewpoint or Viewpoint()
    shape = (SUPERSAMPLING * size[1], SUPERSAMPLING * size[0])
    image, depth = _still(problem, problem.start, viewpoint, shape, hidden)
    for mesh, opacity, opacity_behind in _translucent(solution, ghosts):
        view = rasterise(mesh, viewpoint, shape)
        at = view.rows, view.columns
        share = np.where(view.depth < depth[at] - 1e-3, opacity, opacity_behind)[:, None]
        image[at] += share * (shaded(mesh.colours[view.face], view.normals) - image[at])
    write_png(Path(path), _eight_bit(image))


def still_image(
    problem: PlanningProblem,
    q: np.ndarray,
    size: tuple[int, int] = (900, 600),
    viewpoint: Viewpoint | None = None,
    hidden: Sequence[str] = ("walls/right",),
) -> np.ndarray:
    """Colours (height, width, 3), 8 bit, of the scene and the robot at q (n,); what figures are drawn over.

    `Viewpoint.screen` says where in it a point is.
    """
    shape = (SUPERSAMPLING * size[1], SUPERSAMPLING * size[0])
    return _eight_bit(_still(problem, q, viewpoint or Viewpoint(), shape, hidden)[0])


def _still(
    problem: PlanningProblem,
    q: np.ndarray,
    viewpoint: Viewpoint,
    shape: tuple[int, int],
    hidden: Sequence[str],
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (rows, columns, 3) and depth [m] of scene and robot."""
    solid = joined([*scene_meshes(problem, hidden), *robot_meshes(problem, q, ROBOT_COLOUR)])
    return solid_image(solid, ground_height(problem), viewpoint, shape)


def _eight_bit(image: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] at SUPERSAMPLING times the size as 8-bit colours of the picture."""
    rows, columns = (side // SUPERSAMPLING for side in image.shape[:2])
    smaller = image.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return (255.0 * np.clip(smaller, 0.0, 1.0) + 0.5).astype(np.uint8)


def _translucent(solution: Solution, ghosts: int) -> Iterator[tuple[Mesh, float, float]]:
    """What is blended over the solid layer: (mesh, opacity, opacity behind something solid)."""
    problem = solution.problem
    if solution.simplified is None:
        for goal in problem.goals[:1]:
            yield joined(robot_meshes(problem, goal, GOAL_COLOUR)), 0.5, 0.0
        return
    states = solution.simplified.path.states
    travelled = travelled_along(states)
    for k in range(1, ghosts + 1):
        between = states[np.searchsorted(travelled, travelled[-1] * k / (ghosts + 1))]
        yield joined(robot_meshes(problem, between, GHOST_COLOUR)), 0.25, 0.0
    yield joined(robot_meshes(problem, states[-1], GOAL_COLOUR)), 0.55, 0.0
    yield beads(poses_along(problem.robot, states)[1][:, :3, 3], TRACE_COLOUR), 1.0, 0.45


def write_png(path: Path, image: np.ndarray) -> None:
    """Write 8-bit colours (rows, columns, 3)."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        Image.fromarray(image).save(temporary, format="PNG", optimize=True)
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise InvalidInputError(
            f"cannot write picture {path}: {error.strerror}; name a file in a folder that exists"
        ) from error
