"""Options of earlier versions name the new spelling; FILE alone is a problem in every command."""

import json

import pytest
from command_line import refused

from cvqmpt_lab.cli.main import COMMANDS, main, parser_with
from cvqmpt_lab.cli.old_spellings import OLD, ROBOT_OPTIONS, SCAN_OPTIONS

MOST_SLOTS, MOST_OF_PLAN = 232, 42
VALUES = {"--end-effectors": "a b", "--lock": "j=0", "--margin-angle": "0.01", "--bodies": "hulls"}
CURES = {
    "--urdf": "; write --robot x",
    "--problem-file": "; write x alone: cvqmpt ",
    "--task-file": "; write x alone: cvqmpt ",
    "--problems-dir": "; write x alone: cvqmpt ",
    "--prices": "; write --cost S:x",
    "--margin-angle": "; write --margin 0.002,0.01",
    "--save-path": "; write --save x",
    "--clearance-out": "; write --save x",
    "--door": "; write --task door",
    "--json": "; write --json > x",
}
GONE = [(command, name) for name, (commands, _) in OLD.items() for command in commands]


def actions_of(command):
    (commands,) = parser_with([command])._subparsers._group_actions
    return commands.choices[command]._actions


@pytest.mark.parametrize(("command", "name"), GONE)
def test_every_old_option_answers_with_the_new_spelling(command, name, capsys):
    known = {option for action in actions_of(command) for option in action.option_strings}
    if name in known and name != "--json":  # options of a scan are old in plan alone
        assert (command, name) == ("scan", name) and name in SCAN_OPTIONS
        return
    words = [name, *VALUES.get(name, "x").split()] if ROBOT_OPTIONS.get(name, 1) else [name]
    if name == "--door":
        words = [name]
    said = refused(capsys, command, *words)
    assert said.startswith(f"cvqmpt: unknown option {' '.join(words)}; ")
    cure = CURES.get(name)
    if cure is None and name in ROBOT_OPTIONS:
        spelled = " ".join(words)
        cure = f"cvqmpt robot NAME|URDF|FILE {spelled} --out robot.json; then give --robot"
    elif cure is None:
        cure = f"; write cvqmpt scan SCAN {' '.join(words)} "
    assert cure in said


def test_the_answer_is_a_command_with_all_options_that_were_given(capsys):
    words = "plan mine.json --urdf arm.urdf --end-effectors a b --lock j=0.1 --hard-limits --seed 3"
    assert refused(capsys, *words.split()) == (
        "cvqmpt: unknown option --urdf arm.urdf; write a robot file: cvqmpt robot arm.urdf "
        "--end-effectors a b --lock j=0.1 --hard-limits --out robot.json; then give --robot "
        "robot.json"
    )
    words = "plan --cloud a.pcd --extrinsics e.json --voxel=0.02 --start -1,2 --goal 1,2"
    assert refused(capsys, *words.split()) == (
        "cvqmpt: unknown option --extrinsics e.json; write cvqmpt scan a.pcd --extrinsics e.json "
        "--voxel 0.02 --arm-at -1,2 --out scene.json; then give --scene scene.json instead of "
        "--cloud"
    )
    words = "plan --robot ur5 --tool 0,0,0.1 --start 0,0,0,0,0,0 --goal 0,0,0,0,0,1"
    assert "cvqmpt robot ur5 --tool 0,0,0.1 --out" in refused(capsys, *words.split())


def test_a_message_about_a_robot_says_where_its_option_stands(capsys, tmp_path):
    assert main(["problems", "new", str(tmp_path / "mine.json"), "--robot", "ur5"]) == 0
    data = json.loads((tmp_path / "mine.json").read_text())
    data["robot"] = {"name": "ur5"}
    (tmp_path / "mine.json").write_text(json.dumps(data))
    capsys.readouterr()
    said = refused(capsys, "execute", tmp_path / "mine.json")
    assert f"cvqmpt robot {tmp_path / 'mine.json'} --acceleration ... --out robot.json" in said


