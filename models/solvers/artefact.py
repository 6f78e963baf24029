"""Points of an artefact: features of a plate, bar or workpiece found by the machine's probe, or made by the machine and found by a CMM.

Reading of one point, a vector in the artefact's own axes, stated pose (O, M), true pose O + t and R M (R a small rotation):

- probed (``source`` "probe"): deviation = M^T (x - O) - N = R ((1 + s) N + F) - N - M^T D(x) + M^T (t + l) + rho n
- workpiece on a CMM ("cmm"): deviation = R ((1 + s) (N + M^T D(x)) + F) - N + M^T t + rho n

x axis coordinates, N nominal place of the feature, D machine's deviation at x with the tool of the run, F form of the artefact, s its scale
(with expansion by temperature), l lobing, rho n excess of the stylus or cutter along the outward normal n of a wall, t with its drift.

Unknowns: ``pose_<setup>_x/y/z`` (mm), ``turn_<setup>_a/b/c`` (rad, artefact axes), ``sway_<setup>_x/y/z`` (mm/s, drift of the pose);
``form_<artefact>_<feature>_x/y/z`` (mm, directions that were sensed), ``scale_<artefact>`` (free unless a length is calibrated),
``expansion_<artefact>`` (1/K, added to the stated one), ``warmth_<artefact>`` (K, of the sensor), ``twist_<artefact>_0..5`` (mm at the
farthest feature: rotation or scale growing with r^2, bends; clamping or springing back leaves them in a workpiece),
``shear_<artefact>_stretch/square`` (mm at the farthest feature: shear of the artefact, or of the CMM), ``cmm_<artefact>`` (scale of the
CMM), ``stylus_<source>`` (mm), ``lobing_<direction>_x/y/z`` (mm, machine axes: shift of touches that start in this direction, or pre-travel
of walls with this normal), ``clamp_<setup>_..``, ``warp_<setup>_..`` (mm at the farthest feature: bends in one pose),
``calibration_<artefact>_<from>_<to>`` (mm), ``step_<setup>_x/y/z/a/b/c`` (mm, rad: motion of the artefact during the run), and fine
structure of the machine (`Fine`).

Source: artefact-based self-calibration by reversal, Evans, Hocken and Estler, CIRP Annals 45/2 (1996) 617.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.geometry.rotation import rotation_matrix, turn_vector, turn_vector_slope

Source = Literal["probe", "cmm", "length"]
LETTERS = "xyz"
TURNS = "abc"
SAME_PLACE_MM = 0.5


@dataclass(frozen=True, slots=True)
class Fine:
    """Fine structure of one axis' motion that no polynomial follows: one unknown, mm, in direction ``component``.

    With ``period_mm`` above 0 it is a wave over the position: cosine (``phase`` 0) or sine (1). Otherwise it is one displacement of all
    points within `SAME_PLACE_MM` of ``at_mm``. Several waves stand for one found period, ``found_mm``; ``probability``: probability of this
    period.
    """

    axis: int
    component: int
    at_mm: float = 0.0
    period_mm: float = 0.0
    phase: int = 0
    found_mm: float = 0.0
    probability: float = 1.0

    @property
    def name(self) -> str:
        """Name of the unknown, e.g. ``nugget_X_259.06_y`` or ``wave_X_10_x_0``."""
        where = f"{self.period_mm:.5g}" if self.period_mm else f"{self.at_mm:.2f}"
        end = f"_{self.phase}" if self.period_mm else ""
        return f"{'wave' if self.period_mm else 'nugget'}_{'XYZ'[self.axis]}_{where}_{LETTERS[self.component]}{end}"

    def sd_mm(self, priors: ArtefactPriors) -> float:
        """Prior standard deviation; the two waves of a period share its variance."""
        return priors.wave_mm * float(np.sqrt(0.5 * self.probability)) if self.period_mm else priors.nugget_mm

    def values(self, axes_mm: F2) -> F1:
        """Motion per unit at axis positions (n, 3)."""
        x = axes_mm[:, self.axis]
        if not self.period_mm:
            return np.asarray(np.abs(x - self.at_mm) <= SAME_PLACE_MM, dtype=np.float64)
        return np.asarray(np.sin(2.0 * np.pi * x / self.period_mm) if self.phase else np.cos(2.0 * np.pi * x / self.period_mm))


@dataclass(frozen=True, eq=False)
class ArtefactPoints:
    """Data that only the run of an artefact has; one row per component of a point.

    Attributes
    ----------
    artefact : str
    source : "probe" | "cmm" | "length"
        "length": rows are calibrated lengths from ``feature`` to ``far``, not measured by the machine.
    matrix : array, shape (3, 3)
        Stated orientation: columns are the artefact's axes in machine axes.
    feature : tuple of str, shape (n,)
    component : array of int, shape (n,)
        Axis of the artefact along which the row reads.
    nominal_mm : array, shape (n, 3)
        Nominal place in artefact axes.
    normal : array, shape (n, 3)
        Outward normal of a wall in artefact axes; zero for a hole or ball.
    warm_K : array, shape (n,)
        Temperature above the artefact's reference.
    expansion_per_K, u_expansion_per_K : float
    touch_deg : array, shape (n,)
        Direction of the first touch; NaN where it is not stated.
    reach_mm : float
        Distance of the farthest feature from the centre of all.
    middle_mm : array, shape (3,)
        Centre of all features, artefact axes.
    far, far_mm, u_mm : for lengths: second feature, its nominal place (n, 3), standard uncertainty (n,).
    u_cmm_scale : float
        Relative standard uncertainty of the CMM's scales and squareness.
    calibrated : bool
        Whether a length of the artefact is calibrated.
    fine : tuple of Fine
        Fine structure of the machine that the solution includes, the same in all runs.
    step_s : float
        Time from which the artefact lies elsewhere, because it moved during the run.
    """

    artefact: str
    source: Source
    matrix: F2
    feature: tuple[str, ...]
    component: NDArray[np.int64]
    nominal_mm: F2
    normal: F2
    warm_K: F1  # noqa: N815 - kelvin
    expansion_per_K: float  # noqa: N815
    u_expansion_per_K: float  # noqa: N815
    touch_deg: F1
    reach_mm: float
    middle_mm: F1
    calibrated: bool
    u_cmm_scale: float = 0.0
    far: tuple[str, ...] = ()
    far_mm: F2 = field(default_factory=lambda: np.zeros((0, 3)))
    u_mm: F1 = field(default_factory=lambda: np.zeros(0))
    fine: tuple[Fine, ...] = ()
    step_s: float = float("inf")

    @property
    def direction(self) -> F2:
        """First-order derivative of every reading by the machine's deviation, shape (n, 3); zero for a calibrated length."""
        return np.asarray({"probe": -1.0, "cmm": 1.0, "length": 0.0}[self.source] * self.matrix.T[self.component])


