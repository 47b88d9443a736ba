"""The rule is older than the rows that it judges: it stands in the commit that made them."""

import ast
import subprocess
import tomllib
from datetime import datetime

import pytest

from cvqmpt_lab.benchmarks.results.provenance import sessions
from cvqmpt_lab.paper_tables.committed import RESULTS
from cvqmpt_lab.paper_tables.evidence import read_evidence
from cvqmpt_lab.paper_tables.statements import CLAIMS

RULE = tuple(f"paper_tables/{name}.py" for name in ("rule", "within", "bootstrap"))
FILE = "paper_tables/published/claims.toml"
WORDS = {"title", "sentence", "answers", "remark"}  # of a claim; they decide nothing
SUITES = sorted({suite for claim in CLAIMS for suite in claim.suites})


def git(*words):
    return subprocess.run(
        ("git", *words), cwd=RESULTS.parents[1], capture_output=True, text=True, check=True
    ).stdout


def code(text):
    """Return a module's code without comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node, clean=False
        ):
            node.body = node.body[1:]
    return ast.dump(tree)


def deciding(text, suite):
    """Return the rule of streams, a suite's problems, and what decides each sentence by title."""
    data = tomllib.loads(text)
    claims = {
        item["title"]: {k: v for k, v in item.items() if k not in WORDS} for item in data["claim"]
    }
    return data["streams"], data["problems"][suite], claims


@pytest.mark.parametrize("suite", SUITES)
def test_the_commit_that_made_the_rows_has_this_rule(suite):
    if not (RESULTS.parents[1] / ".git").exists():
        pytest.skip("this copy has no history")
    for session in sessions(read_evidence(RESULTS / suite).record):
        commit = session["git_commit"]
        try:
            made = datetime.fromisoformat(git("show", "-s", "--format=%cI", commit).strip())
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"the history does not reach commit {commit[:12]}: {error}")
        assert made <= datetime.fromisoformat(session["date_utc"])
        for path in RULE:
            now = (RESULTS.parents[1] / path).read_text(encoding="utf-8")
            assert code(git("show", f"{commit}:{path}")) == code(now), path
        now = (RESULTS.parents[1] / FILE).read_text(encoding="utf-8")
        *conditions, claims = deciding(now, suite)
        *earlier, before = deciding(git("show", f"{commit}:{FILE}"), suite)
        assert earlier == conditions
        for title, decides in claims.items():
            if suite in decides["suites"]:
                assert before[title] == decides