def test_abbreviations_are_answered_too(capsys):
    said = refused(capsys, "plan", "--problem-f", "mine.json")
    assert said.endswith(
        "unknown option --problem-file mine.json; write mine.json alone: cvqmpt plan mine.json"
    )
    assert "--accel" in refused(capsys, "certify", "m.csv", "mine.json", "--accel=3")


def test_option_slots_stay_few():
    slots = {command: len(actions_of(command)) - 1 for command in COMMANDS}
    assert sum(slots.values()) <= MOST_SLOTS and slots["plan"] <= MOST_OF_PLAN


@pytest.fixture
def mine(tmp_path, cvqmpt):
    """Return a problem file of the Panda, whose start is that of the scan of the tests."""
    cvqmpt("problems new", tmp_path / "mine.json")
    return tmp_path / "mine.json"


def test_file_alone_is_enough(mine, cvqmpt, scan_folder, tmp_path, monkeypatch):
    """Where words follow options, too."""
    path, poses = tmp_path / "path.csv", tmp_path / "poses.csv"
    assert "certificate certified" in cvqmpt("plan --iterations 20000", mine, "--save", path)
    assert "certificate certified" in cvqmpt(f"certify {path}", mine)
    assert json.loads(cvqmpt(f"certify {path} --json {mine}"))["valid"]
    assert cvqmpt("fk", mine) == cvqmpt("fk start", mine) == cvqmpt("fk", mine, "start")
    assert "1 posture found" in cvqmpt("ik", mine) and cvqmpt("ik", mine) == cvqmpt(
        "ik --region goal", mine
    )
    told = cvqmpt("scan", scan_folder / "cloud.ply", mine)
    assert told == cvqmpt("scan", scan_folder / "cloud.ply")
    hand = json.loads(cvqmpt("fk --json", mine))["poses"]["panda_hand"]
    xyz = [row[3] for row in hand[:3]]
    lines = [[*xyz, 3.14159, 0, 0], [xyz[0], xyz[1], xyz[2] + 0.02, 3.14159, 0, 0]]
    poses.write_text("\n".join(",".join(map(str, line)) for line in lines))
    assert "certified" in cvqmpt(f"follow {poses}", mine)


def test_the_studio_and_execute_take_a_file_alone(mine, monkeypatch):
    seen = []
    monkeypatch.setattr(
        "cvqmpt_lab.cli.execute_command._motion",
        lambda args, item, times: seen.append(item) or 1 / 0,
    )
    monkeypatch.setattr("cvqmpt_lab.cli.execute_command.mujoco_module", lambda: None)
    monkeypatch.setattr(
        "cvqmpt_lab.cli.plan_runs.compile_kernels", lambda bar: seen.append(0) or 1 / 0
    )
    for command in ("execute", "studio"):
        with pytest.raises(ZeroDivisionError):
            main([command, str(mine)])
    assert len(seen) == 2 and seen[0].name == "mine"


def test_a_task_takes_a_robot_file(cvqmpt, tmp_path, capsys):
    task, robot = tmp_path / "drawer.json", tmp_path / "robot.json"
    cvqmpt(f"problems new {task} --task drawer")
    cvqmpt(f"robot {task} --tool-speed 0.5 --out {robot}")
    told = json.loads(cvqmpt(f"plan {task} --robot {robot} --json --trajectory {tmp_path / 'm'}"))
    assert told["solved"]
    assert cvqmpt("fk", task).startswith("hand        panda_hand")


def test_a_suite_takes_a_robot_file_with_its_own_robot(cvqmpt, tmp_path):
    cvqmpt(f"problems export open-door --problems 1 --out {tmp_path}")
    robot = tmp_path / "robot.json"
    cvqmpt(f"robot {tmp_path / 'open-door-000.json'} --bodies hulls --out {robot}")
    words = f"plan open-door --planner birrt --iterations 20000 --robot {robot}"
    assert "certificate certified" in cvqmpt(words)
