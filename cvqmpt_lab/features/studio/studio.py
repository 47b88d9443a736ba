"""Page in the browser on which start, goal and obstacles are moved, and the path follows.

viser serves the page. All tabs of the page show the same state.
"""

import html
import re
import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    require_installed,
)
from cvqmpt_lab.base.poses import Placement
from cvqmpt_lab.features.pictures.bodies import (
    BODY_COLOURS,
    Body,
    drawing_of_problem,
    mesh_in_view,
    mesh_of,
    robot_bodies,
    scene_bodies,
)
from cvqmpt_lab.features.pictures.meshes import Colour, shape_mesh
from cvqmpt_lab.features.pictures.raster import clear_viewpoint
from cvqmpt_lab.features.studio.studio_guard import Guard, is_choice, is_number, is_switch
from cvqmpt_lab.features.studio.studio_look import (
    GHOST_LAYERS,
    VIEWS,
    Timed,
    outline,
    thinner,
    timed,
)
from cvqmpt_lab.features.studio.studio_planning import Response, Studio
from cvqmpt_lab.features.studio.studio_plots import PlotPanel
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import SLOW_SPEED

MOST_EDGES = 20_000  # of an outline that is drawn
EDGE_COLOUR = (60, 60, 66)  # of outlines of what is not chosen


def studio(problem: PlanningProblem, port: int = 8090, name: str = "") -> "StudioPage":
    """Serve a page at a local address until its `stop()` is called.

    Args:
        problem: the problem to start from.
        port: port of the address; 0: any free port.
        name: title of the page, e.g. suite and number; "": the name of the problem.
    """
    require_installed("viser", "studio", "studio")
    import viser

    try:  # viser would silently take the next free port
        socket.create_server(("127.0.0.1", port)).close()
    except (OSError, OverflowError, TypeError) as error:
        raise InvalidInputError(
            f"port {port} is in use or no port; give another one, or 0 for any"
        ) from error
    guard = Guard()
    with guard.installed():
        server = viser.ViserServer(
            "127.0.0.1", port, f"cvqmpt: {name or problem.name}", verbose=False
        )
    if not guard.started:
        server.stop()
        raise InvalidInputError(
            f"viser {viser.__version__} starts its server in an unknown way, so its page cannot be "
            "guarded: install the version in constraints.txt"
        )
    return StudioPage(Studio(problem), server, guard)


