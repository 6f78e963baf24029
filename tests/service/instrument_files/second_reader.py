"""A second reader of the same files, written another way: whole-file expressions, dictionaries, ElementTree. It shares no code with Abbe.

It returns plain lists, or None where a file is not whole.
"""

from __future__ import annotations

import itertools
import re
import struct
import xml.etree.ElementTree as ET
from typing import Any

FLOAT = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
Found = dict[str, Any] | None


def text_of(data: bytes) -> str | None:
    pairs = re.findall(b"[\x80-\xff][\x80-\xff]", data)
    chinese = sum(0xB0 <= pair[0] <= 0xD7 for pair in pairs) * 2 >= len(pairs)
    usual = ("utf-8-sig", "gb2312", "latin-1") if chinese else ("utf-8-sig", "latin-1")
    for encoding in ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else usual:
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        text = text.replace("\r\n", "\n").replace("\r", "\n")
        return None if re.search(r"[\x00-\x08\x0b-\x1f\x7f\ufffd]", text) else text
    return None


def finite(word: str) -> float | None:
    if re.fullmatch(FLOAT, word) is None or abs(float(word)) == float("inf"):
        return None
    return float(word)


def numbers(words: list[str]) -> list[float] | None:
    found = [finite(word) for word in words]
    return None if None in found else [one for one in found if one is not None]


def letter(text: str) -> str:
    found = re.match(r"(?i)(?:axis[ :_-]*)?([xyz])(?:[^a-z]|$)", text.strip()) or re.match(r"(?i)([xyz])[ _-]?axis", text.strip())
    return found[1].upper() if found else ""


def pairs(text: str) -> dict[str, str]:
    """``name : value`` of each line; the last of equal names counts."""
    found = (line.split(":", 1) for line in text.split("\n") if ":" in line)
    return {re.sub(r"\s+", " ", key.strip()).lower(): value.strip() for key, value in found}


def contradicts(text: str) -> bool:
    """Whether one name has two values."""
    found = {
        (re.sub(r"\s+", " ", a.strip()).lower(), b.strip()) for a, _, b in (line.partition(":") for line in text.split("\n") if ":" in line)
    }
    return len({name for name, _ in found}) < len(found)


def environment(text: str, axis: str) -> dict[str, list[float]] | None:
    """Start and end of each temperature (°C) and of the pressure (Pa) that can be; material is the mean of its sensors."""
    values = {re.sub(r"\s+", " ", a.strip()).lower(): numbers(b.split()) for a, _, b in (line.partition(":") for line in text.split("\n"))}
    wanted = {name: values[name] for name in ("air temp", "air press", "mat temp 1", "mat temp 2", "mat temp 3") if name in values}
    if any(found is None or not 1 <= len(found) <= 3 for found in wanted.values()):
        return None
    used = {}
    for name, found in wanted.items():
        low, high = (600, 1100) if name == "air press" else (-20, 50)
        if found and any(found) and all(low <= one <= high for one in found):
            used[name] = [found[0], found[-1]]
    material = [ends for name, ends in used.items() if name.startswith("mat")]
    out = {"temp_air_C": used["air temp"]} if "air temp" in used else {}
    out |= {"pressure_air_Pa": [100 * one for one in used["air press"]]} if "air press" in used else {}
    if material and axis:
        out[f"temp_{axis.lower()}_C"] = [sum(ends) / len(material) for ends in zip(*material, strict=True)]
    return out


