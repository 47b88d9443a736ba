"""Tables of motions as loggers write them: separators, columns, and the unit of the times."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab import Motion, PlanningProblem, Scene, judge
from cvqmpt_lab.features.motion.trajectory import read_motion

TIMES = [0.0, 0.004, 0.012]
STATES = [[0.1, -1.5], [0.25, -1.0], [0.5, 2.0]]
ROWS = [[t, *q] for t, q in zip(TIMES, STATES, strict=True)]


def text(header, separator, scale=1.0, comma=False):
    """The table of ROWS with times multiplied by `scale`."""
    rows = [separator.join(repr(x) for x in (t * scale, *q)) for t, *q in ROWS]
    if comma:
        rows = [row.replace(".", ",") for row in rows]
    return "\n".join([separator.join(header), *rows]) + "\n"


PLAIN = ["time", "first", "second"]
READ = {
    "semicolons": text(PLAIN, ";"),
    "decimal commas": text(PLAIN, ";", comma=True),
    "blanks": text(PLAIN, "  "),
    "tabs": text(PLAIN, "\t"),
    "decimal commas between tabs": text(PLAIN, "\t", comma=True),
    "a commented header": "# " + text(PLAIN, ","),
    "quotes": text(['"time"', '"first"', '"second"'], " "),
    "milliseconds": text(["time_ms", *PLAIN[1:]], ",", 1e3),
    "microseconds in brackets": text(["t [us]", *PLAIN[1:]], ",", 1e6),
    "nanoseconds": text(["timestamp_ns", *PLAIN[1:]], ";", 1e9),
    "seconds": text(["Time (s)", *PLAIN[1:]], ","),
    "an underlined name": text(["__time", *PLAIN[1:]], ","),
}


@pytest.mark.parametrize("kind", READ)
def test_tables_of_loggers_are_read(tmp_path, kind):
    file = tmp_path / "a.csv"
    file.write_text(READ[kind])
    motion = read_motion(file)
    assert motion.joint_names == ("first", "second")
    np.testing.assert_allclose(motion.times, TIMES, rtol=1e-12)
    np.testing.assert_array_equal(motion.positions, STATES)
    assert motion.in_seconds == ("seconds" in kind)


@pytest.mark.parametrize(
    ("name", "begin", "left"), [("", 0, True), ("Unnamed: 0", 1, True), ("", None, False)]
)
def test_a_column_that_counts_rows_is_left_out_with_a_note(tmp_path, caplog, name, begin, left):
    head, *rows = text(PLAIN, ",").splitlines()
    counts = [0.5, 2.0, 9.0] if begin is None else range(begin, begin + 3)
    lines = [f"{count},{row}" for count, row in zip(counts, rows, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join([f"{name},{head}", *lines]))
    names = read_motion(tmp_path / "a.csv").joint_names
    assert names == (("first", "second") if left else ("", "first", "second"))
    assert ("it is left out" in caplog.text) == left


def test_recordings_of_rtde_are_positions_in_the_order_of_joints(tmp_path, caplog):
    columns = ["timestamp", "target_q_0", "target_q_1", "actual_q_0", "actual_q_1", "robot_mode"]
    rows = [[1.7e9 + t, 9.0, 9.0, *q, 7] for t, *q in ROWS]
    lines = [" ".join(columns), *(" ".join(map(str, row)) for row in rows)]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    motion = read_motion(tmp_path / "a.csv")
    assert motion.joint_names is None and motion.in_seconds
    np.testing.assert_array_equal(motion.positions, STATES)
    np.testing.assert_allclose(motion.times - motion.times[0], TIMES, atol=1e-6)
    assert "left out: target_q_0, target_q_1, robot_mode" in caplog.text


def test_what_is_no_table_names_the_separators(tmp_path):
    (tmp_path / "a.csv").write_text("time,first\n0 0.1\n1 0.2\n")
    refused("columns separated by commas, semicolons or blanks", read_motion, tmp_path / "a.csv")


@pytest.fixture(scope="module")
def swing(panda):
    """A motion of positions alone at 0.3 of the velocity limit; and its problem."""
    times = np.linspace(0.0, 0.4, 51)
    positions = np.tile([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], (51, 1))
    positions[:, 5] += 0.1 * (1.0 - np.cos(np.pi * times / 0.4))
    problem = PlanningProblem("swing", panda, Scene("empty", ()), positions[0], positions[-1:])
    return Motion(panda.joint_names, positions, times), problem


@pytest.mark.parametrize(
    ("scale", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_times_in_other_units_are_asked_for(swing, scale, unit):
    motion, problem = swing
    assert judge(motion, problem).certified
    other = Motion(motion.joint_names, motion.positions, scale * motion.times)
    refused(rf"are its times in ({unit}|.* or {unit})\? Give seconds.*time_", judge, other, problem)


def test_slow_motions_in_seconds_are_judged(swing):
    """A file may say that its times are seconds; parts of a motion may hardly move."""
    motion, problem = swing
    slow = (motion.joint_names, motion.positions, 1e3 * motion.times)
    assert judge(Motion(*slow, in_seconds=True), problem).certified
    assert judge(motion.at_speed(1e-3), problem).certified
    still = np.tile(motion.positions[:1], (2, 1))
    still_problem = problem.changed(goals=still[:1])
    assert judge(Motion(motion.joint_names, still, [0.0, 5.0]), still_problem).certified


def test_velocities_of_other_times_are_asked_for(swing):
    motion, problem = swing
    v = np.gradient(motion.positions, motion.times, axis=0)
    judge(Motion(motion.joint_names, motion.positions, motion.times, v), problem)
    other = Motion(motion.joint_names, motion.positions, 1e3 * motion.times, v)
    refused(r"1e\+03 times as far .* in milliseconds\? Give seconds", judge, other, problem)


def test_a_first_column_without_a_name_may_be_the_time(swing):
    motion, problem = swing
    table = np.column_stack([motion.times, motion.positions])
    refused("is the first one the time.*header time,panda_j", judge, Motion(None, table), problem)
