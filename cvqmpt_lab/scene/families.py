"""Random scenes of several kinds for training, so that samplers do not depend on one kitchen.

A scene is its family and a number, which seeds numpy's `default_rng`. Evaluation scenes are made
elsewhere; the kitchen of the tasks, with its published dimensions, is never among these.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, whole_number
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.kitchen import KitchenParameters, kitchen
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere
from cvqmpt_lab.values import FloatArray

CUBE_EDGE = 0.2  # edge of the cubes [m]
SPHERE_RADIUS = 0.15  # radius of the spheres [m]
CUBE_LIFT = 0.5  # height [m] of the point around which cubes are scattered
SPHERE_LIFT = 0.33  # height [m] of the point around which spheres are scattered


def random_scene(seed: int, n_cubes: int = 8, n_spheres: int = 8) -> Scene:
    """Return environment `seed` of the published training data: cubes with random yaw, and spheres.

    The seed, 0 to 2**32 - 1, seeds numpy's legacy generator, whose stream is frozen, so environment
    n is the same everywhere. Order of the draws: cube distances, elevations, azimuths, yaws; sphere
    distances, elevations, azimuths. The older 6-joint data used 6 cubes and 6 spheres.
    """
    for what, value in (("seed", seed), ("n_cubes", n_cubes), ("n_spheres", n_spheres)):
        whole_number(what, value, 0, 2**32 - 1)
    rng = np.random.RandomState(seed)
    cube_centres = _scattered(rng, n_cubes, CUBE_LIFT)
    yaws = rng.uniform(0.0, 2.0 * math.pi, n_cubes)
    sphere_centres = _scattered(rng, n_spheres, SPHERE_LIFT)
    objects = [
        SceneObject(f"cube_{i}", Box((CUBE_EDGE,) * 3), pose(centre, yaw))
        for i, (centre, yaw) in enumerate(zip(cube_centres, yaws, strict=True))
    ]
    for i, centre in enumerate(sphere_centres):
        objects.append(SceneObject(f"sphere_{i}", Sphere(SPHERE_RADIUS), pose(centre)))
    return Scene(f"random_{seed:06d}", tuple(objects))


def _scattered(rng: np.random.RandomState, count: int, lift: float) -> FloatArray:
    """Points (count, 3) [m] on a spherical shell around a point `lift` [m] above the base."""
    distance = rng.uniform(0.4, 1.2, count)
    elevation = rng.uniform(-0.25 * math.pi, 0.5 * math.pi, count)
    azimuth = rng.uniform(0.0, 2.0 * math.pi, count)
    across, up = distance * np.cos(elevation), distance * np.sin(elevation)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up + lift], axis=1)


BOARD = 0.02  # [m] thickness of boards and walls
DIMENSION_SPREAD = 0.2  # share by which a random kitchen's dimensions may differ
FIXED = ("floor", "pedestal", "wall", "handle", "knob", "plate")  # dimensions that stay


def family_scene(family: str, number: int) -> Scene:
    """Return scene `number` of a family; UnknownChoiceError lists the families."""
    if family not in FAMILIES:
        raise UnknownChoiceError("scene family", family, FAMILIES)
    return FAMILIES[family](whole_number("number of the scene", number))


def another_scene() -> Scene:
    """What controls are shown in place of a problem's own scene."""
    return family_scene("shelves", 77)


def _table(number: int) -> Scene:
    """A table in front of the robot with boxes, cylinders and balls on it."""
    rng = np.random.default_rng([1, number])
    size = rng.uniform(0.4, 0.8), rng.uniform(0.8, 1.6), rng.uniform(-0.1, 0.45)
    near, yaw = rng.uniform(0.3, 0.5), rng.uniform(-0.6, 0.6)
    return Scene(f"table_{number}", tuple(_laid_table(rng, size, near, yaw, (3, 10), _clutter)))


