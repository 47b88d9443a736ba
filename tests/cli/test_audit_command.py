"""`cvqmpt audit`: its table, files and exit codes; what is not given is asked for."""

import json

import numpy as np
from command_line import refused
from data_sets import episode, table_of, write_set

from cvqmpt_lab.cli.main import main

ARM = "--robot so-arm101 --jobs 1"


def test_a_data_set_is_audited(tmp_path, cvqmpt):
    good = write_set(tmp_path / "good", [table_of(episode(k), k) for k in range(2)])
    told = cvqmpt(f"audit {good} {ARM} --units degrees --out {tmp_path / 'out'}")
    assert "2 episodes: 2 certified" in told
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"rows.csv", "audit.html"}
    calibration = {
        name.removesuffix(".pos"): {"id": 1, "drive_mode": 0, "range_min": 900, "range_max": 3100}
        for name in json.loads((good / "meta" / "info.json").read_text())["features"]["action"][
            "names"
        ]
    }
    (tmp_path / "c.json").write_text(json.dumps(calibration))
    words = f"audit {good} {ARM} --units normalised --calibration {tmp_path / 'c.json'}"
    assert "2 certified" in cvqmpt(words)
    assert "2 certified" in cvqmpt(f"{words} --column observation.state")
    ball = {"type": "sphere", "radius": 0.3}
    pose = np.eye(4)
    pose[:3, 3] = 0.3, 0.0, 0.2
    scene = {
        "name": "ball",
        "objects": [{"name": "b", "shape": ball, "T_world_object": pose.tolist()}],
    }
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    words = f"audit {good} {ARM} --units degrees --scene {tmp_path / 'scene.json'}"
    assert "collision in 2" in cvqmpt(words, code=1)


def test_one_fault_gives_1_and_nothing_that_can_be_read_gives_2(tmp_path, capsys):
    wrong = episode(1)
    wrong[30, 2] += 30.0
    root = write_set(tmp_path / "set", [table_of(episode(0)), table_of(wrong, 1)])
    words = f"{ARM} --units degrees".split()
    assert main(["audit", str(root), *words]) == 1
    told = capsys.readouterr().out
    assert "elbow_flex jumps by" in told and "1 certified, 1 refused; jump in 1" in told
    for file in root.rglob("*.parquet"):
        file.write_bytes(b"PAR1")
    assert main(["audit", str(root), *words]) == 2
    assert "could be read" in capsys.readouterr().err


def test_what_is_missing_is_asked_for(tmp_path, capsys):
    root = write_set(tmp_path / "set", [table_of(episode(0))])
    assert "needs --robot" in refused(capsys, "audit", root, "--units", "degrees")
    assert "needs --units" in refused(capsys, "audit", root, "--robot", "so-arm101")
    said = refused(capsys, "audit", root, "--robot", "so-arm101", "--units", "normalised")
    assert "needs --calibration" in said
    words = ["--robot", "so-arm101", "--units", "degrees"]
    assert "is inside of" in refused(capsys, "audit", root, *words, "--out", root / "out")
    assert "is no folder" in refused(capsys, "audit", root / "data" / "none", *words)
    assert "cvqmpt audit" in refused(capsys, "certify", root, "--robot", "panda")
    (file,) = root.rglob("*.parquet")
    assert "cvqmpt audit" in refused(capsys, "certify", file, "--robot", "panda")
    assert "'speed'" in refused(capsys, "audit", root, *words, "--column", "speed")
    assert "No such file" in refused(capsys, "audit", root, *words, "--scene", tmp_path / "s.json")
