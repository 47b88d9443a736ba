"""Source of a robot, the field "robot" of a problem file; table of the arms that have a name."""

import hashlib
import os
import re
import stat
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError, located, mapping, unique
from cvqmpt_lab.base.modules import installed_module, require_code_allowed
from cvqmpt_lab.base.poses import Pose
from cvqmpt_lab.base.values import FloatArray, numbers
from cvqmpt_lab.robot.robot import FrameLimit
from cvqmpt_lab.robot.urdf import read_urdf
from cvqmpt_lab.robot.urdf_bodies import collada_unit


class PerJoint:
    """One number for each joint, or a single number for all joints."""

    def read(self, value: Any, where: str) -> FloatArray:
        """Return an array (n,), or () for a single number."""
        return numbers(value, where, "a number, or one a joint")

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema."""
        return {"anyOf": [schema_of(float), schema_of(tuple[float, ...])]}


@dataclass(frozen=True, eq=False)
class RobotSource:
    """Source of a robot: a URDF file or an arm's name, with options; "": not given."""

    urdf: str = ""  # path of the file
    end_effector: str = ""  # frame of constraints and goals; "": the named arm's
    # file with the link pairs that are not checked; "": the named arm's, or found by sampling
    srdf: str = ""
    # values of the joints that are held [rad or m]
    locked: Mapping[str, float] = field(default_factory=dict)
    # (n,), or () for all joints [rad/s or m/s]; None: limits of the URDF
    velocity_limits: Annotated[FloatArray, PerJoint()] | None = None
    # (n,), or () for all joints [rad/s^2 or m/s^2]
    acceleration_limits: Annotated[FloatArray, PerJoint()] | None = None
    # (n,), or () for all joints [rad/s^3 or m/s^3]
    jerk_limits: Annotated[FloatArray, PerJoint()] | None = None
    # (n,), or () for all joints [Nm or N]; None: the URDF's, where they are plausible
    effort_limits: Annotated[FloatArray, PerJoint()] | None = None
    # (n,), or () for all joints [Nm/s or N/s], of a controller that runs at 1 kHz
    torque_rate_limits: Annotated[FloatArray, PerJoint()] | None = None
    # path of a joint_limits.yaml of MoveIt, whose limits replace others
    joint_limits: str = ""
    # largest speeds of frames by name, such as the tool or the elbow
    frame_limits: Mapping[str, FrameLimit] = field(default_factory=dict)
    # folders that are searched first for ``package://`` mesh paths
    package_dirs: tuple[str, ...] = ()
    # whether <safety_controller> does not narrow the joint limits
    hard_limits: bool = False
    # whether links without a collision body get their visual bodies
    visual_as_collision: bool = False
    # whether a collision mesh that is not found is no body, instead of an error
    skip_missing_meshes: bool = False
    # whether concave meshes are not cut into convex pieces; those of a named arm never are
    one_hull_a_mesh: bool = False
    # "visual" meshes or "hulls": what pictures show of the links
    bodies: Literal["visual", "hulls"] = "visual"
    # (4, 4) pose of the URDF's base link in the world; None: the identity
    base: Pose | None = None
    # (4, 4) pose of a tool in the frame `end_effector`; the hand is then END_EFFECTOR/tool
    tool: Pose | None = None
    name: str = (
        ""  # an arm of `cvqmpt robot`, instead of a URDF; other fields replace the named arm's
    )
    finger_opening: float | None = None  # opening of each finger of the Panda [m]
    # several frames instead of `end_effector`; a region without a frame refers to the first
    end_effectors: tuple[str, ...] = ()

    @property
    def limits(self) -> dict[str, FloatArray | None]:
        """Fields that are limits, by name; None: not given."""
        kinds = ("acceleration", "jerk", "effort", "torque_rate")
        return {name: getattr(self, name) for name in (f"{kind}_limits" for kind in kinds)}


# fields of RobotSource that are paths: of files, and of all
FILE_FIELDS = ("urdf", "srdf", "joint_limits")
PATH_FIELDS = (*FILE_FIELDS, "package_dirs")