def rtl(data: bytes) -> Found:  # noqa: C901 - one rule of the format a line
    text = text_of(data)
    if text is None:
        return None
    text = "\n".join(line.strip() for line in text.split("\n"))
    cut = re.split(r"(?:^|\n)([A-Z][A-Z -]*)::(?=\n|$)", text)
    names = [name.strip() for name in cut[1::2]]
    if cut[0].strip() or not names or names[0] != "HEADER" or len(set(names)) != len(names):
        return None
    part = dict(zip(names, cut[2::2], strict=True))
    if not {"TARGET DATA", "RUNS", "DEVIATIONS", "EOF"} <= set(part) or names[-1] != "EOF" or part["EOF"].strip():
        return None
    head, user = pairs(part["HEADER"]), pairs(part.get("USER-TEXT", ""))
    if any(contradicts(part.get(name, "")) for name in ("HEADER", "USER-TEXT")):
        return None
    said = [line.split(":", 1)[0].split() for line in part.get("ENVIRONMENT", "").split("\n") if line]
    if any(said.count(name) > 1 for name in said):
        return None
    kind = head.get("file type", "").lower()
    if (kind, head.get("owner", "").lower()) not in (("rtl", "linear"), ("rta", "angular")):
        return None
    shape = target_data(part["TARGET DATA"])
    count = re.fullmatch(r"(?i)\s*run-count\s*:\s*([0-9]+)\s*", part["RUNS"])
    rows = re.fullmatch(r"(?i)\s*run\s+target\s+data\s*:\s*\n(.*)", part["DEVIATIONS"], re.DOTALL)
    if shape is None or count is None or rows is None:
        return None
    targets, flags, runs = numbers(shape[1]), shape[2], int(count[1])
    if targets is None or len(targets) != shape[0] or len(targets) < 2 or flags not in (["0", "1", "2", "0"], ["0", "0", "2", "0"]):
        return None
    rise = {(b > a) - (b < a) for a, b in itertools.pairwise(targets)}
    both = flags[1] == "0"
    if rise not in ({1}, {-1}) or (both and runs % 2):
        return None
    lines = [line.split() for line in rows[1].split("\n") if line.strip()]
    values = numbers([line[2] for line in lines if len(line) == 3])
    if values is None or any(len(line) != 3 or not (line[0] + line[1]).isascii() for line in lines):
        return None
    if not all(re.fullmatch("[0-9]{1,9}", line[0]) and re.fullmatch("[0-9]{1,9}", line[1]) for line in lines):
        return None
    around = environment(part.get("ENVIRONMENT", ""), letter(user.get("axis", "")))
    if around is None:
        return None
    most = max(targets) - min(targets) if kind == "rtl" else 0.1
    if any(abs(value) * 1e-3 > most for value in values):
        return None
    order = [(int(line[0]), int(line[1])) for line in lines]
    out = range(1, len(targets) + 1)
    zigzag = [(run, t) for run in range(1, runs + 1) for t in (out if run % 2 else reversed(out))]
    straight = [(run, t) for run in range(1, runs + 1) for t in out]
    sign = rise.pop()
    if order == zigzag and both:
        chosen = list(range(len(order)))
    elif order == straight and not both:
        chosen = list(range(len(order)))
        zigzag = straight
    elif order == zigzag and runs % 2 == 0 and all(v == 0.0 for (run, _), v in zip(order, values, strict=True) if run % 2 == 0):
        chosen = [k for k, (run, _) in enumerate(order) if run % 2]
    else:
        return None
    unit = 1e-3
    return {
        "axis": letter(user.get("axis", "")),
        "machine": user.get("machine", ""),
        "further": around,
        "position": [targets[order[k][1] - 1] for k in chosen],
        "direction": [sign * (1 if zigzag is straight or order[k][0] % 2 else -1) for k in chosen],
        "deviation": [values[k] * unit for k in chosen],
    }


def target_data(text: str) -> tuple[int, list[str], list[str]] | None:
    """Number of targets, their words, and the flags."""
    lines = [line for line in text.split("\n") if line and not re.match(r"(?i)filetype\s*:", line)]
    at = {name: [k for k, line in enumerate(lines) if re.match(rf"(?i){name}\s*:", line)] for name in ("target-count", "targets", "flags")}
    if any(len(found) != 1 for found in at.values()):
        return None
    (counted,), (first,), (last,) = at.values()
    rest = [k for k in range(len(lines)) if k not in (counted, first, last)]
    count = lines[counted].split(":", 1)[1].strip()
    if any(not first < k < last for k in rest) or re.fullmatch("[0-9]{1,9}", count) is None:
        return None
    words = lines[first].split(":", 1)[1].split() + [word for k in rest for word in lines[k].split()]
    return int(count), words, lines[last].split(":", 1)[1].split()[:4]


