"""Entries check arrays from Python; numba's machine code is cached on disk and repaired there."""

import gc
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, NamedTuple

import numpy as np
import pytest
from command_line import python
from compiled_kernels import from_python
from numba import TypingError
from refusals import refused

from cvqmpt_lab.base.jit import (
    KERNEL_FILES,
    Entry,
    Pointer,
    called_at_address,
    check_arrays,
    compile_before_clocks,
    compile_in_processes,
    entries,
    entry,
    forget_unused,
    kernel,
)
from cvqmpt_lab.constraints import project as projection
from cvqmpt_lab.constraints.constraint import with_functions
from cvqmpt_lab.constraints.region_constraint import RegionConstraint, stack_regions
from cvqmpt_lab.constraints.regions import FunctionRows
from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.planning import pipeline
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.search import birrt, lazy_roadmap, motion, shortcut
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace, refine_and_check


class Pair(NamedTuple):
    nodes: Annotated[np.ndarray, "rows n"]
    parent: Annotated[np.ndarray, "int64 rows"]


@entry
def first_entry(pair: Pair, q: Annotated[np.ndarray, "n"], factor: float):
    return factor * pair.nodes[0, 0] + q[0]


@kernel
def twice_first_entry(pair, q):
    return 2.0 * first_entry(pair, q, 1.0)


def a_pair(rows=3, n=2, dtype=np.int64):
    return Pair(np.ones((rows, n)), np.zeros(rows, dtype=dtype))


def test_right_arrays_pass_and_compiled_callers_see_the_kernel_itself():
    assert first_entry(a_pair(), np.ones(2), 3.0) == 4.0
    assert from_python(twice_first_entry)(a_pair(), np.ones(2)) == 4.0


@entry(inline="never")
def on_circle(
    derivative: int,
    n: int,
    m: int,
    q: Pointer,
    rotation: Pointer,
    translation: Pointer,
    parameters: Pointer,
    out: Pointer,
):
    """Circle of the first two joints, with its squared radius as parameter."""
    for j in range(n * derivative):
        out[j] = 2.0 * q[j] if j < 2 else 0.0
    if not derivative:
        out[0] = q[0] * q[0] + q[1] * q[1] - parameters[0]
    return 0


def test_an_entry_is_a_function_that_other_kernels_call_by_its_address(panda):
    rows = FunctionRows(on_circle.address, np.zeros(1), np.zeros(1), np.array([0.25]))
    regions = with_functions(stack_regions(panda, (upright(),)), [rows], 0.0)
    scratch = projection.projection_scratch(panda.kinematics, regions)
    q = np.full(7, 0.2)
    assert projection.project(panda.kinematics, regions, q, 1e-9, 20, scratch) > 0
    assert abs(q[0] ** 2 + q[1] ** 2 - 0.25) < 1e-9
    again = Entry(on_circle.py_func, on_circle.options)  # its machine code is on disk
    assert 0 < again.address != on_circle.address
    rows = rows._replace(address=again.address)
    gc.collect()
    regions, q = with_functions(stack_regions(panda, (upright(),)), [rows], 0.0), np.full(7, 0.2)
    assert projection.project(panda.kinematics, regions, q, 1e-9, 20, scratch) > 0
    Entry.all.remove(again)


@entry
def size_and_more(pair: Pair, more: int):
    return pair.nodes.shape[0] + more


size_at = called_at_address(size_and_more)


@kernel
def size_from_afar(address, pair, more):
    return size_at(address, (pair, more))


def test_kernels_call_an_entry_without_a_copy_of_it_with_its_own_types_only():
    call = from_python(size_from_afar)
    assert call(size_and_more.kernel_address, a_pair(), 4) == 7
    with pytest.raises(TypingError, match="size_and_more is called with"):
        call(size_and_more.kernel_address, a_pair(), 4.0)


UNEVEN = Pair(np.ones((3, 2)), np.zeros(4, int))
NEEDED = r"needed: \(n = 2\) of float64"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((a_pair(), np.ones(3), 1.0), rf"first_entry: q has shape \(3,\) of float64; {NEEDED}"),
        ((a_pair(), np.ones(2, dtype=np.float32), 1.0), r"q has shape \(2,\) of float32"),
        ((a_pair(), np.ones((1, 2)), 1.0), r"q has shape \(1, 2\)"),
        ((a_pair(), [1.0, 1.0], 1.0), f"q is a list; {NEEDED}"),
        ((a_pair(), np.ones(4)[::2], 1.0), r"not contiguous"),
        ((a_pair(dtype=np.int32), np.ones(2), 1.0), r"first_entry\.pair: parent .* of int32"),
        ((UNEVEN, np.ones(2), 1.0), r"parent .* needed: \(rows = 3\)"),
    ],
)
def test_what_does_not_fit_is_named(arguments, message):
    refused(message, first_entry, *arguments)


