"""The fault kit of the serial line itself: scenarios from TOML, a receiver with other settings, pieces and bursts."""

from __future__ import annotations

import random

import pytest

from abbe.drivers.ballbar.frames import Bad, FrameDecoder
from abbe.drivers.errors import LinkDown, LossyLine
from abbe.simulators.faults.scenario import Fault, FaultScenarioError, load, scenario
from abbe.simulators.faults.serial_bytes import cut, every_nth, sliced
from abbe.simulators.faults.serial_line import Uart, heard
from abbe.simulators.faults.serial_player import KINDS, play
from tests.faults.serial_pure import honest
from tests.faults.serial_rig import be_patient, stage

TOML = """
name = "a bad afternoon"
seed = 3

[[fault]]
kind = "garbage"
at = 100
value = 64

[[fault]]
kind = "drop"
at = 2000

[[fault]]
kind = "repeat"
at = 2500
value = 3
times = 2

[[fault]]
kind = "stall"
at = 2600
seconds = 0.05
"""


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    be_patient(monkeypatch)


async def test_a_scenario_from_a_file(tmp_path):
    (tmp_path / "bad.toml").write_text(TOML, encoding="utf-8")
    async with stage(tmp_path, "kit", "toml") as on:
        await on.bar.identify()
        play(on.box.line, load(tmp_path / "bad.toml"))

        async def script() -> None:
            await on.box.run(3000)

        assert await on.measure(script) is None
        counters = on.bar.counters
        # the first frames are INFO, SETTINGS and two ACKs: sample n is frame n + 4
        assert (counters.bad_bytes, counters.lost, counters.duplicates) == (64, 1, 6)
        assert [batch.missing for batch in on.tap.batches if batch.missing] == [1]
        assert (on.wrong, on.unaccounted) == (0, 0)


@pytest.mark.parametrize(
    ("fault", "error"),
    [(Fault("unplug", at=50), LinkDown), (Fault("burst", at=50, times=20), LossyLine), (Fault("truncate", at=50, value=9), LossyLine)],
    ids=["unplug", "burst", "truncate"],
)
async def test_faults_end_a_run(tmp_path, fault, error):
    async with stage(tmp_path, "kit", fault.kind) as on:
        await on.bar.identify()
        play(on.box.line, scenario(fault))
        assert isinstance(await on.measure(lambda: on.box.run(200)), error)


def test_an_unknown_kind_is_refused():
    with pytest.raises(FaultScenarioError, match="'melt' is none of"):
        play(None, scenario(Fault("melt")))  # type: ignore[arg-type]
    assert "stall" in KINDS


def test_equal_settings_hear_every_byte():
    data = bytes(range(256))
    assert heard(data, Uart(460800, "even"), Uart(460800, "even")) == data


@pytest.mark.parametrize(
    "receiver", [Uart(115200), Uart(230400), Uart(921600), Uart(460800, "even"), Uart(460800, "odd")], ids=lambda u: f"{u.baud} {u.parity}"
)
def test_other_settings_hear_no_frame(receiver):
    data = b"".join(sample.frame() for sample in honest(200))
    arrived = heard(data, Uart(460800), receiver)
    assert arrived
    assert all(isinstance(frame, Bad) for frame in FrameDecoder().feed(arrived))


def test_a_parity_bit_that_happens_to_be_one_is_a_stop_bit():
    even = bytes(byte for byte in range(256) if byte.bit_count() % 2)
    assert heard(even, Uart(9600, "even"), Uart(9600)) == even


def test_pieces_and_bursts():
    frames = [sample.frame() for sample in honest(50)]
    assert cut(b"".join(frames)) == frames
    assert b"".join(sliced(b"".join(frames), 7)) == b"".join(frames)
    hit = [n for n, frame in enumerate(every_nth(frames, 10, random.Random(1)), 1) if frame != frames[n - 1]]
    assert hit == [10, 20, 30, 40, 50]