class StudioPage:
    """Page of a `Studio`, which is its attribute `live`; see `studio`."""

    def __init__(self, live: Studio, server: Any, guard: Guard) -> None:
        self.live, self.server = live, server
        # who knows the address may read and change everything
        self.address = f"http://127.0.0.1:{server.get_port()}/{guard.token}"
        self._guard, self._drawing = guard, threading.RLock()  # one thread draws at a time
        self._nodes: dict[str, tuple[Body, Any]] = {}  # bodies and nodes of the scene by name
        self._edges: dict[str, Any] = {}  # nodes of outlines, by the name of the body's node
        self._timed: Timed | None = None  # the timed path, some time after the response
        self._timer: threading.Timer | None = None
        self._moving: list[tuple[Any, np.ndarray]] = []  # nodes, and their poses along the path
        self._points: list[Any] = []  # nodes of `sampled_hands`
        self._dragged: set[str] = set()  # names of the gizmos that the user is dragging
        self._layers: dict[str, Any] = {}  # checkboxes by name of a layer
        self._gizmos: dict[str, Any] = {}  # by "start", "goal" and "obstacle"
        self._joints: list[Any] = []  # sliders of the start
        self._changed = "", 0.0  # what was changed last, and when [s]
        gui, problem = server.gui, live.problem
        # no share button and no answer to its request, which would open a public address
        server.request_share_url = lambda verbose=True: None
        self._set_theme(dark=False)
        gui.main_panel.dock_right()  # beside the view, not over it
        self._state = gui.add_html(_badge("planning ..."))

        def choice(label: str, names: tuple[str, ...]) -> Any:
            element = gui.add_dropdown(label, names)
            guard.values[element._impl.uuid] = partial(is_choice, choices=names)
            return element

        def switch(element: Any) -> Any:
            guard.values[element._impl.uuid] = is_switch
            return element

        gui.add_markdown("Click the goal, the start or an obstacle, and drag its handles.")
        self._chosen = choice("move", ("goal", "start", *live.groups))
        self._chosen.on_update(lambda event: self._mark_chosen())
        switch(gui.add_button("undo")).on_click(lambda event: self._go_back(live.undo))
        switch(gui.add_button("reset")).on_click(lambda event: self._go_back(live.reset))

        def slider(label: str, least: float, most: float, step: float, value: float) -> Any:
            element = gui.add_slider(label, least, most, step, value)
            guard.values[element._impl.uuid] = partial(is_number, least=least, most=most)
            return element

        self._readout = gui.add_html("")
        views = gui.add_button_group("view", ("reset", *VIEWS))
        guard.values[views._impl.uuid] = partial(is_choice, choices=("reset", *VIEWS))
        views.on_click(self._look)
        self._slider = slider("along the path", 0.0, 1.0, 0.01, 0.0)
        self._slider.on_update(lambda event: self._pose_robot())
        speed = slider("speed", 0.05, 1.0, 0.05, SLOW_SPEED)
        switch(gui.add_button("play")).on_click(self._play)
        # elements by the field of a request that they change
        self._controls = {
            "speed": speed,
            "planner": choice("planner", live.planners),
            "constraint": choice("constraint", tuple(live.constraints)),
            "clearance": slider("clearance [mm]", 0.0, 100.0, 1.0, 1e3 * live.request.clearance),
        }
        for name, element in self._controls.items():
            element.on_update(partial(self._change, name))
        self._where = gui.add_html("")
        self._plots = PlotPanel(gui, gui.add_folder("plots"))
        with gui.add_folder("joints of the start [rad or m]", expand_by_default=False):
            # limits are rounded inwards, because the page rounds to steps
            limits = np.ceil(1e3 * problem.robot.lower), np.floor(1e3 * problem.robot.upper)
            for k, (least, most) in enumerate(1e-3 * np.transpose(limits)):
                joint = slider(problem.robot.joint_names[k], least, most, 0.001, least)
                joint.on_update(partial(self._move_joint, k))
                self._joints.append(joint)
        dark = switch(gui.add_checkbox("dark", False))
        dark.on_update(lambda event: self._set_theme(event.target.value))
        with gui.add_folder("details", expand_by_default=False):
            self._text = gui.add_markdown("planning ...")
        with gui.add_folder("layers", expand_by_default=False):
            self._legend = gui.add_html("")
            for name in ("start", "goals", "path", "constraint", "search", "cloud", "Gaussians"):
                box = switch(gui.add_checkbox(name, name in live.request.layers))
                box.on_update(partial(self._change, "layers"))
                self._layers[name] = box
        with gui.add_folder("save", expand_by_default=False):
            for kind in ("problem", "page", "picture", "trajectory"):
                switch(gui.add_button(f"save {kind}")).on_click(partial(self._save, kind))
        for name in ("start", "goal", "obstacle"):
            gizmo = server.scene.add_transform_controls(
                f"/drag {name}", 0.2 * problem.robot.reach, depth_test=False
            )
            guard.gizmos.add(gizmo.name)
            gizmo.on_update(partial(self._drag, name))
            self._gizmos[name] = gizmo
        self._mark_chosen()
        self._draw_ground()
        self._place_camera()
        server.on_client_connect(self._fit_phone)
        live.on_response, live.on_wait = self._show, self._show_wait
        live.submit()  # the first response may have come before the page existed

    def _place_camera(self) -> None:
        """Let pages begin with a free view of the robot."""
        problem, camera = self.live.problem, self.server.initial_camera
        robot = robot_bodies(problem, problem.start[None])
        still = mesh_of(scene_bodies(problem.scene))
        torso = mesh_of(body for body in robot if body.torso)
        view = clear_viewpoint([mesh_in_view(robot)], still, (1400, 1000), torso=torso)
        # from farther away, so that goal and gizmos are in the picture too
        camera.position = 2.2 * np.subtract(view.eye, view.target) + view.target
        camera.look_at, camera.fov = view.target, view.height_angle

    def __repr__(self) -> str:
        return f"studio of {self.live.problem.name!r} at {self.address}"

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.address}" width="100%" height="600"></iframe>'

    def stop(self) -> None:
        """End planning and close the address."""
        if self._timer is not None:
            self._timer.cancel()
        self.live.stop()
        self.server.stop()

    def _fit_phone(self, client: Any, away: np.ndarray | None = None) -> None:
        """Show the scene smaller and above the panel if the screen is upright.

        away: vector from what is looked at to the eye [m]; None: that of the first view.
        """
        if client.camera.aspect < 1.0:
            start = self.server.initial_camera
            away = np.subtract(start.position, start.look_at) if away is None else away
            away = away / max(client.camera.aspect, 0.3)
            height = 2.0 * np.tan(0.5 * start.fov) * np.linalg.norm(away)  # of the view [m]
            middle = start.look_at - np.array([0.0, 0.0, 0.2 * height])
            with client.atomic():  # a new position moves the point that is looked at
                client.camera.position = middle + away
                client.camera.look_at = middle

    def _set_theme(self, dark: bool) -> None:
        """Show panel and background light or dark, without viser's logo and share button."""
        self.server.gui.configure_theme(
            dark_mode=bool(dark), show_logo=False, show_share_button=False
        )

    def _draw_ground(self) -> None:
        """Draw shadows, a grid with lines every half metre, and the axes of the world."""
        scene, problem = self.server.scene, self.live.problem
        scene.configure_default_lights(enabled=True, cast_shadow=True)
        under = drawing_of_problem(problem, None, ghosts=0).under
        scene.add_grid(
            "/grid", 5.0, 5.0, position=(0.0, 0.0, under + 0.002), cell_size=0.5, section_size=1.0,
            cell_color=(190, 190, 195), shadow_opacity=0.3, fade_distance=12.0,
        )  # fmt: skip
        reach = problem.robot.reach
        scene.add_frame("/axes", axes_length=0.15 * reach, axes_radius=0.004 * reach)

    def _look(self, event: Any) -> None:
        """Move the camera of the tab to the view whose button was pressed."""
        start, client = self.server.initial_camera, event.client
        if client is None:
            return
        away = np.subtract(start.position, start.look_at)
        if event.target.value in VIEWS:
            azimuth, elevation = VIEWS[event.target.value]
            across = np.cos(elevation)
            towards = [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)]
            away = np.linalg.norm(away) * np.array(towards)
        with client.atomic():  # a new position moves the point that is looked at
            client.camera.position = start.look_at + away
            client.camera.look_at = start.look_at
            client.camera.up_direction = (0.0, 0.0, 1.0)
        if client.camera.aspect < 1.0:
            self._fit_phone(client, away)

    def _save(self, kind: str, event: Any) -> None:
        """Send a file to the tab whose button was pressed."""
        try:
            name, content = self.live.saved(kind)
            event.client.send_file_download(name, content, save_immediately=True)
            said = f"{name} is in the folder of this browser's downloads"
            event.client.add_notification(f"{kind} saved", said, color="green")
        except CvqmptError as error:
            event.client.add_notification(f"{kind} not saved", str(error), color="red")

    def _play(self, event: Any) -> None:
        """Move the slider along the path."""
        shown = self._timed
        seconds = 0.4 / self.live.request.speed  # 4 s at 0.1 of the joint limits
        if shown is not None and shown.times is not None:
            seconds = float(shown.times[-1])
        for k in range(101):
            self._slider.value = 0.01 * k
            time.sleep(0.01 * seconds)

    async def _drag(self, name: str, event: Any) -> None:
        """Submit the pose of a gizmo; viser calls coroutines in order, functions perhaps not."""
        if event.phase == "end":
            self._dragged.discard(name)
        else:
            if name not in self._dragged:
                self.live.remember()
            self._dragged.add(name)
        w, x, y, z = event.target.wxyz.tolist()
        a, b, c = event.target.position.tolist()
        T = Placement(xyz=(a, b, c), quaternion=(x, y, z, w)).matrix
        self._read_out(T)
        if name == "start":
            self.live.move_start(T)
        elif name == "goal":
            self.live.move_goal(T)
        else:
            self.live.move_obstacle(self._chosen.value, T)

    async def _move_joint(self, index: int, event: Any) -> None:
        """Submit a joint of the start that the user moved, not the page itself."""
        if event.client is not None:
            self._remember(self.live.problem.robot.joint_names[index])
            self.live.move_joint(index, event.target.value)

    async def _change(self, name: str, event: Any) -> None:
        """Submit a field of the request if the user changed it, not the page itself."""
        if event.client is None:
            return
        value = event.target.value
        if name == "layers":
            value = frozenset(layer for layer, box in self._layers.items() if box.value)
        elif name == "clearance":
            value = 1e-3 * value
        self._remember(name)
        self.live.submit(**{name: value})

    def _remember(self, name: str) -> None:
        """Keep the request for `undo`, once for a movement of the mouse at what has this name."""
        now = time.monotonic()
        if self._changed[0] != name or now - self._changed[1] > 1.0:
            self.live.remember()
        self._changed = name, now

    def _go_back(self, back: Callable[[], int]) -> None:
        """Undo or reset, and show the request's values on the panel."""
        back()
        request = self.live.request
        for name, element in self._controls.items():
            value = getattr(request, name)
            element.value = 1e3 * value if name == "clearance" else value
        for name, box in self._layers.items():
            box.value = name in request.layers
        self._changed = "", 0.0

    async def _pick(self, name: str, event: Any) -> None:
        """Choose what was clicked."""
        self._chosen.value = name

    def _mark_chosen(self) -> None:
        """Highlight what is chosen and show its handles, larger than the body that they move."""
        chosen = self._chosen.value
        for name, gizmo in self._gizmos.items():
            gizmo.visible = name == (chosen if chosen in ("start", "goal") else "obstacle")
        for name, edges in self._edges.items():
            body = self._nodes[name][0]
            marked = _mover_of(body) == chosen
            colour = _rgb(BODY_COLOURS["chosen"]) if marked else EDGE_COLOUR
            edges.colors = np.array(colour, np.uint8)
            edges.thickness = 3.0 if marked else 1.0
            edges.visible = marked or body.layer == "scene"
        if chosen in ("start", "goal"):
            self._read_out(_pose_of(self._gizmos[chosen]))
        items, gizmo = self.live.groups.get(chosen), self._gizmos["obstacle"]
        if items is None or "obstacle" in self._dragged:
            return
        T = items[0].T_world_object
        corners = np.concatenate(
            [shape_mesh(it.shape).placed(it.T_world_object).corners.reshape(-1, 3) for it in items]
        )
        size = np.linalg.norm(corners - T[:3, 3], axis=1).max()
        gizmo.scale = float(max(0.2 * self.live.problem.robot.reach, 1.2 * size))
        T = self.live.request.moved.get(items[0].name, T)
        _place(gizmo, T)
        self._read_out(T)

    def _read_out(self, T: np.ndarray) -> None:
        """Show where the chosen body is, for its pose (4, 4) [m]."""
        x, y, z = T[:3, 3]
        name = html.escape(self._chosen.value)
        self._readout.content = (
            '<div style="margin:0 1em 0.5em;font-variant-numeric:tabular-nums">'
            f"<b>{name}</b>: x {x:.3f}, y {y:.3f}, z {z:.3f} m</div>"
        )

    def _show(self, response: Response) -> None:
        """Draw a response; called in the planning thread."""
        with self._drawing:
            self._timed = None
            self._draw(response)
        if self._timer is not None:
            self._timer.cancel()
        # timing takes half a second: not while a body is dragged
        self._timer = threading.Timer(0.3, self._show_timed, (response,))
        self._timer.daemon = True
        self._timer.start()

    def _show_timed(self, response: Response) -> None:
        """Time the path of a response and show its plots, unless a newer one came meanwhile."""
        shown = timed(response)
        with self._drawing:
            if self.live.response is not response:
                return
            with self.server.atomic():
                self._plots.show(shown)
                if shown is not None:
                    self._timed = shown
                    named = {_node_of(body): body for body in shown.drawing.bodies("hand")}
                    self._moving = [
                        (self._nodes[name][1], body.poses)
                        for name, body in named.items()
                        if len(body.poses) > 1 and name in self._nodes
                    ]
                self._pose_robot()

    def _show_wait(self) -> None:
        """Say that a response takes its time; called in a thread of its own."""
        with self._drawing:
            if self.live.request is not self.live.response.request:
                self._state.content = _badge("planning ...")

    def _draw(self, response: Response) -> None:
        """Draw a response."""
        problem, request = response.problem, response.request
        scene = self.server.scene
        if response.message and request.posture is not None:
            # where the sliders are, although no path begins there
            problem = problem.changed(start=request.posture)
        drawing = drawing_of_problem(problem, response.path, ghosts=0)
        shown = request.layers
        named = {_node_of(body): body for body in drawing.bodies(*shown)}
        states = np.array([problem.start, *problem.goals])
        if response.path is not None:
            states = response.path.states
        points = response.drawn if shown & {"search", "cloud", "Gaussians"} else ()
        drawn = [(layer, at, colour) for layer, at, colour in points if layer in shown]
        with self.server.atomic():
            self._state.content = state_of(response)
            self._text.content = text_of(response)
            colours = {body.layer.split("/")[0]: body.colour for body in drawing.over}
            colours |= {layer: colour for layer, _, colour in drawn}
            self._legend.content = "".join(
                f'<span style="color:rgb{_rgb(colours[name])}">&#9632;</span> {name} &ensp;'
                for name in self._layers
                if name in colours
            )
            for name in self._nodes.keys() - named.keys():
                self._edges.pop(name, None)  # removed together with the body
                self._nodes.pop(name)[1].remove()
            for name, body in named.items():
                last, node = self._nodes.get(name, (None, None))
                # nodes of the scene are kept, although the meshes of clouds are new every time
                if last is None or (last.mesh is not body.mesh and body.layer != "scene"):
                    corners, faces = thinner(body)
                    opacity = body.opacity if body.opacity < 1.0 else None
                    node = scene.add_mesh_simple(
                        name,
                        corners,
                        faces,
                        color=body.colour,
                        opacity=opacity,
                        cast_shadow=opacity is None,
                    )
                    self._draw_edges(name, body)
                    _place(node, body.poses[0])
                    if (mover := _mover_of(body)) in self._chosen.options:
                        self._guard.clicked.add(name)
                        node.on_click(partial(self._pick, mover))
                self._nodes[name] = (body, node)
                T = request.moved.get(body.name) if body.layer == "scene" else body.poses[0]
                if T is not None:  # None: an object of the scene that was not moved
                    _place(node, T)
            moving = ((self._nodes[name][1], body.poses) for name, body in named.items())
            self._moving = [(node, poses) for node, poses in moving if len(poses) > 1]
            for node in self._points:
                node.remove()
            self._points = [
                scene.add_point_cloud(f"/{layer}/{k}", at, colour, point_size=0.008)
                for k, (layer, at, colour) in enumerate(drawn)
            ]
            first, last = problem.robot.poses(np.array([problem.start, states[-1]]))
            if "start" not in self._dragged:
                asked = request.start if request.posture is None else None
                _place(self._gizmos["start"], first if asked is None else asked)
            if self.live.request.posture is None:  # else a joint was moved after this request
                for joint, value in zip(self._joints, problem.start.tolist(), strict=True):
                    joint.value = min(max(round(value, 3), joint.min), joint.max)
            if "goal" not in self._dragged:
                _place(self._gizmos["goal"], last if request.goal is None else request.goal)
            self._mark_chosen()
            self._pose_robot()

    def _draw_edges(self, name: str, body: Body) -> None:
        """Draw the outline of a body that can be chosen, as a child of its node."""
        if _mover_of(body) in self._chosen.options and body.layer != "robot":
            edges = outline(body.mesh)
            if 0 < len(edges) <= MOST_EDGES:
                self._edges[name] = self.server.scene.add_line_segments(
                    f"{name}/edges", edges, EDGE_COLOUR, thickness=1.0, thickness_units="screen"
                )

    def _pose_robot(self) -> None:
        """Place all moving bodies at the state of the slider, and hide ghosts that coincide."""
        share, at = self._slider.value, {}
        for node, poses in self._moving:
            T = poses[round(share * (len(poses) - 1))]
            _place(node, T)
            at[node.name] = T
        for body, node in self._nodes.values():
            if body.layer.split("/")[0] in GHOST_LAYERS:
                robot = at.get(f"/robot/{body.name.replace('/', '|')}")
                apart = robot is None or not np.allclose(robot, body.poses[0], atol=1e-3)
                if node.visible != apart:
                    node.visible = apart
        shown, count = self._timed, len(self._moving[0][1]) if self._moving else 1
        text = f"state {round(share * (count - 1))} of {count - 1}"
        if shown is not None:
            text = shown.label(round(share * (len(shown.drawing.labels) - 1)))
        self._where.content = f'<div style="margin:0 1em 0.5em">{text}</div>'