@dataclass(frozen=True, slots=True)
class ArtefactPriors:
    """Standard deviations of the priors of an artefact and its probing.

    Attributes
    ----------
    pose_mm, turn_rad : true minus stated pose; wide, because a person types the pose.
    sway_mm_s : drift of the pose: 0.3 um in 10 minutes.
    form_mm : true minus nominal place of a feature; this size is estimated from the data.
    scale : scale of an artefact without a calibrated length.
    shear : difference in scale of the artefact's two axes, and its squareness: errors of the machine that made it.
    twist_mm : smooth form; this size is estimated from the data.
    stylus_mm : radius of stylus with pre-travel, or of the cutter.
    lobing_mm : lobing of the probe; this size is estimated from the data.
    clamp_mm, warp_mm : bend of the artefact in a pose by clamping and weight, in its plane and out of it; sizes estimated from the data.
    nugget_mm, wave_mm : fine structure of a machine's motion; the first size is estimated from the data.
    warmth_K : offset of the temperature sensor, the same in all runs of the artefact.
    """

    pose_mm: float = 1.0
    turn_rad: float = 5e-3
    sway_mm_s: float = 5e-7
    form_mm: float = 15e-3
    scale: float = 500e-6
    shear: float = 100e-6
    twist_mm: float = 1.5e-3
    stylus_mm: float = 50e-3
    lobing_mm: float = 2e-3
    clamp_mm: float = 0.5e-3
    warp_mm: float = 1e-3
    nugget_mm: float = 0.5e-3
    wave_mm: float = 1.5e-3
    warmth_K: float = 0.07  # noqa: N815 - kelvin


