"""Objects that several test files share; each is made once and must not be changed."""

import shlex
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cvqmpt_lab  # noqa: F401  before numpy: it pins the arithmetic

# isort: split
import numpy as np
import pytest
from command_line import SCAN_START, run_here
from refusals import DATA

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.place_task import (
    multi_sequence_task,
    place_kitchen,
    place_problem,
)
from cvqmpt_lab.features.scan.depth import write_view
from cvqmpt_lab.features.tasks.solve import solve_task
from cvqmpt_lab.planning.pipeline import solve, with_drawn_goals
from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.scene.cloud_files import write_cloud
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.sensing.camera import Camera, Intrinsics, look_at, view_of
from cvqmpt_lab.sensing.observation import arm_objects, solids_of

pytest_plugins = ["promises"]


@pytest.fixture(scope="session")
def part(request):
    """Return `count` evenly spread cases of a large comparison, or all cases with --long."""

    def chosen(cases, count):
        return cases if request.config.getoption("--long") else cases[:: len(cases) // count]

    return chosen


def pytest_runtest_setup():
    """Limit torch, once imported, to one thread: small networks are slower with more."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


@pytest.fixture(scope="session")
def panda():
    return robot_from_source({"name": "panda"})


@pytest.fixture(scope="session")
def slider_arm_urdf():
    """A chain of one slider and three hinges, none of whose axes is z."""
    return DATA / "slider_arm.urdf"


@pytest.fixture(scope="session")
def slider_arm(slider_arm_urdf):
    return load_robot(slider_arm_urdf, "tool")


@pytest.fixture(scope="session")
def open_kitchen():
    """The kitchen of the place task, shelf door open."""
    return place_kitchen()


@pytest.fixture(scope="session")
def published_states():
    """Tensors of a checkpoint like the published ones, by part."""
    from published_files import random_states  # torch takes 2 s to import

    return random_states()


@pytest.fixture
def published(tmp_path, published_states):
    """Write folders like the published ones, with changes name=value, and return their paths."""
    from published_files import write_published

    return partial(write_published, tmp_path, published_states)


@pytest.fixture(scope="session")
def problem():
    """Environment 0 of the place task with its goals."""
    return with_drawn_goals(place_problem(0))


@pytest.fixture(scope="session")
def solution(problem):
    """A certified solution of `problem`."""
    return solve(problem, "birrt", Budget(iterations=20_000), seed=0)


@pytest.fixture(scope="session")
def task():
    """The first task of the multi-sequence suite."""
    return multi_sequence_task(0)


@pytest.fixture(scope="session")
def task_solution(task):
    """`task`, every phase solved and certified."""
    return solve_task(task, "birrt", Budget(seconds=20.0), seed=1)


OBJECTS = (
    SceneObject("table", Box((0.8, 1.4, 0.04)), pose((0.7, 0.0, -0.02))),
    SceneObject("post", Box((0.08, 0.08, 0.5)), pose((0.62, 0.0, 0.25))),
    SceneObject("crate", Box((0.12, 0.12, 0.2)), pose((0.6, 0.3, 0.1), 0.4)),
)
LENS = Intrinsics.from_fov(width=200, height=160, vertical_fov=60.0, near=0.2)
CAMERA = Camera(LENS, look_at((-0.4, 0.3, 1.2), (0.6, 0.0, 0.0)))


@pytest.fixture(scope="session")
def scan_view(panda):
    """A depth camera's view of a table, a post, a crate and the arm at the start."""
    arm = arm_objects(panda, np.fromstring(SCAN_START, sep=","))
    return view_of(solids_of((*OBJECTS, *arm)), CAMERA)


@pytest.fixture(scope="session")
def scan_folder(tmp_path_factory, scan_view):
    """The view as a depth image with its camera, and as a cloud."""
    folder, T = tmp_path_factory.mktemp("scan"), CAMERA.T_world_camera
    write_view(scan_view, folder, "depth")
    write_cloud(folder / "cloud.ply", (scan_view.points - T[:3, 3]) @ T[:3, :3])
    return folder


@pytest.fixture
def cvqmpt(capsys):
    """Run `cvqmpt WORDS` in this process, which must end with `code`; return the output."""

    def output(words, *more, code=0):
        capsys.readouterr()
        run_here([*shlex.split(words), *more], code)
        return capsys.readouterr().out

    return output


@pytest.fixture
def four_threads():
    """Results of a function for each value, in four threads that switch every 10 us."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    with ThreadPoolExecutor(4) as executor:
        yield lambda function, values: list(executor.map(function, values))
    sys.setswitchinterval(before)
