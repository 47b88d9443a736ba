"""Every command on pages and in helps runs, in the order printed, in an empty folder.

The default run leaves out what takes long (`LONG`); `pytest --long` runs it, too. Both take small
amounts (`SMALLER`).
"""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import SCAN_START
from pages import PAGES, ROOT, command_lines, python_of, words_of
from refusals import DATA

from cvqmpt_lab.base.modules import Code
from cvqmpt_lab.cli.main import COMMANDS, examples_of, main
from cvqmpt_lab.scene.cloud_files import write_cloud

PAGES_WITH_COMMANDS = [path for path in PAGES if list(command_lines(path.read_text()))]
FEW = "--scenes 40 --paths-per-scene 4"
LABELS = "--scenes 80 --paths-per-scene 12"  # the fewest that a transformer trains on
TRAY = "TRAY"  # stands for the start of tray.json
OTHER_START = "0.9,0.3,0,-2.0,0,2.3,0.8"  # the pose of SCAN_START on the other side
NOT_RUN = {
    r"^(git|make|pip|\.venv/bin/pip|- run: pip)\b": "installs, or builds what `make test` builds",
    r"^dask |--dask ": "needs a cluster",
    r"\bproblems fetch|motion-bench": "needs a network",
    r"\breproduce peers": "needs the extra `peers`, which is not installed",
    r"\bbench paper-": "needs the extra `pybullet`, which is not installed",
    r"reproduce all ": "takes minutes; tests/cli/test_reproduce.py runs it with one problem",
    r"table paper_tables/": "writes into the checkout what `check-tables` compares",
    r"\bcvqmpt studio": "serves until Ctrl-C; tests/features/studio start it",
    r"claims .*--write": "writes into the checkout; tests/paper_tables write a copy",
    r"docs/judge/|run.mcap": "tests/test_documents.py compares what they print",
    r"\bcvqmpt audit ": "needs data sets; tests/cli/test_audit_command.py makes some",
    r"--proof |cvqmpt_check": "tests/features/proof write proofs and check them",
    r"\bcompletion ": "needs the extra `completion`, which is not installed",
    r"train transformer .*--dictionary": "needs a dictionary of thousands of paths; the log of"
    " training trains one for the shipped dictionary",
    r"check-tables( --all)?$": "repeats planners for minutes, as `make test` does",
}
"""What no test here runs, with the reason."""
LONG = (
    r"cvqmpt (reproduce|data|train|bench|execute|figure|report|compare|table|claims)\b",
    r"check-tables|multi-sequence|runs/|data/ur5|--model|model import|--save \S+(gif|rrd)",
)
"""What takes a second or more of processor time, or needs the results of such a command."""
SMALLER = {
    r"(problems export place-task)": r"\1 --problems 1",
    r"paper_tables/results": str(ROOT / "paper_tables" / "results" / "passages"),
    r"(--problems|--seeds|--epochs|--minutes) \d+": r"\1 1",
    r"(reproduce (?!all|problems)(?!.*--problems).*)": r"\1 --problems 1",
    r"(reproduce (?!.*--cutoff)(?!.*ompl|.*--iterations).*)": r"\1 --cutoff 1",
    r"--scenes \d+": "--scenes 40",
    r"--paths-per-scene \d+": "--paths-per-scene 4",
    r"(labels roadmap .*)--scenes \d+( --paths-per-scene \d+)?": rf"\1{LABELS}",
    r"(train .*)--profile (compact|published)": r"\1--profile smoke",
    r"(reproduce .*)--cutoff \d+": r"\1--cutoff 1",
    r"(plan .*)--cutoff 5": r"\1--cutoff 60",  # so that it is solved on a busy machine, too
}
"""Amounts that are made smaller: patterns, and what is taken instead."""
READERS = {
    r"--robot baxter(.*)\$Q(.*)\$G": rf"--robot baxter\1{TRAY}\2{TRAY}",
    r"\"?\$Q\"?|\bQ1\b|\b0,0,0,-2,0,2,0|\b0,-0\.8,0,-2\.4,0,1\.6,0\.8": SCAN_START,
    r"\"?\$G\"?|\bQ2\b|\b1,0,0,-2,0,2,0": OTHER_START,
}
"""What stands for values of the reader."""
BEFORE = {
    r"(?<!new )mine\.json": "cvqmpt problems new --robot panda mine.json",
    r"(?<!new )task\.json": "cvqmpt problems new --task drawer task.json",
    r"(?<!new )drawer\.json": "cvqmpt problems new --task drawer drawer.json",
    r"motions/ drawer": "cvqmpt plan drawer.json --trajectory motions/",
    r"--scene scene\.json": f"cvqmpt scan depth.png --intrinsics lens.yaml --extrinsics pose.json "
    f"--arm-at {SCAN_START} --out scene.json",
    r"--scene room\.json": "cvqmpt problems import shelf.scene --out room.json",
    r"--cloud clean\.pcd": "cvqmpt scan depth.png --intrinsics lens.yaml --extrinsics pose.json "
    "--out clean.pcd",
    r"--robot robot\.json": "cvqmpt robot panda --tool 0,0,0.1 --out robot.json",
    r"certify motion\.csv": "cvqmpt plan place-task --problem 7 --trajectory motion.csv",
    r"path\.csv place-task": "cvqmpt plan place-task --problem 7 --save path.csv",
    r"motion\.json place-task": "cvqmpt plan place-task --problem 7 --trajectory motion.json",
    r"path\.json mine\.json": "cvqmpt plan mine.json --trajectory path.json",
    r"--motion motion\.json|certify motion\.json mine": "cvqmpt plan mine.json --trajectory "
    "motion.json",
    r"(?<!new )tray\.json --": "cvqmpt problems new --robot baxter tray.json",
    r"certify runs/mine|(?<!--out )problems/?( |$)": "cvqmpt problems export place-task "
    "--problems 1 --out problems",
    r"compare runs/kept": "cvqmpt reproduce problems/ --planners my_planner:plan --cutoff 1 "
    "--out runs/now",
    r"certify runs/mine": "cvqmpt reproduce problems/ --planners birrt --cutoff 1 --out runs/mine",
    r"(certify|figure (?!histogram|concept)\w+|report|compare|table) (?:.* )?runs/(\w[\w-]*)": (
        r"cvqmpt reproduce place-task --problems 1 --planners birrt,my_module:plan --cutoff 1 "
        r"--out runs/\2"
    ),
    r"compare runs/(\w+) runs/": "cvqmpt reproduce place-task --problems 1 --planners birrt "
    r"--cutoff 1 --out runs/\1",
    r"--data data/(paths|small)": f"cvqmpt data generate {FEW} --out data/\\1",
    r"--data data/roadmap": f"cvqmpt data generate --labels roadmap {LABELS} --out data/roadmap",
    r" runs/ur5( |$)": f"cvqmpt data generate --robot ur5 {FEW} --out data/ur5",
    r"--dictionary runs/ur5( |$)": "cvqmpt train stage1 --profile smoke --data data/ur5 "
    "--out runs/ur5",
    r"--data data/ur5-roadmap": "cvqmpt data generate --labels roadmap --robot ur5 --dictionary "
    f"runs/ur5 {LABELS} --out data/ur5-roadmap",
    r"--dictionary runs/published": "cvqmpt train stage1 --profile smoke --data data/paths --out "
    "runs/published",
    r"--model runs/published": "cvqmpt model import --dictionary-dir A --ar-dir B --out "
    "runs/published",
}
"""What a reader did before: a pattern of commands, and what wrote the file of its last word."""
CODES = {
    r"--current \"0.1|--request request|plan place-task .* my_planner:plan$|compare runs/kept": 1
}
"""Exit codes of commands that do not end with 0."""