def pos(data: bytes) -> Found:  # noqa: C901 - one rule of the format a line
    text = text_of(data)
    if text is None:
        return None
    cut = re.split(
        r"(?m)^[ \t]*Position[ \t]+(Bidirectional|Forward Directional|Reverse Directional|Backward Directional) Avg Error[ \t]*$", text
    )
    tables: dict[int, list[tuple[float, float]]] = {}
    steps = []
    for name, body in zip(cut[1::2], cut[2::2], strict=True):
        way = {"B": 0, "F": 1, "R": -1}[name[0] if not name.startswith("Backward") else "R"]
        rows = [line.split() for line in body.split("\n") if line.strip()]
        if way in tables or len(rows) < 2 or any(len(row) != 2 for row in rows):
            return None
        found = [numbers(row) for row in rows]
        if any(one is None for one in found):
            return None
        tables[way] = [(one[0], one[1]) for one in found if one is not None]
        parts = [[*re.split("[eE]", row[1]), "0"] for row in rows]
        steps += [len(part[0].partition(".")[2]) - int(part[1]) for part in parts]
        if any(b[0] <= a[0] for a, b in itertools.pairwise(tables[way])):
            return None
    if not tables or (1 in tables) != (-1 in tables):
        return None
    if 1 in tables:
        places = [p for p, _ in tables[1]]
        if any([p for p, _ in one] != places for one in tables.values()):
            return None
        step = 10.0 ** -max(steps)
        for (_, m), (_, a), (_, b) in zip(tables.get(0, []), tables[1], tables[-1], strict=False):
            if abs(m - (a + b) / 2) > 1.01 * step:
                return None
        chosen = [(p, 1, v) for p, v in tables[1]] + [(p, -1, v) for p, v in reversed(tables[-1])]
    else:
        chosen = [(p, 0, v) for p, v in tables[0]]
    said = pairs(cut[0])
    return {
        "axis": letter(said.get("axis", "")),
        "machine": said.get("machine", ""),
        "position": [p for p, _, _ in chosen],
        "direction": [w for _, w, _ in chosen],
        "deviation": [v for *_, v in chosen],
    }


def ren(data: bytes) -> Found:
    text = text_of(data)
    if text is None:
        return None
    cut = re.split(r"(?m)^[ \t]*(No\.[ \t]+Axis position[ \t]+Combined.*)$", text, maxsplit=1)
    if len(cut) != 3:
        return None
    facts = {}
    for word in ("spacing", "start", "end"):
        found = [line for line in cut[0].split("\n") if f"compensation {word}" in line.lower()]
        number = re.search(r"[-+]?[0-9]*\.?[0-9]+", found[0]) if len(found) == 1 else None
        if number is None:
            return None
        facts[word] = float(number[0])
    rows = [line.split() for line in cut[2].split("\n") if line.strip()]
    if len(rows) < 2 or any(len(row) != 3 for row in rows) or rows[0][0] not in ("0", "1"):
        return None
    if any(row[0] not in (str(k), str(k + 1)) for k, row in enumerate(rows)):
        return None
    found_rows = [numbers(row[1:]) for row in rows]
    if any(one is None for one in found_rows):
        return None
    table = [(one[0], one[1]) for one in found_rows if one is not None]
    span = max(1.0, abs(facts["end"] - facts["start"]))
    last = facts["start"] + facts["spacing"] * (len(table) - 1)
    if any(abs(p - facts["start"] - facts["spacing"] * k) > 1e-6 * span for k, (p, _) in enumerate(table)):
        return None
    if facts["spacing"] == 0.0 or abs(last - facts["end"]) > 1e-6 * max(1.0, abs(facts["end"])):
        return None
    words = [word.lower() for line in cut[0].split("\n") if "unit" in line.lower() for word in unit_words(line.partition(":")[2])]
    unit = {1e-6 if w == "nm" else 1.0 if w[:2] == "mm" or w[:5] == "milli" else 1e-3 for w in [*words, *unit_words(cut[1])]}
    said = pairs(cut[0])
    return {
        "axis": letter(said.get("axis", "")),
        "machine": said.get("machine", ""),
        "unit_known": len(unit) == 1,
        "position": [p for p, _ in table],
        "direction": [0] * len(table),
        "deviation": [v * (next(iter(unit)) if len(unit) == 1 else 1.0) for _, v in table],
    }


