"""Remove a door or drawer from a scene, so that it can become a joint of the robot."""

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


def take_out(
    scene: Scene, name: str, may_touch: Sequence[tuple[str, str]] = ()
) -> tuple[Scene, ArticulatedObject]:
    """Split a scene into an articulated object and the scene without it.

    A closed door is half a millimetre from the boards of its cabinet: less than the distance that
    planners keep from obstacles. Such boards become the object's casing, which is checked against
    the robot but not against the door. A fixed obstacle belongs to the casing if, in the whole
    range of the joint, its distance from the moving parts is somewhere below 1 mm and nowhere
    below -0.1 mm (an overlap). All other obstacles, such as another door or a box in the path of
    the door, stay in the scene and are checked against the moving parts.

    Args:
        scene: scene with the articulation, whose joint may have any value.
        name: name of the articulation.
        may_touch: (robot piece, part) pairs that may touch, see `ArticulatedObject`.
    """
    joint = scene.articulation(name)
    movers = [scene[part] for part in joint.moves]
    cloud = next((item.name for item in movers if isinstance(item.shape, Measured)), None)
    if cloud is not None:
        raise InvalidInputError(
            f"{cloud!r}, a part of {name!r}, consists of measured points; replace it by a box or "
            "a mesh"
        )
    moved = {part for item in scene.articulations for part in item.moves}
    standing = (item for item in scene.obstacles if item.name not in moved)
    fixed = [item for item in standing if not isinstance(item.shape, Measured)]
    casing = [item for item in fixed if _rests_against(joint, movers, item)]
    T_joint_world = np.linalg.inv(joint.T_world_joint @ joint.motion(joint.value))
    heights = [(T_joint_world @ item.T_world_object)[2, 3] for item in movers]
    middle = pose((0.0, 0.0, float(np.mean(heights))))
    # move the origin of the joint frame along z to the mean height of the parts
    T_world_joint = joint.T_world_joint @ middle
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
    """Return an object as a part: a convex polytope that contains its shape."""
    return Part(item.name, T, hull_vertices(coal_shape(item.shape)))


def _rests_against(
    joint: Articulation,
    movers: Sequence[SceneObject],
    item: SceneObject,
    rest_gap: float = 1e-3,
    deepest: float = 1e-4,
    least_step: float = 1e-3,
) -> bool:
    """Return whether the moving objects come close to a fixed item, but never overlap it.

    All values of the joint are covered: a change by d moves no point by more than J d, where J is
    the largest norm of a point's Jacobian. Therefore the next check is at a value larger by
    (distance - rest_gap) / J, but at least by least_step / J.

    Args:
        joint: the articulation.
        movers: its moving objects.
        item: a fixed object.
        rest_gap: distance that counts as close [m].
        deepest: largest depth that does not count as an overlap [m].
        least_step: smallest motion of the movers between two checks [m].
    """
    shape = coal_shape(item.shape)
    close = False
    for mover in movers:
        moving = coal_shape(mover.shape)
        # J: 1 for a slider, for a hinge the largest distance from the axis [m]
        speed = 1.0
        if joint.kind == "hinge":
            T = np.linalg.inv(joint.T_world_joint) @ mover.T_world_object
            points = hull_vertices(moving) @ T[:3, :3].T + T[:3, 3]
            speed = float(np.linalg.norm(points[:, :2], axis=1).max())
        value = joint.lower
        while True:
            T = joint.displacement(value) @ mover.T_world_object
            distance = shape_distance(moving, T, shape, item.T_world_object)
            if distance < -deepest:
                return False
            close = close or distance < rest_gap
            if value >= joint.upper:
                break
            value = min(joint.upper, value + max(distance - rest_gap, least_step) / speed)
    return close
