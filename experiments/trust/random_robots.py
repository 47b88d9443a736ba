"""Random arms, as URDF text: hinges and sliders about any axes, links of boxes, balls and cylinders, side branches."""

import numpy as np
from scipy.spatial.transform import Rotation

Rng = np.random.Generator
TOOL = "tool"


def random_urdf(rng: Rng, least: int = 2, most: int = 9) -> str:
    """An arm of `least` to `most` joints, of which about a third slide, that ends in link "tool"."""
    joints = int(rng.integers(least, most + 1))
    parts = ['<robot name="random">', _link("base", rng)]
    for k in range(joints):
        parent = "base" if k == 0 else f"link{k}"
        parts += [_link(f"link{k + 1}", rng), _joint(f"joint{k + 1}", parent, f"link{k + 1}", rng)]
        if rng.random() < 0.15:  # a branch, which planning holds still
            parts += [_link(f"side{k}", rng), _joint(f"turn{k}", parent, f"side{k}", rng)]
    parts += [f'<link name="{TOOL}"/>', _fixed("mount", f"link{joints}", TOOL, rng), "</robot>"]
    return "\n".join(parts)


def _link(name: str, rng: Rng) -> str:
    if rng.random() < 0.3:
        return f'<link name="{name}"/>'
    a, b, c = rng.uniform(0.02, 0.08, 3)
    kind = rng.choice(
        [f'<box size="{a} {b} {c}"/>', f'<sphere radius="{a}"/>', f'<cylinder radius="{a}" length="{b}"/>']
    )
    return (
        f'<link name="{name}"><collision>{_origin(rng, 0.05)}<geometry>{kind}</geometry></collision></link>'
    )


def _joint(name: str, parent: str, child: str, rng: Rng) -> str:
    slides = rng.random() < 0.3
    kind = "prismatic" if slides else rng.choice(["revolute", "revolute", "continuous"])
    low, high = np.sort(rng.uniform(-0.6, 0.6, 2) if slides else rng.uniform(-3.1, 3.1, 2)) + [-0.05, 0.05]
    axis = " ".join(map(str, _direction(rng)))
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{_origin(rng, 0.35)}'
        f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>'
    )


def _fixed(name: str, parent: str, child: str, rng: Rng) -> str:
    return (
        f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f"{_origin(rng, 0.1)}</joint>"
    )


def _direction(rng: Rng) -> np.ndarray:
    axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
    return axis / np.linalg.norm(axis)


def _origin(rng: Rng, away: float) -> str:
    xyz = " ".join(map(str, away * _direction(rng) * rng.uniform(0.2, 1.0)))
    rpy = " ".join(map(str, Rotation.random(random_state=rng).as_euler("xyz")))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'
