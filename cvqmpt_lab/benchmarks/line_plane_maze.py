"""The hand on a line, the hand in a plane, a pen in a maze: problems by the recipe of McVAMP.

McVAMP (Iyer et al. 2026) published such problem sets for the Panda: axis-aligned cubes of random
places and sizes for lines and planes, walls for the maze, with one start and one goal. Bounds,
sizes and ranges here are those of its files. docs/performance.md lists what the files leave open.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from cvqmpt_lab.base.poses import pose, rigid
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import problem_between, with_first_goal
from cvqmpt_lab.benchmarks.results.row import phase_problem
from cvqmpt_lab.collision.exact import shared_checker
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, sample_region
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion, symmetric_region
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder


def line_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return a problem in which the fingertips stay on a line along y, within 2.5 mm.

    There are 20 * (index % 6) cubes.
    """
    free = [2.5e-3, FREE, 2.5e-3, FREE, FREE, FREE]

    def draw(rng: np.random.Generator) -> PlanningProblem | UnsolvableProblem:
        x, z = rng.uniform((0.2, 0.04), (0.55, 0.4))
        ends = np.array([(x, side, z) for side in (0.6, -0.6)])
        return _among_cubes(index, index % 6, 20 * (index % 6), ends, free, rng)

    return _first(draw, index)


def plane_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return a problem in which the fingertips stay in a plane, within 0.1 mm.

    The plane is normal to x, y or z. There are 10 * (index % 11) cubes.
    """

    def draw(rng: np.random.Generator) -> PlanningProblem | UnsolvableProblem:
        normal = rng.integers(3)
        ends = rng.uniform((0.25, -0.6, 0.05), (0.6, 0.6, 0.55), (2, 3))
        if normal != 1:  # from one side of the robot to the other
            ends[:, 1] = rng.uniform(0.3, 0.6) * np.array([1.0, -1.0])
        ends[1, normal] = ends[0, normal]
        bounds = [FREE] * 6
        bounds[normal] = 1e-4
        return _among_cubes(index, index % 11, 10 * (index % 11), ends, bounds, rng)

    return _first(draw, index)


def maze_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return a problem in which a pen, pointing down, moves through a random maze of corridors.

    The fingertips keep their height within 1 cm, and tilt by at most 0.01 rad about x and y. The
    maze has 3 x 8, 4 x 10 or 5 x 12 cells, which is index % 3.
    """
    return _first(partial(_in_maze, index), index)


def _first(
    draw: Callable[[np.random.Generator], PlanningProblem | UnsolvableProblem], index: int
) -> PlanningProblem | UnsolvableProblem:
    """Draw until a problem has a free start and a free goal, at most 50 times."""
    rng = np.random.default_rng(index)
    problem = draw(rng)
    for _ in range(49):
        if isinstance(problem, UnsolvableProblem):
            problem = draw(rng)
    return problem


def _among_cubes(
    index: int,
    number: int,
    count: int,
    ends: np.ndarray,
    bounds: list[float],
    rng: np.random.Generator,
) -> PlanningProblem | UnsolvableProblem:
    """Return a problem between two places of the fingertips, among cubes.

    Args:
        index: of the problem.
        number: of its group of problems with equally many cubes.
        count: number of cubes.
        ends: places at the start and at the goal (2, 3) [m].
        bounds: (6,) of the fingertips' displacement from the start along the world's axes, and of
            their orientation [m, rad].
        rng: random number generator.
    """
    cubes: list[SceneObject] = []
    way, on_line = ends[1] - ends[0], np.isinf(bounds[:3]).sum() == 1
    while len(cubes) < count:
        centre = rng.uniform((-0.1, -0.8, -0.2), (0.8, 0.8, 0.7))
        half = np.clip(rng.normal(0.0165, 0.005), 0.002, 0.03)
        # the base and both ends are left free, and the line, because there is no way around it
        share = np.clip((centre - ends[0]) @ way / (way @ way), 0.0, 1.0)
        nearest = ends[0] + (share if on_line else round(share)) * way
        if np.hypot(*centre[:2]) > 0.2 and np.linalg.norm(centre - nearest) > 0.1:
            size = (2.0 * half,) * 3
            cubes.append(SceneObject(f"cube_{len(cubes)}", Box(size), pose(centre)))
    name = phase_problem(str(index), 1 + number, f"{count} cubes")
    scene = Scene(f"cubes-{index}", tuple(cubes))
    robot = robot_from_source({"name": "panda"})
    checker = shared_checker(robot, scene, (), SAMPLE_MARGIN_M)
    constraint, found = _fingertips(ends[0], bounds, np.eye(3)), []
    for end in ends:
        region = _fingertips(end, [0.0] * 3 + [0.3, 0.3, FREE])
        postures = sample_region(robot, region, checker, rng, count=20, within=(constraint,))
        if len(postures.configurations) == 0:
            return UnsolvableProblem(name, f"no posture at an end: {postures.outcome}")
        found.append(postures.configurations)
    # start and goal have similar postures in the published files
    gaps = np.linalg.norm(found[0][:, None] - found[1], axis=2)
    start, goal = np.unravel_index(gaps.argmin(), gaps.shape)
    return PlanningProblem(
        name=name,
        robot=robot,
        scene=scene,
        start=found[0][start],
        goals=found[1][goal][None],
        constraint=(constraint,),
    )