def test_a_space_whose_arrays_do_not_fit_each_other_is_refused(problem, slider_arm):
    arrays = ConstrainedSpace.of(problem).arrays
    check_arrays(arrays)
    refused(r"Space.*n = 7", check_arrays, arrays._replace(state=np.zeros(4)))
    refused(r"Space", check_arrays, arrays._replace(kinematics=slider_arm.kinematics))


SIX = np.zeros((3, 6))


@pytest.mark.parametrize(
    "call",
    [
        lambda space, trees: birrt.grow(space.arrays, trees, SIX, 0, 1.0),
        lambda space, trees: motion.bisect_motion(space.arrays, SIX[0], SIX[1], 1.0, SIX),
        lambda space, trees: motion.motion_free(space.arrays, SIX[0], SIX[1]),
        lambda space, trees: refine_and_check(space.arrays, SIX, SIX, np.zeros(6, dtype=np.int64)),
        lambda space, trees: shortcut.shortcut(space.arrays, SIX, 3, np.zeros((1, 2)), SIX),
        lambda space, trees: motion.states_valid(space.arrays, SIX, np.zeros(3, bool)),
        lambda space, trees: link_poses(space.robot.kinematics, SIX),
        lambda space, trees: space.valid(SIX[0]),
        lambda space, trees: space.project(SIX[0]),
        lambda space, trees: space.residual_and_jacobian(SIX[0]),
        lambda space, trees: space.valid_batch(SIX),
        lambda space, trees: space.checked_path(SIX),
        lambda space, trees: lazy_roadmap.nearest_nodes(
            SIX, 3, np.zeros(7), np.zeros(1, np.int32), np.zeros(1)
        ),
        lambda space, trees: RegionConstraint(space.robot, (upright(),)).residual(SIX),
        lambda space, trees: RegionConstraint(space.robot, (upright(),)).project(SIX[0]),
    ],
)
def test_six_joints_never_reach_a_kernel_of_seven(problem, call):
    space = ConstrainedSpace.of(problem)
    trees = birrt.plant(problem.start, problem.goals, 64)
    refused(r"7|n = 6", call, space, trees)


def test_machine_code_of_versions_long_unused_is_removed_and_nothing_else(tmp_path):
    for k in range(5):
        version = tmp_path / f"{k:016x}"
        version.mkdir()
        (version / "motion.motion_free-0.nbi").touch()
        os.utime(version, (k, k))
    for other in ("0123456789abcdef", "clouds"):
        (tmp_path / other).mkdir()
        (tmp_path / other / "mine.txt").touch()
        os.utime(tmp_path / other, (0, 0))
    forget_unused(tmp_path, kept=2)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {f"{3:016x}", f"{4:016x}", "0123456789abcdef", "clouds"}


SHRINK = """
import numpy as np
from cvqmpt_lab.base.jit import Entry, folder
from cvqmpt_lab.collision.covers import shrink_sphere
print(round(shrink_sphere(np.eye(3), 9, np.zeros(3), np.zeros(3)), 6))
# numba creates the function of an entry only to compile it or a caller
read = [one for one in Entry.all if "unchecked" in vars(one) and "dispatcher" not in vars(one)]
print(len(read), folder())
"""


@pytest.mark.parametrize("cores", [1, 3])
def test_every_entry_is_compiled_and_counted(monkeypatch, cores):
    workers = []

    def threads(count, context):  # in place of processes, which would import everything again
        workers.append(count)
        return ThreadPoolExecutor(count)

    monkeypatch.setattr("concurrent.futures.ProcessPoolExecutor", threads)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(cores), raising=False)
    monkeypatch.setattr("cvqmpt_lab.base.jit.compiled_before", lambda: False)
    counts = []
    compile_in_processes(lambda *count: counts.append(count))
    names = [(one.__module__, one.name) for one in entries()]
    assert names == sorted(set(names)) and first_entry not in entries()
    assert {"reach_free", "grow", "motion_free"} <= {name for _, name in names}
    assert len({module for module, _ in names}) <= len(KERNEL_FILES)
    first = 1 if cores == 1 else 0
    assert counts == [(done, len(names)) for done in range(first, len(names) + 1)]
    assert workers == ([] if cores == 1 else [cores])


def test_what_is_on_disk_is_not_compiled(monkeypatch):
    monkeypatch.setattr("cvqmpt_lab.base.jit.compiled_before", lambda: True)
    compile_in_processes(lambda *count: pytest.fail("something is compiled"))


