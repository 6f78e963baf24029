"""The judge of the races finds what it is there to find: logs of a controller in which two did mix, each with one thing wrong."""

from __future__ import annotations

from itertools import chain

import pytest

from tests.push.bench import image
from tests.push.races import Access, Racer, _interleaved, _outcomes

ONE, OTHER = 10, 11
CHUNK = 100


class Nobody:
    """A racer needs no process to be judged."""

    owner = 0


def racer(height: int, state: str | None, why: str = "why") -> Racer:
    return Racer(Nobody(), height, state == "KEEP", 0.0, height, {"state": state, "why": why, "settled": True})  # type: ignore[arg-type]


def write(height: int, chunk: int, owner: int, *, taken: bool = True) -> Access:
    data = bytes.fromhex(image(height))[2 * CHUNK * chunk : 2 * CHUNK * (chunk + 1)]
    words = [int.from_bytes(data[k : k + 2], "big") for k in range(0, len(data), 2)]
    return Access(0.0, "write", 1, CHUNK * chunk, words, 0, taken, owner << 16, 0, 1)


def command(kind: str, height: int, *, taken: bool = True) -> Access:
    return Access(0.0, kind, 1, 0, [1, 0], height << 16, taken, height << 16, 0, 1)


def pushed(height: int) -> list[Access]:
    return [*(write(height, k, height) for k in range(3)), command("seal", height), command("activate", height)]


GOOD = (racer(ONE, "KEEP"), racer(OTHER, "ABORTED"))
BOTH = (racer(ONE, "KEEP"), racer(OTHER, "KEEP"))


def test_nothing_is_found_where_nothing_is_wrong():
    assert [*_interleaved(GOOD, pushed(ONE)), *_outcomes(GOOD, pushed(ONE), "")] == []
    one_after_the_other = [*pushed(OTHER), *pushed(ONE)]
    assert [*_interleaved(BOTH, one_after_the_other), *_outcomes(BOTH, one_after_the_other, "")] == []


@pytest.mark.parametrize(
    ("two", "log", "found"),
    [
        (BOTH, list(chain(*zip(pushed(ONE), pushed(OTHER), strict=True))), "interleaved"),
        (GOOD, [*pushed(ONE)[:2], write(OTHER, 0, ONE), *pushed(ONE)[2:]], "without the lease"),
        (GOOD, [write(OTHER, 0, 0, taken=False), *pushed(ONE)], "without the lease (refused)"),
        (GOOD, [write(77, 1, ONE), *pushed(ONE)], "nobody's"),
        (GOOD, [write(OTHER, 0, OTHER), *pushed(ONE)], "came to nothing"),
        (GOOD, [*pushed(OTHER), *pushed(ONE)], "says that nothing was brought into force"),
        (BOTH, pushed(ONE), "0 activations"),
        ((racer(ONE, "ABORTED"), racer(OTHER, None)), [], "nobody got through"),
        ((racer(ONE, "KEEP"), racer(OTHER, "ABORTED", "")), pushed(ONE), "without a word"),
        ((racer(ONE, "KEEP"), racer(OTHER, "OPERATOR")), pushed(ONE), "did not come to an end"),
    ],
)
def test_what_is_wrong_is_found(two, log, found):
    assert found in " | ".join([*_interleaved(two, log), *_outcomes(two, log, "")])
