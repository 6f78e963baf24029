"""Preconditions for resuming a measurement: the same controller run, the same table, and no interlock."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.drivers.api import ControllerStatus
from abbe.service.devices.session import Session
from abbe.service.errors import PreconditionsChanged
from abbe.service.sequences.interlocks import Watching, air_trouble, beam_trouble, check_interlocks


@dataclass(frozen=True, slots=True)
class ExpectedTable:
    """Boot id of the controller and CRC of the active table when the campaign began."""

    boot_id: int
    table_crc: int


async def check_preconditions(session: Session, expected: ExpectedTable | None, watching: Watching, *, beam: bool) -> ControllerStatus:
    """Check all preconditions and return the controller's status. ``beam``: during a laser run, also check the beam.

    Raises
    ------
    PreconditionsChanged
        Another boot id or another table: the campaign cannot resume.
    Interlock
        A condition must clear first.
    """
    status = await session.controller.status()
    if expected is not None:
        comp = await session.controller.comp_status()
        check_expected(expected, comp.boot_id, comp.bank_crc[comp.active_bank])
    check_interlocks(status)
    if session.laser is not None and (beam or watching.air_c is not None):
        reading = await session.laser.peek()
        trouble = (beam_trouble(reading) if beam else None) or air_trouble(reading, watching.air_c)
        if trouble is not None:
            raise trouble
    return status


def check_expected(expected: ExpectedTable, boot_id: int, table_crc: int) -> None:
    """Raise PreconditionsChanged if the controller was restarted or another table is active."""
    if boot_id != expected.boot_id:
        raise PreconditionsChanged(
            f"the controller was restarted since this campaign began (boot id {boot_id:#x} instead of {expected.boot_id:#x})",
            "its clock began anew: measure a new campaign; the complete runs of this one stay",
        )
    if table_crc != expected.table_crc:
        raise PreconditionsChanged(
            f"another compensation table is active (CRC {table_crc:08X} instead of {expected.table_crc:08X})",
            "make the old one active again, or measure a new campaign",
        )
