"""Modules that a plan from the shell must not import; planning and tables without torch."""

import json
import os
import re
from functools import cache, partial

import pytest
from command_line import ROOT, python, run

from cvqmpt_lab.cli.main import parser_with
from cvqmpt_lab.cli.model_command import PROFILE_NAMES, STAGES
from cvqmpt_lab.constraints.named import NAMED_REGIONS
from cvqmpt_lab.features.scan.scan import MAP_RESOLUTION_M, ScanSettings
from cvqmpt_lab.planning.margins import Margin
from cvqmpt_lab.planning.planners import PLANNERS
from cvqmpt_lab.search.space import BACKENDS

HEAVY = (
    "torch", "scipy.stats", "scipy.optimize", "scipy.interpolate", "scipy.ndimage", "matplotlib",
    "cvxpy", "highspy", "ompl", "PIL", "rerun", "trimesh", "collada",
    "cvqmpt_lab.paper_tables", "urllib.request",
)  # fmt: skip
IMPORT = "--dictionary-dir d --ar-dir a --out o"
LEARNED = ("safetensors", "cvqmpt_lab.vqmpt.weights")
REPORT = "import json, sys; print(json.dumps(sorted(sys.modules)))"
PEAK = (
    "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))"
)
PACKAGES = ("cvqmpt_lab",)
MOST_MODULES = 118  # of our own that a classical plan imports, 19 empty packages included
MOST_OF_ALL = 701  # that it imports where machine code is on disk
COMPILING = ("numba.np.linalg", "scipy.linalg")  # of what numba imports to compile
MOST_MB = 40  # that weights and prediction add to the memory of a plan


@pytest.fixture
def without_torch(tmp_path):
    """Run a command in a process that cannot import torch."""
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.modules['torch'] = None")
    return partial(run, PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}")


@cache
def planned(*planner):
    """Return the modules that are imported at the end of a plan, and its memory [kB]."""
    words = ["plan", "place-task", "--problem", "7", *planner]
    code = f"from cvqmpt_lab.cli.main import main; assert main({words!r}) == 0; {REPORT}; {PEAK}"
    for _ in range(2):  # the first one may have compiled
        *_, modules, peak = python(code).splitlines()
        if not {*json.loads(modules)} & {*COMPILING}:
            break
    return {*json.loads(modules)}, int(peak)


@pytest.mark.parametrize("planner", [("--planner", "birrt"), ()], ids=["birrt", "default"])
def test_a_classical_plan_imports_nothing_heavy_and_few_modules(planner):
    modules, _ = planned(*planner)
    assert "cvqmpt_lab.planning.pipeline" in modules
    assert not modules & {*COMPILING}
    added = {
        name
        for name in modules
        if re.match(r"cvqmpt_lab\.(planners\.|benchmarks\..*_suite$)", name)
    }
    assert len(modules - added) <= MOST_OF_ALL
    assert not modules & {*HEAVY, *LEARNED}
    own = [name for name in modules if name.split(".")[0] in PACKAGES]
    assert len(own) <= MOST_MODULES, sorted(own)


def test_tables_know_the_suites_and_import_no_robot():
    code = (
        "from cvqmpt_lab.paper_tables.rendering import title_of; "
        "assert title_of('passages').startswith('Narrow'); " + REPORT
    )
    modules = set(json.loads(python(code)))
    assert "cvqmpt_lab.benchmarks.declarations" in modules
    assert not modules & {"pinocchio", "coal", "numba", "cvqmpt_lab.problem"}


def test_a_command_collects_garbage_but_not_what_was_imported():
    code = (
        "import atexit, cvqmpt_lab.cli.main, gc, sys; sys.argv = ['cvqmpt', 'robot']; "
        "atexit.register(lambda: print(gc.isenabled(), gc.get_freeze_count() > 0)); "
        "cvqmpt_lab.cli.main.entry_point()"
    )
    assert python(code).endswith("True True\n")


def test_a_learned_plan_reads_weights_and_imports_nothing_else():
    modules, _ = planned("--planner", "opt-cvq-mpt")
    assert modules >= {*LEARNED}
    assert not modules & {*HEAVY}


def test_weights_and_prediction_need_little_memory():
    (_, classical), (_, learned) = (planned("--planner", name) for name in ("birrt", "opt-cvq-mpt"))
    assert learned - classical <= 1000 * MOST_MB


@pytest.mark.parametrize("words", [["--help"], ["plan", "--help"], ["studio", "--help-all"]])
def test_help_imports_next_to_nothing(words):
    code = f"from cvqmpt_lab.cli.main import main\ntry: main({words})\nexcept SystemExit: " + REPORT
    modules = set(json.loads(python(code).splitlines()[-1]))
    assert "argparse" in modules
    assert not modules & {"numpy", "numba", "scipy", "pinocchio", "coal", *HEAVY, *LEARNED}


def test_help_of_plan_has_the_names_and_defaults_of_the_library():
    (commands,) = (a for a in parser_with(["plan"])._actions if a.dest == "command")
    options = {action.dest: action for action in commands.choices["plan"]._actions}
    known = {"planner": PLANNERS, "constraint": NAMED_REGIONS, "backend": BACKENDS}
    for option, names in known.items():
        words = options[option].help.replace(",", " ").split()
        assert {*names} <= {*words}, option
    scan, margin = ScanSettings(), Margin()
    assert options["margin"].default == (margin.metres, margin.radians)
    assert f"({margin.metres},{margin.radians};" in options["margin"].help
    (commands,) = (a for a in parser_with(["scan"])._actions if a.dest == "command")
    options = {action.dest: action for action in commands.choices["scan"]._actions}
    for option in ("voxel", "robot_margin", "neighbours"):
        value = getattr(scan, option)
        assert options[option].default == value and f"({value}" in options[option].help
    assert f"(default: {scan.down:g})" in options["down"].help
    assert f"({MAP_RESOLUTION_M:g})" in options["map"].help  # without a default beside --radius


def test_all_planners_reproduce_and_render_without_torch(without_torch, tmp_path):
    few = "reproduce place-task --problems 1 --seeds 1 --iterations 100 --jobs 1 --planners all"
    without_torch([*few.split(), "--out", tmp_path / "run"])
    rows = (tmp_path / "run" / "runs.csv").read_text().splitlines()[1:]
    assert len(rows) == len(PLANNERS)
    assert not [row for row in rows if "torch" in row]


def test_help_of_train_needs_no_torch_and_names_what_the_profiles_have(without_torch):
    without_torch(["train", "--help"])
    profiles = pytest.importorskip("cvqmpt_lab.training.profiles")
    assert tuple(profiles.STAGE_MODELS) == STAGES and tuple(profiles.PROFILES) == PROFILE_NAMES


@pytest.mark.parametrize(
    "words", ["train stage1 --data d --out o", f"model import {IMPORT}"], ids=["train", "model"]
)
def test_what_needs_torch_says_how_to_get_it(without_torch, words):
    said = without_torch(words.split(), code=2)
    assert said.count("\n") == 1 and "pip install -c constraints.txt -e '.[train]'" in said
