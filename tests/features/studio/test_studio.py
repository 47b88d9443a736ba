"""A studio plans again when start, goal or obstacles move, and its page shows the result."""

import asyncio
import html
import json
import math
import re
import signal
import subprocess
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from browser import BROWSER, Tab, until
from command_line import start
from refusals import refused

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.features.motion.trajectory import read_motion
from cvqmpt_lab.features.pictures.bodies import BODY_COLOURS
from cvqmpt_lab.features.pictures.meshes import shape_mesh
from cvqmpt_lab.features.studio.studio import state_of, studio, text_of
from cvqmpt_lab.features.studio.studio_look import outline
from cvqmpt_lab.features.studio.studio_planning import Studio
from cvqmpt_lab.planning.margins import Margin
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.shapes import Box

CHOSEN = tuple(round(255 * part) for part in BODY_COLOURS["chosen"])
FAR = pose((9.0, 0.0, 0.5))


@pytest.fixture(scope="module")
def live(problem):
    """A studio that has already planned once."""
    made = Studio(problem)
    assert made.wait().verdict == "certified"
    yield made
    made.stop()


@pytest.fixture
def fresh(live, problem):
    """The studio with the problem's own start, goals, obstacles and constraint."""
    live.wait(live.submit(start=None, goal=None, moved={}, constraint="own", planner="roadmap"))
    assert live.response.verdict == "certified"
    return live


def hand(response, state):
    """Return the pose of the hand at a state of a response's path."""
    return response.problem.robot.pose(response.path.states[state])


def lifted(T, height):
    """Return a pose moved up by a height [m]."""
    return pose((0.0, 0.0, height)) @ T


def test_the_certified_path_follows_the_goal(fresh):
    goal, seconds = hand(fresh.response, -1), []
    for k in range(1, 6):
        T = lifted(goal, 0.01 * k)
        response = fresh.wait(fresh.move_goal(T))
        assert response.verdict == "certified" and response.message == ""
        assert certify(response.problem, response.path).valid
        assert hand(response, -1) == pytest.approx(T, abs=1e-5)
        assert np.array_equal(response.path.states[0], fresh.problem.start)
        seconds.append(response.seconds)
    assert min(seconds) < 0.5  # [s]; the others may have waited for a busy machine


def test_the_newest_request_wins(fresh):
    goal, seen = hand(fresh.response, -1), []
    fresh.on_response = lambda response: seen.append(response.request.number)
    numbers = [fresh.move_goal(lifted(goal, 0.0005 * k)) for k in range(1, 101)]
    response = fresh.wait(numbers[-1])
    assert numbers == list(range(numbers[0], numbers[0] + 100))
    assert response.request.number == numbers[-1] == fresh.request.number
    assert hand(response, -1) == pytest.approx(lifted(goal, 0.05), abs=1e-5)
    fresh.on_response = lambda response: None
    assert seen == sorted(set(seen)) and len(seen) < 50  # requests with a newer one are skipped


def test_the_start_moves_and_the_path_begins_there(fresh):
    T = lifted(fresh.problem.robot.pose(fresh.problem.start), 0.02)
    response = fresh.wait(fresh.move_start(T))
    assert response.verdict == "certified" and hand(response, 0) == pytest.approx(T, abs=1e-5)
    assert certify(response.problem, response.path).valid


def test_an_obstacle_in_the_start_is_named_and_the_path_stays(fresh):
    before, (item, *_) = fresh.response, fresh.problem.scene.obstacles
    at = fresh.problem.robot.pose(fresh.problem.start)
    response = fresh.wait(fresh.move_obstacle(item.name, at))
    assert response.verdict == "no path" and response.path is before.path
    assert "start is in collision: " in response.message and item.name in response.message
    text = html.unescape(text_of(response))
    assert "earlier request" in text and response.message in text
    assert f"<b>no path</b>: {html.escape(response.message)}" in state_of(response)
    response = fresh.wait(fresh.move_obstacle(item.name, item.T_world_object))
    assert response.verdict == "certified" and "earlier request" not in text_of(response)
    certificate = replace(response.solution.certificate, constraint_states=7)
    checked = replace(response, solution=replace(response.solution, certificate=certificate))
    assert "constraint checked at 7 states, not proven between" in state_of(checked)


