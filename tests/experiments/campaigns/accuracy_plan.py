"""The planner's campaign, measured on a simulated machine: raw readings at the instrument's rate, set-ups shared as planned."""

from dataclasses import replace

import numpy as np

from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import Machine
from abbe.models.planning.measurements import HelixTest, helix_path
from abbe.models.planning.plan import MeasuringPlan, PlanStep, plan_campaign
from abbe.models.solvers.observations import RunData, block_average
from abbe.simulators.campaign.sampler import Conditions, Rig
from tests.experiments.campaigns.population import BLOCKS, Case, draw_machine
from tests.experiments.campaigns.truth import Truth


def planned_case(seed: int, minutes: float, conditions: Conditions) -> Case:
    """Machine number ``seed`` of the population under the planner's campaign."""
    scenario, machine = draw_machine(seed, np.random.default_rng([seed, 7]))
    plan = plan_campaign(machine, minutes=minutes)
    rig = Rig(scenario, conditions)
    return Case(seed, "joint", machine, measured(rig, machine, plan), Truth(rig), (machine.tool_mm,))


def measured(rig: Rig, machine: Machine, plan: MeasuringPlan) -> tuple[RunData, ...]:
    """Readings of all runs of a plan, bars in block averages as the product takes them."""
    cups: dict[str, np.ndarray] = {}
    mounts: dict[str, dict] = {}
    return tuple(_run(rig, step, expected, cups, mounts) for step, expected in zip(plan.steps, plan.runs, strict=True))


def _run(rig: Rig, step: PlanStep, expected: RunData, cups: dict[str, np.ndarray], mounts: dict[str, dict]) -> RunData:
    if not isinstance(step.test, HelixTest):
        return replace(expected, deviation_mm=_laser(rig, expected, mounts))
    test = step.test
    n = int(expected.weight_n.sum())
    path = helix_path(test, n)
    if expected.setup not in cups:
        cups[expected.setup] = rig.cup(np.array(test.centre_mm))
    t_s = np.linspace(expected.t_s[0], expected.t_s[-1], n)
    reading = rig.bar(path, np.array(test.centre_mm), test.radius_mm, None, t_s, cups[expected.setup])
    raw = replace(expected, axes_mm=path, deviation_mm=reading, sign=travel_sign(path), t_s=t_s, weight_n=np.ones(n))
    return block_average(raw, BLOCKS)


def _laser(rig: Rig, expected: RunData, mounts: dict[str, dict]) -> np.ndarray:
    """Readings; runs of one set-up find the mirror as the first of them left it (the same draws of beam and mirror)."""
    after = None
    if expected.setup in mounts:
        after = rig._setup.bit_generator.state
        rig._setup.bit_generator.state = mounts[expected.setup]
    else:
        mounts[expected.setup] = rig._setup.bit_generator.state
    reading = rig.laser(expected.axes_mm, expected.beam, None, expected.t_s)
    if after is not None:
        rig._setup.bit_generator.state = after
    return reading
