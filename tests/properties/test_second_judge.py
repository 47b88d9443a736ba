"""Motions with a valid certificate are checked again by the files' triangles (`second_judge`)."""

import json
import logging
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from judged_bodies import furthest, moved, swallowed, touching
from random_arms import ARMS as RANDOM_ARMS
from random_arms import joint, origin, random_urdf
from scipy.spatial.transform import Rotation
from second_judge import WORLD, Arm, Judge, body_of

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.benchmarks.two_arms import CARRYING_LAYOUTS, hold
from cvqmpt_lab.certificate.certificate import CERTIFICATE_TOLERANCE, certify
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.by_name.relative_pose import relative_pose
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem, really_held
from cvqmpt_lab.robot.left_out import OVERLAP
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.source import ARMS, example_robots
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget, JointPath

log = logging.getLogger(__name__)
ALLOWED = 1e-4  # [m]
WAY = (0.003, 0.05)  # [m] that points move in a case, at most
LEAST = 1e-6  # [m]
MOTIONS, OBSTACLES = 5, 4  # tried for a case
PLANNED, STRETCH = 20, 4  # of so many cases, one is so many states of a planned path
BUDGET = Budget(iterations=300)  # to plan it
PROMISE = "what is certified overlaps by 0.1 mm at most, by the files' triangles"
STANDING = (
    "standing meshes of the URDF: what is certified overlaps their triangles by at most 0.1 mm"
)
NOTHING = Scene("empty", ())
ROOM = "room"  # link that stands
JUDGED = 0.8  # share of cases in which there must be something to judge
DRAWN = 200  # configurations, of which one with two links near each other is chosen
SPREADS = (0.3, 0.1, 0.03, 0.01, 0.0)  # [rad or m] by which those that follow differ from it
CHAIN_STEPS = (0.01, 0.03, 0.1)  # [rad or m] between states of a closed chain, about
SLIPS = (0.0, 1e-4, 3e-4)  # [rad or m] by which joints leave it, so that bounds are nearly broken
# pose of the second hand in the frame of the first hand
FREEDOMS = ({}, {"position": 0.002, "rotation": 0.005}, {"about": "z"})
KINDS = len(CARRYING_LAYOUTS) * len(FREEDOMS)


