"""A web page has the whole motion and its plots, loads nothing, and a browser displays it."""

import json
import shutil
import subprocess
from base64 import b64decode
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSER, Tab, until
from PIL import Image

from cvqmpt_lab.features.pictures import web_page
from cvqmpt_lab.features.pictures.visuals import drawn_pieces
from cvqmpt_lab.features.pictures.web_page import save_page
from cvqmpt_lab.features.tasks.world import World

NODE = shutil.which("node")


def data_of(path):
    before, after = web_page.PAGE_TEMPLATE.read_text().split(web_page.PAGE_DATA_ELEMENT)
    text = path.read_text()
    assert text.startswith(before) and text.endswith(after) and "://" not in before + after
    data = text[len(before) : -len(after)].removeprefix(web_page.PAGE_DATA_ELEMENT[:-11])
    return json.loads(data.removesuffix("</script>"))


def array(text):
    return np.frombuffer(b64decode(text), "<f4")


def test_a_page_holds_the_motion_and_its_plots(solution, tmp_path):
    seen = replace(solution.problem.scene, unseen=0.38)
    named = replace(solution.problem, name="a</script><!--<script>b", scene=seen)
    named = replace(solution, problem=named)
    save_page(named, tmp_path / "a.html")
    assert "<!--" not in (tmp_path / "a.html").read_text()
    data = data_of(tmp_path / "a.html")
    states = solution.path.states
    assert data["title"].startswith("a</script><!--<script>b: panda, solved")
    assert data["states"] == len(states)
    assert ["38% of the arm's reach is unseen" in line for line in data["unseen"]] == [True]
    robot = [body for body in data["bodies"] if body["group"] == "robot"]
    assert len(robot) == len(drawn_pieces(solution.problem.robot))
    fingers = np.linalg.inv(solution.problem.robot.poses(states, "panda_rightfinger"))
    drawn = np.tile(np.eye(4), (len(states), 1, 1))
    drawn[:, :3] = array(robot[-1]["poses"]).reshape(-1, 3, 4)
    assert np.ptp(fingers @ drawn, axis=0) == pytest.approx(0.0, abs=1e-5)
    plots = {plot["title"]: plot for plot in data["plots"]}
    assert {"tilt of the hand [deg]", "clearance [mm]"} < plots.keys()
    bounds = plots["rotation about y against its bounds [rad]"]["curves"]
    assert [curve["bound"] for curve in bounds] == [False, True, True]
    assert bounds[2]["values"][0] == 0.1
    limit = np.degrees(2.0 * np.arcsin(0.5 * np.hypot(0.1, 0.1)))
    assert plots["tilt of the hand [deg]"]["curves"][1]["values"][0] == pytest.approx(limit, 1e-4)
    assert plots["tilt of the hand [deg]"]["low"] == plots["clearance [mm]"]["low"] == 0.0
    assert min(plots["clearance [mm]"]["curves"][0]["values"]) > 0.0
    assert max(plots["tilt of the hand [deg]"]["curves"][0]["values"]) < np.degrees(0.1415)


def test_a_page_of_a_task_has_path_of_the_hand_clearance_and_joints(task_solution, tmp_path):
    save_page(task_solution, tmp_path / "task.html")
    data = data_of(tmp_path / "task.html")
    assert "path of the hand" in {body["group"] for body in data["bodies"]}
    path, clearance, joints = data["plots"]
    assert [curve["name"] for curve in path["curves"]] == ["x", "y", "z"]
    assert [curve["name"] for curve in joints["curves"]] == list(
        World.before(task_solution.task).arm.joint_names
    )
    known = [value for value in clearance["curves"][0]["values"] if value is not None]
    assert len(clearance["curves"][0]["values"]) == data["states"] > len(known) > 10
    assert min(known) > 0.0


