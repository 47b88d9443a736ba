"""Page in the browser on which start, goal and obstacles are moved, and the path follows.

The only module that imports viser, which serves the page. All tabs of the page show the same state.
"""

import html
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    UnknownChoiceError,
    require_choice,
    require_installed,
    require_kind,
)
from cvqmpt_lab.base.files import json_text
from cvqmpt_lab.base.poses import Placement, Pose
from cvqmpt_lab.certificate.motion_check import certified_motion
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, sample_region
from cvqmpt_lab.constraints.named import upper_axis
from cvqmpt_lab.constraints.no_goal import why_none
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright
from cvqmpt_lab.planning.margins import Margin, solve_with_margin
from cvqmpt_lab.planning.pipeline import PROBLEM_HINT
from cvqmpt_lab.planning.planners import PLANNERS, default_planner, planner_named
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.warm_up import warm_up
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import SLOW_SPEED
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.show.bodies import (
    Body,
    drawing_of_problem,
    mesh_in_view,
    mesh_of,
    robot_bodies,
    scene_bodies,
)
from cvqmpt_lab.show.drawn_hands import sampled_hands
from cvqmpt_lab.show.meshes import Colour, shape_mesh
from cvqmpt_lab.show.picture import png_of
from cvqmpt_lab.show.raster import clear_viewpoint
from cvqmpt_lab.show.studio_guard import Guard, is_choice, is_number, is_switch
from cvqmpt_lab.show.web_page import path_html
from cvqmpt_lab.trajectory.trajectory import as_ros_json


@dataclass(frozen=True, eq=False)
class Request:
    """A planning request; each change makes a new one."""

    number: int
    planner: str
    constraint: str = "own"  # a key of `Studio.constraints`
    start: np.ndarray | None = None  # pose of the hand (4, 4) [m]; None: the problem's start
    goal: np.ndarray | None = None  # pose of the hand (4, 4) [m]; None: the problem's goals
    moved: Mapping[str, np.ndarray] = field(default_factory=dict)  # T_world_object by name
    clearance: float = Margin().metres  # to obstacles [m]; less where start or goals have less


@dataclass(frozen=True, eq=False)
class Response:
    """Response to a planning request."""

    request: Request
    problem: PlanningProblem  # the problem that `solution` solves
    verdict: str = "not planned yet"  # or "certified", or "no path"
    seconds: float = 0.0  # from inverse kinematics to the certificate [s]
    solution: Solution | None = None  # the last certified one
    planner: str = ""  # planner that found it
    message: str = ""  # why it is the solution of an earlier request; "": it is this request's

    @property
    def path(self) -> JointPath | None:
        """The last certified path, which is this request's if `message` is empty."""
        return self.solution.path if self.solution else None

    @property
    def drawn(self) -> Iterator[tuple[str, np.ndarray, Colour]]:
        """Points of `sampled_hands` for the planner of the request."""
        trees = self.solution.plan.trees if self.solution else ()
        return sampled_hands(self.problem, self.request.planner, trees)