def with_absolute_paths(folder: Path, source: Any) -> Any:
    """Return a robot's source in which paths relative to `folder` are made absolute.

    source: JSON of the field "robot"; anything but a mapping is returned unchanged.
    """
    if not isinstance(source, Mapping):
        return source
    files: dict[str, Any] = {
        name: str((folder / source[name]).absolute())
        for name in FILE_FIELDS
        # "" stands for an absent file
        if isinstance(source.get(name), str) and source[name]
    }
    folders = source.get("package_dirs")
    if isinstance(folders, list) and all(isinstance(path, str) for path in folders):
        files["package_dirs"] = [str((folder / path).absolute()) for path in folders]
    return {**source, **files}


def with_relative_paths(folder: Path, source: Mapping[str, Any]) -> dict[str, Any]:
    """Return a robot's source in which paths below `folder` are relative to it.

    It is the inverse of `with_absolute_paths`; other paths stay absolute.
    """

    def relative(path: str) -> str:
        below = Path(path).is_relative_to(folder)
        return str(Path(path).relative_to(folder)) if below else path

    files: dict[str, Any] = {
        name: relative(source[name]) for name in FILE_FIELDS if source.get(name)
    }
    if source.get("package_dirs"):
        files["package_dirs"] = [relative(path) for path in source["package_dirs"]]
    return {**source, **files}


def read_source(source: Mapping[str, Any]) -> RobotSource:
    """Return a robot's source from JSON, after checks; a named arm is looked up in `ARMS`.

    Args:
        source: fields of `RobotSource`; "articulated" is ignored here (`load` reads it).

    Raises:
        InvalidInputError: a field is wrong; the message names it.
        UnknownChoiceError: no arm has this name; the message lists the arms.
    """
    values = {
        name: value
        for name, value in mapping(source, "robot").items()
        # null stands for an absent field
        if name != "articulated" and (value is not None or name not in ("end_effector", "srdf"))
    }
    given = from_plain(RobotSource, values, "robot")
    if given.end_effector and given.end_effectors:
        raise InvalidInputError("robot has 'end_effector' and 'end_effectors': give one of the two")
    unique(given.end_effectors, "robot.end_effectors")
    if given.end_effectors:
        given = replace(given, end_effector=given.end_effectors[0])
    if given.tool is not None and len(given.end_effectors) > 1:
        raise InvalidInputError(
            f"robot.tool belongs to one end effector: give one of {', '.join(given.end_effectors)}"
            " as 'end_effector'"
        )
    if given.name.startswith("rd:") and not given.urdf:
        given = _of_descriptions(given)
    if given.name and given.urdf:
        raise InvalidInputError("robot has 'name' and 'urdf': give one of the two")
    if given.name:
        given = _of_arm(given)
    elif not given.urdf:
        raise InvalidInputError(
            f"robot needs 'name' ({', '.join(ARMS)}) or 'urdf' and 'end_effector'"
        )
    elif not given.end_effector:
        raise InvalidInputError(f"robot.end_effector is missing: give a frame of {given.urdf}")
    elif given.finger_opening is not None:
        raise InvalidInputError(
            "robot.finger_opening needs 'name': 'panda'; hold the joints of other grippers by "
            "'locked'"
        )
    return replace(given, end_effectors=given.end_effectors or (given.end_effector,))


def _of_descriptions(given: RobotSource) -> RobotSource:
    """Return the source of rd:NAME, a robot of the package robot_descriptions, with its URDF."""
    name = given.name.removeprefix("rd:")
    require_code_allowed(
        f"robot {given.name!r} is made by the package robot_descriptions, which runs and may "
        "download the robot",
        "give its URDF, --robot ARM.urdf",
    )
    try:
        if not name.isidentifier():
            raise ModuleNotFoundError("its name is no word")
        module = installed_module("robot_descriptions", f"robot_descriptions.{name}_description")
    except ModuleNotFoundError as error:
        raise InvalidInputError(
            f"robot {given.name!r} is not found ({error}): pip install robot_descriptions; its "
            "command robot_descriptions list prints the names, such as rd:piper"
        ) from error
    except Exception as error:  # the package downloads files that are missing, in its own ways
        said = " ".join(str(error).split())
        raise InvalidInputError(
            f"files of robot {given.name!r} are not there: {said}; give a URDF, --robot ARM.urdf"
        ) from error
    path = getattr(module, "URDF_PATH", "")
    if not path:
        raise InvalidInputError(
            f"robot {given.name!r} has no URDF; expand its {getattr(module, 'XACRO_PATH', 'files')}"
            " and give it as --robot"
        )
    packages = (*given.package_dirs, getattr(module, "PACKAGE_PATH", str(Path(path).parent)))
    hand = given.end_effector or read_urdf(Path(path), packages).likely_end_effectors()[0]
    return replace(given, name="", urdf=path, end_effector=hand, package_dirs=packages)