def test_no_clock_runs_while_kernels_are_compiled(problem, monkeypatch, caplog):
    done = []
    monkeypatch.setattr("cvqmpt_lab.base.jit.compiled_before", lambda: False)
    monkeypatch.setattr("cvqmpt_lab.base.jit.compile_all", lambda: done.append("kernels"))
    monkeypatch.setattr("cvqmpt_lab.base.jit.entries", lambda: [SimpleNamespace(ready=False)])
    goals_of = pipeline.goals_of
    monkeypatch.setattr(pipeline, "goals_of", lambda *one: done.append("goals") or goals_of(*one))
    compile_before_clocks.cache_clear()
    for _ in range(2):
        pipeline.solve(problem, "birrt", Budget(iterations=100), 0)
    assert done == ["kernels", "goals", "goals"]
    assert caplog.text.count("compiling kernels") == 1
    # where machine code cannot be kept on disk, what the command compiled is not compiled again
    monkeypatch.setattr("cvqmpt_lab.base.jit.entries", lambda: [SimpleNamespace(ready=True)])
    compile_before_clocks.cache_clear()
    compile_before_clocks()
    assert done.count("kernels") == 1


READ_ONLY = """
import os, sys
def refuse_to_write(event, arguments):  # rights do not bind root, who may run the tests
    if event in ("open", "os.mkdir", "os.rename", "os.utime", "os.remove") \
and str(arguments[0]).startswith(WARM):
        if event != "open" or arguments[2] & (os.O_WRONLY | os.O_RDWR):
            raise PermissionError(13, "Permission denied")
sys.addaudithook(refuse_to_write)
os.access = lambda path, mode: False
"""


@pytest.fixture
def shrink(tmp_path):
    """Run SHRINK after other code with a cache folder; return radius, entries, folder, warnings."""

    def run(before=""):
        warm = str(tmp_path / "warm")
        environment = os.environ | {"NUMBA_CACHE_DIR": warm, "TMPDIR": str(tmp_path)}
        command = [sys.executable, "-c", before.replace("WARM", repr(warm)) + SHRINK]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        radius, used = done.stdout.splitlines()
        count, place = used.split(" ", 1)
        said = done.stderr.splitlines()
        warnings = [line for line in said if re.search("Warning|digest", line)]
        return radius, int(count), place, warnings

    return run


def test_machine_code_is_read_where_nothing_can_be_written_and_not_where_others_can_write(
    tmp_path, shrink
):
    radius, _, place, _ = shrink()
    files = sorted(tmp_path.rglob("*.nb?"))
    assert files and shrink(READ_ONLY) == (radius, len(files) // 2, place, [])
    for file in files[::2]:
        file.unlink()
    again, count, _, told = shrink(READ_ONLY)
    assert again == radius and len(told) == 1 and "cannot be kept" in told[0]
    (tmp_path / "warm").chmod(0o777)
    again, count, instead, told = shrink()
    assert (again, count) == (radius, 0) and len(told) == 1 and "others can write" in told[0]
    assert instead != place and shrink()[1] == len(files) // 2


CALLER = """
import test_jit
print(test_jit.first_entry(test_jit.a_pair(), test_jit.np.ones(2), 3.0))
print("dispatcher" in vars(test_jit.first_entry))
test_jit.test_right_arrays_pass_and_compiled_callers_see_the_kernel_itself()
"""


def test_what_calls_an_entry_that_was_read_from_disk_is_compiled(tmp_path):
    here, tests = Path(__file__).parent, Path(__file__).parents[1]
    paths = os.pathsep.join(map(str, (here, tests / "helpers", tests.parent)))
    how = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": paths}
    said = [python(CALLER, **how).split() for _ in range(2)]
    assert said == [["4.0", "True"], ["4.0", "False"]]


def test_damaged_machine_code_is_compiled_anew(tmp_path, shrink):
    whole = shrink()
    files = list(tmp_path.rglob("*.nb?"))
    for file in files:
        file.write_bytes(file.read_bytes()[: 0 if file.suffix == ".nbi" else 1000])
    assert files and shrink()[0] == whole[0]
    assert all(file.stat().st_size > 1000 for file in tmp_path.rglob("*.nbc"))
    assert shrink()[1] == len(files) // 2


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_machine_code_with_a_changed_bit_is_compiled_anew(tmp_path, shrink, suffix):
    """The process crashed by signal 11, or ended in a traceback of pickle."""
    whole = shrink()
    files = list(tmp_path.rglob(f"*{suffix}"))
    for number, file in enumerate(files):
        data = bytearray(file.read_bytes())
        data[(number + 1) * len(data) // (len(files) + 1)] ^= 1 << (number % 8)
        file.write_bytes(data)
    radius, _, _, said = shrink()
    told = [
        line for line in said if "is damaged (its digest differs): it is compiled again" in line
    ]
    assert radius == whole[0] and len(told) == len(files) > 0
    assert shrink() == whole[:1] + (len(list(tmp_path.rglob("*.nbc"))), *whole[2:])