class Studio:
    """Plans a problem again after every change, in one thread that takes the newest request.

    Requests are numbered. A request has no response if a newer one came before it was planned.

    Args:
        problem: the problem to start from.
        seconds: budget of each request [s].
    """

    def __init__(self, problem: PlanningProblem, seconds: float = 1.0) -> None:
        require_kind("problem", problem, PlanningProblem, PROBLEM_HINT)
        self.problem, self._budget = problem, Budget(seconds=seconds)
        planner = default_planner(problem)[0]
        fitting = (name for name, one in PLANNERS.items() if not one.incompatibility(problem))
        self.planners = tuple(dict.fromkeys((planner, *fitting)))
        standing = upright(axis=upper_axis(problem.robot.pose(problem.start)))
        held = problem.closed_chain  # two hands on one object keep hold of it in any case
        self.constraints = {"own": problem.constraint, "upright": (*held, standing), "none": held}
        self.on_response: Callable[[Response], None] = lambda response: None  # in planning thread
        # objects that move together: those whose names are alike up to the first "/"
        self.groups: dict[str, list[SceneObject]] = {}
        for item in problem.scene:
            self.groups.setdefault(item.name.partition("/")[0], []).append(item)
        self._past: list[Request] = []  # what `undo` goes back to, the last one first
        self.request = Request(0, planner)  # the newest one
        self.response = Response(Request(-1, planner), problem)  # the newest one
        self._changed, self._stopped = threading.Condition(), False
        self._worker = threading.Thread(target=self._work, daemon=True, name="studio")
        self._worker.start()

    def move_goal(self, T: np.ndarray) -> int:
        """Move the hand's goal to a pose (4, 4) [m]; returns the number of the request."""
        return self.submit(goal=from_plain(Pose, T, "goal"))

    def move_start(self, T: np.ndarray) -> int:
        """Move the hand's start to a pose (4, 4) [m]; returns the number of the request."""
        return self.submit(start=from_plain(Pose, T, "start"))

    def move_obstacle(self, name: str, T: np.ndarray) -> int:
        """Move a scene object, or one of `groups` by the pose of its first object.

        T: pose (4, 4) [m].

        Returns the number of the request.
        """
        first, *others = self.groups.get(name) or [self.problem.scene[name]]
        T = from_plain(Pose, T, f"obstacle {name!r}")
        shift = T @ np.linalg.inv(first.T_world_object)
        moved = {first.name: T, **{it.name: shift @ it.T_world_object for it in others}}
        with self._changed:
            return self.submit(moved={**self.request.moved, **moved})

    def remember(self) -> None:
        """Keep the present poses of start, goal and obstacles for `undo`."""
        self._past.append(self.request)

    def undo(self) -> int:
        """Go back to the poses that were remembered last; returns the number of the request."""
        last = self._past.pop() if self._past else self.request
        return self.submit(start=last.start, goal=last.goal, moved=last.moved)

    def reset(self) -> int:
        """Go back to the problem's poses, which `undo` reverts; returns the request's number."""
        self.remember()
        return self.submit(start=None, goal=None, moved={})

    def set_planner(self, name: str) -> int:
        """Change to another one of `planners`; returns the number of the request."""
        require_choice("planner", name, self.planners)
        return self.submit(planner=name)

    def set_constraint(self, name: str) -> int:
        """Change to another one of `constraints`; returns the number of the request."""
        require_choice("constraint", name, self.constraints)
        return self.submit(constraint=name)

    def submit(self, **changes: Any) -> int:
        """Submit the newest request again with some fields changed; returns its number."""
        with self._changed:
            self.request = replace(self.request, number=self.request.number + 1, **changes)
            self._changed.notify_all()
            return self.request.number

    def wait(self, number: int | None = None, timeout: float = 60.0) -> Response:
        """Wait for the response to a request or to a newer one, and return the newest response.

        Args:
            number: number of the request; None: the newest one.
            timeout: time after which the newest response is returned in any case [s].
        """
        with self._changed:
            least = self.request.number if number is None else number
            self._changed.wait_for(lambda: self.response.request.number >= least, timeout)
            return self.response

    def stop(self) -> None:
        """End the planning thread after its current request."""
        self._stopped = True
        self.submit()
        # the thread is a daemon: it may wait forever for a browser that accepts no message
        self._worker.join(timeout=10.0)

    def _work(self) -> None:
        """Response the newest request, again and again."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self.request is not self.response.request)
                if self._stopped:
                    return
                request = self.request
            response = self._planned(request)
            with self._changed:
                self.response = response
                self._changed.notify_all()
            try:
                self.on_response(response)
            except Exception:  # an error while drawing must not end the planning
                logging.getLogger("cvqmpt").exception("a response cannot be drawn")

    def _planned(self, request: Request) -> Response:
        """Plan a request and return the response; it has the last path if none was found."""
        method = planner_named(request.planner)
        began = time.perf_counter()
        try:
            if request.planner != self.response.planner:
                warm_up(self.problem, method, "compiled")
                began = time.perf_counter()
            problem = self._problem_of(request)
            margin = Margin(request.clearance).check()
            found, _ = solve_with_margin(
                problem, method, self._budget, 0, margin, near_goals_first=True
            )
            if found.solved:
                seconds = time.perf_counter() - began
                solved = found.problem
                return Response(request, solved, "certified", seconds, found, request.planner)
            message = " ".join(repr(found).splitlines()[-1].split())  # of certificate or plan
        except Exception as error:
            message = str(error) or repr(error)
            if not isinstance(error, CvqmptError):  # a defect here or in an external planner
                logging.getLogger("cvqmpt").exception("request %d failed", request.number)
        last, seconds = self.response, time.perf_counter() - began
        return replace(last, request=request, verdict="no path", seconds=seconds, message=message)

    def _problem_of(self, request: Request) -> PlanningProblem:
        """Problem of a request; InvalidInputError if the hand cannot reach its start or goal."""
        last, scene = self.response, self.problem.scene
        if request.moved:
            objects = tuple(
                item.changed(T_world_object=request.moved.get(item.name, item.T_world_object))
                for item in scene
            )
            scene = scene.changed(objects=objects)
        constraint = self.constraints[request.constraint]
        problem = self.problem.changed(scene=scene, constraint=constraint)
        if request.start is not None:
            start = _reached(problem, "start", request.start, last.problem.start)[0]
            problem = problem.changed(start=start)
        if request.goal is not None:
            near = last.path.states[-1] if last.path else problem.start
            goals = _reached(problem, "goal", request.goal, near)
            problem = problem.changed(goals=goals, goal_region=None)
        return problem

    def saved(self, kind: str, speed: float = SLOW_SPEED) -> tuple[str, bytes]:
        """Name and content of a file.

        Args:
            kind: "problem", "page", "picture" or "trajectory" of the last certified path.
            speed: fraction of the joint limits that a trajectory uses.
        """
        response, path = self.response, self.response.path
        if path is None:
            raise InvalidInputError(f"nothing to save: {response.message or response.verdict}")
        match kind:
            case "problem":
                return "problem.json", json_text(response.problem.to_dict()).encode()
            case "page":
                verdict = f"certified path of {response.planner}"
                return "plan.html", path_html(response.problem, path.states, verdict).encode()
            case "picture":
                return "plan.png", png_of(response.solution) or b""
            case "trajectory":
                from cvqmpt_lab.trajectory.timing import TimingSettings  # half a second to import

                motion = certified_motion(response.problem, path, TimingSettings(speed))
                return "motion.json", as_ros_json(motion).encode()
        raise UnknownChoiceError("file", kind, ("problem", "page", "picture", "trajectory"))


def _reached(problem: PlanningProblem, what: str, T: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Configurations (k, n) with the hand at a pose; those near a given one come first.

    Args:
        problem: the problem with robot, scene and constraint.
        what: "start" or "goal", for the error message.
        T: pose (4, 4) of the hand [m].
        near: configuration (n,) [rad or m].
    """
    region = TaskSpaceRegion(T, np.eye(4), np.zeros((6, 2)))
    checker, rng = problem.collision_checker(SAMPLE_MARGIN_M), np.random.default_rng(0)
    some = partial(sample_region, problem.robot, region, checker, rng, within=problem.constraint)
    found = np.concatenate([some(2, 2, near=near).configurations, some(2, 12).configurations])
    if len(found) == 0:
        why = why_none(problem.robot, region, checker, problem.constraint)
        raise InvalidInputError(f"the {what} cannot be there: {why or 'the constraint is broken'}")
    return found