def _laid_table(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    near: float,
    yaw: float,
    counts: tuple[int, int],
    thing: Callable[[np.random.Generator], tuple[Box | Cylinder | Sphere, float]],
) -> Iterator[SceneObject]:
    """A table (depth, width, height) [m] with items, `near` [m] away at an angle `yaw` [rad]."""
    depth, width, top = size
    x, T = near + depth / 2, pose((0.0, 0.0, 0.0), yaw)
    yield SceneObject("top", Box((depth, width, BOARD)), T @ pose((x, 0.0, top - BOARD / 2)))
    for i in range(rng.integers(*counts)):
        place = (x + rng.uniform(-0.45, 0.45) * depth, rng.uniform(-0.45, 0.45) * width)
        shape, height = thing(rng)
        stands = pose((*place, top + height / 2), rng.uniform(-np.pi, np.pi))
        yield SceneObject(f"item_{i}", shape, T @ stands)


def _clutter(rng: np.random.Generator) -> tuple[Box | Cylinder | Sphere, float]:
    """An item that stands on a table, and its height [m]."""
    kind, height = rng.integers(3), rng.uniform(0.1, 0.4)
    if kind == 0:
        return Box((rng.uniform(0.05, 0.25), rng.uniform(0.05, 0.25), height)), height
    if kind == 1:
        return Cylinder(rng.uniform(0.03, 0.1), height), height
    radius = rng.uniform(0.05, 0.12)
    return Sphere(radius), 2.0 * radius


def _cluttered_table(number: int) -> Scene:
    """A table reached from its side, at elbow height, full of slim items as tall as a forearm."""
    rng = np.random.default_rng([4, number])
    size = rng.uniform(0.5, 0.8), rng.uniform(0.6, 1.2), rng.uniform(0.05, 0.45)
    near, yaw = rng.uniform(0.25, 0.4), rng.uniform(-np.pi, np.pi)
    return Scene(
        f"cluttered_table_{number}", tuple(_laid_table(rng, size, near, yaw, (8, 19), _slim))
    )


def _slim(rng: np.random.Generator) -> tuple[Box | Cylinder, float]:
    """A slim item, and its height [m]."""
    radius, height = rng.uniform(0.02, 0.06), rng.uniform(0.15, 0.5)
    return Cylinder(radius, height) if rng.random() < 0.5 else Box(
        (2 * radius, 2 * radius, height)
    ), height


def _cage(number: int) -> Scene:
    """Upright bars in a ring around the robot, with gaps wide enough for an arm, and hoops."""
    rng = np.random.default_rng([5, number])
    ring, radius = rng.uniform(0.4, 0.65), rng.uniform(0.01, 0.03)
    low, high = rng.uniform(-0.4, 0.0), rng.uniform(0.7, 1.2)
    count = int(2.0 * np.pi * ring / rng.uniform(0.22, 0.4))
    angles = rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    angles += rng.uniform(-0.3, 0.3, count) * 2.0 * np.pi / count
    objects = []
    for i, angle in enumerate(angles):
        T = pose((ring * np.cos(angle), ring * np.sin(angle), (low + high) / 2))
        objects.append(SceneObject(f"bar_{i}", Cylinder(radius, high - low), T))
    side = 2.0 * np.pi * ring / 12
    for hoop, level in enumerate(rng.uniform(low, high, rng.integers(1, 3))):
        for part in range(12):
            T = pose((0.0, 0.0, 0.0), part * np.pi / 6) @ pose((ring, 0.0, float(level)))
            objects.append(
                SceneObject(f"hoop_{hoop}/{part}", Box((2 * radius, side, 2 * radius)), T)
            )
    return Scene(f"cage_{number}", tuple(objects))


class _CabinetSizes(NamedTuple):
    """Ranges that a cabinet is drawn from."""

    width: tuple[float, float]  # [m]
    gap: tuple[float, float]  # between its boards [m]
    boards: tuple[int, int]  # how many, the last number excluded


WIDE = _CabinetSizes((0.35, 0.9), (0.25, 0.5), (2, 5))
NARROW = _CabinetSizes((0.25, 0.45), (0.17, 0.3), (3, 7))


