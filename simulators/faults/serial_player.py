"""Plays a scenario of faults (see `abbe.simulators.faults.scenario`) on a serial line; events are the frames that the box sends, counted
from 0.

==========  ==========================================================================================
kind        what happens at the frames that it hits
==========  ==========================================================================================
garbage     ``value`` random bytes (or ``data``) come before the frame
truncate    only the first ``value`` bytes arrive
flip        bit ``value`` is flipped
burst       two to six bytes in a row are changed
drop        the frame does not arrive
repeat      the frame arrives ``value`` times more
stall       this frame and all later bytes arrive together after ``seconds``
unplug      the cable is pulled before the frame
==========  ==========================================================================================
"""

import asyncio
import random
from collections.abc import Callable, Iterator

from abbe.simulators.faults.scenario import Fault, FaultScenario
from abbe.simulators.faults.serial_bytes import burst, cut, flipped, garbage
from abbe.simulators.faults.serial_line import FaultyLine

Change = Callable[[bytes, Fault, random.Random], bytes]
_CHANGES: dict[str, Change] = {
    "garbage": lambda frame, fault, draw: (bytes.fromhex(fault.data) or garbage("random", fault.value, draw)) + frame,
    "truncate": lambda frame, fault, draw: frame[: fault.value],
    "flip": lambda frame, fault, draw: flipped(frame, fault.value % (8 * len(frame))),
    "burst": lambda frame, fault, draw: burst(frame, draw),
    "drop": lambda frame, fault, draw: b"",
    "repeat": lambda frame, fault, draw: frame * (1 + fault.value),
}
KINDS = (*_CHANGES, "stall", "unplug")


def play(line: FaultyLine, scenario: FaultScenario) -> None:
    """Play the scenario on the line from the next frame on, in place of the previous one.

    Raises
    ------
    FaultScenarioError
        A kind that is not in the table above.
    """
    scenario.check(KINDS)
    draw, number = random.Random(scenario.seed), -1

    def spoil(data: bytes) -> Iterator[bytes]:
        nonlocal number
        for frame in cut(data):
            number += 1
            yield _changed(line, frame, [fault for fault in scenario.faults if fault.hits(number)], draw)

    line.spoil = spoil


def _changed(line: FaultyLine, frame: bytes, faults: list[Fault], draw: random.Random) -> bytes:
    for fault in faults:
        if fault.kind == "stall":
            line.stall()
            asyncio.get_running_loop().call_later(fault.seconds, line.resume)
        elif fault.kind == "unplug":
            line.pull()
        elif len(frame) > 8:  # an earlier fault may have left too few bytes for another
            frame = _CHANGES[fault.kind](frame, fault, draw)
    return frame