class Given(NamedTuple):
    """An arm."""

    source: dict  # field "robot" of problem files
    robot: Robot
    checker: CollisionChecker  # of an empty scene
    arm: Arm  # as the judge reads it
    always: tuple[tuple[str, str], ...]  # links that overlap in nearly every configuration
    unseen: set[frozenset]  # pairs that the certificate leaves out for another reason
    held: tuple[dict, ...] = ()  # what two hands hold, field "attachments"
    chain: tuple[TaskSpaceRegion, ...] = ()  # how they hold it, and that it is level
    standing: frozenset = frozenset()  # links that a motion shall be near

    def kept(self, states):
        """Project states (k, n) onto the closed chain; leave out states for which this fails."""
        if not self.chain:
            return states
        manifold = RegionConstraint(self.robot, self.chain)
        found = [manifold.project(q, 1e-6) for q in states]
        return np.array([q for q in found if q is not None]).reshape(-1, self.robot.dof)

    def drawn(self, rng, count):
        """Configurations (at most count, n), on the closed chain if there is one."""
        return self.kept(self.robot.random_configurations(rng, count))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder for all tests: an arm is read once for a folder."""
    return tmp_path_factory.mktemp("arms")


@cache
def read_arm(name, folder):
    """Return an arm by name, or a random arm by number: source, robot and the judge's model.

    The judge takes the order of joints in states from the robot.
    """
    source = {"urdf": str(folder / f"arm_{name}.urdf"), "end_effector": "tool", "srdf": None}
    if name in ARMS:
        named, robots = ARMS[name], example_robots()
        files = {"urdf": str(robots / named.urdf), "srdf": named.srdf and str(robots / named.srdf)}
        hands = {"end_effector": named.end_effector, "end_effectors": list(named.end_effectors)}
        hands = {key: value for key, value in hands.items() if value}
        source = files | hands | {"locked": dict(named.locked)}
    else:
        (folder / source["urdf"]).write_bytes(random_urdf(name))
    robot = robot_from_source(source)
    return source, robot, Arm(source, folder, robot.joint_names)


@cache
def standing_arm(number, folder):
    """Return a random arm with a concave mesh as a link beside it, on the base or on the ground."""
    rng, name = np.random.default_rng(number), f"standing_{number}"
    room(rng).export(folder / f"{name}.stl")
    body = f'<geometry><mesh filename="{name}.stl"/></geometry>'
    link = f'<link name="{ROOM}"><collision>{body}</collision></link>'
    place = origin(rng, rng.choice([0.1, 0.5]))
    mounted = joint("mounted", "fixed", "base", ROOM, place)
    text = random_urdf(number).decode().replace("</robot>", f"{link}{mounted}</robot>")
    (folder / f"{name}.urdf").write_text(text)
    source = {"urdf": str(folder / f"{name}.urdf"), "end_effector": "tool", "srdf": None}
    robot = robot_from_source(source)
    arm, checker = Arm(source, folder, robot.joint_names), CollisionChecker(robot, NOTHING)
    always = overlapping_links(robot, arm)
    states = robot.random_configurations(rng, 50)
    for pair in always:
        if ROOM in pair:  # standing bodies are left out only where no state is free of them
            assert overlaps_in(arm, pair, states) > 0.9, (number, pair)
    return Given(source, robot, checker, arm, always, set(), standing=frozenset([ROOM]))


def overlapping_links(robot, arm):
    """Return the pairs of links that are left out because they, or pieces of them, overlap."""
    links = {body.name for body in arm.bodies}
    return tuple(  # of pairs of pieces, LINK_NUMBER, the pairs of their links
        tuple(name if name in links else name.rpartition("_")[0] for name in pair[:2])
        for pair in robot.left_out_pairs
        if pair.reason.startswith(OVERLAP)
    )


def overlaps_in(arm, pair, states):
    """Return the share of states (k, n) in which two links overlap by their triangles."""
    a, b = (next(body for body in arm.bodies if body.name == name) for name in pair)
    poses = arm.poses(states)
    between = np.linalg.inv(poses[a.group]) @ poses[b.group]
    return np.mean([touching(a, b, T) or swallowed(a, b, T) for T in between])


def room(rng):
    """A floor with a column, a wall with a hole, a shelf, a ring or a box without a lid."""
    a, b, c = rng.uniform(0.3, 1.2, 3)
    d, kind = rng.uniform(0.01, 0.08), rng.integers(5)
    if kind == 0:
        return trimesh.creation.torus(a, d, 16, 6)
    plates = {
        1: [((a, b, d), (0, 0, 0)), ((2 * d, 2 * d, c), (a / 4, b / 4, c / 2))],
        2: [((a, d, c / 3), (0, 0, z)) for z in (-c / 3, c / 3)]
        + [((a / 3, d, c / 3), (x, 0, 0)) for x in (-a / 3, a / 3)],
        3: [((a, b, d), (0, 0, z)) for z in (0, c / 2, c)] + [((d, b, c), (-a / 2, 0, c / 2))],
        4: [((a, b, d), (0, 0, 0))]
        + [((d, b, c), (x, 0, c / 2)) for x in (-a / 2, a / 2)]
        + [((a, d, c), (0, y, c / 2)) for y in (-b / 2, b / 2)],
    }[int(kind)]
    placed = trimesh.transformations.translation_matrix
    boxes = [trimesh.creation.box(size, transform=placed(at)) for size, at in plates]
    return trimesh.util.concatenate(boxes).subdivide_to_size(0.1)


@cache
def given_arm(name, folder, kind=0):
    """Return an arm; kind: way in which two hands hold an object."""
    source, robot, arm = read_arm(name, folder)
    out = [(pair.first, pair.second, pair.reason) for pair in robot.left_out_pairs]
    always = overlapping_links(robot, arm)
    unseen = {frozenset((first, second)) for first, second, _ in out}
    held, chain = both_hold(robot, kind) if len(robot.end_effectors) > 1 else ((), ())
    checker = CollisionChecker(robot, NOTHING, really_held(robot, held, chain))
    plain = tuple({**to_plain(x), "T_hand_object": x.T_hand_object.tolist()} for x in held)
    return Given(source, robot, checker, arm, always, unseen, plain, chain)


def both_hold(robot, kind):
    """Return an object in both hands: held rigidly, with play, or turning about a hand's axis."""
    number, freedom = divmod(kind, len(FREEDOMS))
    item, _, (closed, level) = hold(robot, [*CARRYING_LAYOUTS][number])
    free = relative_pose(closed.base, closed.T0_w, **FREEDOMS[freedom])
    return (item,), (free.changed(end_effector=closed.end_effector), level)


