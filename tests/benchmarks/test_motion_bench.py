"""MotionBenchMaker: reading and refusals with a made archive; the real archive if it is cached."""

import hashlib
import io
import tarfile

import numpy as np
import pytest
from command_line import refused as command_refused
from refusals import refused

from cvqmpt_lab.base.caches import cache_folder
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.motion_bench import (
    BENCH_ARCHIVE,
    BENCH_DIGESTS,
    BENCH_HANDS,
    bench_robot,
    fetch,
    level_problem,
    motion_bench_problem,
    problem_of_texts,
    problem_texts,
    read_texts,
    robot_file,
    unpack,
)
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.usable import check_problem
from cvqmpt_lab.search.result import Budget

SCENE = """
world:
  collision_objects:
    - {id: can, primitives: [{type: cylinder, dimensions: [0.14, 0.03]}],
       primitive_poses: [{position: [3, 0, 0.5], orientation: [0, 0, 0, 1]}]}
"""


def request(start, goal):
    """A motion request; joints by name, in the opposite order, and one that is not planned."""
    names = ["wheel", *reversed(start)]
    ends = [{"joint_name": name, "position": value} for name, value in goal.items()]
    state = {"name": names, "position": [7.0, *reversed(start.values())]}
    return (
        f"start_state: {{joint_state: {state}}}\ngoal_constraints: [{{joint_constraints: {ends}}}]"
    )


def tar_of(files, kind, link=""):
    """A tar file of texts and bytes by name; `link` is the name of a symbolic link in it."""
    target = io.BytesIO()
    with tarfile.open(fileobj=target, mode=kind) as tar:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
        if link:
            member = tarfile.TarInfo(link)
            member.type, member.linkname = tarfile.SYMTYPE, "/etc/passwd"
            tar.addfile(member)
    return target.getvalue()


def archive_of(folder, leave_out="", **more):
    """An archive in the form of the real one."""
    texts = {
        f"problems/box_{r}/{k}0001.yaml": b"a: 1" for r in BENCH_HANDS for k in ("scene", "request")
    }
    problems = tar_of(texts, "w:bz2", link="problems/box_panda/scene0002.yaml")
    files = {
        f"vamp-1/resources/{robot}/{name}": data
        for robot in BENCH_HANDS
        if robot != leave_out
        for name, data in {
            f"{robot}.urdf": b"<robot/>",
            f"{robot}.srdf": b"<robot/>",
            "problems.tar.bz2": problems,
            "meshes/hand.obj": b"v 0 0 0",
        }.items()
    }
    path = folder / BENCH_ARCHIVE
    path.write_bytes(tar_of(files | more, "w:gz", link="vamp-1/resources/panda/link.urdf"))
    return path


def test_only_descriptions_and_problems_are_unpacked(tmp_path):
    hostile = ("vamp-1/resources/panda/../../../../out.urdf", "vamp-1/resources/panda/a.pkl")
    more = dict.fromkeys((*hostile, "vamp-1/setup.py", "vamp-1/resources/pr2/pr2.urdf"), b"bad")
    unpack(archive_of(tmp_path, **more), tmp_path / "robots")
    found = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    names = ("{0}.urdf", "{0}.srdf", "problems.tar.bz2", "meshes/hand.obj")
    assert found == {
        BENCH_ARCHIVE,
        *(f"robots/{r}/{n.format(r)}" for r in BENCH_HANDS for n in names),
    }
    data = (tmp_path / "robots/ur5/problems.tar.bz2").read_bytes()
    assert read_texts(data, "panda") == {"box/scene0001": "a: 1", "box/request0001": "a: 1"}
    path = archive_of(tmp_path, leave_out="fetch")
    refused("lacks resources/fetch/fetch.urdf", unpack, path, tmp_path / "robots")
    refused("panda.urdf is too large", unpack, path, tmp_path / "robots", most=7)
    path.write_bytes(path.read_bytes()[:-200])
    refused(f"{BENCH_ARCHIVE} is changed or cut", unpack, path, tmp_path / "robots")
    assert (tmp_path / "robots/fetch/fetch.urdf").exists()  # the former ones


