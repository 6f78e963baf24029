"""The printed table of the uncertainty part: time per trial, what 100 000 trials would take, ratios against goals, agreement."""

from __future__ import annotations

from tests.experiments.bench.trials_case import TRIALS

WORDS = {
    "linear-ours": "ours, one factorisation, chunks",
    "lstsq": "(a) numpy.linalg.lstsq, a loop",
    "lstsq-many": "    lstsq, all trials in one call",
    "helix-ours": "ours, all trials at once",
    "least_squares": "(b) scipy least_squares, a loop",
    "lmfit": "(c) lmfit.minimize, a loop",
    "least_squares-jac": "    least_squares, own Jacobian, lm",
    "propagation-ours": "ours, numpy",
    "uncertainties": "(d) uncertainties",
    "gtc": "(e) GTC",
    "joint-ours": "ours, solve_joint, order chosen",
    "joint-order-5": "ours, solve_joint(order=5)",
    "joint-scipy": "(f) scipy least_squares, own Jacobian, order 5, fixed sizes",
}
CASE_WORDS = {
    "linear": "60-parameter linear campaign",
    "helix": "six-parameter non-linear helix, 63 points",
    "propagation": "u of the deviation at points, 33 coefficients",
    "joint": "10 helices x 500 points + 8 step diagonals",
}
ITEMS = {"linear": "trial", "helix": "trial", "propagation": "point", "joint": "solution"}
GOALS = {("linear", "lstsq"): 100, ("helix", "least_squares"): 40}
JOINT_GOAL_S = 1.0


def lines(found: dict) -> list[str]:
    """All cases of the uncertainty part."""
    out = []
    for name, case in found.items():
        out += ["", *_times(name, case), "", *_goals(name, case), "", *_agreement(name, case)]
    return [
        *out,
        "",
        "A loop is timed on the trials shown and scaled per trial: its trials cost the same each. Every contestant draws its own readings",
        f"inside the timed call; ours draws and solves all {TRIALS:,}. Same draws: largest difference of single estimates, in standard",
        "uncertainties, for readings that all contestants were given. Mean, covariance: largest difference from ours in sampling errors.",
    ]


def _times(name: str, case: dict) -> list[str]:
    who, item = case["contestants"], ITEMS[name]
    scaled = f"{TRIALS:,}: s" if item == "trial" else ""
    out = [f"{CASE_WORDS[name]:<47}{item + 's':>10}{'best s':>9}{'median':>9}{'us/' + item:>13}{scaled:>12}{'beyond MB':>11}"]
    for k, w in who.items():
        total = f"{w['per_item_s'] * TRIALS:.2f}" if scaled else ""
        beyond = "-" if w["beyond_mb"] is None else f"{w['beyond_mb']:.1f}"
        figures = f"{w['items']:10d}{w['min_s']:9.3f}{w['median_s']:9.3f}{w['per_item_s'] * 1e6:13.2f}"
        out.append(f"  {WORDS[k]:<45}{figures}{total:>12}{beyond:>11}")
    return out


def _goals(name: str, case: dict) -> list[str]:
    who = case["contestants"]
    first, *rest = who
    if name == "joint":
        met = "met" if who[first]["min_s"] < JOINT_GOAL_S else "NOT MET"
        return [f"  {WORDS[first]}: {who[first]['min_s']:.2f} s (goal {JOINT_GOAL_S:.0f} s: {met})"]
    out = []
    for k in rest:
        ratio, goal = who[k]["per_item_s"] / who[first]["per_item_s"], GOALS.get((name, k))
        verdict = "" if goal is None else f" (goal {goal}: {'met' if ratio >= goal else 'NOT MET'})"
        out.append(f"  {'times faster than ' + WORDS[k].strip():<55}{ratio:10.0f}{verdict}")
    return out


def _agreement(name: str, case: dict) -> list[str]:
    rows = case["agreement"]
    if name in ("linear", "helix"):
        out = [f"  {'differs from ours by':<45}{'same draws, u':>15}{'mean':>9}{'covariance':>12}{'trials':>10}"]
        for k, a in rows.items():
            figures = f"{a['same_draws_u']:15.1e}{a['mean_sigmas']:9.2f}{a['covariance_sigmas']:12.2f}{a['trials']:10d}"
            out.append(f"  {WORDS[k]:<45}{figures}{_mark(a)}")
        return out
    if name == "propagation":
        out = [f"  {'differs from ours by':<45}{'u, relative':>15}{'value, in u':>14}"]
        return out + [f"  {WORDS[k]:<45}{a['u_relative']:15.1e}{a['value_u']:14.1e}{_mark(a)}" for k, a in rows.items()]
    out = [f"  {'prediction, rms, rigid motion out':<45}{'um':>15}{'unknowns':>14}"]
    return out + [f"  {WORDS[k]:<45}{1e3 * a['prediction_rms_mm']:15.2f}{a['unknowns']:14d}{_mark(a)}" for k, a in rows.items()]


def _mark(row: dict) -> str:
    return "" if row["ok"] else "   DIFFERS"
