"""MotionBenchMaker: 700 problems each of a Panda, a UR5 and a Fetch in published scenes.

The robots are those of the benchmark: the UR5 has a gripper and stands 0.91 m high; the Fetch,
whose torso lifts, is in none of the packages that we depend on.

The archive is fetched, checked by digest and unpacked into the cache. It is the source archive of
`vamp-planner` (Apache-2.0) on the package index that pip uses: problems as yaml of MoveIt, and
their robots. We run and unpickle nothing of it; pip compares its digest before it asks a build tool
for its metadata.
"""

import hashlib
import io
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zlib
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.caches import cache_folder, trusted_cache, written_by_owner_only
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import locked, make_folder, read_bytes, write_bytes, yaml_value
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.results.row import FailReason, phase_problem
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, sample_region
from cvqmpt_lab.constraints.named import upper_axis
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import FREE, symmetric_region, upright
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.moveit_scenes import scene_of_yaml

BENCH_ARCHIVE = "vamp_planner-0.6.4.tar.gz"
# sha256 of the archive, of each robot's problems in it, and of the listing of each robot's files
BENCH_DIGESTS: Mapping[str, str] = {
    BENCH_ARCHIVE: "d3150c6b67ff941af9ad56480b31d3fb73b12211ea21dc684f7737b059f6daba",
    "panda": "4e1509e99c53da769ee6a338cf1173ecf601e4ec16f24081d3894ef358243b69",
    "ur5": "576c199b30a0150d176362207494e6f3e409eb74c55f5225e671a00decfcb5b0",
    "fetch": "8f5d7a38acbd56326ba75b48c2a0058abc8ec7eaf0f5ea9786a881d1efbfacce",
    "panda/": "1eaa19a50e41030ea8eda4ee4212fcecbe8fce35c73a1d5ca910b394dc776eb1",
    "ur5/": "bef9b4b6c934ec06af0dfe700b888e3b7d77fb2711b9e1e615364c30910b87dc",
    "fetch/": "205bbb2bbf6e325b0f3744304dd707968902fafa545e187e5c1d3ac882df4ce4",
}
BENCH_HANDS = {"panda": "panda_hand", "ur5": "tool0", "fetch": "gripper_link"}  # end effectors


def fetch() -> Path:
    """Download the archive unless it is in the cache, check and unpack it; return the folder.

    Raises:
        InvalidInputError: the archive cannot be downloaded, or has another digest.
    """
    folder = bench_folder()
    archive = folder / BENCH_ARCHIVE
    with locked(folder):
        for left in folder.glob(".fetch-*"):  # by a fetch that was killed
            shutil.rmtree(left, ignore_errors=True)
        if not archive.exists():
            _download(archive)
        require_digest(read_bytes(archive, "archive"), BENCH_ARCHIVE, archive)
        unpack(archive, folder / "robots")
    return folder


def bench_folder() -> Path:
    """Return the folder of archive and robots in this user's cache."""
    folder = trusted_cache(cache_folder() / "motion-bench")
    if folder is None:
        raise InvalidInputError(
            f"no folder for {BENCH_ARCHIVE}: set XDG_CACHE_HOME to a folder that only you can write"
        )
    return folder


def require_digest(data: bytes, name: str, path: Path) -> None:
    """Refuse data whose digest is not that of a name in `BENCH_DIGESTS`."""
    found, expected = hashlib.sha256(data).hexdigest(), BENCH_DIGESTS[name]
    if found != expected:
        raise InvalidInputError(
            f"{path} is changed or cut: its sha256 is {found}, not {expected}; delete it, then: "
            "cvqmpt problems fetch motion-bench"
        )


def _download(archive: Path) -> None:
    """Download the archive by pip, which asks for its metadata and builds nothing."""
    package, version = "vamp-planner", "0.6.4"
    with tempfile.TemporaryDirectory(prefix=".fetch-", dir=archive.parent) as place:
        wanted = Path(place, "wanted.txt")
        wanted.write_text(
            f"{package}=={version} --hash=sha256:{BENCH_DIGESTS[BENCH_ARCHIVE]}\n", "utf-8"
        )
        options = ["--no-deps", "--no-binary", package, "--disable-pip-version-check"]
        words = [sys.executable, "-m", "pip", "download", *options, "-r", str(wanted), "-d", place]
        done = subprocess.run(words, capture_output=True, text=True, errors="replace")
        found = Path(place, BENCH_ARCHIVE)
        if done.returncode or not found.is_file():
            raise InvalidInputError(
                f"pip cannot download {package} {version}: {_reason(done.stderr)}; or put "
                f"{BENCH_ARCHIVE} into {archive.parent}"
            )
        found.replace(archive)


