"""Solves the campaigns of a folder by the public command and counts what held.

As ``tools/coverage.py`` of the shared data: components of the deviation inside U on the points of the case (best-fit rigid motion
removed), error over machine. Beside it: rms of z = error over U/2; components at points off the border of the grid; points inside the
95 % ellipsoid of which U states the half axes (correlation left out: the file has none); parameters with the status "observed" inside 2 u
(only where the truth lists them, `tests.experiments.calibration.folder`).
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from tests.experiments.calibration.kinematics import F
from tests.experiments.campaigns.statistics import Share, share
from tests.experiments.campaigns.truth import TrueParameters

ELLIPSOID = 7.815 / 1.96**2
"""Largest sum of (d/U)² inside the 95 % ellipsoid of three components."""
TIMEOUT_S = 600.0
COLUMNS = (
    "family",
    "n",
    "refused",
    "inside U",
    "se",
    "rms z",
    "off the border",
    "ellipsoid",
    "error/machine",
    "worst",
    "U median µm",
    "observed",
    "se",
    "rms z",
)


@dataclass(frozen=True)
class Case:
    """One solved case: error over U of every component (points, 3), points on the border, error over machine, U, parameters."""

    family: str
    over_u: F
    border: F
    ratio: float
    u_um: F
    parameter_z: F


@dataclass(frozen=True)
class Refused:
    """A case without an answer, and what the program said."""

    family: str
    case: str
    said: str


def judge(
    folder: Path, answers: Path, *, jobs: int = 1, options: list[str] | None = None, told: Callable[[str], None] = lambda _: None
) -> list[Case | Refused]:
    """Solve what has no answer yet, at most ``jobs`` at a time, and compare everything with the truth."""
    answers.mkdir(parents=True, exist_ok=True)
    names = sorted(p.stem for p in (folder / "sealed").glob("*.csv"))
    if not names:
        raise SystemExit(f"{folder}: no sealed/CASE.csv; make the folder first")

    def one(name: str) -> Case | Refused:
        said = "" if (answers / f"{name}.csv").exists() else solve(folder, answers, name, options or [])
        told(f"\r{name}  ")
        return compared(folder, answers, name, said)

    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(one, names))


def solve(folder: Path, answers: Path, name: str, options: list[str]) -> str:
    """Answer one case with ``abbe solve``; return the last line of what it said."""
    command = [str(Path(sys.executable).with_name("abbe")), "solve", str((folder / "public" / name).resolve()), "--json", *options]
    command += ["--at", str((folder / "points" / f"{name}.csv").resolve()), "--out", str((answers / f"{name}.csv").resolve())]
    env = {k: v for k, v in os.environ.items() if k not in ("ABBE_MACHINE", "ABBE_DB")} | {"OPENBLAS_NUM_THREADS": "1"}
    with (answers / f"{name}.json").open("w") as out:
        try:
            ran = subprocess.run(
                command, stdout=out, stderr=subprocess.PIPE, text=True, cwd=answers, env=env, timeout=TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired:
            return f"no answer in {TIMEOUT_S:.0f} s"
    return (ran.stderr.strip().splitlines() or [""])[-1]


def compared(folder: Path, answers: Path, name: str, said: str) -> Case | Refused:
    """One case against its truth."""
    family = re.sub(r"\d+$", "", name)
    if not (answers / f"{name}.csv").exists():
        return Refused(family, name, said)
    truth, answer = _table(folder / "sealed" / f"{name}.csv"), _table(answers / f"{name}.csv")
    if truth.shape[0] != answer.shape[0] or np.abs(truth[:, :3] - answer[:, :3]).max() > 1e-3:
        raise SystemExit(f"{answers / name}.csv: not the points of {folder}/sealed/{name}.csv; delete it and judge again")
    error, u = answer[:, 3:6] - truth[:, 3:], answer[:, 6:9]
    ends = (truth[:, :3] == truth[:, :3].min(axis=0)) | (truth[:, :3] == truth[:, :3].max(axis=0))
    ratio = float(np.sqrt((error**2).sum() / (truth[:, 3:] ** 2).sum()))
    return Case(family, error / u, ends.any(axis=1), ratio, u, parameter_z(folder, answers, name))


def parameter_z(folder: Path, answers: Path, name: str) -> F:
    """Error over u of the parameters called observed; empty without their truth."""
    known, solved = folder / "sealed" / f"{name}.json", answers / f"{name}.json"
    if not known.exists() or not solved.exists() or not solved.read_text().strip():
        return np.zeros(0)
    found = json.loads(solved.read_text())
    true = true_parameters(json.loads(known.read_text()), json.loads((folder / "public" / name / "campaign.json").read_text())["machine"])
    listed = {n: p for n, p in found["parameters"].items() if re.fullmatch(r"E..\.\d+|C0Y|B0Z|A0Z", n)}
    seen = [n for n, p in listed.items() if p["status"] == "observed"]
    order = max((int(n.partition(".")[2] or 0) for n in listed), default=1)
    values = true.values(seen, order)
    return np.array([(listed[n]["value"] - v) / listed[n]["u"] for n, v in zip(seen, values, strict=True)])


def true_parameters(truth: dict[str, Any], machine: dict[str, Any]) -> TrueParameters:
    """The motions that a truth lists as Legendre series."""
    stroke = np.array([machine["stroke_mm"][a] for a in "XYZ"])
    work, tool = (
        tuple("XYZ".index(c) for c in side if c in "XYZ") for side in machine["chain"].removesuffix("-t").removeprefix("w-").split("b")
    )
    motions = [_series(np.array(c), *limits) for c, limits in zip(truth["series"], stroke, strict=True)]
    return TrueParameters(motions, truth["squareness"], stroke, work, tool)


def _series(coefficients: F, low: float, high: float) -> Callable[[F], F]:
    return lambda x: legendre.legval(2.0 * (x - low) / (high - low) - 1.0, coefficients).T


def table(found: list[Case | Refused]) -> str:
    """One line per family as markdown, one for all, and every refusal."""
    lines = [f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    for family in [*dict.fromkeys(c.family for c in found), "all"]:
        mine = [c for c in found if family in (c.family, "all")]
        lines.append("| " + " | ".join([family, str(len(mine)), *_figures(mine)]) + " |")
    return "\n".join(lines + [f"refused: {c.case}: {c.said}" for c in found if isinstance(c, Refused)])


def _figures(found: list[Case | Refused]) -> Iterator[str]:
    solved = [c for c in found if isinstance(c, Case)]
    yield str(len(found) - len(solved))
    if not solved:
        return
    inside = share([(np.abs(c.over_u) <= 1.0).ravel() for c in solved], [2.0 * c.over_u.ravel() for c in solved])
    inner = share([(np.abs(c.over_u[~c.border]) <= 1.0).ravel() for c in solved], [c.over_u[~c.border].ravel() for c in solved])
    bodies = np.mean([((c.over_u**2).sum(axis=1) <= ELLIPSOID).mean() for c in solved])
    ratios = [c.ratio for c in solved]
    parameters = share([np.abs(c.parameter_z) <= 2.0 for c in solved], [c.parameter_z for c in solved])
    yield from _share(inside)
    yield f"{inner.share:.3f}"
    yield f"{bodies:.3f}"
    yield f"{np.median(ratios):.2f}"
    yield f"{max(ratios):.2f}"
    yield f"{np.median([np.median(c.u_um) for c in solved]):.1f}"
    yield from _share(parameters)


def _share(found: Share) -> Iterator[str]:
    yield from (f"{found.share:.3f}", f"{found.se:.3f}", f"{found.rms_z:.2f}")


def _table(path: Path) -> F:
    return np.loadtxt(path, delimiter=",", skiprows=1, comments="#", ndmin=2)
