"""The page of an audit: one file with the table, distributions, and what its player needs."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from data_sets import episode, table_of, write_set

from cvqmpt_lab.features.audit.judging import Settings
from cvqmpt_lab.features.audit.page import MOST_PLAYED, TEMPLATE, write_page
from cvqmpt_lab.features.audit.run import audit

SETTINGS = Settings({"name": "so-arm101"}, "degrees")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Return the text of a page of three episodes, of which one is refused, and its data."""
    folder = tmp_path_factory.mktemp("page")
    wrong = episode(1)
    wrong[30, 2] += 30.0
    root = write_set(folder / "<b>", [table_of(episode(0)), table_of(wrong, 1)])
    (root / "data" / "chunk-000" / "file-001.parquet").write_bytes(b"broken")
    rows = audit(root, SETTINGS)
    write_page(folder / "a.html", root, rows, SETTINGS)
    text = (folder / "a.html").read_text()
    (data,) = re.findall(r'id="data">(.*?)</script>', text, re.DOTALL)
    return text, json.loads(data)


def test_a_page_has_rows_and_episodes_and_loads_nothing(page):
    text, data = page
    template = TEMPLATE.read_text().replace("http://www.w3.org", "")  # a name, not an address
    assert len(text) < 1_500_000 and "<b>" not in text and "://" not in template
    assert [row["verdict"] for row in data["rows"]] == ["refused", "not read", "certified"]
    assert {*data["played"]} == {row["name"] for row in data["rows"] if row["states"]}
    played = data["played"][data["rows"][0]["name"]]
    assert played["states"] == 60 and len(played["mesh_places"]) >= 10
    assert max(played["mesh_places"]) < len(data["meshes"])
    assert {bar["name"] for bar in data["distributions"]} >= {"position", "velocity", "self mm"}
    assert sum(data["distributions"][0]["counts"]) == 2 and MOST_PLAYED == 20
    assert np.isfinite([bar["top"] for bar in data["distributions"]]).all()


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_a_click_gives_the_viewer_its_page(page, tmp_path):
    """The script runs; a click makes a page of the viewer that has the episode's data."""
    (tmp_path / "page.html").write_text(page[0])
    script = tmp_path / "click.js"
    script.write_text(CLICK)
    done = subprocess.run(
        ["node", script, tmp_path / "page.html"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["rows"] == 3 and told["states"] == 60 and told["meshes"] >= 10


CLICK = r"""
const fs = require("fs"), page = fs.readFileSync(process.argv[2], "utf8");
const parts = [...page.matchAll(/<script[^>]*>([^]*?)<\/script>/g)].map(found => found[1]);
class Element {
  constructor() {
    const classList = {add() {}, remove() {}};
    Object.assign(this, {children: [], style: {}, textContent: "", classList});
  }
  append(...children) { this.children.push(...children); }
  setAttribute() {}
  scrollIntoView() {}
}
const elements = {}, byName = id => elements[id] ??= new Element(), made = () => new Element();
byName("data").textContent = parts[0];
const all = {querySelectorAll: () => []};
globalThis.document = {getElementById: byName, createElement: made, createElementNS: made, ...all};
(0, eval)(parts[1]);
const rows = byName("rows").children;
rows[0].onclick();
const text = byName("viewer").srcdoc;
const inner = JSON.parse(text.match(/id="data">([^]*?)<\/script>/)[1]);
const told = {rows: rows.length, states: inner.states, meshes: inner.meshes.length};
console.log(JSON.stringify(told));
"""
