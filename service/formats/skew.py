"""Squareness and lost motion as commands of Marlin, Klipper and grblHAL, which hold no tables.

Marlin and Klipper command x − y·xy − z·(xz − xy·yz) and y − z·yz (both sources alike: Marlin planner.h, Klipper skew_correction.py): a
factor is the deviation of an axis for a unit of travel of another, +e. Klipper takes it as three lengths of a figure with sides of 100
mm: diagonals AC and BD, side AD. Lost motion: M425 of Marlin (needs BACKLASH_GCODE) and $160 to $162 of grblHAL (needs a build with
ENABLE_BACKLASH_COMPENSATION); Klipper compensates no lost motion, grblHAL no skew. Zero is the machine's own zero: another zero would
shift the whole map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from abbe.models.machine import AXES
from abbe.service.errors import FormatRefused
from abbe.service.formats.files import FormatSettings, TextFile, fixed
from abbe.service.formats.model import AxisTable, Compensation
from abbe.service.formats.rules import NOTHING, FormatLimits, SignRule, check_kinds, check_positions

PAIRS = (("Y", "X"), ("Z", "X"), ("Z", "Y"))
"""Axis and output of the three lines, in the order XY, XZ, YZ."""
STRAIGHT_MM = 1e-6
FACTOR_DECIMALS, LENGTH_DECIMALS = 11, 9
SIDE_MM = 100.0
SIGN = SignRule(1, False, "by manual", True, "the program's source: skew +e for a unit of travel; lost motion as measured")


@dataclass(frozen=True, slots=True)
class SkewProgram:
    """One program: its name, its file, and what the file can hold."""

    what: str
    name: str
    skew: bool
    lost_motion: bool

    @property
    def limits(self) -> FormatLimits:
        """Limits of the format: straight lines of two points, and a backlash parameter."""
        return FormatLimits(
            points=2, directional=False, own=False, cross=self.skew, lost_motion=self.lost_motion, lines=True, zero_at_reference=False
        )


MARLIN = SkewProgram("Marlin", "abbe-marlin.gcode", True, True)
KLIPPER = SkewProgram("Klipper", "abbe-klipper.gcode", True, False)
GRBLHAL = SkewProgram("grblHAL", "abbe-grblhal.txt", False, True)


def factor_of(ac: float, bd: float, ad: float) -> float:
    """Return the skew factor from the diagonals and the side of a measured figure, as Marlin and Klipper compute it."""
    ab = math.sqrt(2.0 * ac**2 + 2.0 * bd**2 - 4.0 * ad**2) / 2.0
    return math.tan(0.5 * math.pi - math.acos((ac**2 - ab**2 - ad**2) / (2.0 * ab * ad)))


def lengths_of(factor: float) -> tuple[float, float, float]:
    """Return AC, BD and AD, mm, of a figure with sides of 100 mm whose skew factor is ``factor``."""
    cosine = factor / math.hypot(1.0, factor)
    return SIDE_MM * math.sqrt(2.0 + 2.0 * cosine), SIDE_MM * math.sqrt(2.0 - 2.0 * cosine), SIDE_MM


def write(comp: Compensation, settings: FormatSettings, *, dialect: SkewProgram) -> tuple[TextFile, ...]:
    """Write the commands in one file, and the commands that cancel them.

    Raises
    ------
    FormatRefused
        A table is not a straight line of X over Y, X over Z or Y over Z, or the lost motion of an axis is negative.
    """
    check_kinds(comp, dialect.limits, dialect.what)
    factors = _factors(comp, dialect)
    lost = {a: comp.lost_motion_mm.get(a, 0.0) for a in AXES}
    negative = next((a for a, v in lost.items() if v < 0.0), None)
    if negative is not None:
        raise FormatRefused(
            f"{dialect.what}: the lost motion of {negative} is {lost[negative] * 1e3:.2f} µm, expected 0 or more",
            f"measure the reversals of {negative} again; {NOTHING}",
        )
    lines = _COMMANDS[dialect.what](factors, {a: fixed(v, settings.decimals) for a, v in lost.items()})
    return (TextFile(dialect.name, "\n".join(lines) + "\n"),)


def _factors(comp: Compensation, dialect: SkewProgram) -> tuple[float, float, float]:
    """Return xy, xz and yz of the programs' formula."""
    slope = dict.fromkeys(PAIRS, 0.0)
    for t in comp.tables:
        check_positions(t.position_mm, FormatLimits(points=1000), f"{dialect.what}, table {t.name}")
        line = np.polyfit(t.position_mm, t.forward_mm, 1)
        if (t.axis, t.output) not in slope or t.directional or np.abs(np.polyval(line, t.position_mm) - t.forward_mm).max() > STRAIGHT_MM:
            raise FormatRefused(
                f"{dialect.what}, table {t.name}: the program can hold only straight lines of X over Y, X over Z and Y over Z, the same in "
                "both directions",
                f"give squareness; {NOTHING}",
            )
        slope[(t.axis, t.output)] = float(line[0])
    xy, xz, yz = (SIGN.per_error * -v + 0.0 for v in slope.values())
    return xy, xz + xy * yz, yz