def _reason(said: str) -> str:
    """Return the digests that pip compared, or its last error."""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    digests = [line for line in lines if re.match(r"(Expected sha256|Got) ", line)]
    errors = [line for line in lines if line.startswith("ERROR")] or lines or ["it says nothing"]
    return ", ".join(digests) or errors[-1].removeprefix("ERROR: ")


def unpack(archive: Path, folder: Path, most: int = 2**26) -> None:
    """Write descriptions and problems of the robots into a folder; leave out other members.

    Args:
        archive: file of the archive.
        folder: output folder; it is replaced.
        most: largest size of one file [bytes].

    Raises:
        InvalidInputError: the archive cannot be read, or lacks a robot.
    """
    wanted = re.compile(
        rf"[^/]+/resources/((?:{'|'.join(BENCH_HANDS)})/(?:[\w-]+/)*[\w-]+"
        r"\.(?:urdf|srdf|stl|obj|dae|tar\.bz2))",
        re.IGNORECASE | re.ASCII,
    )
    here = tempfile.TemporaryDirectory(prefix=".fetch-", dir=folder.parent)
    with written_by_owner_only(), here as place:
        try:
            with tarfile.open(archive, "r:gz") as tar:
                for member in tar:
                    found = wanted.fullmatch(member.name)
                    data = tar.extractfile(member) if found and member.isfile() else None
                    if found is None or data is None:
                        continue
                    if member.size > most:
                        raise InvalidInputError(f"{archive}: {member.name} is too large")
                    path = Path(place, found[1])
                    write_bytes(make_folder(path.parent) / path.name, data.read())
        except (tarfile.TarError, EOFError, OSError, zlib.error) as error:
            raise InvalidInputError(f"{archive} is changed or cut: {error}") from error
        for robot in BENCH_HANDS:
            for name in (f"{robot}.urdf", f"{robot}.srdf", "problems.tar.bz2"):
                if not Path(place, robot, name).is_file():
                    raise InvalidInputError(f"{archive} lacks resources/{robot}/{name}")
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(place, folder)


@lru_cache(maxsize=8)
def problem_texts(robot: str) -> Mapping[str, str]:
    """Return the yaml texts of a robot's problems by "SET/scene0001" and "SET/request0001".

    Raises:
        InvalidInputError: they were not fetched, or differ from those of the archive.
    """
    path = robot_file(robot, "problems.tar.bz2")
    data = read_bytes(path, "problems")
    require_digest(data, robot, path)
    return read_texts(data, robot)


def read_texts(data: bytes, robot: str) -> dict[str, str]:
    """Return the texts of a ``problems.tar.bz2`` with members problems/SET_ROBOT/scene0001.yaml."""
    named = re.compile(rf"problems/(\w+)_{robot}/((?:scene|request)\d{{4}})\.yaml")
    texts = {}
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:bz2") as tar:
        for member in tar:
            found = named.fullmatch(member.name)
            text = tar.extractfile(member) if found and member.isfile() else None
            if found and text:
                texts[f"{found[1]}/{found[2]}"] = text.read().decode("utf-8")
    return texts


def robot_file(robot: str, name: str) -> Path:
    """Return a file of a robot in the cache; InvalidInputError if the archive was not fetched."""
    path = bench_folder() / "robots" / robot / name
    if not path.is_file():
        raise InvalidInputError(
            f"no {path}: first fetch the problems with: cvqmpt problems fetch motion-bench"
        )
    return path


def _listing(folder: Path) -> bytes:
    """Return a line for each file of a robot: its sha256 and its path; problems are left out."""
    paths = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    lines = [
        f"{hashlib.sha256(read_bytes(path, 'robot')).hexdigest()}  {name}\n"
        for name, path in sorted(paths.items())
        if not path.is_dir() and name != "problems.tar.bz2"
    ]
    return "".join(lines).encode()


