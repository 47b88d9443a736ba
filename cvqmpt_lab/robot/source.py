"""Field "robot" of a problem file: a name or a URDF, with options; and the arms with a name."""

import hashlib
import os
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

from cvqmpt_lab.codec import from_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, located, mapping
from cvqmpt_lab.poses import Pose
from cvqmpt_lab.robot.urdf import collada_unit
from cvqmpt_lab.values import FloatArray, numbers

ARTICULATED = "articulated"
WHERE = "robot"  # the field's name in errors


class PerJoint:
    """A number for all joints, or one for each."""

    def read(self, value: Any, where: str) -> FloatArray:
        """A read-only array (n,) or ()."""
        array = numbers(value, where, "a number, or one a joint")
        array.setflags(write=False)
        return array

    def write(self, value: FloatArray) -> Any:
        """The same in json."""
        return value.tolist()


@dataclass(frozen=True, eq=False, kw_only=True)
class RobotOptions:
    """Options of any robot."""

    # file with the link pairs to skip; None: the named arm's own, or sampled
    srdf: str | None = None
    # joints to fix, with their values [rad or m]
    locked: Mapping[str, float] = field(default_factory=dict)
    # folders in which ``package://`` mesh paths are looked up first
    package_dirs: tuple[str, ...] = ()
    # (n,) or () [rad/s^2 or m/s^2]
    acceleration_limits: Annotated[FloatArray, PerJoint()] | None = None
    # (4, 4), pose of the URDF's base link in the world; None: the identity
    base: Pose | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class UrdfRobot(RobotOptions):
    """A robot of a URDF file."""

    urdf: str  # path of the file
    end_effector: str  # frame that constraints and goals are about


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedRobot(RobotOptions):
    """A robot with a name; options given here replace those of the name."""

    name: str  # a key of `ARMS`
    # frame that constraints and goals are about, instead of the usual one
    end_effector: str | None = None
    finger_opening: float | None = None  # [m] of each finger of the Panda

    @property
    def described(self) -> UrdfRobot:
        """The URDF, options and end effector that the name stands for."""
        if self.name in ELSEWHERE:
            raise InvalidInputError(
                f"robot {self.name!r} is not in the package {EXAMPLES}: {ELSEWHERE[self.name]}; "
                "give its file as --urdf, or 'urdf' and 'end_effector' in a problem file"
            )
        name = ALIASES.get(self.name, self.name)
        if name not in ARMS:
            raise UnknownChoiceError("robot", self.name, [*ARMS, "or 'urdf' and 'end_effector'"])
        arm, robots = ARMS[name], example_robots()
        fingers: Mapping[str, float] = {}
        if self.finger_opening is not None:
            if name != "panda":
                raise InvalidInputError(
                    f"'finger_opening' is the panda's, not that of {self.name!r}; use 'locked'"
                )
            if not 0.0 <= self.finger_opening <= FINGER_OPENING:
                raise InvalidInputError(
                    f"finger opening {self.finger_opening} m: give a value from 0 to "
                    f"{FINGER_OPENING} m"
                )
            fingers = dict.fromkeys(arm.locked, self.finger_opening)
        accelerations = numbers(arm.acceleration_limits, WHERE) if arm.acceleration_limits else None
        given = self.acceleration_limits
        return UrdfRobot(
            urdf=str(robots / arm.urdf),
            end_effector=self.end_effector or arm.end_effector,
            srdf=self.srdf or (arm.srdf and str(robots / arm.srdf)),
            locked={**arm.locked, **fingers, **self.locked},
            package_dirs=self.package_dirs,
            acceleration_limits=accelerations if given is None else given,
            base=self.base,
        )


def seen_from(folder: Path, source: Any) -> Any:
    """A robot's source with paths made absolute from a folder; other json unchanged."""
    if not isinstance(source, Mapping):
        return source
    named = [name for name in ("urdf", "srdf") if isinstance(source.get(name), str)]
    files: dict[str, Any] = {name: str((folder / source[name]).absolute()) for name in named}
    folders = source.get("package_dirs")
    if isinstance(folders, list) and all(isinstance(path, str) for path in folders):
        files["package_dirs"] = [str((folder / path).absolute()) for path in folders]
    return {**source, **files}


def read_source(source: Mapping[str, Any]) -> UrdfRobot:
    """The files and options of a robot's source; errors name the field, or list the arms."""
    values = {name: value for name, value in mapping(source, WHERE).items() if name != ARTICULATED}
    if "urdf" in values:
        return from_plain(UrdfRobot, values, WHERE)
    if "name" not in values:
        raise InvalidInputError(
            f"{WHERE} needs 'name' ({', '.join(ARMS)}) or 'urdf' and 'end_effector'"
        )
    return from_plain(NamedRobot, values, WHERE).described


FINGER_OPENING = 0.04  # [m] of each finger of the Panda's hand, the largest


