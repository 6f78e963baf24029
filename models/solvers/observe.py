"""What a run reads of a machine and its set-up, exactly, and how each unknown changes it (docs/explanation/conventions.md, "Readings").

Unknowns of a campaign, always in this order: smooth terms, lost motion of X, Y, Z, set-up unknowns (`abbe.models.solvers.observe_setup`).
The readings are those of math.md 4.2 and 5.4 without any linearisation: finite rotations in the chain, the length of the bar as a length,
the mirror as a tilted plane that a misaligned beam meets. A helix, a circle in any plane and a partial arc are one and the same reading of
a ball-bar; step diagonal, plain diagonal and single-axis line one of a laser: only the commanded positions differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.geometry.bases import Term, term_values
from abbe.models.geometry.chain import exact_deviation_mm
from abbe.models.geometry.jacobian import exact_jacobian
from abbe.models.machine import Machine
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe_setup import SetupUnknowns, bar_length_name, perpendicular, setup_unknowns

LOST = 3
"""Lost motion of X, Y, Z follows the smooth terms in the vector of unknowns."""


def with_tool(machine: Machine, tool_mm: F1 | None) -> Machine:
    """The machine with another tool, for rule G's levers; None: its own."""
    return machine if tool_mm is None else replace(machine, tool_mm=tool_mm)


@dataclass(frozen=True)
class AxisPlaces:
    """Commanded positions of one machine and tool with everything about them that no unknown changes.

    Attributes
    ----------
    machine : Machine
        With the tool that is in use.
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
        column = np.array([6 * t.axis + t.component for t in terms], dtype=np.intp)
        return cls(machine, axes_mm, sign, term_values(terms, axes_mm, machine.stroke_mm), column)

    def motions(self, theta: F1) -> F3:
        """Error motions, squareness and lost motion included, shape (n, 3 axes, 6), for unknowns that begin with terms and lost motion."""
        terms = self.values.shape[1]
        pick = np.zeros((terms, 18))
        pick[np.arange(terms), self.column] = theta[:terms]
        out: F3 = (self.values @ pick).reshape(-1, 3, 6)
        for a in range(3):
            out[:, a, a] -= 0.5 * self.sign[:, a] * theta[terms + a]
        return out

    def deviation_mm(self, motions: F3) -> F2:
        """Exact deviation of the tool, finite rotations, shape (n, 3), mm."""
        return exact_deviation_mm(self.machine, self.axes_mm, motions)

    def slope(self, motions: F3) -> F4:
        """Derivative of the exact deviation with respect to the error motions, shape (n, 3, 3 axes, 6)."""
        return exact_jacobian(self.machine, self.axes_mm, motions)

    def rows(self, direction: F2, slope: F4) -> F2:
        """What a reading in the given directions (n, 3) takes of every term and lost motion, shape (n, terms + 3)."""
        seen = (direction[:, None, :] @ slope.reshape(-1, 3, 18))[:, 0, :]
        lost = -0.5 * self.sign * seen[:, [0, 7, 14]]
        return np.concatenate([self.values * seen[:, self.column], lost], axis=1)


__all__ = [
    "SetupUnknowns",
    "bar_normals",
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
        Where the axes were commanded to; its readings are not looked at.
    setup : SetupUnknowns
        Set-up unknowns of the campaign (`setup_unknowns`); one that has no name there is taken as zero.
    theta : array, shape (terms + 3 + set-up,)
        Coefficients (mm, rad), lost motion (mm), set-up unknowns.
    """
    return _of(machine, terms, run, setup, theta).reading()


def run_jacobian(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns, theta: F1) -> F2:
    """Exact analytic derivative of `predict` at given unknowns, shape (n, terms + 3 + set-up); parameters as there."""
    return _of(machine, terms, run, setup, theta).jacobian()


def run_design(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns) -> F2:
    """Linearised reading per unit of every unknown: `run_jacobian` of the perfect machine in a perfect set-up."""
    return run_jacobian(machine, terms, run, setup, np.zeros(len(terms) + LOST + len(setup.names)))


def linearise(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns, theta: F1) -> tuple[F1, F2]:
    """`predict` and `run_jacobian` at once, for a step of an iteration."""
    at = _of(machine, terms, run, setup, theta)
    return at.reading(), at.jacobian()


def bar_normals(run: RunData) -> F2:
    """Unit vectors from the nominal cup to the commanded positions, shape (n, 3)."""
    assert run.centre_mm is not None
    d = run.axes_mm - run.centre_mm
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


