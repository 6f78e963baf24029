"""Volumetric compensation as a network of stock LinuxCNC HAL components: lincurve, mult2, sum2.

A one-axis table becomes a lincurve; a product of two functions becomes two lincurves and a mult2. A lincurve has 2 to 16 points and holds
its end values beyond them; ``halcmd setp`` changes it live. A chain of sum2 adds the corrections to the command of an axis and ends in the
signal ``drive-x``, ``drive-y`` or ``drive-z``, which commands the servo; motor-pos-fb gets the command without corrections. The network
has no input for the direction of motion, so lost motion belongs in COMP_FILE. The file replaces the lines that connect motor-pos-cmd to
motor-pos-fb; load it after ``addf motion-controller``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from abbe.service.formats.files import FormatSettings, TextFile, increasing, short
from abbe.service.formats.model import AxisCurve, AxisTable, Compensation, ProductTable
from abbe.service.formats.rules import FormatLimits, SignRule, check_kinds, check_positions, check_size, check_table

LIMITS = FormatLimits(points=16, directional=False, own=True, cross=True, products=True)
SIGN = SignRule(-1, False, "verified by execution", True, "what is added to the drive's command: −e")
LEVERS = FormatLimits(points=16, size_mm=1e5)
WHAT = "LinuxCNC HAL network"
NAME = "abbe.hal"
JOINTS = {"X": 0, "Y": 1, "Z": 2}
ANGLE_DECIMALS = 3
"""Additional decimals of an angle, which acts at a lever of up to a metre."""
_TABLE = re.compile(r"t-([xyz])([xyz])")
_PART = re.compile(r"(a|l)-([xyz])([xyz])([xyz])")


@dataclass
class _Network:
    """Content of a HAL file: curves with their size, parameter values with their line, running and wired components."""

    points: dict[str, int] = field(default_factory=dict)
    values: dict[str, tuple[float, int]] = field(default_factory=dict)
    running: set[str] = field(default_factory=set)
    wired: set[str] = field(default_factory=set)


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write the network as one HAL file: components, order of execution, wires, tables.

    Raises
    ------
    FormatRefused
        There is a grid, an error motion, a direction-dependent table, or a table with more than 16 points.
    """
    check_kinds(comp, LIMITS, WHAT)
    curves: list[tuple[str, str, AxisCurve, int]] = []
    for table in comp.tables:
        check_table(table, LIMITS, WHAT, settings.reference_mm, settings.step_mm)
        number = SIGN.to_file(table.forward_mm, table.position_mm)
        name = f"t-{table.output}{table.axis}".lower()
        curves.append((name, table.output, AxisCurve(table.axis, table.position_mm, number), settings.decimals))
    for p in comp.products:
        for curve, limits in ((p.angle, LIMITS), (p.lever, LEVERS)):
            check_positions(curve.position_mm, limits, f"{WHAT}, {p.name}")
            check_size(curve.position_mm, curve.value, limits, f"{WHAT}, {p.name}")
        tail = f"{p.output}{p.angle.axis}{p.lever.axis}".lower()
        number = SIGN.to_file(p.angle.value, p.angle.position_mm)
        curves.append((f"a-{tail}", p.output, AxisCurve(p.angle.axis, p.angle.position_mm, number), settings.decimals + ANGLE_DECIMALS))
        curves.append((f"l-{tail}", p.output, p.lever, settings.decimals))
    return (TextFile(NAME, "\n".join(_hal(comp, curves)) + "\n"),)


def _hal(comp: Compensation, curves: list[tuple[str, str, AxisCurve, int]]) -> list[str]:
    names = [name for name, *_ in curves]
    products = [f"m-{p.output}{p.angle.axis}{p.lever.axis}".lower() for p in comp.products]
    feeds = {a: [n for n, out, *_ in curves if out == a and n[0] == "t"] for a in JOINTS}
    for p, name in zip(comp.products, products, strict=True):
        feeds[p.output].append(name)
    sums = [f"s-{a.lower()}{k}" for a, parts in feeds.items() for k in range(max(1, len(parts)))]
    lines = [f"loadrt lincurve names={','.join(names)} personality={','.join(str(c.value.size) for _, _, c, _ in curves)}"]
    lines += [f"loadrt mult2 names={','.join(products)}"] if products else []
    lines += [f"loadrt sum2 names={','.join(sums)}"]
    lines += [f"addf {name} servo-thread" for name in (*names, *products, *sums)]
    for axis, joint in JOINTS.items():
        inputs = [f"{n}.in" for n, _, c, _ in curves if c.axis == axis]
        if inputs:
            lines.append(f"net abbe-nom-{axis.lower()} joint.{joint}.pos-cmd => {' '.join(inputs)}")
    for name in products:
        lines += [f"net w-{c}{name[1:]} {c}{name[1:]}.out => {name}.in{k}" for k, c in enumerate("al")]
    for axis, parts in feeds.items():
        lines += _summed(axis, parts)
    for name, _, curve, decimals in curves:
        for k, (p, v) in enumerate(zip(curve.position_mm, curve.value, strict=True)):
            lines.append(f"setp {name}.x-val-{k:02d} {short(p, 6)}")
            lines.append(f"setp {name}.y-val-{k:02d} {short(v, decimals)}")
    return lines