class NamedArm(NamedTuple):
    """Files of a fixed-base arm, below example-robot-data's folder of robots, and its options."""

    urdf: str
    end_effector: str  # frame that constraints and goals are about
    srdf: str | None = None  # file with the pairs to skip; None: found by sampling
    locked: Mapping[str, float] = MappingProxyType({})  # [rad or m], as `RobotOptions.locked`
    acceleration_limits: tuple[float, ...] | None = None  # [rad/s^2] of the maker's data sheet


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
        # [rad/s^2], data sheet
        (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
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
    "tiago-dual-right": NamedArm(
        "tiago_description/robots/tiago_dual.urdf", "hand_right_palm_link"
    ),
    "tiago-pro-left": NamedArm(
        "tiago_pro_description/robots/tiago_pro.urdf", "gripper_left_base_link"
    ),
    "tiago-pro-right": NamedArm(
        "tiago_pro_description/robots/tiago_pro.urdf", "gripper_right_base_link"
    ),
    "talos-left-arm": NamedArm(TALOS, "gripper_left_base_link", locked=STANDING),
    "talos-right-arm": NamedArm(TALOS, "gripper_right_base_link", locked=STANDING),
    "baxter-left": NamedArm("baxter_description/urdf/baxter.urdf", "left_gripper", BAXTER_SRDF),
    "baxter-right": NamedArm("baxter_description/urdf/baxter.urdf", "right_gripper", BAXTER_SRDF),
    "pr2-left": NamedArm("pr2_description/urdf/pr2.urdf", "l_gripper_tool_frame"),
    "pr2-right": NamedArm("pr2_description/urdf/pr2.urdf", "r_gripper_tool_frame"),
    "two-dof": NamedArm("asr_twodof_description/urdf/TwoDofs.urdf", "Tip"),
    "finger": NamedArm("finger_edu_description/robots/finger_edu.urdf", "finger_tip_link"),
}

ALIASES = {"so100": "so-arm", "so101": "so-arm101", "j2s6s200": "kinova", "franka": "panda"}
LBR = "its URDF comes with ROS's lbr_description (github.com/lbr-stack/lbr_fri_ros2_stack)"
ELSEWHERE = {
    "gen3": "its URDF comes with ROS's kortex_description (github.com/Kinovarobotics/ros2_kortex)",
    **dict.fromkeys(("iiwa", "iiwa7", "iiwa14"), LBR),
}


@lru_cache(maxsize=1024)
def _digest(path: str, stamp: tuple[int, ...]) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def content_digest(path: str, settled: float = 1e8) -> str:
    """sha256 of what a file holds, "" if there is none.

    Read again only if its times or size have changed, or less than `settled` [ns] ago: another
    change could then leave the same time.
    """
    try:
        # a Path takes 20 us
        status = os.stat(path)  # noqa: PTH116
        stamp = status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino
        fresh = time.time_ns() - max(stamp[:2]) <= settled
        return (_digest.__wrapped__ if fresh else _digest)(path, stamp)
    except OSError:
        return ""


EXAMPLES = "example-robot-data"
ROS_VARIABLE = "ROS_PACKAGE_PATH"
SCHEME = "package://"


def example_robots() -> Path:
    """The folder of robots that example-robot-data installed."""
    robots = _installed_share() / EXAMPLES / "robots"
    if not robots.is_dir():
        raise InvalidInputError(f"robots by name need their descriptions: pip install {EXAMPLES}")
    return robots


def _installed_share() -> Path:
    """The share folder in which example-robot-data is, or would be, installed."""
    for entry in sys.path:
        share = Path(entry) / "cmeel.prefix" / "share"
        if (share / EXAMPLES).is_dir():
            return share
    return Path(sys.prefix) / "share"


def find_collision_meshes(
    root: ElementTree.Element, urdf: Path, package_dirs: Sequence[Path]
) -> list[str]:
    """Replace the names of collision meshes in a URDF by absolute paths, and return these.

    The unit of a DAE file, which pinocchio's loader ignores, goes into the mesh's scale. Errors
    name a mesh that is not found or has an unknown unit.
    """
    found = []
    for mesh in root.findall("link/collision/geometry/mesh"):
        name = mesh.get("filename", "")
        if not name.startswith(SCHEME):
            path = urdf.parent / name.removeprefix("file://")
            if not path.is_file():
                raise InvalidInputError(
                    f"{urdf.name}: mesh {name!r} is not there: {path} is no file"
                )
        else:
            package, _, rest = name.removeprefix(SCHEME).partition("/")
            path = in_package(package, rest, urdf, package_dirs)
        found.append(str(path.resolve()))
        mesh.set("filename", found[-1])
        if path.suffix.lower() == ".dae":
            with located(f"{urdf.name}: mesh {name!r}"):
                unit = collada_unit(path.read_bytes())
            scale = [unit * float(number) for number in mesh.get("scale", "1 1 1").split()]
            mesh.set("scale", " ".join(map(repr, scale)))
    return found


def in_package(package: str, rest: str, urdf: Path, package_dirs: Sequence[Path] = ()) -> Path:
    """The file of "package://PACKAGE/REST"; InvalidInputError says where it was sought."""
    named = os.environ.get(ROS_VARIABLE, "").split(os.pathsep)
    ros_folders = [Path(name) for name in named if name]
    for folder in (*package_dirs, *ros_folders, *urdf.resolve().parents, _installed_share()):
        # the folder holds the package, or is the package
        if (folder / package / rest).is_file():
            return folder / package / rest
        if folder.name == package and (folder / rest).is_file():
            return folder / rest
    given = ", ".join(str(folder) for folder in package_dirs) or "not given"
    raise InvalidInputError(
        f"{urdf.name}: mesh {SCHEME}{package}/{rest} is in none of these places: --package-dir "
        f"({given}), {ROS_VARIABLE} ({os.environ.get(ROS_VARIABLE) or 'not set'}), the folders "
        f"above {urdf.resolve().parent}; give --package-dir DIR, the folder that holds {package}"
    )
