"""Exact readings of a run from machine and set-up, and their derivatives (docs/explanation/conventions.md, "Readings").

Unknowns of a campaign, always in this order: smooth terms, lost motion of X, Y, Z, set-up unknowns. Nothing is linearised: rotations are
finite, the bar's reading is a length, the mirror a tilted plane that turns with the tool and that a misaligned beam meets. The ball-bar
reading is the same for helix, circle in any plane and partial arc, the laser reading for step diagonal, plain diagonal and single-axis
line: only the commanded positions differ.

Published methods (Yang and Kim; Wang) take the set-ups as perfect. Here each set-up error is an unknown with a documented prior
(`abbe.models.solvers.priors`):

- ``cup_<setup>_x/y/z``, mm: position of the cup minus the machine's actual position when the spindle set it down, so the error of the
  mounting alone.
- ``bar_length_<radius>``, mm: excess of the reading, so the bar is SHORTER than stated by this much. Runs whose nominal radius agrees to
  0.01 mm use one bar (`bar_length_name`).
- ``bar_drift_<setup>_x/y/z``, mm/s: slow drift of the tool against the cup since the set-up's first reading.
- ``tilt_<setup>_1/2``, rad: tilt of the mirror's normal towards the two directions of `perpendicular`.
- ``cosine_<setup>``: 1 / (m.l) - 1 of mirror m and beam l. The direction of the beam enters only through this number. It is of second order
  in the angles, so the angles themselves, with zero derivative at zero, cannot be the unknowns.
- ``laser_scale``: relative error of the laser's wavelength, common to all laser runs of the campaign.
- ``zero_<run>``, mm, and ``drift_<run>``, mm/s: error of a laser run's first record, which sets its zero; slow drift of the run.
- unknowns of an artefact: see `abbe.models.solvers.artefact`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.geometry.bases import Term, layout_of, term_values
from abbe.models.geometry.chain import exact_deviation_mm, exact_jacobian, motion_jacobian
from abbe.models.geometry.rotation import turn_vector, turn_vector_slope
from abbe.models.machine import Machine, with_tool
from abbe.models.solvers.artefact import ArtefactReading
from abbe.models.solvers.artefact import unknowns as artefact_unknowns
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import Priors, bar_length_sd

LEAST_DRIFT_MM = 2e-5
"""A set-up in which the typical drift stays below this (0.02 um) has no drift unknowns."""
SAME_PLACE_MM = 1e-3
SAME_BEAM = 1e-4
"""Beams of one set-up may differ by this much (components of unit vectors), as rounding."""

STRAIGHT_MM = 0.01
"""A path within this distance of its best line counts as straight. Commanded positions are rounded to 1 um or less, and a mirror tilted by
0.5 mrad turns 0.01 mm into 5 nm; the steps of a step diagonal are millimetres."""
NEAR_BEAM = 1e-3
"""A nominal beam may differ from a straight path by this much (components of unit vectors), because it is stated with few digits. With a
tilted mirror this difference acts as a scale of the run and is part of its cosine error."""
BAR_DIGITS = 2


@dataclass(frozen=True)
class SetupUnknowns:
    """Names and prior standard deviations of a campaign's set-up unknowns.

    ``start_s``: time of the first reading of each set-up, except the laser's. ``details``: what each laser run reads per unit of every
    set-up unknown because of details of the machine (`abbe.models.solvers.engine`), by label, shape (n, set-up).
    """

    names: tuple[str, ...]
    prior_sd: F1
    start_s: Mapping[str, float] = field(default_factory=dict)
    details: Mapping[str, F2] = field(default_factory=dict)


def setup_unknowns(runs: tuple[RunData, ...], priors: Priors, machine: Machine | None = None) -> SetupUnknowns:
    """Set-up unknowns of a set of runs, named as in the module's docstring.

    Runs with the same nominal radius share one bar; if they state its length differently, the largest uncertainty counts. Runs with
    the same set-up share cup, mirror and beam.

    Parameters
    ----------
    machine : Machine, optional
        Machine whose tool applies to runs that state none. None: such a run has the tool of its set-up.

    Raises
    ------
    ValueError
        Two runs of one set-up have different cups, beams, tools or instruments; a new mounting must be another set-up.
    """
    _check_setups(runs, None if machine is None else machine.tool_mm)
    spans = _spans(runs)
    sd: dict[str, float] = {"laser_scale": priors.laser_scale} if any(r.kind == "laser" for r in runs) else {}
    for run in runs:
        if run.kind == "bar":
            sd |= _bar_unknowns(run, sd, priors, spans[run.setup])
        elif run.points is not None:
            first, last = spans[run.setup]
            sd |= artefact_unknowns(run.points, run.setup, last - first)
        else:
            sd |= _laser_unknowns(run, priors)
    return SetupUnknowns(tuple(sd), np.array(list(sd.values())), {name: start for name, (start, _) in spans.items()})


def _bar_unknowns(run: RunData, known: Mapping[str, float], priors: Priors, span_s: tuple[float, float]) -> dict[str, float]:
    assert run.radius_mm is not None
    length = bar_length_name(run.radius_mm)
    out = {f"cup_{run.setup}_{a}": priors.cup_mm for a in "xyz"}
    out[length] = max(known.get(length, 0.0), bar_length_sd(run.u_length_mm, run.length_calibrated, priors))
    if priors.bar_drift_mm_s * (span_s[1] - span_s[0]) >= LEAST_DRIFT_MM:
        out |= {f"bar_drift_{run.setup}_{a}": priors.bar_drift_mm_s for a in "xyz"}
    return out


def _laser_unknowns(run: RunData, priors: Priors) -> dict[str, float]:
    """Unknowns of a laser run; on a straight path the tilts only add to the cosine error, by tilt times angle between beam and path."""
    out = {f"tilt_{run.setup}_{k}": priors.tilt_rad for k in "12"} if _bent(run) else {}
    away = 0.0 if out else _off_path(run)
    out[f"cosine_{run.setup}"] = float(np.hypot(priors.cosine, priors.tilt_rad * away))
    out[f"zero_{run.label}"] = priors.zero_mm
    out[f"drift_{run.label}"] = priors.drift_mm_s
    return out


def _spans(runs: tuple[RunData, ...]) -> dict[str, tuple[float, float]]:
    """First and last reading of every set-up of a ball-bar or artefact, s."""
    spans: dict[str, tuple[float, float]] = {}
    for run in runs:
        if run.kind != "laser":
            first, last = spans.get(run.setup, (np.inf, -np.inf))
            spans[run.setup] = (min(first, float(run.t_s.min())), max(last, float(run.t_s.max())))
    return spans


def _check_setups(runs: tuple[RunData, ...], tool_mm: F1 | None) -> None:
    """Refuse runs of one set-up that cannot share a mounting; ``tool_mm``: tool of runs that state none."""
    firsts: dict[str, RunData] = {}
    for given in runs:
        run = given if given.tool_mm is not None else replace(given, tool_mm=tool_mm)
        first = firsts.setdefault(run.setup, run)
        if first.tool_mm is None and run.tool_mm is not None:
            first = firsts[run.setup] = replace(first, tool_mm=run.tool_mm)
        if run.kind != first.kind:
            what = "instrument"
        elif run.centre_mm is not None and first.centre_mm is not None and np.abs(run.centre_mm - first.centre_mm).max() > SAME_PLACE_MM:
            what = "cup"
        elif run.beam is not None and first.beam is not None and np.abs(run.beam - first.beam).max() > SAME_BEAM:
            what = "beam"
        elif not _same_tool(run.tool_mm, first.tool_mm):
            what = "tool"
        else:
            continue
        raise ValueError(f"run {run.label}: set-up {run.setup} has another {what} than in run {first.label}; give it its own set-up name")


def _same_tool(a: F1 | None, b: F1 | None) -> bool:
    """Whether two runs can use the same tool; with another tool, cup or mirror must have been mounted anew."""
    return a is None or b is None or float(np.abs(a - b).max()) <= SAME_PLACE_MM


def _bent(run: RunData) -> bool:
    """Whether the tilts of the mirror are unknowns of their own: the path is not straight, or not along the beam.

    A beam that leaves a straight path only by rounding does not count: its tilt would act as a scale of the run and hide that scale.
    """
    return straight_line_of(run.axes_mm) is None or _off_path(run) > NEAR_BEAM


def _off_path(run: RunData) -> float:
    """Sine of the angle between a straight path and the beam; 0 for a path that is not straight or stands still."""
    assert run.beam is not None
    line = straight_line_of(run.axes_mm)
    return 0.0 if line is None or not line[1].any() else float(np.linalg.norm(np.cross(line[1], run.beam)))


def straight_line_of(axes_mm: F2) -> tuple[F1, F1] | None:
    """Midpoint and unit vector of the line on which positions (n, 3), mm, lie within `STRAIGHT_MM`; None if they do not.

    The vector points from the first position towards the farthest from it; it is zero if the path stands still. The component of an axis
    that moves by less than `STRAIGHT_MM` is exactly zero.
    """
    middle = axes_mm.mean(axis=0)
    d = axes_mm - middle
    d = np.where(np.abs(d).max(axis=0) < STRAIGHT_MM, 0.0, d)
    if not d.any():
        return middle, np.zeros(3)
    along = np.linalg.svd(d, full_matrices=False)[2][0]
    along = np.where((d == 0.0).all(axis=0), 0.0, along)
    if np.abs(d - np.outer(d @ along, along)).max() >= STRAIGHT_MM:
        return None
    far = d[int(np.argmax(np.linalg.norm(axes_mm - axes_mm[0], axis=1)))] - d[0]
    return middle, along if far @ along >= 0.0 else -along


def bar_length_name(radius_mm: float) -> str:
    """Name of the unknown length of a bar, from its nominal radius rounded to 0.01 mm.

    The stored radius of one bar varies from run to run by calibration and rounding; two bars differ by millimetres.
    """
    return f"bar_length_{round(radius_mm, BAR_DIGITS):.10g}"


def perpendicular(beam: F1) -> F2:
    """Two unit vectors perpendicular to a beam and to each other, shape (2, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(beam)))]
    first = np.cross(beam, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(beam, first)])


