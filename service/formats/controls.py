"""Corrections that controls offer according to their manuals, and the best use of a control for an identified machine.

`choices` evaluates each kind of table by the errors that remain over the whole volume in both directions of motion. The best-fit rigid
motion is removed, and the numbers are rounded as in the control. If the control limits the number of tables, those with the largest
reduction are taken first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.volume import remove_rigid, volume_grid
from abbe.models.machine import AXES
from abbe.service.formats.identified import Identified, Values, axis_tables, grid_mm, lattice_of, motions_of, products_of, table_values
from abbe.service.formats.model import AxisCurve, AxisTable, Compensation, Lattice, Lookup, Motions, ProductTable, correction_at


@dataclass(frozen=True, slots=True)
class ControlModel:
    """Capabilities of the tables of one control.

    Attributes
    ----------
    own_format, cross_format : str
        Format of own-axis tables (an axis corrects itself), and of cross and product tables; empty if the control has none.
    own_points, cross_points : int
        Largest number of points of a table.
    both_directions : bool
        Own-axis tables have two columns. Otherwise the control's backlash parameter holds the lost motion.
    tables : int, optional
        Largest number of tables of the ``cross_format``, of which a product takes two; None: unlimited.
    lattice_format, nodes : str, int
        Format of a 3-D grid, and its nodes per axis.
    motions_format : str
        Format of the error motions from which the control computes corrections by its own kinematic chain.
    lines_format, squareness, lost_motion : str, bool, bool
        Format of commands; whether they can hold squareness; whether they can hold lost motion.
    lookup : str
        Position at which the control looks up all tables but the own-axis ones.
    unit_mm : float
        Resolution of the numbers in the tables.
    """

    key: str
    name: str
    own_format: str = ""
    own_points: int = 25
    both_directions: bool = True
    cross_format: str = ""
    cross_points: int = 25
    products: bool = False
    tables: int | None = None
    lattice_format: str = ""
    nodes: int = 0
    motions_format: str = ""
    lines_format: str = ""
    squareness: bool = True
    lost_motion: bool = True
    lookup: Lookup = "command"
    unit_mm: float = 1e-6


CONTROLS: dict[str, ControlModel] = {
    c.key: c
    for c in (
        ControlModel(
            "linuxcnc",
            "LinuxCNC: COMP_FILE and HAL network",
            own_format="linuxcnc-1",
            own_points=101,
            cross_format="linuxcnc-hal",
            cross_points=16,
            products=True,
        ),
        ControlModel("linuxcnc-kins", "LinuxCNC: kinematics component", lattice_format="linuxcnc-kins", nodes=33),
        ControlModel(
            "siemens-840d",
            "SINUMERIK 840D sl: ENC_COMP and CEC",
            own_format="siemens-eec",
            own_points=101,
            both_directions=False,
            cross_format="siemens-cec",
            products=True,
        ),
        ControlModel(
            "siemens-828d",
            "SINUMERIK 828D with the option: ENC_COMP and 8 CEC tables",
            own_format="siemens-eec",
            own_points=101,
            both_directions=False,
            cross_format="siemens-cec",
            products=True,
            tables=8,
        ),
        ControlModel("fanuc", "Fanuc with pitch error compensation only", own_format="fanuc-pitch", own_points=101, unit_mm=1e-3),
        ControlModel(
            "fanuc-30i",
            "Fanuc 30i with 3-D error compensation",
            own_format="fanuc-pitch",
            lattice_format="fanuc-lattice",
            nodes=9,
            unit_mm=1e-3,
        ),
        ControlModel(
            "heidenhain",
            "Heidenhain TNC: .COM tables",
            own_format="heidenhain",
            own_points=101,
            cross_points=101,
            cross_format="heidenhain",
            unit_mm=1e-4,
        ),
        ControlModel(
            "heidenhain-kinematics",
            "Heidenhain TNC with KinematicsComp: 18 motions and squareness",
            motions_format="heidenhain-kinematics",
            own_points=101,
            unit_mm=1e-4,
        ),
        ControlModel("isg", "Beckhoff/ISG kernel with TF5280", motions_format="isg"),
        ControlModel("mach4", "Mach4", own_format="mach4", own_points=101, unit_mm=1e-4),
        ControlModel("centroid", "Centroid CNC10 v2.61 to CNC12, table version 3", own_format="centroid", own_points=101, unit_mm=1e-4),
        ControlModel("marlin", "Marlin: squareness and lost motion", lines_format="marlin"),
        ControlModel("klipper", "Klipper: squareness", lines_format="klipper", lost_motion=False),
        ControlModel("grblhal", "grblHAL: lost motion", lines_format="grblhal", squareness=False),
    )
}


JUDGE_NODES, COARSE_NODES = 12, 6
MIN_GAIN = 0.02
"""A larger set of tables is chosen only if it reduces the residual rms by at least this share."""


@dataclass(frozen=True)
class FormatChoice:
    """One kind of tables with its residual error (rms and largest vector over the volume, mm); ``best``: the recommended kind."""

    kind: str
    compensation: Compensation
    rms_mm: float
    max_mm: float
    best: bool = False

    @property
    def numbers(self) -> int:
        """Count of numbers in all tables."""
        return self.compensation.numbers


class FormatJudge:
    """Evaluates tables by the error they leave at the nodes of a volume grid."""

    def __init__(self, known: Identified, control: ControlModel, nodes: int = JUDGE_NODES) -> None:
        self.points_mm: F2 = volume_grid(known.machine.stroke_mm, nodes)
        self._moving = {way: known.moving_mm(self.points_mm, way) for way in (1, -1)}
        self._control = control

    def left_mm(self, comp: Compensation) -> F1:
        """Return the length of the residual error, mm, shape (2 n,): at all n nodes while moving in +, then while moving in −."""
        stored = rounded(comp, self._control.unit_mm)
        parts = []
        for way, field in self._moving.items():
            direction = np.full(self.points_mm.shape, float(way))
            parts.append(field + correction_at(stored, self.points_mm, direction, lookup=self._control.lookup))
        both = np.concatenate([self.points_mm, self.points_mm])
        return np.asarray(np.linalg.norm(remove_rigid(both, np.concatenate(parts)), axis=1))

    def choice(self, kind: str, comp: Compensation) -> FormatChoice:
        """Evaluate one kind of tables."""
        left = self.left_mm(comp)
        return FormatChoice(kind, comp, float(np.sqrt(np.mean(left**2))), float(left.max()))


def choices(known: Identified, control: ControlModel, reference_mm: F1) -> tuple[FormatChoice, ...]:
    """Evaluate every kind of tables that the control can hold, from none to all, and mark the best."""
    judge = FormatJudge(known, control)
    found = [judge.choice("no table", Compensation())]
    if control.own_format:
        build = _Builder(known, control, reference_mm)
        found.append(judge.choice("one-axis tables", build.together((), ())))
        found += _crossed(control, build, judge) if control.cross_format else []
    if control.lattice_format:
        nodes = _grids(known, control.nodes, reference_mm)
        grid = Compensation(lattice=lattice_of(known, nodes, reference_mm), lost_motion_mm=dict(known.lost_motion_mm))
        found.append(judge.choice(f"3-D grid of {' x '.join(str(g.size) for g in nodes)} nodes", grid))
    if control.motions_format:
        grids = _grids(known, control.own_points, reference_mm)
        comp = Compensation(motions=motions_of(known, grids), lost_motion_mm=dict(known.lost_motion_mm))
        found.append(judge.choice("error motions, worked out by the control", comp))
    if control.lines_format:
        found += [judge.choice(kind, comp) for kind, comp in _lines(known, control, reference_mm)]
    return _marked(found)


def _lines(known: Identified, control: ControlModel, reference_mm: F1) -> list[tuple[str, Compensation]]:
    """Return squareness as three straight lines (X over Y, X over Z, Y over Z), and lost motion; a negative lost motion is left out.

    A line of Y over X equals a line of X over Y plus a rotation of the whole machine, which is no error.
    """
    lost = {a: v for a, v in known.lost_motion_mm.items() if v > 0.0}
    if not control.squareness:
        return [("lost motion", Compensation(lost_motion_mm=lost))]
    x, y, z = known.machine.stroke_mm
    ends = (x, y, z)
    values = table_values(known, known.deviation_mm, (ends,), reference_mm, smooth=True)[0]
    slope = [(v[1] - v[0]) / np.ptp(ends[a]) for a, v in enumerate(values)]
    tables = []
    for a, o in ((1, 0), (2, 0), (2, 1)):
        line = (slope[a][o] + slope[o][a]) * (ends[a] - reference_mm[a])
        tables.append(AxisTable(AXES[a], AXES[o], ends[a], line, line))
    both = [("squareness and lost motion", Compensation(tuple(tables), lost_motion_mm=lost))] if control.lost_motion else []
    return [("squareness", Compensation(tuple(tables))), *both]


def best_of(found: tuple[FormatChoice, ...]) -> FormatChoice:
    """Return the choice marked as the best."""
    return next(c for c in found if c.best)


def _marked(found: list[FormatChoice]) -> tuple[FormatChoice, ...]:
    best = found[0]
    for c in sorted(found[1:], key=lambda c: c.numbers):
        if c.rms_mm < (1.0 - MIN_GAIN) * best.rms_mm:
            best = c
    return tuple(replace(c, best=c is best) for c in found)


def _grids(known: Identified, points: int, reference_mm: F1) -> tuple[F1, F1, F1]:
    x, y, z = (grid_mm(known.machine, a, points, reference_mm) for a in range(3))
    return x, y, z


def _own(known: Identified, control: ControlModel, tables: tuple[AxisTable, ...]) -> Compensation:
    """Put the lost motion into the two columns of the own-axis tables or into the control's backlash parameter."""
    if control.both_directions:
        return Compensation(tables)
    plain = tuple(replace(t, backward_mm=t.forward_mm) for t in tables)
    return Compensation(plain, lost_motion_mm=dict(known.lost_motion_mm))


