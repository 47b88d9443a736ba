"""Machine code on disk: every entry has a place in it, it is told from damaged files, and loading it needs no numba."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from cvqmpt_lab import kernels
from cvqmpt_lab.kernels import objects
from cvqmpt_lab.kernels.entry import Entry
from cvqmpt_lab.kernels.manifold.kinematics import write_link_poses

ROOM = Path(kernels.__file__).parent
MODULES = [
    ".".join(path.relative_to(ROOM).with_suffix("").parts)
    for path in sorted(ROOM.rglob("*.py"))
    if path.name != "__init__.py"
]


def test_every_entry_is_compiled_in_the_group_of_its_module():
    grouped = [module for modules in objects.GROUPS.values() for module in modules]
    assert len(grouped) == len(set(grouped))
    for module in MODULES:
        own = import_module(objects.ROOM + module)
        entries = [e for e in vars(own).values() if isinstance(e, Entry) and e.__module__ == own.__name__]
        assert bool(entries) == (module in grouped), module


def test_a_damaged_file_is_compiled_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    path = objects._path("poses")
    objects._functions.__wrapped__("poses")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    functions = objects._functions.__wrapped__("poses")
    assert set(functions) == {write_link_poses.symbol} and len(path.read_bytes()) > len(whole) // 2


def test_machine_code_of_versions_long_unused_is_removed_and_nothing_else(tmp_path):
    for k in range(5):
        version = tmp_path / f"{k:016x}"
        version.mkdir()
        (version / "plan-0.o").touch()
        os.utime(version, (k, k))
    for other in ("0123456789abcdef", "clouds"):
        (tmp_path / other).mkdir()
        (tmp_path / other / "mine.txt").touch()
        os.utime(tmp_path / other, (0, 0))
    objects.forget_unused(tmp_path, kept=2)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {f"{3:016x}", f"{4:016x}", "0123456789abcdef", "clouds"}


WRONG_MEMBERS = """
import sys
import numpy as np
from cvqmpt_lab.kernels.manifold.kinematics import Kinematics, write_link_poses
one = np.zeros((1, 7)), np.empty((1, 8, 3, 3)), np.empty((1, 8, 3))
for wrong in (np.zeros(7), np.zeros((7, 1), dtype=np.int64), None):
    try:
        write_link_poses.unchecked(Kinematics(*[wrong] * len(Kinematics._fields)), *one)
    except TypeError as error:
        print(error)
print('numba' in sys.modules)
"""


def test_wrong_members_of_a_bundle_are_refused_by_the_machine_code_itself_without_numba():
    objects.make_ready(("poses",))
    lines = said_by(WRONG_MEMBERS)
    assert len(lines) == 4 and all("another type" in line for line in lines[:3]) and lines[3] == "False"


def test_planning_with_machine_code_on_disk_imports_no_numba():
    objects.make_ready()
    plan = "import sys; from cli.main import main; main(['plan', 'place-task', '--problem', '3']); "
    assert said_by(plan + "print('numba' in sys.modules)")[-1] == "False"


def said_by(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()