@pytest.mark.parametrize("end", ["goal", "start"])
def test_an_end_that_cannot_be_reached_says_why_and_the_path_stays(fresh, end):
    before = fresh.response.path
    response = fresh.wait(getattr(fresh, f"move_{end}")(FAR))
    assert response.path is before
    assert f"the {end} cannot be there: they lie " in response.message


def test_a_goal_in_an_obstacle_says_what_collides(fresh):
    goal, before = hand(fresh.response, -1), fresh.response.path
    item = fresh.problem.scene.obstacles[0]
    fresh.move_obstacle(item.name, goal)
    response = fresh.wait(fresh.move_goal(goal))
    assert response.path is before
    assert "configurations that reach them collide" in response.message
    assert item.name in response.message


def test_wrong_poses_and_names_are_refused_and_submit_no_request(fresh):
    number = fresh.request.number
    refused(
        "goal is not a rigid pose: its rotation", fresh.move_goal, np.diag([2.0, 1.0, 1.0, 1.0])
    )
    refused("start", fresh.move_start, np.eye(3))
    refused("object of scene .* 'nope'", fresh.move_obstacle, "nope", np.eye(4))
    refused("unknown planner 'nope'", fresh.set_planner, "nope")
    refused("constraint 'nope'; valid choices: own, upright, none", fresh.set_constraint, "nope")
    refused("problem is a str", Studio, "nope")
    assert fresh.request.number == number


def test_a_request_of_an_unknown_planner_does_not_end_the_planning(fresh):
    number = fresh.submit(planner="nope")
    response = fresh.wait(number, timeout=20.0)
    assert response.request.number >= number and response.verdict == "no path"
    assert "unknown planner 'nope'; valid choices:" in response.message
    assert fresh.wait(fresh.set_planner("roadmap")).verdict == "certified"


def test_constraint_and_planner_are_chosen(fresh):
    assert "birrt" in fresh.planners and "atlas-rrt" in fresh.planners
    response = fresh.wait(fresh.set_constraint("none"))
    assert response.verdict == "certified" and response.problem.constraint == ()
    fresh.set_constraint("own")
    response = fresh.wait(fresh.set_planner("opt-cvq-mpt"))
    assert response.verdict == "certified" and response.planner == "opt-cvq-mpt"
    layers = [layer for layer, points, _ in response.drawn if points.shape[1] == 3]
    assert layers[-3:] == ["cloud", "Gaussians", "Gaussians"]  # before and after Algorithm 2


def test_a_clearance_is_kept_and_a_wrong_one_is_refused(fresh):
    response = fresh.wait(fresh.submit(clearance=0.5))
    assert response.verdict == "no path" and "margin 0.5: give a number" in response.message
    response = fresh.wait(fresh.submit(clearance=0.0))
    assert response.verdict == "certified"
    fresh.submit(clearance=Margin().metres)


def test_files_hold_the_path_that_is_shown(fresh, tmp_path):
    response = fresh.wait(fresh.move_goal(lifted(hand(fresh.response, -1), 0.02)))
    for kind in ("problem", "page", "picture", "trajectory"):
        name, content = fresh.saved(kind)
        (tmp_path / name).write_bytes(content)
    again = PlanningProblem.load(tmp_path / "problem.json")
    assert certify(again, response.path).valid
    shown = (tmp_path / "plan.html").read_text()
    assert "certified path of roadmap" in shown and re.search(r'"labels": \["0\.0 of \d', shown)
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")
    motion = read_motion(tmp_path / "motion.json")
    assert motion.positions[[0, -1]] == pytest.approx(response.path.states[[0, -1]])
    fresh.submit(speed=1.0)
    (tmp_path / "fast.json").write_bytes(fresh.saved("trajectory")[1])
    assert read_motion(tmp_path / "fast.json").times[-1] < 0.5 * motion.times[-1]
    refused("unknown file 'film'; valid choices: problem", fresh.saved, "film")


@pytest.fixture(scope="module")
def page(problem):
    """Return a page of the studio at a free port."""
    pytest.importorskip("viser")
    made = studio(problem, 0)
    made.live.wait()
    yield made
    made.stop()


