"""Planning behind the studio, in one thread that takes the newest request."""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    UnknownChoiceError,
    require_choice,
    require_kind,
)
from cvqmpt_lab.base.files import json_text
from cvqmpt_lab.base.poses import Pose
from cvqmpt_lab.base.values import scalar
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, sample_region
from cvqmpt_lab.constraints.named import upper_axis
from cvqmpt_lab.constraints.no_goal import why_none
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright
from cvqmpt_lab.features.motion.motion_check import certified_motion
from cvqmpt_lab.features.motion.trajectory import Trajectory, as_ros_json
from cvqmpt_lab.features.pictures.drawn_hands import sampled_hands
from cvqmpt_lab.features.pictures.meshes import Colour
from cvqmpt_lab.features.pictures.picture import png_of
from cvqmpt_lab.features.pictures.web_page import path_html
from cvqmpt_lab.features.plan import Request, plan
from cvqmpt_lab.planning.margins import Margin
from cvqmpt_lab.planning.pipeline import PROBLEM_HINT
from cvqmpt_lab.planning.planners import PLANNERS, default_planner, planner_named
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.warm_up import warm_up
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import SLOW_SPEED
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.search.result import Budget, JointPath

MOST_STATES = 200  # of a timed path that is played


@dataclass(frozen=True, eq=False)
class StudioRequest:
    """A planning request; each change makes a new one."""

    number: int
    planner: str
    constraint: str = "own"  # a key of `Studio.constraints`
    # pose of the hand (4, 4) [m], or configuration (n,); None: the problem's start
    start: np.ndarray | None = None
    goal: np.ndarray | None = None  # pose of the hand (4, 4) [m]; None: the problem's goals
    moved: Mapping[str, np.ndarray] = field(default_factory=dict)  # T_world_object by name
    clearance: float = Margin().metres  # to obstacles [m]; less where start or goals have less
    speed: float = SLOW_SPEED  # of the joint limits, for play and for a saved trajectory
    layers: frozenset[str] = frozenset(("start", "goals", "path", "constraint"))  # that are drawn

    def plans_like(self, other: "StudioRequest") -> bool:
        """Return whether only speed and layers differ, so that nothing is planned again."""
        fields = "planner", "constraint", "start", "goal", "moved", "clearance"
        return all(getattr(self, name) is getattr(other, name) for name in fields)

    @property
    def posture(self) -> np.ndarray | None:
        """The start (n,) if joints were moved, not the hand [rad or m]."""
        return self.start if self.start is not None and self.start.ndim == 1 else None


