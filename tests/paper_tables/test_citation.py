"""CITATION.cff has the version of pyproject.toml and its date in the changelog."""

import tomllib

import yaml
from refusals import refused

from cvqmpt_lab.paper_tables.citation import citation, release_date
from cvqmpt_lab.paper_tables.committed import README

ROOT = README.parent


def test_the_citation_has_version_and_date_of_the_changelog():
    text = (ROOT / "CITATION.cff").read_text()
    assert text == citation(ROOT)
    cited = yaml.safe_load(text)
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    date = release_date((ROOT / "CHANGELOG.md").read_text(), version)
    assert (cited["version"], str(cited["date-released"])) == (version, date)
    refused(r"has no line '## \[9\.9\.9\] - ", release_date, "## [9.9.8] - 2026-01-01", "9.9.9")