def tab(page, path=None, origin=None, **headers):
    """Connect to the page as a tab of a browser does; path, Origin and Host may be another's."""
    import viser
    from websockets.sync.client import connect

    version = f"viser-v{viser.__version__}"
    begin, _, own = page.address.rpartition("/")
    address = f"{begin.replace('http', 'ws')}/{own if path is None else path}"
    settings = {"subprotocols": [version], "max_size": None, "compression": None}
    return connect(address, origin=origin or begin, additional_headers=headers, **settings)


def received(connection, seconds=1.0):
    """All bytes that a tab receives within a number of seconds."""
    found, end = b"", time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            found += connection.recv(timeout=max(end - time.monotonic(), 0.0))
        except TimeoutError:
            break
    return found


def test_two_tabs_drag_one_goal_and_may_go(page):
    import msgspec

    first, second = tab(page), tab(page)
    # meshes, packed, from a machine that may be busy
    assert len(received(first, 4.0)) > 1e5 and len(received(second)) > 1e5
    gizmo, number = page._gizmos["goal"], page.live.request.number
    moved = {"type": "TransformControlsUpdateMessage", "name": gizmo.name, "owner": ""}
    x, y, z = gizmo.position.tolist()
    for k in range(1, 11):
        pose_now = {"wxyz": gizmo.wxyz.tolist(), "position": (x, y, z + 0.002 * k)}
        first.send(msgspec.msgpack.encode({**moved, **pose_now}))
    deadline = time.monotonic() + 30.0
    while page.live.request.number < number + 10 and time.monotonic() < deadline:
        time.sleep(0.01)
    response = page.live.wait()
    assert response.verdict == "certified"
    assert hand(response, -1)[:3, 3] == pytest.approx([x, y, z + 0.02], abs=1e-5)
    assert len(received(second)) > 1e3  # the second tab receives the path of the first
    first.close()
    second.close()
    assert page.live.wait(page.live.submit()).verdict == "certified"


def test_a_foreign_page_or_user_gets_nothing(page):
    from http.client import HTTPConnection

    from websockets.exceptions import InvalidStatus

    port = page.server.get_port()
    foreign = (
        {"origin": "https://evil.example"},
        {"origin": f"http://127.0.0.1:{port + 1}"},  # another server of this computer
        {"origin": "null"},  # a frame without rights
        {"path": ""},
        {"path": "x" * 32},
    )
    for settings in foreign:
        with pytest.raises(InvalidStatus, match="403"):
            tab(page, **settings)
    token = page.address.rpartition("/")[2]
    requests = (("", "127.0.0.1"), ("index.html", "127.0.0.1"), (token, "evil.example"))
    for path, host in requests:
        connection = HTTPConnection("127.0.0.1", port)
        connection.request("GET", f"/{path}", headers={"Host": f"{host}:{port}"})
        answer = connection.getresponse()
        assert answer.status == 403 and answer.read() == b""
    connection = HTTPConnection("127.0.0.1", port)
    connection.request("GET", f"/{token}")
    assert connection.getresponse().status == 200


def test_no_value_of_a_tab_is_taken_unchecked(page, monkeypatch):
    import msgspec
    from websockets.exceptions import ConnectionClosed

    monkeypatch.setattr(page.server, "request_share_url", lambda *_: pytest.fail("a public tunnel"))
    elements = page.server.gui._gui_input_handle_from_uuid.values()
    planner = next(one for one in elements if getattr(one, "options", ()) == page.live.planners)
    before = page.live.request, page._slider.value, planner.value
    client = tab(page)
    gizmo = {"name": page._gizmos["goal"].name, "owner": "", "position": [0.4, 0.0, math.nan]}
    slider, chosen = page._slider._impl.uuid, planner._impl.uuid
    for message in (
        {"type": "GuiUpdateMessage", "uuid": chosen, "updates": {"value": "evil.py:planner"}},
        {"type": "GuiUpdateMessage", "uuid": chosen, "updates": {"value": ["birrt"]}},
        {"type": "GuiUpdateMessage", "uuid": chosen, "updates": {"options": ["x" * 60_000]}},
        {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": math.nan}},
        {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 2.0}},
        {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 0.5, "removed": True}},
        {"type": "GuiFormDirtyMessage", "uuid": "x" * 60_000},
        {"type": "ShareUrlRequest"},
        {"type": "TransformControlsUpdateMessage", "wxyz": [1, 0, 0, 0], **gizmo},
        {"type": "TransformControlsUpdateMessage", "wxyz": [0] * 4, **gizmo, "position": [0] * 3},
        {"type": "no such message"},
        ["no message"],
    ):
        client.send(msgspec.msgpack.encode(message))
    client.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
    received(client)
    assert (page.live.request, page._slider.value, planner.value) == before
    late = tab(page)
    assert b"x" * 60_000 not in received(late)
    value = {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 0.5}}
    client.send(msgspec.msgpack.encode(value))
    deadline = time.monotonic() + 30.0
    while page._slider.value != 0.5 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert page._slider.value == 0.5
    with pytest.raises(ConnectionClosed, match="too big"):
        client.send(b"x" * 40_000_000)
        while True:
            client.recv(timeout=30.0)


