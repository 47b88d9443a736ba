"""Proofs that motions keep a named constraint, judged at dense states by pinocchio and numpy."""

import numpy as np
import pinocchio as pin
import pytest
from random_arms import ARMS, two_armed

from cvqmpt_lab.certificate.between_states import largest_violation
from cvqmpt_lab.certificate.certificate import CERTIFICATE_TOLERANCE, CHECK_SPACING_RAD
from cvqmpt_lab.constraints.centre_of_mass import CentreOfMass
from cvqmpt_lab.constraints.named import region
from cvqmpt_lab.robot.dynamics import Load
from cvqmpt_lab.robot.load import robot_from_source

DENSE = 401  # states at which a motion is judged


def distances(at, points):
    """Distance of positions (k, 3) from a point each (k or 1, 3)."""
    return np.linalg.norm(at - points, axis=1)


def judged(kind, rng, robot, states):
    """A named constraint of one number per state, without bounds, and these numbers (k,)."""
    frames = [name for name in robot.frame_names if robot.movers(robot.frame(name)[0]).any()]
    frame, base = rng.choice(frames, 2)
    E = robot.poses(states, frame)
    way, direction = rng.standard_normal((2, 3))
    if rng.random() < 0.5:  # the way to the point has its least in the middle
        along = E[-1, :3, 3] - E[0, :3, 3]
        way, direction = (
            v - (v @ along) * along / max(along @ along, 1e-12) for v in (way, direction)
        )
    point = E[len(E) // 2, :3, 3] + 10.0 ** rng.uniform(-2.5, 0.0) * way / np.linalg.norm(way)
    if kind == "look-at":
        axis = rng.choice(["x", "-x", "y", "-y", "z", "-z"])
        ahead = (-1.0 if axis[0] == "-" else 1.0) * E[:, :3, "xyz".index(axis[-1])]
        to = point - E[:, :3, 3]
        across = np.linalg.norm(np.cross(ahead, to), axis=1)
        angle = np.arctan2(across, (ahead * to).sum(axis=1))
        return frame, {"point": point.tolist(), "axis": str(axis)}, angle
    if kind == "distance":
        if robot.frame(base)[0] == robot.frame(frame)[0]:
            return frame, {"point": point.tolist()}, distances(E[:, :3, 3], point)
        W = robot.poses(states, base)
        local = np.linalg.inv(W[len(W) // 2]) @ [*point, 1.0]
        there = (W @ local)[:, :3]
        return frame, {"point": local[:3].tolist(), "base": base}, distances(E[:, :3, 3], there)
    if kind == "on-sphere":
        return frame, {"centre": point.tolist()}, distances(E[:, :3, 3], point)
    z = direction / np.linalg.norm(direction)
    to = E[:, :3, 3] - point
    fields = {"direction": direction.tolist(), "point": point.tolist()}
    return frame, fields, np.linalg.norm(to - np.outer(to @ z, z), axis=1)


def bounded(kind, rng, fields, values, outside):
    """Add bounds that some of the values break by `outside`."""
    if kind == "look-at":
        return fields | {"angle": max(values.max() - outside, 1e-6)}
    if kind == "distance":
        inner, outer = values.min() + outside, values.max() - outside
        sides = (0.0, outer) if rng.random() < 0.3 else (inner, None)
        return fields | {"bounds": [max(side, 1e-6) if side else side for side in sides]}
    side = rng.random()
    low = max(values.min() + outside * (side < 0.6), 0.0)
    high = max(values.max() - outside * (side > 0.4), low + 1e-6)
    return fields | {"radius": 0.5 * (low + high), "tolerance": 0.5 * (high - low)}


def promised(kind):
    words = f"motions that are proven to keep {kind} keep it"
    return pytest.param(kind, marks=pytest.mark.promise(words, "motions", ci=40, long=2000))


@pytest.mark.parametrize(
    "kind", [promised(kind) for kind in ("look-at", "distance", "on-sphere", "on-cylinder")]
)
def test_named(kind, trials, record_property):
    """Motions of 1 to 50 cm and more, near a bound, past the place where F is not smooth."""
    proven, near, false = 0, 0, {}
    for number in range(trials):
        rng, robot = np.random.default_rng(number), two_armed(number % ARMS)
        half = 10.0 ** rng.uniform(-2.5, -0.7) * rng.standard_normal(robot.dof)
        ends = robot.random_configurations(rng, 1)[0] + np.outer((-1.0, 1.0), half)
        frame, fields, values = judged(kind, rng, robot, np.linspace(*ends, DENSE))
        outside = 10.0 ** rng.uniform(-5.0, -2.5)
        fields = bounded(kind, rng, fields, values, outside)
        given = region(kind, **fields).changed(end_effector=str(frame))
        low, high = given.bounds[{"look-at": 9, "on-cylinder": 8}.get(kind, 7)]
        truth = np.maximum(low - values, values - high).max()
        found = largest_violation(
            robot, (given,), ends, CHECK_SPACING_RAD, CERTIFICATE_TOLERANCE
        ).largest
        if found <= CERTIFICATE_TOLERANCE:
            proven += 1
            near += truth > 0.5 * CERTIFICATE_TOLERANCE
            false |= {number: truth} if truth > found + 1e-9 else {}
    record_property(
        "proven", f"{proven}, {near} of them by more than half of the tolerance outside"
    )
    assert false == {} and proven >= 0.3 * trials and near > 0


@pytest.mark.promise(
    "bounds of the centre of mass hold between states", "motions", ci=40, long=2000
)
def test_centre_of_mass(trials):
    """The excess between states over the larger end, by pinocchio, against the bound on it."""
    false, share = {}, 0.0
    robots = [robot_from_source({"name": name}) for name in ("talos-left-arm", "tiago", "baxter")]
    for number in range(trials):
        rng, robot = np.random.default_rng(number), robots[number % len(robots)]
        load = Load(np.eye(4), rng.uniform(0.1, 20.0), rng.uniform(-0.2, 0.2, 3), np.zeros((3, 3)))
        turn = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi / 3.0 * np.arange(3)
        corners = 0.1 * np.column_stack([np.cos(turn), np.sin(turn)])
        given = CentreOfMass(corners).carrying((load,)).on(robot)
        half = 10.0 ** rng.uniform(-2.5, -0.3) * rng.standard_normal(robot.dof)
        ends = robot.random_configurations(rng, 1)[0] + np.outer((-1.0, 1.0), half)
        c = centres_of_mass(robot, load, np.linspace(*ends, 101))
        x = c @ given.given.edges[0].T
        rise = (x.max(axis=0) - np.maximum(x[0], x[-1])).max()
        bound = given.bound_between(ends)[0]
        false |= {number: rise} if rise > bound + 1e-12 else {}
        share = max(share, rise / bound)
    assert false == {} and share > 0.05


def centres_of_mass(robot, load, states):
    """Centre of all masses (k, 2), what stands still included, by pinocchio."""
    data, found = robot.model.createData(), []
    frame = robot.model.getFrameId(robot.end_effector)
    for q in states:
        pin.forwardKinematics(robot.model, data, robot.kinematics.joint_values(q))
        hand = pin.updateFramePlacement(robot.model, data, frame)
        bodies = [
            (b.mass, T * b.lever) for T, b in zip(data.oMi, robot.model.inertias, strict=True)
        ]
        bodies.append((load.mass, hand * load.centre))
        found.append(sum(m * p for m, p in bodies) / sum(m for m, _ in bodies))
    return np.array(found)[:, :2]