PRIORS = ArtefactPriors()
LEARNED = ("sway", "form", "twist", "lobing", "clamp", "warp", "nugget")
"""Classes of an artefact's unknowns whose typical size is estimated from the data."""


def unknowns(p: ArtefactPoints, setup: str, span_s: float, priors: ArtefactPriors = PRIORS) -> dict[str, float]:
    """Names of a run's unknowns with their prior standard deviations."""
    a = p.artefact
    if p.source == "length":
        ends = zip(p.feature, p.far, p.u_mm, strict=True)
        return {f"calibration_{a}_{one}_{two}": max(float(u), 1e-6) for one, two, u in ends}
    sensed = {(int(k), f) for k, f in zip(p.component, p.feature, strict=True)}
    out = {f"pose_{setup}_{LETTERS[k]}": priors.pose_mm for k in range(3)}
    out |= {f"turn_{setup}_{n}": priors.turn_rad for n in TURNS}
    if span_s > 0.0:
        out |= {f"sway_{setup}_{LETTERS[k]}": priors.sway_mm_s for k in range(3)}
    if p.warm_K.any() and p.u_expansion_per_K > 0.0:
        out[f"expansion_{a}"] = p.u_expansion_per_K
        out[f"warmth_{a}"] = priors.warmth_K
    if p.source == "probe":
        out |= {f"form_{a}_{f}_{LETTERS[k]}": priors.form_mm for k, f in sorted(sensed)}
        out[f"scale_{a}"] = priors.scale
    else:
        out[f"cmm_{a}"] = max(p.u_cmm_scale, 1e-8)
    shear = priors.shear if p.source == "probe" else max(p.u_cmm_scale, 1e-8)
    out |= {name: shear * p.reach_mm if "shear_" in name else priors.twist_mm for name in _shapes(p, p.nominal_mm)}
    out |= _steps(p, setup)
    if p.source == "probe":
        out |= {name: priors.warp_mm if name.startswith("warp_") else priors.clamp_mm for name in _bends(p, setup)}
    out |= {one.name: one.sd_mm(priors) for one in p.fine}
    if p.normal.any():
        out[f"stylus_{p.source}"] = priors.stylus_mm
    out |= {name: priors.lobing_mm for name, _ in lobing(p)} if p.source == "probe" else {}
    return out


def lobing(p: ArtefactPoints) -> list[tuple[str, F1]]:
    """Lobing unknowns with their column in the reading, shape (n,).

    Without a stated direction of the first touch, all points of a run are shifted alike, and the pose absorbs this shift. Each further
    direction shifts its points by its own vector in machine axes, since the probe does not turn with the artefact. A wall is touched along
    its normal, so each direction in the machine has its own pre-travel.
    """
    along = np.asarray(p.matrix.T[p.component])  # machine direction of every row
    wall = p.normal.any(axis=1)
    out = []
    for way in np.unique(np.round(p.normal[wall] @ p.matrix.T, 2), axis=0) + 0.0:
        mine = wall & (np.abs(p.normal @ p.matrix.T - way).max(axis=1) < 0.02)
        out.append((f"lobing_{way[0]:g}:{way[1]:g}:{way[2]:g}", mine * p.normal[np.arange(len(along)), p.component]))
    for angle in np.unique(p.touch_deg[~wall & np.isfinite(p.touch_deg)]):
        mine = ~wall & (p.touch_deg == angle)
        out += [(f"lobing_{angle:g}_{LETTERS[k]}", mine * along[:, k]) for k in range(3)]
    return out


