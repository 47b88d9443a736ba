"""Second, independent judge of paths: no code of cvqmpt_lab, triangles of the files, fcl.

The judge reads json, URDF and meshes itself, and checks states of a path between which no point
moves by more than `STEP`. It uses no hulls: links and meshes are the triangles of the files, clouds
are balls, maps are cubes. Round solids are inscribed polyhedra, so every overlap found is real.
"""

import json
import xml.etree.ElementTree as ElementTree
from itertools import combinations, pairwise, product
from typing import NamedTuple

import numpy as np
import trimesh
from judged_bodies import Balls, Body, depth, moved, swallowed, touching
from scipy.spatial.transform import Rotation

STEP = 2e-4  # largest motion of a point between checked states [m]
STATES = 5  # largest number of states at which the depth of an overlapping pair is measured
SIDES = 96  # number of sides of the prism that stands for a cylinder
WORLD = 0  # group of bodies that do not move; group k moves with joint k


class Verdict(NamedTuple):
    """The deepest overlap found."""

    depth: float  # lower bound on the penetration depth [m]; 0 if nothing overlaps
    pair: tuple[str, str] = ("", "")
    at: float = 0.0  # index of the state; 12.5 is half-way from state 12 to 13


def body_of(item, group, T, folder):
    """Return the body of an object or attachment in json, at pose T (4, 4) in its group."""
    shape = item["shape"]
    if shape["type"] == "point_cloud":
        return Balls(item["name"], group, moved(T, np.array(shape["points"])), shape["radius"])
    return Body(item["name"], group, moved(T, triangles_of(shape, folder)))


def triangles_of(shape, folder):
    """Return triangles (f, 3, 3) of a json shape; a map gives cubes, padded along one axis each."""
    match shape["type"]:
        case "box":
            return trimesh.creation.box(shape["size"]).triangles
        case "cylinder":
            return trimesh.creation.cylinder(
                shape["radius"], shape["height"], sections=SIDES
            ).triangles
        case "sphere":
            return trimesh.creation.icosphere(subdivisions=4, radius=shape["radius"]).triangles
        case "convex_mesh":
            return trimesh.convex.convex_hull(shape["vertices"]).triangles
        case "mesh_file":
            return trimesh.load(folder / shape["path"], force="mesh", process=False).triangles
        case "occupancy_map":
            edge, more = shape["resolution"], 2.0 * shape["padding"]
            cubes = [trimesh.creation.box(size).triangles for size in edge + more * np.eye(3)]
            middles = (np.array(shape["cells"]) + 0.5) * edge
            return np.concatenate([cube + middle for middle in middles for cube in cubes])
    raise ValueError(shape["type"])


def link_triangles(geometry, folder):
    """Return triangles (f, 3, 3) of a <geometry> in a URDF of a folder."""
    (shape,) = geometry
    if shape.tag == "mesh":
        name = shape.get("filename").removeprefix("package://")
        path = next(above / name for above in (folder, *folder.parents) if (above / name).is_file())
        mesh = triangles_of({"type": "mesh_file", "path": path}, folder)
        return mesh * numbers(shape, "scale", "1 1 1")
    radius, height = (float(shape.get(name, 0.0)) for name in ("radius", "length"))
    size = {"size": numbers(shape, "size", ""), "radius": radius, "height": height}
    return triangles_of({"type": shape.tag, **size}, folder)


def numbers(element, key, otherwise):
    text = None if element is None else element.get(key)
    return np.array((text or otherwise).split(), dtype=float)


def pose_of(element):
    """Return the pose (4, 4) of an element's <origin>."""
    T, origin = np.eye(4), element.find("origin")
    T[:3, 3] = numbers(origin, "xyz", "0 0 0")
    T[:3, :3] = Rotation.from_euler("xyz", numbers(origin, "rpy", "0 0 0")).as_matrix()
    return T


def motion(joint, value):
    """Return the transforms (..., 4, 4) of a joint at values (...) [rad or m]."""
    axis = numbers(joint.find("axis"), "xyz", "1 0 0")
    along = np.asarray(value, dtype=float)[..., None] * axis / np.linalg.norm(axis)
    T = np.tile(np.eye(4), (*along.shape[:-1], 1, 1))
    if joint.get("type") == "prismatic":
        T[..., :3, 3] = along
    else:
        T[..., :3, :3] = Rotation.from_rotvec(along).as_matrix()
    return T


def held_value(joint, locked, joints):
    """Return a held joint's value: by the file, its mimicked joint, or the value nearest to 0."""
    mimic, limit = joint.find("mimic"), joint.find("limit")
    if joint.get("name") in locked:
        return locked[joint.get("name")]
    if mimic is not None:
        value = held_value(joints[mimic.get("joint")], locked, joints)
        return float(mimic.get("multiplier", 1.0)) * value + float(mimic.get("offset", 0.0))
    if joint.get("type") == "continuous" or limit is None:
        return 0.0
    lower, upper = (float(limit.get(end, 0.0)) for end in ("lower", "upper"))
    return min(max(0.0, lower), upper)


