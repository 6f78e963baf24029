"""What an imported campaign holds beside its runs, for a report: angles, means of both directions, stated figures, what is unknown."""

from __future__ import annotations

import numpy as np

from abbe.models.evaluation.iso230_2 import ScaleBudget, Value, positioning
from abbe.service.domain.document import Doc
from abbe.service.domain.imported_file import OtherReadings, SourceFile, StatedFigure
from abbe.service.rendering.document import ReportFigure
from abbe.service.verification.iso_readings import approaches_of
from abbe.service.verification.iso_report import UM, Evaluated, positioning_rows

URAD = 1e6
STATED = "as its file states it"
NO_U = "U of the figures that a file states: the file holds no uncertainty"
ANGLE_STATEMENT = (
    "U of angles (rows of ISO 230-2 for the angular deviation of an axis, ISO 230-1) includes the scatter of the approaches and the "
    "resolution, not the calibration of the instrument, which the file does not state."
)


def evaluate_imported(campaign: Doc) -> Evaluated:
    """Evaluate ``origins``, ``readings`` and ``stated`` of a campaign; empty for a campaign that Abbe measured."""
    out = Evaluated()
    for doc in campaign.get("readings", ()):
        _readings(out, OtherReadings.read(doc))
    for doc in campaign.get("stated", ()):
        one = StatedFigure.read(doc)
        out.figures.append(ReportFigure(f"{one.group}, {one.file}", one.symbol, one.name, one.value, None, one.unit, STATED))
    out.not_observable += [NO_U] if campaign.get("stated") else []
    for doc in campaign.get("origins", ()):
        origin = SourceFile.read(doc)
        out.remarks += [f"{origin.file} ({origin.format}) does not say: {text}" for text in origin.unknown]
        out.conditions[f"File {origin.file}"] = "; ".join(f"{name}: {value}" for name, value in origin.said.items()) or origin.format
    return out


def _readings(out: Evaluated, read: OtherReadings) -> None:
    if read.kind == "mean":
        _means(out, read)
        return
    cells: dict[tuple[float, int], list[float]] = {}
    for position, way, value in zip(read.position_mm, read.direction, read.deviation, strict=True):
        cells.setdefault((position, way), []).append(value)
    group = f"Axis {read.axis}, set-up {read.setup_id}: angle, ISO 230-1"
    try:
        found = positioning(approaches_of(cells), ScaleBudget(reading_mm=read.resolution / np.sqrt(12.0)))
    except ValueError:
        out.not_observable.append(f"reversal and figures of both directions of {group} ({read.file}): no target was approached from both")
        out.figures += _ranges(read, group)
        return
    out.figures += [_figure(group, symbol, name.replace("positioning", "angle"), v, URAD) for symbol, name, v in positioning_rows(found)]
    out.remarks.append(f"{read.file}: it does not say which angle of axis {read.axis} was measured (pitch, yaw or roll)")
    out.statements += [] if ANGLE_STATEMENT in out.statements else [ANGLE_STATEMENT]


def _ranges(read: OtherReadings, group: str) -> list[ReportFigure]:
    """Range of the mean angle at the targets of a test in one direction."""
    at = np.array(read.position_mm)
    means = [float(np.mean(np.array(read.deviation)[at == p])) for p in np.unique(at)]
    symbol = "E+" if read.direction[0] > 0 else "E-"
    u = read.resolution / np.sqrt(6.0)
    return [_figure(group, symbol, f"systematic deviation, moving in {symbol[1]}", Value(max(means) - min(means), u), URAD)]


def _means(out: Evaluated, read: OtherReadings) -> None:
    """Range of the means of both directions: M of ISO 230-2. The scatter behind a mean is unknown, and so is U."""
    value, group = np.ptp(read.deviation), f"Axis {read.axis}, set-up {read.setup_id}: positioning, ISO 230-2"
    out.figures.append(ReportFigure(group, "M", "range of the mean bidirectional deviations", float(value) * UM, None, "µm", "ISO 230-2"))
    out.not_observable.append(f"U of M of {read.file}: the file holds means, not the readings behind them")


def _figure(group: str, symbol: str, name: str, value: Value | None, factor: float) -> ReportFigure:
    if value is None:
        return ReportFigure(group, symbol, name, None, None, "µrad", "ISO 230-1")
    return ReportFigure(group, symbol, name, value.value_mm * factor, value.u_mm * factor, "µrad", "ISO 230-1")