@dataclass(frozen=True)
class _SetupValues:
    """Set-up part of the unknowns by name; what is not an unknown of this campaign is zero and has no column."""

    at: dict[str, int]
    values: F1

    def get(self, *names: str) -> F1:
        """Values of some unknowns, shape (len(names),)."""
        return np.array([self.values[self.at[n]] if n in self.at else 0.0 for n in names])

    def columns(self, parts: dict[str, F1], n: int) -> F2:
        """Derivatives by name, put where the unknowns stand, shape (n, set-up)."""
        out = np.zeros((n, self.values.size))
        for name, column in parts.items():
            if name in self.at:
                out[:, self.at[name]] = column
        return out


def _of(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: SetupUnknowns, theta: F1) -> _Bar | _Laser:
    n_machine = len(terms) + LOST
    if theta.shape != (n_machine + len(setup.names),):
        raise ValueError(f"run {run.label}: {theta.size} unknowns given, {n_machine + len(setup.names)} expected")
    machine = with_tool(machine, run.tool_mm)
    known = _SetupValues({name: i for i, name in enumerate(setup.names)}, theta[n_machine:])
    places = AxisPlaces.of(machine, terms, run.axes_mm, run.sign)
    if run.kind == "laser":
        return _Laser(run, places, known, places.motions(theta))
    assert run.centre_mm is not None
    cup = AxisPlaces.of(machine, terms, run.centre_mm[None], np.zeros((1, 3)))
    return _Bar(run, places, known, places.motions(theta), cup, cup.motions(theta), run.t_s - setup.start_s.get(run.setup, run.t_s[0]))


@dataclass(frozen=True)
class _Bar:
    """|p - c + D(p) - D(c) - offset + drift t| - R + length error: nominal bar R, nominal cup c, D the machine's deviation.

    The spindle puts the cup down, so the cup carries the machine's deviation D(c) there, with the tool of the set-up; from which side the
    axes came then is not known and belongs to the mounting offset.
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
        """From the cup to the tool, shape (n, 3), mm."""
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
    """(1 + scale) m.(P - P0) / (m.l) - nominal + zero + drift t: P where the mirror really is (P0 at the first record), l the beam.

    Normal of the mirror m = n + t1 e1 + t2 e2 with the nominal beam n and tilts as tangents, so that m.n = 1 and 1 / (m.l) = 1 + cosine.
    """

    run: RunData
    places: AxisPlaces
    known: _SetupValues
    motions: F3

    def _names(self) -> tuple[list[str], str, str, str]:
        s, label = self.run.setup, self.run.label
        return [f"tilt_{s}_1", f"tilt_{s}_2"], f"cosine_{s}", f"zero_{label}", f"drift_{label}"

    def _mirror(self) -> tuple[F1, F2, F1]:
        """Normal of the mirror less the nominal beam, the two directions of tilt, and (1 + scale), (1 + cosine)."""
        tilt, cosine, _, _ = self._names()
        assert self.run.beam is not None
        across = perpendicular(self.run.beam)
        return self.known.get(*tilt) @ across, across, 1.0 + self.known.get("laser_scale", cosine)

    def _moved(self) -> tuple[F2, F2]:
        """Nominal displacement and what the machine adds to it since the first record, shape (n, 3) each, mm."""
        deviation = self.places.deviation_mm(self.motions)
        return self.run.axes_mm - self.run.axes_mm[0], deviation - deviation[0]

    def reading(self) -> F1:
        assert self.run.beam is not None
        lean, _, factors = self._mirror()
        nominal, added = self._moved()
        _, _, zero, drift = self._names()
        values = self.known.get(zero, drift)
        factor = factors.prod()
        seen = nominal @ lean + added @ (self.run.beam + lean)  # apart, so that no digits of the metre are lost
        return np.asarray((factor - 1.0) * (nominal @ self.run.beam) + factor * seen + values[0] + values[1] * self._since_s())

    def jacobian(self) -> F2:
        assert self.run.beam is not None
        lean, across, factors = self._mirror()
        mirror, (nominal, added) = self.run.beam + lean, self._moved()
        n = len(nominal)
        rows = self.places.rows(np.broadcast_to(factors.prod() * mirror, (n, 3)), self.places.slope(self.motions))
        tilt, cosine, zero, drift = self._names()
        path = nominal + added
        parts = {zero: np.ones(n), drift: self._since_s()}
        parts |= {"laser_scale": factors[1] * (path @ mirror), cosine: factors[0] * (path @ mirror)}
        parts |= {name: factors.prod() * (path @ across[k]) for k, name in enumerate(tilt)}
        return np.concatenate([rows - rows[0], self.known.columns(parts, n)], axis=1)

    def _since_s(self) -> F1:
        return np.asarray(self.run.t_s - self.run.t_s[0])