def _of_arm(given: RobotSource) -> RobotSource:
    """Return the source of a named arm; fields of `given` override `ARMS`."""
    ros_package = ARMS_IN_ROS_PACKAGES.get(given.name.lower().replace("-", "").replace("_", ""))
    if ros_package is not None:
        raise InvalidInputError(
            f"robot {given.name!r} is not in the package {ROBOT_DATA}: its URDF comes with "
            f"ROS's {ros_package}; give its file as --robot, or 'urdf' and 'end_effector' in a "
            "problem file; or pip install robot_descriptions, which has many arms as rd:NAME"
        )
    name = ALIASES.get(given.name, given.name)
    if name not in ARMS:
        raise UnknownChoiceError("robot", given.name, [*ARMS, "or 'urdf' and 'end_effector'"])
    arm = ARMS[name]
    folder = example_robots()
    fingers: Mapping[str, float] = {}
    if given.finger_opening is not None:
        if name != "panda":
            raise InvalidInputError(
                f"'finger_opening' is an option of 'panda', not of {given.name!r}; use 'locked'"
            )
        if not 0.0 <= given.finger_opening <= PANDA_FINGER_OPENING_M:
            raise InvalidInputError(
                f"finger opening {given.finger_opening} m: give a value from 0 to "
                f"{PANDA_FINGER_OPENING_M} m"
            )
        fingers = dict.fromkeys(arm.locked, given.finger_opening)
    limits: dict[str, Any] = {
        kind: getattr(arm, kind) if values is None else values
        for kind, values in given.limits.items()
    }
    return replace(
        given,
        urdf=str(folder / arm.urdf),
        end_effector=given.end_effector or arm.end_effector or arm.end_effectors[0],
        end_effectors=given.end_effectors or (() if given.end_effector else arm.end_effectors),
        srdf=given.srdf or (arm.srdf and str(folder / arm.srdf)),
        locked={**arm.locked, **fingers, **given.locked},
        **limits,
    )


PANDA_FINGER_OPENING_M = 0.04  # default opening of each finger

# Robots with two arms, which `ARMS` also has with one arm: NAME-left and NAME-right
TWO_ARMS: Mapping[str, RobotSource] = {
    "tiago-dual": RobotSource(
        "tiago_description/robots/tiago_dual.urdf",
        end_effectors=("hand_left_palm_link", "hand_right_palm_link"),
    ),
    "tiago-pro": RobotSource(
        "tiago_pro_description/robots/tiago_pro.urdf",
        end_effectors=("gripper_left_base_link", "gripper_right_base_link"),
    ),
    "talos": RobotSource(
        "talos_data/robots/talos_reduced.urdf",
        locked={"torso_1_joint": 0.0, "torso_2_joint": 0.0},
        end_effectors=("gripper_left_base_link", "gripper_right_base_link"),
    ),
    "baxter": RobotSource(
        "baxter_description/urdf/baxter.urdf",
        srdf="baxter_description/srdf/baxter_manipulation.srdf",
        end_effectors=("left_gripper", "right_gripper"),
    ),
    "pr2": RobotSource(
        "pr2_description/urdf/pr2.urdf",
        end_effectors=("l_gripper_tool_frame", "r_gripper_tool_frame"),
    ),
    "g1": RobotSource(
        "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf",
        locked={f"waist_{axis}_joint": 0.0 for axis in ("yaw", "roll", "pitch")},
        end_effectors=("left_hand_palm_link", "right_hand_palm_link"),
    ),
}


