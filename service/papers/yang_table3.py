"""Yang and Kim, Table 3 and the text of 3.3: EXX by laser against the line from the ball bar."""

from __future__ import annotations

import numpy as np

from abbe.models.functions.line_fit import slope_through_origin, straight_line
from abbe.service.papers import yang_printed as paper
from abbe.service.papers.compare import Computed, computed_from
from abbe.service.papers.printed import Printed, values
from abbe.service.papers.row import Erratum, PaperRow


def restored_x_mm() -> list[float]:
    """Positions of Table 3 with the damaged one replaced by the mean of its neighbours, which are equally spaced."""
    x = values(paper.TABLE3_X)
    x[paper.DAMAGED] = 0.5 * (x[paper.DAMAGED - 1] + x[paper.DAMAGED + 1])
    return x


def bar_line_um() -> list[float]:
    """The ball bar's line at the positions of the laser's readings, um."""
    slope = paper.TABLE2["dxx"][1].value
    return [slope * x * 1e3 for x in restored_x_mm()]


def laser_slope_rows(printed: Printed) -> list[PaperRow]:
    """The laser's slope of Table 2 from the readings of Table 3: only a line through the origin reproduces it."""
    x = np.array(restored_x_mm())
    by_origin = computed_from(
        lambda *y: slope_through_origin(x, np.array(y)) * 1e-3, *paper.TABLE3_LASER, because="readings rounded to 0.1 µm"
    )
    slope, intercept = straight_line(x, np.array(values(paper.TABLE3_LASER)))
    ordinary = computed_from(lambda *y: straight_line(x, np.array(y))[0] * 1e-3, *paper.TABLE3_LASER, because="readings rounded to 0.1 µm")
    share = 100.0 * (by_origin.value - printed.value) / printed.value
    return [
        PaperRow(
            "yang",
            "Table 2",
            "dxx, laser, line through origin",
            "mm/mm",
            printed,
            by_origin,
            "slope_through_origin on Table 3 (23 readings, x restored)",
            f"off by {abs(share):.2f} %: readings rounded to 0.1 µm allow that",
        ),
        PaperRow(
            "yang",
            "Table 2",
            "dxx, laser, ordinary line",
            "mm/mm",
            printed,
            ordinary,
            "straight_line on Table 3 (23 readings, x restored)",
            f"slope {slope * 1e-3:.4e} with intercept {intercept:.2f} µm is not what is printed: the paper fits through the origin",
            again=True,
        ),
    ]


def rows() -> list[PaperRow]:
    """Rows of the positions, of the three columns, and of the figures derived from them in the text."""
    return [_position(), *_laser_column(), *_bar_column(), *_difference_column(), *_figures()]


def _position() -> PaperRow:
    x = restored_x_mm()[paper.DAMAGED]
    text = "digits lost in the text file. With 254.0 mm the bar's line gives the printed −22.1 µm (row of the bar column)"
    how = "middle of the neighbouring positions 215.9 and 292.1 mm"
    return PaperRow(
        "yang", "Table 3", "eighth position", "mm", paper.TABLE3_X[paper.DAMAGED], Computed(x), how, "damaged print", Erratum(text)
    )


def _laser_column() -> list[PaperRow]:
    why = "measured: input, nothing can compute it"
    return [
        PaperRow("yang", "Table 3", f"laser at {x:g} mm", "µm", number, why=why, series="laser column", given=True)
        for x, number in zip(restored_x_mm(), paper.TABLE3_LASER, strict=True)
    ]


def _bar_column() -> list[PaperRow]:
    slope = paper.TABLE2["dxx"][1]
    how = f"bar slope {slope.text} of Table 2 times x"
    return [_in_column("bar", x, number, slope.value * x * 1e3, how) for x, number in zip(restored_x_mm(), paper.TABLE3_BAR, strict=True)]


def _difference_column() -> list[PaperRow]:
    how = "printed laser − printed bar, taken as exact"
    return [
        _in_column("laser − bar", x, number, laser.value - bar.value, how)
        for x, laser, bar, number in zip(restored_x_mm(), paper.TABLE3_LASER, paper.TABLE3_BAR, paper.TABLE3_DIFFERENCE, strict=True)
    ]


def _in_column(name: str, x_mm: float, number: Printed, value_um: float, how: str) -> PaperRow:
    """Row of a column; the number at the origin is always zero, so it is no evidence."""
    quantity, series = f"{name} at {x_mm:g} mm", f"{name} column"
    if x_mm == 0.0:
        why = "zero by construction: readings and lines start at the origin"
        return PaperRow("yang", "Table 3", quantity, "µm", number, why=why, series=series, given=True)
    return PaperRow("yang", "Table 3", quantity, "µm", number, Computed(value_um), how, series=series)


def _figures() -> list[PaperRow]:
    apart = np.array(values(paper.TABLE3_LASER)) - np.array(values(paper.TABLE3_BAR))
    at = restored_x_mm()[int(np.argmax(np.abs(apart)))]
    laser, bar, _ = paper.TABLE2["dxx"]
    end = restored_x_mm()[-1]
    lines = Computed(abs(laser.value - bar.value) * end * 1e3)
    size = float(np.abs(apart).max())
    column = "printed laser − printed bar"
    return [
        PaperRow("yang", "Table 3", "largest |laser − bar|", "µm", paper.TABLE3_MAX, Computed(size), column, f"at {at:g} mm"),
        PaperRow(
            "yang", "Table 3", "mean |laser − bar|", "µm", paper.TABLE3_MEAN, Computed(float(np.abs(apart).mean())), f"{column}, 23 points"
        ),
        PaperRow(
            "yang", "3.3", f"the two lines apart at {end:g} mm", "µm", paper.LINES_AT_END, lines, "slopes of Table 2 times the travel"
        ),
    ]
