"""How much better 100 machines become: the errors of their distances before and after a table from one campaign, on the true machines.

``python -m tests.experiments.campaigns.accuracy --machines 100 [--jobs 2] [--campaign plan] [--minutes 60] [--nodes 13]``

Every machine has its own chain, strokes, pivots, tool and quality (`tests.experiments.campaigns.population`). It is measured by the
sampler of the
independent truth, solved by `solve_joint`, and corrected with the 3-D grid (and with nine tables, for comparison) at the command, as a
controller does it. Judged are the distances between 4000 random pairs of points of the inner 80 % of every stroke, mean of both directions
of travel. Headline: the ratio of their rms error before and after; the ratios of the 95 % quantile and of the largest stand next to it.

The bound: `tests.experiments.campaigns.accuracy_bound` together with what the grid leaves of a field that is known perfectly.
"""

import argparse
import multiprocessing
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from abbe.models.compensation.distances import DistanceStatistics, Pairs, figures, inner_box_mm, predict_distances, random_pairs
from abbe.models.compensation.grid import grid_table, quantise_grid
from abbe.models.compensation.nine_tables import nine_tables
from abbe.models.compensation.tables import quantise
from abbe.models.planning.measurements import Instruments
from abbe.models.solvers.joint import JointSolution, solve_joint
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.sources import error_sources
from abbe.simulators.campaign.sampler import Conditions
from tests.experiments.campaigns.accuracy_bound import bound_mm
from tests.experiments.campaigns.accuracy_plan import planned_case
from tests.experiments.campaigns.population import CAMPAIGNS, Case, draw_case

PAIR_COUNT, PAIR_SEED = 4000, 11
LSB_MM = 1e-4
CONDITIONS = Conditions(bar_noise_mm=0.5e-3, laser_noise_mm=0.3e-3, bar_length_sd_mm=Instruments().u_bar_length_mm)
"""Bars calibrated as well as the planner's instruments state; set-ups, drift and outliers as in the population."""
Correction = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Row:
    """One machine, all mm: distance errors as it is, with nine tables, with the grid; what the solution leaves; predicted; bound."""

    seed: int
    chain: str
    order: int
    before: DistanceStatistics
    nine: DistanceStatistics
    grid: DistanceStatistics
    solution_mm: float
    table_mm: float
    predicted_mm: float
    bound_mm: float

    @property
    def least_mm(self) -> float:
        """Rms that is left at the least: of the bound, and of a grid like this on a field known perfectly."""
        return float(np.hypot(self.bound_mm, self.table_mm))


def case_of(seed: int, campaign: str, minutes: float) -> Case:
    """Machine number ``seed`` measured by the planner's campaign or by one of the population's."""
    if campaign == "plan":
        return planned_case(seed, minutes, CONDITIONS)
    return draw_case(seed, campaign, conditions=CONDITIONS)


def true_error_mm(case: Case, pairs: Pairs, correction: Correction | None = None) -> np.ndarray:
    """Errors of the distances on the true machine when the controller adds a correction to every command, shape (n,)."""

    def off(points: np.ndarray) -> np.ndarray:
        if correction is None:
            return case.truth.deviation_mm(points)
        add = correction(points)
        return case.truth.deviation_mm(points + add) + add

    return pairs.error_mm(off(pairs.first_mm), off(pairs.second_mm))


def solve(case: Case) -> JointSolution:
    """The solution as the product makes it of these runs."""
    return solve_joint(case.machine, case.runs)


def one(seed: int, campaign: str, minutes: float, nodes: int) -> Row:
    """Measure, solve, correct and judge one machine."""
    case = case_of(seed, campaign, minutes)
    solution = solve(case)
    pairs = random_pairs(inner_box_mm(case.machine), PAIR_COUNT, PAIR_SEED)
    grid = quantise_grid(grid_table(solution, (nodes,) * 3), LSB_MM)
    nine = quantise(nine_tables(solution, (25, 25, 25)), LSB_MM)
    sources = error_sources(solution, StatedInputs().as_measured())  # these machines are as warm in use as in the campaign
    predicted = predict_distances(solution, grid.correction_at, sources=sources)
    exact = figures(true_error_mm(case, pairs, lambda p: -solution.deviation_mm(p)))
    return Row(
        seed,
        case.machine.chain,
        solution.order,
        figures(true_error_mm(case, pairs)),
        figures(true_error_mm(case, pairs, nine.correction_at)),
        figures(true_error_mm(case, pairs, grid.correction_at)),
        exact.rms_mm,
        predicted.known_mm,
        predicted.rms_mm,
        bound_mm(case, pairs),
    )


