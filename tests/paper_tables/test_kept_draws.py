"""Results of draws that are kept on disk are those of the rule."""

import numpy as np
import pytest

from cvqmpt_lab.paper_tables import kept_draws
from cvqmpt_lab.paper_tables.kept_draws import kept_effects, kept_within
from cvqmpt_lab.paper_tables.rule import Effect
from cvqmpt_lab.paper_tables.within import solved_within

LEVEL, LIMIT = 0.05, 2.0


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "cvqmpt_lab"


@pytest.fixture
def sides():
    """Costs (2, 60) of a planner and a baseline; in the second line the planner solves 8."""
    own, other = np.exp(np.random.default_rng(0).normal(size=(2, 60)))
    return np.array([own, np.where(np.arange(60) < 8, own, np.nan)]), np.array([other, other])


def test_they_are_those_of_the_rule_made_and_read_again(sides, monkeypatch):
    """With and without an interval, and None for too few problems."""
    own, other = sides
    few = own[:, :9], other[:, :9]
    effects = Effect.of_prices(own, other, LEVEL), Effect.of_prices(*few, LEVEL)
    shares = [solved_within(*pair, LIMIT, LEVEL) for pair in zip(own, other, strict=True)]
    assert effects[0][0].parts and effects[0][1].means.low is None and shares[0] != shares[1]
    for drawn in (True, False):
        if not drawn:
            monkeypatch.delattr(Effect, "of_prices")
            monkeypatch.delattr(kept_draws, "solved_within")
        assert (kept_effects(own, other, LEVEL), kept_effects(*few, LEVEL)) == effects
        for *pair, known in zip(own, other, shares, strict=True):
            assert kept_within(*pair, LIMIT, LEVEL) == known
        assert kept_within(few[0][0], few[1][0], LIMIT, LEVEL) is None


@pytest.mark.parametrize("changed", ["value", "level", "limit", "source code"])
def test_what_a_result_depends_on_makes_it_again(sides, cache, tmp_path, monkeypatch, changed):
    (own, _), (other, _) = sides
    limit, level = LIMIT, LEVEL
    kept_within(own, other, limit, level)
    if changed == "value":
        own[7] *= 2.0
    elif changed == "source code":
        (tmp_path / "rule.py").write_text("LEVEL = 0.01\n")
        monkeypatch.setattr(kept_draws, "SOURCES", (tmp_path / "rule.py",))
    else:
        limit, level = (LIMIT, 0.01) if changed == "level" else (1.0, LEVEL)
    assert kept_within(own, other, limit, level) == solved_within(own, other, limit, level)
    assert len([*(cache / "within").iterdir()]) == 2
