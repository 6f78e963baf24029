"""Yang and Kim, Tables 1, 2, 5 and 6 (math.md 8); Table 3 and the simulation have their own modules."""

from __future__ import annotations

import numpy as np

from abbe.models.papers.yang.difference import confidence_interval
from abbe.service.papers import yang_printed as paper
from abbe.service.papers import yang_simulation, yang_table3
from abbe.service.papers.check import PaperCheck
from abbe.service.papers.compare import Computed, computed_from
from abbe.service.papers.printed import Printed
from abbe.service.papers.row import Erratum, PaperRow

_OTHERS = "the ball-bar simulation used 15 more error functions, the origins of Fig. 6 and the tool vector; none is printed"
_RAW = {
    "dxx": "",
    "dyy": "the laser readings of Y are not printed (Fig. 8 is lost)",
    "dzz": "the laser readings of Z are not printed (Fig. 9 is lost)",
}


def rows() -> list[PaperRow]:
    """Every row of the paper, in printed order."""
    table3 = yang_table3.rows()
    return [*_table1(), *_table2(), *table3, *_table4(), *_table5(), *_table6()]


def checks() -> list[PaperCheck]:
    """Checks of Abbe's functions on the paper's numbers."""
    return yang_simulation.checks()


def _table1() -> list[PaperRow]:
    lost = "the laser's polynomials, the range and the random points are not printed; only the interval's arithmetic can be redone"
    out = []
    for name, (mean, sd, _, _) in paper.TABLE1.items():
        out.append(PaperRow("yang", "Table 1", f"mean of {name}", "µm", mean, why=lost, series="means"))
        out.append(PaperRow("yang", "Table 1", f"standard deviation of {name}", "µm", sd, why=lost, series="standard deviations"))
    out.sort(key=lambda r: r.series)
    for name, (mean, sd, low, high) in paper.TABLE1.items():
        ends = confidence_interval(np.array(mean.value), np.array(sd.value), paper.SAMPLES, law="normal")
        how = "confidence_interval(mean, s, 10000), factor 1.96, printed mean and s taken as exact: the interval's arithmetic only"
        out += [
            PaperRow("yang", "Table 1", f"interval of {name}, {end}", "µm", number, Computed(float(ends[k])), how)
            for k, (end, number) in enumerate((("lower", low), ("upper", high)))
        ]
    return out


def _table2() -> list[PaperRow]:
    out = []
    for name, (laser, bar, difference) in paper.TABLE2.items():
        if name == "dxx":
            out += yang_table3.laser_slope_rows(laser)
        else:
            why = _RAW.get(name, "the laser's readings of the squareness are not printed")
            out.append(PaperRow("yang", "Table 2", f"{name}, laser", _unit(name), laser, why=why))
        out.append(PaperRow("yang", "Table 2", f"{name}, ball bar", _unit(name), bar, why=_OTHERS))
        out.append(_difference("Table 2", name, laser, bar, difference))
    for table, where in ((paper.TABLE5, "Table 5"), (paper.TABLE6, "Table 6")):
        out += [_difference(where, n, v[0], v[1], paper.TABLE2[n][2]) for n, v in table.items()]
    return out


def _difference(where: str, name: str, laser: Printed, bar: Printed, printed: Printed) -> PaperRow:
    again = computed_from(lambda a, b: b - a, laser, bar)
    wrong = Erratum("the paper prints bar − laser here, laser − bar everywhere else", again) if name == "Syz" else None
    digits = "" if where == "Table 2" else f", digits of {where}"
    how = f"laser − bar with the numbers of {where}"
    return PaperRow(
        "yang",
        "Table 2",
        f"{name}, laser − bar{digits}",
        _unit(name),
        printed,
        computed_from(lambda a, b: a - b, laser, bar),
        how,
        "" if wrong is None else "sign",
        wrong,
        again=where != "Table 2",
    )


def _unit(name: str) -> str:
    return "rad" if name.startswith("S") else "mm/mm"


def _table4() -> list[PaperRow]:
    out = []
    for name, (largest, where, mean) in paper.TABLE4.items():
        bar = paper.TABLE2[name][1].value * where.value * 1e3
        why = (
            f"the laser readings are not printed. Consistency only: the bar line stands at {bar:.1f} µm there, so the laser should read"
            f" {bar + largest.value:.1f} µm"
        )
        out.append(PaperRow("yang", "Table 4", f"{name}, largest laser − bar, at {where.text} mm", "µm", largest, why=why))
        out.append(PaperRow("yang", "Table 4", f"{name}, mean |laser − bar|", "µm", mean, why="the laser readings are not printed"))
    return out


def _table5() -> list[PaperRow]:
    laser, bar, travel, at_laser, at_bar, difference = paper.TABLE5["Sxy"]
    rounded = Erratum(
        "the paper subtracts its already rounded products: (−0.0132) − (−0.0096) mm",
        Computed((at_laser.value - at_bar.value) * 1e3),
    )
    out = _products("Table 5", "Sxy", (laser, bar, travel), (at_laser, at_bar))
    computed = computed_from(_apart_um, laser, bar, travel)
    how = "(laser − bar)·travel with the five or six digits of Table 5"
    return [*out, PaperRow("yang", "Table 5", "Sxy·y, laser − bar", "µm", difference, computed, how, "rounded operands", rounded)]


def _table6() -> list[PaperRow]:
    out = []
    for name, (laser, bar, travel, at_laser, at_bar, difference) in paper.TABLE6.items():
        out += _products("Table 6", name, (laser, bar, travel), (at_laser, at_bar))
        computed = computed_from(_apart_um, laser, bar, travel)
        how = "(laser − bar)·travel with the digits of Table 6"
        if name == "Syz":
            swapped = Erratum(
                "the sign is reversed (bar − laser), and the operands are the rounded products: (−0.0590) − (−0.0549) mm",
                Computed((at_bar.value - at_laser.value) * 1e3),
            )
            out.append(
                PaperRow("yang", "Table 6", "Syz·y, laser − bar", "µm", difference, computed, how, "sign and rounded operands", swapped)
            )
        else:
            out.append(PaperRow("yang", "Table 6", f"{name}·x, laser − bar", "µm", difference, computed, how))
    return out


def _apart_um(laser: float, bar: float, travel: float) -> float:
    return (laser - bar) * travel * 1e3


def _products(where: str, name: str, inputs: tuple[Printed, Printed, Printed], results: tuple[Printed, Printed]) -> list[PaperRow]:
    travel = inputs[2]
    return [
        PaperRow(
            "yang",
            where,
            f"{name} at {travel.text} mm, {instrument}",
            "mm",
            result,
            Computed(angle.value * travel.value),
            f"{name} of {where} times {travel.text} mm, both taken as exact",
        )
        for instrument, angle, result in zip(("laser", "ball bar"), inputs[:2], results, strict=True)
    ]
