"""False stops and kept contacts of bodies and worlds: states and motions close to obstacles.

    python -m cvqmpt_lab.experiments.bench.false_stops --cases 200

Five arms stand among random bodies. The reference is coal with the triangles of the collision
meshes and the true bodies. States that it calls free, 1.5 to 50 mm from an obstacle, and motions
around such states that its distances prove free, should not be stopped; states and motions that
touch must be stopped. The arm's bodies are oriented boxes, hulls, convex pieces or the triangles;
the world is voxels, which are occupied where a body overlaps them, or the true bodies. Motions of
the first three are stopped where the certificate does not prove them free; of the triangles,
where one of the states touches. The arm is not compared with itself.
"""

import argparse
import tempfile
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin
import trimesh

from cvqmpt_lab.certificate.motion_proof import prove_free
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.collision.solids import Solid, obstacles_within
from cvqmpt_lab.experiments.bench.proofs import ARMS, problem_of
from cvqmpt_lab.robot.hulls import MeshFile, take_meshes, triangles_of_file
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.source import RobotSource, mesh_path, read_source
from cvqmpt_lab.scene.coal_shapes import transform
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import OccupancyMap

EDGES_M = (0.025, 0.015)  # of voxels
CLOSE_M = (0.0015, 0.05)  # distances of free states from obstacles
SAMPLES = 200  # states of a motion
LONGEST_M = 0.2  # way of any point on a motion
CASES_A_SCENE = 5  # of each kind
KINDS = ("states", "motions")


class Arm(NamedTuple):
    """An arm with three kinds of bodies, and its triangles."""

    robots: dict[str, Robot]
    triangles: list[tuple[int, coal.Transform3s, coal.CollisionGeometry]]


class Case(NamedTuple):
    """A state (1, n) or a motion (SAMPLES, n), and whether it touches."""

    states: np.ndarray
    touches: bool


def arm_of(name: str, folder: Path) -> Arm:
    """Return an arm; files of its other bodies are written to a folder."""
    given = read_source(robot_from_source({"name": name}).source)
    root = ElementTree.parse(given.urdf).getroot()
    for mesh in root.iter("mesh"):
        folders = [Path(path) for path in given.package_dirs]
        mesh.set("filename", str(mesh_path(mesh.get("filename", ""), Path(given.urdf), folders)))
    links = [link.get("name", "") for link in root.iter("link")]
    pairs = "".join(
        f'<disable_collisions link1="{a}" link2="{b}" reason="User"/>'
        for a, b in combinations(links, 2)
    )
    (folder / f"{name}.srdf").write_text(f'<robot name="{root.get("name")}">{pairs}</robot>')
    (folder / f"{name}.urdf").write_bytes(ElementTree.tostring(root))
    for shape in root.findall("link/collision"):
        if shape.find("geometry/mesh") is not None:
            _put_box(shape)
    (folder / f"{name}-boxes.urdf").write_bytes(ElementTree.tostring(root))
    kinds = {
        "boxes": (f"{name}-boxes.urdf", True),
        "hulls": (f"{name}.urdf", True),
        "pieces": (f"{name}.urdf", False),
    }
    robots = {kind: _robot(folder, name, given, *parts) for kind, parts in kinds.items()}
    return Arm(robots, list(_triangles(robots["hulls"], folder / f"{name}.urdf")))


def _robot(folder: Path, name: str, given: RobotSource, urdf: str, one_hull: bool) -> Robot:
    return robot_from_source(
        {
            "urdf": str(folder / urdf),
            "srdf": str(folder / f"{name}.srdf"),
            "end_effector": given.end_effector,
            "locked": dict(given.locked),
            "one_hull_a_mesh": one_hull,
        }
    )


def _put_box(shape: ElementTree.Element) -> None:
    """Replace the mesh of a <collision> by the least oriented box around it."""
    (kind,) = shape.findall("geometry/mesh")
    scale = [float(word) for word in kind.get("scale", "1 1 1").split()]
    points, _ = triangles_of_file(kind.get("filename", ""), scale)
    T_box_mesh, size = trimesh.bounds.oriented_bounds(points)
    origin = shape.find("origin")
    T = np.eye(4)
    if origin is not None:
        T[:3, 3] = [float(word) for word in origin.get("xyz", "0 0 0").split()]
        roll, pitch, yaw = (float(word) for word in origin.get("rpy", "0 0 0").split())
        T[:3, :3] = pin.rpy.rpyToMatrix(roll, pitch, yaw)
        shape.remove(origin)
    T = T @ np.linalg.inv(T_box_mesh)
    rpy = pin.rpy.matrixToRpy(T[:3, :3])
    words = {
        "xyz": " ".join(map(repr, T[:3, 3].tolist())),
        "rpy": " ".join(map(repr, rpy.tolist())),
    }
    ElementTree.SubElement(shape, "origin", words)
    kind.tag = "box"
    kind.attrib.clear()
    kind.set("size", " ".join(map(repr, size.tolist())))


