"""Hypothesis strategies of hostile files: damaged bytes; hostile but well-formed json and xml."""

import copy
import json
import xml.etree.ElementTree as ElementTree
from functools import partial

from hypothesis import strategies as st

LIES = (b"999999999999", b"-1", b"0", b"1e300", b"nan", b"4294967295", b"1e-300", b"''", b"null")
PIECES = tuple(b"[|{|]|: |\n- |&a |*a|!!set |\t|#|'|---\n|\xff|\0".split(b"|"))
TEXTS = "../../etc/passwd /etc/passwd /dev/zero file:///etc/passwd package://x/y.stl"
NUMBERS = "0 -1 nan inf 1e308 5e-324 1e-9 100"
KINDS = "x base tool é revolute prismatic continuous fixed floating planar"
LONG = "x" * 5000
WORDS = (*f"{TEXTS} {NUMBERS} {KINDS}".split(), "", "0 0 0", "1 0 0", "0 0 1e300", "1 2", LONG)
VALUES = (
    *(None, True, False, [], {}, "", " ", LONG, "a\nb\x1b[31m", "\x00", "\ud800", "~", "$(id)"),
    *(*TEXTS.split(), *map(float, NUMBERS.split()), -0.0, 2e-4, 1.0000001, 1e4, 1e9, 1.7e308),
    *(1, 2, 255, 2**31, 2**63, 2**64, 10**400, -(10**18), [[]], [None], [0.0] * 3, [0.0] * 2000),
    *([float("nan")] * 6, [[1.0, -1.0]] * 6, [[0.0] * 3] * 400, {"type": "box"}, {"type": []}),
    *({"xyz": [0, 0, 0], "rpy": [0, 0, 0]}, {"_comment": {}}),
)
BOMB = b"".join(b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (99 + k) * 10) for k in range(8))
ENTITIES = tuple(
    b'<?xml version="1.0"?><!DOCTYPE r [%s]>' % entities
    for entities in (
        b'<!ENTITY a SYSTEM "file:///etc/passwd">',
        b'<!ENTITY a "&a;">',  # means itself
        b'<!ENTITY a "&b;">' + BOMB + b'<!ENTITY j "xxxxxxxxxx">',  # ten to the eighth letters
    )
)
SCALES = st.builds(
    lambda sign, power: sign * 10.0**power, st.sampled_from((1, -1)), st.integers(-12, 12)
)
json_values = st.sampled_from(VALUES) | st.sampled_from(VALUES) | st.floats() | st.text()


def rarely(usual, rare, one_in):
    """A strategy that sometimes draws from another one."""
    return st.integers(1, one_in).flatmap(lambda k: rare if k == one_in else usual)


def damaged(content):
    """Bytes with up to five parts removed, doubled or changed; numbers replaced; or truncated."""
    digits = [k for k, byte in enumerate(content[:600]) if 48 <= byte <= 57] or [0]
    places = st.integers(0, len(content))
    pieces = st.builds(bytes.__mul__, st.sampled_from(PIECES), st.sampled_from((1, 1, 1, 300)))
    stretch = st.tuples(places, st.integers(0, 40), st.none() | pieces | st.binary(max_size=40))
    number = st.tuples(st.sampled_from(digits), st.just(1), st.sampled_from(LIES))
    changes = st.lists(stretch | number, min_size=1, max_size=5)
    return changes.map(partial(spliced, content)) | places.map(lambda end: content[:end])


def spliced(content, changes):
    """Bytes with parts (start, length, new) replaced; a part is doubled if `new` is None."""
    data = bytearray(content)
    for at, length, new in changes:
        data[at : at + length] = 2 * data[at : at + length] if new is None else new
    return bytes(data)


@st.composite
def hostile_json(draw, content):
    """Json with parts replaced, scaled, removed, repeated or exchanged; sometimes damaged bytes."""
    tree = json.loads(content)
    for _ in range(draw(st.integers(1, 3))):
        if not tree:
            break
        (holder, key), (other, name) = draw(places(tree)), draw(places(tree))
        change = draw(st.sampled_from((*["replace"] * 3, "scale", "remove", "repeat", "exchange")))
        if change == "remove":
            del holder[key]
        elif change == "scale" and isinstance(holder[key], float):
            holder[key] *= draw(SCALES)
        elif change == "repeat" and isinstance(holder, list):
            holder.extend(copy.deepcopy([holder[key]] * draw(st.sampled_from((1, 2, 50)))))
        elif change == "repeat":
            holder[key + "_"] = copy.deepcopy(holder[key])
        else:
            new = other[name] if change == "exchange" else draw(json_values)
            holder[key] = copy.deepcopy(new)
    text = json.dumps(tree)
    twice, deep = ('{"name": 1, "name": 2, ', "{"), ("[" * 100_000, "[")
    new, old = draw(rarely(st.just(("", "")), st.sampled_from((twice, deep)), 30))
    raw = text.replace(old, new, 1).encode()
    return draw(rarely(st.just(raw), damaged(raw), 10))


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
    meant = raw.replace(b'name="', b'name="&a;', 1)
    raw = draw(rarely(st.just(raw), st.sampled_from(ENTITIES).map(lambda head: head + meant), 20))
    return draw(rarely(st.just(raw), damaged(raw), 10))
