"""Arms that have a name: fixed-base arms whose descriptions the package example-robot-data installs."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from cvqmpt_lab.robot.limits import PANDA_ACCELERATION

FINGER_OPENING = 0.04
"""[m] of each finger of the Panda's hand, its largest."""


@dataclass(frozen=True)
class NamedArm:
    """Where an arm's description lies, and what of it is an arm."""

    urdf: str
    """Path below the package's folder of robots."""
    end_effector: str
    """Frame that constraints and goals speak of."""
    srdf: str | None = None
    """Path of the file with the pairs to skip, likewise; None: found by sampling."""
    locked: Mapping[str, float] = field(default_factory=dict)
    """Joints held at other values than the nearest to 0, or between base and end effector [rad or m]."""
    acceleration_limits: tuple[float, ...] | None = None
    """[rad/s^2] of the maker's data sheet."""


UR, XARM, KINOVA = "ur_description", "xarm_description", "kinova_description"
TALOS = "talos_data/robots/talos_reduced.urdf"
BAXTER_SRDF = "baxter_description/srdf/baxter_manipulation.srdf"
STANDING = {"torso_1_joint": 0.0, "torso_2_joint": 0.0}

ARMS: Mapping[str, NamedArm] = {
    "panda": NamedArm(
        "panda_description/urdf/panda.urdf",
        "panda_hand",
        "panda_description/srdf/panda.srdf",
        {"panda_finger_joint1": FINGER_OPENING, "panda_finger_joint2": FINGER_OPENING},
        PANDA_ACCELERATION,
    ),
    "ur3": NamedArm(f"{UR}/urdf/ur3_robot.urdf", "tool0"),
    "ur5": NamedArm(f"{UR}/urdf/ur5_robot.urdf", "tool0"),
    "ur10": NamedArm(f"{UR}/urdf/ur10_robot.urdf", "tool0"),
    "ur3-limited": NamedArm(f"{UR}/urdf/ur3_joint_limited_robot.urdf", "tool0"),
    "ur5-limited": NamedArm(f"{UR}/urdf/ur5_joint_limited_robot.urdf", "tool0"),
    "ur10-limited": NamedArm(f"{UR}/urdf/ur10_joint_limited_robot.urdf", "tool0"),
    "kinova": NamedArm(f"{KINOVA}/robots/kinova.urdf", "j2s6s200_end_effector"),
    "xarm7": NamedArm(f"{XARM}/urdf/xarm7.urdf", "link_eef", f"{XARM}/srdf/xarm7.srdf"),
    "z1": NamedArm("z1_description/urdf/z1.urdf", "gripperStator"),
    "so-arm": NamedArm("so_arm_description/urdf/so100.urdf", "gripper"),
    "so-arm101": NamedArm("so_arm_description/urdf/so101.urdf", "gripper_frame_link"),
    "tiago": NamedArm("tiago_description/robots/tiago.urdf", "hand_tool_link"),
    "tiago-no-hand": NamedArm("tiago_description/robots/tiago_no_hand.urdf", "wrist_ft_tool_link"),
    "tiago-dual-left": NamedArm("tiago_description/robots/tiago_dual.urdf", "hand_left_palm_link"),
    "tiago-dual-right": NamedArm("tiago_description/robots/tiago_dual.urdf", "hand_right_palm_link"),
    "tiago-pro-left": NamedArm("tiago_pro_description/robots/tiago_pro.urdf", "gripper_left_base_link"),
    "tiago-pro-right": NamedArm("tiago_pro_description/robots/tiago_pro.urdf", "gripper_right_base_link"),
    "talos-left-arm": NamedArm(TALOS, "gripper_left_base_link", locked=STANDING),
    "talos-right-arm": NamedArm(TALOS, "gripper_right_base_link", locked=STANDING),
    "baxter-left": NamedArm("baxter_description/urdf/baxter.urdf", "left_gripper", BAXTER_SRDF),
    "baxter-right": NamedArm("baxter_description/urdf/baxter.urdf", "right_gripper", BAXTER_SRDF),
    "pr2-left": NamedArm("pr2_description/urdf/pr2.urdf", "l_gripper_tool_frame"),
    "pr2-right": NamedArm("pr2_description/urdf/pr2.urdf", "r_gripper_tool_frame"),
    "two-dof": NamedArm("asr_twodof_description/urdf/TwoDofs.urdf", "Tip"),
    "finger": NamedArm("finger_edu_description/robots/finger_edu.urdf", "finger_tip_link"),
}
