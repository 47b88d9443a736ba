"""A page in the browser on which start, goal and obstacles are dragged and the path follows.

The only module that imports viser, which serves the page; all its tabs show one state.
"""

import logging
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
from cvqmpt_lab.planning.pipeline import LOAD, Solution
from cvqmpt_lab.planning.planners import PLANNERS, default_planner, planner_named, require_fit
from cvqmpt_lab.planning.solution_report import solution_lines
from cvqmpt_lab.planning.warm_up import warm_up
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.show.bodies import in_view, robot_bodies, scene_bodies, seen_of_problem, whole
from cvqmpt_lab.show.drawn_hands import sampled_hands
from cvqmpt_lab.show.meshes import Colour
from cvqmpt_lab.show.picture import png_of
from cvqmpt_lab.show.raster import clear_viewpoint
from cvqmpt_lab.show.web_page import path_html
from cvqmpt_lab.trajectory.trajectory import as_ros_json


@dataclass(frozen=True, eq=False)
class Request:
    """What is asked for; each change makes a new one."""

    number: int
    planner: str
    constraint: str = "own"  # a key of `Studio.constraints`
    start: np.ndarray | None = None  # pose of the hand (4, 4) [m]; None: as the problem has it
    goal: np.ndarray | None = None  # likewise
    moved: Mapping[str, np.ndarray] = field(default_factory=dict)  # T_world_object by name


@dataclass(frozen=True, eq=False)
class Answer:
    """What became of a request."""

    request: Request
    problem: PlanningProblem  # that the path below solves
    verdict: str = "not planned yet"  # "certified", or "no path"
    seconds: float = 0.0  # from inverse kinematics to the certificate [s]
    solution: Solution | None = None  # the last certified one
    planner: str = ""  # that found it
    message: str = ""  # why the path is still that of an earlier request; "": it is this one's

    @property
    def path(self) -> JointPath | None:
        """The last certified path; it is of this request if there is no message."""
        return self.solution.path if self.solution else None

    @property
    def drawn(self) -> Iterator[tuple[str, np.ndarray, Colour]]:
        """What `sampled_hands` draws of the planner asked for."""
        trees = self.solution.plan.trees if self.solution else ()
        return sampled_hands(self.problem, self.request.planner, trees)