LOST = 3
"""Number of lost motions (X, Y, Z), which follow the smooth terms in the vector of unknowns."""


@dataclass(frozen=True)
class AxisPlaces:
    """Commanded positions of one machine and tool, with the values of the terms' functions there.

    Attributes
    ----------
    machine : Machine
        With the tool in use.
    axes_mm : array, shape (n, 3)
    sign : array, shape (n, 3)
        Direction in which each axis last moved; zeros: lost motion left out.
    values : array, shape (n, terms)
        Value of each term's own function (`abbe.models.geometry.bases.term_values`).
    column : array of int, shape (terms,)
        Which of the 18 motions (axis x 6 + component) each term belongs to.
    """

    machine: Machine
    axes_mm: F2
    sign: F2
    values: F2
    column: np.ndarray[tuple[int, ...], np.dtype[np.intp]]

    @classmethod
    def of(cls, machine: Machine, terms: tuple[Term, ...], axes_mm: F2, sign: F2) -> AxisPlaces:
        """Evaluate the terms' functions at commanded positions (n, 3)."""
        return cls(machine, axes_mm, sign, term_values(terms, axes_mm, machine.stroke_mm), layout_of(terms).motion)

    def first(self) -> AxisPlaces:
        """The first place alone."""
        return replace(self, axes_mm=self.axes_mm[:1], sign=self.sign[:1], values=self.values[:1])

    def motions(self, theta: F1) -> F3:
        """Error motions with squareness and lost motion, shape (n, 3 axes, 6), mm and rad; ``theta`` begins with terms and lost motion."""
        terms = self.values.shape[1]
        pick = np.zeros((terms, 18))
        pick[np.arange(terms), self.column] = theta[:terms]
        out: F3 = (self.values @ pick).reshape(-1, 3, 6)
        for a in range(3):
            out[:, a, a] -= 0.5 * self.sign[:, a] * theta[terms + a]
        return out

    def deviation_mm(self, motions: F3) -> F2:
        """Exact deviation of the tool, finite rotations, shape (n, 3), mm."""
        if not motions.any():
            return np.zeros_like(self.axes_mm)
        return exact_deviation_mm(self.machine, self.axes_mm, motions)

    def slope(self, motions: F3) -> F4:
        """Derivative of the exact deviation with respect to the error motions, shape (n, 3, 3 axes, 6)."""
        if not motions.any():
            return motion_jacobian(self.machine, self.axes_mm)
        return exact_jacobian(self.machine, self.axes_mm, motions)

    def rows(self, direction: F2, slope: F4, turn: F2 | None = None) -> F2:
        """Derivative of a reading in the given directions (n, 3) with respect to every term and lost motion, shape (n, terms + 3).

        ``turn`` (n, 3), mm: reading per rad of the tool's rotation, by any carriage.
        """
        along = (direction[:, None, :] @ slope.reshape(-1, 3, 18))[:, 0, :]
        if turn is not None:
            along.reshape(-1, 3, 6)[:, :, 3:] += turn[:, None, :]
        lost = -0.5 * self.sign * along[:, [0, 7, 14]]
        return np.concatenate([self.values * along[:, self.column], lost], axis=1)


