"""Faults that `cvqmpt audit` finds: twelve kinds, planted in episodes of timed paths.

Run `python -m cvqmpt_lab.experiments.bench.planted_faults FOLDER [COUNT]`: it writes data sets in
the form of LeRobot v3 into the folder, audits them and prints the table of docs/audit.md. Each kind
is planted once in COUNT episodes of each arm (10). If the package lerobot-doctor is installed, its
answers on the same files are printed, too.

An episode goes from home through free configurations, along straight lines, each timed within the
limits of the arm; commands are its states at 30 Hz, measured positions follow one sample later, in
steps of the encoder and with noise.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import make_folder, write_text
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.features.audit.judging import Settings
from cvqmpt_lab.features.audit.rows import CERTIFIED
from cvqmpt_lab.features.audit.run import audit
from cvqmpt_lab.features.motion.timing import TimingSettings, time_path
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene

RATE = 30.0  # samples a second
STEP_RAD = {"so-arm101": 2.0 * np.pi / 4096.0, "panda": 1e-6}  # of the encoders
CLEAN = 20  # episodes without a fault, an arm
GRIPPER = "gripper"


@dataclass(frozen=True)
class Arm:
    """An arm, the limits that its episodes keep, and where they begin."""

    name: str
    units: str  # of its data sets
    source: Mapping[str, Any]
    home: tuple[float, ...]  # [rad]
    spread: float  # of the configurations around home [rad]


ARMS = (
    Arm(
        "so-arm101",
        "degrees",
        {
            "name": "so-arm101",
            "end_effectors": ["gripper_frame_link", "moving_jaw_so101_v1_link"],
            "velocity_limits": 3.0,
            "acceleration_limits": 20.0,
            "jerk_limits": 4000.0,
            "effort_limits": 1.0,
        },
        (0.0, -0.6, 0.5, 0.5, 0.0, 0.6),
        0.5,
    ),
    Arm(
        "panda",
        "radians",
        {"name": "panda", "effort_limits": [60.0, 48.0, 60.0, 48.0, 6.0, 6.0, 6.0]},
        (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
        0.5,
    ),
)


@dataclass
class Made:
    """An episode: commanded and measured positions (m, n) [rad], times (m,) [s]."""

    action: np.ndarray
    state: np.ndarray
    times: np.ndarray
    scale: float = 1.0  # on what is written, of wrong units
    gripper_scale: float = 1.0


class Maker:
    """Makes episodes of an arm, and plants faults in them.

    Args:
        arm: the arm.
        seed: of all randomness.
    """

    def __init__(self, arm: Arm, seed: int) -> None:
        self.arm, self.robot = arm, robot_from_source(arm.source)
        self.rng = np.random.default_rng(seed)
        self.checker = CollisionChecker(self.robot, Scene("none", ()))
        self.home = np.array(arm.home)

    def free_line(self, a: np.ndarray, b: np.ndarray, count: int = 60) -> bool:
        """Return whether a straight line from a to b (n,) is free at `count` states."""
        states = a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)
        return not self.checker.in_collision_batch(states).any()

    def stop(self, begin: np.ndarray) -> np.ndarray:
        """Return a configuration (n,) near home that a free line joins with `begin`."""
        while True:
            q = self.home + self.rng.uniform(-1.0, 1.0, len(self.home)) * self.arm.spread
            q = np.clip(q, self.robot.lower + 0.05, self.robot.upper - 0.05)
            if self.free_line(begin, q):
                return q

    def clean(self, stops: int = 3) -> Made:
        """Return an episode without a fault."""
        begin = self.home + 0.02 * self.rng.standard_normal(len(self.home))
        rows, q = [begin[None].repeat(5, 0)], begin
        for _ in range(stops):
            q, last = self.stop(q), q
            rows.append(self.timed(np.array([last, q])))
            rows.append(q[None].repeat(4, 0))
        return self.recorded(np.concatenate(rows))

    def timed(self, path: np.ndarray, speed: float = 0.7) -> np.ndarray:
        """Return the states at RATE of the fastest motion along a path (k, n)."""
        motion = time_path(path, self.robot.joint_limits, TimingSettings(speed=speed))
        return motion.sampled(1.0 / RATE).positions[1:]

    def recorded(self, action: np.ndarray) -> Made:
        """Return the episode of commands (m, n)."""
        late = np.vstack([action[:1], action[:-1]])
        step = STEP_RAD[self.arm.name]
        noisy = late + 0.2 * step * self.rng.standard_normal(late.shape)
        measured = np.round(noisy / step) * step
        return Made(action, measured, np.arange(len(action)) / RATE)

    def joint(self, made: Made) -> int:
        """Return one of the joints that move most in an episode."""
        moved = np.ptp(made.action, axis=0)
        return int(self.rng.choice(np.argsort(moved)[-3:]))


def units(maker: Maker, made: Made) -> Made:
    """Radians where degrees are stated, or degrees where radians are."""
    wrong = np.pi / 180.0 if maker.arm.units == "degrees" else 180.0 / np.pi
    return replace(made, scale=wrong)


def swapped(maker: Maker, made: Made) -> Made:
    """Two columns change places: in the measured positions, or in both."""
    middle = np.median(made.action, axis=0)
    pairs = [(i, j) for i in range(len(middle)) for j in range(i)]
    apart = [p for p in pairs if abs(middle[p[0]] - middle[p[1]]) > 0.4]
    i, j = apart[maker.rng.integers(len(apart))]
    order = np.arange(len(middle))
    order[[i, j]] = j, i
    both = maker.rng.random() < 0.5
    action = made.action[:, order] if both else made.action
    return replace(made, action=action, state=made.state[:, order])


def jump(maker: Maker, made: Made) -> Made:
    """One sample of one joint is 0.25 rad off, or all that follow it."""
    k, j = int(maker.rng.integers(10, len(made.action) - 10)), maker.joint(made)
    action = made.action.copy()
    last = k + 1 if maker.rng.random() < 0.5 else None
    action[k:last, j] += 0.25 * np.sign(maker.home[j] - action[k, j] + 1e-9)
    return replace(made, action=action)


def limit(maker: Maker, made: Made) -> Made:
    """A joint goes 0.03 rad beyond its limit, slowly."""
    j, robot = maker.joint(made), maker.robot
    q = made.action[:, j]
    room = robot.upper[j] + 0.03 - q.max()
    bump = np.sin(np.linspace(0.0, np.pi, len(q))) ** 2
    peak = int((q + room * bump).argmax())
    grown = room + (q.max() - q[peak]) + 0.02
    action = made.action.copy()
    action[:, j] = q + grown * bump
    action[:, j] *= (robot.upper[j] + 0.03) / action[:, j].max()
    return maker.recorded(action)


def touch(maker: Maker, made: Made) -> Made:
    """The arm touches itself between two samples, which are free."""
    speed = np.minimum(0.6 * maker.robot.joint_limits.velocity / RATE, 0.08)
    while True:
        states = maker.robot.random_configurations(maker.rng, 200)
        for q in states[maker.checker.in_collision_batch(states)]:
            near, far = maker.home, q
            for _ in range(40):  # where the line from home begins to touch
                middle = 0.5 * (near + far)
                hit = maker.checker.in_collision(middle)
                near, far = (near, middle) if hit else (middle, far)
            for _ in range(20):
                way = maker.rng.uniform(-1.0, 1.0, len(q)) * speed
                found = _grazing(maker, far, way)
                if found is not None:
                    return maker.recorded(found)


def _grazing(maker: Maker, q: np.ndarray, way: np.ndarray) -> np.ndarray | None:
    """Return samples (m, n) that pass a touching state q (n,) by steps `way`; None: they touch."""
    steps = np.concatenate([np.linspace(0.0, 1.0, 12)[1:], np.ones(3), np.linspace(1.0, 0.0, 12)])
    along = np.cumsum(steps)
    line = q + (along - along[12] + 0.5)[:, None] * way
    low, high = maker.robot.lower + 0.02, maker.robot.upper - 0.02
    if ((line < low) | (line > high)).any() or maker.checker.in_collision_batch(line).any():
        return None
    home = maker.home
    if not (maker.free_line(home, line[0]) and maker.free_line(line[-1], home)):
        return None
    there, back = (maker.timed(np.array(ends)) for ends in ([home, line[0]], [line[-1], home]))
    return np.concatenate([home[None].repeat(5, 0), there, line, back])


def gap(maker: Maker, made: Made) -> Made:
    """Eight samples are lost."""
    k = int(maker.rng.integers(10, len(made.action) - 20))
    kept = np.r_[0:k, k + 8 : len(made.action)]
    return replace(made, action=made.action[kept], state=made.state[kept], times=made.times[kept])


def drift(maker: Maker, made: Made) -> Made:
    """The measured position of a joint drifts by 0.2 rad."""
    state = made.state.copy()
    state[:, maker.joint(made)] += np.linspace(0.0, 0.2, len(state))
    return replace(made, state=state)


def stamps(maker: Maker, made: Made) -> Made:
    """Two samples have the time of the one before."""
    times = made.times.copy()
    for k in maker.rng.choice(np.arange(5, len(times) - 5), 2, replace=False):
        times[k] = times[k - 1]
    return replace(made, times=times)


def gripper(maker: Maker, made: Made) -> Made:
    """The gripper goes from 0 to 1, not from 0 to 100."""
    return replace(made, gripper_scale=0.01)


def other_arm(maker: Maker, made: Made) -> Made:
    """Zero positions of an older calibration, or an arm of another maker with as many joints."""
    if maker.arm.name == "so-arm101":
        shift = np.zeros(len(maker.home))
        shift[1:3] = 0.5 * np.pi
        return replace(made, action=made.action + shift, state=made.state + shift)
    home = np.array([0.0, -0.4, 0.0, 0.9, 0.0, 1.3, 0.0])  # of the xArm 7
    return maker.recorded(made.action - maker.home + home)


def jerk(maker: Maker, made: Made) -> Made:
    """The commands of a joint tremble for six samples, within its limits of velocity."""
    limits, j = maker.robot.joint_limits, maker.joint(made)
    assert limits.jerk is not None
    size = 1.3 * limits.jerk[j] / (8.0 * RATE**3)
    k = int(maker.rng.integers(10, len(made.action) - 20))
    action = made.action.copy()
    action[k : k + 6, j] += size * (-1.0) ** np.arange(6)
    return maker.recorded(action)


def effort(maker: Maker, made: Made) -> Made:
    """The stretched arm is swung as fast as its limits of velocity and acceleration allow."""
    names = ("shoulder_lift", "panda_joint2")
    j = next(k for k, name in enumerate(maker.robot.joint_names) if name in names)
    limits, q = maker.robot.joint_limits, maker.home.copy()
    if maker.arm.name == "panda":
        q[[1, 3, 5]] = 1.2, -0.3, 1.571
    else:
        q[[1, 2, 3]] = 1.2, -1.2, 0.0
    size = 0.2
    pace = np.sqrt(0.8 * limits.acceleration[j] / size)
    t = np.arange(int(3.0 * RATE)) / RATE
    swing = np.tile(q, (len(t), 1))
    swing[:, j] += size * np.cos(pace * t)
    return maker.recorded(swing)


KINDS: Mapping[str, tuple[Callable[[Maker, Made], Made], str]] = {
    # name in the table: what plants it, and the kinds that name it in a row
    "units": (units, "units"),
    "swapped joints": (swapped, "swapped"),
    "jump": (jump, "jump"),
    "limit": (limit, "limits"),
    "self-touch between samples": (touch, "collision"),
    "gap": (gap, "gap"),
    "drift": (drift, "drift"),
    "repeated stamps": (stamps, "stamps"),
    "gripper scale": (gripper, "gripper"),
    "wrong arm": (other_arm, "limits units"),
    "jerk": (jerk, "jerk"),
    "effort": (effort, "effort"),
}


def write_set(root: Path, maker: Maker, episodes: list[Made]) -> None:
    """Write a data set of LeRobot v3."""
    names = [f"{name}.pos" for name in maker.robot.joint_names]
    n = len(names)
    feature = {"dtype": "float32", "shape": [n], "names": names}
    info = {
        "codebase_version": "v3.0",
        "robot_type": maker.arm.name,
        "fps": int(RATE),
        "total_episodes": len(episodes),
        "total_frames": sum(len(made.action) for made in episodes),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {"action": feature, "observation.state": feature},
    }
    make_folder(root / "meta")
    write_text(root / "meta" / "info.json", json.dumps(info))
    tables, begun = [], 0
    for number, made in enumerate(episodes):
        m = len(made.action)
        rows = {
            "action": _lists(maker, made, made.action),
            "observation.state": _lists(maker, made, made.state),
            "timestamp": pa.array(made.times.astype(np.float32)),
            "frame_index": np.arange(m),
            "episode_index": np.full(m, number),
            "index": np.arange(begun, begun + m),
            "task_index": np.zeros(m, dtype=int),
        }
        tables.append(pa.table(rows))
        begun += m
    folder = make_folder(root / "data" / "chunk-000")
    pq.write_table(pa.concat_tables(tables), folder / "file-000.parquet")


def _lists(maker: Maker, made: Made, states: np.ndarray) -> Any:
    """Return a column of states in the units of the data set."""
    robot, values = maker.robot, states.copy()
    if maker.arm.units == "degrees":
        values = np.degrees(values)
        if GRIPPER in robot.joint_names:
            j = robot.joint_names.index(GRIPPER)
            values[:, j] = 100.0 * (states[:, j] - robot.lower[j])
            values[:, j] /= robot.upper[j] - robot.lower[j]
    values *= made.scale
    if GRIPPER in robot.joint_names:
        values[:, robot.joint_names.index(GRIPPER)] *= made.gripper_scale
    kind = pa.list_(pa.float32(), values.shape[1])
    return pa.array(list(values.astype(np.float32)), type=kind)


def measured(folder: Path, arm: Arm, count: int) -> Iterator[list[object]]:
    """Yield lines of the table: kind, found of all, named of all, found by other tools.

    The kind "none" counts clean episodes that were refused, by either column.

    Args:
        folder: where the data sets are written.
        arm: the arm.
        count: planted episodes of each kind.
    """
    maker = Maker(arm, seed=1)  # thresholds were chosen by episodes of seed 0
    clean = [maker.clean() for _ in range(CLEAN)]
    lint = _lint(arm, clean)
    for column in ("action", "observation.state"):
        rows = _rows(folder / f"{arm.name}-clean", maker, clean, column)
        refused = [row for row in rows if row.verdict != CERTIFIED]
        for row in refused:
            print(f"  false alarm of {arm.name}, {column}: {row.name}: {row.fault}")
        yield [f"none ({column})", len(rows), len(refused), "", "", lint]
    for kind, (plant, words) in KINDS.items():
        if kind == "gripper scale" and GRIPPER not in maker.robot.joint_names:
            continue
        planted = [plant(maker, maker.clean()) for _ in range(count)]
        root = folder / f"{arm.name}-{kind.replace(' ', '-')}"
        rows = _rows(root, maker, clean + planted, "action")[len(clean) :]
        found = [row for row in rows if row.verdict != CERTIFIED]
        named = [row for row in rows if {*words.split()} & {*row.kinds.split()}]
        others = [_doctor(root, maker, clean, planted), _lint(arm, planted)]
        yield [kind, count, len(found), len(named), *others]


def _rows(root: Path, maker: Maker, episodes: list[Made], column: str) -> list[Any]:
    """Write a data set and return the rows of its audit."""
    write_set(root, maker, episodes)
    return audit(root, Settings(maker.arm.source, maker.arm.units, column=column))


def _doctor(root: Path, maker: Maker, clean: list[Made], planted: list[Made]) -> object:
    """Return how many planted episodes change an answer of lerobot-doctor on the clean ones."""
    try:
        from lerobot_doctor.dataset_loader import load_dataset  # no package of this project
        from lerobot_doctor.runner import run_checks
    except ImportError:
        return "-"

    def answers(episodes: list[Made]) -> set[str]:
        write_set(root.with_name("doctor"), maker, episodes)
        results = run_checks(load_dataset(str(root.with_name("doctor")))).results
        return {f"{result.name} {result.severity}" for result in results}

    usual = answers(clean)
    return sum(bool(answers([*clean[:-1], made]) - usual) for made in planted)


def _lint(arm: Arm, episodes: list[Made]) -> object:
    """Return how many episodes have a finding of lerobot-lint, told their units in radians.

    Its checks are called without its loader, which needs the package lerobot.
    """
    try:
        from lerobot_lint.config import load_profile  # no package of this project
        from lerobot_lint.engine import build_episode_check_registry
        from lerobot_lint.types import EpisodeData
    except ImportError:
        return "-"
    registry = build_episode_check_registry(
        load_profile("so101" if len(arm.home) == 6 else "default")
    )
    found = 0
    for made in episodes:
        states, actions = made.state * made.scale, made.action * made.scale
        data = EpisodeData(states, actions, made.times, RATE, "task", {})
        found += bool(registry.run_all(data, 0))
    return found


def main(words: list[str]) -> None:
    """Write, audit and print."""
    if not words:
        raise InvalidInputError("give a folder for the data sets")
    folder, count = make_folder(Path(words[0])), int(words[1]) if len(words) > 1 else 10
    for arm in ARMS:
        print(f"| {arm.name}: fault | planted | found | named | lerobot-doctor | lerobot-lint |")
        for line in measured(folder, arm, count):
            print(f"| {' | '.join(map(str, line))} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