class Studio:
    """Plans a problem again at every change, in one thread that always takes the newest request.

    Requests, of a budget in `seconds`, are numbered; those overtaken meanwhile have no answer.
    """

    def __init__(self, problem: PlanningProblem, seconds: float = 1.0) -> None:
        require_kind("problem", problem, PlanningProblem, LOAD)
        self.problem, self._budget = problem, Budget(seconds=seconds)
        planner = default_planner(problem)[0]
        fitting = (name for name, one in PLANNERS.items() if not one.incompatibility(problem))
        self.planners = tuple(dict.fromkeys((planner, *fitting)))
        standing = upright(axis=upper_axis(problem.robot.pose(problem.start)))
        held = problem.closed_chain  # hands that hold one thing do not let go of it
        self.constraints = {"own": problem.constraint, "upright": (*held, standing), "none": held}
        self.on_answer: Callable[[Answer], None] = lambda answer: None  # in the planning thread
        # the newest ones
        self.request, self.state = Request(0, planner), Answer(Request(-1, planner), problem)
        self._changed, self._stopped = threading.Condition(), False
        self._worker = threading.Thread(target=self._work, daemon=True, name="studio")
        self._worker.start()

    def move_goal(self, T: np.ndarray) -> int:
        """Put the hand's goal at a pose (4, 4) [m]; like all changes it returns their number."""
        return self.ask(goal=from_plain(Pose, T, "goal"))

    def move_start(self, T: np.ndarray) -> int:
        """Put the hand's start at a pose (4, 4) [m]."""
        return self.ask(start=from_plain(Pose, T, "start"))

    def move_obstacle(self, name: str, T: np.ndarray) -> int:
        """Put an object of the scene at a pose (4, 4) [m]."""
        moved = {self.problem.scene[name].name: from_plain(Pose, T, f"obstacle {name!r}")}
        with self._changed:
            return self.ask(moved={**self.request.moved, **moved})

    def set_planner(self, name: str) -> int:
        """Plan with another planner."""
        require_fit(planner_named(name), self.problem)
        return self.ask(planner=name)

    def set_constraint(self, name: str) -> int:
        """Keep another one of `constraints`."""
        require_choice("constraint", name, self.constraints)
        return self.ask(constraint=name)

    def ask(self, **changes: Any) -> int:
        """Make a request that differs from the newest one in some fields, or in none."""
        with self._changed:
            self.request = replace(self.request, number=self.request.number + 1, **changes)
            self._changed.notify_all()
            return self.request.number

    def wait(self, number: int | None = None, timeout: float = 60.0) -> Answer:
        """The newest answer: of that request (None: the newest) or later, or after timeout [s]."""
        with self._changed:
            least = self.request.number if number is None else number
            self._changed.wait_for(lambda: self.state.request.number >= least, timeout)
            return self.state

    def stop(self) -> None:
        """End the planning thread, after the request it works on."""
        self._stopped = True
        self.ask()
        # it is a daemon: a browser that takes no message must not keep the process
        self._worker.join(timeout=10.0)

    def _work(self) -> None:
        """Answer the newest request, again and again."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self.request is not self.state.request)
                if self._stopped:
                    return
                request = self.request
            answer = self._answered(request)
            with self._changed:
                self.state = answer
                self._changed.notify_all()
            try:
                self.on_answer(answer)
            except Exception:  # what shows answers must not end the planning
                logging.getLogger("cvqmpt").exception("an answer is not shown")

    def _answered(self, request: Request) -> Answer:
        """The answer of a request; it has the last path where this one gives none."""
        method = planner_named(request.planner)
        began = time.perf_counter()
        try:
            if request.planner != self.state.planner:
                warm_up(self.problem, method, "compiled")
                began = time.perf_counter()
            asked = (self._posed(request), method, self._budget, 0, Margin())
            found, _ = solve_with_margin(*asked, near_goals_first=True)
            if found.solved:
                how = ("certified", time.perf_counter() - began, found, request.planner)
                return Answer(request, found.problem, *how)
            message = " ".join(repr(found).splitlines()[-1].split())  # of certificate or plan
        except Exception as error:
            message = str(error) or repr(error)
            if not isinstance(error, CvqmptError):  # a fault of ours, or of an external planner
                logging.getLogger("cvqmpt").exception("request %d failed", request.number)
        last, seconds = self.state, time.perf_counter() - began
        return replace(last, request=request, verdict="no path", seconds=seconds, message=message)

    def _posed(self, request: Request) -> PlanningProblem:
        """The problem of a request; InvalidInputError where a pose has no configuration."""
        last, scene, moved = self.state, self.problem.scene, request.moved
        if moved:
            to = (moved.get(item.name, item.T_world_object) for item in scene)
            pairs = zip(scene, to, strict=True)
            scene = scene.changed(objects=tuple(it.changed(T_world_object=T) for it, T in pairs))
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

    def saved(self, kind: str) -> tuple[str, bytes]:
        """Name and content of a file: problem, page, picture or trajectory of the last path."""
        answer, path = self.state, self.state.path
        if path is None:
            raise InvalidInputError(f"nothing to save: {answer.message or answer.verdict}")
        match kind:
            case "problem":
                return "problem.json", json_text(answer.problem.to_dict()).encode()
            case "page":
                verdict = f"certified path of {answer.planner}"
                return "plan.html", path_html(answer.problem, path.states, verdict).encode()
            case "picture":
                return "plan.png", png_of(answer.solution) or b""
            case "trajectory":
                return "motion.json", as_ros_json(certified_motion(answer.problem, path)).encode()
        raise UnknownChoiceError("file", kind, ("problem", "page", "picture", "trajectory"))


def _reached(problem: PlanningProblem, what: str, T: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Configurations (k, n) with the hand at T (4, 4), first those near one (n,)."""
    region = TaskSpaceRegion(T, np.eye(4), np.zeros((6, 2)))
    checker, rng = problem.collision_checker(SAMPLE_MARGIN_M), np.random.default_rng(0)
    some = partial(sample_region, problem.robot, region, checker, rng, within=problem.constraint)
    found = np.concatenate([some(2, 2, near=near).configurations, some(2, 12).configurations])
    if len(found) == 0:
        why = why_none(problem.robot, region, checker, problem.constraint)
        raise InvalidInputError(f"the {what} cannot be there: {why or 'the constraint is broken'}")
    return found


