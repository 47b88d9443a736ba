"""Narrow passages: a pen in a maze on a plane, a hand that moves into a cage or through a slot.

Problems are a function of a width and an index; suite `passages` has several widths.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cvqmpt_lab.base.poses import pose, rigid
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import problem_between
from cvqmpt_lab.benchmarks.results.row import phase_problem
from cvqmpt_lab.constraints.task_space_region import UPRIGHT_ROTATION, TaskSpaceRegion, upright_box
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder

Passage = Callable[[float, int], PlanningProblem | UnsolvableProblem]


def maze_problem(width: float, index: int) -> PlanningProblem | UnsolvableProblem:
    """Return a problem in which a pen moves on a plane through three joined corridors.

    The position and the turn of the maze and the posture at the start depend on the index.
    width: of a corridor [m].
    """
    rng = np.random.default_rng([index, round(1e4 * width)])
    thick, length, pitch = 0.008, 0.5, width + 0.008
    middle = pose((rng.uniform(0.5, 0.6), 0.0, 0.15), rng.uniform(-0.3, 0.3))
    walls = []
    for k in range(4):
        inner = k in (1, 2)
        # inner walls have their gap at one end and at the other in turn
        shift = (k - 1.5) * width if inner else 0.0
        size = Box((thick, length - width if inner else length + 2 * thick, 0.08))
        walls.append(
            SceneObject(f"wall_{k}", size, middle @ pose(((k - 1.5) * pitch, shift, 0.02)))
        )
    for end in (-1, 1):
        place = pose((0.0, end * 0.5 * (length + thick), 0.02))
        walls.append(SceneObject(f"end_{end}", Box((3 * pitch, thick, 0.08)), middle @ place))
    pen = Attachment("pen", Cylinder(0.006, 0.14), pose((0.0, 0.0, 0.15)))
    tip = pose((0.0, 0.0, 0.22))
    tip[1:3, 1:3] *= -1.0  # the pen points down
    lean = [[-0.1, 0.1]] * 2
    free = [-np.inf, np.inf]
    height = pose((0.0, 0.0, 0.15))
    plane = TaskSpaceRegion(height, tip, np.array([free, free, [-1e-3, 1e-3], *lean, free]))
    ends = []
    for side in (-1, 1):
        corner = middle @ pose((side * pitch, side * 0.5 * (length - width), 0.0))
        turn = [[0.0, 0.0]] * 3 + [[-0.03, 0.03]] * 2 + [[-math.pi, math.pi]]
        ends.append(TaskSpaceRegion(corner, tip, np.array(turn)))
    name = f"maze-{width:g}-{index}"
    return problem_between(name, Scene(name, tuple(walls)), ends, plane, rng, (pen,))


def cage_problem(opening: float, index: int) -> PlanningProblem | UnsolvableProblem:
    """Return a problem in which an upright hand moves into a cage of bars with one gap.

    The position of the cage, the direction of the gap and the posture at the start depend on the
    index. opening: width of the gap [m].
    """
    rng = np.random.default_rng([index, round(1e4 * opening)])
    centre = np.array([rng.uniform(0.55, 0.62), rng.uniform(-0.05, 0.05)])
    radius = 0.27
    gap = math.pi + rng.uniform(-0.2, 0.2)  # towards the base
    half = math.asin(0.5 * (opening + 0.02) / radius)
    bars = []
    count = 1 + math.ceil((2.0 * math.pi - 2.0 * half) / math.radians(10.0))
    for k, angle in enumerate(np.linspace(half, 2.0 * math.pi - half, count)):
        x, y = centre + radius * np.array([math.cos(gap + angle), math.sin(gap + angle)])
        bars.append(SceneObject(f"bar_{k}", Cylinder(0.01, 1.1), pose((x, y, 0.35))))
    bars.append(SceneObject("roof", Box((0.62, 0.62, 0.02)), pose((*centre, 0.91))))
    side = rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.1)  # [rad] of the start about the base
    outside = (0.65 * math.cos(side), 0.65 * math.sin(side), 0.4)
    ends = [_upright_at(outside, math.pi), _upright_at((*centre, 0.4), 0.6)]
    name = f"cage-{opening:g}-{index}"
    return problem_between(name, Scene(name, tuple(bars)), ends, upright_box(), rng)


def slot_problem(width: float, index: int) -> PlanningProblem | UnsolvableProblem:
    """Return a problem in which an upright hand reaches through a slot in a wall.

    The position of the slot and the posture at the start depend on the index. width: of the slot
    [m].
    """
    rng = np.random.default_rng([index, round(1e4 * width)])
    x, y = rng.uniform(0.4, 0.5), rng.uniform(-0.1, 0.1)
    boards = []
    for sign in (-1, 1):
        place = pose((x, y + sign * 0.5 * (width + 0.8), 0.6))
        boards.append(SceneObject(f"board_{sign}", Box((0.02, 0.8, 1.2)), place))
    side = rng.choice([-1.0, 1.0])
    before, behind = (x - 0.2, side * 0.35, 0.4), (x + 0.2, y, 0.4)
    ends = [_upright_at(before, math.pi), _upright_at(behind, math.pi)]
    name = f"slot-{width:g}-{index}"
    return problem_between(name, Scene(name, tuple(boards)), ends, upright_box(), rng)


def passage_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return problem index // 8 of passage index % 8; its rows are named by index and passage."""
    # kind, function that makes its problems, and width in centimetres
    passages: Sequence[tuple[str, Passage, float]] = (
        *(("maze", maze_problem, width) for width in (5, 6, 7, 8, 10)),
        ("cage", cage_problem, 21),
        *(("slot", slot_problem, width) for width in (19, 21)),
    )
    number, k = divmod(index, len(passages))
    kind, make, width = passages[k]
    # numbers from 1000 on are not used by tuning or tests
    found = make(width / 100, 1000 + number)
    return replace(found, name=phase_problem(str(index), k + 1, f"{kind} {width} cm"))


def _upright_at(place: tuple[float, ...], turn: float) -> TaskSpaceRegion:
    """Return upright hand poses within 5 mm of a place, turned by up to +-turn [rad]."""
    Bw = np.array([[-0.005, 0.005]] * 3 + [[0.0, 0.0]] * 2 + [[-turn, turn]])
    return TaskSpaceRegion(pose(place), rigid(UPRIGHT_ROTATION), Bw)
