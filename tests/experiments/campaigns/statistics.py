"""Coverage over many machines: shares with the standard error that clusters of machines leave, and the table of it.

The intervals of one machine go right or wrong together, so the machines are the sample, not the intervals: with m machines, n_i intervals
of which h_i hold the truth, p = sum h / sum n and its standard error is sqrt(m/(m-1) sum (h_i - p n_i)^2) / sum n (ratio estimator, Cochran
1977, 6.4). A bound for a smaller sample has to leave room for that error.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

HEAD = "kind          machines  params  cover %    se  rms z | points cover %    se rms z   u/um max u/um | order wrong refused  s/solve"


@dataclass(frozen=True)
class Share:
    """Share of intervals that hold the truth, its standard error between machines, and the rms of error over u."""

    share: float
    se: float
    rms_z: float
    count: int


def share(inside: list[np.ndarray], z: list[np.ndarray]) -> Share:
    """Of one array per machine."""
    used = [i for i, v in enumerate(inside) if v.size]
    n, h = np.array([inside[i].size for i in used], float), np.array([inside[i].sum() for i in used], float)
    if not used:
        return Share(float("nan"), float("nan"), float("nan"), 0)
    p = h.sum() / n.sum()
    m = len(used)
    se = np.sqrt(m / (m - 1) * np.sum((h - p * n) ** 2)) / n.sum() if m > 1 else float("nan")
    return Share(float(p), float(se), float(np.sqrt(np.mean(np.concatenate([z[i] for i in used]) ** 2))), int(n.sum()))


def parameter_share(cases: list[dict[str, Any]], k: float = 1.96) -> Share:
    """Of the identifiable parameters."""
    z = [np.array(c["z"])[np.array(c["identifiable"], bool)] for c in cases]
    return share([np.abs(v) <= k for v in z], z)


def point_share(cases: list[dict[str, Any]]) -> Share:
    """Of the predicted deviations."""
    return share([np.array(c["point_inside"], bool) for c in cases], [np.array(c["point_z"]) for c in cases])


def table(cases: Iterable[dict[str, Any]]) -> str:
    """One line per kind of campaign, then every wrong claim and refusal."""
    by_kind: dict[str, list[dict[str, Any]]] = {}
    notes = []
    for c in cases:
        by_kind.setdefault(c["kind"], []).append(c)
        notes += [
            f"seed {c['seed']} {c['kind']} {c['chain']}: {w}"
            for w in [*c["wrong"], *([f"refused: {c['refused']}"] if c["refused"] else [])]
        ]
    return "\n".join([HEAD, *(_line(kind, found) for kind, found in by_kind.items()), *notes])


def _line(kind: str, cases: list[dict[str, Any]]) -> str:
    solved = [c for c in cases if not c["refused"]]
    wrong = sum(len(c["wrong"]) for c in cases)
    if not solved:
        return f"{kind:13s} {len(cases):8d}  none solved, {len(cases)} refused"
    a, b = parameter_share(solved), point_share(solved)
    u = [np.median(c["point_u_mm"]) * 1e3 for c in solved]
    orders = [c["order"] for c in solved]
    return (
        f"{kind:13s} {len(cases):8d} {a.count / len(solved):7.1f} {100 * a.share:8.2f} {100 * a.se:5.2f} {a.rms_z:5.2f}  | "
        f"{100 * b.share:14.2f} {100 * b.se:5.2f} {b.rms_z:5.2f} {np.median(u):6.2f} {np.max(u):8.2f} | "
        f"{min(orders):2d}-{max(orders):2d} {wrong:5d} {len(cases) - len(solved):7d} {np.mean([c['seconds'] for c in solved]):8.2f}"
    )
