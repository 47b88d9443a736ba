"""Small robots as URDF text, and problems for them, whose right answers are seen at once."""

import json

import numpy as np

from cvqmpt_lab.problem import PlanningProblem


def box(name, size, xyz=(0.0, 0.0, 0.0)):
    """A link that is a box of 1 kg."""
    at, edges = (" ".join(map(str, values)) for values in (xyz, size))
    return (
        f'<link name="{name}"><inertial><mass value="1"/><origin xyz="{at}"/>'
        '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
        f'<collision><origin xyz="{at}"/><geometry><box size="{edges}"/></geometry></collision>'
        "</link>"
    )


def joint(name, parent, child, kind, axis, xyz=(0.0, 0.0, 0.0), limit=3.0):
    """A joint within +-limit, of 2 rad/s or m/s and 100 Nm or N."""
    at, along = (" ".join(map(str, values)) for values in (xyz, axis))
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}"/><axis xyz="{along}"/>'
        f'<limit lower="{-limit}" upper="{limit}" velocity="2" effort="100"/></joint>'
    )


def gantry():
    """Two carriages on rails along x at y = +-0.5 m; on the left one a wrist turns about z."""
    return (
        '<robot name="gantry">'
        + box("base", (0.02, 0.02, 0.02), (0.0, 0.0, -2.0))
        + box("left", (0.02, 0.02, 0.02))
        + box("wrist", (0.02, 0.02, 0.02))
        + box("right", (0.02, 0.02, 0.02))
        + joint("left_rail", "base", "left", "prismatic", (1, 0, 0), (0.0, 0.5, 0.0))
        + joint("left_turn", "left", "wrist", "revolute", (0, 0, 1), (0.0, 0.0, 0.1))
        + joint("right_rail", "base", "right", "prismatic", (1, 0, 0), (0.0, -0.5, 0.0))
        + "</robot>"
    )


def pendulum(axes="zyx"):
    """A hand that turns about axes through one point, the first one fixed to the world."""
    names = ["base", *(f"part_{k}" for k in range(len(axes)))]
    links = "".join(box(name, (0.01, 0.01, 0.01), (0, 0, -1.0 - k)) for k, name in enumerate(names))
    joints = "".join(
        joint(f"turn_{axis}{k}", names[k], names[k + 1], "revolute", np.eye(3)["xyz".index(axis)])
        for k, axis in enumerate(axes)
    )
    return f'<robot name="pendulum">{links}{joints}</robot>'


def problem_of(
    folder, text, states, hands, attachments=(), constraint=(), objects=(), name="small"
):
    """A problem from the first to the last of the states (m, n) for a URDF that is written."""
    (folder / "arm.urdf").write_text(text)
    key = "end_effectors" if len(hands) > 1 else "end_effector"
    data = {
        "schema": PlanningProblem.SCHEMA,
        "name": name,
        "robot": {"urdf": "arm.urdf", key: list(hands) if len(hands) > 1 else hands[0]},
        "scene": {"name": "made", "objects": list(objects)},
        "constraint": list(constraint),
        "attachments": list(attachments),
        "start": list(map(float, states[0])),
        "goals": [list(map(float, states[-1]))],
    }
    (folder / "problem.json").write_text(json.dumps(data))
    return PlanningProblem.load(folder / "problem.json")


def carried(name, size, xyz, hand, *others):
    """A box in a hand, in json; others hold it, too."""
    T = np.eye(4)
    T[:3, 3] = xyz
    shape = {"type": "box", "size": list(size)}
    made = {"name": name, "shape": shape, "T_hand_object": T.tolist(), "end_effector": hand}
    return {**made, "also_held_by": list(others)} if others else made


def turned(q):
    """Quaternion (m, 4), scalar first with its own sign, of turns about z, y and x by q (m, 3)."""
    half = 0.5 * np.atleast_2d(q).T
    (a, b, c), (s, t, u) = np.cos(half), np.sin(half)
    found = (
        a * b * c + s * t * u,
        a * b * u - s * t * c,
        a * t * c + s * b * u,
        s * b * c - a * t * u,
    )
    return np.array(found).T


def beside_a_half_turn(cosine, seed=0):
    """A motion (2, 3) of 0.1 rad; the cosine of half the angle is least in its middle."""
    rng, eye = np.random.default_rng(seed), 1e-4 * np.eye(3)
    for _ in range(3000):
        q = rng.uniform(-2.5, 2.5, 3)
        for _ in range(20):
            gradient = (turned(q + eye)[:, 0] - turned(q - eye)[:, 0]) / 2e-4
            q = q + gradient * (cosine - turned(q)[0, 0]) / (gradient @ gradient + 1e-12)
        u, v = np.linalg.svd(gradient[None])[2][1:]
        for angle in np.linspace(0.0, np.pi, 8):
            along = 0.05 * (np.cos(angle) * u + np.sin(angle) * v)
            ends = np.array([q - along, q + along])
            if (np.abs(ends) < 2.8).all() and turned(ends)[:, 0].min() > cosine + 1.5e-4:
                return ends
    raise AssertionError("no such motion")
