"""A problem that is planned again whenever its start, goal or an obstacle is moved."""

import io
import logging
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cvqmpt_lab.codec import from_plain
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region, why_none
from cvqmpt_lab.constraints.named import upper_axis
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright
from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError, require_kind
from cvqmpt_lab.files import json_text
from cvqmpt_lab.margins import Margin, solve_with_margin
from cvqmpt_lab.pipeline import LOAD, Solution
from cvqmpt_lab.planners import PLANNERS, default_planner, planner_named, require_fit
from cvqmpt_lab.poses import Pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.search.planner_interface import GaussianMixture, Observation, Query
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.roadmap import RoadmapPath
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.warm_up import warm_up

CONSTRAINTS: Mapping[str, Callable[[PlanningProblem], tuple[TaskSpaceRegion, ...]]] = {
    "the problem's own": lambda problem: problem.constraint,
    "upright": lambda problem: (upright(axis=upper_axis(problem.robot.pose(problem.start))),),
    "none": lambda problem: (),
}


@dataclass(frozen=True, eq=False)
class Request:
    """What is asked for; each change makes a new one."""

    number: int
    planner: str
    constraint: str  # a key of CONSTRAINTS
    start: np.ndarray | None = None  # pose of the hand (4, 4) [m]; None: as the problem has it
    goal: np.ndarray | None = None  # likewise
    moved: Mapping[str, np.ndarray] = field(default_factory=dict)  # T_world_object by name


@dataclass(frozen=True, eq=False)
class Answer:
    """What became of a request."""

    request: Request
    verdict: str  # of the certificate, or why there is no path
    seconds: float  # from the beginning of its inverse kinematics to its certificate [s]
    problem: PlanningProblem  # that the path below solves
    solution: Solution | None = None  # the last certified one
    planner: str = ""  # that found it
    margin: str = ""  # that its path keeps
    message: str = ""  # why the path is still that of an earlier request; "": it is this one's

    @property
    def number(self) -> int:
        """Number of the request."""
        return self.request.number

    @property
    def path(self) -> JointPath | None:
        """The last certified path; that of this request if there is no message."""
        found = self.solution and self.solution.simplified
        return found.path if found else None