__all__ = [
    "SetupUnknowns",
    "linearise",
    "perpendicular",
    "predict",
    "run_design",
    "run_jacobian",
    "setup_unknowns",
    "with_tool",
]


def predict(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns, theta: F1) -> F1:
    """Reading of a run for given unknowns, exact, shape (n,), mm: bar length minus radius, or displacement minus nominal.

    Parameters
    ----------
    machine, terms
        Nominal machine; terms of its error motions.
    run : RunData
        Commanded positions; its readings are not used.
    setup : SetupUnknowns
        Set-up unknowns of the campaign (`setup_unknowns`); an unknown that it does not name is zero.
    theta : array, shape (terms + 3 + set-up,)
        Coefficients (mm, rad), lost motion (mm), set-up unknowns.
    """
    return _of(machine, terms, run, setup, theta).reading()


def run_jacobian(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns, theta: F1) -> F2:
    """Exact analytic derivative of `predict` at given unknowns, shape (n, terms + 3 + set-up); parameters as in `predict`."""
    return _of(machine, terms, run, setup, theta).jacobian()


def run_design(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns) -> F2:
    """Linearised reading per unit of every unknown: `run_jacobian` of the perfect machine in a perfect set-up."""
    return run_jacobian(machine, terms, run, setup, np.zeros(len(terms) + LOST + len(setup.names)))