def _single_arms() -> dict[str, RobotSource]:
    """Return the robots of `TWO_ARMS` with one of their arms each, by name."""
    arms = {}
    for name, robot in TWO_ARMS.items():
        # "talos-left" alone would not say that only an arm is meant
        ending = "-arm" if name == "talos" else ""
        for side, hand in zip(("left", "right"), robot.end_effectors, strict=True):
            arms[f"{name}-{side}{ending}"] = replace(robot, end_effector=hand, end_effectors=())
    return arms


# Arms with a fixed base (legs are held); paths are relative to the folder of `example_robots`.
# Velocity and effort limits come from the URDF. Only the Panda has published limits of
# acceleration and jerk. Left out: alex (no commercial use), icub (velocity limits of 100 rad/s),
# centauro (a mesh without a convex hull), arms of humanoids without collision bodies at the hand.
ARMS: Mapping[str, RobotSource] = {
    "panda": RobotSource(
        "panda_description/urdf/panda.urdf",
        "panda_hand",
        "panda_description/srdf/panda.srdf",
        {
            "panda_finger_joint1": PANDA_FINGER_OPENING_M,
            "panda_finger_joint2": PANDA_FINGER_OPENING_M,
        },
        # Franka Control Interface, "Robot and interface specifications"
        acceleration_limits=np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
        jerk_limits=np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]),
    ),
    "ur3": RobotSource("ur_description/urdf/ur3_robot.urdf", "tool0"),
    "ur5": RobotSource("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": RobotSource("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "ur3-limited": RobotSource("ur_description/urdf/ur3_joint_limited_robot.urdf", "tool0"),
    "ur5-limited": RobotSource("ur_description/urdf/ur5_joint_limited_robot.urdf", "tool0"),
    "ur10-limited": RobotSource("ur_description/urdf/ur10_joint_limited_robot.urdf", "tool0"),
    # two fixed fingers
    "ur3-gripper": RobotSource(
        "ur_description/urdf/ur3_gripper.urdf", "tool0", "ur_description/srdf/ur3_gripper.srdf"
    ),
    "ur5-gripper": RobotSource(
        "ur_description/urdf/ur5_gripper.urdf", "tool0", "ur_description/srdf/ur5_gripper.srdf"
    ),
    "kinova": RobotSource("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "xarm7": RobotSource(
        "xarm_description/urdf/xarm7.urdf", "link_eef", "xarm_description/srdf/xarm7.srdf"
    ),
    "z1": RobotSource("z1_description/urdf/z1.urdf", "gripperStator"),
    "so-arm": RobotSource("so_arm_description/urdf/so100.urdf", "gripper"),
    "so-arm101": RobotSource("so_arm_description/urdf/so101.urdf", "gripper_frame_link"),
    "tiago": RobotSource("tiago_description/robots/tiago.urdf", "hand_tool_link"),
    "tiago-no-hand": RobotSource(
        "tiago_description/robots/tiago_no_hand.urdf", "wrist_ft_tool_link"
    ),
    **TWO_ARMS,
    **_single_arms(),
    **{
        f"romeo-{side}": RobotSource(
            "romeo_description/urdf/romeo.urdf", f"{side[0]}_wrist", locked={"TrunkYaw": 0.0}
        )
        for side in ("left", "right")
    },
    "anymal-kinova": RobotSource(
        "anymal_b_simple_description/robots/anymal-kinova.urdf", "j2s6s200_end_effector"
    ),
    "b1-z1": RobotSource("b1_description/urdf/b1-z1.urdf", "gripperStator"),
    "two-dof": RobotSource("asr_twodof_description/urdf/TwoDofs.urdf", "Tip"),
    "finger": RobotSource("finger_edu_description/robots/finger_edu.urdf", "finger_tip_link"),
}

ALIASES = {"so100": "so-arm", "so101": "so-arm101", "j2s6s200": "kinova", "franka": "panda"}
# names, without - and _, of arms that `ROBOT_DATA` lacks, and the ROS package that has their URDF
ARMS_IN_ROS_PACKAGES = {
    arm: package
    for package, arms in {
        "kortex_description (github.com/Kinovarobotics/ros2_kortex)": "gen3 gen3lite",
        "lbr_description (github.com/lbr-stack/lbr_fri_ros2_stack)": (
            "kuka iiwa iiwa7 iiwa14 lbriiwa lbriiwa7 lbriiwa14 kukaiiwa kukaiiwa7 kukaiiwa14 med7 "
            "med14"
        ),
        "ur_description (github.com/UniversalRobots/Universal_Robots_ROS2_Description)": (
            "ur3e ur5e ur7e ur8long ur10e ur12e ur15 ur16e ur18 ur20 ur30"
        ),
        "xarm_description (github.com/xArm-Developer/xarm_ros2)": (
            "xarm5 xarm6 lite6 uf850 xarm7gripper"
        ),
        "franka_description (github.com/frankarobotics/franka_description)": "fr3 fer fp3",
    }.items()
    for arm in arms.split()
}


def _sha256(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@lru_cache(maxsize=1024)
def _kept_sha256(path: str, stamp: tuple[int, ...]) -> str:
    """Return the sha256 of a file; it is computed once for each stamp of times and size."""
    return _sha256(path)


def content_digest(path: str, settled: float = 1e8) -> str:
    """Return the sha256 of a regular file's content; "" if there is no such file.

    The digest is kept in memory. The file is read again if its times or size have changed, or if
    its last change is less than `settled` [ns] old: a second change could have the same time.
    """
    try:
        # making a Path takes 20 us
        status = os.stat(path)  # noqa: PTH116
        if not stat.S_ISREG(status.st_mode):
            return ""
        stamp = status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino
        age = time.time_ns() - max(stamp[:2])
        return _sha256(path) if age <= settled else _kept_sha256(path, stamp)
    except OSError:
        return ""


ROBOT_DATA = "example-robot-data"  # package on the index with descriptions of robots


def example_robots() -> Path:
    """Return the package's folder of robots; InvalidInputError if it is not installed."""
    robots = _installed_share() / ROBOT_DATA / "robots"
    if not robots.is_dir():
        raise InvalidInputError(f"robots by name need their descriptions: pip install {ROBOT_DATA}")
    return robots


def _installed_share() -> Path:
    """Return the share folder in which `ROBOT_DATA` is installed, else the default one."""
    for entry in sys.path:
        share = Path(entry) / "cmeel.prefix" / "share"
        if (share / ROBOT_DATA).is_dir():
            return share
    return Path(sys.prefix) / "share"


def find_collision_meshes(
    root: ElementTree.Element, urdf: Path, package_dirs: Sequence[Path], skip_missing: bool = False
) -> tuple[list[str], list[str]]:
    """Replace the names of collision meshes in a URDF by absolute paths.

    The attribute scale of a DAE mesh is multiplied by the unit that the DAE file states, because
    pinocchio's loader ignores that unit.

    Args:
        root: root element of the URDF; it is changed.
        urdf: path of the URDF; relative names of meshes start at its folder.
        package_dirs: folders that are searched first for ``package://`` names.
        skip_missing: whether bodies whose mesh is not found are removed from `root`.

    Returns:
        The absolute paths, one for each mesh, and the links that lost a body.

    Raises:
        InvalidInputError: a mesh is not found or an archive, or its unit is not a number; the
            message names it.
    """
    found, lost = list[str](), list[str]()
    bodies = [(link, body) for link in root.findall("link") for body in link.findall("collision")]
    for link, body in bodies:
        mesh = body.find("geometry/mesh")
        if mesh is None:
            continue
        name = mesh.get("filename", "")
        try:
            path = mesh_path(name, urdf, package_dirs)
        except InvalidInputError as error:
            if not skip_missing:
                raise InvalidInputError(
                    f"{error}; --skip-missing-meshes plans without it"
                ) from error
            link.remove(body)
            lost.append(link.get("name", ""))
            continue
        with path.open("rb") as file:
            if file.read(4) == b"PK\3\4":  # its size when it is unpacked has no bound
                raise InvalidInputError(
                    f"{urdf.name}: mesh {name!r} is a zip archive; give an STL, OBJ or DAE file"
                )
        found.append(str(path.resolve()))
        mesh.set("filename", found[-1])
        if path.suffix.lower() == ".dae":
            with located(f"{urdf.name}: mesh {name!r}"):
                unit = collada_unit(path.read_bytes())
            scale = [unit * float(number) for number in mesh.get("scale", "1 1 1").split()]
            mesh.set("scale", " ".join(map(repr, scale)))
    return found, lost


PACKAGE_PATHS = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")  # variables that list folders


def mesh_path(name: str, urdf: Path, package_dirs: Sequence[Path] = ()) -> Path:
    """Return the file that a URDF or scene names by a path or by "package://PACKAGE/REST".

    A package is a folder of this name, or one whose package.xml has it. It is searched in
    `package_dirs`, the folders of ROS_PACKAGE_PATH, the folders share of AMENT_PREFIX_PATH, the
    folders above the URDF and the share folder of example-robot-data, in this order.

    Args:
        name: path of the file, or "package://PACKAGE/REST".
        urdf: file that contains the name; relative paths start at its folder.
        package_dirs: folders that hold packages, or are packages.

    Raises:
        InvalidInputError: no folder has the file; the message lists the folders.
    """
    scheme = "package://"
    if not name.startswith(scheme):
        path = urdf.parent / name.removeprefix("file://")
        if path.is_file():
            return path
        raise InvalidInputError(f"{urdf.name}: mesh {name!r} is not found: there is no file {path}")
    package, _, rest = name.removeprefix(scheme).partition("/")
    paths = {variable: os.environ.get(variable, "") for variable in PACKAGE_PATHS}
    there = []
    for folder in _package_folders(package, urdf.resolve(), package_dirs, *paths.values()):
        if (folder / rest).is_file():
            return folder / rest
        if folder.is_dir():
            there.append(str(folder))
    if there:
        why = f"package {package} is {' and '.join(there)}, without {rest}"
    else:
        given = ", ".join(str(folder) for folder in package_dirs) or "not given"
        places = ", ".join(f"{variable} ({path or 'not set'})" for variable, path in paths.items())
        why = (
            f"no folder is called {package}, or has a package.xml of that name, in these places: "
            f"--package-dir ({given}), {places}, the folders above {urdf.resolve().parent}"
        )
    raise InvalidInputError(
        f"{urdf.name}: mesh {name} is not found: {why}; give --package-dir DIR, the folder of the "
        "package, or one that holds it"
    )


def _package_folders(
    package: str, urdf: Path, package_dirs: Sequence[Path], ros_path: str, ament_path: str
) -> Iterator[Path]:
    """Yield folders that may be a package, in the order of `mesh_path`.

    Args:
        package: name of the package.
        urdf: full path of the file that names it.
        package_dirs: folders that hold packages, or are packages.
        ros_path: value of ROS_PACKAGE_PATH.
        ament_path: value of AMENT_PREFIX_PATH.
    """

    def called(folder: Path) -> Iterator[Path]:
        yield folder / package
        if folder.name == package:
            yield folder

    def stated(folder: Path, levels: Sequence[str] = ("", "*/", "*/*/")) -> Iterator[Path]:
        # the folder of a clone may have another name than its package
        for level in levels:
            for manifest in sorted(folder.glob(f"{level}package.xml")):
                if _package_name(manifest) == package:
                    yield manifest.parent

    ros = [Path(name) for name in ros_path.split(os.pathsep) if name]
    ament = [Path(name, "share") for name in ament_path.split(os.pathsep) if name]
    for folder in package_dirs:
        yield from called(folder)
        yield from stated(folder)
    for folder in (*ros, *ament, *urdf.parents, _installed_share()):
        yield from called(folder)
    for folder in ros:
        yield from stated(folder)
    for folder in urdf.parents:
        yield from stated(folder, [""])


def _package_name(manifest: Path) -> str:
    """Return the name in a package.xml of ROS; "" if it has none."""
    try:
        named = re.search(rb"<name>\s*([^<\s]+)\s*</name>", manifest.read_bytes()[: 2**16])
    except OSError:
        return ""
    return named[1].decode(errors="replace") if named else ""