def holds(region):
    """Return whether a region in json fixes a hand to an object.

    Its bounds are at most 2 cm wide, and at most 0.2 rad about at least two axes; null: no bound.
    """
    wide = [np.inf if None in row else row[1] - row[0] for row in region["Bw"]]
    tilt = np.inf if region.get("tilt") is None else 2.0 * region["tilt"]
    return max(wide[:3]) <= 0.02 and min(sorted(wide[3:])[1], tilt) <= 0.2


class Arm:
    """Groups of rigidly joined links with joints and bodies, by the field "robot" of a problem."""

    def __init__(self, robot, folder, order, bodies=True):
        """Read the robot; order: names of joints in the order of states; bodies: with shapes."""
        path = (folder / robot["urdf"]).resolve()
        root, locked = ElementTree.parse(path).getroot(), robot.get("locked", {})
        joints = {joint.get("name"): joint for joint in root.findall("joint")}
        above = {joint.find("child").get("link"): joint for joint in joints.values()}
        hands = robot.get("end_effectors") or [robot["end_effector"]]
        moving = {}  # joints by name, from the hands to the base
        for link in hands:
            while link in above:
                if above[link].get("type") != "fixed" and above[link].get("name") not in locked:
                    moving[above[link].get("name")] = above[link]
                link = above[link].find("parent").get("link")
        self.joints = []  # of each group after the world: the group before it, T (4, 4), joint
        links = {link: (WORLD, np.eye(4))}  # of each: its group, and T (4, 4) in it
        waiting = list(joints.values())
        while waiting:
            later = order[len(self.joints) + 1 :]  # which wait for a joint before them
            hanging = (joint for joint in waiting if joint.find("parent").get("link") in links)
            joint = next(joint for joint in hanging if joint.get("name") not in later)
            waiting.remove(joint)
            group, T = links[joint.find("parent").get("link")]
            if joint.get("name") in moving:
                self.joints.append((group, T @ pose_of(joint), joint))
                group, T = len(self.joints), np.eye(4)
            else:
                T = T @ pose_of(joint)
                if joint.get("type") != "fixed":
                    T = T @ motion(joint, held_value(joint, locked, joints))
            links[joint.find("child").get("link")] = group, T
        self.frames, self.first, self.hand, self.bodies = links, hands[0], links[hands[0]], []
        for link in root.findall("link") if bodies else ():
            (group, T), found = links[link.get("name")], link.findall("collision")
            shapes = [link_triangles(x.find("geometry"), path.parent) for x in found]
            parts = [moved(T @ pose_of(x), it) for x, it in zip(found, shapes, strict=True)]
            self.bodies += [Body(link.get("name"), group, np.concatenate(parts))] if parts else []
        self.excused = set()
        if robot["srdf"]:
            pairs = ElementTree.parse(folder / robot["srdf"]).iter("disable_collisions")
            self.excused = {frozenset((pair.get("link1"), pair.get("link2"))) for pair in pairs}
        names = {body.name for body in self.bodies}
        for link in names & set(above):
            before = above[link].find("parent").get("link")
            while before in above and before not in names:
                before = above[before].find("parent").get("link")
            self.excused.add(frozenset((link, before)))  # the nearest one before it that has a body

    def pairs(self, excused=()):
        """Return pairs of links that must not overlap: other group, not adjacent, not excused."""
        skipped = self.excused | {frozenset(pair) for pair in excused}
        every = combinations(self.bodies, 2)
        return [(a, b) for a, b in every if a.group != b.group and {a.name, b.name} not in skipped]

    def carried(self, things, folder):
        """Return the bodies of attachments in json."""
        hands = [self.frames[x.get("end_effector") or self.first] for x in things]
        return [
            body_of(x, k, T @ np.array(x["T_hand_object"]), folder)
            for (k, T), x in zip(hands, things, strict=True)
        ]

    def carried_pairs(self, things, bodies, regions):
        """Return pairs of a load with links and other loads, except with the links that hold it.

        A second hand holds a load if a region in json with a base fixes this hand to the first.
        """
        holding = []
        for thing, body in zip(things, bodies, strict=True):
            tied = {body.group}
            for region in regions:
                keys = ("base", "end_effector")
                ends = {self.frames[region.get(key) or self.first][0] for key in keys}
                if region.get("base") and ends & tied and holds(region):
                    tied |= ends
            also = {self.frames[name][0] for name in thing.get("also_held_by", ())}
            holding.append({body.group, *(also & tied)})
        both = zip(bodies, holding, strict=True)
        found = [(a, b) for b, hands in both for a in self.bodies if a.group not in hands]
        every = combinations(zip(bodies, holding, strict=True), 2)
        apart = [(a, b) for (a, by), (b, of) in every if a.group not in of and b.group not in by]
        return found + apart

    def poses(self, states):
        """Return the poses of all groups (groups, k, 4, 4) at states (k, n)."""
        found = [np.tile(np.eye(4), (len(states), 1, 1))]
        for (before, T, joint), values in zip(self.joints, states.T, strict=True):
            found.append(found[before] @ T @ motion(joint, values))
        return np.array(found)

    def speeds(self, bodies, states):
        """Return bounds (n,) on motion of points per coordinate [m/rad or m/m]; states (k, n)."""
        outer, speeds = np.zeros(len(self.joints) + 1), np.ones(len(self.joints))
        for body in bodies:
            size = np.linalg.norm(body.points, axis=1).max() + body.radius
            outer[body.group] = max(outer[body.group], size)
        for k in range(len(self.joints), 0, -1):
            before, T, joint = self.joints[k - 1]
            slides = joint.get("type") == "prismatic"
            speeds[k - 1] = 1.0 if slides else outer[k]
            way = np.linalg.norm(T[:3, 3]) + slides * np.abs(states[:, k - 1]).max() + outer[k]
            outer[before] = max(outer[before], way)
        return speeds


