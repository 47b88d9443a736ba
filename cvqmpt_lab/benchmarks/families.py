"""Families of random scenes for training: samplers must not depend on one kitchen.

A scene has a family and a number, which seeds numpy's `default_rng`. The kitchen of the tasks, with
its published dimensions, is never one of these scenes.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_choice, whole_number
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.benchmarks.kitchen import KITCHEN_DIMENSIONS, kitchen
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere


def random_scene(seed: int, n_cubes: int = 8, n_spheres: int = 8) -> Scene:
    """Return environment `seed` of the published training data: cubes with random yaw, and spheres.

    The seed, 0 to 2**32 - 1, seeds numpy's legacy generator, which never changes: environment n is
    the same everywhere. Order of the random numbers: distances, elevations, azimuths and yaws of
    cubes; distances, elevations and azimuths of spheres. The older data of 6 joints had 6 cubes and
    6 spheres.
    """
    for what, value in (("seed", seed), ("n_cubes", n_cubes), ("n_spheres", n_spheres)):
        whole_number(what, value, 0, 2**32 - 1)
    rng = np.random.RandomState(seed)
    cube_centres = _scattered(rng, n_cubes, lift=0.5)
    yaws = rng.uniform(0.0, 2.0 * math.pi, n_cubes)
    sphere_centres = _scattered(rng, n_spheres, lift=0.33)
    cube, ball = Box((0.2, 0.2, 0.2)), Sphere(0.15)
    cube_poses = map(pose, cube_centres, yaws)
    cubes = [SceneObject(f"cube_{i}", cube, T) for i, T in enumerate(cube_poses)]
    spheres = [SceneObject(f"sphere_{i}", ball, T) for i, T in enumerate(map(pose, sphere_centres))]
    return Scene(f"random_{seed:06d}", (*cubes, *spheres))


def _scattered(rng: np.random.RandomState, count: int, lift: float) -> FloatArray:
    """Draw points (count, 3), 0.4 to 1.2 m from a point `lift` [m] above the base."""
    distance = rng.uniform(0.4, 1.2, count)
    elevation = rng.uniform(-0.25 * math.pi, 0.5 * math.pi, count)
    azimuth = rng.uniform(0.0, 2.0 * math.pi, count)
    across, up = distance * np.cos(elevation), distance * np.sin(elevation)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up + lift], axis=1)


class Family(NamedTuple):
    """A kind of random scenes."""

    name: str  # start of the names of its scenes; their number follows
    seed: int  # seed of the generator, together with the number of the scene
    # draws the objects of a scene
    objects: Callable[[np.random.Generator], Iterable[SceneObject]]


def family_scene(family: str, number: int) -> Scene:
    """Return scene `number` of a family; UnknownChoiceError lists the families."""
    require_choice("scene family", family, FAMILIES)
    whole_number("number of the scene", number)
    made = FAMILIES[family]
    if made is None:
        return random_scene(number)
    rng = np.random.default_rng([made.seed, number])
    return Scene(f"{made.name}_{number}", tuple(made.objects(rng)))


def another_scene() -> Scene:
    """Return the scene that ablation runs get in place of the problem's scene."""
    return family_scene("shelves", 77)


def _tables(
    spans: Sequence[tuple[float, float]],
    counts: tuple[int, int],
    draw_item: Callable[[np.random.Generator], tuple[Box | Cylinder | Sphere, float]],
    board: float = 0.02,
) -> Callable[[np.random.Generator], Iterator[SceneObject]]:
    """Return a function that draws a table with items on it.

    Args:
        spans: ranges of the table's depth, width, height, distance [m] and angle [rad].
        counts: range of the number of items, upper end excluded.
        draw_item: draws the shape of an item and its height [m].
        board: thickness of the table top [m].
    """

    def objects(rng: np.random.Generator) -> Iterator[SceneObject]:
        depth, width, top, near, yaw = (rng.uniform(*span) for span in spans)
        x, T = near + depth / 2, pose((0.0, 0.0, 0.0), yaw)
        yield SceneObject("top", Box((depth, width, board)), T @ pose((x, 0.0, top - board / 2)))
        for i in range(rng.integers(*counts)):
            place = (x + rng.uniform(-0.45, 0.45) * depth, rng.uniform(-0.45, 0.45) * width)
            shape, height = draw_item(rng)
            T_table_item = pose((*place, top + height / 2), rng.uniform(-np.pi, np.pi))
            yield SceneObject(f"item_{i}", shape, T @ T_table_item)

    return objects


def _clutter(rng: np.random.Generator) -> tuple[Box | Cylinder | Sphere, float]:
    """Draw an item on a table; return its shape and height [m]."""
    kind, height = rng.integers(3), rng.uniform(0.1, 0.4)
    if kind == 0:
        return Box((rng.uniform(0.05, 0.25), rng.uniform(0.05, 0.25), height)), height
    if kind == 1:
        return Cylinder(rng.uniform(0.03, 0.1), height), height
    radius = rng.uniform(0.05, 0.12)
    return Sphere(radius), 2.0 * radius


def _slim(rng: np.random.Generator) -> tuple[Box | Cylinder, float]:
    """Draw a slim item; return its shape and height [m]."""
    radius, height = rng.uniform(0.02, 0.06), rng.uniform(0.15, 0.5)
    if rng.random() < 0.5:
        return Cylinder(radius, height), height
    return Box((2 * radius, 2 * radius, height)), height