def _in_maze(index: int, rng: np.random.Generator) -> PlanningProblem | UnsolvableProblem:
    """Return a problem between two cells of a maze."""
    cells = ((3, 8), (4, 10), (5, 12))[index % 3]
    corner, cell = np.array((0.2, -0.65)), np.divide((0.46, 1.3), cells)
    walls: list[SceneObject] = []
    for middle, along in _walls(cells, rng):
        size = (*(np.where(along, cell, 0.0) + 0.01).tolist(), 0.1)
        at = pose((*(corner + cell * middle), 0.05))
        walls.append(SceneObject(f"wall_{len(walls)}", Box(size), at))
    # from the fingertips on; the published pen consists of spheres of 1 cm along this line
    pen = Attachment("pen", Cylinder(0.01, 0.18), pose((0.0, 0.0, 0.105 + 0.08)))
    chosen = np.unravel_index(rng.choice(math.prod(cells), 2, replace=False), cells)
    places = [(*(corner + cell * (one + 0.5)), 0.206) for one in np.array(chosen).T]
    ends = [_fingertips(place, [0.0] * 5 + [FREE]) for place in places]
    plane = _fingertips(places[0], [FREE, FREE, 0.01, 0.01, 0.01, FREE])
    name = phase_problem(str(index), 1 + index % 3, f"{cells[0]} x {cells[1]} cells")
    scene = Scene(f"maze-{index}", tuple(walls))
    return with_first_goal(problem_between(name, scene, ends, plane, rng, (pen,)))


def _fingertips(
    place: Sequence[float] | np.ndarray, bounds: Sequence[float], axes: np.ndarray | None = None
) -> TaskSpaceRegion:
    """Return the region of the point between the fingertips at a place, the hand pointing down.

    Args:
        place: (3,) [m].
        bounds: (6,), of the displacement along and about the axes [m, rad].
        axes: axes of the displacement in the world (3, 3); None: those of the hand.
    """
    down = np.diag([1.0, -1.0, -1.0])  # orientation of the hand
    axes = down if axes is None else axes
    tip = pose((0.0, 0.0, -0.105))  # the hand's frame, seen from the fingertips
    return symmetric_region(rigid(axes, place), rigid(axes.T @ down) @ tip, bounds)


def _walls(cells: tuple[int, int], rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the walls of a random maze in which one way joins any two cells.

    Args:
        cells: numbers of cells along x and y.
        rng: random number generator.

    Returns:
        Middle of each wall (2,) in cells, and whether it extends along x and y (2,).
    """
    inside = [(i, j, k) for i in range(cells[0]) for j in range(cells[1]) for k in (0, 1)]
    group = np.arange(cells[0] * cells[1]).reshape(cells)
    found = []
    for place in rng.permutation(len(inside)):
        i, j, axis = inside[place]
        other = (i + 1, j) if axis == 0 else (i, j + 1)
        middle = np.array((i + 0.5, j + 0.5))
        middle[axis] += 0.5
        if other[axis] < cells[axis] and group[i, j] != group[other]:
            group[group == group[other]] = group[i, j]  # no wall: both cells become one room
        else:
            found.append((middle, np.arange(2) != axis))
    for axis in (0, 1):
        for j in range(cells[1 - axis]):
            middle = np.empty(2)
            middle[axis], middle[1 - axis] = 0.0, j + 0.5
            found.append((middle, np.arange(2) != axis))
    return found