def arm_of(name, number, folder):
    """The arm of a case."""
    if name == "standing":
        return standing_arm(number % RANDOM_ARMS, folder)
    if name in ARMS and ARMS[name].end_effectors:
        return given_arm(name, folder, number % KINDS)
    return given_arm(number % RANDOM_ARMS if name == "random" else name, folder)


def shape(rng, folder, carried=False):
    """A json shape: solid, sheet, needle or cloud; if not carried, also map or non-convex mesh."""
    kinds = ("box", "bar", "cylinder", "sphere", "convex_mesh", "point_cloud")
    kind = rng.choice(kinds if carried else (*kinds, "point_cloud", "occupancy_map", "mesh_file"))
    a, b, c = size = 10.0 ** rng.uniform(-2.0, -0.5, 3)
    if kind in ("box", "bar"):
        size[: rng.integers(3) * (kind == "bar")] = 10.0 ** rng.uniform(-5.0, -1.5)
        return {"type": "box", "size": size.tolist()}
    if kind == "convex_mesh":
        return {"type": kind, "vertices": (rng.uniform(-1.0, 1.0, (8, 3)) * size).tolist()}
    if kind == "point_cloud":
        count = rng.choice([1, 10, 300] if carried else [1, 300, 1001, 3000])
        points = rng.standard_normal((count, 3)) * size
        points[1:] += rng.integers(2) * (0.5 if carried else 30.0) * unit(rng)  # one ball alone
        return {"type": kind, "points": points.tolist(), "radius": 10.0 ** rng.uniform(-3.0, -1.3)}
    if kind == "occupancy_map":
        cells = rng.integers(-3, 4, (rng.choice([1, 30, 200]), 3)) + rng.integers(-50, 50, 3)
        sizes = {"resolution": 0.1 * a, "padding": 0.01 * rng.integers(2)}
        return {"type": kind, "cells": cells.tolist(), **sizes}
    if kind == "mesh_file":
        return {"type": kind, "path": concave(rng, folder).name}
    return {"type": kind, "radius": a / 2} | ({"height": b * c} if kind == "cylinder" else {})


def concave(rng, folder):
    """Return the mesh file of a ring or of a bracket."""
    mesh = trimesh.creation.torus(*rng.uniform((0.05, 0.01), (0.2, 0.04)), 10, 5)
    a, b, c = rng.uniform(0.05, 0.3, 3)
    if rng.random() < 0.7:
        outline = np.array([(0.0, 0.0), (a, 0.0), (a, 0.02), (0.02, 0.02), (0.02, b), (0.0, b)])
        faces = [(0, k, k + 1) for k in range(1, 5)]
        mesh = trimesh.creation.extrude_triangulation(outline, faces, c)
    path = folder / f"{rng.integers(1 << 30)}.stl"
    mesh.export(path)
    return path


def unit(rng):
    direction = rng.standard_normal(3)
    return direction / np.linalg.norm(direction)


