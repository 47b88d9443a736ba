"""Hypothesis strategies of hostile files: damaged bytes; hostile but well-formed json and xml."""

import copy
import json
import xml.etree.ElementTree as ElementTree

from hypothesis import strategies as st

LIES = (b"999999999999", b"-1", b"0", b"1e300", b"nan", b"4294967295", b"1e-300", b"''", b"null")
PIECES = tuple(b"[|{|]|: |\n- |&a |*a|!!set |\t|#|'|---\n|\xff|\0".split(b"|"))
NASTY = (
    *(None, True, False, [], {}, "", " ", "nan", "x" * 5000, "a\nb\x1b[31m", "\x00", "\ud800"),
    *"../../etc/passwd /etc/passwd /dev/zero ~ =1+1 $(id) file:///etc/passwd 1e3".split(),  # noqa: SIM905
    *(0, -1, 1, 2, 255, 2**31, 2**63, 2**64, 10**400, -(10**18)),
    *(0.0, -0.0, 5e-324, 1e-300, 1e-9, 2e-4, 0.5, 1.0000001, 7.0, 100.0, 1e4, 1e9, 1e300, 1.7e308),
    *(
        [[]],
        [None],
        [0.0] * 3,
        [float("nan")] * 6,
        [[1.0, -1.0]] * 6,
        [0.0] * 2000,
        [[0.0] * 3] * 400,
    ),
    *({"type": "box"}, {"type": []}, {"xyz": [0, 0, 0], "rpy": [0, 0, 0]}, {"_comment": {}}),
)
SCALES = tuple(sign * 10.0**power for power in range(-12, 13) for sign in (1.0, -1.0))
WORDS = (
    *[
        "0",
        "-1",
        "nan",
        "inf",
        "1e308",
        "5e-324",
        "1e-9",
        "100",
        "x",
        "base",
        "tool",
        "é",
        "revolute",
        "prismatic",
        "continuous",
        "fixed",
        "floating",
        "planar",
    ],
    *"../../etc/passwd /etc/passwd file:///etc/passwd package://x/y.stl".split(),  # noqa: SIM905
    *("", "0 0 0", "1 0 0", "0 0 1e300", "1 2", "a b", "x" * 5000),
)
ENTITIES = tuple(
    b'<?xml version="1.0"?><!DOCTYPE r [%s]>' % entities
    for entities in (
        b'<!ENTITY a SYSTEM "file:///etc/passwd">',
        b'<!ENTITY a "&a;">',  # means itself
        b'<!ENTITY a "&b;">'  # ten to the eighth letters
        + b"".join(b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (99 + k) * 10) for k in range(8))
        + b'<!ENTITY j "xxxxxxxxxx">',
    )
)

json_values = st.one_of(
    st.sampled_from(NASTY), st.sampled_from(NASTY), st.floats(), st.integers(), st.text()
)


def rarely(draw, one_in):
    return draw(st.integers(1, one_in)) == one_in


@st.composite
def damaged(draw, content):
    """Bytes with parts changed, cut, doubled, a number replaced, or another format inserted."""
    data = bytearray(content)
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 5)))):
        at, length = draw(st.integers(0, len(data))), draw(st.integers(1, 40))
        change = draw(st.sampled_from(("cut", "double", "end", "change", "number", "piece", "bit")))
        if change == "cut":
            del data[at : at + length]
        elif change == "double":
            data[at:at] = data[at : at + length]
        elif change == "end":
            del data[at:]
        elif change == "change":
            data[at : at + length] = draw(st.binary(min_size=length, max_size=length))
        elif change == "number":
            if digits := [k for k, byte in enumerate(data[:600]) if 48 <= byte <= 57]:
                k = draw(st.sampled_from(digits))
                data[k : k + 1] = draw(st.sampled_from(LIES))
        elif change == "piece":
            data[at:at] = draw(st.sampled_from(PIECES)) * draw(st.sampled_from((1, 1, 1, 300)))
        elif data:
            data[at % len(data)] ^= 1 << draw(st.integers(0, 7))
    return bytes(data)


@st.composite
def hostile_json(draw, content):
    """Json with parts replaced, scaled, removed, repeated or swapped; sometimes damaged bytes."""
    tree = json.loads(content)
    for _ in range(draw(st.integers(1, 3))):
        if not tree:
            break
        holder, key = draw(places(tree))
        change = draw(st.sampled_from((*["replace"] * 3, "scale", "remove", "repeat", "exchange")))
        if change == "remove":
            del holder[key]
        elif change == "scale" and isinstance(holder[key], float):
            holder[key] *= draw(st.sampled_from(SCALES))
        elif change == "repeat" and isinstance(holder, list):
            holder.extend(copy.deepcopy([holder[key]] * draw(st.sampled_from((1, 2, 50)))))
        elif change == "repeat":
            holder[key + "_"] = copy.deepcopy(holder[key])
        elif change == "exchange":
            other, name = draw(places(tree))
            holder[key] = copy.deepcopy(other[name])
        else:
            holder[key] = copy.deepcopy(draw(json_values))
    text = json.dumps(tree)
    if rarely(draw, 20):
        text = text.replace("{", '{"name": 1, "name": 2, ', 1)
    if rarely(draw, 50):
        text = text.replace("[", "[" * 100_000, 1)
    return draw(damaged(text.encode())) if rarely(draw, 10) else text.encode()


@st.composite
def places(draw, tree):
    """A container of the tree and one of its keys: last or second-last step of a random walk."""
    walk, node = [], tree
    while isinstance(node, dict | list) and node:
        key = draw(st.sampled_from(list(node if isinstance(node, dict) else range(len(node)))))
        walk.append((node, key))
        node = node[key]
    return draw(st.sampled_from(walk))


@st.composite
def hostile_xml(draw, content):
    """Xml with changed attributes, elements repeated, removed, moved; entities; damaged bytes."""
    root = ElementTree.fromstring(content)
    for _ in range(draw(st.integers(1, 3))):
        elements = list(root.iter())
        element = draw(st.sampled_from(elements))
        change = draw(st.sampled_from(("set", "set", "unset", "repeat", "remove")))
        if change == "set" and element.attrib:
            element.set(draw(st.sampled_from(list(element.attrib))), draw(st.sampled_from(WORDS)))
        elif change == "unset" and element.attrib:
            del element.attrib[draw(st.sampled_from(list(element.attrib)))]
        elif change == "repeat":
            element.append(copy.deepcopy(draw(st.sampled_from(elements))))
        elif len(element):
            element.remove(element[draw(st.integers(0, len(element) - 1))])
    raw = ElementTree.tostring(root)
    if rarely(draw, 20):
        raw = draw(st.sampled_from(ENTITIES)) + raw.replace(b'name="', b'name="&a;', 1)
    return draw(damaged(raw)) if rarely(draw, 10) else raw
