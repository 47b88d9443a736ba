"""Committed rows and the verdicts on them, read and judged once."""

import pytest

from cvqmpt_lab.paper_tables.claims import judged_claims
from cvqmpt_lab.paper_tables.committed import RESULTS
from cvqmpt_lab.paper_tables.evidence import evidence_below


@pytest.fixture(scope="session")
def committed_evidence():
    return evidence_below(RESULTS)


@pytest.fixture(scope="session")
def committed_claims(committed_evidence):
    return judged_claims(committed_evidence)