def test_names_of_a_file_are_text_on_the_page(fresh):
    name = "<iframe srcdoc='<script>alert(1)</script>'></iframe> ![x](http://evil.example/_x_.png)"
    shown = text_of(replace(fresh.response, message=f"the path touches {name}"))
    assert not set("<>![]'") & set(shown) and "evil.example" in shown
    assert html.unescape(shown).splitlines()[0] == f"the path touches {name}"
    shown = state_of(replace(fresh.response, message=f"the path touches {name}"))
    assert "<iframe" not in shown and html.escape(name) in shown


def shown(page):
    """Wait until the page has drawn a response, which it does before the next one is planned."""
    page.live.wait(page.live.submit())
    page.live.wait(page.live.submit())


def test_the_page_shows_layers_and_plays_along_the_path(page):
    page.live.set_planner("birrt")
    page.live.submit(layers=frozenset(page._layers))
    shown(page)
    assert {node.name.split("/")[1] for node in page._points} == {"search"}
    layers = {name.split("/")[1] for name in page._nodes}
    assert {"scene", "robot", "start", "goals", "path", "constraint"} <= layers
    assert all(f"</span> {name} " in page._legend.content for name in ("start", "path", "search"))
    solution = page.live.response.solution
    page.live.submit(layers=page.live.request.layers - {"start"})
    shown(page)
    assert page.live.response.solution is solution, "a layer is switched without planning"
    assert not any(name.startswith("/start/") for name in page._nodes)
    page._slider.value = 1.0
    node, poses = page._moving[-1]
    assert node.position == pytest.approx(poses[-1][:3, 3])


def test_a_click_chooses_what_handles_move_and_undo_reverts_it(page):
    import msgspec

    name, (item, *others) = next((k, v) for k, v in page.live.groups.items() if "drawer" in k)
    node = f"/scene/{name}/{item.name.replace('/', '|')}"
    click = {"type": "SceneNodeClickMessage", "name": node, "instance_index": None, "owner": ""}
    click |= {"ray_origin": [0.0] * 3, "ray_direction": [1.0, 0.0, 0.0], "modifier": None}
    shown(page)
    permits = page._guard.permits
    assert permits(msgspec.msgpack.encode({**click, "screen_pos": [0.5, 0.5]}))
    assert not permits(msgspec.msgpack.encode({**click, "screen_pos": [0.5, math.nan]}))
    asyncio.run(page._pick(name, None))
    shown(page)
    assert page._gizmos["obstacle"].visible and not page._gizmos["goal"].visible
    body, drawn = page._nodes[node]
    assert drawn.color == pytest.approx([255 * part for part in body.colour], abs=1.0)
    assert tuple(page._edges[node].colors) == CHOSEN and page._edges[node].thickness == 3.0
    rest = [edges for name, edges in page._edges.items() if f"/{name}/" not in name]
    assert any(edges.thickness == 1.0 for edges in rest)
    x, y, z = item.T_world_object[:3, 3]
    assert f"{name}</b>: x {x:.3f}, y {y:.3f}, z {z:.3f} m" in page._readout.content
    corners = shape_mesh(item.shape).corners.reshape(-1, 3)
    assert page._gizmos["obstacle"].scale > np.abs(corners).max(), "handles are outside the body"
    page.live.remember()
    page.live.move_obstacle(name, lifted(item.T_world_object, 0.3))
    moved = page.live.request.moved
    for it in (item, *others):
        assert moved[it.name] == pytest.approx(lifted(it.T_world_object, 0.3))
    page.live.wait(page.live.undo())
    assert page.live.request.moved == {}