def _pose_of(node: Any) -> np.ndarray:
    """Pose (4, 4) of a node [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(node.wxyz, scalar_first=True).as_matrix()
    T[:3, 3] = node.position
    return T


def _node_of(body: Body) -> str:
    """Name of a body's node; objects of the scene are grouped in viser's tree of the scene."""
    # no other slashes, because viser moves a node together with its parent
    group = f"{_mover_of(body)}/" if body.layer == "scene" else ""
    return f"/{body.layer}/{group}{body.name.replace('/', '|')}"


def _mover_of(body: Body) -> str:
    """Name of what moves a body: "start", "goal" or a group of obstacles; "" if nothing does."""
    layer = body.layer.split("/")[0]
    movers = {"start": "start", "robot": "start", "goals": "goal"}
    return body.name.partition("/")[0] if layer == "scene" else movers.get(layer, "")


def state_of(response: Response) -> str:
    """State of a response as html: a word and a colour, and why there is no path."""
    took = f", {1e3 * response.seconds:.0f} ms{response.gap}"
    return _badge(response.verdict, f": {response.message}" if response.message else took)


def _badge(word: str, why: str = "") -> str:
    """Coloured field with a word and a reason as html."""
    colour = {"certified": "#1a7f37", "no path": "#b42318"}.get(word, "#9a6700")
    return (
        f'<div style="background:{colour};color:#fff;padding:0.5em;'
        f'margin:0 0.6em 0.6em;border-radius:4px"><b>{word}</b>{html.escape(why)}</div>'
    )


def text_of(response: Response) -> str:
    """Details of a response, as markdown; names in it cannot become html or links."""
    lines = []
    if response.message:
        lines += [_plain(response.message), "The path is that of an earlier request:"]
    if response.solution is not None:
        report = response.solution.report(response.planner)
        shown = report.only("planner", "constraint", "length", "certificate")
        lines += [f"*{label}* {_plain(text)}" for label, text in shown.entries]
    return "\n\n".join(lines)


def _plain(text: str) -> str:
    """Text as markdown that shows it as it is: what could be markdown or html is an entity."""
    return re.sub(r"[^\w\s.,:;()/%+=°-]|_", lambda found: f"&#{ord(found[0])};", text)


def _rgb(colour: Colour) -> tuple[int, int, int]:
    """Red, green and blue from 0 to 255."""
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


def _place(node: Any, T: np.ndarray) -> None:
    """Place a node of the page's scene at a pose (4, 4) [m]."""
    node.wxyz = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    node.position = T[:3, 3]
