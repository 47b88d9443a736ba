"""What the project is made of, read from what is installed: the pages of licences and the bill of materials.

`python -m experiments.trust.inventory` writes LICENSES.md and sbom.json (CycloneDX) into the project's folder.
"""

import json
import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageMetadata, metadata, requires, version
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from cvqmpt_lab.files import read_text, write_text
from cvqmpt_lab.models.weights_folder import read_description
from cvqmpt_lab.prediction.weights import SHIPPED, WEIGHTS
from cvqmpt_lab.robot.named import ARMS
from cvqmpt_lab.robot.packages import example_robots

ROOT = Path(__file__).resolve().parents[2]
PROJECT = "cvqmpt-lab"
LICENCES, BILL = "LICENSES.md", "sbom.json"
UNKNOWN = "unknown"
STATED_IN_FILES = {"cmeel-qhull": "Qhull"}
"""Licences that a distribution brings as a file alone (COPYING.txt)."""
CLASSIFIER = "License :: OSI Approved :: "


@dataclass(frozen=True)
class Component:
    """Something that ships or is installed with the project."""

    name: str
    version: str
    licence: str
    """As its maker states it, or `UNKNOWN`."""
    digests: tuple[tuple[str, str], ...] = ()
    """(file, sha256) of what ships with the project itself."""


def closure(wanted: Iterable[Requirement]) -> set[str]:
    """Names of all distributions that requirements pull in here."""
    found: set[tuple[str, tuple[str, ...]]] = set()
    left = [(str(canonicalize_name(r.name)), tuple(sorted(r.extras))) for r in wanted]
    while left:
        item = left.pop()
        if item in found:
            continue
        found.add(item)
        for text in requires(item[0]) or ():
            requirement = Requirement(text)
            markers = ({"extra": extra} for extra in ("", *item[1]))
            if requirement.marker is None or any(requirement.marker.evaluate(m) for m in markers):
                left.append((str(canonicalize_name(requirement.name)), tuple(sorted(requirement.extras))))
    return {name for name, _ in found}


@cache
def distributions() -> tuple[Component, ...]:
    """What planning needs, pulled in by pip, by name."""
    wanted = tomllib.loads(read_text(ROOT / "pyproject.toml"))["project"]["dependencies"]
    names = sorted(closure(map(Requirement, wanted)))
    return tuple(Component(name, version(name), _licence(name, metadata(name))) for name in names)


def _licence(name: str, of: PackageMetadata) -> str:
    """What a distribution says of its licence, in the three places where they say it."""
    stated = "".join(of.get_all("License-Expression") or ())
    short = "".join(of.get_all("License") or ()).strip().splitlines()
    classified = [
        c.removeprefix(CLASSIFIER) for c in of.get_all("Classifier") or () if c.startswith(CLASSIFIER)
    ]
    return (
        stated
        or (short[0] if len(short) == 1 else "")
        or ", ".join(classified)
        or STATED_IN_FILES.get(name, UNKNOWN)
    )


def weights() -> Iterator[Component]:
    """The trained weights that ship, with the hashes that are checked when they are loaded."""
    for name in SHIPPED:
        described = read_description(WEIGHTS / name)
        digests = tuple((f"{part}.safetensors", digest) for part, digest in sorted(described.sha256.items()))
        yield Component(f"weights {name}", version(PROJECT), "MIT", digests)


def robots() -> Iterator[Component]:
    """Descriptions of arms by name: installed with example-robot-data, each under its maker's licence."""
    for name in sorted({arm.urdf.split("/")[0] for arm in ARMS.values()}):
        readme = example_robots() / name / "README.md"
        text = readme.read_text(errors="replace") if readme.is_file() else ""
        stated = re.search(r"(?im)^licen[cs]e:\s*(\S.*)$", text)
        yield Component(name, version("example-robot-data"), stated[1].strip() if stated else UNKNOWN)


def licences_page() -> str:
    """LICENSES.md: without versions, which constraints.txt pins."""
    tables = {
        "This project": (Component("code, tables, documentation", "", "MIT (LICENSE)"), *weights()),
        "Descriptions of robots (from example-robot-data; not copied into this project)": tuple(robots()),
        "Distributions that planning needs": distributions(),
    }
    lines = [
        "# Licences of all that ships or is installed with it",
        "",
        "Made by `python -m experiments.trust.inventory` from what distributions and folders say of themselves.",
        "Weights were trained by this project, on scenes, problems and labels that it generates itself.",
        "The extra `train` adds torch (BSD-3-Clause) and, on Linux, NVIDIA's CUDA libraries under NVIDIA's own terms.",
    ]
    for title, components in tables.items():
        lines += ["", f"## {title}", "", "| what | licence |", "|---|---|"]
        lines += [f"| {component.name} | {component.licence} |" for component in components]
    return "\n".join(lines) + "\n"


def bill_of_materials() -> dict[str, object]:
    """CycloneDX 1.5: distributions with their versions, and the weights with their hashes."""
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {
            "component": {"type": "application", "name": PROJECT, "version": version(PROJECT)},
        },
        "components": [
            *(
                _entry(item, "library", purl=f"pkg:pypi/{item.name}@{item.version}")
                for item in distributions()
            ),
            *(_entry(item, "machine-learning-model") for item in weights()),
            *(_entry(item, "data") for item in robots()),
        ],
    }


def _entry(item: Component, kind: str, **more: object) -> dict[str, object]:
    files = [
        {"type": "file", "name": name, "hashes": [{"alg": "SHA-256", "content": digest}]}
        for name, digest in item.digests
    ]
    entry = {"type": kind, "name": item.name, "version": item.version, **more}
    entry["licenses"] = [{"license": {"name": item.licence}}]
    return entry | ({"components": files} if files else {})


def pinned(constraints: Path = ROOT / "constraints.txt") -> dict[str, str]:
    """Name -> version of constraints.txt."""
    lines = (line.strip() for line in read_text(constraints).splitlines())
    wanted = (Requirement(line) for line in lines if line and not line.startswith("#"))
    return {str(canonicalize_name(r.name)): str(r.specifier).removeprefix("==") for r in wanted}


if __name__ == "__main__":
    write_text(ROOT / LICENCES, licences_page())
    write_text(ROOT / BILL, json.dumps(bill_of_materials(), indent=1) + "\n")