class Studio:
    """Plans a problem again at every change, in a thread that takes the newest request.

    Requests are numbered. Those that were overtaken while another was planned are left out.

    Args:
        problem: to begin with.
        planner: its name; None: the usual one of the problem.
        carried: objects shown in the hand if the problem has no attachments.
        seconds: budget of a request [s].
        on_answer: called with each answer, in the planning thread.
    """

    def __init__(
        self,
        problem: PlanningProblem,
        planner: str | None = None,
        carried: Sequence[Attachment] = (),
        seconds: float = 1.0,
        on_answer: Callable[[Answer], None] | None = None,
    ) -> None:
        require_kind("problem", problem, PlanningProblem, LOAD)
        self.problem, self.carried, self._budget = problem, tuple(carried), Budget(seconds=seconds)
        planner = planner or default_planner(problem)[0]
        require_fit(planner_named(planner), problem)
        self._request = Request(0, planner, next(iter(CONSTRAINTS)))
        self._answer = Answer(replace(self._request, number=-1), "not planned yet", 0.0, problem)
        self._changed, self._stopped = threading.Condition(), False
        self._on_answer, self._warm = on_answer, set[str]()
        self._worker = threading.Thread(target=self._work, daemon=True, name="studio")
        self._worker.start()

    @property
    def request(self) -> Request:
        """The newest request."""
        return self._request

    @property
    def state(self) -> Answer:
        """The newest answer."""
        return self._answer

    @property
    def planners(self) -> tuple[str, ...]:
        """Names of the planners that fit the problem."""
        return tuple(
            name for name, one in PLANNERS.items() if not one.incompatibility(self.problem)
        )

    def move_goal(self, T: np.ndarray) -> int:
        """Put the goal of the hand at a pose (4, 4) [m]; returns the request's number."""
        return self.ask(goal=from_plain(Pose, T, "goal"))

    def move_start(self, T: np.ndarray) -> int:
        """Put the start of the hand at a pose (4, 4) [m]; returns the request's number."""
        return self.ask(start=from_plain(Pose, T, "start"))

    def move_obstacle(self, name: str, T: np.ndarray) -> int:
        """Put an object of the scene at a pose (4, 4) [m]; returns the request's number."""
        item = self.problem.scene[name]
        moved = {item.name: from_plain(Pose, T, f"obstacle {name!r}")}
        with self._changed:
            return self.ask(moved={**self._request.moved, **moved})

    def set_planner(self, name: str) -> int:
        """Plan with another planner; returns the request's number."""
        require_fit(planner_named(name), self.problem)
        return self.ask(planner=name)

    def set_constraint(self, name: str) -> int:
        """Keep another constraint, a key of `CONSTRAINTS`; returns the request's number."""
        if name not in CONSTRAINTS:
            raise UnknownChoiceError("constraint", name, CONSTRAINTS)
        return self.ask(constraint=name)

    def ask(self, **changes: Any) -> int:
        """Make a request that differs from the newest one in some fields, or in none."""
        with self._changed:
            number = self._request.number + 1
            self._request = replace(self._request, number=number, **changes)
            self._changed.notify_all()
            return number

    def wait(self, number: int | None = None, timeout: float = 30.0) -> Answer:
        """The newest answer, once it is that of request `number` (the newest one) or a later one.

        InvalidInputError: there is none within `timeout` [s].
        """
        with self._changed:
            number = self._request.number if number is None else number
            if not self._changed.wait_for(lambda: self._answer.number >= number, timeout):
                raise InvalidInputError(
                    f"request {number} has no answer after {timeout:g} s; wait longer"
                )
            return self._answer

    def stop(self) -> None:
        """End the planning thread, after the request it works on."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _work(self) -> None:
        """Answer the newest request, again and again."""
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._stopped or self._request.number > self._answer.number
                )
                if self._stopped:
                    return
                request = self._request
            answer = self._answered(request)
            with self._changed:
                self._answer = answer
                self._changed.notify_all()
            try:
                if self._on_answer is not None:
                    self._on_answer(answer)
            except Exception:  # what shows answers must not end the planning
                logging.getLogger("cvqmpt").exception("answer %d is not shown", answer.number)

    def _answered(self, request: Request) -> Answer:
        """The answer of a request; it has the last path where this one gives none."""
        method = planner_named(request.planner)
        began = time.perf_counter()
        try:
            if request.planner not in self._warm:
                warm_up(self.problem, method, "compiled")
                self._warm.add(request.planner)
                began = time.perf_counter()
            problem = self._posed(request)
            found, margin = solve_with_margin(
                problem, method, self._budget, 0, Margin(), near_goals_first=True
            )
        except CvqmptError as error:
            verdict, message = "not planned", str(error)
        except Exception as error:  # a fault of ours, or of an external planner; the thread goes on
            logging.getLogger("cvqmpt").exception("request %d failed", request.number)
            verdict, message = "failed", f"{type(error).__name__}: {error}"
        else:
            seconds = time.perf_counter() - began
            if found.solved:
                answered = (request, "certified", seconds, found.problem, found)
                return Answer(*answered, request.planner, margin)
            verdict = str(found.certificate.verdict if found.certificate else found.plan.status)
            reasons = found.certificate.reasons if found.certificate else (found.plan.detail,)
            message = "; ".join(filter(None, reasons)) or f"no path within {seconds:.1f} s"
        seconds = time.perf_counter() - began
        return replace(
            self._answer, request=request, verdict=verdict, seconds=seconds, message=message
        )

    def _posed(self, request: Request) -> PlanningProblem:
        """The problem of a request; InvalidInputError where a pose has no configuration."""
        scene, moved = self.problem.scene, request.moved
        if moved:
            objects = (
                item.changed(T_world_object=moved[item.name]) if item.name in moved else item
                for item in scene
            )
            scene = scene.changed(objects=tuple(objects))
        problem = self.problem.changed(scene=scene)
        if request.constraint != "the problem's own":
            problem = problem.changed(constraint=CONSTRAINTS[request.constraint](problem))
        last = self._answer
        if request.start is not None:
            start = self._reached(problem, "start", request.start, last.problem.start)[0]
            problem = problem.changed(start=start)
        if request.goal is not None:
            near = last.path.states[-1] if last.path else problem.start
            goals = self._reached(problem, "goal", request.goal, near)
            problem = problem.changed(goals=goals, goal_region=None)
        return problem

    @staticmethod
    def _reached(
        problem: PlanningProblem, what: str, T: np.ndarray, near: np.ndarray
    ) -> np.ndarray:
        """Configurations (k, n) with the hand at T (4, 4): near one (n,), or anywhere."""
        region = TaskSpaceRegion(T, np.eye(4), np.zeros((6, 2)))
        checker, rng = problem.collision_checker(SAMPLE_MARGIN), np.random.default_rng(0)
        asked = problem.robot, region, checker, rng
        for around, count in ((near, 2), (None, 8)):
            found = sample_region(
                *asked, count, max_poses=2 * count, within=problem.constraint, near=around
            )
            if len(found.configurations):
                return found.configurations
        why = why_none(problem.robot, region, checker, problem.constraint)
        raise InvalidInputError(f"the {what} cannot be there: {why or found.outcome}")

    def saved(self, kind: str) -> tuple[str, bytes]:
        """Name and content of a file: the problem, page, picture or trajectory of the last path.

        InvalidInputError: there is no path yet. UnknownChoiceError: of an unknown kind.
        """
        answer = self.state
        if answer.path is None:
            raise InvalidInputError(f"nothing to save yet: {answer.message or answer.verdict}")
        problem, path = answer.problem, answer.path
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "-", problem.name)
        match kind:
            case "problem":
                return f"{stem}.json", (json_text(problem.to_dict()) + "\n").encode()
            case "page":
                from cvqmpt_lab.show.web_page import path_html

                verdict = f"certified path of {answer.planner}"
                return f"{stem}.html", path_html(problem, path.states, verdict).encode()
            case "picture":
                from PIL import Image

                from cvqmpt_lab.show.picture import problem_image

                image, written = problem_image(problem, path, (1200, 800)), io.BytesIO()
                Image.fromarray(image).save(written, format="PNG")
                return f"{stem}.png", written.getvalue()
            case "trajectory":
                from cvqmpt_lab.motion_check import certified_motion
                from cvqmpt_lab.trajectory.trajectory import as_ros_json

                return f"{stem}-motion.json", as_ros_json(certified_motion(problem, path)).encode()
        kinds = ("problem", "page", "picture", "trajectory")
        raise UnknownChoiceError("kind of file", kind, kinds)


def hands_drawn(answer: Answer) -> dict[str, np.ndarray]:
    """Points (k, 3) [m] that tell what the planner of an answer sees and draws, by name.

    `cloud`: that its network sees. `roadmap`: hands of the roadmap's nodes. `before`, `after`:
    hands of draws from the Gaussians that it predicts, before and after its update (Algorithm 2).
    """
    problem, method = answer.problem, planner_named(answer.request.planner)
    robot, stages = problem.robot, method.stages(problem)
    found, cloud = dict[str, np.ndarray](), None
    if stages.observe is not None:
        found["cloud"] = cloud = stages.observe(problem.scene)
    if isinstance(stages.predict, RoadmapPath):
        found["roadmap"] = robot.poses(stages.predict.roadmap.nodes)[:, :3, 3]
    if method.sampler is None:
        return found
    rng = np.random.default_rng(0)
    query = Query.of(ConstrainedSpace(problem), Budget(seconds=1.0), rng)
    query = replace(query, goals=query.nearest_goals(1))
    proposals = {"before": stages.predict(query, Observation(cloud))}
    if stages.update is not None:
        proposals["after"] = stages.update(query, proposals["before"])
    for name, proposal in proposals.items():
        if isinstance(proposal.distribution, GaussianMixture):
            draws = replace(proposal.distribution, uniform_share=0.0).sample(rng, 400)
            found[name] = robot.poses(draws.clip(robot.lower, robot.upper))[:, :3, 3]
    return found
