"""A web page has the whole motion and its plots, loads nothing, and a browser displays it."""

import io
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

from cvqmpt_lab.features.motion.motion_check import certified_motion
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.pictures import web_page
from cvqmpt_lab.features.pictures.picture import still_image
from cvqmpt_lab.features.pictures.raster import Viewpoint
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


def opened(path, folder, size=(1400, 1000)):
    """Return a tab that shows a page, as soon as it is drawn."""
    tab = Tab(f"file://{path}", folder, size=size)
    until(lambda: tab.value("document.readyState === 'complete'") and tab.text())
    return tab


def pixels_of(tab):
    """Return the pixels (height, width, 3) of a screenshot."""
    return np.array(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"), dtype=int)


def press(tab, key):
    for kind in ("keyDown", "keyUp"):
        text = {"text": key} if len(key) == 1 and kind == "keyDown" else {}
        tab.call("Input.dispatchKeyEvent", type=kind, key=key, **text)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_a_page_has_the_light_shadow_ground_and_outlines_of_the_still_picture(solution, tmp_path):
    save_page(solution, tmp_path / "plan.html")
    with opened(tmp_path / "plan.html", tmp_path / "user", (1100, 700)) as tab:
        groups = set(tab.value("data.bodies.map((body) => body.group)")) - {"scene", "robot"}
        shown = tab.value(
            f"(() => {{ {json.dumps(sorted(groups))}.forEach((group) => hidden.add(group));"
            "views.reset(); draw(false); const { width, height } = canvas;"
            "const pixels = new Uint8Array(4 * width * height);"
            "gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);"
            "return { pixels: [...pixels], width, height, camera }; })()"
        )
    width, height, camera = shown["width"], shown["height"], shown["camera"]
    page = np.array(shown["pixels"]).reshape(height, width, 4)[::-1, :, :3]
    turn, rise = camera["azimuth"], camera["elevation"]
    back = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
    eye = camera["target"] + camera["distance"] * back
    view = Viewpoint(tuple(eye), tuple(camera["target"]), camera["angle"])
    problem = solution.problem
    still = still_image(problem, problem.start, (width, height), view).astype(int)
    apart = np.abs(page - still).max(axis=2)
    # walls in front of the robot are transparent on the page alone
    assert np.median(apart) <= 3 and (apart < 30).mean() > 0.85


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_mouse_keys_and_buttons_turn_zoom_step_and_play(solution, tmp_path):
    save_page(solution, tmp_path / "plan.html")
    with opened(tmp_path / "plan.html", tmp_path / "user", (1000, 700)) as tab:
        middle = tab.value(
            "(() => { const r = canvas.getBoundingClientRect();"
            "return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )

        def wheel():
            x, y = middle
            tab.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=120)

        before = tab.value("camera.distance")
        wheel()
        until(lambda: tab.value("byId('hint').className") == "on")
        assert tab.value("camera.distance") == before, "without the focus the page scrolls"
        turn = tab.value("camera.azimuth")
        tab.drag(middle, (middle[0] + 60, middle[1] + 10))
        until(lambda: tab.value("camera.azimuth") == pytest.approx(turn - 0.48))
        wheel()
        until(lambda: tab.value("camera.distance") > 1.05 * before)
        press(tab, "r")
        until(lambda: tab.value("camera.azimuth") == turn)
        press(tab, "ArrowRight")
        assert tab.value("state()") == 1
        press(tab, "End")
        assert tab.value("state()") == len(solution.path.states) - 1
        press(tab, " ")
        until(lambda: 0 < tab.value("state()") < len(solution.path.states) - 1)
        press(tab, " ")
        assert tab.value("playing") is None
        full = "Math.abs(canvas.width - canvas.clientWidth) < 2"
        until(lambda: tab.value(f"!busy && {full}"))
        assert tab.value(f"draw(true); {full}") is False, "coarse while it moves"
        until(lambda: tab.value(full))
        tab.click("top", lambda: tab.value("camera.elevation") == 1.55)
        tab.click("full screen", lambda: tab.value("document.fullscreenElement !== null"))
        press(tab, "Enter")
        assert not tab.said


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_a_page_fills_the_window_fits_a_phone_and_is_dark_where_the_system_is(solution, tmp_path):
    save_page(solution, tmp_path / "plan.html")
    edges = "['head', 'world', 'bar', 'legend', 'help'].map((name) => (byId(name) ?? "
    edges += "document.querySelector('header')).getBoundingClientRect().bottom)"
    with opened(tmp_path / "plan.html", tmp_path / "user", (1300, 900)) as tab:
        assert max(tab.value(edges)) <= 900, "the help is within view"
        width, height = tab.value("[canvas.clientWidth, canvas.clientHeight]")
        assert width > 0.6 * 1300 and height > 0.7 * 900
        bright = pixels_of(tab)
        media = [{"name": "prefers-color-scheme", "value": "dark"}]
        tab.call("Emulation.setEmulatedMedia", features=media)
        dark = pixels_of(tab)
        assert bright[5, 5].min() > 240 and dark[5, 5].max() < 40
        tab.resize(390, 800)
        until(lambda: tab.value("canvas.clientWidth") < 390)
        assert tab.value("document.documentElement.scrollWidth") <= 390
        assert not tab.said


@pytest.mark.skipif(NODE is None, reason="no Node.js is installed")
def test_axes_have_round_numbers(solution, tmp_path):
    save_page(solution, tmp_path / "plan.html")
    script = Path(__file__).with_name("run_page.js")
    command = [NODE, script, tmp_path / "plan.html", "0", "ticks(-0.116, 0.116, 3)"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert json.loads(done.stdout.splitlines()[-1]) == [-0.1, 0.0, 0.1]


def test_a_timed_motion_is_shown_over_its_seconds(solution, tmp_path):
    motion = certified_motion(solution.problem, solution.path, TimingSettings(0.3))
    save_page(solution, tmp_path / "a.html", motion=motion, name="my-suite 7")
    save_page(solution, tmp_path / "b.html", motion=motion, name="my-suite 7")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    data = data_of(tmp_path / "a.html")
    assert data["title"].startswith("my-suite 7: panda, solved")
    assert data["times"][-1] == pytest.approx(motion.duration, abs=1e-3) == data["seconds"]
    assert data["labels"][0] == f"0.0 of {motion.duration:.1f} s"
    assert len(data["times"]) == data["states"] == len(data["plots"][0]["curves"][0]["values"])


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
            tab.value(f"camera.azimuth = {azimuth}; draw(false)")
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
