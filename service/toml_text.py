"""Change single values of a TOML text and leave everything else, comments too, as a person wrote it.

A key is dotted; a table of a list has its number, from 1: ``limits.table_value_um``, ``schedule[2].needs.idle``.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

_TOKEN = re.compile(r"""\"{3}(?:\\.|[^\\])*?\"{3,5}|'{3}.*?'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*'|\#[^\n]*|[\[{]|[\]}]|\n""", re.DOTALL)
"""Parts of a TOML text that decide where a statement ends: strings, comments, brackets, ends of lines."""
_NAME = r"""(?:[A-Za-z0-9_-]+|"(?:\\.|[^"\\\n])*"|'[^'\n]*')"""
_LEFT = re.compile(rf"[ \t]*{_NAME}(?:[ \t]*\.[ \t]*{_NAME})*[ \t]*=")
_PART = re.compile(r"([^.\[\]]+)(?:\[([1-9]\d*)\])?")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
Path = tuple[str | int, ...]
"""Keys that lead to a value; the key of a list of tables is followed by the number of the table, from 0."""


class NotEditableError(ValueError):
    """The text is written in a way in which this value cannot be changed alone; the message names its key."""


@dataclass(frozen=True, slots=True)
class _Statement:
    """A header, a key with its value, a comment or an empty line. ``line``: number of its first line, from 1; ``at``: table of its keys."""

    line: int
    text: str
    at: Path
    header: bool
    values: Mapping[str, Any]

    def has(self, path: Path) -> bool:
        """Whether the statement belongs to a table or key, or to one inside of it."""
        n = len(path)
        return self.at[:n] == path if self.header else any(leaf[:n] == path for leaf in self.leaves())

    def leaves(self) -> Iterator[Path]:
        """The keys to which the statement gives values."""
        return iter(()) if self.header else (path for path, _ in _leaves(self.values, self.at))


def key_lines(text: str) -> dict[str, int]:
    """Number of the line, from 1, on which each key of a valid TOML text (lines end with ``\\n``) begins."""
    return {dotted(path): one.line for one in _statements(text) for path in one.leaves()}


def path_of(key: str) -> Path:
    """A dotted key in parts. Raises ValueError for any other text."""
    parts: list[str | int] = []
    for part in key.split("."):
        found = _PART.fullmatch(part)
        if found is None:
            raise ValueError(f"{key!r} is not a dotted key")
        parts += [found[1]] if found[2] is None else [found[1], int(found[2]) - 1]
    return tuple(parts)


def dotted(path: Path) -> str:
    """The dotted key of a path."""
    return "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in path).removeprefix(".")


def set_value(values: Mapping[str, Any], path: Path, value: Any) -> dict[str, Any]:
    """A copy of parsed TOML with one value replaced; None removes the key or table, and a list or table that is left empty."""
    copy = deepcopy(dict(values))
    _put(copy, path, value)
    return copy


def _put(inside: Any, path: Path, value: Any) -> None:
    head: Any = path[0]
    rest = path[1:]
    if isinstance(head, int) and head == len(inside):
        inside.append({})
    if rest:
        if isinstance(inside, dict):
            inside.setdefault(head, [] if isinstance(rest[0], int) else {})
        _put(inside[head], rest, value)
        if not inside[head] and value is None:
            del inside[head]
    elif value is not None:
        inside[head] = value
    elif isinstance(inside, list) or head in inside:
        del inside[head]


def edited(text: str, key: str, value: Any) -> str:
    """Return a TOML text with the value of one key replaced or added. None removes the key; the key of a table removes the whole table.

    The result is parsed and compared: it differs in this value alone.

    Raises
    ------
    NotEditableError
        This value cannot be changed alone in the text as it is written.
    """
    path = path_of(key)
    try:
        wanted = set_value(tomllib.loads(text), path, value)
        made = _removed(text, path) if value is None else _replaced(text, path, value)
        if _full(tomllib.loads(made)) == _full(wanted):
            return made
    except (tomllib.TOMLDecodeError, LookupError, TypeError, AttributeError):
        pass
    raise NotEditableError(f"{key} cannot be changed in the file as it is written: write its section as a table with one key a line")


def _full(values: Any) -> Any:
    """Return parsed TOML as JSON values: dates become texts, and empty tables are left out."""
    if isinstance(values, dict):
        return {key: _full(one) for key, one in values.items() if one != {}}
    return json.loads(json.dumps([_full(one) for one in values] if isinstance(values, list) else values, default=str))


def _replaced(text: str, path: Path, value: Any) -> str:
    lines = _statements(text)
    for k, one in enumerate(lines):
        if one.header or not one.values:
            continue
        depth, inner = _depth(one)
        own = one.at + depth
        if path[: len(own)] == own and (path == own or isinstance(inner, dict | list)):
            new = value if path == own else set_value({"": inner}, ("", *path[len(own) :]), value)[""]
            return _joined(lines, k, _written(one.text, new))
    return _inserted(lines, path, value)