def _summed(axis: str, parts: list[str]) -> list[str]:
    """Return the lines that add all corrections of one axis to its motor command, one sum2 each."""
    a, joint = axis.lower(), JOINTS[axis]
    source = f"net abbe-cmd-{a} joint.{joint}.motor-pos-cmd => joint.{joint}.motor-pos-fb s-{a}0.in0"
    lines = [source]
    for k, part in enumerate(parts):
        lines.append(f"net w-{part} {part}.out => s-{a}{k}.in1")
        if k + 1 < len(parts):
            lines.append(f"net w-s-{a}{k} s-{a}{k}.out => s-{a}{k + 1}.in0")
    lines.append(f"net drive-{a} <= s-{a}{max(0, len(parts) - 1)}.out")
    return lines


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read a network written by `write`.

    Raises
    ------
    TableFileError
        A line is of another kind, a point is missing, positions do not increase (HAL does not check that), or a curve does not run.
    """
    file = files[0]
    net = _Network()
    for line, text in file.lines():
        _take(net, file, line, text)
    curves = {name: _curve(net, file, name) for name in net.points}
    tables, products = [], []
    for name, curve in curves.items():
        if (m := _TABLE.fullmatch(name)) is not None:
            out, axis = m.group(1).upper(), m.group(2).upper()
            value = SIGN.from_file(curve.value, curve.position_mm)
            tables.append(AxisTable(axis, out, curve.position_mm, value, value))
        elif (m := _PART.fullmatch(name)) is not None and m.group(1) == "a":
            lever = curves.get(f"l{name[1:]}")
            if lever is None:
                raise file.wrong(1, f"the curve l{name[1:]} of a product is missing")
            angle = AxisCurve(m.group(3).upper(), curve.position_mm, SIGN.from_file(curve.value, curve.position_mm))
            products.append(ProductTable(m.group(2).upper(), angle, AxisCurve(m.group(4).upper(), lever.position_mm, lever.value)))
    return Compensation(tuple(tables), tuple(products))


def _take(net: _Network, file: TextFile, line: int, text: str) -> None:
    cells = text.split()
    if cells[:2] == ["loadrt", "lincurve"] and len(cells) == 4:
        names, sizes = cells[2].removeprefix("names=").split(","), cells[3].removeprefix("personality=").split(",")
        if len(names) != len(sizes) or not all(s.isdigit() and 2 <= int(s) <= LIMITS.points for s in sizes):
            raise file.wrong(line, f"names and personality differ in length, or a curve does not have 2 to {LIMITS.points} points")
        net.points |= {n: int(s) for n, s in zip(names, sizes, strict=True)}
    elif cells[:1] == ["addf"] and len(cells) == 3:
        net.running.add(cells[1])
    elif cells[:1] == ["setp"] and len(cells) == 3:
        net.values[cells[1]] = (file.number(line, cells[2], cells[1]), line)
    elif cells[:1] == ["net"] and len(cells) > 3:
        net.wired |= {w.partition(".")[0] for w in cells[3:] if w.endswith((".in", ".in0", ".in1", ".out"))} | {cells[2].partition(".")[0]}
    elif cells[:1] != ["loadrt"]:
        raise file.wrong(line, f"{text.strip()!r} is not a line of a network written by Abbe")


def _curve(net: _Network, file: TextFile, name: str) -> AxisCurve:
    found: dict[str, list[float]] = {"x": [], "y": []}
    lines: list[int] = []
    for k in range(net.points[name]):
        for which, values in found.items():
            key = f"{name}.{which}-val-{k:02d}"
            if key not in net.values:
                raise file.wrong(1, f"{key} is not set: HAL would take 0")
            values.append(net.values[key][0])
            if which == "x":
                lines.append(net.values[key][1])
    if name not in net.running or name not in net.wired:
        raise file.wrong(1, f"curve {name} is not run (addf) or not wired (net): it would do nothing")
    increasing(file, found["x"], lines)
    match = _TABLE.fullmatch(name) or _PART.fullmatch(name)
    if match is None:
        raise file.wrong(1, f"curve {name!r} has none of the names t-OA, a-OAL, l-OAL")
    axis = match.group(2) if name[0] == "t" else match.group(3 if name[0] == "a" else 4)
    return AxisCurve(axis.upper(), np.array(found["x"]), np.array(found["y"]))
