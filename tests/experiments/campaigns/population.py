"""Random machines under random campaigns, measured on the independent truth: material for statistics about the solver.

``draw_case(seed, kind)`` is all that others need. Every machine has its own chain (of all 24), strokes, pivots, tool and quality; set-ups
are imperfect, a share of the readings are outliers, the machine drifts a little; what a run states about its bar is true as a statistic.
"""

from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, get_args

import numpy as np

from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import Machine
from abbe.models.solvers.observations import RunData, block_average
from abbe.simulators.campaign.sampler import Conditions, Rig
from abbe.simulators.scenario import MachineConfig, Magnitudes, Pivots, Scenario, Strokes
from tests.experiments.campaigns.plans import Bar, Beam, Kind, plan
from tests.experiments.campaigns.truth import Truth

CAMPAIGNS: tuple[Kind, ...] = get_args(Kind)
CHAINS = tuple("-".join(("w", *order[:k], "b", *order[k:], "t")) for order in permutations("XYZ") for k in range(4))
BLOCKS = 400
"""Values per ball-bar run, as the product has it."""
U_LENGTH_MM = (0.5e-3, 1e-3, 2e-3)
"""Stated uncertainty of a calibrated bar."""
UNCALIBRATED_SHARE, UNCALIBRATED_SD_MM = 0.15, 0.06
"""How often a campaign's bars are not calibrated, and how well such a bar is set by hand (known to be within 0.1 mm or so)."""
SCALED = ("scale_sd_um_per_m", "squareness_sd_urad", "positioning_rms_um", "straightness_rms_um", "angle_rms_urad", "angle_slope_sd_urad")


@dataclass(frozen=True)
class Case:
    """One campaign on one machine: what the solver gets (``machine``, ``runs``), and the truth it does not get.

    ``tools_mm``: the tools used, the machine's own first.
    """

    seed: int
    kind: Kind
    machine: Machine
    runs: tuple[RunData, ...]
    truth: Truth
    tools_mm: tuple[np.ndarray, ...]


def draw_case(seed: int, kind: Kind, *, conditions: Conditions | None = None) -> Case:
    """Machine number ``seed``, the same for every kind, under a campaign of one kind. ``conditions``: in place of the drawn ones."""
    rng = np.random.default_rng([seed, 7])
    scenario, machine = draw_machine(seed, rng)
    calibrated = bool(rng.random() >= UNCALIBRATED_SHARE)
    u_length = float(rng.choice(U_LENGTH_MM))
    second = machine.tool_mm * (1.0 + rng.uniform(60.0, 150.0) / np.linalg.norm(machine.tool_mm))
    drawn = Conditions(bar_length_sd_mm=u_length if calibrated else UNCALIBRATED_SD_MM)
    rig = Rig(scenario, drawn if conditions is None else conditions)
    states = {"u_length_mm": u_length if calibrated else None, "length_calibrated": calibrated}
    cups: dict[str, np.ndarray] = {}
    tools = (machine.tool_mm, second)
    runs = [_run(rig, item, tools, cups, states) for item in plan(machine, kind, np.random.default_rng([seed, 8, CAMPAIGNS.index(kind)]))]
    return Case(seed, kind, machine, tuple(runs), Truth(rig), tools if kind == "two_tool" else tools[:1])


def draw_machine(seed: int, rng: np.random.Generator) -> tuple[Scenario, Machine]:
    """A machine of any arrangement, 300 to 1200 mm of stroke, better or worse than the average one by up to a factor of two."""
    chain = CHAINS[int(rng.integers(len(CHAINS)))]
    length = np.round(rng.uniform(300.0, 1200.0, 3))
    start = np.round(np.where(rng.random(3) < 0.5, 0.0, -rng.uniform(0.0, 1.0, 3) * length))
    stroke = np.stack([start, start + length], axis=1)
    table = stroke.mean(axis=1) + rng.uniform(-0.3, 0.3, (3, 3)) * length
    head = rng.uniform(-350.0, 350.0, (3, 3))
    on_table = np.array([chain.index(a) < chain.index("b") for a in "XYZ"])
    pivots = np.round(np.where(on_table[:, None], table, head))
    tool = np.round(np.eye(3)[int(rng.integers(3))] * rng.choice([-1.0, 1.0]) * rng.uniform(60.0, 250.0))
    quality = float(np.clip(np.exp(rng.normal(0.0, 0.4)), 0.5, 2.0))
    config = MachineConfig(chain, Strokes(*_pairs(stroke)), Pivots(*_triples(pivots)), _triples(tool[None])[0])
    magnitudes = replace(Magnitudes(), **{name: _scaled(getattr(Magnitudes(), name), quality) for name in SCALED})
    return Scenario(seed=seed, machine=config, magnitudes=magnitudes), Machine(chain, stroke, pivots, tool)


def _run(rig: Rig, item: Bar | Beam, tools: tuple[np.ndarray, ...], cups: dict[str, np.ndarray], states: dict[str, Any]) -> RunData:
    n, tool = len(item.path_mm), tools[item.tool]
    common: dict[str, Any] = {
        "axes_mm": item.path_mm,
        "sign": travel_sign(item.path_mm),
        "weight_n": np.ones(n),
        "tool_mm": tool if item.tool else None,
    }
    if isinstance(item, Beam):
        t = rig.time_s + rig.conditions.pause_s + 2.0 * np.arange(n)
        reading = rig.laser(item.path_mm, item.beam, tool, t)
        return RunData(item.label, item.label, "laser", deviation_mm=reading, t_s=t, beam=item.beam, **common)
    if item.setup not in cups:
        cups[item.setup] = rig.cup(item.centre_mm, tool)
    t = rig.time_s + rig.conditions.pause_s + 0.03 * np.arange(n)
    reading = rig.bar(item.path_mm, item.centre_mm, item.radius_mm, tool, t, cups[item.setup])
    where: dict[str, Any] = {"centre_mm": item.centre_mm, "radius_mm": item.radius_mm}
    return block_average(RunData(item.label, item.setup, "bar", deviation_mm=reading, t_s=t, **common, **where, **states), BLOCKS)


def _scaled(value: float | tuple[float, float], factor: float) -> float | tuple[float, float]:
    return tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value


def _pairs(stroke: np.ndarray) -> list[tuple[float, float]]:
    return [(float(a), float(b)) for a, b in stroke]


def _triples(rows: np.ndarray) -> list[tuple[float, float, float]]:
    return [(float(a), float(b), float(c)) for a, b, c in rows]
