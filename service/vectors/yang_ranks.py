"""yang_ranks.json: rank and effective rank of the experiments of math.md 4.6, and combinations that they cannot observe."""

from __future__ import annotations

import numpy as np

from abbe.models.functions.monomials import monomials
from abbe.models.papers.yang.experiments import EXPERIMENTS, LATERAL_TOOL_MM, LONG_TOOL_MM, MAP_NODES, Experiment, Problem, YangPlan
from abbe.models.papers.yang.origins import origin_plan
from abbe.models.solvers.designs import hidden_combination, ranks
from abbe.service.errors import FileFormatError
from abbe.service.vectors.case import LAYOUT, VectorCase
from abbe.service.vectors.checks import Checks

DECIMALS = 4
"""Decimals of the combinations in the file; the computed ones are rounded to them and must then be equal."""
NO_TRACE = 1e-9


def read(case: VectorCase, checks: Checks) -> None:
    """The plan of the assumptions, ranks of every experiment and degree, and the listed null vectors."""
    assumed = case.at("assumed")
    plans = [plan_of(assumed, d + 1) for d in range(len(case.at("N").parts()))]
    stroke = np.stack([np.zeros(3), plans[0].travel_mm], axis=1)
    checks.compare("origins of the plan", origin_plan(stroke), assumed.at("origins"), unit="mm", floor=1e-13, rounding="last digit")
    checks.compare("number of coefficients", [len(monomials(p.degree)) for p in plans], case.at("N"), unit="1")
    checks.assume(f"a whole vector map has {MAP_NODES} nodes per axis; the tools of e2 and e3 are {LONG_TOOL_MM} and {LATERAL_TOOL_MM} mm")
    hidden = list(case.at("null_space_degree1").named(*case.at("ranks").keys()))
    for key, part in case.at("ranks").items():
        if len(part.parts()) != len(plans):
            raise FileFormatError(f"{part.label}: expected {len(plans)} degrees as in N, got {len(part.parts())}", LAYOUT)
        found = [ranks(*experiment(part, key)(plan)) for plan in plans]
        checks.compare("rank and effective rank", found, part, unit="1")
    for key, part in hidden:
        problem = experiment(part, key)(plans[0])
        sees_all = case.number("ranks", key, 0, 0) == case.number("N", 0)
        for vector in part.parts(or_none=sees_all):
            _null_vector(vector, checks, problem)


def plan_of(case: VectorCase, degree: int) -> YangPlan:
    """The file's assumptions as a plan."""
    steps = case.number("steps")
    if steps != int(steps):
        raise FileFormatError(f"{case.label}/steps: expected a whole number, got {steps!r}", "")
    radii = tuple(float(r) for r in case.array("radii"))
    return YangPlan(
        case.array("L", shape=(3,)),
        case.array("tool", shape=(3,)),
        case.array("origins", shape=(None, 3)),
        radii,
        case.number("turns"),
        int(steps),
        degree,
    )


def experiment(case: VectorCase, key: str) -> Experiment:
    """Experiment of a key such as ``c1 helix(1)+step diagonals, ideal mirror``, named by its first word."""
    code = key.split()[0]
    if code not in EXPERIMENTS:
        raise FileFormatError(f"{case.label}: experiment {code!r} is unknown", f"known: {', '.join(EXPERIMENTS)}")
    return EXPERIMENTS[code]


def _null_vector(case: VectorCase, checks: Checks, problem: Problem) -> None:
    """Compare the ratios of the named parameters, up to the common sign, and check that their combination is unobservable."""
    names = [t.name for t in monomials(1)]
    stored = dict(case.items())
    if not set(stored) <= set(names):
        raise FileFormatError(f"{case.label}: parameters {', '.join(stored)} are not all known", f"known: {', '.join(names)}")
    parts = list(stored.values())
    weights, trace = hidden_combination(*problem, [names.index(k) for k in stored])
    # A null vector and its negative are one direction: the file's sign is taken for all components together.
    sign = -1.0 if sum(w * part.number() for w, part in zip(weights, parts, strict=True)) < 0 else 1.0
    for w, part in zip(weights, parts, strict=True):
        value = np.round(sign * w, DECIMALS) if trace < NO_TRACE else np.nan
        checks.compare("null vectors, degree 1", value, part, unit="1", rounding="stated with four decimals, ours rounded alike")