def free(given, rng):
    """A configuration without contact between links, if one is found soon."""
    drawn = given.drawn(rng, 60 if given.chain else 20)
    return next((q for q in drawn if not given.checker.in_collision(q)), drawn[0])


def near_each_other(given, rng):
    """A configuration that the checker calls free, with two links in or near contact."""
    robot, states = given.robot, given.drawn(rng, DRAWN)
    held = given.arm.carried(given.held, Path())
    poses, pairs = given.arm.poses(states), given.arm.pairs(given.always)
    chain = [region_in_json(region) for region in given.chain]
    pairs = [*pairs, *given.arm.carried_pairs(given.held, held, chain)]
    pairs = [pair for pair in pairs if (gaps(*pair, poses, 1) < 0.0).any()]
    pairs = [pair for pair in pairs if given.standing & {x.name for x in pair}] or pairs
    unseen = [(a, b) for a, b in pairs if {a.name, b.name} in given.unseen]
    pairs = unseen if unseen and rng.random() < 0.5 else pairs
    if not pairs:
        return free(given, rng)
    pair = pairs[rng.integers(len(pairs))]
    for spread in SPREADS:
        order = gaps(*pair, given.arm.poses(states), 40).argsort()[:40]
        free_ones = (q for q in states[order] if not given.checker.in_collision(q))
        nearest = next(free_ones, states[order[0]])
        around = nearest + spread * rng.standard_normal((DRAWN, robot.dof))
        states = given.kept(np.clip(around, robot.lower, robot.upper))
        states = np.concatenate([nearest[None], states])
    return nearest


