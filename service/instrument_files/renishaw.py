"""Renishaw .rtl and .rta: tests of positioning and of angle, as text in sections. Known from two public readers and one writer.

Numbers are mm for targets; deviations are µm in .rtl and mrad in .rta. The runs of a test in both directions are read alternately along
the targets and back. Unknown parts of the format are refused, not guessed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from abbe.models.arrays import F1
from abbe.service.config_schema import COLDEST_C, WARMEST_C
from abbe.service.formats.files import TextFile
from abbe.service.instrument_files.content import HPA, AxisReadings, Content, along, axis_of, digest, step_of, text_file

KINDS = {"rtl": ("linear", "length", 1e-3), "rta": ("angular", "angle", 1e-3)}
"""For each file type: the owner that its heading must name, the quantity of its deviations, and their unit in mm or rad."""
ONE_WAY, BOTH_WAYS = ("0", "1", "2", "0"), ("0", "0", "2", "0")
"""First four words of ``Flags``."""
LARGEST_MRAD = 100.0
MOST = 20_000
"""Largest accepted number of targets, and of runs; no test has more."""
_SECTION = re.compile(r"([A-Z][A-Z -]*)::")
_NEEDED = ("HEADER", "TARGET DATA", "RUNS", "DEVIATIONS", "EOF")
_READ = (*_NEEDED, "USER-TEXT", "EQUIPMENT", "ENVIRONMENT")
_AIR_HPA = (600.0, 1100.0)
Lines = list[tuple[int, str]]


@dataclass(frozen=True, slots=True)
class _FileSection:
    """Line of the heading, and the lines below it."""

    at: int
    lines: Lines


@dataclass
class _Sections:
    """Lines by section, the line of each heading, and the last line of the file."""

    file: TextFile
    lines: dict[str, Lines] = field(default_factory=dict)
    at: dict[str, int] = field(default_factory=dict)
    last: int = 1

    @property
    def header(self) -> _FileSection:
        """The section that says what the file is."""
        return self.section("HEADER")

    @property
    def target_data(self) -> _FileSection:
        """The section of the targets."""
        return self.section("TARGET DATA")

    @property
    def runs(self) -> _FileSection:
        """The section with the number of runs."""
        return self.section("RUNS")

    @property
    def deviations(self) -> _FileSection:
        """The section of the readings."""
        return self.section("DEVIATIONS")

    def section(self, name: str) -> _FileSection:
        """Return a section that every file has (`_NEEDED`)."""
        return _FileSection(self.at[name], self.lines[name])


def read_renishaw(name: str, data: bytes) -> Content:
    """Read a .rtl or .rta file.

    Raises
    ------
    FileFormatError
        The file is incomplete, contradicts itself, or holds something unknown; the message has the line.
    """
    file = text_file(name, data)
    parts = _sections(file)
    head = _facts(file, parts.header.lines)
    kind = head.get("file type", "").lower()
    _, quantity, unit = _kind(parts, kind, head.get("owner", ""))
    targets, both = _targets(parts)
    rows, words = _rows(parts, targets.size, _run_count(parts, both=both))
    notes = [f"section {one} (line {at}) is not known and was not read" for one, at in parts.at.items() if one not in _READ]
    _check_size(file, rows, quantity, float(np.ptp(targets)) / unit)
    rows, dropped = _readings(parts, rows, targets.size, both=both)
    notes += [dropped] if dropped else []
    user = _facts(file, parts.lines.get("USER-TEXT", []))
    further, read, odd = _environment(parts, axis_of(user.get("axis", "")), len(rows))
    position = np.array([targets[t] for _, _, t, _ in rows])
    rising = 1.0 if targets[-1] > targets[0] else -1.0
    test = AxisReadings(
        quantity=quantity,
        axis=axis_of(user.get("axis", "")),
        position_mm=position,
        direction=np.array([rising * way for _, way, _, _ in rows]),
        deviation=np.array([value for _, _, _, value in rows]) * unit,
        resolution=step_of(words, unit),
        further=further,
    )
    said = {key.capitalize(): value for key, value in (head | user).items() if value} | read
    return Content(
        name=name,
        form=f"Renishaw .{kind}",
        sha256=digest(data),
        machine=user.get("machine", ""),
        said=said,
        test=test,
        notes=(*notes, *odd),
    )


def _sections(file: TextFile) -> _Sections:
    out = _Sections(file)
    now: Lines | None = None
    for line, text in file.lines():
        out.last = line
        heading = _SECTION.fullmatch(text.strip())
        if heading is not None:
            name = heading.group(1).strip()
            if name in out.at:
                raise file.wrong(line, f"a second section {name}:: (the first is in line {out.at[name]})")
            if now is None and name != "HEADER":
                raise file.wrong(line, f"the file begins with {name}::, expected HEADER::")
            now = out.lines.setdefault(name, [])
            out.at[name] = line
        elif text.strip():
            if now is None or "EOF" in out.at:
                raise file.wrong(line, f"{text.strip()[:40]!r} is outside of every section")
            now.append((line, text.strip()))
    for name in _NEEDED:
        if name not in out.at:
            raise file.wrong(out.last, f"section {name}:: is missing: the file is cut off, or is not an .rtl or .rta file")
    return out


def _facts(file: TextFile, lines: Lines) -> dict[str, str]:
    """Return the facts of a section: names in small letters, and their values."""
    out = dict[str, str]()
    for line, text in lines:
        name, colon, value = text.partition(":")
        key = " ".join(name.split()).lower()
        if out.get(key, value.strip()) != value.strip():
            raise file.wrong(line, f"a second {name.strip()[:40]}: {out[key]!r} before, {value.strip()[:40]!r} here")
        out |= {key: value.strip()} if colon else {}
    return out


def _kind(parts: _Sections, kind: str, owner: str) -> tuple[str, str, float]:
    at = parts.header.at
    if kind not in KINDS:
        what = f"the file type is {kind!r}" if kind else "'File type' is missing"
        raise parts.file.wrong(at, f"{what}, expected rtl or rta", "only tests of positioning and of angle can be read")
    if owner.lower() != KINDS[kind][0]:
        raise parts.file.wrong(at, f"the owner is {owner!r}, expected {KINDS[kind][0]!r} in a .{kind}")
    return KINDS[kind]


def _targets(parts: _Sections) -> tuple[F1, bool]:
    """The targets, mm, and whether they were approached from both sides."""
    file, at, lines, values = parts.file, parts.target_data.at, dict[str, tuple[int, str]](), list[float]()
    for line, text in parts.target_data.lines:
        key, colon, rest = text.partition(":")
        name = " ".join(key.split()).lower()
        known = name in ("target-count", "targets", "flags") and name not in lines if colon else "targets" in lines and "flags" not in lines
        if not known and not (colon and name == "filetype"):
            raise file.wrong(line, f"{text[:40]!r} is unknown or repeated in TARGET DATA::")
        lines |= {name: (line, rest.strip())} if colon else {}
        if not colon or name == "targets":
            values += [file.number(line, word, "a target") for word in (rest if colon else text).split()]
    if not {"target-count", "targets", "flags"} <= set(lines):
        raise file.wrong(at, "TARGET DATA:: needs Target-count, Targets and Flags")
    count, both = _whole(file, *lines["target-count"], "Target-count"), _both(file, *lines["flags"])
    if len(values) != count:
        raise file.wrong(at, f"{len(values)} targets, Target-count says {count}")
    step = np.diff(values)
    if count < 2 or not ((step > 0.0).all() or (step < 0.0).all()):
        raise file.wrong(at, "expected two or more targets, all rising or all falling")
    return np.array(values), both


def _both(file: TextFile, line: int, rest: str) -> bool:
    flags = tuple(rest.split())[:4]
    if flags not in (ONE_WAY, BOTH_WAYS):
        known = f"{' '.join(ONE_WAY)} (one direction) and {' '.join(BOTH_WAYS)} (both)"
        raise file.wrong(line, f"Flags {rest.strip()[:40]!r} are not known; {known} are", "send the file to the people who write Abbe")
    return flags == BOTH_WAYS


def _whole(file: TextFile, line: int, word: str, what: str) -> int:
    if re.fullmatch(r"[0-9]{1,9}", word) is None or not 1 <= int(word) <= MOST:
        raise file.wrong(line, f"{what} is {word[:40]!r}, expected a whole number from 1 to {MOST}")
    return int(word)


def _run_count(parts: _Sections, *, both: bool) -> int:
    file, lines = parts.file, parts.runs.lines
    at = lines[0][0] if lines else parts.runs.at
    if len(lines) != 1 or not re.match(r"run-count\s*:", lines[0][1], re.IGNORECASE):
        raise file.wrong(at, "section RUNS:: must have exactly one line, Run-count")
    count = _whole(file, at, lines[0][1].partition(":")[2].strip(), "Run-count")
    if both and count % 2:
        raise file.wrong(at, f"Run-count is {count}: a test in both directions has an even number of runs; its last run back is missing")
    return count


Row = tuple[int, int, int, float]
"""Line, way (+1 along the targets), target from 0, deviation."""


def _rows(parts: _Sections, targets: int, runs: int) -> tuple[list[Row], list[str]]:
    """Return the deviations in order, checked against the numbers of targets and runs, and their values as printed."""
    file, lines = parts.file, parts.deviations.lines
    if not lines or " ".join(lines[0][1].split()).lower() != "run target data:":
        raise file.wrong(lines[0][0] if lines else parts.deviations.at, "expected the line 'Run Target Data:'")
    out, words = list[Row](), list[str]()
    for k, (line, text) in enumerate(lines[1:]):
        cells = text.split()
        if len(cells) != 3:
            raise file.wrong(line, f"{len(cells)} values, expected run, target and deviation")
        run, target = _whole(file, line, cells[0], "the run"), _whole(file, line, cells[1], "the target")
        wanted, place = divmod(k, targets)
        if wanted >= runs:
            raise file.wrong(line, f"more rows than {runs} runs of {targets} targets")
        way = (1 if target == 1 else -1) if place == 0 else out[-1][1]
        if (run, target - 1) != (wanted + 1, place if way > 0 else targets - 1 - place):
            expected = f"run {wanted + 1}, target {(place if way > 0 else targets - 1 - place) + 1}"
            raise file.wrong(line, f"run {run}, target {target}, expected {expected}")
        out.append((line, way, target - 1, file.number(line, cells[2], "the deviation")))
        words.append(cells[2])
    if len(out) != runs * targets:
        raise file.wrong(lines[-1][0], f"the file ends after {len(out)} of {runs * targets} deviations")
    return out, words


def _check_size(file: TextFile, rows: list[Row], quantity: str, travel: float) -> None:
    most = travel if quantity == "length" else LARGEST_MRAD
    for line, *_, value in rows:
        if abs(value) > most:
            unit = "µm, more than the targets are apart" if quantity == "length" else "mrad, more than a guide can turn"
            raise file.wrong(line, f"the deviation is {value:g} {unit}")


def _readings(parts: _Sections, rows: list[Row], targets: int, *, both: bool) -> tuple[list[Row], str]:
    """Return the rows that are readings, and a note on the others: one writer fills the way back of a one-way test with zeros."""
    wrong = [k for k in range(0, len(rows), targets) if (rows[k][1] > 0) != (not both or (k // targets) % 2 == 0)]
    if not wrong:
        return rows, ""
    runs = [rows[k : k + targets] for k in wrong]
    filler = not both and all(value == 0.0 for run in runs for *_, value in run)
    if not filler or len(wrong) * 2 * targets != len(rows):
        flags = "both directions" if both else "one direction"
        way = "along the targets" if rows[wrong[0]][1] > 0 else "back"
        raise parts.file.wrong(rows[wrong[0]][0], f"run {wrong[0] // targets + 1} is read {way}, but the flags say {flags}")
    left = {row[0] for run in runs for row in run}
    return [row for row in rows if row[0] not in left], f"{len(wrong)} runs back hold only zeros in a test of one direction: no readings"


def _environment(parts: _Sections, axis: str, n: int) -> tuple[dict[str, F1], dict[str, str], list[str]]:
    """Return the columns of temperature and pressure, all values as text, and notes on impossible values."""
    columns, said, notes = dict[str, F1](), dict[str, str](), list[str]()
    material = list[list[float]]()
    for line, text in parts.lines.get("ENVIRONMENT", []):
        name, _, rest = text.partition(":")
        key = " ".join(name.split())
        if key in said:
            raise parts.file.wrong(line, f"a second {key[:40]}")
        said[key] = " ".join(rest.replace('"', " ").split())
        taken = _TAKEN.get(key.lower())
        if taken is None:
            continue
        values = [parts.file.number(line, word, key) for word in rest.split()]
        low, high, unit = taken
        if not 1 <= len(values) <= 3:
            raise parts.file.wrong(line, f"{key} has {len(values)} values, expected 1 to 3 (start, middle, end)")
        if not all(low <= v <= high for v in values) or not any(values):
            notes.append(f"{key} (line {line}) is zero, or not from {low:g} to {high:g}: it was not used")
        elif key.lower().startswith("mat"):
            material.append(values)
        else:
            columns["temp_air_C" if unit == 1.0 else "pressure_air_Pa"] = along(values, n) * unit
    if said.get("Exp coeff", "").strip("0. "):
        notes.append(
            f"Exp coeff is {said['Exp coeff']}: if the laser compensated the material, state it as laser_per_k in the machine file"
        )
    if material and axis:
        columns[f"temp_{axis.lower()}_C"] = np.mean([along(values, n) for values in material], axis=0)
    return columns, said, notes


_MATERIAL = (COLDEST_C, WARMEST_C, 1.0)
_TAKEN: Mapping[str, tuple[float, float, float]] = {
    "air temp": _MATERIAL,
    "air press": (*_AIR_HPA, HPA),
    **{f"mat temp {k}": _MATERIAL for k in (1, 2, 3)},
}
"""Quantities that become columns, by name in the file: least and largest value, and the unit in °C or Pa."""
