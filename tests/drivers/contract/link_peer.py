"""A Modbus link to the peer of `conftest`, and what a peer may do instead of answering."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator

import pytest

from abbe.drivers.links.incidents import Backoff
from abbe.drivers.links.modbus_link import ModbusLink
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl, parse_url
from tests.faults.patient import patience

TIMEOUT_S = 0.15
"""Of a reply, by a clock that does not count what other programs take of a loaded computer."""


@pytest.fixture(scope="module", autouse=True)
def patient() -> Iterator[None]:
    """For modules that import it: peer and link live in one process."""
    with patience():
        yield


@pytest.fixture
async def link(peer) -> AsyncIterator[ModbusLink]:
    for address in range(1000):
        peer.words[address] = address
    url = parse_url(peer.url)
    assert isinstance(url, ModbusTcpUrl | ModbusRtuUrl)
    opened = await ModbusLink.connect(url, timeout_s=TIMEOUT_S, backoff=Backoff(first_s=0.005))
    yield opened
    await opened.close()


async def silent(exchange) -> None:
    return


def times(trick, n=2):
    """Reads are repeated once, so a trick has to be played twice to reach the caller."""
    return [trick] * n