def studio(problem: PlanningProblem, port: int = 8090) -> "StudioPage":
    """Serve a page at a local address until its `stop()` is called; port 0: any free port."""
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
        server = viser.ViserServer("127.0.0.1", port, f"cvqmpt: {problem.name}", verbose=False)
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
        self._moving: list[tuple[Any, np.ndarray]] = []  # nodes, and their poses along the path
        self._points: list[Any] = []  # nodes of `sampled_hands`
        self._dragged: set[str] = set()  # names of the gizmos that the user is dragging
        self._layers: dict[str, Any] = {}  # checkboxes by name of a layer
        self._gizmos: dict[str, Any] = {}  # by "start", "goal" and "obstacle"
        gui, problem = server.gui, live.problem
        # no share button and no answer to its request, which would open a public address
        server.request_share_url = lambda verbose=True: None
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()  # beside the view, not over it
        self._state = gui.add_html("planning ...")

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
        switch(gui.add_button("undo")).on_click(lambda event: live.undo())
        switch(gui.add_button("reset")).on_click(lambda event: live.reset())

        def slider(label: str, least: float, most: float, step: float, value: float) -> Any:
            element = gui.add_slider(label, least, most, step, value)
            guard.values[element._impl.uuid] = partial(is_number, least=least, most=most)
            return element

        self._slider = slider("along the path", 0.0, 1.0, 0.01, 0.0)
        self._slider.on_update(lambda event: self._pose_robot())
        # of the joint limits, for play and for a saved trajectory
        self._speed = slider("speed", 0.05, 1.0, 0.05, SLOW_SPEED)
        switch(gui.add_button("play")).on_click(self._play)
        planner = choice("planner", live.planners)
        planner.on_update(lambda event: live.set_planner(event.target.value))
        constraint = choice("constraint", tuple(live.constraints))
        constraint.on_update(lambda event: live.set_constraint(event.target.value))
        clearance = slider("clearance [mm]", 0.0, 100.0, 1.0, 1e3 * live.request.clearance)
        clearance.on_update(lambda event: live.submit(clearance=1e-3 * event.target.value))
        with gui.add_folder("details", expand_by_default=False):
            self._text = gui.add_markdown("planning ...")
        with gui.add_folder("layers", expand_by_default=False):
            self._legend = gui.add_html("")
            for name in ("start", "goals", "path", "constraint", "search", "cloud", "Gaussians"):
                slow = name in ("search", "cloud", "Gaussians")
                self._layers[name] = switch(gui.add_checkbox(f"show {name}", not slow))
                self._layers[name].on_update(lambda event: self._show(live.response))
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
        robot = robot_bodies(problem, problem.start[None])
        still = mesh_of(scene_bodies(problem.scene))
        torso = mesh_of(body for body in robot if body.torso)
        view = clear_viewpoint([mesh_in_view(robot)], still, (1400, 1000), torso=torso)
        # from farther away, so that goal and gizmos are in the picture too
        server.initial_camera.position = 2.2 * np.subtract(view.eye, view.target) + view.target
        server.initial_camera.look_at, server.initial_camera.fov = view.target, view.height_angle
        server.on_client_connect(self._fit_phone)
        live.on_response = self._show
        live.submit()  # the first response may have come before the page existed

    def __repr__(self) -> str:
        return f"studio of {self.live.problem.name!r} at {self.address}"

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.address}" width="100%" height="600"></iframe>'

    def stop(self) -> None:
        """End planning and close the address."""
        self.live.stop()
        self.server.stop()

    def _fit_phone(self, client: Any) -> None:
        """Show the scene smaller and above the panel if the screen is upright."""
        if client.camera.aspect < 1.0:
            start = self.server.initial_camera
            away = np.subtract(start.position, start.look_at) / max(client.camera.aspect, 0.3)
            height = 2.0 * np.tan(0.5 * start.fov) * np.linalg.norm(away)  # of the view [m]
            middle = start.look_at - np.array([0.0, 0.0, 0.2 * height])
            with client.atomic():  # a new position moves the point that is looked at
                client.camera.position = middle + away
                client.camera.look_at = middle

    def _save(self, kind: str, event: Any) -> None:
        """Send a file to the tab whose button was pressed."""
        try:
            name, content = self.live.saved(kind, self._speed.value)
            event.client.send_file_download(name, content, save_immediately=True)
            said = f"{name} is in the folder of this browser's downloads"
            event.client.add_notification(f"{kind} saved", said, color="green")
        except CvqmptError as error:
            event.client.add_notification(f"{kind} not saved", str(error), color="red")

    def _play(self, event: Any) -> None:
        """Move the slider along the path."""
        for k in range(101):
            self._slider.value = 0.01 * k
            time.sleep(0.004 / self._speed.value)  # 4 s at 0.1 of the joint limits

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
        if name == "start":
            self.live.move_start(T)
        elif name == "goal":
            self.live.move_goal(T)
        else:
            self.live.move_obstacle(self._chosen.value, T)

    async def _pick(self, name: str, event: Any) -> None:
        """Choose what was clicked."""
        self._chosen.value = name

    def _mark_chosen(self) -> None:
        """Highlight what is chosen and show its handles, larger than the body that they move."""
        chosen = self._chosen.value
        for name, gizmo in self._gizmos.items():
            gizmo.visible = name == (chosen if chosen in ("start", "goal") else "obstacle")
        for body, node in self._nodes.values():
            marked = _mover_of(body) == chosen and body.layer != "robot"
            node.color = (255, 165, 25) if marked else _rgb(body.colour)
        items, gizmo = self.live.groups.get(chosen), self._gizmos["obstacle"]
        if items is None or "obstacle" in self._dragged:
            return
        T = items[0].T_world_object
        corners = np.concatenate(
            [shape_mesh(it.shape).placed(it.T_world_object).corners.reshape(-1, 3) for it in items]
        )
        size = np.linalg.norm(corners - T[:3, 3], axis=1).max()
        gizmo.scale = float(max(0.2 * self.live.problem.robot.reach, 1.2 * size))
        _place(gizmo, self.live.request.moved.get(items[0].name, T))

    def _show(self, response: Response) -> None:
        """Draw a response; called in the planning thread, and where a layer is switched."""
        with self._drawing:
            self._draw(response)

    def _draw(self, response: Response) -> None:
        """Draw a response."""
        problem, request = response.problem, response.request
        scene = self.server.scene
        drawing = drawing_of_problem(problem, response.path, ghosts=0)
        shown = {name for name, box in self._layers.items() if box.value}
        # without slashes in the name, because viser moves a node together with its parent
        named = {
            f"/{body.layer}/{body.name.replace('/', '|')}": body for body in drawing.bodies(*shown)
        }
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
                self._nodes.pop(name)[1].remove()
            for name, body in named.items():
                last, node = self._nodes.get(name, (None, None))
                # nodes of the scene are kept, although the meshes of clouds are new every time
                if last is None or (last.mesh is not body.mesh and body.layer != "scene"):
                    corners = body.mesh.corners.reshape(-1, 3)
                    faces = np.arange(len(corners)).reshape(-1, 3)
                    opacity = body.opacity if body.opacity < 1.0 else None
                    node = scene.add_mesh_simple(
                        name, corners, faces, color=body.colour, opacity=opacity
                    )
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
            first, last = problem.robot.poses(states[[0, -1]])
            if "start" not in self._dragged:
                _place(self._gizmos["start"], first if request.start is None else request.start)
            if "goal" not in self._dragged:
                _place(self._gizmos["goal"], last if request.goal is None else request.goal)
            self._mark_chosen()
            self._pose_robot()

    def _pose_robot(self) -> None:
        """Place all moving bodies at the state of the slider."""
        for node, poses in self._moving:
            _place(node, poses[round(self._slider.value * (len(poses) - 1))])