class Judge:
    """Bodies of a problem file, and the pairs of bodies that must not overlap."""

    def __init__(self, path, arm, excused=()):
        """Read a problem; arm: its field "robot"; excused: more pairs of links that may overlap."""
        problem = json.loads(path.read_text())
        things, objects = problem["attachments"], problem["scene"]["objects"]
        regions = problem.get("constraint", [])
        self.regions = [regions] if isinstance(regions, dict) else regions
        carried = arm.carried(things, path.parent)
        obstacles = [body_of(x, WORLD, np.array(x["T_world_object"]), path.parent) for x in objects]
        self.arm, self.bodies = arm, [*arm.bodies, *carried, *obstacles]
        self.moving = [body for body in (*arm.bodies, *carried) if body.group != WORLD]
        in_hand = arm.carried_pairs(things, carried, self.regions)
        self.pairs = [*arm.pairs(excused), *in_hand, *product(self.moving, obstacles)]

    def walk(self, states):
        """Return the deepest overlap on straight motions between states (m, n)."""
        speeds, worst = self.arm.speeds(self.moving, states), Verdict(0.0)
        for k, (first, last) in enumerate(pairwise(states)):
            shares = np.linspace(0.0, 1.0, int(np.ceil(speeds @ np.abs(last - first) / STEP)) + 1)
            for share in np.array_split(shares, 1 + len(shares) // 500):
                found = self.look(first + share[:, None] * (last - first))
                worst = max(worst, found._replace(at=k + float(share[int(found.at)])))
        return worst

    def outside(self, states):
        """Return the largest violation of the regions between states (m, n) [m or rad]."""
        speeds, worst = self.arm.speeds(self.moving, states), 0.0
        for first, last in pairwise(states):
            shares = np.linspace(0.0, 1.0, int(np.ceil(speeds @ np.abs(last - first) / STEP)) + 1)
            poses = self.arm.poses(first + shares[:, None] * (last - first))
            worst = max([worst, *(self.excess(region, poses) for region in self.regions)])
        return worst

    def excess(self, region, poses):
        """Return the largest violation of a region in json at poses of groups (groups, k, 4, 4)."""
        base, e = region.get("base"), region.get("end_effector")
        b, T_base = self.arm.frames[base] if base else (WORLD, np.eye(4))
        k, T_e = self.arm.frames[e] if e else self.arm.hand
        w = poses[b] @ T_base @ np.array(region["T0_w"])
        displaced = np.linalg.inv(w) @ poses[k] @ T_e @ np.linalg.inv(np.array(region["Tw_e"]))
        turns = Rotation.from_matrix(displaced[:, :3, :3]).as_rotvec()
        # at a half turn v and -v are the same rotation: both count
        half = np.linalg.norm(turns, axis=1) > np.pi - 1e-6
        x = np.concatenate([displaced[:, :3, 3], turns], axis=1)
        x = np.concatenate([x, x[half] * np.repeat([1.0, -1.0], 3)])
        free = np.array([[-np.inf, np.inf]] * 6)
        bounds = np.array(region["Bw"], dtype=float)
        lower, upper = np.where(np.isnan(bounds), free, bounds).T
        tilts = np.arccos(displaced[:, 2, 2].clip(-1.0, 1.0))
        most = np.inf if region.get("tilt") is None else region["tilt"]
        return float(max((lower - x).max(), (x - upper).max(), (tilts - most).max()))

    def look(self, states):
        """Return the deepest overlap at states (k, n), which are close to each other."""
        poses, worst, boxes = self.arm.poses(states), Verdict(0.0), {}
        for body in self.bodies:
            T = poses[body.group]
            corners = np.einsum("kij,cj->kci", T[:, :3, :3], body.box) + T[:, None, :3, 3]
            boxes[body] = corners.min(axis=1), corners.max(axis=1)
        for a, b in self.pairs:
            (low, high), (least, most) = boxes[a], boxes[b]
            near = np.flatnonzero(((low < most) & (least < high)).all(axis=1))
            if len(near) == 0:
                continue
            T = np.linalg.inv(poses[a.group]) @ poses[b.group]
            hits = [k for k in near if touching(a, b, T[k])]
            hits = hits or [k for k in near[:1] if swallowed(a, b, T[k])]
            for k in hits[:: 1 + len(hits) // STATES]:
                worst = max(worst, Verdict(float(depth(a, b, T[k])), (a.name, b.name), k))
        return worst
