"""Trajectories in ROS messages: the `JointTrajectory` that a message holds, as plain values.

`RobotTrajectory`, the goals of trajectory controllers and the results of MoveIt's planners hold
one; a `DisplayTrajectory` holds several, which follow each other.
"""

from collections.abc import Mapping
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, mapping, require_choice, shown, whole_number
from cvqmpt_lab.base.values import scalar


def joint_trajectory(message: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the fields of the `JointTrajectory` in a message; InvalidInputError if it has none.

    Joints without a name of their own, such as the pose of a mobile base, are refused, and so are
    objects that the robot carries at the start.
    """
    if "points" in message:
        return message
    # the second name is that of FollowJointTrajectory
    for key in ("multi_dof_joint_trajectory", "multi_dof_trajectory"):
        base = message.get(key)
        if isinstance(base, Mapping) and base.get("points"):
            raise InvalidInputError(
                f"{key} moves a mobile base or a floating joint, which is not judged; write the "
                "trajectory of the joints alone"
            )
    start = message.get("trajectory_start")
    if isinstance(start, Mapping) and start.get("attached_collision_objects"):
        from cvqmpt_lab.scene.moveit_scenes import refuse_attached  # its meshes take 0.3 s

        refuse_attached(start)
    for key in ("joint_trajectory", "trajectory"):
        held = message.get(key)
        if isinstance(held, list) and held:
            parts = [joint_trajectory(mapping(part, f"{key}[{k}]")) for k, part in enumerate(held)]
            return _joined(parts)
        if isinstance(held, Mapping):
            return joint_trajectory(held)
    raise InvalidInputError("it has no 'states', 'path' or 'points'")


def nanoseconds(where: str, time: Any) -> int:
    """Return a ROS duration, {sec, nanosec} or ROS 1's {secs, nsecs}, in nanoseconds.

    A number is read as seconds.
    """
    if isinstance(time, int | float) and not isinstance(time, bool):
        return round(1e9 * scalar(float, time, where))
    fields = mapping(time, where, "sec, nanosec")
    whole, rest = ("secs", "nsecs") if "secs" in fields else ("sec", "nanosec")
    for key in fields:
        require_choice(f"key of {where}", key, (whole, rest))
    seconds = whole_number(f"{where}: {whole}", fields.get(whole), most=2**31 - 1)
    left = whole_number(f"{where}: {rest}", fields.get(rest, 0), most=999_999_999)
    return 10**9 * seconds + left


def _joined(parts: list[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return several trajectories as one; each begins at the time and place where one ended."""
    first, points, begun = parts[0], list[Any](), 0
    for k, part in enumerate(parts):
        if part.get("joint_names") != first.get("joint_names"):
            raise InvalidInputError(
                f"trajectory {k} moves joints {shown(part.get('joint_names'))}, the first one "
                f"{shown(first.get('joint_names'))}: write each in a file of its own"
            )
        where = f"trajectory {k}: time_from_start"
        for number, point in enumerate(part.get("points") or []):
            time = mapping(point, where).get("time_from_start")
            elapsed = begun + nanoseconds(where, time)
            again = bool(points) and number == 0
            if again:  # this point is left out, so that it must be the one before
                kinds = ("positions", "velocities", "accelerations")
                unlike = [x for x in kinds if (points[-1].get(x) or []) != (point.get(x) or [])]
                if unlike or elapsed != begun:
                    why = f"it has other {unlike[0]}" if unlike else "its first time is not 0"
                    raise InvalidInputError(
                        f"trajectory {k} does not begin where trajectory {k - 1} ends ({why}): "
                        "write each in a file of its own"
                    )
            else:
                seconds = dict(zip(("sec", "nanosec"), divmod(elapsed, 10**9), strict=True))
                # a number stays one, as its unit is not certain
                later = seconds if isinstance(time, Mapping) else 1e-9 * elapsed
                points.append({**point, "time_from_start": later})
        begun = elapsed if part.get("points") else begun
    return {**first, "points": points}