def _marlin(factors: tuple[float, float, float], lost: dict[str, str]) -> list[str]:
    skew = " ".join(f"{w}{fixed(v, FACTOR_DECIMALS)}" for w, v in zip("IJK", factors, strict=True))
    back = " ".join(f"{a}{v}" for a, v in lost.items())
    undo = "; back to nothing: M852 I0 J0 K0, M425 F0, M500"
    return [undo, f"M852 {skew}", f"M425 {back} F1", "M500"]


def _klipper(factors: tuple[float, float, float], _: dict[str, str]) -> list[str]:
    planes = [
        f"{plane}={','.join(fixed(v, LENGTH_DECIMALS) for v in lengths_of(factor))}"
        for plane, factor in zip(("XY", "XZ", "YZ"), factors, strict=True)
    ]
    return ["; back to nothing: SET_SKEW CLEAR=1", f"SET_SKEW {' '.join(planes)}", "SKEW_PROFILE SAVE=abbe", "SAVE_CONFIG"]


def _grblhal(_: tuple[float, float, float], lost: dict[str, str]) -> list[str]:
    return [f"${160 + k}={lost[a]}" for k, a in enumerate(AXES)]


_COMMANDS = {MARLIN.what: _marlin, KLIPPER.what: _klipper, GRBLHAL.what: _grblhal}


def read(files: tuple[TextFile, ...], settings: FormatSettings, *, dialect: SkewProgram) -> Compensation:
    """Read the commands as the program does; the straight lines of squareness are zero at the reference.

    Raises
    ------
    TableFileError
        A command, word or number is not one of this program's, or there is no command.
    FormatRefused
        No machine was given: the commands have no range.
    """
    if settings.machine is None:
        raise FormatRefused(f"{dialect.what}: the commands do not state the strokes, and no machine is given", "give the machine")
    file, found = files[0], dict[str, float]()
    for line, text in file.lines():
        bare = text.partition(";")[0].strip()
        if bare:
            _READ[dialect.what](file, line, bare, found)
    if not found:
        raise file.wrong(1, "there is no command")
    xy, xz, yz = (found.get(k, 0.0) for k in ("xy", "xz", "yz"))
    slopes = (xy, xz - xy * yz, yz)
    start = settings.machine.stroke_mm[:, 0] if settings.reference_mm is None else np.array(settings.reference_mm)
    tables = []
    for (axis, output), slope in zip(PAIRS, slopes, strict=True):
        position = settings.machine.stroke_mm[AXES.index(axis)]
        value = SIGN.from_file(slope * (position - start[AXES.index(axis)]), position)
        tables.append(AxisTable(axis, output, position, value, value))
    lost = {a: found[a] for a in AXES if found.get(a)}
    return Compensation(tuple(tables) if dialect.skew else (), lost_motion_mm=lost)


def _read_marlin(file: TextFile, line: int, text: str, found: dict[str, float]) -> None:
    code, *words = text.split()
    names = {"M852": {"I": "xy", "J": "xz", "K": "yz"}, "M425": {"X": "X", "Y": "Y", "Z": "Z", "F": "share", "S": "smooth"}, "M500": {}}
    if code not in names:
        raise file.wrong(line, f"{code} is neither M852, M425 nor M500")
    for word in words:
        if word[0] not in names[code]:
            raise file.wrong(line, f"{code} has no parameter {word}")
        found[names[code][word[0]]] = file.number(line, word[1:], word[0])
    if found.get("share", 1.0) != 1.0:
        raise file.wrong(line, f"F{found['share']:g} corrects only a part of the lost motion, expected F1")


def _read_klipper(file: TextFile, line: int, text: str, found: dict[str, float]) -> None:
    code, *words = text.split()
    if code in ("SKEW_PROFILE", "SAVE_CONFIG"):
        return
    if code != "SET_SKEW":
        raise file.wrong(line, f"{code} is neither SET_SKEW, SKEW_PROFILE nor SAVE_CONFIG")
    for word in words:
        plane, _, lengths = word.partition("=")
        values = [file.number(line, v, plane) for v in lengths.split(",")]
        if plane not in ("XY", "XZ", "YZ") or len(values) != 3:
            raise file.wrong(line, f"{word} is not XY, XZ or YZ with three lengths")
        try:
            found[plane.lower()] = factor_of(*values)
        except (ValueError, ZeroDivisionError):
            raise file.wrong(line, f"{word}: no parallelogram has these lengths") from None


def _read_grblhal(file: TextFile, line: int, text: str, found: dict[str, float]) -> None:
    name, _, value = text.partition("=")
    if name not in ("$160", "$161", "$162"):
        raise file.wrong(line, f"{name} is neither $160, $161 nor $162")
    found[AXES[int(name[1:]) - 160]] = file.number(line, value, name)


_READ = {MARLIN.what: _read_marlin, KLIPPER.what: _read_klipper, GRBLHAL.what: _read_grblhal}