def linearise(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns, theta: F1) -> tuple[F1, F2]:
    """`predict` and `run_jacobian` at once, for a step of an iteration."""
    at = _of(machine, terms, run, setup, theta)
    return at.reading(), at.jacobian()


@dataclass(frozen=True)
class _SetupValues:
    """Set-up part of the unknowns by name; a name that is not an unknown of this campaign is zero and has no column."""

    at: dict[str, int]
    values: F1

    def get(self, *names: str) -> F1:
        """Values of some unknowns, shape (len(names),)."""
        return np.array([self.values[self.at[n]] if n in self.at else 0.0 for n in names])

    def columns(self, parts: dict[str, F1], n: int) -> F2:
        """Put derivatives by name into the columns of their unknowns, shape (n, set-up)."""
        out = np.zeros((n, self.values.size))
        for name, column in parts.items():
            if name in self.at:
                out[:, self.at[name]] = column
        return out


def _of(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns, theta: F1) -> _Bar | _Laser | ArtefactReading:
    n_machine = len(terms) + LOST
    if theta.shape != (n_machine + len(setup.names),):
        raise ValueError(f"run {run.label}: {theta.size} unknowns given, {n_machine + len(setup.names)} expected")
    machine = with_tool(machine, run.tool_mm)
    known = _SetupValues({name: i for i, name in enumerate(setup.names)}, theta[n_machine:])
    places = AxisPlaces.of(machine, terms, run.axes_mm, run.sign)
    if run.kind == "laser":
        return _Laser(run, places, known, places.motions(theta), setup.details.get(run.label))
    if run.points is not None:
        motions, since = places.motions(theta), run.t_s - setup.start_s.get(run.setup, run.t_s[0])
        rows = partial(_rows, places, motions)
        return ArtefactReading(run.points, run.setup, known, run.axes_mm, places.deviation_mm(motions), rows, since, run.t_s)
    assert run.centre_mm is not None
    cup = AxisPlaces.of(machine, terms, run.centre_mm[None], np.zeros((1, 3)))
    return _Bar(run, places, known, places.motions(theta), cup, cup.motions(theta), run.t_s - setup.start_s.get(run.setup, run.t_s[0]))


