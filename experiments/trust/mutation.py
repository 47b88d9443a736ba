"""Hostile variants of good files: bytes that are damaged, json and xml that are well formed and mean harm."""

import copy
import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from typing import Any

import numpy as np

Rng = np.random.Generator
LIES = (b"999999999999", b"-1", b"0", b"1e300", b"nan", b"4294967295", b"1e-300", b"''", b"null")
PIECES = (
    b"[",
    b"{",
    b"]",
    b": ",
    b"\n- ",
    b"&a ",
    b"*a",
    b"!!set ",
    b"\t",
    b"#",
    b"'",
    b"---\n",
    b"\xff",
    b"\0",
)
NASTY: tuple[Any, ...] = (
    *(None, True, False, [], {}, "", " ", "nan", "x" * 5000, "a\nb\x1b[31m", "\x00", "\ud800"),
    *("../../etc/passwd", "/etc/passwd", "/dev/zero", "~", "=1+1", "$(id)", "file:///etc/passwd", "1e3"),
    *(0, -1, 1, 2, 255, 2**31, 2**63, 2**64, 10**400, -(10**18)),
    *(0.0, -0.0, 5e-324, 1e-300, 1e-9, 2e-4, 0.5, 1.0000001, 7.0, 100.0, 1e4, 1e9, 1e300, 1.7e308),
    *(float("nan"), float("inf"), float("-inf")),
    *([[]], [None], [0.0] * 3, [float("nan")] * 6, [[1.0, -1.0]] * 6, [0.0] * 2000, [[0.0] * 3] * 400),
    *(
        {"type": "box"},
        {"type": []},
        {"xyz": [0, 0, 0], "rpy": [0, 0, 0]},
        {"_comment": {}},
        {"name": "panda"},
    ),
)
"""What stands in place of a part of a json file."""
WORDS = (
    *(
        "",
        "0",
        "-1",
        "nan",
        "inf",
        "1e308",
        "5e-324",
        "1e-9",
        "100",
        "0 0 0",
        "1 0 0",
        "0 0 1e300",
        "1 2",
        "x",
    ),
    *("base", "tool", "../../etc/passwd", "/etc/passwd", "file:///etc/passwd", "package://x/y.stl"),
    *("revolute", "prismatic", "continuous", "fixed", "floating", "planar", "a b", "é", "x" * 5000),
)
"""What stands in place of a value of an xml file."""


def damaged(content: bytes, rng: Rng) -> bytes:
    """The bytes with some changed, cut out, doubled, lied about, or a word of another format put in."""
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        at = int(rng.integers(len(data) + 1))
        length = int(rng.integers(1, 40))
        change = rng.integers(7)
        if change == 0:
            data[at : at + length] = rng.bytes(length)
        elif change == 1:
            del data[at : at + length]
        elif change == 2:
            data[at:at] = data[at : at + length]
        elif change == 3:
            data = data[:at]
        elif change == 4:
            digits = [k for k in range(min(len(data), 600)) if 48 <= data[k] <= 57]
            if digits:
                k = digits[rng.integers(len(digits))]
                data[k : k + 1] = LIES[rng.integers(len(LIES))]
        elif change == 5:
            data[at:at] = PIECES[rng.integers(len(PIECES))] * int(rng.choice([1, 1, 1, 300]))
        elif len(data):
            data[at % len(data)] ^= 1 << int(rng.integers(8))
    return bytes(data)


def hostile_json(data: bytes, rng: Rng) -> bytes:
    """Json with a few parts replaced, left out, repeated, exchanged or nested, and sometimes damaged bytes."""
    tree = json.loads(data)
    for _ in range(rng.integers(1, 4)):
        places = list(_places(tree, rng))
        if not places:
            break
        holder, key = places[rng.integers(len(places))]
        CHANGES[rng.integers(len(CHANGES))](holder, key, places, rng)
    text = json.dumps(tree)
    if rng.random() < 0.05:
        text = text.replace("{", '{"name": 1, "name": 2, ', 1)
    if rng.random() < 0.02:
        text = text.replace("[", "[" * 100_000, 1)
    raw = text.encode()
    return damaged(raw, rng) if rng.random() < 0.1 else raw


def _places(tree: Any, rng: Rng) -> list[tuple[Any, Any]]:
    """Containers with one of their keys: a random walk from the top each, so that no large list crowds others out."""
    found = []
    for _ in range(8):
        node = tree
        while isinstance(node, dict | list) and len(node):
            keys = list(node) if isinstance(node, dict) else range(len(node))
            key = keys[rng.integers(len(keys))]
            found.append((node, key))
            node = node[key]
    return found


def _replace(holder: Any, key: Any, places: Any, rng: Rng) -> None:
    holder[key] = copy.deepcopy(NASTY[rng.integers(len(NASTY))])


def _scale(holder: Any, key: Any, places: Any, rng: Rng) -> None:
    if isinstance(holder[key], float | int) and abs(holder[key]) < 1e300:
        holder[key] = holder[key] * float(10.0 ** rng.integers(-12, 13)) * float(rng.choice([-1.0, 1.0]))


def _remove(holder: Any, key: Any, places: Any, rng: Rng) -> None:
    if key in holder if isinstance(holder, dict) else key < len(holder):
        del holder[key]


def _repeat(holder: Any, key: Any, places: Any, rng: Rng) -> None:
    if isinstance(holder, list) and len(holder) < 10_000:
        holder.extend(copy.deepcopy([holder[key]] * int(rng.choice([1, 2, 50]))))
    elif isinstance(holder, dict):
        holder[str(key) + "_"] = copy.deepcopy(holder[key])


def _exchange(holder: Any, key: Any, places: list[tuple[Any, Any]], rng: Rng) -> None:
    other, name = places[rng.integers(len(places))]
    holder[key] = copy.deepcopy(other[name])


CHANGES: tuple[Callable[[Any, Any, list[tuple[Any, Any]], Rng], None], ...] = (
    *(_replace, _replace, _replace, _scale, _scale, _remove, _repeat, _exchange),
)


def hostile_xml(data: bytes, rng: Rng) -> bytes:
    """Xml with attributes changed and elements repeated, left out or moved; entities; sometimes damaged bytes."""
    root = ElementTree.fromstring(data)
    for _ in range(rng.integers(1, 4)):
        elements = list(root.iter())
        element = elements[rng.integers(len(elements))]
        change = rng.integers(5)
        if change <= 1 and element.attrib:
            key = list(element.attrib)[rng.integers(len(element.attrib))]
            element.set(key, WORDS[rng.integers(len(WORDS))])
        elif change == 2 and element.attrib:
            del element.attrib[list(element.attrib)[rng.integers(len(element.attrib))]]
        elif change == 3 and len(element):
            element.append(copy.deepcopy(elements[rng.integers(len(elements))]))
        elif len(element):
            element.remove(element[rng.integers(len(element))])
    raw = ElementTree.tostring(root)
    if rng.random() < 0.05:
        raw = ENTITIES[rng.integers(len(ENTITIES))] + raw.replace(b'name="', b'name="&a;', 1)
    return damaged(raw, rng) if rng.random() < 0.1 else raw


_NESTED = b"".join(b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (97 + k + 2) * 10) for k in range(8))
ENTITIES = (
    b'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]>',
    b'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "&b;">' + _NESTED + b'<!ENTITY j "xxxxxxxxxx">]>',
    b'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "&a;">]>',
)
"""A file from elsewhere, ten to the eighth letters, and one that means itself."""
