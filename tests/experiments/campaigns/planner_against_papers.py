"""The planner's campaign against the papers' fixed ones, for the same minutes: `python -m
tests.experiments.campaigns.planner_against_papers`.

Yang: one helix; helices about five origins with two radii each. Wang: four step diagonals. Both together. Everything is judged alike: the
same noise, priors, time model (shared cups included), Legendre order and nodes; temperatures, which add the same to both, are left out.
The papers' bars are as long as fits, up to the planner's longest. Where too little time leaves the planner no choice, the best of all
mountings that fit into it is tried out: no plan can do better.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.geometry.chain import all_chains
from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS
from abbe.models.planning.measurements import BAR_CLEARANCE_MM, DiagonalTest, HelixTest, Instruments, candidates
from abbe.models.planning.plan import INNER_SHARE, PLAN_ORDER, REPORT_NODES, plan_campaign, uncertainty_mm
from abbe.models.planning.problem import field_rows, problem
from abbe.models.planning.search import Chosen, PlanSearch
from abbe.models.uncertainty.inputs import StatedInputs

STROKES = ((600.0, 500.0, 450.0), (812.8, 495.0, 508.0), (1000.0, 600.0, 500.0), (400.0, 400.0, 300.0), (1500.0, 800.0, 700.0))
TRAVEL_MM = np.array([812.8, 495.0, 508.0])
OFFSETS_MM = ((0.0, 0.0), (-200.0, -75.0), (-200.0, 75.0), (200.0, -75.0), (200.0, 75.0))
"""Yang's origins across the hemisphere's axis, on his machine (math.md 4.3: the centre and four about it), scaled to other strokes."""
RADII_MM = (175.0, 100.0)
TOOLS = Instruments(inputs=StatedInputs().without_stated_inputs())
CAMPAIGNS = ("one helix", "5 origins x 2 radii", "4 step diagonals", "both")


@dataclass(frozen=True)
class Comparison:
    """Worst-point standard uncertainty of a paper's campaign and of the planner's for the same minutes, um; ``best_um``: see module."""

    name: str
    minutes: float
    paper_um: float
    planner_um: float
    best_um: float | None

    @property
    def factor(self) -> float:
        """How much better the planner's campaign is."""
        return self.paper_um / self.planner_um


def machines(count: int) -> list[Machine]:
    """All chains in turn, strokes in turn, pivots and tools drawn."""
    rng = np.random.default_rng(44)
    out = []
    for k in range(count):
        stroke = np.array([[0.0, s] for s in STROKES[k % len(STROKES)]])
        pivots = np.stack([stroke.mean(axis=1) + rng.uniform(-150.0, 150.0, 3) for _ in range(3)])
        out.append(Machine(all_chains()[(5 * k) % 24], stroke, pivots, np.array([0.0, 0.0, -rng.uniform(80.0, 200.0)])))
    return out


def paper_bars(machine: Machine) -> tuple[float, float]:
    """Yang's two radii, scaled so that the longer is as long as the five hemispheres leave room for, at most 300 mm, whole mm."""
    length = machine.length_mm
    across = [
        length[0] / 2 - max(abs(x) for x, _ in OFFSETS_MM) * length[0] / TRAVEL_MM[0],
        length[1] / 2 - 75.0 * length[1] / TRAVEL_MM[2],
    ]
    longest = np.floor(min(*across, length[2] - BAR_CLEARANCE_MM, 300.0 + BAR_CLEARANCE_MM) - BAR_CLEARANCE_MM)
    return float(longest), float(np.round(longest * RADII_MM[1] / RADII_MM[0]))


def paper_campaign(machine: Machine, name: str) -> Chosen:
    """A paper's campaign, tests by mounting."""
    chosen: dict[str, tuple] = {}
    long, short = paper_bars(machine)
    scale = machine.length_mm[:2] / TRAVEL_MM[[0, 2]]
    low = float(machine.stroke_mm[2, 0] + BAR_CLEARANCE_MM)
    if name != "4 step diagonals":
        for dx, dy in OFFSETS_MM[: 1 if name == "one helix" else None]:
            x, y = machine.centre_mm[:2] + np.array([dx, dy]) * scale
            first = HelixTest((round(float(x)), round(float(y)), low), long)
            chosen[first.mounting] = (first,) if name == "one helix" else (first, replace(first, radius_mm=short))
    if name in ("4 step diagonals", "both"):
        chosen |= {DiagonalTest(d).mounting: (DiagonalTest(d),) for d in DIAGONALS}
    return chosen


def compare(machine: Machine, name: str) -> Comparison:
    """One paper's campaign against the planner's on one machine."""
    paper = PlanSearch(problem(machine, replace(TOOLS, bar_lengths_mm=paper_bars(machine)), PLAN_ORDER), (), INNER_SHARE)
    chosen = paper_campaign(machine, name)
    minutes = paper.total_min(chosen)
    theirs = uncertainty_mm(paper.information(chosen), field_rows(paper.what, INNER_SHARE, REPORT_NODES))[0]
    ours = plan_campaign(machine, minutes=minutes, tools=TOOLS)
    assert ours.minutes <= minutes + 1e-9
    best = best_mounting(machine, minutes) if name == "one helix" else None
    return Comparison(name, minutes, theirs * 1e3, ours.u_worst_mm * 1e3, best)


def best_mounting(machine: Machine, minutes: float) -> float:
    """Smallest worst-point uncertainty of all mountings that fit into the minutes, with up to three tests each, um: tried one by one."""
    search = PlanSearch(problem(machine, TOOLS, PLAN_ORDER), candidates(machine, TOOLS), INNER_SHARE)
    rows = field_rows(search.what, INNER_SHARE, REPORT_NODES)
    layer: list[Chosen] = [{t.mounting: (t,)} for t in search.candidates if search.cost_min(t, ()) <= minutes]
    found = []
    for _ in range(3):
        found += [uncertainty_mm(search.information(c), rows)[0] * 1e3 for c in layer]
        layer = [more for c in layer for more in _more(search, c, minutes)]
    return min(found)


def _more(search: PlanSearch, chosen: Chosen, minutes: float) -> list[Chosen]:
    name, tests = next(iter(chosen.items()))
    left = minutes - search.total_min(chosen)
    ranked = search.ranking(chosen, left, tuple(t for t in search.candidates if t.mounting == name))
    return [{name: (*tests, t)} for t in ranked if t.mounting == name]


def say(line: str) -> None:
    """One line at once: the next takes a while."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=24)
    count = parser.parse_args().machines
    say("worst-point standard uncertainty (um), inner 80 % of the volume, rigid motion taken out; best: of all mountings that fit")
    factors: dict[str, list[float]] = {name: [] for name in CAMPAIGNS}
    for k, machine in enumerate(machines(count)):
        sizes = "x".join(f"{v:g}" for v in machine.length_mm)
        for name in CAMPAIGNS:
            c = compare(machine, name)
            factors[name].append(c.factor)
            best = "" if c.best_um is None else f"  best {c.best_um:6.2f}"
            where = f"{k:2d} {machine.chain} {sizes:15s} {name:20s}"
            say(
                f"{where} {c.minutes:5.1f} min  paper {c.paper_um:7.2f}  planner {c.planner_um:7.2f}  factor {c.factor:6.2f}{best}",
            )
    for name, values in factors.items():
        say(f"{name:20s} factor: least {min(values):.2f}, median {np.median(values):.2f}, largest {max(values):.2f}")


if __name__ == "__main__":
    main()