@pytest.mark.skipif(NODE is None, reason="no Node.js is installed")
def test_legends_name_every_curve_with_its_value(solution, tmp_path):
    save_page(solution, tmp_path / "plan.html")
    script = Path(__file__).with_name("run_page.js")
    command = [NODE, script, tmp_path / "plan.html", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    tilt, *_, joints = done.stdout.splitlines()
    assert tilt.startswith("tilt of the hand [deg]: tilt ") and "bounds 8.11" in tilt
    for name, value in zip(
        solution.problem.robot.joint_names, solution.path.states[0], strict=True
    ):
        assert f"{name} {float(f'{value:.3g}'):g}" in joints


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_walls_do_not_hide_the_robot_from_any_side(solution, tmp_path):
    save_page(solution, tmp_path / "plan.html")
    largest = """(() => { // share of the picture that has one colour
        const pixels = new Uint8Array(4 * canvas.width * canvas.height), counts = new Map();
        gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
        for (const pixel of new Uint32Array(pixels.buffer))
          counts.set(pixel, (counts.get(pixel) ?? 0) + 1);
        return Math.max(...counts.values()) / (canvas.width * canvas.height); })()"""
    with Tab(f"file://{tmp_path}/plan.html", tmp_path / "user", size=(700, 900)) as tab:
        until(lambda: tab.value("document.readyState === 'complete'") and tab.text())
        for azimuth in np.linspace(-np.pi, np.pi, 13):
            tab.value(f"camera.azimuth = {azimuth}; draw()")
            assert tab.value(largest) < 0.8, azimuth
        assert not tab.said


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_a_browser_shows_scene_robot_and_plots(solution, task_solution, tmp_path):
    save_page(solution, tmp_path / "plan.html")
    save_page(task_solution, tmp_path / "task.html")
    last = len(solution.path.states) - 1
    # a turn and back, then a second finger that zooms and back
    used = """
        const { distance, target } = camera, touch = (pointerId, clientX) => {
          const event = { pointerId, clientX, clientY: 0 };
          if (!fingers.has(pointerId)) fingers.set(pointerId, event);
          canvas.onpointermove(event);
        };
        for (const x of [0, 9, 0]) touch(1, x);
        for (const x of [100, 200]) touch(2, x);
        if (!(camera.distance < 0.6 * distance)) throw new Error("no zoom");
        touch(2, 100);
        Object.assign(camera, { target });
        fingers.clear();
    """
    used += f"byId('play').click(); show(1); byId('play').click(); show({last});"
    used = f"setTimeout(() => {{ {used} }}, 300);"  # after the first frame is on the screen
    page = (tmp_path / "plan.html").read_text()
    page = page.replace("</body>", f"<script>{used}</script></body>")
    (tmp_path / "used.html").write_text(page)
    shown = {}
    for page in ("plan.html#0", "used.html#0", "task.html#0"):
        words = "--headless --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader "
        words += "--window-size=700,900 --virtual-time-budget=4000 --enable-logging=stderr"
        files = [f"--user-data-dir={tmp_path}/user", f"--screenshot={tmp_path}/shot.png"]
        command = [BROWSER, *words.split(), *files, f"file://{tmp_path}/{page}"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert "CONSOLE" not in done.stderr, done.stderr
        shown[page] = np.array(Image.open(tmp_path / "shot.png").convert("RGB"), dtype=int)
    first, end, task = shown.values()
    trace = (first[..., 0] - first[..., 2] > 130) & (first[..., 1] > 60)  # orange beads
    assert trace[:560].sum() > 100
    assert (np.abs(first - end).max(axis=2) > 60)[:560].sum() > 1000  # the robot moved
    drawn = [(picture.min(axis=2) < 240)[40:500].sum() for picture in (first, end)]
    assert drawn[1] == pytest.approx(drawn[0], rel=0.1)  # nothing is lost by turning and playing
    assert (np.abs(first - end).max(axis=2) > 60)[640:].sum() > 50  # and the marks in the plots
    assert len(np.unique(task[40:500].reshape(-1, 3), axis=0)) > 500
