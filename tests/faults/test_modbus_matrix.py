"""Rows M1 to M10 of the fault matrix: drivers against the simulators' controller and laser, over lines that are disturbed on purpose."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from abbe.drivers.errors import DriverError, WrongDevice, on_behalf_of
from abbe.drivers.links.modbus_link import ModbusOperation
from abbe.drivers.registry import open_controller
from abbe.simulators.faults.scenario import Fault, FaultScenario, scenario
from tests.faults import rows_modbus as rows
from tests.faults.contract import BOOK, Observed, assert_fault_contract, told_of
from tests.faults.modbus_rig import KINDS, TARGET, Kind, Rig, observe, opened, records_of
from tests.faults.patient import patience
from tests.faults.stale import Pair, pair

pytestmark = pytest.mark.timeout(300)
AT_A_TIME = 28
ROWS = {row.name: row for row in rows.ROWS}
Play = Callable[[str], Awaitable[Observed]]


@pytest.fixture(scope="module", autouse=True)
def _patient():
    with patience():
        yield


async def played(row: str, play: Play) -> dict[str, Observed]:
    """Play all cases of a row, some at a time, and check each; all that break their contract are named at once."""
    gate = asyncio.Semaphore(AT_A_TIME)

    async def one(case: str) -> Observed:
        async with gate:
            with on_behalf_of(f"run {row}/{case}"):
                return await play(case)

    cases = ROWS[row].cases
    seen = dict(zip(cases, await asyncio.gather(*(one(case) for case in cases)), strict=True))
    broken = []
    for observed in seen.values():
        try:
            assert all(record.run == f"run {row}/{observed.case}" for record in observed.records), "a record names another run"
            assert_fault_contract(observed)
        except AssertionError as error:
            broken.append(f"{error}\n    told: {observed.told}\n    records: {observed.records}")
    assert not broken, "\n".join(broken)
    assert BOOK.rows[row].cases == set(cases)
    return seen


def at(kind: Kind, rig: Rig, name: str, **keys: Any) -> FaultScenario:
    """A fault on exactly the request of this kind, and on its repetition where the link repeats it."""
    return scenario(Fault(name, at=kind.nth(rig), times=2 if kind.repeated else 1, on=kind.sort, **keys))


async def test_m1_exception_codes():
    async def play(case: str) -> Observed:
        code, name = case.split(" ", 1)
        kind = KINDS[name]
        # 5 and 6 last longer than the patience: the bounded wait has to end by itself. A hold that is sent afterwards gets through.
        for_ever = {"times": 0, "on": "write 64" if name == "motion command" else kind.sort} if code in ("05", "06") else {"on": kind.sort}
        async with opened(kind.device) as rig:
            fault = Fault("exception", at=kind.nth(rig), value=int(code, 16), **for_ever)
            return await observe(rig, "M1", case, kind, lambda rig: rig.line.play(scenario(fault)))

    seen = await played("M1", play)
    expected = {"04": "DRV-006", "08": "DRV-006", "05": "DRV-003", "06": "DRV-003", "0A": "DRV-002", "0B": "DRV-002"}
    for case, observed in seen.items():
        assert observed.told is not None, case  # nothing is ever taken for done that was not
        assert observed.told.code == expected.get(case[:2], "DRV-007"), case


async def test_m2_late_replies():
    async def play(case: str) -> Observed:
        line, way, operations, factor = case.split()
        return await pair(Pair("M2", case, line, way, *operations.split("-"), float(factor)))

    await played("M2", play)


async def test_m3_black_hole():
    async def play(case: str) -> Observed:
        moving = case == "while the axes move"
        kind = KINDS["motion command" if moving else "status" if case == "idle" else case]
        heartbeat_s = 1.0 if case == "idle" else None
        async with opened(kind.device, timeout_s=1.0, heartbeat_s=heartbeat_s) as rig:
            if case == "idle":
                return await _idle(rig, case, kind)
            slow = dataclasses.replace(kind, run=lambda r: r.cnc.move(TARGET, feed_mm_min=30.0, timeout_s=20.0)) if moving else kind
            where = Fault("black_hole", at=4 if moving else kind.nth(rig), on="read" if moving else kind.sort)
            clock, noticed_s = asyncio.get_running_loop().time, list[float]()
            rig.link.incidents.listen = lambda entry: noticed_s.append(clock())
            began = clock()
            observed = await observe(rig, "M3", case, slow, lambda rig: rig.line.play(scenario(where)))
            assert noticed_s[0] - began <= 3.0, f"{case}: noticed after {noticed_s[0] - began:.1f} s"
            return observed

    await played("M3", play)


async def _idle(rig: Rig, case: str, kind: Kind) -> Observed:
    """Nobody asks anything: the heartbeat has to find it."""
    clock = asyncio.get_running_loop().time
    began = clock()
    rig.line.play(scenario(Fault("black_hole")))
    while not rig.link.incidents.entries and clock() - began < 3.0:  # noqa: ASYNC110 - polled with a deadline
        await asyncio.sleep(0.02)
    assert rig.link.incidents.entries, "not noticed within 3 s"
    trouble = rig.link.incidents.open
    assert trouble is not None
    state = rig.link.state
    rig.line.play(FaultScenario())
    while rig.link.incidents.open is not None and clock() - began < 10.0:  # noqa: ASYNC110 - polled with a deadline
        await asyncio.sleep(0.02)
    resumed = kind.right(rig, await kind.run(rig))
    await rig.device.close()
    return Observed("M3", case, told=told_of(trouble), state=state, resumed=resumed, records=records_of(rig.link))


async def test_m4_closed_and_reset():
    async def play(case: str) -> Observed:
        how, when, name = case.split(" ", 2)
        kind = KINDS[name]
        async with opened(kind.device) as rig:
            fault = f"{how}_before" if when == "before" else how
            observed = await observe(rig, "M4", case, kind, lambda rig: rig.line.play(at(kind, rig, fault)))
            if name == "motion command":
                assert sum(command == 1 for _, _, command in rig.registers.commands) <= 2  # at most the first and the one that goes on
            return observed

    await played("M4", play)


async def test_m5_slow_is_not_wrong():
    async def play(case: str) -> Observed:
        factor, how, name = case.split(" ", 2) if not case.split(" ", 1)[1].startswith("one of") else _spiked(case)
        kind, timeout_s = KINDS[name], 0.2
        seconds = float(factor) * timeout_s
        fault = Fault("latency", seconds=seconds, times=0) if how == "always" else Fault("latency", seconds=seconds, at=37)
        rounds = 1 if how == "always" else (3 if name == "motion command" else 100)

        async def repeatedly(rig: Rig) -> Any:
            answers = [await kind.run(rig) for _ in range(rounds)]
            return answers if all(kind.right(rig, answer) for answer in answers) else None

        many = dataclasses.replace(kind, run=repeatedly, right=lambda rig, answer: answer is not None)
        if name == "motion command" and how != "always":
            fault = dataclasses.replace(fault, at=2)
        async with opened(kind.device, timeout_s=timeout_s) as rig:
            quiet = {"A": "slow within its deadline is not a fault"} if float(factor) < 1 else {}
            observed = await observe(rig, "M5", case, many, lambda rig: rig.line.play(scenario(fault)), **quiet)
            assert (observed.told is None) or float(factor) > 1, case
            return observed

    await played("M5", play)


def _spiked(case: str) -> tuple[str, str, str]:
    factor, rest = case.split(" ", 1)
    return factor, "one of 100", rest.removeprefix("one of 100 ")


SEGMENTS = {
    "one byte at a time": Fault("one_byte", times=0),
    "two halves": Fault("split", times=0, seconds=0.02),
    "two replies in one segment": Fault("twice"),
    "length too large": Fault("set_length", value=100),
    "length too small": Fault("set_length", value=4),
    "length 0": Fault("set_length", value=0),
    "length 65535": Fault("set_length", value=65535),
    "protocol id 1": Fault("set_pid", value=1),
}


async def test_m6_segments():
    async def play(case: str) -> Observed:
        fault, kind = SEGMENTS[case], KINDS["status"]
        good = case in ("one byte at a time", "two halves")
        quiet = {"A": "a reply in pieces is not a fault"} if good else {}
        async with opened("cnc") as rig:
            line = rig.line
            before = line.connections  # type: ignore[union-attr]
            observed = await observe(rig, "M6", case, kind, lambda rig: rig.line.play(scenario(fault)), **quiet)
            assert observed.absorbed
            assert (line.connections > before) is not good  # type: ignore[union-attr]
            if not good:
                assert "the reply does not fit" in rig.link.incidents.entries[0].text  # seen at once, not when the time was up
            return observed

    await played("M6", play)


def _wrong(name: str, kind: Kind) -> tuple[str, dict[str, Any]]:
    """The fault that makes a reply not fit in this way."""
    function = 3 if kind.sort == "read" else 16
    return {
        "unit": ("set_unit", {"value": 2}),
        "tid": ("set_tid", {"value": 54321}),
        "check sum": ("flip", {"value": 36}),
        "function": ("set_function", {"value": 4 if function == 16 else 6}),
        "another's exception": ("instead", {"data": "8602" if function == 16 else "9002"}),
        "byte count": ("set_byte_count", {"value": 3}),
        "fewer registers": ("more_registers", {"value": -1}),
        "more registers": ("more_registers", {"value": 1}),
        "echo address": ("set_address", {"value": 7}),
        "echo count": ("set_count", {"value": 99}),
        "echo too long": ("noise_after", {"data": "00"}),
    }[name]


async def test_m7_replies_that_do_not_answer():
    async def play(case: str) -> Observed:
        line, rest = case.split(" ", 1)
        name = next(name for name in KINDS if rest.startswith(name + " "))
        kind, wrong = KINDS[name], rest.removeprefix(name + " ")
        fault, keys = _wrong(wrong, kind)
        async with opened(kind.device, line) as rig:
            return await observe(rig, "M7", case, kind, lambda rig: rig.line.play(at(kind, rig, fault, **keys)))

    seen = await played("M7", play)
    for case, observed in seen.items():
        assert observed.records[0].code == "DRV-004", case  # refused, whether it was then overcome or told


def _ordered(order: str) -> list[int]:
    return {"ABCD": [0, 1, 2, 3], "CDAB": [2, 3, 0, 1], "BADC": [1, 0, 3, 2], "DCBA": [3, 2, 1, 0]}[order]


def _shown_as(words: list[int], order: str) -> list[int]:
    """How a device of another order shows a value of 2 or 4 registers."""
    if order in ("CDAB", "DCBA"):
        words = words[::-1]
    return [word >> 8 | (word & 0xFF) << 8 for word in words] if order in ("BADC", "DCBA") else words


async def test_m8_byte_and_word_order():
    async def play(case: str) -> Observed:
        device, order, *rest = case.split()
        async with opened("cnc" if device == "controller" else "laser") as rig:
            first, count = {"int32": (0, 2), "float32": (2, 2), "int64": (16 if device == "controller" else 12, 4)}.get(
                "".join(rest), (0, 0)
            )

            def reorder(address: int, words: list[int]) -> list[int]:
                at = first - address
                if order == "ABCD" or at < 0 or at + count > len(words):
                    return words
                return words[:at] + _shown_as(words[at : at + count], order) + words[at + count :]

            while rig.registers.read(10, 1) is None or rig.world.time_s < 1.0:  # noqa: ASYNC110 - a clock at 0 looks the same in any order
                await asyncio.sleep(0.01)
            rig.registers.reorder = reorder
            return await _identified_anew(rig, "M8", case, lambda: setattr(rig.registers, "reorder", lambda address, words: words))

    seen = await played("M8", play)
    for case, observed in seen.items():
        if case.endswith("ABCD"):
            assert observed.told is None
        else:
            assert observed.told is not None, case
            assert observed.told.code == "DRV-005", case
            assert case.split()[2].replace("int64", "64-bit") in observed.told.cause, observed.told
            assert case.split()[2] == "int64" or case.split()[1] in observed.told.cause, observed.told


async def _identified_anew(rig: Rig, row: str, case: str, lift: Callable[[], None]) -> Observed:
    """Identify the device as at a connect; then lift the fault and identify it again."""
    error: DriverError | None = None
    try:
        await rig.device.identify()
    except DriverError as caught:
        error = caught
    state = rig.link.state if error is None else "refused"
    lift()
    resumed = (await rig.device.identify()).boot_id > 0
    await rig.device.close()
    quiet = {} if error is not None else {"A": "nothing is wrong with the right order"}
    told = None if error is None else told_of(error)
    return Observed(
        row, case, told=told, absorbed=error is None, state=state, resumed=resumed, records=records_of(rig.link), left_out=quiet
    )


MAP_FIXED = ("MAP_VER", "N_AXES", "BANK_SIZE")
"""Refused by the driver at once; the others are read from the controller, and must stay as they were."""
MAP_AT = {"MAP_VER": 4, "N_AXES": 9, "TABLE_LSB_NM": 10, "BANK_SIZE": 11, "FIFO_SIZE": 12}


async def test_m9_another_register_map():
    async def play(case: str) -> Observed:
        when, name = case.rsplit(" ", 1)
        async with opened("cnc") as rig:
            info = await rig.device.identify()
            rig.registers.shown = {MAP_AT[name]: 2}
            if when == "at connect" and name in MAP_FIXED:
                with pytest.raises(WrongDevice) as refused:
                    await open_controller(rig.line.url)
                assert refused.value.code == "DRV-005"
            rig.line.hang_up()  # type: ignore[union-attr]
            error: DriverError | None = None
            try:
                await rig.cnc.status()
            except DriverError as caught:
                error = caught
            assert isinstance(error, WrongDevice), (case, error)
            assert info.firmware in str(error) or "instead of" in str(error)
            moved = rig.registers.dangerous_after(0.0)
            with pytest.raises(WrongDevice):
                await rig.cnc.move(TARGET, feed_mm_min=60000.0, timeout_s=5.0)
            moved = rig.registers.dangerous_after(0.0) - moved
            rig.registers.shown = {}
            resumed = (await rig.cnc.identify()).firmware == info.firmware
            await rig.device.close()
            told = told_of(error)
            # the hang-up was a trouble of its own, overcome before the map was looked at
            entries = [r for r in records_of(rig.link) if r.code == "DRV-005"]
            return Observed("M9", case, told=told, commands_after=moved, state="refused", resumed=resumed, records=entries)

    await played("M9", play)


FOREIGN = "02030064000a" + "85e1" + "0203140000000000000000000000000000000000000000"
LINE_FAULTS = {
    "echo": lambda kind, at: Fault("echo", at=at, on=kind.sort),
    "collision": lambda kind, at: Fault("flip", at=at, on=kind.sort, value=21),
    "noise tail": lambda kind, at: Fault("noise_after", at=at, on=kind.sort, data="ff00ff"),
    "noise in front": lambda kind, at: Fault("noise_before", at=at, on=kind.sort, data="00ff"),
    "gap inside a reply": lambda kind, at: Fault("split", at=at, on=kind.sort, seconds=0.02),
}


async def test_m10_a_disturbed_line():
    async def play(case: str) -> Observed:
        kind = KINDS[next(name for name in rows.LINE_KINDS if case.endswith(name))]
        name = case.removesuffix(next(name for name in rows.LINE_KINDS if case.endswith(name))).strip()
        async with opened(kind.device, "rtu") as rig:
            before = rig.link.foreign_bytes

            def disturb(rig: Rig) -> None:
                if name == "foreign master":
                    rig.line.inject(bytes.fromhex(FOREIGN))  # type: ignore[union-attr]
                else:
                    rig.line.play(scenario(LINE_FAULTS[name](kind, kind.nth(rig))))

            quiet = {"A": "a gap is not a fault"} if name == "gap inside a reply" else {}
            if name == "foreign master":
                quiet = {"A": "other traffic is counted; it disturbed no request of ours"}
            observed = await observe(rig, "M10", case, kind, disturb, **quiet)
            if name == "foreign master" and not observed.records:
                assert rig.link.foreign_bytes - before == len(bytes.fromhex(FOREIGN))
            return observed

    await played("M10", play)


def test_every_operation_has_a_rule():
    assert {op.name for op in ModbusOperation} == {"READ", "LEVEL", "NUMBERED", "TRIGGER"}
