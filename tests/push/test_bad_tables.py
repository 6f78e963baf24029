"""Bad tables are rejected with a reason each, before anything is written."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from abbe.service.push.validate import Candidate, CandidateContext, PushLimits, reasons_against
from tests.push.bad_tables import CLASSES, EACH, LSB_MM, NOW_S, good, signed
from tests.push.loading import real
from tests.push.world import Case, World

LIMITS = PushLimits()


def in_the_world(reasons: list[str]) -> World:
    world = World(real(), Case("bad table", reasons=tuple(reasons)), {})
    assert world.run() == []
    return world


def test_there_are_all_classes_of_the_specification() -> None:
    assert len(CLASSES) >= 40


@pytest.mark.parametrize("k", range(EACH))
def test_nothing_speaks_against_a_good_table(k: int) -> None:
    candidate, context = good(Random(k))
    assert reasons_against(candidate, context, LIMITS) == []
    assert str(in_the_world([]).journal[-1].state) == "KEEP"


@pytest.mark.parametrize("name", CLASSES)
def test_every_class_is_rejected_with_its_reason_and_without_a_write(name: str) -> None:
    make, word = CLASSES[name]
    for k in range(EACH):
        candidate, context = make(Random(f"{name} {k}"))
        reasons = reasons_against(candidate, context, LIMITS)
        assert any(reason.startswith(word) for reason in reasons), (k, reasons)
        world = in_the_world(reasons)
        assert str(world.journal[-1].state) == "REJECTED"
        assert world.journal[-1].doc["reasons"] == reasons
        assert not [event for event in world.events if event[0] in ("write", "activated", "leased")]


UNATTENDED = {
    "a second push within a day": (lambda c, s: (c, replace(s, attended=False, last_push_s=NOW_S - 3600.0)), "POLICY TIME"),
    "walked away over a month": (
        lambda c, s: (c, replace(s, attended=False, month_ago={("Y", "Y"): (0.0,) + (0.0601,) * 8, **{}})), "POLICY WALK",
    ),
    "base replaced since": (lambda c, s: (c, replace(s, active_crc=0x1234)), "BASE"),
    "signature of another table": (
        lambda c, s: (replace(c, seal=replace(c.seal, digest="0" * 64)), s), "SIGNATURE",
    ),
    "three tables of an axis together": (lambda c, s: (c, s), "VALUE"),
}  # fmt: skip


@pytest.mark.parametrize("name", UNATTENDED)
def test_what_the_classes_do_not_hold_is_rejected_too(name: str) -> None:
    change, word = UNATTENDED[name]
    candidate, context = good(Random(3))
    limits = replace(LIMITS, value_mm=0.012) if word == "VALUE" else LIMITS
    made: tuple[Candidate, CandidateContext] = change(candidate, context)
    assert [r for r in reasons_against(*made, limits) if r.startswith(word)]


@pytest.mark.parametrize(("units", "refused"), [(-9, True), (-1, True), (0, False), (1, True), (9, True)])
def test_the_reference_stays_where_it_is(units: int, refused: bool) -> None:
    """One unit there moves the axis at once when the table comes into force."""
    for at in range(9):
        candidate, context = good(Random(11))
        columns = list(candidate.columns)
        columns[at] = replace(columns[at], correction_mm=(units * LSB_MM, *columns[at].correction_mm[1:]))
        reasons = reasons_against(signed(replace(candidate, columns=tuple(columns))), context, LIMITS)
        assert [reason.split(":")[0] for reason in reasons] == ["REFERENCE"] * refused, at


def test_a_table_beyond_what_was_measured_needs_the_word_of_the_machine_file() -> None:
    """The table corrects X from 0 to 640 of 800 mm; the runs left 224 mm (28 %) of that at its end."""
    candidate, context = good(Random(4))
    reached = ((0.0, 416.0), (0.0, 640.0), (160.0, 640.0))
    made = signed(replace(candidate, evidence=replace(candidate.evidence, reached_mm=reached)))
    (reason,) = reasons_against(made, context, LIMITS)
    assert reason.startswith(
        "REACH: the runs moved X from 0 to 416 mm, but the table corrects 28% of the stroke beyond that, the limit is 25%"
    )
    assert "table_beyond_percent" in reason
    assert reasons_against(made, context, replace(LIMITS, beyond=0.28)) == []


def test_all_reasons_are_told_at_once() -> None:
    candidate, context = good(Random(5))
    bad = signed(replace(candidate, machine="other", lsb_nm=1, evidence=replace(candidate.evidence, run_count=0)))
    words = {reason.split(":")[0] for reason in reasons_against(bad, context, LIMITS)}
    assert words == {"MACHINE", "SCALE", "RUNS"}


def test_a_limit_itself_is_allowed_and_nothing_is_clamped() -> None:
    candidate, context = good(Random(7))
    worst = max(abs(v) for v in candidate.columns[1].correction_mm)
    before = candidate.columns
    assert reasons_against(candidate, context, replace(LIMITS, change_mm=max(LIMITS.change_mm, worst))) == []
    assert candidate.columns is before