def gaps(a, b, poses, count):
    """Distances (k,) of about `count` corners of two bodies; for 1, of balls around the bodies."""
    if count > 1:
        some, balls = [x.points[:: 1 + len(x.points) // count] for x in (a, b)], 0.0
    else:
        some = [x.box.mean(axis=0)[None] for x in (a, b)]
        balls = sum(np.linalg.norm(x.box[-1] - x.box[0]) / 2 for x in (a, b))
    first, second = (
        np.einsum("kij,cj->kci", poses[x.group, :, :3, :3], points) + poses[x.group, :, None, :3, 3]
        for x, points in zip((a, b), some, strict=True)
    )
    return np.linalg.norm(first[:, :, None] - second[:, None], axis=3).min(axis=(1, 2)) - balls


def short_motion(given, held, rng):
    """States (k, n) of a straight motion, and the state (n,) that was drawn."""
    near = 0.8 if given.standing else 0.4
    robot, drawn = given.robot, (near_each_other if rng.random() < near else free)(given, rng)
    change = rng.standard_normal(robot.dof) * (rng.random(robot.dof) < rng.choice([0.3, 1.0]))
    if given.chain:  # along the closed chain, then onto it
        J = RegionConstraint(robot, given.chain[:1]).residual_and_jacobian(drawn, full=True)[1]
        change -= np.linalg.pinv(J) @ J @ change
    speeds = given.arm.speeds([*given.arm.bodies, *held], drawn[None])
    change *= rng.uniform(*WAY) / max(speeds @ np.abs(change), LEAST)
    share = rng.random()
    ends = [drawn - share * change, drawn + (1.0 - share) * change]
    ends = np.clip(ends, robot.lower, robot.upper)
    step = rng.choice(CHAIN_STEPS) if given.chain else 0.1
    states = given.kept(np.linspace(*ends, 2 + int(np.linalg.norm(ends[1] - ends[0]) / step)))
    if given.chain:
        states = states + rng.choice(SLIPS) * rng.uniform(-1.0, 1.0, states.shape)
    return np.clip(states, robot.lower, robot.upper), drawn


def attachment(rng, folder):
    """An object in the hand or in front of it."""
    made, T = shape(rng, folder, carried=True), np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    body = body_of({"name": "", "shape": made}, WORLD, T, folder)
    lowest = furthest(body, np.array([0.0, 0.0, -1.0]))
    T[:3, 3] = (0.0, 0.0, rng.uniform(-0.02, 0.15)) - lowest
    return {"name": "carried", "shape": made, "T_hand_object": T.tolist()}


def obstacle(given, held, q, rng, folder):
    """An object that nearly touches a link or what is held at q, or goes into it by up to 1 cm."""
    moving = [body for body in given.arm.bodies if body.group != WORLD]
    things = held if held and rng.random() < 0.4 else moving
    thing, direction = things[rng.integers(len(things))], unit(rng)
    T_group = given.arm.poses(q[None])[thing.group, 0]
    contact, direction = moved(T_group, furthest(thing, direction)), T_group[:3, :3] @ direction
    made, T, outward = shape(rng, folder), np.eye(4), unit(rng)
    body = body_of({"name": "", "shape": made}, WORLD, T, folder)
    point = furthest(body, outward)
    if made["type"] == "mesh_file" and rng.random() < 0.7:  # inside the ring or bracket
        corners = body.triangles[rng.integers(len(body.triangles))]
        outward = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        point = rng.dirichlet(np.ones(3)) @ corners
    turn = Rotation.align_vectors([-direction], [outward])[0]
    T[:3, :3] = (Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * direction) * turn).as_matrix()
    gap = rng.choice([-1.0, 1.0, 1.0]) * 10.0 ** rng.uniform(-4.0, -2.0)
    T[:3, 3] = contact + gap * direction - T[:3, :3] @ point
    name = f"obstacle_{rng.integers(1 << 30)}"
    return {"name": name, "shape": made, "T_world_object": T.tolist()}


def region_in_json(region):
    """A region with its poses in full."""
    return {**to_plain(region), "T0_w": region.T0_w.tolist(), "Tw_e": region.Tw_e.tolist()}


def problem_of(path, given, objects, attachments, states):
    """The problem of a motion, written to a file and read from it."""
    scene = {"name": "made", "objects": objects}
    data = {"schema": PlanningProblem.SCHEMA, "name": "made", "robot": given.source}
    ends = {"start": states[0].tolist(), "goals": [states[-1].tolist()]}
    data["constraint"] = [region_in_json(region) for region in given.chain]
    path.write_text(json.dumps({**data, "scene": scene, **ends, "attachments": attachments}))
    return PlanningProblem.load(path)


def certified(problem, states):
    return certify(problem, JointPath(states)).valid


def planned(given, problem, states, rng):
    """Return a part of a certified path from the states to a free state, else the states."""
    checker = problem.collision_checker()
    goals = [q for q in given.drawn(rng, 40) if not checker.in_collision(q)]
    starts = [q for q in given.kept(states[:1]) if not checker.in_collision(q)]
    if not goals or not starts:
        return states
    posed = replace(problem, start=starts[0], goals=np.array(goals[:1]))
    found = solve(posed, "birrt", BUDGET, 0)
    path = found.path.states if found.solved else states
    first = rng.integers(len(path) - 1)
    return path[first : first + STRETCH]


def judged(name, number, folder):
    """The judge's verdict of a case by its number, and how far its regions are left [m, rad].

    None if no motion is certified.

    Obstacles are added one by one and kept only if the motion is still certified.
    """
    rng = np.random.default_rng([number, *name.encode()])
    given, path = arm_of(name, number, folder), folder / "problem.json"
    for _ in range(MOTIONS):
        attachments = [attachment(rng, folder)] if rng.random() < 0.4 else []
        attachments = [*given.held] or attachments
        held = given.arm.carried(attachments, folder)
        states, drawn = short_motion(given, held, rng)
        if len(states) < 2:
            continue
        problem, objects = problem_of(path, given, [], attachments, states), []
        if certified(problem, states):
            break
    else:
        return None
    for _ in range(OBSTACLES):
        made = obstacle(given, held, drawn, rng, folder)
        # each is read only once
        more = problem_of(path, given, [made], attachments, states).scene.objects
        fuller = replace(problem, scene=problem.scene.with_objects(*more))
        if certified(fuller, states):
            problem, objects = fuller, [*objects, made]
    problem_of(path, given, objects, attachments, states)
    states = planned(given, problem, states, rng) if number % PLANNED == PLANNED - 1 else states
    judge = Judge(path, given.arm, given.always)
    return judge.walk(states), judge.outside(states)


@pytest.mark.parametrize(
    "name", ["panda", "ur5", "xarm7", "tiago", "random", "baxter", "tiago-pro"]
)
@pytest.mark.promise(PROMISE, "cases", ci=6, long=2000)
def test_certified_motions(name, trials, folder):
    judge_cases(name, trials, folder)


@pytest.mark.promise(STANDING, "cases", ci=3, long=2000)
def test_certified_motions_beside_standing_meshes(trials, folder):
    judge_cases("standing", trials, folder)


def judge_cases(name, trials, folder):
    """Judge the cases of a kind of arm; all must be right, and most must have a motion."""
    verdicts = {number: judged(name, number, folder) for number in range(trials)}
    found = {number: verdict for number, verdict in verdicts.items() if verdict is not None}
    left = {
        number: outside
        for number, (_, outside) in found.items()
        if outside > CERTIFICATE_TOLERANCE + 1e-6
    }
    arms = (arm_of(name, number, folder) for number in range(min(trials, RANDOM_ARMS)))
    excused = {pair for one in arms for pair in one.always}
    counts = name, len(found), trials, sorted(excused)
    log.info("%s: %d of %d cases certified, links not compared: %s", *counts)
    assert {number: deep for number, (deep, _) in found.items() if deep.depth > ALLOWED} == {}
    assert left == {}
    assert len(found) >= JUDGED * trials


CUBE = (0.02 * (np.indices((2, 2, 2)).reshape(3, 8).T - 0.5)).tolist()
CELLS = {"cells": [[0, 0, 0], [-1, -1, -1]], "resolution": 0.01, "padding": 0.01}
AROUND = (
    {"type": "box", "size": [0.02, 0.03, 0.04]},
    {"type": "cylinder", "radius": 0.01, "height": 0.02},
    {"type": "sphere", "radius": 3.0},  # around the whole arm
    {"type": "convex_mesh", "vertices": CUBE},
    {"type": "point_cloud", "points": [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]], "radius": 0.01},
    {"type": "occupancy_map", **CELLS},
)


