"""Taking a door or drawer out of a scene, so that it can become a joint of the robot."""

from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.robot.hulls import hull_vertices
from cvqmpt_lab.robot.mechanism import ArticulatedObject, Part
from cvqmpt_lab.scene.coal_shapes import coal_shape, shape_distance
from cvqmpt_lab.scene.scene import Articulation, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Measured

# [m] fixed objects closer than REST_GAP to the moving object become its casing, but stay obstacles
# if the moving object penetrates them deeper than DEEPEST
REST_GAP, DEEPEST = 1e-3, 1e-4


def take_out(
    scene: Scene, name: str, may_touch: Sequence[tuple[str, str]] = ()
) -> tuple[Scene, ArticulatedObject]:
    """Take the articulation `name` out of a scene, whatever its value is.

    A closed door is half a millimetre from the boards of its cabinet: less than the distance that
    planners keep from obstacles. Such boards become the object's casing, which is checked against
    the robot, but not against the door. A fixed obstacle belongs to the casing if, over the joint's
    whole range, it comes closer than `REST_GAP` to the object and is never penetrated deeper than
    `DEEPEST`. All others stay obstacles for the moving object, too, e.g. a box in its path or
    other doors.

    may_touch: (robot piece, part) pairs that may touch, see `ArticulatedObject`.
    """
    joint = scene.articulation(name)
    movers = [scene[part] for part in joint.moves]
    cloud = next((item.name for item in movers if isinstance(item.shape, Measured)), None)
    if cloud is not None:
        raise InvalidInputError(
            f"{cloud!r}, a part of {name!r}, is measured points: give a box or a mesh in its place"
        )
    moved = {part for item in scene.articulations for part in item.moves}
    standing = (item for item in scene.obstacles if item.name not in moved)
    fixed = [item for item in standing if not isinstance(item.shape, Measured)]
    casing = [item for item in fixed if _rests_against(joint, movers, item)]
    T_joint_world = np.linalg.inv(joint.T_world_joint @ joint.motion(joint.value))
    heights = [(T_joint_world @ item.T_world_object)[2, 3] for item in movers]
    middle = pose((0.0, 0.0, float(np.mean(heights))))
    T_world_joint = joint.T_world_joint @ middle  # so that its origin is near its links
    T_joint_world = np.linalg.inv(T_world_joint @ joint.motion(joint.value))
    articulated = ArticulatedObject(
        name=name,
        kind=joint.kind,
        T_world_joint=T_world_joint,
        lower=joint.lower,
        upper=joint.upper,
        parts=tuple(_part(item, T_joint_world @ item.T_world_object) for item in movers),
        casing=tuple(_part(item, item.T_world_object) for item in casing),
        may_touch=tuple(may_touch),
    )
    return scene.without(*joint.moves, *(item.name for item in casing)), articulated


def _part(item: SceneObject, T: FloatArray) -> Part:
    """An object as a part: a convex polytope that contains its shape."""
    return Part(item.name, T, hull_vertices(coal_shape(item.shape)))


def _rests_against(
    joint: Articulation, movers: Sequence[SceneObject], item: SceneObject, least_step: float = 1e-3
) -> bool:
    """Whether movers come close to a fixed item in the joint's range, but do not penetrate it.

    A change of the joint by d moves no point by more than J d, with J the largest norm of a point's
    Jacobian. So the next check is at a value larger by (distance - REST_GAP) / J, or by
    least_step [m] / J if that is more.
    """
    shape = coal_shape(item.shape)
    close = False
    for mover in movers:
        # speed: J, which is 1 for a slider, largest distance from the axis [m] for a hinge
        moving, speed = coal_shape(mover.shape), 1.0
        if joint.kind == "hinge":
            T = np.linalg.inv(joint.T_world_joint) @ mover.T_world_object
            points = hull_vertices(moving) @ T[:3, :3].T + T[:3, 3]
            speed = float(np.linalg.norm(points[:, :2], axis=1).max())
        value = joint.lower
        while True:
            T = joint.displacement(value) @ mover.T_world_object
            distance = shape_distance(moving, T, shape, item.T_world_object)
            if distance < -DEEPEST:
                return False
            close = close or distance < REST_GAP
            if value >= joint.upper:
                break
            value = min(joint.upper, value + max(distance - REST_GAP, least_step) / speed)
    return close