def studio(problem: PlanningProblem, port: int = 8090) -> "StudioPage":
    """Serve a page at a local address until its `stop()`; port 0: any that is free."""
    require_installed("viser", "studio", "studio")
    import viser

    try:  # viser would take the next port, at which the user would not look
        socket.create_server(("127.0.0.1", port)).close()
    except (OSError, OverflowError, TypeError) as error:
        raise InvalidInputError(
            f"port {port} is in use or no port; give another one, or 0 for any"
        ) from error
    server = viser.ViserServer("127.0.0.1", port, f"cvqmpt: {problem.name}", verbose=False)
    return StudioPage(Studio(problem), server)


class StudioPage:
    """A page for a `Studio`, which is its attribute `live`; see `studio`."""

    def __init__(self, live: Studio, server: Any) -> None:
        self.live, self.server = live, server
        self.address = f"http://127.0.0.1:{server.get_port()}"
        self._nodes: dict[str, tuple[Any, Any]] = {}  # mesh and node of the scene by name
        self._moving: list[tuple[Any, np.ndarray]] = []  # nodes, and their poses along the path
        self._points: list[Any] = []  # nodes of `sampled_hands`
        self._dragged, self._layers, self._gizmos = set[str](), dict[str, Any](), dict[str, Any]()
        gui, scene, problem = server.gui, server.scene, live.problem
        # the share button would send the page through a public server
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._text = gui.add_markdown("planning ...")
        planner = gui.add_dropdown("planner", live.planners)
        planner.on_update(lambda event: live.set_planner(event.target.value))
        constraint = gui.add_dropdown("constraint", tuple(live.constraints))
        constraint.on_update(lambda event: live.set_constraint(event.target.value))
        self._obstacle = gui.add_dropdown("drag an obstacle", ("none", *problem.scene.names))
        self._obstacle.on_update(self._choose_obstacle)
        self._slider = gui.add_slider("along the path", 0.0, 1.0, 0.01, 0.0)
        self._slider.on_update(lambda event: self._pose_robot())
        gui.add_button("play").on_click(self._play)
        for name in ("start", "goals", "path", "constraint", "search", "cloud", "Gaussians"):
            shown = name not in ("search", "cloud", "Gaussians")  # which take time
            self._layers[name] = gui.add_checkbox(f"show {name}", shown)
            self._layers[name].on_update(lambda event: live.ask())  # the answer is drawn so
        for kind in ("problem", "page", "picture", "trajectory"):
            gui.add_button(f"save {kind}").on_click(partial(self._save, kind))
        for name in ("start", "goal", "obstacle"):
            gizmo = scene.add_transform_controls(f"/drag {name}", 0.2 * problem.robot.reach)
            gizmo.visible = name != "obstacle"
            gizmo.on_update(partial(self._drag, name))
            self._gizmos[name] = gizmo
        robot, still = robot_bodies(problem, problem.start[None]), scene_bodies(problem.scene)
        aside = whole(body for body in robot if body.aside)
        view = clear_viewpoint([in_view(robot)], whole(still), (1400, 1000), torso=aside)
        # from further away: the goal and what is dragged are in the picture, too
        server.initial_camera.position = 2.2 * np.subtract(view.eye, view.target) + view.target
        server.initial_camera.look_at, server.initial_camera.fov = view.target, view.height_angle
        live.on_answer = self._show
        live.ask()  # the first answer may have come before the page

    def __repr__(self) -> str:
        return f"studio of {self.live.problem.name!r} at {self.address}"

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.address}" width="100%" height="600"></iframe>'

    def stop(self) -> None:
        """End planning and close the address."""
        self.live.stop()
        self.server.stop()

    def _save(self, kind: str, event: Any) -> None:
        """Send a file to the tab that asked for it."""
        try:
            event.client.send_file_download(*self.live.saved(kind), save_immediately=True)
        except CvqmptError as error:
            event.client.add_notification(f"{kind} not saved", str(error), color="red")

    def _play(self, event: Any) -> None:
        """Move the slider along the path."""
        for k in range(101):
            self._slider.value = 0.01 * k
            time.sleep(0.04)

    async def _drag(self, name: str, event: Any) -> None:
        """Ask for the pose of a gizmo; coroutines are called in order, functions might not be."""
        (self._dragged.discard if event.phase == "end" else self._dragged.add)(name)
        (w, x, y, z), (a, b, c) = event.target.wxyz.tolist(), event.target.position.tolist()
        T = Placement(xyz=(a, b, c), quaternion=(x, y, z, w)).matrix
        moved = partial(self.live.move_obstacle, self._obstacle.value)
        {"start": self.live.move_start, "goal": self.live.move_goal}.get(name, moved)(T)

    def _choose_obstacle(self, event: Any) -> None:
        """Put a gizmo at the chosen obstacle."""
        name, gizmo = event.target.value, self._gizmos["obstacle"]
        gizmo.visible = name != "none"
        if gizmo.visible:
            usual = self.live.problem.scene[name].T_world_object
            _place(gizmo, self.live.request.moved.get(name, usual))

    def _show(self, answer: Answer) -> None:
        """Draw an answer; in the planning thread."""
        problem, request, scene = answer.problem, answer.request, self.server.scene
        seen = seen_of_problem(problem, answer.path, ghosts=0)
        shown = {name for name, box in self._layers.items() if box.value}
        # a slash would make one object move another
        named = {f"/{it.layer}/{it.name.replace('/', '|')}": it for it in seen.bodies(*shown)}
        states = answer.path.states if answer.path else np.array([problem.start, *problem.goals])
        points = answer.drawn if shown & {"search", "cloud", "Gaussians"} else ()
        drawn = [it for it in points if it[0] in shown]
        with self.server.atomic():
            self._text.content = text_of(answer)
            for name in self._nodes.keys() - named.keys():
                self._nodes.pop(name)[1].remove()
            for name, body in named.items():
                mesh, node = self._nodes.get(name, (None, None))
                # a scene's meshes stay, though those of clouds are made anew every time
                if node is None or (mesh is not body.mesh and body.layer != "scene"):
                    corners = body.mesh.corners.reshape(-1, 3)
                    faces, faint = np.arange(len(corners)).reshape(-1, 3), body.opacity < 1.0
                    look = {"color": body.colour, "opacity": body.opacity if faint else None}
                    node = scene.add_mesh_simple(name, corners, faces, **look)
                    _place(node, body.poses[0])
                    self._nodes[name] = (body.mesh, node)
                T = request.moved.get(body.name) if body.layer == "scene" else body.poses[0]
                if T is not None:  # few objects of a scene were moved
                    _place(node, T)
            moving = ((self._nodes[name][1], it.poses) for name, it in named.items())
            self._moving = [(node, poses) for node, poses in moving if len(poses) > 1]
            for node in self._points:
                node.remove()
            self._points = [
                scene.add_point_cloud(f"/{layer}/{k}", at, colour, point_size=0.008)
                for k, (layer, at, colour) in enumerate(drawn)
            ]
            first, last = problem.robot.poses(states[[0, -1]])
            for name, asked, T in (("start", request.start, first), ("goal", request.goal, last)):
                if name not in self._dragged:  # under a user's hand it is where it is
                    _place(self._gizmos[name], T if asked is None else asked)
            self._pose_robot()

    def _pose_robot(self) -> None:
        """Put all that moves where the slider is."""
        for node, poses in self._moving:
            _place(node, poses[round(self._slider.value * (len(poses) - 1))])


def text_of(answer: Answer) -> str:
    """What the page says of an answer, as markdown."""
    lines = [f"**{answer.verdict}**, {1e3 * answer.seconds:.0f} ms"]
    if answer.message:
        lines += [answer.message, "The path is that of an earlier request:"]
    for line in solution_lines(answer.solution, answer.planner) if answer.solution else ():
        if (head := line[:12].strip()) in ("planner", "constraint", "length", "certificate"):
            lines.append(f"*{head}* {line[12:]}")
    return "\n\n".join(lines)


def _place(node: Any, T: np.ndarray) -> None:
    """Put a node of the scene at a pose (4, 4) [m]."""
    node.wxyz = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    node.position = T[:3, 3]
