import json

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.results.provenance import ProvenanceFile, provenance


def test_provenance_names_versions_machine_and_seeds():
    record = provenance(["cvqmpt", "run"], np.arange(3), {"mpnet": "abc"}, 2)
    assert json.loads(json.dumps(record)) == record
    assert record["seeds"] == [0, 1, 2] and record["processes"] == 2
    assert record["weights"] == {"mpnet": "abc"}
    assert record["versions"]["numpy"] == np.__version__
    assert {"pin", "coal", "ompl", "numba", "torch", "rerun-sdk"} < set(record["versions"])
    assert record["cpu_count"] >= 1 and record["date_utc"].endswith("+00:00")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"continued": 3}, "continued is 3"),
        ({"continued": [None]}, r"continued\[0\] is None"),
        ({"git_commit": 7}, "git_commit is 7"),
        ({"weights": {"mpnet": None}}, "weights.mpnet is None"),
        ({"configuration": {"cutoff_s": "10"}}, "cutoff_s is '10'"),
    ],
)
def test_a_record_that_is_not_one_is_refused_by_field(tmp_path, changes, words):
    file = ProvenanceFile(tmp_path)
    file.create({"cutoff_s": 10.0}, provenance(["cvqmpt"], [0], {"mpnet": "abc"}))
    file.path.write_text(json.dumps(file.read() | changes))
    refused(rf"provenance.json: {words}", file.read)