class Known(Protocol):
    """Values of set-up unknowns by name; unnamed ones are zero."""

    def get(self, *names: str) -> F1:
        """Values, shape (len(names),)."""
        ...

    def columns(self, parts: dict[str, F1], n: int) -> F2:
        """Derivatives by name in the columns of their unknowns, shape (n, set-up)."""
        ...


@dataclass(frozen=True, eq=False)
class ArtefactReading:
    """Exact reading and derivative of the points of one run.

    ``axes_mm``, ``smooth_mm``: axis positions and deviation of the machine without fine structure, shape (n, 3); ``rows``: derivative of
    the deviation along given directions (n, 3) with respect to terms and lost motion; ``since_s``: time since the set-up's first point.
    """

    points: ArtefactPoints
    setup: str
    known: Known
    axes_mm: F2
    smooth_mm: F2
    rows: Callable[[F2], F2]
    since_s: F1
    t_s: F1

    @property
    def deviation_mm(self) -> F2:
        """Deviation of the machine at every row, shape (n, 3)."""
        out = self.smooth_mm.copy()
        for one in self.points.fine:
            out[:, one.component] += self.known.get(one.name)[0] * one.values(self.axes_mm)
        return out

    def _pose(self) -> tuple[list[str], list[str], list[str]]:
        s = self.setup
        return [f"pose_{s}_{k}" for k in LETTERS], [f"turn_{s}_{k}" for k in TURNS], [f"sway_{s}_{k}" for k in LETTERS]

    def _own(self) -> tuple[F2, F1]:
        """Places of the features on the true artefact, without the machine's deviation, (n, 3); and 1 + scale, (n,)."""
        return _place(self.points, self.known, self.points.feature, self.points.nominal_mm)

    def reading(self) -> F1:
        """Exact readings, shape (n,), mm."""
        p, pick = self.points, np.arange(len(self.points.feature))
        if p.source == "length":
            return self._length()[0]
        pose, turn, sway = self._pose()
        place, factor = self._own()
        moved = self.deviation_mm @ p.matrix
        if p.source == "cmm":
            place = place + factor[:, None] * moved
        added = place - p.nominal_mm + turn_vector(np.broadcast_to(self.known.get(*turn), place.shape), place)
        added = added + (self.known.get(*pose) + np.outer(self.since_s, self.known.get(*sway))) @ p.matrix
        added = added + self.known.get(f"stylus_{p.source}")[0] * p.normal
        if p.source == "probe":
            added = added - moved
        out = added[pick, p.component]
        for name, column in self._shifts():
            out = out + self.known.get(name)[0] * column
        return np.asarray(out)

    def _shifts(self) -> list[tuple[str, F1]]:
        """Unknowns that add to the readings of a probe, with their columns: lobing, bends by clamping."""
        p = self.points
        if p.source != "probe":
            return []
        bends = _bends(p, self.setup)
        moved = zip(_steps(p, self.setup), step_columns(p, self.t_s >= p.step_s).T, strict=False)
        return [*lobing(p), *moved, *((name, shape[np.arange(len(shape)), p.component]) for name, shape in bends.items())]

    def _length(self) -> tuple[F1, F2]:
        """Calibrated length minus nominal, and the unit vectors from the first to the second feature."""
        p = self.points
        (one, _), (two, _) = self._own(), _place(p, self.known, p.far, p.far_mm)
        away = two - one
        length = np.linalg.norm(away, axis=1)
        error = np.array([self.known.get(f"calibration_{p.artefact}_{a}_{b}")[0] for a, b in zip(p.feature, p.far, strict=True)])
        return np.asarray(length - np.linalg.norm(p.far_mm - p.nominal_mm, axis=1) + error), np.asarray(away / length[:, None])

    def jacobian(self) -> F2:
        """Derivative of `reading` with respect to all unknowns, shape (n, terms + 3 + set-up)."""
        p, n = self.points, len(self.points.feature)
        if p.source == "length":
            return self._length_jacobian()
        pose, turn, sway = self._pose()
        angles = self.known.get(*turn)[None]
        place, factor = self._own()
        if p.source == "cmm":
            place = place + factor[:, None] * (self.deviation_mm @ p.matrix)
        mine = np.eye(3)[p.component]
        back = mine @ rotation_matrix(angles)[0]  # derivative of the reading by the place on the artefact
        along = np.asarray(p.matrix.T[p.component])
        direction = -along if p.source == "probe" else factor[:, None] * (back @ p.matrix.T)
        slope = turn_vector_slope(np.broadcast_to(angles, place.shape), place)
        parts: dict[str, F1] = {name: along[:, k] for k, name in enumerate(pose)}
        parts |= {name: along[:, k] * self.since_s for k, name in enumerate(sway)}
        parts |= {name: np.einsum("ni,ni->n", mine, slope[:, :, k]) for k, name in enumerate(turn)}
        parts |= _place_slopes(p, self.known, p.feature, p.nominal_mm, back, self.deviation_mm @ p.matrix)
        parts[f"stylus_{p.source}"] = np.einsum("ni,ni->n", mine, p.normal)
        for name, column in self._shifts():
            parts[name] = parts.get(name, np.zeros(n)) + column
        parts |= {one.name: direction[:, one.component] * one.values(self.axes_mm) for one in p.fine}
        return np.concatenate([self.rows(direction), self.known.columns(parts, n)], axis=1)

    def _length_jacobian(self) -> F2:
        p, (_, unit) = self.points, self._length()
        none = np.zeros_like(p.nominal_mm)
        near = _place_slopes(p, self.known, p.feature, p.nominal_mm, -unit, none)
        far = _place_slopes(p, self.known, p.far, p.far_mm, unit, none)
        parts = {name: near.get(name, 0.0) + far.get(name, 0.0) * np.ones(len(unit)) for name in {*near, *far}}
        ends = [f"calibration_{p.artefact}_{a}_{b}" for a, b in zip(p.feature, p.far, strict=True)]
        parts |= {name: np.array([float(one == name) for one in ends]) for name in ends}
        return np.concatenate([0.0 * self.rows(none), self.known.columns(parts, len(unit))], axis=1)