def test_ghosts_that_coincide_with_the_robot_are_hidden_and_others_lie_inside(page):
    page.live.wait(page.live.reset())
    shown(page)
    ghosts = [node for name, (_, node) in page._nodes.items() if name.startswith("/start/")]
    page._slider.value = 0.0
    page._pose_robot()
    assert ghosts and not any(node.visible for node in ghosts)
    page._slider.value = 1.0
    page._pose_robot()
    goals = [node for name, (_, node) in page._nodes.items() if name.startswith("/goals/")]
    assert goals and not any(node.visible for node in goals)
    assert any(node.visible for node in ghosts)


def test_a_certified_path_gets_seconds_and_plots_and_the_slider_follows_them(page):
    page.live.wait(page.live.reset())
    shown(page)
    timed = until(lambda: page._timed)
    until(lambda: len(page._plots.made) == len(timed.plots))
    assert {"clearance [mm]", "joints [rad] or [m]"} < {plot.title for plot in timed.plots}
    page._slider.value = 1.0
    page._pose_robot()
    end = timed.times[-1]
    assert end > 1.0 and f"{end:.1f} of {end:.1f} s" in page._where.content
    assert page._moving[0][1].shape[0] == len(timed.times)


def test_the_outline_of_a_box_has_its_edges():
    edges = outline(shape_mesh(Box((1.0, 2.0, 3.0))))
    assert edges.shape == (12, 2, 3)
    lengths = np.sort(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1))
    assert lengths == pytest.approx([1.0] * 4 + [2.0] * 4 + [3.0] * 4)


def test_undo_and_reset_cover_every_control(page):
    live, controls, box = page.live, page._controls, page._layers["search"]
    live.reset()
    first = vars(live.request)
    changes = {"planner": "birrt", "constraint": "none", "clearance": 5.0, "speed": 0.5}
    for name, value in changes.items():
        event = SimpleNamespace(client="a tab", target=SimpleNamespace(value=value))
        asyncio.run(page._change(name, event))
    box.value = True
    asyncio.run(page._change("layers", SimpleNamespace(client="a tab", target=box)))
    assert live.request.clearance == 0.005 and live.request.speed == 0.5
    assert "search" in live.request.layers and live.request.planner == "birrt"
    page._go_back(live.undo)
    assert not box.value and live.request.speed == 0.5
    for _ in changes:
        page._go_back(live.undo)
    assert vars(live.request) == {**first, "number": live.request.number}
    live.submit(planner="birrt", speed=1.0, clearance=0.01, moved={"a": np.eye(4)})
    page._go_back(live.reset)
    assert vars(live.request) == {**first, "number": live.request.number}
    assert [controls[name].value for name in ("planner", "clearance")] == ["roadmap", 2.0]


def test_joints_of_the_start_are_moved_onto_the_constraint_or_say_why_not(fresh):
    response = fresh.wait(fresh.move_joint(1, fresh.problem.start[1] - 0.2))
    assert response.verdict == "certified" and certify(response.problem, response.path).valid
    assert response.problem.start[1] < fresh.problem.start[1] - 0.1
    refused("panda_joint2", fresh.move_joint, 1, math.nan)
    response = fresh.wait(fresh.move_joint(1, fresh.problem.robot.upper[1]))
    assert response.verdict == "no path" and "start" in response.message