def _crossed(control: ControlModel, build: _Builder, judge: FormatJudge) -> list[FormatChoice]:
    """Evaluate own-axis tables with as many cross tables and products as the control can hold."""
    kinds: list[tuple[str, tuple[ProductTable, ...]]] = [("one-axis and cross tables", ())]
    kinds += [("one-axis, cross and product tables", build.offered)] if control.products else []
    out = []
    for kind, offered in kinds:
        chosen, pairs = offered, PAIRS
        if control.tables is not None:
            chosen, pairs = build.greedy(FormatJudge(build.known, control, nodes=COARSE_NODES), offered, control.tables)
        out.append(judge.choice(kind, build.together(chosen, pairs)))
    return out


Pair = tuple[str, str]
PAIRS: tuple[Pair, ...] = tuple((a, o) for a in AXES for o in AXES if a != o)


class _Builder:
    """Builds sets of tables that correct no error twice. Tables are linear in the error, so each part is computed only once."""

    def __init__(self, known: Identified, control: ControlModel, reference_mm: F1) -> None:
        self.known, self._control = known, control
        self._sets = tuple(_grids(known, n, reference_mm) for n in (control.own_points, control.cross_points))
        self.offered = products_of(known, self._sets[1], reference_mm) if control.products else ()
        self._whole = table_values(known, known.deviation_mm, self._sets, reference_mm, smooth=True)
        self._of = {p.name: table_values(known, partial(_added_by, p), self._sets, reference_mm) for p in self.offered}

    def together(self, products: tuple[ProductTable, ...], pairs: tuple[Pair, ...]) -> Compensation:
        """Combine products with own-axis tables and the cross tables of ``pairs`` (axis, output), which correct the rest left by the
        products."""
        fine, coarse = (axis_tables(self.known, grids, self._values(k, products)) for k, grids in enumerate(self._sets))
        own = _own(self.known, self._control, tuple(t for t in fine if t.own))
        cross = tuple(t for t in coarse if (t.axis, t.output) in pairs)
        return replace(own, tables=(*own.tables, *cross), products=products)

    def _values(self, k: int, products: tuple[ProductTable, ...]) -> Values:
        x, y, z = (self._whole[k][a] + sum((self._of[p.name][k][a] for p in products), np.zeros((1, 3))) for a in range(3))
        return x, y, z

    def greedy(self, judge: FormatJudge, offered: tuple[ProductTable, ...], room: int) -> tuple[tuple[ProductTable, ...], tuple[Pair, ...]]:
        """Add the product or cross table with the largest reduction per table until ``room`` tables are used or none helps."""
        products: tuple[ProductTable, ...] = ()
        pairs: tuple[Pair, ...] = ()
        left = float(np.mean(judge.left_mm(self.together(products, pairs)) ** 2))
        while True:
            free = room - len(pairs) - 2 * len(products)
            steps = [((*products, p), pairs, 2) for p in offered if p not in products]
            steps += [(products, (*pairs, pair), 1) for pair in PAIRS if pair not in pairs]
            tried = []
            for more, cross, cost in steps:
                if cost <= free:
                    now = float(np.mean(judge.left_mm(self.together(more, cross)) ** 2))
                    tried.append(((left - now) / cost, now, more, cross))
            gain, left, products_, pairs_ = max(tried, key=lambda t: t[0], default=(0.0, left, products, pairs))
            if gain <= 0.0:
                return products, pairs
            products, pairs = products_, pairs_


