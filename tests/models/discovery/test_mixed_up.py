"""Readings under the wrong label are suspected by the names of their runs, before any effect is blamed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.case import Case
from abbe.models.discovery.discover import discover
from abbe.models.discovery.mixed_up import mixed_up
from abbe.models.discovery.whitened_problem import whiten
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