def _place(p: ArtefactPoints, known: Known, feature: tuple[str, ...], nominal_mm: F2) -> tuple[F2, F1]:
    """Place of features on the true artefact, (n, 3), and 1 + scale and expansion, (n,)."""
    shapes = _shapes(p, nominal_mm)
    form = np.array([known.get(*(f"form_{p.artefact}_{f}_{k}" for k in LETTERS)) for f in feature]).reshape(-1, 3)
    form = form + np.einsum("k,knj->nj", known.get(*shapes), np.array(list(shapes.values())))
    scale, cmm = known.get(f"scale_{p.artefact}", f"cmm_{p.artefact}")
    expansion, warmer = _expansion(p, known)
    factor = 1.0 + scale + cmm + warmer * expansion
    return factor[:, None] * nominal_mm + form, np.asarray(factor)


def form_rows(p: ArtefactPoints, features: Sequence[str], nominal_mm: F2, names: Sequence[str]) -> NDArray[np.float64]:
    """Derivatives of the form of an artefact at features by the unknowns ``names`` of a solution, shape (n, 3, unknowns), artefact axes."""
    at = {name: i for i, name in enumerate(names)}
    out = np.zeros((len(nominal_mm), 3, len(names)))
    for i, feature in enumerate(features):
        for k in range(3):
            if (name := f"form_{p.artefact}_{feature}_{LETTERS[k]}") in at:
                out[i, k, at[name]] = 1.0
    for name, shape in (_shapes(p, nominal_mm) | {f"scale_{p.artefact}": nominal_mm}).items():
        if name in at:
            out[:, :, at[name]] = shape
    return out


