"""Split of the named error fields of a plane into errors of an artefact and errors of the machine, with U and evidence.

The form of the artefact and the map of the machine are unknowns of one solution, and only the poses separate them. If the poses hide a
field (`abbe.models.solvers.observability.poses`), its split is reported as unknown: it would come from the priors. The split is also
unknown if a field is certain in the readings, but neither in the part nor in the machine.

Evidence: log of the Savage-Dickey ratio of a normal prior and posterior at zero, nats (Dickey 1971).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.solvers.artefact import ArtefactPoints, form_rows
from abbe.models.solvers.artefact_motion import fine_of, motion_rows, unfollowed_mm2
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observability.poses import NAMED, PoseRank, stated_places

COVERAGE = 2.0
NATS = 5.0
"""Least evidence, nats, for a field in part or machine."""
LEAST_MM = 0.3e-3
"""A field below this size is taken as zero, however certain it is."""

Verdict = Literal["with the part", "with the machine", "with both", "unknown", "none"]


@dataclass(frozen=True)
class Share:
    """A field's amount in the part and in the machine at ``reach_mm`` from the centre, mm, with standard uncertainties and evidence.

    ``both_mm``, ``u_both_mm``: the reading of the part on this machine (part minus machine, as a probe reads it).
    """

    field: str
    part_mm: float
    u_part_mm: float
    part_nats: float
    machine_mm: float
    u_machine_mm: float
    machine_nats: float
    both_mm: float
    u_both_mm: float
    verdict: Verdict
    reach_mm: float

    @property
    def text(self) -> str:
        """One phrase for people."""
        if self.verdict in ("none", "unknown"):
            return f"{self.field} {self.verdict} ({_um(self.both_mm, self.u_both_mm)} part minus machine)"
        part, machine = _um(self.part_mm, self.u_part_mm), _um(self.machine_mm, self.u_machine_mm)
        return f"{self.field} {self.verdict} (part {part}, machine {machine}; evidence {self.part_nats:.0f} and {self.machine_nats:.0f})"


def _um(value_mm: float, u_mm: float) -> str:
    return f"{1e3 * value_mm:+.1f} ± {1e3 * COVERAGE * u_mm:.1f} µm"


def shares_text(found: tuple[Share, ...], rank: PoseRank | None) -> str:
    """Return one line on all fields, with the pose that would show the unknown ones; empty without fields."""
    if not found or rank is None:
        return ""
    line = f"At {found[0].reach_mm:.0f} mm from the part's centre: {'; '.join(s.text for s in found)}."
    lost = [s.field for s in found if s.verdict == "unknown"]
    cure = next(((name, fields) for name, _, fields in rank.cures if set(fields) & set(lost)), None)
    return line + (f" A further pose {cure[0]} would show: {', '.join(cure[1])}." if cure is not None else "")


def field_shares(joint: JointSolution, rank: PoseRank) -> tuple[Share, ...]:
    """Return the share of every named field in part and machine."""
    probed = [(r, r.points) for r in joint.data if r.points is not None and r.points.source == "probe"]
    run, p = probed[0]
    places = {f: n for _, q in probed for f, n in zip(q.feature, q.nominal_mm, strict=True)}
    e, keep = joint.estimate, ["XYZ".index(a) for a in rank.plane]
    form = form_amounts(p, places, e.names)
    at = np.concatenate([stated_places(r.axes_mm, q.matrix, q.nominal_mm, keep) for r, q in probed])
    middle, off = 0.5 * (at.min(axis=0) + at.max(axis=0)), next(k for k in range(3) if k not in keep)
    points = np.insert(at, off, float(np.mean([r.axes_mm[:, off].mean() for r, _ in probed])), axis=1)
    sign = np.array([_turned(name, p.matrix[keep][:, :2]) for name in NAMED])[:, None]  # as the part lies in the first pose
    of_machine = np.zeros((len(NAMED), len(at), 3))
    of_machine[:, :, keep] = _weights((at - middle) / p.reach_mm).reshape(len(NAMED), -1, 2)
    machine = np.tensordot(of_machine, motion_rows(joint, run.tool_mm, points, fine_of(joint)), 2)
    touched, of_part = np.concatenate([r.axes_mm for r, _ in probed]), _in_the_part([q for _, q in probed], places)
    of_both = np.concatenate([sign[..., None] * of_part, -of_machine], axis=1)
    asked = (
        (sign * form, unfollowed_mm2(joint, touched, of_part)),
        (machine, unfollowed_mm2(joint, points, of_machine)),
        (sign * form - machine, unfollowed_mm2(joint, np.concatenate([touched, points]), of_both)),
    )
    out = []
    for i, name in enumerate(NAMED):
        (part, u_part, part_nats), (own, u_own, own_nats), (sum_, u_sum, nats) = (_known(joint, w[i], v[i]) for w, v in asked)
        seen = [n > NATS and abs(v) > LEAST_MM for n, v in ((part_nats, part), (own_nats, own), (nats, sum_))]
        verdict = _verdict(seen, hidden=name in rank.hidden)
        out.append(Share(name, part, u_part, part_nats, own, u_own, own_nats, sum_, u_sum, verdict, p.reach_mm))
    return tuple(out)


def _verdict(seen: list[bool], *, hidden: bool) -> Verdict:
    part, machine, both = seen
    if hidden:
        return "unknown" if both else "none"
    if part and machine:
        return "with both"
    return "with the part" if part else "with the machine" if machine else "unknown" if both else "none"


def _known(joint: JointSolution, weights: F1, unfollowed_mm2: float) -> tuple[float, float, float]:
    """Value and standard uncertainty of a sum of unknowns, and the evidence that it is not zero."""
    value = float(weights @ joint.estimate.theta)
    u = float(np.sqrt(max(float(weights @ joint.estimate.covariance @ weights), 0.0) + unfollowed_mm2))
    before = float(np.sqrt(np.sum((weights @ joint.prior_root) ** 2) + unfollowed_mm2))
    if u <= 0.0 or before <= 0.0:
        return value, u, 0.0
    return value, u, float(0.5 * (value / u) ** 2 - np.log(max(before / u, 1.0)))


def _turned(name: str, turn: F2) -> float:
    """Return the sign that a field gets when the part is turned by quarter turns."""
    q = np.array([[0.3, 0.7], [-0.6, 0.4]])
    field = NAMED[name]
    return float(np.sign((field(q @ turn.T) * (field(q) @ turn.T)).sum()))


def _weights(q: F2) -> F2:
    """Return weights by which displacements (n, 2) at places q from the centre give the amounts of the named fields, shape (5, 2 n)."""
    rigid = [np.tile([1.0, 0.0], (len(q), 1)), np.tile([0.0, 1.0], (len(q), 1)), np.stack([-q[:, 1], q[:, 0]], axis=1)]
    basis = np.stack([*rigid, *(field(q) for field in NAMED.values())], axis=2).reshape(2 * len(q), -1)
    return np.asarray(np.linalg.pinv(basis)[3:])


def _in_the_part(probed: list[ArtefactPoints], places: dict[str, F1]) -> F3:
    """Return weights by which the machine's deviations at all readings enter the part's amounts, shape (5, readings, 3).

    The part of these deviations that the solution does not follow counts as form, because a feature's place is the mean of its readings.
    """
    p, order = probed[0], {f: i for i, f in enumerate(places)}
    weights = np.zeros((len(NAMED), len(places), 3))
    weights[:, :, :2] = _weights((np.array(list(places.values())) - p.middle_mm)[:, :2] / p.reach_mm).reshape(len(NAMED), -1, 2)
    feature, component = np.array([order[f] for q in probed for f in q.feature]), np.concatenate([q.component for q in probed])
    count = np.zeros((len(places), 3))
    np.add.at(count, (feature, component), 1.0)
    way = np.concatenate([q.matrix.T[q.component] for q in probed])
    return np.asarray((weights[:, feature, component] / count[feature, component])[..., None] * way)


def form_amounts(p: ArtefactPoints, places: dict[str, F1], names: tuple[str, ...]) -> F2:
    """Return the matrix from the unknowns of an artefact's form to the named fields, mm at its farthest feature, shape (5, unknowns)."""
    nominal = np.array(list(places.values()))
    q = (nominal - p.middle_mm)[:, :2] / p.reach_mm
    return _weights(q) @ form_rows(p, tuple(places), nominal, names)[:, :2].reshape(2 * len(q), -1)