def _shelves(number: int) -> Scene:
    """One to three open cabinets around the robot, each with boards and things on them."""
    return _cabinets(f"shelves_{number}", np.random.default_rng([2, number]), WIDE)


def _narrow_shelves(number: int) -> Scene:
    """The same with compartments that a hand just fits into."""
    return _cabinets(f"narrow_shelves_{number}", np.random.default_rng([6, number]), NARROW)


def _cabinets(name: str, rng: np.random.Generator, sizes: _CabinetSizes) -> Scene:
    objects: list[SceneObject] = []
    heading = rng.uniform(-np.pi, np.pi)
    for k in range(rng.integers(1, 4)):
        T = pose((0.0, 0.0, 0.0), heading + k * rng.uniform(0.9, 1.6))
        objects.extend(_cabinet(f"cabinet_{k}", T, rng, sizes))
    return Scene(name, tuple(objects))


def _cabinet(
    name: str, T: np.ndarray, rng: np.random.Generator, sizes: _CabinetSizes
) -> list[SceneObject]:
    """A cabinet open towards the robot: back, two sides, boards, a few things inside."""
    near, depth, width = rng.uniform(0.35, 0.65), rng.uniform(0.25, 0.4), rng.uniform(*sizes.width)
    boards = rng.integers(*sizes.boards)
    levels = rng.uniform(-0.3, 0.3) + np.cumsum(
        np.concatenate([[0.0], rng.uniform(*sizes.gap, boards - 1)])
    )
    x, low, high = near + depth / 2, levels[0], levels[-1]
    parts = [
        ("back", (BOARD, width, high - low), (near + depth, 0.0, (low + high) / 2)),
        ("left", (depth, BOARD, high - low), (x, width / 2, (low + high) / 2)),
        ("right", (depth, BOARD, high - low), (x, -width / 2, (low + high) / 2)),
        *(
            (f"board_{i}", (depth, width, BOARD), (x, 0.0, float(level)))
            for i, level in enumerate(levels)
        ),
    ]
    objects = [
        SceneObject(f"{name}/{part}", Box(size), T @ pose(place)) for part, size, place in parts
    ]
    for i in range(rng.integers(0, 4)):
        radius, height = rng.uniform(0.03, 0.05), rng.uniform(0.08, 0.2)
        level = float(levels[rng.integers(0, boards - 1)])
        place = (x, rng.uniform(-0.4, 0.4) * width, level + BOARD / 2 + height / 2)
        objects.append(SceneObject(f"{name}/item_{i}", Cylinder(radius, height), T @ pose(place)))
    return objects


def _random_kitchen(number: int) -> Scene:
    """The parametric kitchen with other dimensions and doors and drawers moved at random."""
    rng = np.random.default_rng([3, number])
    published = KitchenParameters()
    names = [f.name for f in fields(published) if not f.name.startswith(FIXED)]
    while True:
        changed = rng.choice(names, size=len(names) // 2, replace=False)
        factors = {name: 1.0 + rng.uniform(-DIMENSION_SPREAD, DIMENSION_SPREAD) for name in changed}
        values = {name: getattr(published, name) * factor for name, factor in factors.items()}
        try:
            scene = kitchen(replace(published, **values))
        except InvalidInputError:  # pieces do not fit each other
            continue
        for joint in scene.articulations:
            if rng.random() < 0.4:
                scene = scene.with_joint(joint.name, rng.uniform(joint.lower, joint.upper))
        return Scene(f"kitchen_{number}", scene.objects)


FAMILIES: Mapping[str, Callable[[int], Scene]] = {  # cubes-spheres is the published training family
    "cubes-spheres": random_scene,
    "table": _table,
    "shelves": _shelves,
    "kitchen-like": _random_kitchen,
    "cluttered-table": _cluttered_table,
    "narrow-shelves": _narrow_shelves,
    "cage": _cage,
}