def _triangles(
    robot: Robot, urdf: Path
) -> Iterator[tuple[int, coal.Transform3s, coal.CollisionGeometry]]:
    """Yield joint, pose and triangles, or the solid, of each body that moves."""
    meshes = take_meshes(ElementTree.parse(urdf).getroot())
    for item in robot.collision_model.geometryObjects:
        if item.parentJoint:
            pose = coal.Transform3s(item.placement.rotation, item.placement.translation)
            mesh = meshes.get(item.name)
            yield item.parentJoint, pose, item.geometry if mesh is None else _surface(mesh)


def _surface(mesh: MeshFile) -> coal.BVHModelOBBRSS:
    points, faces = triangles_of_file(*mesh)
    corners, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    corners.extend(list(points))
    triangles.extend([coal.Triangle(*row) for row in faces.tolist()])
    surface = coal.BVHModelOBBRSS()
    surface.beginModel(len(triangles), len(corners))
    surface.addSubModel(corners, triangles)
    surface.endModel()
    return surface


class Reference:
    """Triangles of an arm against bodies."""

    def __init__(self, arm: Arm, solids: list[Solid]) -> None:
        robot = arm.robots["hulls"]
        self._robot, self._data = robot, robot.model.createData()
        self._bodies = arm.triangles
        self._objects = [coal.CollisionObject(shape) for *_, shape in arm.triangles]
        # a manager does not own its objects
        self._solids = [
            coal.CollisionObject(solid.shape, transform(solid.T_parent_shape)) for solid in solids
        ]
        self._world = coal.DynamicAABBTreeCollisionManager()
        self._world.registerObjects(self._solids)
        self._world.setup()

    def _place(self, q: np.ndarray) -> None:
        values = self._robot.kinematics.joint_values(q)
        pin.forwardKinematics(self._robot.model, self._data, values)
        for item, (joint, pose, _) in zip(self._objects, self._bodies, strict=True):
            placed = self._data.oMi[joint]
            own = coal.Transform3s(placed.rotation, placed.translation) * pose
            item.setTransform(own)
            item.computeAABB()

    def touches(self, q: np.ndarray) -> bool:
        """Return whether state q (n,) touches a body."""
        self._place(q)
        for item in self._objects:
            callback = coal.CollisionCallBackDefault()
            self._world.collide(item, callback)
            if callback.data.result.isCollision():
                return True
        return False

    def distance(self, q: np.ndarray) -> float:
        """Return the distance of state q (n,) from the nearest body [m]; 0: it touches."""
        if self.touches(q):
            return 0.0
        least = np.inf
        for item in self._objects:
            callback = coal.DistanceCallBackDefault()
            self._world.distance(item, callback)
            least = min(least, callback.data.result.min_distance)
        return max(float(least), 0.0)


def voxels(rng: np.random.Generator, solids: list[Solid], edge: float) -> Scene:
    """Return a map of the cells that bodies overlap, in a grid with a random origin."""
    origin, box, found = rng.uniform(0.0, edge, 3), coal.Box(edge, edge, edge), set()
    for solid in solids:
        body = coal.CollisionObject(solid.shape, transform(solid.T_parent_shape))
        body.computeAABB()
        low, high = (
            np.floor((end - origin) / edge).astype(int)
            for end in (body.getAABB().min_, body.getAABB().max_)
        )
        for cell in np.ndindex(*(high - low + 1)):
            place = origin + (low + cell + 0.5) * edge
            result = coal.CollisionResult()
            at = coal.CollisionObject(box, coal.Transform3s(np.eye(3), place))
            if coal.collide(body, at, coal.CollisionRequest(), result):
                found.add(tuple((low + cell).tolist()))
    T = np.eye(4)
    T[:3, 3] = origin
    shape = OccupancyMap(np.array(sorted(found), dtype=float), resolution=edge)
    return Scene("voxels", (SceneObject("voxels", shape, T),))


def close_states(
    rng: np.random.Generator, robot: Robot, reference: Reference, touching: bool
) -> np.ndarray | None:
    """Return a state (n,) close to an obstacle, or touching it by a few millimetres; or None.

    It lies on a line between a free state and one that touches.
    """
    ends: list[np.ndarray | None] = [None, None]
    for q in robot.random_configurations(rng, 40):
        ends[int(reference.touches(q))] = q
    free, hit = ends
    if free is None or hit is None:
        return None
    gap = 0.0 if touching else float(rng.uniform(*CLOSE_M))
    low, high = 0.0, 1.0  # farther than gap, and nearer
    if reference.distance(free) <= gap:
        return None
    for _ in range(14):
        middle = 0.5 * (low + high)
        near = reference.distance(free + middle * (hit - free)) <= gap
        low, high = (low, middle) if near else (middle, high)
    beyond = float(rng.uniform(0.001, 0.005)) if touching else 0.0
    way = robot.reach * np.abs(hit - free).sum()  # bounds that of any point, for hinges
    q = free + (high + beyond / way if touching else low) * (hit - free)
    return q if reference.touches(q) == touching else None