def pixel(client, tab, point):
    """Return the pixel of a tab at which its client sees a point (3,)."""
    at, ahead = client.camera.position, client.camera.look_at - client.camera.position
    # the largest one; those of plots are smaller
    canvas = "[...document.querySelectorAll('canvas')].reduce((a, b) => "
    canvas += "a.clientHeight > b.clientHeight ? a : b)"
    width, height = (tab.value(f"{canvas}.{name}") for name in ("clientWidth", "clientHeight"))
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    axes = np.stack([right, np.cross(ahead, right), ahead])
    x, y, depth = axes / np.linalg.norm(axes, axis=1)[:, None] @ (point - at)
    scale = 0.5 * height / math.tan(0.5 * client.camera.fov) / depth
    return 0.5 * width + scale * x, 0.5 * height + scale * y


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_a_mouse_moves_a_drawer_and_a_joint_undoes_both_and_saves(page, tmp_path):
    live, name = page.live, "indigo_drawer_top"
    live.wait(live.reset())
    with Tab(page.address, tmp_path, drawn=False) as tab:
        until(lambda: "certified" in tab.text())
        (client,) = page.server.get_clients().values()
        until(lambda: np.allclose(client.camera.position, page.server.initial_camera.position))
        assert f"cvqmpt: {live.problem.name}" in tab.text()
        T = live.groups[name][0].T_world_object
        tab.click(pixel(client, tab, T[:3, 3]), lambda: page._chosen.value == name)

        def dragged():  # by the arrow along z, once the page shows it
            up = page._gizmos["obstacle"].scale * np.array([0.0, 0.0, 1.0])
            tab.drag(*(pixel(client, tab, T[:3, 3] + share * up) for share in (0.9, 1.2)))
            return live.request.moved

        moved = until(dragged)
        assert moved.keys() == {item.name for item in live.groups[name]}
        shift = moved[f"{name}/front_panel"][:3, 3] - T[:3, 3]
        assert shift[2] > 0.05 and shift[:2] == pytest.approx([0.0, 0.0])
        tab.click("undo", lambda: not live.request.moved)
        live.wait()
        until(lambda: "certified" in tab.text() and page._timed)  # then nothing moves on the panel
        joint, before = live.problem.robot.joint_names[-1], live.problem.start[-1]
        tab.click("joints of the start [rad or m]", lambda: tab.middle(joint, "[role=slider]"))
        x, y = tab.place(joint, "[role=slider]")
        tab.drag((x, y), (x + 20, y))
        until(lambda: live.request.posture is not None and live.request.posture[-1] > before + 0.1)
        until(lambda: live.wait().verdict in tab.text())
        tab.click("undo", lambda: live.request.start is None)
        until(lambda: "certified" in tab.text())
        solution = live.wait().solution
        tab.click("layers", lambda: tab.middle("goals", "[type=checkbox]"))
        tab.click("goals", lambda: not page._layers["goals"].value, "[type=checkbox]")
        assert live.wait().solution is solution, "a layer is switched without planning"
        tab.click("undo", lambda: page._layers["goals"].value)
        tab.click("save", lambda: tab.middle("save problem"))
        tab.click("save problem", lambda: "problem.json is in the folder" in tab.text())
        # a drag before the page showed the arrow has turned the view: reset goes to the first one
        first = page.server.initial_camera.position
        target = page.server.initial_camera.look_at
        tab.click("top", lambda: client.camera.position[2] > target[2] + 2.0)
        assert client.camera.position[:2] == pytest.approx(target[:2], abs=0.2)
        button = tab.value(  # "reset" of the views, not of the problem
            "(() => { const e = [...document.querySelectorAll('button')]"
            ".filter((e) => e.textContent.trim() === 'reset').pop();"
            "e.scrollIntoView({block: 'nearest'});"
            "const r = e.getBoundingClientRect();"
            "return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        away = np.linalg.norm(client.camera.position - first)
        tab.click(button, lambda: np.linalg.norm(client.camera.position - first) < 0.1 * away)
        assert not tab.said


def test_an_address_is_shown_and_a_port_in_use_is_refused(page, problem):
    assert page.address in repr(page) and page.address in page._repr_html_()
    assert page.address.startswith("http://127.0.0.1:")
    port = page.server.get_port()
    refused(f"port {port} is in use or no port; give another one, or 0", studio, problem, port)


def test_the_command_serves_until_it_is_interrupted(tmp_path, problem):
    pytest.importorskip("viser")
    (tmp_path / "mine.json").write_text(json.dumps(problem.to_dict()))
    # if it hangs, the signal ABRT prints what each of its threads does
    process = start(["studio", tmp_path / "mine.json", "--port", "0"], PYTHONFAULTHANDLER="1")
    for line in process.stdout:
        if "Ctrl-C" in line:
            break
    process.send_signal(signal.SIGINT)
    try:
        _, err = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)
        _, err = process.communicate()
    assert "studio of '0' at http://127.0.0.1:" in line and process.returncode == 0, err