@pytest.mark.parametrize("size", AROUND, ids=lambda size: size["type"])
def test_judge_sees_what_a_corner_of_a_link_is_in(size, folder):
    """An object 5 mm deep or more is found; without it there is no overlap."""
    given, rng = given_arm("panda", folder), np.random.default_rng(0)
    q, body, T = free(given, rng), given.arm.bodies[-1], np.eye(4)
    T[:3, 3] = moved(given.arm.poses(q[None])[body.group, 0], body.points[0])
    item = {"name": "around", "shape": size, "T_world_object": T.tolist()}
    for objects, deep in (([item], 0.005), ([], 0.0)):
        problem_of(folder / "problem.json", given, objects, [], q[None])
        verdict = Judge(folder / "problem.json", given.arm).look(q[None])
        assert verdict.depth >= deep and (verdict.depth > 0.0) == bool(objects)


def test_judge_sees_a_hand_that_lets_go(folder):
    """A wrist that turns violates the chain by its angle; a hand that lets go overlaps."""
    given, rng = given_arm("baxter", folder), np.random.default_rng(0)
    q, path = free(given, rng), folder / "problem.json"
    for held, turn in (
        (given.held, 0.0),
        (given.held, 0.05),
        ([{**given.held[0], "also_held_by": []}], 0.0),
    ):
        end = q + turn * np.eye(given.robot.dof)[-1]
        problem_of(path, given, [], held, np.array([q, end]))
        judge = Judge(path, given.arm, given.always)
        assert judge.outside(np.array([q, end])) == pytest.approx(turn, abs=1e-5)
        assert (judge.look(q[None]).depth > 0.005) == (held != given.held)
