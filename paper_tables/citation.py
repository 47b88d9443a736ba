"""CITATION.cff, with the version of pyproject.toml and its date in the changelog."""

import re
import tomllib
from pathlib import Path

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import read_text
from cvqmpt_lab.paper_tables.pages import rendered


def citation(root: Path) -> str:
    """Return the text of CITATION.cff; root: folder of the checkout."""
    project = tomllib.loads(read_text(root / "pyproject.toml"))["project"]
    version, description = project["version"], project["description"]
    date = release_date(read_text(root / "CHANGELOG.md"), version)
    return rendered("citation.cff.j2", version=version, description=description, date=date)


def release_date(changelog: str, version: str) -> str:
    """Return the date of a version in the changelog; refuse a version without one."""
    found = re.search(rf"^## \[{re.escape(version)}\] - (\S+)$", changelog, re.MULTILINE)
    if found is None:
        raise InvalidInputError(
            f"CHANGELOG.md has no line '## [{version}] - YYYY-MM-DD' for the version of "
            "pyproject.toml: add it"
        )
    return found[1]