def _expansion(p: ArtefactPoints, known: Known) -> tuple[float, F1]:
    """Expansion, 1/K, and its factor in each reading, K: a probed artefact's temperature; minus a workpiece's at manufacture."""
    more, offset = known.get(f"expansion_{p.artefact}", f"warmth_{p.artefact}")
    sensed = p.warm_K if p.source == "length" else p.warm_K + offset
    return p.expansion_per_K + float(more), -sensed if p.source == "cmm" else sensed


def _place_slopes(p: ArtefactPoints, known: Known, feature: tuple[str, ...], nominal_mm: F2, back: F2, moved: F2) -> dict[str, F1]:
    """Derivatives of readings, by name of the unknown: the artefact's form, scale, expansion and temperature, and the scale of the CMM.

    ``back``: derivative of each reading with respect to the place of its feature; ``moved``: the machine's deviation there, in artefact
    axes, mm.
    """
    out: dict[str, F1] = {}
    for i, f in enumerate(feature):
        for k in range(3):
            out.setdefault(f"form_{p.artefact}_{f}_{LETTERS[k]}", np.zeros(len(feature)))[i] += back[i, k]
    along = np.einsum("ni,ni->n", back, nominal_mm + (moved if p.source == "cmm" else 0.0))
    out |= {name: np.einsum("ni,ni->n", back, shape) for name, shape in _shapes(p, nominal_mm).items()}
    out[f"scale_{p.artefact}"] = out[f"cmm_{p.artefact}"] = along
    expansion, warmer = _expansion(p, known)
    out[f"expansion_{p.artefact}"] = along * warmer
    out[f"warmth_{p.artefact}"] = along * expansion * {"probe": 1.0, "cmm": -1.0, "length": 0.0}[p.source]
    return out


def _steps(p: ArtefactPoints, setup: str) -> dict[str, float]:
    """Unknowns of a motion of the artefact during a run, with their prior standard deviations."""
    if not np.isfinite(p.step_s):
        return {}
    return {f"step_{setup}_{k}": 0.1 for k in LETTERS} | {f"step_{setup}_{k}": 1e-3 for k in TURNS}


def step_columns(p: ArtefactPoints, after: NDArray[np.bool_]) -> F2:
    """First-order readings per unit of a shift (machine axes) and turn (artefact axes) of the artefact after a time, shape (n, 6)."""
    mine = np.eye(3)[p.component]
    turns = np.cross(np.eye(3)[None], (p.nominal_mm - p.middle_mm)[:, None])
    whole = np.concatenate([p.matrix.T[p.component], np.einsum("ni,nki->nk", mine, turns)], axis=1)
    return np.asarray(whole * after[:, None])


def _bends(p: ArtefactPoints, setup: str) -> dict[str, F2]:
    """Second-degree bends of an artefact in one pose, 1 at its farthest feature, shape (n, 3): in its plane, and out of it (warp)."""
    x, y, _ = ((p.nominal_mm - p.middle_mm) / p.reach_mm).T
    out = {}
    for i, value in enumerate((x * x, x * y, y * y)):
        if np.ptp(value) > 0.0:
            for k in np.unique(p.component):
                shape = np.zeros((len(x), 3))
                shape[:, k] = value
                out[f"{'warp' if k == 2 else 'clamp'}_{setup}_{LETTERS[k]}{i}"] = shape
    return out


def _shapes(p: ArtefactPoints, nominal_mm: F2) -> dict[str, F2]:
    """Smooth forms in the artefact's plane by unknown, 1 at its farthest feature, shape (n, 3): stretch, shear, swirl, barrel, bends."""
    x, y, _ = ((nominal_mm - p.middle_mm) / p.reach_mm).T
    r2, none = x * x + y * y, np.zeros(len(x))
    linear = {f"shear_{p.artefact}_stretch": (x, -y), f"shear_{p.artefact}_square": (y, x)}
    bends = ((-y * r2, x * r2), (x * r2, y * r2), (x * x, none), (none, y * y), (x * y, none), (none, x * y))
    shapes = linear | {f"twist_{p.artefact}_{i}": bend for i, bend in enumerate(bends)}
    return {name: np.stack([*at, none], axis=1) for name, at in shapes.items()}