def cases(
    rng: np.random.Generator, robot: Robot, reference: Reference, motions: bool
) -> Iterator[Case]:
    """Yield at most CASES_A_SCENE free cases, and as many that touch."""
    left = {False: CASES_A_SCENE, True: CASES_A_SCENE}
    for _ in range(12 * CASES_A_SCENE):
        touching = left[True] > left[False]
        q = close_states(rng, robot, reference, touching and not motions)
        if q is None:
            continue
        case = _motion(rng, robot, reference, q) if motions else Case(q[None], touching)
        if case is not None and left[case.touches]:
            left[case.touches] -= 1
            yield case
        if not any(left.values()):
            return


def _motion(
    rng: np.random.Generator, robot: Robot, reference: Reference, q: np.ndarray
) -> Case | None:
    """Return a straight motion around a state; None: what the reference says of it is unsure."""
    way = rng.normal(size=len(q))
    way *= LONGEST_M / (robot.reach * np.abs(way).sum())
    states = q + np.linspace(-0.5, 0.5, SAMPLES)[:, None] * way
    if (states < robot.lower).any() or (states > robot.upper).any():
        return None
    if any(reference.touches(state) for state in states):
        return Case(states, True)
    at = 0.0
    while at < 1.0:
        distance = reference.distance(q + (at - 0.5) * way)
        if distance < CLOSE_M[0]:
            return None
        at += (distance - 0.5 * CLOSE_M[0]) / LONGEST_M  # no point goes farther until then
    return Case(states, False)


def stopped(case: Case, checker: CollisionChecker | None, world: Reference | None) -> bool:
    """Return whether a case is stopped: by hulls in a world, or by triangles."""
    if world is not None:
        return any(world.touches(q) for q in case.states)
    assert checker is not None
    if len(case.states) == 1:
        return checker.in_collision(case.states[0])
    proof = prove_free(checker, case.states[[0, -1]])
    return proof.colliding is not None or proof.unproven is not None


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--cases", type=int, default=200, help="free states, free motions; half as many touch"
    )
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng, counts, totals = np.random.default_rng(args.seed), Counter[Any](), Counter[Any]()
    with tempfile.TemporaryDirectory() as name:
        arms = {arm: arm_of(arm, Path(name)) for arm in ARMS}
        scene = 0
        most = {False: args.cases, True: args.cases // 2}
        while any(totals[what, touches] < most[touches] for what, touches in product(KINDS, most)):
            name_of_arm = ARMS[scene % len(ARMS)]
            scene += 1
            _judge_scene(rng, name_of_arm, arms[name_of_arm], counts, totals, most)
    _print(counts, totals)


def _judge_scene(
    rng: np.random.Generator,
    name: str,
    arm: Arm,
    counts: Counter,
    totals: Counter,
    most: dict[bool, int],
) -> None:
    """Judge the cases of one random scene in all conditions."""
    objects = problem_of(rng, name)[0].scene
    robot = arm.robots["hulls"]
    solids = list(obstacles_within(objects, robot.reach))
    if not solids:
        return
    worlds = {f"voxels, {1e3 * edge:g} mm": voxels(rng, solids, edge) for edge in EDGES_M}
    worlds["bodies"] = objects
    reference = Reference(arm, solids)
    meshes = {
        world: Reference(arm, list(obstacles_within(scene, robot.reach)))
        for world, scene in worlds.items()
    }
    checkers = {
        (kind, world): CollisionChecker(of_kind, scene)
        for kind, of_kind in arm.robots.items()
        for world, scene in worlds.items()
    }
    for what in KINDS:
        for case in cases(rng, robot, reference, what == "motions"):
            if totals[what, case.touches] >= most[case.touches]:
                continue
            totals[what, case.touches] += 1
            for (kind, world), checker in checkers.items():
                counts[kind, world, what, case.touches] += stopped(case, checker, None)
            for world, triangles in meshes.items():
                counts["meshes", world, what, case.touches] += stopped(case, None, triangles)


def _print(counts: Counter, totals: Counter) -> None:
    """Print the table in Markdown."""
    heads = [
        f"{'contacts kept' if touches else 'false stops'}, {what} (of {totals[what, touches]})"
        for what in KINDS
        for touches in (False, True)
    ]
    print("|arm|world|" + "|".join(heads) + "|\n|---|---|" + "---|" * 4)
    for kind in ("boxes", "hulls", "pieces", "meshes"):
        for world in (*(f"voxels, {1e3 * edge:g} mm" for edge in EDGES_M), "bodies"):
            row = [
                counts[kind, world, what, touches] for what in KINDS for touches in (False, True)
            ]
            print(f"|{kind}|{world}|" + "|".join(map(str, row)) + "|")


if __name__ == "__main__":
    main()