def test_joints_are_found_by_name_and_a_torso_that_lifts_is_one(slider_arm):
    robot = slider_arm
    start = dict.fromkeys(robot.joint_names, 0.1)
    goal = {**start, robot.joint_names[0]: float(robot.upper[0]) + 4e-6}
    texts = ("0", robot, "box/0001", SCENE)
    problem = problem_of_texts(*texts, request(start, goal))
    np.testing.assert_array_equal(problem.start, [0.1] * robot.dof)
    np.testing.assert_array_equal(problem.goals[0], [robot.upper[0], *[0.1] * (robot.dof - 1)])
    assert problem.scene.names == ("can",) and problem.scene.name == "box/0001"
    assert solve(problem, "birrt", Budget(iterations=100), seed=0).solved
    far = {**goal, robot.joint_names[0]: float(robot.upper[0]) + 2e-5}
    refused("is outside the limits", problem_of_texts, *texts, request(start, far))
    del far[robot.joint_names[1]]
    told = f"request of box/0001 .*{robot.joint_names[1]}"
    refused(told, problem_of_texts, *texts, request(start, far))
    refused("'goal_constraints'", problem_of_texts, *texts, request(start, far).split("\n")[0])


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    """The folder of the problems in an empty cache."""
    problem_texts.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield cache_folder() / "motion-bench"
    problem_texts.cache_clear()


def test_problems_that_were_not_fetched_or_have_changed_are_refused(empty_cache, capsys):
    fetched = "cvqmpt problems fetch motion-bench"
    assert fetched in command_refused(capsys, "problems", "list", "motion-bench")
    empty_cache.mkdir(parents=True, exist_ok=True)
    left = empty_cache / ".fetch-killed" / "part.tar.gz"
    left.parent.mkdir()
    left.write_bytes(b"half of an archive")
    path = archive_of(empty_cache)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    said = command_refused(capsys, "problems", "fetch", "motion-bench")
    assert all(word in said for word in (str(path), digest, BENCH_DIGESTS[BENCH_ARCHIVE], fetched))
    assert not left.parent.exists()
    unpack(path, empty_cache / "robots")
    said = command_refused(capsys, "problems", "list", "motion-bench")
    assert "problems.tar.bz2 is changed or cut" in said and BENCH_DIGESTS["panda"] in said
    # robots were used as they lay in the cache
    told = f"robots/ur5 is changed or cut: .*{BENCH_DIGESTS['ur5/']}; delete it"
    refused(told, bench_robot, "ur5")


def test_what_pip_says_is_told_in_one_line(empty_cache, tmp_path, monkeypatch):
    """The package index has no such archive, or a different one."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    said = refused("pip cannot download vamp-planner 0.6.4: No matching", fetch)
    assert f"put {BENCH_ARCHIVE} into {empty_cache}" in said
    path = archive_of(tmp_path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert digest in refused(f"Expected sha256 {BENCH_DIGESTS[BENCH_ARCHIVE]}, Got", fetch)


def cached():
    """Return whether the real problems were downloaded."""
    try:
        return bool(robot_file("panda", "problems.tar.bz2"))
    except InvalidInputError:
        return False


@pytest.mark.skipif(not cached(), reason="cvqmpt problems fetch motion-bench")
def test_problems_of_the_real_archive_are_solved_and_colliding_ones_are_named():
    for index, joints in ((100, 7), (530, 7), (1100, 6), (1510, 8)):
        problem = motion_bench_problem(index)
        assert problem.robot.dof == joints and not problem.constraint
        assert solve(problem, "birrt", Budget(iterations=20_000), seed=0).solved
        level = level_problem(index)
        assert len(level.constraint) == 1
        check_problem(level)
    found = motion_bench_problem(708)
    assert isinstance(found, UnsolvableProblem) and found.kind == "invalid_goal"
    assert "bookshelf_small/0009: the goal collides, forearm_link" in found.reason