def _added_by(product: ProductTable, points_mm: F2) -> F2:
    """Return what one product adds to the positions, mm; for the other tables this is a further error to correct."""
    return correction_at(Compensation(products=(product,)), points_mm)


def rounded(comp: Compensation, unit_mm: float) -> Compensation:
    """Round corrections to ``unit_mm``, and angles to a thousandth of the same number in rad."""

    def to(v: F1, unit: float = unit_mm) -> F1:
        return np.asarray(np.round(v / unit) * unit)

    def curve(c: AxisCurve, unit: float) -> AxisCurve:
        return replace(c, value=to(c.value, unit))

    tables = tuple(replace(t, forward_mm=to(t.forward_mm), backward_mm=to(t.backward_mm)) for t in comp.tables)
    products = tuple(replace(p, angle=curve(p.angle, unit_mm * 1e-3), lever=curve(p.lever, unit_mm)) for p in comp.products)
    lattice = comp.lattice
    if lattice is not None:
        lattice = Lattice(lattice.position_mm, np.round(lattice.correction_mm / unit_mm) * unit_mm)
    motions = comp.motions
    if motions is not None:
        curves = {n: curve(c, unit_mm * (1e-3 if n[1] in "ABC" else 1.0)) for n, c in motions.curves.items()}
        motions = Motions(
            motions.machine, curves, {n: round(v / unit_mm * 1e3) * unit_mm * 1e-3 for n, v in motions.squareness_rad.items()}
        )
    return Compensation(tables, products, lattice, motions, comp.lost_motion_mm)
