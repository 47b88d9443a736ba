"""Descriptions for machines: files as they are, how each was made, readers of both formats."""

import hashlib
import json
import tomllib

import pytest
import yaml
from refusals import refused

from cvqmpt_lab.paper_tables.committed import README, RESULTS, committed_directories
from cvqmpt_lab.paper_tables.metadata import release_date

ROOT = README.parent
CROISSANT = json.loads((ROOT / "croissant.json").read_text())
CRATE = json.loads((ROOT / "ro-crate-metadata.json").read_text())["@graph"]


def test_every_file_of_the_results_has_its_size_and_digest_and_says_how_it_was_made():
    kinds = (".csv", ".json", ".md", ".tex")
    paths = {path for path in RESULTS.glob("*/*") if path.suffix in kinds}
    crate = {item["@id"]: item for item in CRATE if item["@type"] == "File"}
    listed = {item["@id"]: item for item in CROISSANT["distribution"]}
    assert crate.keys() == listed.keys() == {path.relative_to(ROOT).as_posix() for path in paths}
    for path in paths:
        data, name = path.read_bytes(), path.relative_to(ROOT).as_posix()
        for item in (crate[name], listed[name]):
            assert item["sha256"] == hashlib.sha256(data).hexdigest()
            assert item["contentSize"] == f"{len(data)} B"
        assert (
            "`cvqmpt " in listed[name]["description"] and "commit " in listed[name]["description"]
        )


def test_every_table_names_its_sessions_and_the_crate_has_an_action_for_each():
    made = {item["result"]["@id"]: item for item in CRATE if item["@type"] == "CreateAction"}
    known = {item["@id"] for item in CRATE}
    for folder in committed_directories():
        action = made[f"{folder.relative_to(ROOT).as_posix()}/"]
        assert action["name"].startswith("cvqmpt ") and ", machine " in action["description"]
        assert {action["result"]["@id"], action["instrument"]["@id"]} <= known
        if (folder / "table.md").is_file():
            text = (folder / "table.md").read_text()
            assert f"- {action['description']}\n" in text.partition("## Sessions that made")[2]


def test_the_citation_has_version_and_date_of_the_changelog():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    date = release_date((ROOT / "CHANGELOG.md").read_text(), version)
    assert (cited["version"], str(cited["date-released"])) == (version, date)
    assert CROISSANT["version"] == version and CROISSANT["datePublished"] == date
    refused(r"has no line '## \[9\.9\.9\] - ", release_date, "## [9.9.8] - 2026-01-01", "9.9.9")


def test_a_reader_of_croissant_loads_rows():
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = mlcroissant.Dataset(jsonld=str(ROOT / "croissant.json"))
    assert not dataset.metadata.ctx.issues.errors
    row = next(iter(dataset.records(record_set="runs-peers")))
    assert isinstance(row["runs-peers/solved"], bool)


def test_a_reader_of_ro_crate_finds_the_folders():
    crate = pytest.importorskip("rocrate.rocrate").ROCrate(str(ROOT))
    folders = [item.id for item in crate.root_dataset["hasPart"] if item.type == "Dataset"]
    assert [f"{path.relative_to(ROOT)}/" for path in committed_directories()] == folders