@dataclass(frozen=True, eq=False)
class Response:
    """Response to a planning request."""

    request: StudioRequest
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
    def gap(self) -> str:
        """What of the constraint is not proven between states, after "; "; else ""."""
        certificate = self.solution and self.solution.certificate
        return (
            f"; {certificate.constraint_gap}" if certificate and certificate.constraint_gap else ""
        )

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
        self.on_wait: Callable[[], None] = lambda: None  # when a response takes more than 0.2 s
        # objects that move together: those whose names are alike up to the first "/"
        self.groups: dict[str, list[SceneObject]] = {}
        for item in problem.scene:
            self.groups.setdefault(item.name.partition("/")[0], []).append(item)
        self._past: list[StudioRequest] = []  # what `undo` goes back to, the last one first
        self.request = self._first = StudioRequest(0, planner)  # the newest and the first one
        self.response = Response(StudioRequest(-1, planner), problem)  # the newest one
        self._changed, self._stopped = threading.Condition(), False
        self._worker = threading.Thread(target=self._work, daemon=True, name="studio")
        self._worker.start()

    def move_goal(self, T: np.ndarray) -> int:
        """Move the hand's goal to a pose (4, 4) [m]; returns the number of the request."""
        return self.submit(goal=from_plain(Pose, T, "goal"))

    def move_start(self, T: np.ndarray) -> int:
        """Move the hand's start to a pose (4, 4) [m]; returns the number of the request."""
        return self.submit(start=from_plain(Pose, T, "start"))

    def move_joint(self, index: int, value: float) -> int:
        """Move one joint of the start [rad or m]; returns the number of the request.

        The path begins at the nearest configuration at which the constraint holds.
        """
        with self._changed:
            before = self.request.posture
            posture = np.array(self.response.problem.start if before is None else before)
            posture[index] = scalar(float, value, self.problem.robot.joint_names[index])
            return self.submit(start=posture)

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
        """Keep the present request for `undo`."""
        self._past.append(self.request)

    def undo(self) -> int:
        """Go back to the request that was remembered last; returns the number of the new one."""
        return self._again(self._past.pop() if self._past else self.request)

    def reset(self) -> int:
        """Go back to the first request, which `undo` reverts; returns the number of the new one."""
        self.remember()
        return self._again(self._first)

    def _again(self, request: StudioRequest) -> int:
        """Submit an earlier request under a new number, and return that."""
        return self.submit(**vars(request))

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
            number = self.request.number + 1
            self.request = replace(self.request, **{**changes, "number": number})
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
            waiting = threading.Timer(0.2, self.on_wait)
            waiting.daemon = True  # the end of the program does not wait for it
            waiting.start()
            response = self._planned(request)
            waiting.cancel()
            with self._changed:
                self.response = response
                self._changed.notify_all()
            try:
                self.on_response(response)
            except Exception:  # an error while drawing must not end the planning
                logging.getLogger("cvqmpt").exception("a response cannot be drawn")

    def _planned(self, request: StudioRequest) -> Response:
        """Plan a request and return the response; it has the last path if none was found."""
        last = self.response
        if last.request.number >= 0 and request.plans_like(last.request):
            return replace(last, request=request)
        began = time.perf_counter()
        try:
            method = planner_named(request.planner)
            if request.planner != last.planner:
                warm_up(self.problem, method, "compiled")
                began = time.perf_counter()
            problem = self._problem_of(request)
            margin = Margin(request.clearance)
            asked = Request(method, self._budget, 0, margin, near_goals_first=True)
            found = plan(problem, asked).solution
            if found.solved:
                seconds = time.perf_counter() - began
                solved = found.problem
                return Response(request, solved, "certified", seconds, found, request.planner)
            message = " ".join(repr(found).splitlines()[-1].split())  # of certificate or plan
        except Exception as error:
            message = str(error) or repr(error)
            if not isinstance(error, CvqmptError):  # a defect here or in an external planner
                logging.getLogger("cvqmpt").exception("request %d failed", request.number)
        seconds = time.perf_counter() - began
        return replace(last, request=request, verdict="no path", seconds=seconds, message=message)

    def _problem_of(self, request: StudioRequest) -> PlanningProblem:
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
        if request.posture is not None:
            start = problem.manifold.project(request.posture)
            if start is None:
                raise InvalidInputError("no posture near that of the sliders fits the constraint")
            problem = problem.changed(start=start)
        elif request.start is not None:
            start = _reached(problem, "start", request.start, last.problem.start)[0]
            problem = problem.changed(start=start)
        if request.goal is not None:
            near = last.path.states[-1] if last.path else problem.start
            goals = _reached(problem, "goal", request.goal, near)
            problem = problem.changed(goals=goals, goal_region=None)
        return problem

    def saved(self, kind: str) -> tuple[str, bytes]:
        """Name and content of a file: "problem", "page", "picture" or "trajectory" of the path."""
        response, path = self.response, self.response.path
        if path is None:
            raise InvalidInputError(f"nothing to save: {response.message or response.verdict}")
        match kind:
            case "problem":
                return "problem.json", json_text(response.problem.to_dict()).encode()
            case "page":
                verdict = f"certified path of {response.planner}{response.gap}"
                times, states = timed_states(response.problem, path, self.request.speed)
                text = path_html(response.problem, states, verdict, times=times)
                return "plan.html", text.encode()
            case "picture":
                return "plan.png", png_of(response.solution) or b""
            case "trajectory":
                motion = _motion(response.problem, path, self.request.speed)
                limits = self.problem.robot.joint_limits
                return "motion.json", as_ros_json(motion, limits).encode()
        raise UnknownChoiceError("file", kind, ("problem", "page", "picture", "trajectory"))


def _motion(problem: PlanningProblem, path: JointPath, speed: float) -> Trajectory:
    """Certified motion along a path at a share `speed` of the joint limits."""
    from cvqmpt_lab.features.motion.timing import TimingSettings  # half a second to import

    return certified_motion(problem, path, TimingSettings(speed))


def timed_states(
    problem: PlanningProblem, path: JointPath, speed: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Times (m,) [s] and states (m, n) of the motion along a path; None if it cannot be timed."""
    try:
        motion = _motion(problem, path, speed)
    except CvqmptError:  # e.g. efforts of a joint: the path is shown over its states
        return None, path.states
    sampled = motion.sampled(max(0.05, motion.duration / (MOST_STATES - 1)))
    return sampled.times, sampled.positions


def _reached(problem: PlanningProblem, what: str, T: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Configurations (k, n) with the hand at a pose; those near a given one come first.

    Args:
        problem: the problem with robot, scene and constraint.
        what: "start" or "goal", for the error message.
        T: pose (4, 4) of the hand [m].
        near: configuration (n,) [rad or m].
    """
    region = TaskSpaceRegion(T, np.eye(4), np.zeros((6, 2)))
    checker, rng = checker_of(problem, SAMPLE_MARGIN_M), np.random.default_rng(0)
    some = partial(sample_region, problem.robot, region, checker, rng, within=problem.constraint)
    found = np.concatenate([some(2, 2, near=near).configurations, some(2, 12).configurations])
    if len(found) == 0:
        why = why_none(problem.robot, region, checker, problem.constraint)
        raise InvalidInputError(f"the {what} cannot be there: {why or 'the constraint is broken'}")
    return found
