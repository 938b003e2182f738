"""Files that are almost right: trees of JSON with parts dropped, doubled, swapped or replaced.

A mutation is a tuple of small draws, so that hypothesis shrinks to few of them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

quoted = json.encoder.encode_basestring_ascii


class Pairs(list):
    """An object as [key, value] lists, which may hold a key twice."""


@dataclass
class Raw:
    """Words that stand in the text as they are."""

    text: str


@dataclass
class Inside:
    """A text that is JSON itself."""

    tree: Any


JUNK = (
    None, True, False, 0, 1, -1, 2, 0.5, -0.0, 1e-320, 1e308, -1e308, 2**31 - 1, 2**31, -2**31 - 1,
    2**32, 2**53 + 1, 2**63 - 1, 2**63, -2**63 - 1, 2**64, 10**6, 10**9, 10**18, 10**30,
    Raw("NaN"), Raw("Infinity"), Raw("-Infinity"), Raw(".nan"), Raw("-.inf"), Raw("1e999"),
    Raw("9" * 400), Raw("9" * 5000), Raw("010"), Raw("1:30"), Raw("0x10"), Raw("yes"), Raw("~"),
    Raw("*a"), Raw("&a [*a]"), Raw("!!python/name:os.system ''"), Raw("[" * 3000), Raw("{}}"),
    "", " ", "\0", "a\0b", "a\nb", "a\r\nb", "a\x85b", "a\u2028b", "a\u2029b", "\x1b[31m",
    "\ud800", "\u202e", "\ufeff", "A" * 5000, "\U0001f916", "..", "/", "/dev/null", "nan", "A", "*",
    "drone", "no.py:X", "a\0.py:X", "seconds", "AND", "-1", "1e9",
    [], [[]], [0] * 300, Pairs(), Pairs([["", None]]), Pairs([["a\nb", 1]]), Pairs([["\0", []]]),
    [1, 2], [1.5, 2], [-1, -1], [10**9, 10**9], ["A"], ["A"] * 300, [""],
    [str(i) for i in range(99)])

OPERATIONS = ("replace", "replace", "replace", "drop", "double", "many", "swap", "rename", "wrap",
              "graft", "number", "number")
changes = st.lists(st.integers(0, 2**64 - 1), max_size=3)
"""What is done to a tree: the bits of each say which operation, where, and with what."""
harm = st.integers(0, 2**34 - 1)
"""What is done to bytes: nothing to three quarters of them."""


def tree_of(value: Any) -> Any:
    """Plain data as a tree to be mutated."""
    if isinstance(value, dict):
        return Pairs([key, tree_of(inner)] for key, inner in value.items())
    return [tree_of(inner) for inner in value] if isinstance(value, list | tuple) else value


def copied(tree: Any) -> Any:
    """The same again, to be changed."""
    if isinstance(tree, Pairs):
        return Pairs([key, copied(inner)] for key, inner in tree)
    if isinstance(tree, Inside):
        return Inside(copied(tree.tree))
    return [copied(inner) for inner in tree] if isinstance(tree, list) else tree


def written(tree: Any) -> str:
    """JSON, or what is left of it; YAML reads it too."""
    if isinstance(tree, Raw):
        return tree.text
    if isinstance(tree, Inside):
        return json.dumps(written(tree.tree))
    if isinstance(tree, Pairs):
        return "{" + ", ".join([f"{quoted(key)}: {written(v)}" for key, v in tree]) + "}"
    if isinstance(tree, list):
        return "[" + ", ".join([written(inner) for inner in tree]) + "]"
    if isinstance(tree, str):
        return quoted(tree)
    return repr(tree) if type(tree) is int else json.dumps(tree)


def slots(tree: Any) -> list[tuple[list, int]]:
    """Every place of a value, as the list that holds it and where."""
    found: list[tuple[list, int]] = []
    way = [tree]
    while way:
        node = way.pop()
        if isinstance(node, Inside):
            way.append(node.tree)
        elif isinstance(node, Pairs):
            found += [(pair, 1) for pair in node]
            way += [pair[1] for pair in node]
        elif isinstance(node, list):
            found += [(node, i) for i in range(len(node))]
            way += node
    return found


def mutated(tree: Any, changes: list[int]) -> Any:
    """A changed copy."""
    root = [copied(tree)]
    for bits in changes:
        places = slots(root[0])
        if not places:
            break
        bits, operation = divmod(bits, len(OPERATIONS))
        bits, where = divmod(bits, len(places))
        other, junk = divmod(bits, len(JUNK))
        holder, at = places[where]
        _change(root[0], OPERATIONS[operation], holder, at, places[other % len(places)],
                other, JUNK[junk])
    return root[0]


def _change(root: Any, operation: str, holder: list, at: int, second: tuple[list, int],
            number: int, junk: Any) -> None:
    there, place = second
    if operation == "swap":
        holder[at], there[place] = copied(there[place]), copied(holder[at])
    elif operation == "graft":
        holder[at] = copied(there[place])
    elif operation == "replace":
        holder[at] = tree_of(junk)
    elif operation == "wrap":
        holder[at] = [holder[at]] if number % 2 else Pairs([["a", holder[at]]])
    elif operation == "number":
        holder[at] = _like(holder[at], number)
    else:
        _in_group(root, operation, holder, at, number, junk)


def _like(value: Any, number: int) -> Any:
    """A neighbour of a number, or of a word."""
    if not isinstance(value, int | float):
        return str(value)[:number % 9] if isinstance(value, str) else number
    turned = (-value, value + 1, value - 1, value + 0.5, float(value), str(value), bool(value),
              value * 2**(number % 70), value * 10**9, value / 3)
    return turned[number % len(turned)]


def _in_group(root: Any, operation: str, holder: list, at: int, number: int, junk: Any) -> None:
    """Drops, doubles or renames an item of a list or a pair of an object."""
    group = next((g for g in _groups(root) if any(item is holder for item in g)), None) \
        if len(holder) == 2 and isinstance(holder[0], str) and at == 1 else None
    item: Any = holder
    if group is None:
        group, item = holder, holder[at]
    index = next((i for i, one in enumerate(group) if one is item), 0)
    if operation == "drop":
        del group[index]
    elif operation == "rename":
        if isinstance(group, Pairs):
            group[index][0] = junk if isinstance(junk, str) else written(tree_of(junk))[:20]
    else:
        times = 1 if operation == "double" else 2 + number % 40
        group += [[item[0], copied(item[1])] if isinstance(group, Pairs) else copied(item)
                  for _ in range(times)]


def _groups(tree: Any) -> list[Pairs]:
    found: list[Pairs] = []
    way = [tree]
    while way:
        node = way.pop()
        if isinstance(node, Pairs):
            found.append(node)
            way += [pair[1] for pair in node]
        elif isinstance(node, Inside):
            way.append(node.tree)
        elif isinstance(node, list):
            way += node
    return found


def harmed(data: bytes, harm: int) -> bytes:
    """Bytes cut short, flipped, put in, taken out or said again; as they are below 3 * 2**32."""
    if harm < 3 << 32:
        return data
    held = bytearray(data)
    bits, byte = divmod(harm - (3 << 32), 256)
    where, what = divmod(bits, 5)
    at = where % max(1, len(held))
    if what == 0:
        del held[at:]
    elif what == 1:
        held[at:at + 1] = bytes([held[at] ^ (byte or 0xFF)]) if held else b""
    elif what == 2:
        held[at:at] = bytes([byte])
    elif what == 3:
        del held[at:at + 1 + byte]
    else:
        held[at:at] = held[at:at + 1 + byte]
    return bytes(held)


def put(path: Path, data: bytes) -> Path:
    """A new file: to write over one takes the disk a while."""
    path.unlink(missing_ok=True)
    path.write_bytes(data)
    return path
