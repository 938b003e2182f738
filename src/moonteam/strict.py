"""JSON and YAML as people write them, read so that nothing turns into something else unsaid.

Plain data only. Refused, each in one line: a key given twice, of which one would be lost; numbers
that are not finite; whole numbers that YAML 1.1 takes for octal (010) or for minutes (1:30), which
stay text, as do yes, no and dates; nesting too deep to be read, and aliases that stand for too
much of it; halves of a character; more text than is worth reading.
"""

from __future__ import annotations

import json
import math
import re
from typing import Any

import yaml

from moonteam.errors import InputError

MOST_NODES = 2_000_000
"""Values of a YAML file with each of its aliases written out."""
MOST_JSON = 16 << 20
"""Characters of a JSON text, such as a line of a set: it takes ten times as many bytes."""
MOST_YAML = 1 << 19
"""Characters of a YAML text: some ten seconds of reading."""
MOST_DEEP = 64
"""Lists and mappings inside each other, in YAML."""
DEEP = "is nested too deeply"
HALF = "holds half a character (\\ud800 to \\udfff)"
_HALF = re.compile("[\ud800-\udfff]")
_HALVES = re.compile(r"\\u[dD][89a-fA-F]")
_INT = re.compile(r"[-+]?(?:0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")


class _Refused(ValueError):
    """Something that JSON's grammar allows."""


def json_value(text: str, source: object, where: str = "") -> Any:
    """The value of a JSON text. Raises InputError with `where`, or the line and column."""
    _check_length(text, MOST_JSON, source, where)
    try:
        value = json.loads(text.removeprefix("\ufeff"), object_pairs_hook=_once,
                           parse_constant=_no_constant, parse_float=_finite, parse_int=_whole)
        if _HALVES.search(text):
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except UnicodeEncodeError:
        raise InputError(source, HALF, where) from None
    except json.JSONDecodeError as error:
        place = f"column {error.colno}" if where else f"line {error.lineno}, column {error.colno}"
        raise InputError(source, f"is not JSON: {error.msg} ({place})", where) from None
    except _Refused as error:
        raise InputError(source, str(error), where) from None
    except RecursionError:
        raise InputError(source, DEEP, where) from None


def _check_length(text: str, most: int, source: object, where: str = "") -> None:
    if len(text) > most:
        raise InputError(source, f"is too long: {len(text):,} characters; at most {most:,}", where)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise _Refused(f"key {twice!r} is given twice")
    return found


def _no_constant(word: str) -> Any:
    raise _Refused(f"{word} is no number of JSON; a finite one is needed")


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise _Refused(f"the number {_short(text)} is too large")
    return value


def _whole(text: str) -> int:
    _finite(text)  # what no float holds fails wherever it is reckoned with
    return int(text)


def _short(text: str) -> str:
    return text if len(text) <= 20 else f"{text[:12]}..., {len(text)} characters"


class _Loader(yaml.SafeLoader):
    """Numbers, truth values and null as in the core schema of YAML 1.2; all else is text.

    Depth is bounded where it begins: a token costs PyYAML as much as there are brackets about it.
    """

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:
        if self.flow_level >= MOST_DEEP:
            raise RecursionError
        super().fetch_flow_collection_start(TokenClass)

    def add_indent(self, column: int) -> bool:
        if len(self.indents) >= MOST_DEEP:
            raise RecursionError
        return super().add_indent(column)


_Loader.yaml_implicit_resolvers = {}  # its own, to be filled below


def _constructor(kind: str, what: str, pattern: re.Pattern[str], make: Any) -> None:
    def construct(loader: _Loader, node: yaml.ScalarNode) -> Any:
        text = str(loader.construct_scalar(node))
        try:
            if pattern.fullmatch(text):
                return make(text)
            problem = f"{_short(text)!r} is no {what}"
        except _Refused as error:
            problem = str(error)
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)

    _Loader.add_constructor(f"tag:yaml.org,2002:{kind}", construct)


_constructor("int", "whole decimal number", _INT, _whole)
_constructor("float", "finite number", _FLOAT, _finite)
# Infinities and what is no number are recognised, to be refused where they stand.
_ODD = r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
for _tag, _pattern, _first in (
        ("bool", "true|True|TRUE|false|False|FALSE", [*"tTfF"]),
        ("null", "~|null|Null|NULL|", [*"~nN", ""]),
        ("int", _INT.pattern, [*"-+0123456789"]),
        ("float", f"{_FLOAT.pattern}|{_ODD}", [*"-+.0123456789"]),
        ("merge", "<<", ["<"])):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"),
                                  _first)


def yaml_value(text: str, source: object) -> Any:
    """The value of a YAML text, None if it is empty. Raises InputError with the line."""
    _check_length(text, MOST_YAML, source)
    loader = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _check(node)
        return loader.construct_document(node)
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", error)
        raise InputError(source, f"is not YAML: {problem}{line_of(error)}") from None
    except RecursionError:
        raise InputError(source, DEEP) from None
    finally:
        if loader is not None:
            loader.dispose()


def line_of(error: yaml.YAMLError) -> str:
    """Where it is, in words to put behind others; empty if it does not say."""
    mark = getattr(error, "problem_mark", None)
    return f" (line {mark.line + 1})" if mark else ""


def _check(root: yaml.Node) -> None:
    """Raises ConstructorError for a key given twice, half a character, aliases without end."""
    sizes: dict[int, int] = {}  # of what is done; 0 while it is being counted
    way = [(root, False)]
    while way:
        node, counted = way.pop()
        inside = _inside(node)
        if counted:
            size = 1 + sum(sizes[id(inner)] for inner in inside)
            if size > MOST_NODES:
                raise _error(node, "its aliases stand for too many values")
            sizes[id(node)] = size
            continue
        if id(node) in sizes:
            if not sizes[id(node)]:
                raise _error(node, "an alias stands for what it is part of")
            continue
        if isinstance(node, yaml.MappingNode):
            _check_keys(node)
        if isinstance(node, yaml.ScalarNode) and _HALF.search(node.value):
            raise _error(node, HALF)
        sizes[id(node)] = 0
        way.append((node, True))
        way += [(inner, False) for inner in inside]


def _inside(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []


def _check_keys(node: yaml.MappingNode) -> None:
    seen: set[tuple[str, str]] = set()
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise _error(key, "a key must be a word")
        if (key.tag, key.value) in seen:
            raise _error(key, f"key {key.value!r} is given twice")
        seen.add((key.tag, key.value))


def _error(node: yaml.Node, problem: str) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
