"""Readings under the wrong label are suspected by the names of their runs, before any effect is blamed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.discovery.discover import discover
from abbe.models.discovery.mixed_up import mixed_up, wrong_tool
from abbe.models.discovery.whitened_problem import whiten
from abbe.models.machine import Machine
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.discovery_states import after_fit
from abbe.service.discovery.discovery_text import lines_of
from abbe.service.discovery.finding import finding_of
from tests.models.discovery.test_discovery_search import FEW, campaign


def exchanged(case: Case, one: str, other: str) -> Case:
    read = {r.path.label: r.deviation_mm for r in case.runs}
    read[one], read[other] = read[other], read[one]
    return replace(case, runs=tuple(replace(r, deviation_mm=read[r.path.label]) for r in case.runs))


def backwards(case: Case, label: str) -> Case:
    turned = (r.deviation_mm[::-1] if r.path.label == label and r.deviation_mm is not None else r.deviation_mm for r in case.runs)
    return replace(case, runs=tuple(replace(r, deviation_mm=y) for r, y in zip(case.runs, turned, strict=True)))


def test_exchanged_readings_are_suspected_although_a_lost_motion_is_there_too() -> None:
    case = exchanged(campaign(backlash_um=5.0), "r01", "r06")
    found = discover(case, FEW)
    finding = finding_of(found, case, FEW, {r.path.label: np.zeros(r.path.n) for r in case.runs})
    assert (found.verdict, found.effects, found.location.runs) == ("unknown", (), ("r01", "r06"))
    assert answer_doc(finding)["doubt"].startswith("the readings of r01 and r06 are probably exchanged")
    assert answer_doc(finding)["verdict"] == "unknown"
    assert list(after_fit(finding))[-1].why == finding.doubt
    lines = lines_of(finding)
    assert lines[0].startswith("The data look wrong. The readings of r01 and r06")
    assert lines[-1].endswith("abbe discover small --without r01 --without r06")


def test_readings_in_the_reverse_order_are_suspected() -> None:
    found = mixed_up(whiten(backwards(campaign(), "r08"), baseline_of(campaign())))
    assert found is not None
    assert (found.runs, found.how) == (("r08",), "in the reverse order")


@pytest.mark.parametrize("case", [campaign(), campaign(backlash_um=6.0), campaign(step_um=5.0)], ids=["nothing", "lost motion", "step"])
def test_what_is_right_is_not_suspected(case: Case) -> None:
    assert mixed_up(whiten(case, baseline_of(case))) is None


def with_tools(sign: float) -> Case:
    """A machine with rotations of 60 urad, measured with three tools; the last one's X is stated with a sign.

    With two tools, circles could not tell: rotations of the other sign would explain the same readings.
    """
    plain = replace(campaign(), includes=frozenset({"rigid21", "setup_centre_offset", "bar_length_error"}))
    rng = np.random.default_rng(5)

    def stated(runs: tuple[CaseRun, ...], sign: float) -> Case:
        tools = np.array([(0.0, 0.0, -120.0), (30.0, 0.0, -120.0), (60.0 * sign, 0.0, -120.0)])
        machines = [replace(r.path.machine, tool_mm=tools[k % 3]) for k, r in enumerate(runs)]
        return replace(plain, runs=tuple(replace(r, path=replace(r.path, machine=m)) for r, m in zip(runs, machines, strict=True)))

    true = stated(plain.runs, 1.0)
    base = baseline_of(true)
    theta = np.array([60e-6 * rng.normal() if t.component >= 3 and 0 < t.order < 6 else 0.0 for t in base.terms])
    theta = np.concatenate([theta, np.zeros(base.size - theta.size)])
    read = [base.read(r.data(), theta) + 2e-4 * rng.normal(size=r.path.n) for r in true.runs]
    measured = (replace(r, deviation_mm=None if r.role == "sealed" else y) for r, y in zip(plain.runs, read, strict=True))
    return stated(tuple(measured), sign)


def test_the_wrong_sign_of_a_tool_is_suspected_by_component_and_runs() -> None:
    case = with_tools(-1.0)
    found = wrong_tool(whiten(case, baseline_of(case)))
    assert found is not None
    assert found.how == "taken with tools whose tool_mm has the wrong sign in X"
    assert found.runs == tuple(r.path.label for r in case.of("identify") if r.path.machine.tool_mm[0])  # 30 and -60, or -30 and 60
    right = with_tools(1.0)
    assert wrong_tool(whiten(right, baseline_of(right))) is None


def test_a_wrong_sign_that_all_runs_share_changes_no_residual() -> None:
    """Of the only tool, or of a pivot: nothing in these readings tells it, and no effect is blamed for it."""
    plain = replace(campaign(), includes=frozenset({"rigid21", "setup_centre_offset", "bar_length_error"}))

    def left(machine: Machine) -> float:
        case = replace(plain, machine=machine, runs=tuple(replace(r, path=replace(r.path, machine=machine)) for r in plain.runs))
        return whiten(case, baseline_of(case)).projection.chi2

    machine = replace(plain.machine, tool_mm=np.array([40.0, 0.0, -120.0]))
    other = replace(machine, tool_mm=np.array([-40.0, 0.0, -120.0]), pivots_mm=machine.pivots_mm * (1.0, 1.0, -1.0))
    assert left(other) == pytest.approx(left(machine), rel=0.01)
