"""Comparison of two runs: pairs, intervals, and runs without a partner."""

import pytest
from made_rows import a_failure, a_results_folder, a_row
from refusals import refused

from cli.main import main
from paper_tables.compare_runs import clear, compared


def run(time, solved=range(20), planner="birrt"):
    """Rows of 20 problems with two seeds."""
    runs = [(k, {"seed": seed}) for k in range(20) for seed in (0, 1)]
    return [
        a_row(f"p{k}", planner, **seed, t_total_s=time * (1 + 0.01 * k), path_length_rad=5.0)
        if k in solved
        else a_failure(f"p{k}", planner, **seed, t_total_s=9.0)
        for k, seed in runs
    ]


def test_a_change_is_told_with_its_interval_and_equal_numbers_are_no_change():
    (found,) = compared(run(1.0), run(0.5))
    assert found.pairs == 40 and found.changes["time"].estimate == pytest.approx(0.5)
    assert found.changes["length"].estimate == 0.0 and found.changes["time"].n == 20
    assert clear([found]) == ["birrt: less time, −50.0 [−50.0, −50.0] %"]
    assert clear(compared(run(1.0), run(1.0))) == []


def test_runs_of_one_alone_are_left_out_and_counted():
    (found,) = compared(run(1.0, range(1, 20))[:10], [*run(0.5)[4:], a_row("p99")])
    assert found.pairs == 6 and found.left_out == (4, 31) and found.solved[0].estimate == 100.0
    assert found.changes["time"].estimate == pytest.approx(0.5)


def test_runs_gained_and_lost_are_named():
    (found,) = compared(run(1.0, range(1, 20)), run(1.0, range(19)))
    assert found.gained == (("p0", 0), ("p0", 1)) and found.lost == (("p19", 0), ("p19", 1))
    assert "birrt: lost 2: problem p19 seed 0, problem p19 seed 1" in clear([found])
    assert found.changes["time"].n == 18


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ([a_row("p99")], "no run in common: A has problem p0 seed 0, problem p0 seed 1"),
        (run(1.0, planner="mpnet"), "no planner in common: A has birrt, B has mpnet"),
        ([a_row(suite="sensor")], "runs of place do not pair with runs of sensor"),
    ],
)
def test_runs_that_do_not_pair_are_refused_by_name(other, says):
    refused(says, compared, run(1.0), other)


def test_the_command_compares_two_directories(capsys, tmp_path):
    folders = [str(tmp_path / name / "place-task") for name in "ab"]
    for name, time in (("a", 1.0), ("b", 0.5)):
        (tmp_path / name).mkdir()
        a_results_folder(tmp_path / name, birrt=time)
    assert main(["compare", *folders]) == 0
    out = capsys.readouterr().out
    assert "birrt: less time, −50.0" in out and "birrt: less work" in out
    assert main(["compare", str(tmp_path), folders[1]]) == 2
