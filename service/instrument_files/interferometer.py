"""Tables of an interferometer's signals or of a slow linear run, and the cyclic error that they show, in words and as JSON."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.evaluation.cyclic_interferometer import CyclicError, CyclicOrder, from_linear_run, from_quadrature
from abbe.service.errors import FileFormatError
from abbe.service.instrument_files.answers import ANGLES, LENGTHS
from abbe.service.instrument_files.columns import table_of
from abbe.service.instrument_files.content import read_bytes
from abbe.service.rendering.numbers import plain, with_uncertainty

NM = 1e-6
"""One nanometre, mm."""
WHAT_IT_IS = (
    "cyclic error of the interferometer (periodic nonlinearity), not of a drive: its period is the fringe; the effect "
    "`cyclic_error` has the lead of a screw or the pitch of an encoder as its period"
)
CHANCE = 0.01
UNITS = LENGTHS | ANGLES
HEADINGS = "columns are: phase (deg) and radius; or position (mm) and deviation (um); or else two signals in quadrature"


def cyclic_error_of(path: Path, fringe_nm: float) -> CyclicError:
    """Read a table and find the cyclic error, mm: of signals in quadrature (or as phase and radius), or of readings along a slow run.

    ``fringe_nm``: displacement per period of the signals.

    Raises
    ------
    FileFormatError
        The file is no such table, or its samples do not show the cyclic error.
    """
    table = table_of(path.name, read_bytes(path), 1)
    headings = [heading.lower() for heading in table.headings(1)]
    rows = [(line, cells) for line, cells in table.rows if line > 1]
    short = next((line for line, cells in rows if len(cells) < 2), None)
    if len(headings) < 2 or short is not None or not rows:
        raise table.file.wrong(short or 1, "expected two columns with headings", HEADINGS)

    def column(k: int) -> F1:
        heading = headings[k]
        found = [table.file.number(line, cells[k].strip() if k < len(cells) else "", heading) for line, cells in rows]
        return np.array(found)

    phase, radius, position, deviation = (_place(headings, word) for word in ("phase", "radius", "position", "deviation"))
    fringe = fringe_nm * NM
    try:
        if phase is not None and radius is not None:
            angle, size = column(phase) * _unit(headings[phase], "deg"), column(radius)
            return from_quadrature(size * np.cos(angle), size * np.sin(angle), fringe)
        if position is not None and deviation is not None:
            off = column(deviation) * _unit(headings[deviation], "um")
            return from_linear_run(column(position) * _unit(headings[position], "mm") + off, off, fringe)
        return from_quadrature(column(0), column(1), fringe)
    except ValueError as err:
        raise FileFormatError(f"{path.name}: {err}", "record at least one whole fringe, slowly; " + HEADINGS) from None


def _place(headings: list[str], word: str) -> int | None:
    return next((k for k, heading in enumerate(headings) if heading.startswith(word)), None)


def _unit(heading: str, usual: str) -> float:
    """Factor of the unit in a heading, such as ``position (mm)`` or ``deviation_um``."""
    words = re.findall(r"[a-z]+", heading.replace("µ", "u").replace("μ", "u"))
    return UNITS[next((word for word in words[1:] if word in UNITS), usual)]


def lines_of(found: CyclicError) -> list[str]:
    """Return the result for the terminal, one fact per line."""
    out = [WHAT_IT_IS]
    for one in found.orders:
        size, expanded = with_uncertainty(one.amplitude / NM, one.u_amplitude / NM)
        start, wide = with_uncertainty(np.degrees(one.start_rad), np.degrees(one.u_start_rad))
        times = {1: "once", 2: "twice"}[one.order]
        sure = "" if one.p < CHANCE else f"; not proved (p = {plain(one.p, 2)})"
        out.append(f"order {one.order}, {times} per fringe: amplitude {size} ± {expanded} nm, phase {start} ± {wide} degrees{sure}")
    if found.ellipse is not None:
        e = found.ellipse
        offsets = " and ".join(plain(100.0 * offset / e.radius) for offset in (e.offset_x, e.offset_y))
        out.append(
            f"signals: offsets {offsets} % of the amplitude, gains differ by {plain(100.0 * (e.gain - 1.0))} %, "
            f"{plain(np.degrees(e.quadrature_rad))} degrees from quadrature"
        )
    noise = plain(found.u_reading / NM, 2)
    out.append(
        f"{found.samples} samples, {found.outliers:.1%} of them outliers; in a single reading the cyclic error contributes u = {noise} nm"
    )
    return out


def answer_doc(found: CyclicError) -> dict[str, Any]:
    """Return the result as JSON: nm and rad, standard uncertainties; the error is amplitude * sin(order * phase + start)."""
    doc: dict[str, Any] = {
        "what": "interferometer_cyclic_error",
        "fringe_nm": found.fringe / NM,
        "orders": [_order(o) for o in found.orders],
    }
    doc |= {"u_reading_nm": found.u_reading / NM, "samples": found.samples, "outliers": found.outliers}
    return doc | ({} if found.ellipse is None else {"ellipse": asdict(found.ellipse)})


def _order(one: CyclicOrder) -> dict[str, Any]:
    lengths = {"amplitude_nm": one.amplitude / NM, "u_amplitude_nm": one.u_amplitude / NM}
    return {"order": one.order} | lengths | {"start_rad": one.start_rad, "u_start_rad": one.u_start_rad, "p": one.p}
