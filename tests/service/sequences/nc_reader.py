"""A tiny reader of NC programs, by the manuals and not by our writer: where a program goes, where it rests, where it stops."""

import re
from dataclasses import dataclass

WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.\d*|\.?\d+))")


@dataclass(frozen=True)
class Event:
    """``kind``: go, arc, rest or halt; ``at``: X, Y, Z after it; ``value``: feed, seconds, or (for an arc) centre and sense."""

    kind: str
    at: tuple[float, float, float]
    value: object


def read_gcode(text: str, *, dwell: str) -> list[Event]:
    """Events of a G-code program; ``dwell``: the word that carries it, and its unit: F_s, P_ms, P_s, X_s."""
    at, feed, plane, out = [float("nan")] * 3, 0.0, "XY", []
    word, unit = dwell.split("_")
    for line in text.splitlines():
        code = re.sub(r"\([^)]*\)|;.*$|MSG\(.*\)$", "", line).strip()
        if not code or code == "%" or re.fullmatch(r"O\d{4}", code):
            continue
        words = WORD.findall(code)
        assert "".join(a + b for a, b in words) == code.replace(" ", ""), line
        g = [float(v) for k, v in words if k == "G"]
        value = {k: float(v) for k, v in words if k not in "GN"}
        plane = {17.0: "XY", 18.0: "ZX", 19.0: "YZ"}.get(next((x for x in g if x in (17.0, 18.0, 19.0)), 0.0), plane)
        if 4.0 in g:
            out.append(Event("rest", tuple(at), value[word] * (1e-3 if unit == "ms" else 1.0)))
            continue
        if value.get("M") == 0.0:
            out.append(Event("halt", tuple(at), line))
            continue
        start = list(at)
        at = [value.get(k, at[i]) for i, k in enumerate("XYZ")]
        if 1.0 in g:
            feed = value.get("F", feed)
            out.append(Event("go", tuple(at), feed))
        elif 2.0 in g or 3.0 in g:
            feed = value.get("F", feed)
            centre = [start[i] + value.get(k, 0.0) for i, k in enumerate("IJK")]
            out.append(Event("arc", tuple(at), (plane, tuple(centre), 3.0 in g)))
    return out


def read_heidenhain(text: str) -> list[Event]:
    """Events of a plain-language program; block numbers must count from 0."""
    at, centre, out, letters = [float("nan")] * 3, [0.0] * 3, [], ""
    for number, line in enumerate(text.splitlines()):
        head, _, code = line.partition(" ")
        assert int(head) == number
        code = code.split(";")[0].strip()
        found = dict(re.findall(r"([XYZ])([-+]\d+\.\d+)", code))
        if code.startswith("CC "):
            letters = "".join(found)
            centre = [float(found.get(k, at[i])) for i, k in enumerate("XYZ")]
        elif code.startswith("L M0"):
            out.append(Event("halt", tuple(at), text.splitlines()[number - 1]))
        elif code.startswith(("L ", "C ")) and found:
            at = [float(found.get(k, at[i])) for i, k in enumerate("XYZ")]
            plane = {"XY": "XY", "YZ": "YZ", "XZ": "ZX"}.get(letters, "")
            is_arc = code.startswith("C ")
            out.append(Event("arc" if is_arc else "go", tuple(at), (plane, tuple(centre), "DR+" in code) if is_arc else code))
        elif code.startswith("CYCL DEF 9.1"):
            out.append(Event("rest", tuple(at), float(code.split()[-1])))
    return out
