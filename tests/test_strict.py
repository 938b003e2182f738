"""Text that means one thing to its writer and another to a parser."""

import math

import pytest

from moonteam import files
from moonteam.errors import InputError
from moonteam.strict import json_value, yaml_value


@pytest.mark.parametrize(("text", "value"), [
    ("010", "010"), ("1:30", "1:30"), ("0o17", "0o17"), ("0x1F", "0x1F"), ("1_000", "1_000"),
    ("yes", "yes"), ("off", "off"), ("2001-01-01", "2001-01-01"), ("nan", "nan"),
    ("-inf", "-inf"), ("0", 0), ("-12", -12), ("+7", 7), ("1e3", 1000.0), (".5", 0.5),
    ("1.", 1.0), ("-0.25e-2", -0.0025), ("true", True), ("False", False), ("~", None),
    ("null", None), ("", None), ("'10'", "10"), ("[1, 2.0]", [1, 2.0])])
def test_a_yaml_scalar_is_what_it_looks_like(text, value):
    found = yaml_value(f"key: {text}", "m.yaml")["key"]
    assert found == value
    assert type(found) is type(value)


def test_anchors_and_merge_keys():
    text = """
    base: &base {kind: wheeled, speed: 0.3}
    own: &own
      <<: *base
      speed: 0.4
    third: {<<: [*own, *base], name: C}
    inner: {deep: &deep {<<: *base, kind: drone}}
    same: {<<: *deep}
    """
    found = yaml_value(text, "m.yaml")
    assert found["own"] == {"kind": "wheeled", "speed": 0.4}
    assert found["third"] == {"kind": "wheeled", "speed": 0.4, "name": "C"}
    assert found["same"] == found["inner"]["deep"] == {"kind": "drone", "speed": 0.3}


LAUGHS = "a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True))


@pytest.mark.parametrize(("text", "problem"), [
    ("a: 1\nb: 2\na: 3", "key 'a' is given twice (line 3)"),
    ("a: {b: 1, b: 2}", "key 'b' is given twice (line 1)"),
    ("a:\n\t- 1", "cannot start any token (line 2)"),
    ("a: !!int 010", "'010' is no whole decimal number (line 1)"),
    ("a: !!float 1:30", "'1:30' is no finite number"),
    ("a: 1\nb: .nan", "'.nan' is no finite number (line 2)"),
    ("a: -.Inf", "'-.Inf' is no finite number"),
    ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
    ("a: 1e999", "the number 1e999 is too large"),
    ("a: " + "9" * 5000, "the number 999999999999..., 5000 characters is too large"),
    ("a: [-" + "9" * 400 + "]", "the number -99999999999..., 401 characters is too large"),
    ("? [1, 2]\n: 3", "a key must be a word"),
    ("a: &a [*a]", "an alias stands for what it is part of"),
    (LAUGHS, "its aliases stand for too many values"),
    ("a: *b", "found undefined alias 'b'"),
    ("a: 1\n---\na: 2", "but found another document"),
    ("a: " + "[" * 500_000, "is nested too deeply"), ("[" * 65, "is nested too deeply"),
    ("- " * 65, "is nested too deeply"),
    ("a: " + "x" * 524_288, "is too long: 524,291 characters; at most 524,288"),
    (r'a: "\ud800"', r"holds half a character (\ud800 to \udfff) (line 1)"),
])
def test_yaml_refused_in_one_line(text, problem):
    with pytest.raises(InputError) as refused:
        yaml_value(text, "m.yaml")
    assert str(refused.value).startswith("m.yaml: ")
    assert problem in str(refused.value)
    assert len(str(refused.value)) < 200


@pytest.mark.parametrize(("text", "problem"), [
    ('{"a": 1, "a": 2}', "key 'a' is given twice"),
    ('{"a": NaN}', "NaN is no number of JSON"), ('{"a": -Infinity}', "-Infinity is no number"),
    ('{"a": 1e999}', "the number 1e999 is too large"),
    ('{"a": ' + "9" * 5000 + "}", "is too large"), ("9" * 310, "is too large"),
    ('{"a": 010}', "not JSON: "),
    ('{"a": 1,}', "not JSON: "), ("[" * 10_000_000, "is nested too deeply"), ("", "not JSON: "),
    (r'["\ud800"]', r"holds half a character (\ud800 to \udfff)"),
    (r'{"\uDFFF": 1}', "half a character"), ("1" * 16_777_217, "at most 16,777,216"),
])
def test_json_refused_in_one_line(text, problem):
    with pytest.raises(InputError) as refused:
        json_value(text, "s.json", "line 3")
    assert str(refused.value).startswith("s.json: line 3: ")
    assert problem in str(refused.value)
    assert len(str(refused.value)) < 200


def test_a_byte_order_mark_and_ends_of_lines_inside_strings(tmp_path):
    """U+2028, NEL and a form feed end no line of a .jsonl file; \r\n does."""
    words = ["a\u2028b", "c\x85d", "e\u2029f", "\x1c", "\u000b"]
    path = tmp_path / "set.jsonl"

    def read():
        return files.read_lines(path, lambda line, where: json_value(line, path, where), "word")

    files.write_lines(path, words)
    assert read() == words
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert read() == words
    assert math.isclose(json_value("\ufeff0.1", "s.json"), 0.1)


@pytest.mark.parametrize(("name", "safe"), [
    ("../../x", "x"), ("/etc/passwd", "etc-passwd"), ("..", "mission"), ("", "mission"),
    ("a b/c", "a-b-c"), ("Mond: Süd", "Mond-Süd"), (".hidden", "hidden"), ("v1.2_b", "v1.2_b"),
    ("x\x00y\n", "x-y"), ("n" * 300, "n" * 100)])
def test_a_name_stays_in_its_folder(name, safe):
    assert files.safe_name(name, "mission") == safe
