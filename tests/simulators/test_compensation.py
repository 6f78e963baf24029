import struct

import pytest

from abbe.simulators.cnc.bank import checksum, empty_image
from abbe.simulators.cnc.compensation import BankState, Compensation, CompResult

ME, OTHER = 11, 22


@pytest.fixture
def comp() -> Compensation:
    """Bank 1 holds a sealed image that differs from bank 0's; ME has the lease."""
    c = Compensation()
    words = empty_image()
    words[5] = 99  # TABLE_ID
    assert c.write(1, 0, words)
    assert c.lease(ME, 10_000, 0.0) == CompResult.OK
    assert c.seal(1, ME, 0.0) == CompResult.OK
    return c


def expected(c: Compensation) -> tuple[int, int]:
    return c.crcs[1], c.generation


def activate(c: Compensation, owner: int = ME, want: tuple[int, int] | None = None, *, may_act: bool = True, now_s: float = 1.0):
    return c.activate(1, owner, want or expected(c), may_act=may_act, now_s=now_s)


def test_after_boot() -> None:
    c = Compensation()
    assert (c.active, c.kind, c.states) == (0, 0, [BankState.SEALED, BankState.EMPTY])
    assert c.crcs == [checksum(empty_image()), 0]


def test_activation_is_compare_and_swap(comp: Compensation) -> None:
    crc, generation = expected(comp)
    assert activate(comp, want=(crc ^ 1, generation)) == CompResult.CRC_DIFFERS
    assert activate(comp, want=(crc, generation + 1)) == CompResult.GEN_DIFFERS
    assert activate(comp, may_act=False) == CompResult.INTERLOCK
    assert activate(comp, owner=OTHER) == CompResult.LEASED
    assert (comp.active, comp.generation) == (0, generation)
    assert activate(comp) == CompResult.OK
    assert (comp.active, comp.generation) == (1, generation + 1)
    assert activate(comp) == CompResult.BANK_ACTIVE
    assert comp.activate(2, ME, (0, 0), may_act=True, now_s=1.0) == CompResult.BAD_ARGUMENT


def test_a_write_unseals_and_counts(comp: Compensation) -> None:
    crc, generation = expected(comp)
    assert comp.write(1, 5, [98])
    assert (comp.states[1], comp.crcs[1], comp.generation) == (BankState.WRITING, 0, generation + 1)
    assert activate(comp, want=(crc, comp.generation)) == CompResult.NOT_AN_IMAGE
    assert comp.seal(1, ME, 1.0) == CompResult.OK
    assert comp.crcs[1] != crc


def test_the_active_bank_and_the_ends_are_closed(comp: Compensation) -> None:
    assert not comp.write(0, 0, [1])
    assert not comp.write(1, 4799, [1, 2])
    assert comp.seal(0, ME, 1.0) == CompResult.BANK_ACTIVE


def test_seal_refuses_what_is_no_image(comp: Compensation) -> None:
    comp.write(1, 0, list(struct.unpack(">2H", b"nope")))
    assert comp.seal(1, ME, 1.0) == CompResult.NOT_AN_IMAGE
    assert comp.states[1] == BankState.WRITING


def test_lease(comp: Compensation) -> None:
    assert comp.lease(OTHER, 1000, 5.0) == CompResult.LEASED
    assert comp.release(OTHER, 5.0) == CompResult.LEASED
    assert comp.lease_left_ms(5.0) == 5000
    assert comp.lease(OTHER, 1000, 10.0) == CompResult.OK, "the old lease has run out"
    assert comp.seal(1, ME, 10.5) == CompResult.LEASED
    assert comp.release(OTHER, 10.5) == CompResult.OK
    assert (comp.owner(10.6), comp.lease_left_ms(10.6)) == (0, 0)
    assert comp.seal(1, OTHER, 10.6) == CompResult.LEASED, "without a lease nobody seals"
    assert comp.lease(0, 1000, 11.0) == CompResult.BAD_ARGUMENT


def test_a_lease_lasts_in_the_hosts_time() -> None:
    c = Compensation(lease_scale=60.0)
    c.lease(ME, 1000, 0.0)
    assert c.owner(59.0) == ME
    assert c.lease_left_ms(30.0) == 500
    assert c.owner(60.0) == 0
