"""Reading what users write, and writing so that nothing is ever half-written."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from moonteam import outputs
from moonteam.errors import InputError, meant
from moonteam.strict import json_value

T = TypeVar("T")

_TOO_LONG = re.compile(r"Expected `\w+` of length <= (\d+)")
_NOT_YAML = re.compile("[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")

MOST_BYTES = 128 << 20
"""Of a file of text."""


def read_text(path: str | os.PathLike[str]) -> str:
    """The file's text. Raises InputError if it is missing, unreadable, too long or not UTF-8."""
    try:
        with Path(path).open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise InputError(path, f"is too long: more than {MOST_BYTES >> 20} MiB of text")
        text = data.decode("utf-8-sig")  # a byte-order mark is no text
        return text.replace("\r\n", "\n").replace("\r", "\n")
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except IsADirectoryError:
        raise InputError(path, "is a folder, a file is needed") from None
    except UnicodeDecodeError:
        raise InputError(path, "is not UTF-8 text") from None
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None


def convert(value: Any, kind: type[T], source: object, where: str = "") -> T:
    """Checks a decoded JSON or YAML value against a msgspec Struct.

    Unknown keys and wrong types become an InputError naming the key.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at `")
        problem = _TOO_LONG.sub(r"is too long; at most \1", problem)
        key = path.rstrip("`").removeprefix("$").removeprefix(".")
        key = ".".join(part for part in (where, key) if part).replace(".[", "[")
        if problem.startswith("Object contains unknown field"):
            allowed = _fields_at(kind, key.removeprefix(where).lstrip("."))
            problem = problem.replace("Object contains unknown field", "unknown key")
            problem += _instead(problem, allowed)
        elif problem.startswith("Invalid enum value"):
            allowed = _choices_at(kind, key.removeprefix(where).lstrip("."))
            problem = problem.replace("Invalid enum value", "unknown value")
            problem += _instead(problem, allowed)
        raise InputError(source, problem.replace("Object missing", "missing"), key) from None


def _instead(problem: str, allowed: list[str]) -> str:
    """What might have been meant in place of the word that a problem ends with, and may be."""
    word = problem.partition(" ")[2].partition(" ")[2].strip("`'")
    return f"; {meant(word, allowed)}allowed: {', '.join(allowed)}" if allowed else ""


def _fields_at(kind: Any, path: str) -> list[str]:
    """Names allowed in the Struct reached from `kind` by a path such as ``robots[...]``."""
    info = _type_at(kind, path)
    if isinstance(info, msgspec.inspect.StructType):
        return [field.encode_name for field in info.fields]
    return []


def _choices_at(kind: Any, path: str) -> list[str]:
    """Values allowed by the Literal reached from `kind` by a path."""
    info = _type_at(kind, path)
    if isinstance(info, msgspec.inspect.LiteralType):
        return [str(value) for value in info.values]
    return []


def _type_at(kind: Any, path: str) -> Any:
    info = msgspec.inspect.type_info(kind)
    for part in [p for p in path.replace("[", ".[").split(".") if p]:
        info = _struct_or_item(info, part)
    return _struct_or_item(info, "")


def _struct_or_item(info: Any, part: str) -> Any:
    """One step down a msgspec type description; optional types are looked through."""
    if isinstance(info, msgspec.inspect.UnionType):
        kinds = [t for t in info.types if not isinstance(t, msgspec.inspect.NoneType)]
        info = kinds[0]
    if not part:
        return info
    if part.startswith("["):
        return getattr(info, "item_type", info)
    if isinstance(info, msgspec.inspect.StructType):
        for field in info.fields:
            if field.encode_name == part:
                return field.type
    return info


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`, renamed onto it on success and removed on failure.

    The suffix is kept, since writers such as ffmpeg choose their format by it. Raises InputError
    for what is in the way (see `moonteam.outputs`) and where the disk takes no more.
    """
    path = Path(path)
    outputs.admit(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".part-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        outputs.publish(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, name, temporary):
            raise _unwritten(path, error) from None
        raise


def append(path: Path, text: str) -> None:
    """Adds UTF-8 text to a file's end, whole or not at all. Raises InputError if it cannot be."""
    outputs.admit(path)
    with path.open("ab", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        data = text.encode()
        try:
            while data:  # a full disk may take a part of it
                data = data[file.write(data):]
        except OSError as error:
            with contextlib.suppress(OSError):  # no common file
                file.truncate(end)
            raise _unwritten(path, error) from None


def _unwritten(path: Path, error: OSError) -> InputError:
    # NumPy and GDAL give no number, only words.
    return InputError(path, f"cannot be written: {error.strerror or error}")


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes UTF-8 text, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Writes bytes, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def read_json(path: str | os.PathLike[str], kind: Any = Any) -> Any:
    """The value of a JSON file, checked against a type. Raises InputError."""
    return convert(json_value(read_text(path), path), kind, path)


def lines(text: str) -> list[str]:
    """Lines of a `.jsonl` text. JSON's strings may hold what `str.splitlines` takes for an end."""
    return text.removesuffix("\n").split("\n")


def safe_name(name: str, otherwise: str) -> str:
    """A name as a file or folder may have it, in one part; `otherwise` if nothing is left.

    Letters and digits of any language, dots, hyphens and underlines stay; the rest is a hyphen.
    """
    # A file system whose encoding is not UTF-8 lacks some of them.
    known = os.fsdecode(name.encode(sys.getfilesystemencoding(), "replace"))
    plain = re.sub(r"[^\w.-]+", "-", known).strip(".-")
    return plain[:100] or otherwise


def read_lines(path: str | os.PathLike[str], decode: Callable[[str, str], T], what: str
               ) -> list[T]:
    """What `decode(line, "line N")` makes of every line of a `.jsonl` file that is not blank.

    Raises InputError if there is none, `what` being what is missing.
    """
    found = [decode(line, f"line {n}")
             for n, line in enumerate(lines(read_text(path)), 1) if line.strip()]
    if not found:
        raise InputError(path, f"holds no {what}; one JSON object a line is needed")
    return found


def write_lines(path: str | os.PathLike[str], values: Iterable[Any]) -> None:
    """Writes a `.jsonl` file, a value a line, whole or not at all."""
    write_text(path, "".join(dump_json(value) + "\n" for value in values))


def write_json(path: str | os.PathLike[str], value: Any, indent: int = 2) -> None:
    """Writes JSON (msgspec Structs, dataclasses, lists, dicts, NumPy scalars via `.item()`)."""
    write_text(path, dump_json(value, indent) + "\n")


def dump_json(value: Any, indent: int = 0) -> str:
    """JSON text; not-a-number and infinity become null, NumPy scalars and arrays are plain.

    YAML reads it as the same: what it takes for the end of a line, or not at all, is escaped.
    """
    data = msgspec.json.encode(value, enc_hook=_plain)
    text = (msgspec.json.format(data, indent=indent) if indent else data).decode()
    return _NOT_YAML.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise NotImplementedError(f"cannot be written as JSON: {type(value).__name__}")
