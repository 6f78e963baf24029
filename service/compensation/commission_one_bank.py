"""Commissioning of a control with one table, for the lower level that a person requests explicitly (`abbe comp commission --one-bank`).

The assumptions behind an exchange of tables are tested with a copy of the table in force: the control has to refuse writes while its
table acts, and any switch with a wrong CRC. Compensation is off for some tenths of a second, while the machine stands; an axis may move
by its present correction.
"""

from __future__ import annotations

from typing import cast

from abbe.drivers.api import Controller, OneBank, has_one_table
from abbe.drivers.errors import Refused, run_to_end
from abbe.service.clock import SystemClock
from abbe.service.compensation.commission_levels import FlagObservation, ProvedLevels, Trial, keep_proof
from abbe.service.compensation.proved_levels import flags_of, identity
from abbe.service.compensation.recover import recover
from abbe.service.errors import TableMismatch, TableRefused
from abbe.service.push.journal import Capabilities
from abbe.service.sequences.control import check_interlocks
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base

FLAG = "can_disable"
NOT_SHOWN = (
    "that a restart leaves switched-off compensation off: this test restarts nothing",
    "that a late or repeated request to switch does nothing: the driver numbers its requests",
    "lease, interlocks at the instant of a switch, and two banks: this level has none of them",
)


async def commission_one_bank(controller: Controller, store: Store, site: Site) -> ProvedLevels:
    """Prove the capabilities of level 1, and store them; the table in force is the same afterwards.

    Raises
    ------
    TableRefused
        The control has two banks, which are safer.
    Interlock, UnsafeToMove
        The machine is not ready, or an axis moves.
    TableMismatch
        No table acts, or another table acts after the test.
    DriverError
        The link failed: look at the control, compensation may be off.
    """
    if not has_one_table(controller):
        raise TableRefused("this control has two banks, which is safer", "leave --one-bank out; nothing was tried")
    await recover(controller, store, site)
    check_interlocks(await controller.status())
    info, base = await controller.identify(), await read_base(controller)
    trial, control = Trial(controller, SystemClock(), base, 1, 2), cast(OneBank, controller)
    try:
        await _try(trial, control)
    finally:
        await run_to_end(_on_again(trial, control))
    capabilities = Capabilities(can_disable=trial.is_proved(FLAG))
    doc = {
        "identity": identity(info), "boot_id": info.boot_id, "flags": flags_of(capabilities), "level": capabilities.level,
        "shown": [[s.flag, s.ok, s.what] for s in trial.shown], "not_shown": list(NOT_SHOWN),
    }  # fmt: skip
    number = await store.write(keep_proof, store, site, doc)
    return ProvedLevels(capabilities, tuple(trial.shown), NOT_SHOWN, identity(info), number)


async def _try(t: Trial, control: OneBank) -> None:
    """Try the forbidden operations first; then switch the table off, write, and switch it on again."""
    crc, part = t.base.crc, t.base.image[:8]
    t.expect_refusal(FLAG, await t.refusal_of(control.write_table(part, first=0)), "a write while the table acts")
    t.expect_refusal(FLAG, await t.refusal_of(control.switch(on=False, expect_crc=crc ^ 1)), "to switch off with another CRC")
    if not (await control.table_state()).acts:
        t.fail(FLAG, "the table is off although the request was refused")
        return
    await control.switch(on=False, expect_crc=crc)
    t.judge(FLAG, not (await control.table_state()).acts, "says that it is off", "does not say that it is off")
    t.expect_refusal(FLAG, await t.refusal_of(control.switch(on=False, expect_crc=crc)), "to switch off what is off")
    t.expect_refusal(FLAG, await t.refusal_of(control.switch(on=True, expect_crc=crc ^ 1)), "to switch on with another CRC")
    why = await t.refusal_of(control.write_table(part, first=0))
    t.judge(FLAG, not why, "takes a write while it is off", f"refuses a write while it is off: {why}")


async def _on_again(t: Trial, control: OneBank) -> None:
    """Switch the table on again, and check that it has not changed."""
    if not (await control.table_state()).acts:
        try:
            await control.switch(on=True, expect_crc=t.base.crc)
        except Refused as error:
            raise TableMismatch(f"compensation is off and cannot be switched on: {error.detail}", "look at the control") from error
    found = await read_base(t.controller)
    if found.image != t.base.image:
        raise TableMismatch("the table in force differs from the one before the test", "look at the control")
    t.shown.append(FlagObservation(FLAG, True, "acts with the same table afterwards"))