@pytest.fixture
def readers_folder(tmp_path, monkeypatch, scan_folder, scan_view):
    """An empty folder but for files that are the reader's own: scans, an arm, poses."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Code, "allowed", False)
    for name in ("my_module", "my_planner"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    lens, pose = (
        json.loads((scan_folder / f"depth.{x}.json").read_text())
        for x in ("intrinsics", "extrinsics")
    )
    shutil.copy(scan_folder / "depth.png", "depth.png")
    Path("lens.yaml").write_text(json.dumps(lens))
    for name in ("pose", "left", "right"):
        Path(f"{name}.json").write_text(json.dumps(pose))
    T = np.array(pose["T_world_camera"])
    for name in ("scan", "left", "right"):
        write_cloud(Path(f"{name}.pcd"), (scan_view.points - T[:3, 3]) @ T[:3, :3])
    shutil.copy(DATA / "slider_arm.urdf", "arm.urdf")
    shutil.copy(DATA / "newer.scene", "shelf.scene")
    for name in ("my_planner", "my_module"):
        Path(f"{name}.py").write_text(python_of("docs/your_planner.md")[0])
    poses = ("0.4,0.1,0.5,3.1416,0,0", "0.4,0.2,0.5,3.1416,0,0", "0.45,0.2,0.45,3.1416,0,0")
    for name in ("poses", "seam"):
        Path(f"{name}.csv").write_text("\n".join(poses) + "\n")
    for made, given in (("motion", "plan"), ("request", "request")):
        shutil.copy(ROOT / "docs" / "judge" / f"{given}.yaml", f"{made}.yaml")
    Path("scene.yaml").write_text("name: empty\nis_diff: false\nworld: {collision_objects: []}\n")
    return tmp_path


@pytest.fixture
def authors_weights(request):
    """With --long: folders like those of the authors' weights, which need torch."""
    if request.config.getoption("--long"):
        dictionary, sequence = request.getfixturevalue("published")()
        for name in ("A", "model1"):
            shutil.copytree(dictionary, name)
        for name in ("B", "stage2/model1"):
            shutil.copytree(sequence, name)


