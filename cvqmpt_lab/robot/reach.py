"""Robots that reach far: accepted with a note, or refused if their lengths cannot be metres."""

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.urdf import Urdf

USUAL_REACH_M = 10.0  # from the origin; beyond it a note asks about the unit
MAX_REACH_M = 100.0  # as far as obstacles may be away
MAX_ARM_M = 20.0  # from any hinge to what it moves: longer than cranes in space


def note_on_reach(robot: Robot, urdf: Urdf) -> tuple[str, ...]:
    """Return the note on a robot that reaches further than usual; refuse lengths in other units.

    Sliders of a gantry are long, arms are not: an arm in millimetres or centimetres is refused.
    """
    if robot.reach <= USUAL_REACH_M:
        return ()
    k, joints = robot.kinematics, [urdf.joints[name] for name in robot.joint_names]
    strokes = {
        joint.name: max(-low, high)
        for joint, low, high in zip(joints, robot.lower, robot.upper, strict=True)
        if joint.kind == "prismatic" and max(-low, high) > USUAL_REACH_M / 4
    }
    reasons = [f"joint {name!r} slides to {stroke:.4g} m" for name, stroke in strokes.items()]
    above = {joint.name for hand in robot.end_effectors for joint in urdf.chain(hand)}
    reasons += [
        f"joint {joint.name!r} is held at {joint.value:g} m"
        for joint in robot.held_joints
        if joint.name in above
        and urdf.joints[joint.name].kind == "prismatic"
        and abs(joint.value) > USUAL_REACH_M / 4
    ]
    why = ", ".join(reasons) or "its links or base lie far away"
    text = f"{urdf.path.name} reaches {robot.reach:.3g} m from the origin, because {why}"
    arm = float(robot.levers()[~k.prismatic[k.order[: robot.dof]]].max(initial=0.0))
    if robot.reach > MAX_REACH_M:
        named = " ".join(f"--lock {name}={urdf.joints[name].neutral:g}" for name in strokes)
        cure = (
            "are all lengths in metres? Narrow a slider by --joint-limits (max_position), or hold "
            f"it: {named or '--lock JOINT=VALUE'}"
        )
        raise InvalidInputError(f"{text}: at most {MAX_REACH_M:g} m; {cure}")
    if arm > MAX_ARM_M:
        raise InvalidInputError(
            f"{text}: its arm is {arm:.3g} m long behind a hinge, at most {MAX_ARM_M:g} m; are all "
            "lengths in metres?"
        )
    return (f"{text}; lengths are taken as metres",)