HEAD = "seed chain          ord  before   nine   grid   (max)  field  table predicted  bound |  ratio   95 %    max | nine | to bound"


def line(r: Row) -> str:
    """One machine as text, um."""
    rms = (r.before.rms_mm, r.nine.rms_mm, r.grid.rms_mm, r.grid.max_mm, r.solution_mm, r.table_mm, r.predicted_mm, r.bound_mm)
    text = f"{r.seed:4d} {r.chain:14s} {r.order:3d} " + "{:7.2f}{:7.2f}{:7.2f}{:8.2f}{:7.2f}{:7.2f}{:10.2f}{:7.2f}".format(
        *(1e3 * v for v in rms)
    )
    return text + " | {:6.1f} {:6.1f} {:6.1f} | {:4.1f} | {:5.2f}".format(*ratios(r))


def summary(rows: list[Row]) -> list[str]:
    """What all machines say together."""
    every = np.array([ratios(r) for r in rows])
    lines = [f"{len(rows)} machines; distance error before over after"]
    for k, name in enumerate(("grid, rms", "grid, 95 %", "grid, max", "nine tables, rms", "rms to the bound")):
        low, mid, high = every[:, k].min(), np.median(every[:, k]), every[:, k].max()
        lines.append(f"{name:18s} median {mid:6.2f}   smallest {low:6.2f}   largest {high:6.2f}")
    ten, five = np.mean(every[:, 0] >= 10), np.mean(every[:, 0] >= 5)
    lines.append(f"grid: 10x or better on {ten:.0%} of the machines, 5x or better on {five:.0%}")
    lines.append(f"within 1.2 of the bound: {np.mean(every[:, 4] <= 1.2):.0%} of the machines")
    field, after, stated = (
        pooled(rows, *names)
        for names in (
            (lambda r: r.solution_mm, lambda r: r.bound_mm),
            (lambda r: r.grid.rms_mm, lambda r: r.least_mm),
            (lambda r: r.grid.rms_mm, lambda r: r.predicted_mm),
        )
    )
    lines.append(
        f"all machines together: identified field {field.text} of the bound, "
        f"after the grid {after.text} of bound and grid, {stated.text} of the prediction"
    )
    return lines


@dataclass(frozen=True)
class Ratio:
    """Root of the mean square of what is left over that of what is expected, and its sampling error (one standard uncertainty)."""

    value: float
    u: float

    @property
    def text(self) -> str:
        """Value and sampling error."""
        return f"{self.value:.2f} +- {self.u:.2f}"


def pooled(rows: list[Row], left: Callable[[Row], float], expected: Callable[[Row], float]) -> Ratio:
    """Ratio over all machines together. A bound is an expectation: one machine may lie on either side of it, all together may not.

    The sampling error is that of a ratio of means over independent machines, in first order.
    """
    a, b = (np.square([of(r) for r in rows]) for of in (left, expected))
    square = a.mean() / b.mean()
    u_square = np.std(a - square * b, ddof=1) / np.sqrt(len(rows)) / b.mean() if len(rows) > 1 else np.inf
    value = float(np.sqrt(square))
    return Ratio(value, float(u_square / (2.0 * value)))


def ratios(r: Row) -> tuple[float, float, float, float, float]:
    """Before over after: grid by rms, 95 % and maximum, nine tables by rms; then the grid's rms over the bound."""
    b, g = r.before, r.grid
    return b.rms_mm / g.rms_mm, b.q95_mm / g.q95_mm, b.max_mm / g.max_mm, b.rms_mm / r.nine.rms_mm, g.rms_mm / r.least_mm


def main() -> None:
    """Print the table."""
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read by the workers when they start
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--campaign", choices=("plan", *CAMPAIGNS), default="plan")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--nodes", type=int, default=13)
    args = parser.parse_args()
    work = partial(one, campaign=args.campaign, minutes=args.minutes, nodes=args.nodes)
    rows = []
    print(HEAD, flush=True)  # noqa: T201
    with multiprocessing.get_context("spawn").Pool(args.jobs) as pool:
        for row in pool.imap(work, range(args.first, args.first + args.machines)):
            rows.append(row)
            print(line(row), flush=True)  # noqa: T201
    print("\n".join(summary(rows)))  # noqa: T201


if __name__ == "__main__":
    main()