def run_commands(lines, capsys, everything):
    """Run the commands of a page in order."""
    for line in lines:
        if any(re.search(pattern, line) for pattern in NOT_RUN):
            continue
        if not everything and any(re.search(pattern, line) for pattern in LONG):
            continue
        made = line
        for pattern, taken in (SMALLER | READERS).items():
            made = re.sub(pattern, taken, made)
        if TRAY in made:
            start = json.loads(Path("tray.json").read_text())["start"]
            made = made.replace(TRAY, ",".join(map(str, start.values())))
        for pattern, earlier in BEFORE.items():
            if not (found := re.search(pattern, line)):
                continue
            earlier = found.expand(earlier)
            if not Path(earlier.split()[-1]).exists():
                assert main(words_of(earlier)) == 0, (earlier, capsys.readouterr())
        wanted = next((c for p, c in CODES.items() if re.search(p, line)), 0)
        assert main(words_of(made)) == wanted, (made, capsys.readouterr())


def help_lines(command):
    """Return the examples of a command's help."""
    return list(command_lines("```\n{}\n```".format("\n".join(examples_of(command)))))


def test_every_entry_of_the_tables_is_about_a_command():
    lines = [line for command in COMMANDS for line in help_lines(command)]
    lines += [line for page in PAGES for line in command_lines(page.read_text(encoding="utf-8"))]
    for table in (NOT_RUN, LONG, SMALLER, READERS, BEFORE, CODES):
        unused = [x for x in table if not any(re.search(x, line) for line in lines)]
        assert unused == []


@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS, ids=lambda page: page.name)
def test_commands_of_a_page_run_in_order(page, readers_folder, authors_weights, capsys, request):
    if page.name == "your_constraint.md":
        Path("my_module.py").write_text(python_of(page)[0])
    lines = list(command_lines(page.read_text(encoding="utf-8")))
    run_commands(lines, capsys, request.config.getoption("--long"))


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_of_a_help_run_in_order(command, readers_folder, authors_weights, capsys, request):
    run_commands(help_lines(command), capsys, request.config.getoption("--long"))