def _rows(places: AxisPlaces, motions: F3, direction: F2) -> F2:
    return places.rows(direction, places.slope(motions))


@dataclass(frozen=True)
class _Bar:
    """Ball-bar reading |p - c + D(p) - D(c) - offset + drift t| - R + length error: nominal bar R, nominal cup c, deviation D.

    The spindle sets the cup down, so the cup carries the machine's deviation D(c), with the tool of the set-up. The side from which the
    axes came is unknown and belongs to the mounting offset.
    """

    run: RunData
    places: AxisPlaces
    known: _SetupValues
    motions: F3
    cup: AxisPlaces
    cup_motions: F3
    since_s: F1

    def _names(self) -> tuple[list[str], list[str], str]:
        s = self.run.setup
        assert self.run.radius_mm is not None
        return [f"cup_{s}_{a}" for a in "xyz"], [f"bar_drift_{s}_{a}" for a in "xyz"], bar_length_name(self.run.radius_mm)

    def _bar(self) -> F2:
        """Vector from the cup to the tool, shape (n, 3), mm."""
        cup, drift, _ = self._names()
        assert self.run.centre_mm is not None
        placed = self.cup.deviation_mm(self.cup_motions)[0] + self.known.get(*cup)
        moved = self.places.deviation_mm(self.motions) - placed + np.outer(self.since_s, self.known.get(*drift))
        return np.asarray(self.run.axes_mm - self.run.centre_mm + moved)

    def reading(self) -> F1:
        length = self.known.get(self._names()[2])[0]
        assert self.run.radius_mm is not None
        return np.asarray(np.linalg.norm(self._bar(), axis=1) - self.run.radius_mm + length)

    def jacobian(self) -> F2:
        bar = self._bar()
        u = bar / np.linalg.norm(bar, axis=1, keepdims=True)
        rows = self.places.rows(u, self.places.slope(self.motions))
        placed = self.cup.rows(np.eye(3), np.repeat(self.cup.slope(self.cup_motions), 3, axis=0))
        cup, drift, length = self._names()
        parts = {length: np.ones(len(u))}
        parts |= {name: -u[:, k] for k, name in enumerate(cup)}
        parts |= {name: u[:, k] * self.since_s for k, name in enumerate(drift)}
        return np.concatenate([rows - u @ placed, self.known.columns(parts, len(u))], axis=1)