def motion_bench_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return problem index % 100 of set index // 100 % 7 of robot index // 700.

    It has one start and one goal, and is unsolvable if one of them collides in our model. Its rows
    are named by index and robot.
    """
    sets = (
        *("bookshelf_small", "bookshelf_tall", "bookshelf_thin", "box", "cage"),
        *("table_pick", "table_under_pick"),
    )
    number, place = divmod(index, 100 * len(sets))
    robot, scenes = tuple(BENCH_HANDS)[number], sets[place // 100]
    name, number_in_set = phase_problem(str(index), number + 1, robot), f"{place % 100 + 1:04d}"
    texts = problem_texts(robot)
    scene, request = (texts[f"{scenes}/{kind}{number_in_set}"] for kind in ("scene", "request"))
    problem = problem_of_texts(
        name, bench_robot(robot), f"{scenes}/{number_in_set}", scene, request
    )
    checker = checker_of(problem, 0.0)
    for end, kind, q in (
        ("start", FailReason.INVALID_START, problem.start),
        ("goal", FailReason.INVALID_GOAL, problem.goals[0]),
    ):
        if checker.in_collision(q):
            said = f"{problem.scene.name}: the {end} collides, {checker.contact(q)}"
            return UnsolvableProblem(name, said, kind)
    return problem


@lru_cache(maxsize=8)
def bench_robot(robot: str) -> Robot:
    """Return a robot as the archive describes it, with the limits of its joints.

    The published problems go beyond the soft limits of the Panda's `<safety_controller>`.

    Raises:
        InvalidInputError: it was not fetched, or its files differ from those of the archive.
    """
    folder = robot_file(robot, f"{robot}.urdf").parent
    require_digest(_listing(folder), f"{robot}/", folder)
    urdf, srdf = (str(robot_file(robot, f"{robot}.{end}")) for end in ("urdf", "srdf"))
    # committed rows were planned with hulls
    flags = {"hard_limits": True, "one_hull_a_mesh": True}
    return robot_from_source(
        {"urdf": urdf, "srdf": srdf, "end_effector": BENCH_HANDS[robot], **flags}
    )


def problem_of_texts(
    name: str, robot: Robot, scene_name: str, scene: str, request: str
) -> PlanningProblem:
    """Return the problem of a scene and a motion request of MoveIt.

    Values up to 1e-5 outside a joint's limits are moved to the limit: requests hold joints that
    turn without end, which the robot's file bounds by 3.14159 rad.

    Args:
        name: name of the problem.
        robot: whose joints the request names.
        scene_name: name of the scene, for error messages.
        scene: yaml text.
        request: yaml text.
    """
    asked = yaml_value(request)
    try:
        begin = asked["start_state"]["joint_state"]
        start = dict(zip(begin["name"], begin["position"], strict=True))
        bounds = asked["goal_constraints"][0]["joint_constraints"]
        goal = {bound["joint_name"]: bound["position"] for bound in bounds}
        ends = np.array([[float(end[j]) for j in robot.joint_names] for end in (start, goal)])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InvalidInputError(f"request of {scene_name} is not readable: {error}") from error
    inside = np.clip(ends, robot.lower, robot.upper)
    ends = np.where(np.abs(ends - inside) <= 1e-5, inside, ends)
    found = scene_of_yaml(scene, Path(f"{scene_name}.yaml"))
    return PlanningProblem(name, robot, replace(found, name=scene_name), ends[0], ends[1:])


def level_problem(index: int, tilt: float = 0.1) -> PlanningProblem | UnsolvableProblem:
    """Return the same problem with a level hand.

    The hand's axis that points up at the goal points up on the whole path. If the given start is
    not level, another start is found: with the hand at the same position, or within 0.1 or 0.3 m of
    it, near the given start or anywhere. It leans by at most a fifth of the tilt, because planners
    that translate the constraint have narrower bounds.

    Args:
        index: index of the problem, as in `motion_bench_problem`.
        tilt: largest angle between axis and vertical [rad].
    """
    found = motion_bench_problem(index)
    if isinstance(found, UnsolvableProblem):
        return found
    robot, checker = found.robot, checker_of(found, SAMPLE_MARGIN_M)
    axis = upper_axis(robot.pose(found.goals[0]))
    level, steady = upright(tilt, axis), upright(0.2 * tilt, axis)
    apart = RegionConstraint(robot, (level,))
    if np.linalg.norm(apart.residual(found.goals[0])) > 0.0:
        reason = f"{found.scene.name}: no axis of the hand points up at the goal"
        return UnsolvableProblem(found.name, reason, FailReason.NO_GOAL)
    if np.linalg.norm(apart.residual(found.start)) == 0.0:
        return found.changed(constraint=(level,))
    here = pose(robot.pose(found.start)[:3, 3])
    for reach, near in product((0.0, 0.1, 0.3), (found.start, None)):
        there = symmetric_region(here, np.eye(4), [reach] * 3 + [FREE] * 3)
        rng = np.random.default_rng([index, 45])
        drawn = sample_region(robot, there, checker, rng, 1, 50, (steady,), near, project=True)
        if len(drawn.configurations):
            return found.changed(constraint=(level,), start=drawn.configurations[0])
    reason = f"{found.scene.name}: no level hand near the start's place, {drawn.outcome}"
    return UnsolvableProblem(found.name, reason, FailReason.NO_START)
