"""What status words mean: those of the controller against docs/protocols/cnc.md; those of bar and laser, typed in from their pages."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from abbe.drivers import api
from abbe.drivers.api import Condition
from abbe.drivers.cnc.registers import conditions_of, interlocks
from abbe.drivers.errors import Refused
from abbe.drivers.one_bank import FORBIDDEN, NEEDED, OneBankTables

PROTOCOLS = Path(__file__).parents[2] / "docs" / "protocols"
WORDS = {
    "e-stop pressed": "ESTOP",
    "door open": "DOOR_OPEN",
    "alarm": "ALARM",
    "remote mode": "REMOTE",
    "axes referenced": "REFERENCED",
    "drives on": "DRIVES_ON",
    "moving": "MOVING",
    "in position": "IN_POSITION",
    "feed hold": "FEED_HOLD",
    "path running": "PATH_RUNNING",
    "compensation on": "COMPENSATION_ON",
    "NC program running": "NC_PROGRAM",
    "spindle turning": "SPINDLE",
}


def documented() -> dict[int, Condition]:
    text = (PROTOCOLS / "cnc.md").read_text().partition("STATUS_BITS: ")[2].partition("Motion needs")[0].replace("\n", " ")
    found = re.findall(r"(\d+) ([A-Za-z][A-Za-z -]*[a-z])", text)
    return {int(bit): Condition[WORDS[words]] for bit, words in found}


def test_the_document_names_thirteen_bits():
    assert sorted(documented()) == list(range(13))


def test_every_status_word_gives_the_conditions_that_the_document_says():
    bits = documented()
    for word in range(1 << 13):
        wanted = {condition for bit, condition in bits.items() if word >> bit & 1}
        assert set(conditions_of(word)) == wanted


def test_bits_that_the_document_does_not_know_are_left_out():
    assert conditions_of(0xFFFF_E000) == Condition(0)


def test_motion_is_refused_unless_0_1_2_11_are_clear_and_3_4_5_set():
    for word in range(1 << 13):
        may = not word & 0b1000_0000_0111 and word & 0b11_1000 == 0b11_1000
        assert (interlocks(conditions_of(word)) == []) == may


@pytest.mark.parametrize("word", [*range(64), 0xFF00 | 1 << 3, 0x0100])
def test_the_bar_says_that_it_reads(word: int):
    """Bit 0 out of range, 2 samples lost just before, 3 sync, 4 no bar; bits 8 to 15 number its settings."""
    assert api.on_path(word) == bool(word >> 3 & 1)
    assert api.bar_is_out(word) == bool(word & 1 or word >> 4 & 1)
    assert api.overran(word) == bool(word >> 2 & 1)
    assert api.bar_is_valid(word) == (not (word & 1 or word >> 2 & 1 or word >> 4 & 1))
    assert (api.bar_reasons(word) == []) == api.bar_is_valid(word)


@pytest.mark.parametrize("word", range(32))
def test_the_laser_says_that_it_counts(word: int):
    """Bit 0 beam lost (latched), 1 signal low now, 2 zeroed, 3 air compensated, 4 no reflector."""
    lost, low, zeroed, compensated, missing = (bool(word >> k & 1) for k in range(5))
    assert api.beam_is_gone(word) == (lost or missing)
    assert api.beam_is_good(word) == (not (lost or low or missing))
    assert api.signal_is_there(word) == (not (low or missing))
    assert api.is_zeroed(word) == zeroed
    assert api.air_is_compensated(word) == compensated


@pytest.mark.parametrize("flag", [*FORBIDDEN, *NEEDED], ids=lambda flag: flag.name)
async def test_a_control_with_one_table_says_why_it_is_not_safe(flag: Condition) -> None:
    """Wrong is a forbidden condition that holds, or a needed one that does not."""

    class Control:
        async def status(self) -> SimpleNamespace:
            return SimpleNamespace(conditions=NEEDED ^ flag)

    with pytest.raises(Refused, match=f"not safe now: {api.WRONG_STATES[flag]}$"):
        await OneBankTables(Control())._safe()  # type: ignore[arg-type]
