# ruff: noqa: E501 - an edit names the line that it replaces
"""A control with one table against every fault: I1 to I20 or the named weaker form; with a protection taken away, one is violated."""

from __future__ import annotations

import os
from dataclasses import replace
from types import SimpleNamespace

import pytest

from tests.push.invariants import CHECKS
from tests.push.loading import Edits, edited, real
from tests.push.one_bank import CASES, WEAKER, OneBankWorld
from tests.push.sweep import doubles, first_violation, singles

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
SAMPLE, FIRSTS = 601, 4
"""Of every fourth first fault, every so manieth pair."""
TESTED = ("one table, kept", "one table, unattended")
"""Every day; all with ABBE_TEST_LONG."""

MUTANTS: dict[str, Edits] = {
    "not read back": (("one_bank", "found = (await self._c.read_table())[: len(new)]", "found = new"),),
    "written before it is switched off": (
        ("one_bank", "        if acted:\n            await self._c.switch(on=False", "        if False:\n            await self._c.switch(on=False"),
    ),
    "generation not compared": (("one_bank", "if now.gen != expect_gen:", "if False:"),),
    "switched with any CRC": (("one_bank", "await self._c.switch(on=True, expect_crc=crc)", "await self._c.switch(on=True, expect_crc=zlib.crc32(image_in(await self._c.read_table())))"),),
    "table that is off taken for the old one": (("back", 'return "off"', 'return "base"'),),
    "table that is off taken for the new one": (("back", 'return "off"', 'return "candidate"'),),
    "foreign content overwritten": (("back", "if step is not None and _mixed(", "if step is not None or _mixed("),),
    "not restored after an interruption": (("machine", 'if which in ("candidate", "off"):', 'if which == "candidate":'),),
    "a person's switching off overridden": (("machine", 'if which == "off" and isinstance(known.verdict, OperationRefused):', "if False:"),),
    "unattended at level 1": (("journal", "if level in (1, 2):\n        return \"\" if attended else NEEDS_ATTENDANCE", 'if level in (1, 2):\n        return ""'),),
    "e-stop not looked at": (("machine", 'return f"not safe now: {truth.unsafe}" if truth.unsafe else ""', 'return ""'),),
    "a refusal after switching off told as nothing changed": (("one_bank", "except Refused as error:\n            raise DeviceFault", "except ZeroDivisionError as error:\n            raise DeviceFault"),),
    "old table not told from another": (("back", "f.crc if in_force(f, truth) != \"off\" else 0", "f.crc"),),
}  # fmt: skip


def test_weaker_forms_are_named() -> None:
    """Nothing is weaker silently: a checker of its own for each, and its reason where it is weaker than with two banks."""
    assert set(WEAKER) < {*CHECKS, "T1"}
    weaker = {name for name, check in WEAKER.items() if "WEAKER" in (check.__doc__ or "")}
    assert weaker == {"I3", "I12", "I13", "I18"}


def test_no_single_fault_violates_anything() -> None:
    count = singles(real(), tuple(c for c in CASES if c.name in TESTED or LONG))
    assert count.examples == []
    assert count.combinations > 1500
    assert set(count.ends) == {"KEEP", "ROLLED_BACK", "ABORTED", "REJECTED", "OPERATOR", "nothing begun"}


def test_no_second_fault_violates_anything() -> None:
    count = doubles(real(), CASES[1]) if LONG else doubles(real(), CASES[1], every=SAMPLE, part=(1, FIRSTS))
    assert count.examples == []
    assert count.combinations > 250


def test_a_control_that_writes_while_its_table_acts_is_seen() -> None:
    """`abbe comp commission --one-bank` proves that it refuses: without switching it off, a mixture would act."""
    never_off = (
        (
            "one_bank",
            "        if acted:\n            await self._c.switch(on=False",
            "        if False:\n            await self._c.switch(on=False",
        ),
    )
    assert {"I1", "I2"} <= set(OneBankWorld(edited(never_off), replace(CASES[0], one_bank=True), {}).run())


def test_a_control_that_switches_with_any_crc_is_seen() -> None:
    """Also proved by the commissioning: a late write could otherwise act."""
    assert "I8" in singles(real(), (replace(CASES[0], compares=False),), until=frozenset({"I8"})).violated


def test_what_a_person_writes_while_it_is_off_is_left_alone() -> None:
    """After a process died with compensation off: an edit at each later instant, and the check that sees it taken away."""
    unseen = (("back", 'in_force(f, step.truth) == "off" and step.truth.gen != f.restage_gen', "False"),)
    assert _edits_after_death(real()) == []
    assert "I13" in _edits_after_death(edited(unseen))


def _edits_after_death(protocol: SimpleNamespace) -> list[str]:
    """Violations by an edit at every place after a crash behind the switching off."""
    kinds = OneBankWorld(protocol, CASES[0], {}).kinds_of_run()
    off = kinds.index("command")
    dead = {off: "crash_after"}
    count = len(OneBankWorld(protocol, CASES[0], dead).kinds_of_run())
    return [name for n in range(off + 1, count) for name in OneBankWorld(protocol, CASES[0], dead | {n: "hand_active"}).run()]


@pytest.mark.parametrize("name", MUTANTS)
def test_every_mutant_is_killed(name: str) -> None:
    assert first_violation(edited(MUTANTS[name]), CASES)


def test_between_two_tables_nothing_acts() -> None:
    world = OneBankWorld(real(), CASES[0], {})
    assert world.run() == []
    acted = [event[1:] for event in world.events if event[0] == "switched"]
    assert acted == [(False, world.base), (True, world.candidate)]