def _inserted(lines: list[_Statement], path: Path, value: Any) -> str:
    """The text with a new key at the end of its table, or with a new table."""
    table, row = path[:-1], f"{_name(path[-1])} = {toml(value)}"
    own = [k for k, one in enumerate(lines) if one.at == table and (one.header or one.values)]
    if own or not table:
        at = own[-1] if own else -1
        return "\n".join([*(one.text for one in lines[: at + 1]), row, *(one.text for one in lines[at + 1 :])])
    head = ".".join(_name(part) for part in table if isinstance(part, str))
    block = [f"[[{head}]]" if isinstance(table[-1], int) else f"[{head}]", row]
    around = next((table[: n + 1] for n in reversed(range(len(table))) if isinstance(table[n], int)), ())
    inside = [k for k, one in enumerate(lines) if around and one.has(around)]
    at = inside[-1] if inside else max((k for k, one in enumerate(lines) if one.text.strip()), default=-1)
    return "\n".join([*(one.text for one in lines[: at + 1]), "", *block, *(one.text for one in lines[at + 1 :])])


def _removed(text: str, path: Path) -> str:
    lines = _statements(text)
    mine = [k for k, one in enumerate(lines) if one.has(path)]
    whole = {k for k in mine if lines[k].header or all(leaf[: len(path)] == path for leaf in lines[k].leaves())}
    for k in mine:
        if k not in whole:
            depth, inner = _depth(lines[k])
            rest = path[len(lines[k].at) + len(depth) :]
            return _joined(lines, k, _written(lines[k].text, set_value({"": inner}, ("", *rest), None)[""]))
    gone = whole | {k for k in range(min(whole), max(whole)) if not lines[k].values and not lines[k].header}
    return "\n".join(one.text for k, one in enumerate(lines) if k not in gone)


def _joined(lines: list[_Statement], k: int, new: str) -> str:
    return "\n".join([*(one.text for one in lines[:k]), new, *(one.text for one in lines[k + 1 :])])


def _depth(one: _Statement) -> tuple[Path, Any]:
    """Return the keys on the left side of a statement, and the value on its right side."""
    left = _LEFT.match(one.text)
    assert left is not None
    names: list[str | int] = []
    inner: Any = tomllib.loads(left[0] + " 0")
    value: Any = one.values
    while isinstance(inner, dict):
        ((name, inner),) = inner.items()
        names.append(name)
        value = value[name]
    return tuple(names), value


def _written(statement: str, value: Any) -> str:
    """Return a statement with another value. Its comments stay; comments between the lines of a long value move above it."""
    left = _LEFT.match(statement)
    assert left is not None
    found = [token[0] for token in _TOKEN.finditer(statement, left.end()) if token[0].startswith("#")]
    row = f"{left[0]} {toml(value)}"
    return "\n".join([*found, row]) if "\n" in statement else "  ".join([row, *found])


def toml(value: Any) -> str:
    """A value of JSON, or a date, as TOML on one line. Raises TypeError for what TOML cannot hold."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_name(key)} = {toml(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(one) for one in value) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if value is None:
        raise TypeError("TOML has no empty value")
    return json.dumps(value) if isinstance(value, bool) else str(value)


def _name(part: str | int) -> str:
    text = str(part)
    return text if _BARE.fullmatch(text) else json.dumps(text, ensure_ascii=False)


def _statements(text: str) -> list[_Statement]:
    """Return all statements of a TOML text, in order; joined by line feeds they give the text again."""
    found: list[_Statement] = []
    tables: dict[Path, int] = {}  # how many tables of a list there are so far
    at: Path = ()
    for line, statement in _pieces(text):
        values, header = tomllib.loads(statement), statement.lstrip(" \t").startswith("[")
        at = _header(values, tables) if header else at
        found.append(_Statement(line, statement, at, header, {} if header else values))
    return found


def _pieces(text: str) -> Iterator[tuple[int, str]]:
    """Yield each statement with the number of its first line."""
    line, begun, start, depth = 1, 1, 0, 0
    for token in _TOKEN.finditer(text):
        found = token[0]
        depth += (found in "[{") - (found in "]}")
        line += found.count("\n")
        if found == "\n" and depth == 0:
            yield begun, text[start : token.start()]
            begun, start = line, token.end()
    yield begun, text[start:]


def _header(values: Mapping[str, Any], tables: dict[Path, int]) -> Path:
    """The table that a header begins; a further table of a list is counted in ``tables``."""
    at: Path = ()
    inside: Any = values
    while inside:
        ((key, inside),) = inside.items()
        at = (*at, key)
        if isinstance(inside, list):
            tables[at] = tables.get(at, 0) + 1
            inside = inside[0]
        at = (*at, tables[at] - 1) if at in tables else at
    return at


def _leaves(values: Mapping[str, Any], at: Path = ()) -> Iterator[tuple[Path, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, (*at, key))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for number, inner in enumerate(value):
                yield from _leaves(inner, (*at, key, number))
        else:
            yield (*at, key), value
