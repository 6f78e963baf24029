"""Renishaw .b5r: results of a ball-bar test as XML, known from one public reader. The trace is not read: nobody published its place."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from abbe.service.domain.run_file import StatedFigure
from abbe.service.errors import FileFormatError
from abbe.service.formats.files import TextFile
from abbe.service.instrument_files.content import Content, digest

UNITS = {
    "UT_LENGTH_UM": "µm",
    "UT_LENGTH_MM": "mm",
    "UT_LENGTH_M": "m",
    "UT_SQUARENESS": "µm/m",
    "UT_SERVO_MISMATCH": "ms",
    "UT_SCALE_ERROR": "µm/m",
    "UT_FEEDRATE": "mm/min",
}
"""Unit of each data type that is a figure; the other types (rank, share, angle, speed) are reported as not read."""
NOT_FIGURES = ("UT_RANKING", "UT_PERCENT", "UT_ANGLE", "UT_SPEED")
TEXTS = ("OPERATOR", "DATE_STARTED", "SERIAL_NUMBER", "LAST_CALIBRATED", "PART_NUMBER", "A_AXIS_NAME", "B_AXIS_NAME")
NAMED = ("TEST_SPEC", "MACHINE_TESTED")
ANALYSIS = "RENISHAW_DIAGNOSTICS"
PLANES = ("XY", "YZ", "ZX")
ENCODINGS = frozenset(("utf-8", "us-ascii", "iso-8859-1", "windows-1252", "gbk", "gb2312", "gb18030"))
"""Encodings that are decoded here; for any other the parser decides."""
_DECLARED = re.compile(
    rb"\A(?:\xef\xbb\xbf)?<\?xml\s+version=([\"'])1\.[0-9]\1\s+encoding=([\"'])(?P<encoding>[A-Za-z][A-Za-z0-9._-]*)\2"
    rb"(?:\s+standalone=([\"'])(?:yes|no)\4)?\s*\?>"
)


@dataclass
class _Element:
    tag: str
    attributes: dict[str, str]
    line: int
    inside: tuple[str, ...]
    text: str = ""
    parts: list[str] = field(default_factory=list)


def read_b5r(name: str, data: bytes) -> Content:
    """Read the results of a ball-bar test.

    Raises
    ------
    FileFormatError
        The file is no XML, or incomplete; the message has the line.
    """
    file = TextFile(name, "", FileFormatError)
    elements = _elements(file, data)
    said = {_title(one.tag): one.text for one in elements if one.tag in TEXTS and one.text}
    said |= {_title(one.tag): one.attributes["NAME"] for one in elements if one.tag in NAMED and one.attributes.get("NAME")}
    plane, last = _plane(file, elements), max(one.line for one in elements)
    features = [one for one in elements if one.tag == "FEATURE"]
    if any(ANALYSIS in one.inside for one in features):
        features = [one for one in features if ANALYSIS in one.inside]
    stated = tuple(_figures(file, name, plane, features))
    if not stated:
        raise file.wrong(last, "there is no FEATURE with a result: the file is cut off, or is not a .b5r file")
    left = sorted({kind for one in features if (kind := one.attributes.get("DT", "")) not in UNITS and kind not in NOT_FIGURES})
    notes = [f"data type {kind} is not known and was not read" for kind in left]
    notes.append("the trace (radius against angle) was not read: no public description says where it is")
    return Content(
        name=name,
        form="Renishaw .b5r",
        sha256=digest(data),
        machine=said.get("Machine tested", ""),
        said={"Plane": plane} | said,
        stated=stated,
        notes=tuple(notes),
    )


def _plane(file: TextFile, elements: list[_Element]) -> str:
    planes = {one.attributes.get("TEST_PLANE", ""): one.line for one in elements if one.tag == "PLANE"}
    if len(planes) != 1 or not set(planes) <= set(PLANES):
        at = max(planes.values(), default=1)
        raise file.wrong(at, f"the plane is {', '.join(sorted(planes)) or 'missing'}, expected one of {', '.join(PLANES)}")
    return next(iter(planes))


def _figures(file: TextFile, name: str, plane: str, features: list[_Element]) -> Iterator[StatedFigure]:
    seen = dict[str, int]()
    for one in features:
        symbol, kind = one.attributes.get("NAME", ""), one.attributes.get("DT", "")
        if not symbol or not kind:
            raise file.wrong(one.line, "a FEATURE without NAME or DT")
        if kind not in UNITS:
            continue
        if symbol in seen:
            raise file.wrong(one.line, f"a second {symbol} (the first is in line {seen[symbol]})")
        seen[symbol] = one.line
        value = file.number(one.line, one.text, symbol)
        words = symbol.removeprefix("AF_").replace("_", " ").lower()
        yield StatedFigure(file=name, group=f"Ball-bar, plane {plane}", symbol=symbol, name=words, value=value, unit=UNITS[kind])


def _elements(file: TextFile, data: bytes) -> list[_Element]:
    """All elements in the order of their ends, with line, text and the tags around them."""
    out, stack = list[_Element](), list[_Element]()
    parser = expat.ParserCreate(None, " ")  # with namespaces: an unbound prefix is a mistake

    def start(tag: str, attributes: dict[str, str]) -> None:
        stack.append(_Element(tag, attributes, parser.CurrentLineNumber, tuple(one.tag for one in stack)))

    def end(_: str) -> None:
        one = stack.pop()
        one.text = "".join(one.parts).strip()
        out.append(one)

    def text(words: str) -> None:
        if stack:
            stack[-1].parts.append(words)

    def declared(*_: object) -> None:
        raise file.wrong(parser.CurrentLineNumber, "the file has a DOCTYPE, which Abbe does not read", "export the file again")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, text
    parser.StartDoctypeDeclHandler = declared
    try:
        parser.Parse(_utf8(file, data), True)
    except expat.ExpatError as err:
        raise file.wrong(err.lineno, f"not XML: {expat.errors.messages[err.code]}", "export the file again") from None
    except (LookupError, ValueError) as err:  # of an encoding that Python does not know, or not here
        raise file.wrong(1, f"not XML: {err}", "export the file again") from None
    return out


def _utf8(file: TextFile, data: bytes) -> bytes:
    """The document in UTF-8, without its declaration, which may name an encoding that the parser does not know."""
    found = _DECLARED.match(data)
    encoding = "" if found is None else found["encoding"].decode().lower()
    if found is None or encoding not in ENCODINGS:
        return data
    try:
        text = data[found.end() :].decode(encoding)
    except UnicodeDecodeError:
        raise file.wrong(1, f"the file is not in the encoding that it states, {encoding}", "export the file again") from None
    return b"\n" * found.group().count(b"\n") + text.encode()


def _title(tag: str) -> str:
    return tag.replace("_", " ").capitalize()