@dataclass(frozen=True)
class _Laser:
    """Laser reading (1 + scale) (1 + cosine) m.(P - P0) / (m.n) - nominal + zero + drift t: P actual position, P0 the first, n the beam.

    Normal of the mirror m = R (n + t1 e1 + t2 e2) with the nominal beam n and tilts as tangents. A mirror on the spindle turns with the
    tool, by R of the sum of all carriages' rotations. Off the beam this changes the reading: 50 mm times 20 urad is 1 um (Chapman,
    Precision Engineering 27 (2003) 401).
    """

    run: RunData
    places: AxisPlaces
    known: _SetupValues
    motions: F3
    details: F2 | None

    def _names(self) -> tuple[list[str], str, str, str]:
        s, label = self.run.setup, self.run.label
        return [f"tilt_{s}_1", f"tilt_{s}_2"], f"cosine_{s}", f"zero_{label}", f"drift_{label}"

    @cached_property
    def _beam(self) -> F1:
        assert self.run.beam is not None
        return self.run.beam

    @cached_property
    def _factors(self) -> F1:
        """(1 + scale) and (1 + cosine)."""
        return 1.0 + self.known.get("laser_scale", self._names()[1])

    @cached_property
    def _mirror(self) -> F1:
        """Normal of the mirror without rotation of the machine, shape (3,)."""
        return self._beam + self.known.get(*self._names()[0]) @ perpendicular(self._beam)

    @cached_property
    def _rotation(self) -> F2 | None:
        """Rotation of the mirror, shape (n, 3), rad; None: it does not turn."""
        return self.motions[:, :, 3:].sum(axis=1) if self.run.mirror_turns else None

    def _turned(self, vector: F1) -> F2:
        """Directions of a vector that is fixed to the mirror, shape (n, 3)."""
        vectors = np.broadcast_to(vector, self.run.axes_mm.shape)
        return vectors if self._rotation is None else vectors + turn_vector(self._rotation, vectors)

    @cached_property
    def _path(self) -> tuple[F2, F2, F1, F1]:
        """P - P0 and m / (m.n), shape (n, 3); nominal displacement along the beam, and m.(P - P0) / (m.n) minus it, shape (n,), mm."""
        axes_mm = self.run.axes_mm
        nominal = axes_mm - (axes_mm[0] if self.run.start_mm is None else self.run.start_mm)
        deviation = self.places.deviation_mm(self.motions)
        added, normal = deviation - deviation[0], self._turned(self._mirror)
        normal = normal / (normal @ self._beam)[:, None]
        along = nominal @ self._beam
        apart = ((nominal - np.outer(along, self._beam) + added) * normal).sum(axis=1)  # without the nominal metre, to keep all digits
        return nominal + added, normal, along, apart

    def reading(self) -> F1:
        _, _, along, apart = self._path
        zero, drift = self.known.get(*self._names()[2:])
        factor = self._factors.prod()
        shown = (factor - 1.0) * (along - along[0]) + factor * (apart - apart[0]) + zero + drift * self._since_s()
        return np.asarray(shown if self.details is None else shown + self.details @ self.known.values)

    def jacobian(self) -> F2:
        moved, normal, along, apart = self._path
        n, factor, slope = len(along), self._factors.prod(), self.places.slope(self.motions)
        tilt, cosine, zero, drift = self._names()
        seen = along + apart
        across = (moved - np.outer(seen, self._beam)) / (self._turned(self._mirror) @ self._beam)[:, None]  # per change of the normal
        turn = None
        if self._rotation is not None:
            turn = factor * (across[:, None, :] @ turn_vector_slope(self._rotation, np.broadcast_to(self._mirror, (n, 3))))[:, 0]
        rows = self.places.rows(factor * normal, slope, turn)
        first = self.places.first()
        rows -= factor * normal @ first.rows(np.eye(3), np.repeat(slope[:1], 3, axis=0))
        if turn is not None and turn[0].any():
            rows -= first.rows(np.zeros((1, 3)), slope[:1], turn[:1])
        parts = {zero: np.ones(n), drift: self._since_s()}
        parts |= {"laser_scale": self._factors[1] * (seen - seen[0]), cosine: self._factors[0] * (seen - seen[0])}
        for name, direction in zip(tilt, perpendicular(self._beam), strict=True):
            leans = factor * (across * self._turned(direction)).sum(axis=1)
            parts[name] = leans - leans[0]
        columns = self.known.columns(parts, n)
        return np.concatenate([rows, columns if self.details is None else columns + self.details], axis=1)

    def _since_s(self) -> F1:
        return np.asarray(self.run.t_s - self.run.t_s[0])