def _mover_of(body: Body) -> str:
    """Name of what moves a body: "start", "goal" or a group of obstacles; "" if nothing does."""
    layer = body.layer.split("/")[0]
    movers = {"start": "start", "robot": "start", "goals": "goal"}
    return body.name.partition("/")[0] if layer == "scene" else movers.get(layer, "")


def state_of(response: Response) -> str:
    """State of a response as html: a word and a colour, and why there is no path."""
    word, colour = response.verdict, {"certified": "#1a7f37", "no path": "#b42318"}
    why = f": {response.message}" if response.message else f", {1e3 * response.seconds:.0f} ms"
    return (
        f'<div style="background:{colour.get(word, "#9a6700")};color:#fff;padding:0.5em;'
        f'margin:0 0.6em 0.6em;border-radius:4px"><b>{word}</b>{html.escape(why)}</div>'
    )


def text_of(response: Response) -> str:
    """Details of a response, as markdown; names in it cannot become html or links."""
    lines = []
    if response.message:
        lines += [_plain(response.message), "The path is that of an earlier request:"]
    if response.solution is not None:
        for line in response.solution.report(response.planner):
            head = line[:12].strip()
            if head in ("planner", "constraint", "length", "certificate"):
                lines.append(f"*{head}* {_plain(line[12:])}")
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
