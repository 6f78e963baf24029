"""LinuxCNC kinematics component: a 3-D grid of corrections as C source for ``halcompile --install`` (abbekins.c).

The whole field acts, trilinear between the nodes, at the commanded position. A HAL pin puts it in force and takes it back while the machine
stands, without a restart. The component has no input for the direction of motion: lost motion goes into [JOINT_n] BACKLASH. The numbers are
constants of the program, so no file can be missing or belong to another table when the control starts.
"""

from __future__ import annotations

import re
from importlib import resources

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES
from abbe.service.formats.files import FormatSettings, TextFile, whole
from abbe.service.formats.model import Compensation, Lattice
from abbe.service.formats.rules import FormatLimits, SignRule, check_kinds, check_positions, check_size
from abbe.service.formats.siemens import step_of

LIMITS = FormatLimits(points=64, equidistant=True, own=False, lattice=True)
SIGN = SignRule(-1, False, "verified by execution", True, "what is added to the joints' position: −e")
WHAT = "LinuxCNC kinematics"
NAME = "abbekins.c"
POSITION_DECIMALS = 6
_ARRAY = re.compile(r"(COUNT|FIRST|STEP)\[3\] = \{([^}]*)\}")
_BEGIN, _END = re.compile(r"static const double TABLE\[\]\[3\] = \{.*"), "};"


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write the program with the numbers of the grid.

    Raises
    ------
    FormatRefused
        There is no grid or another kind of table, the spacing is unequal, or a correction is too large.
    """
    check_kinds(comp, LIMITS, WHAT)
    assert comp.lattice is not None
    grids, values = comp.lattice.position_mm, comp.lattice.correction_mm
    for axis, grid in zip(AXES, grids, strict=True):
        check_positions(grid, LIMITS, f"{WHAT}, {axis}")
    flat = values.reshape(-1, 3)
    check_size(np.zeros(flat.size), flat.ravel(), LIMITS, WHAT)
    numbers = SIGN.to_file(flat, np.zeros(1))
    parts = {
        "COUNT": ", ".join(str(g.size) for g in grids),
        "FIRST": ", ".join(whole(g[0], POSITION_DECIMALS) for g in grids),
        "STEP": ", ".join(whole(step_of(g, f"{WHAT}, {a}"), POSITION_DECIMALS) for a, g in zip(AXES, grids, strict=True)),
        "TABLE": "\n".join("    {" + ", ".join(whole(v, settings.decimals) for v in row) + "}," for row in numbers),
    }
    text = resources.files(__package__).joinpath(NAME).read_text(encoding="utf-8")
    for name, part in parts.items():
        text = text.replace(f"@{name}@", part)
    return (TextFile(NAME, text),)


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the numbers of a program back.

    Raises
    ------
    TableFileError
        Counts, first positions or steps are missing, a node lacks one of its three numbers, or the number of nodes is not the stated one.
    """
    file = files[0]
    found: dict[str, F1] = {}
    rows: list[list[float]] = []
    inside = False
    for line, text in file.lines():
        for name, words in _ARRAY.findall(text):
            found[name] = np.array([file.number(line, w.strip(), name) for w in words.split(",")])
        if inside and text.strip() == _END:
            inside = False
        elif inside:
            cells = text.strip().removeprefix("{").removesuffix("},").split(",")
            if len(cells) != 3:
                raise file.wrong(line, f"{text.strip()!r} is not a node of three numbers")
            rows.append([file.number(line, w.strip(), "the correction") for w in cells])
        inside = inside or _BEGIN.fullmatch(text.strip()) is not None
    return Compensation(lattice=_lattice(file, found, rows))


def _lattice(file: TextFile, found: dict[str, F1], rows: list[list[float]]) -> Lattice:
    wanted = [found[name] for name in ("COUNT", "FIRST", "STEP") if name in found]
    if len(wanted) != len(found) or len(wanted) != 3 or any(v.size != 3 for v in wanted) or not (wanted[2] > 0).all():
        raise file.wrong(1, "COUNT, FIRST and STEP of three axes are not there")
    count, first, step = wanted
    nx, ny, nz = (int(v) for v in count)
    if min(nx, ny, nz) < 2 or len(rows) != nx * ny * nz:
        raise file.wrong(len(file.text.splitlines()), f"{len(rows)} nodes, {nx} x {ny} x {nz} stated")
    x, y, z = (f + s * np.arange(int(n)) for f, s, n in zip(first, step, count, strict=True))
    values = SIGN.from_file(np.array(rows), np.zeros(1)).reshape(nx, ny, nz, 3)
    return Lattice((x, y, z), values)