def unit_words(text: str) -> list[str]:
    names = r"millimeters?|millimetres?|micrometers?|micrometres?|microns?|mm|um|[µμ]m|nm"
    return [one.lower() for one in re.findall(rf"(?i)(?<![a-z])(?:{names})(?![a-z/])", text)]


def rtx(data: bytes) -> Found:
    at = data.find(b"\r\nData:\r\n")
    head = text_of(data[:at]) if at > 0 and data.startswith(b"HEADER::\r\n") else None
    if head is None:
        return None
    lines = [line for line in head.split("\n") if line.strip() and not line.endswith("::")]
    facts = pairs("\n".join(lines))
    if any(":" not in line for line in lines) or len(facts) != len(lines):
        return None
    count, rate = finite(facts.get("sample no", "")), finite(facts.get("actual sample rate", ""))
    body = data[at + len(b"\r\nData:\r\n") :]
    if count is None or rate is None or count < 2 or count % 1 or not 1e-9 <= rate <= 1e9 or len(body) != 8 * count + 7:
        return None
    if body[-7:] != b"EOF::\r\n":
        return None
    samples = [struct.unpack_from("<d", body, 8 * k)[0] for k in range(int(count))]
    if any(not abs(one) <= 1e12 for one in samples):
        return None
    return {"axis": letter(facts.get("axis", "")), "machine": facts.get("machine", ""), "rate": rate, "samples": samples}


def b5r(data: bytes) -> Found:
    if b"<!DOCTYPE" in data:
        return None
    try:
        root = ET.fromstring(data)
    except (ET.ParseError, ValueError, LookupError):
        return None
    planes = {one.get("TEST_PLANE", "") for one in root.iter("PLANE")}
    inside = [one for part in root.iter("RENISHAW_DIAGNOSTICS") for one in part.iter("FEATURE")]
    units = {
        "UT_LENGTH_UM": "µm", "UT_LENGTH_MM": "mm", "UT_LENGTH_M": "m", "UT_SQUARENESS": "µm/m", "UT_SERVO_MISMATCH": "ms",
        "UT_SCALE_ERROR": "µm/m", "UT_FEEDRATE": "mm/min",
    }  # fmt: skip
    out = {}
    for one in inside or list(root.iter("FEATURE")):
        name, kind, value = one.get("NAME"), one.get("DT"), finite("".join(one.itertext()).strip())
        if not name or not kind:
            return None
        if kind in units:
            if name in out or value is None or len(one):
                return None
            out[name] = (value, units[kind])
    if not out or len(planes) != 1 or not planes <= {"XY", "YZ", "ZX"}:
        return None
    machine = [one.get("NAME", "") for one in root.iter("MACHINE_TESTED") if one.get("NAME")]
    return {"machine": machine[-1] if machine else "", "stated": out}


def csv(data: bytes) -> Found:
    """Of the one column file of the examples: target, measured, direction, air; decimal commas, semicolons, headings in line 2."""
    text = text_of(data)
    lines = [] if text is None else text.split("\n")
    if len(lines) < 4 or '"' in "\n".join(lines[1:]):
        return None
    head = [cell.strip() for cell in lines[1].split(";")]
    if any(head.count(name) != 1 for name in ("Target", "Reading", "Dir", "Air")):
        return None
    rows = [line.split(";") for line in lines[2:] if line.strip()]
    cells = [
        {name: row[head.index(name)].strip() for name in ("Target", "Reading", "Dir", "Air") if head.index(name) < len(row)} for row in rows
    ]
    if any("".join(row[len(head) :]).strip() for row in rows):
        return None
    if len(rows) < 2 or any(len(row) != 4 or "." in row["Target"] + row["Reading"] + row["Air"] for row in cells):
        return None
    columns = {name: numbers([row[name].replace(",", ".") for row in cells]) for name in ("Target", "Reading", "Air")}
    if None in columns.values() or any(row["Dir"] not in ("+", "-") for row in cells):
        return None
    if any(not -20 <= air <= 50 for air in columns["Air"] or ()):
        return None
    return {
        "axis": "X",
        "machine": "",
        "position": columns["Target"],
        "direction": [1 if row["Dir"] == "+" else -1 for row in cells],
        "deviation": [a - b for a, b in zip(columns["Reading"] or (), columns["Target"] or (), strict=True)],
    }