def _cage(rng: np.random.Generator) -> Iterator[SceneObject]:
    """Draw a ring of vertical bars around the robot, with gaps for an arm, and hoops."""
    ring, radius = rng.uniform(0.4, 0.65), rng.uniform(0.01, 0.03)
    low, high = rng.uniform(-0.4, 0.0), rng.uniform(0.7, 1.2)
    count = int(2.0 * np.pi * ring / rng.uniform(0.22, 0.4))
    angles = rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    angles += rng.uniform(-0.3, 0.3, count) * 2.0 * np.pi / count
    for i, angle in enumerate(angles):
        T = pose((ring * np.cos(angle), ring * np.sin(angle), (low + high) / 2))
        yield SceneObject(f"bar_{i}", Cylinder(radius, high - low), T)
    side = 2.0 * np.pi * ring / 12
    for hoop, level in enumerate(rng.uniform(low, high, rng.integers(1, 3))):
        for part in range(12):
            T = pose((0.0, 0.0, 0.0), part * np.pi / 6) @ pose((ring, 0.0, float(level)))
            yield SceneObject(f"hoop_{hoop}/{part}", Box((2 * radius, side, 2 * radius)), T)


def _cabinets(
    widths: tuple[float, float], gaps: tuple[float, float], boards: tuple[int, int]
) -> Callable[[np.random.Generator], Iterator[SceneObject]]:
    """Return a function that draws one to three open cabinets around the robot, with items.

    Args:
        widths: range of a cabinet's width [m].
        gaps: range of the height between two boards [m].
        boards: range of the number of boards, upper end excluded.
    """

    def objects(rng: np.random.Generator) -> Iterator[SceneObject]:
        heading = rng.uniform(-np.pi, np.pi)
        for k in range(rng.integers(1, 4)):
            T = pose((0.0, 0.0, 0.0), heading + k * rng.uniform(0.9, 1.6))
            near, depth = rng.uniform(0.35, 0.65), rng.uniform(0.25, 0.4)
            width, count = rng.uniform(*widths), rng.integers(*boards)
            levels = rng.uniform(-0.3, 0.3) + np.cumsum(
                np.concatenate([[0.0], rng.uniform(*gaps, count - 1)])
            )
            yield from _cabinet(f"cabinet_{k}", T, rng, (near, depth, width), levels)

    return objects


def _cabinet(
    name: str,
    T: np.ndarray,
    rng: np.random.Generator,
    size: tuple[float, float, float],
    levels: FloatArray,
    board: float = 0.02,
) -> Iterator[SceneObject]:
    """Yield a cabinet that is open towards the robot: back, two sides, boards, a few items.

    Args:
        name: start of the names of its pieces.
        T: (4, 4) rotation about the robot.
        rng: random numbers for the items.
        size: (distance of the front from the robot, depth, width) [m].
        levels: heights of the boards [m].
        board: thickness of boards and walls [m].
    """
    near, depth, width = size
    x, low, high = near + depth / 2, levels[0], levels[-1]
    parts = [
        ("back", (board, width, high - low), (near + depth, 0.0, (low + high) / 2)),
        ("left", (depth, board, high - low), (x, width / 2, (low + high) / 2)),
        ("right", (depth, board, high - low), (x, -width / 2, (low + high) / 2)),
        *(
            (f"board_{i}", (depth, width, board), (x, 0.0, float(level)))
            for i, level in enumerate(levels)
        ),
    ]
    for part, edges, place in parts:
        yield SceneObject(f"{name}/{part}", Box(edges), T @ pose(place))
    for i in range(rng.integers(0, 4)):
        radius, height = rng.uniform(0.03, 0.05), rng.uniform(0.08, 0.2)
        level = float(levels[rng.integers(0, len(levels) - 1)])
        place = (x, rng.uniform(-0.4, 0.4) * width, level + board / 2 + height / 2)
        yield SceneObject(f"{name}/item_{i}", Cylinder(radius, height), T @ pose(place))


def _random_kitchen(rng: np.random.Generator, spread: float = 0.2) -> tuple[SceneObject, ...]:
    """Draw a kitchen: half of its dimensions and the joints of doors and drawers are random.

    spread: largest relative difference of a dimension from the published one.
    """
    fixed = ("floor", "pedestal", "wall", "handle", "knob", "plate")
    names = [name for name in KITCHEN_DIMENSIONS if not name.startswith(fixed)]
    while True:
        changed = rng.choice(names, size=len(names) // 2, replace=False)
        factors = {str(name): 1.0 + rng.uniform(-spread, spread) for name in changed}
        try:
            scene = kitchen({name: KITCHEN_DIMENSIONS[name] * factors[name] for name in factors})
        except InvalidInputError:  # the dimensions do not fit together
            continue
        for joint in scene.articulations:
            if rng.random() < 0.4:
                scene = scene.with_joint(joint.name, rng.uniform(joint.lower, joint.upper))
        return scene.objects


FAMILIES: Mapping[str, Family | None] = {
    "cubes-spheres": None,  # the published training family, see `random_scene`
    # in front of the robot
    "table": Family(
        "table",
        1,
        _tables(((0.4, 0.8), (0.8, 1.6), (-0.1, 0.45), (0.3, 0.5), (-0.6, 0.6)), (3, 10), _clutter),
    ),
    "shelves": Family("shelves", 2, _cabinets((0.35, 0.9), (0.25, 0.5), (2, 5))),
    "kitchen-like": Family("kitchen", 3, _random_kitchen),
    # at elbow height, on any side of the robot, with many slim items up to a forearm's length
    "cluttered-table": Family(
        "cluttered_table",
        4,
        _tables(
            ((0.5, 0.8), (0.6, 1.2), (0.05, 0.45), (0.25, 0.4), (-np.pi, np.pi)), (8, 19), _slim
        ),
    ),
    # compartments that are just large enough for a hand
    "narrow-shelves": Family("narrow_shelves", 6, _cabinets((0.25, 0.45), (0.17, 0.3), (3, 7))),
    "cage": Family("cage", 5, _cage),
}
