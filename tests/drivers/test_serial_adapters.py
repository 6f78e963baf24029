"""The serial link knows its adapter again, and sees every kind of going."""

from __future__ import annotations

import asyncio
import errno
import os
import pty
import tty
from pathlib import Path

import pytest

from abbe.drivers.errors import LinkDown, WrongDevice
from abbe.drivers.links import reading as module
from abbe.drivers.links.reading import ReadingThread, Ring
from abbe.drivers.links.serial_link import Adapter, ByteLink, adapter_at, path_to_open, plugged_in
from abbe.drivers.links.urls import SerialUrl
from tests.patience import within

MINE, OTHER = Adapter("/dev/ttyUSB0", "0403:6001", "A5XK3RJT"), Adapter("/dev/ttyUSB0", "0403:6001", "B7")


def moved(adapter: Adapter, node: str) -> Adapter:
    return Adapter(node, adapter.kind, adapter.serial_number)


def test_an_unknown_adapter_is_opened_where_the_url_says():
    assert path_to_open("bar", "/dev/ttyUSB0", None, [OTHER]) == "/dev/ttyUSB0"


def test_a_known_adapter_is_found_under_another_number():
    listed = [OTHER, moved(MINE, "/dev/ttyUSB3")]
    assert path_to_open("bar", "/dev/ttyUSB0", MINE, listed) == "/dev/ttyUSB3"


def test_another_adapter_under_the_old_number_is_refused():
    with pytest.raises(WrongDevice, match="B7 is there instead of 0403:6001 A5XK3RJT"):
        path_to_open("bar", "/dev/ttyUSB0", MINE, [OTHER])


def test_an_adapter_that_is_gone_is_named():
    with pytest.raises(LinkDown, match="A5XK3RJT is not plugged in"):
        path_to_open("bar", "/dev/ttyUSB0", MINE, [])


def test_links_are_followed_and_adapters_without_a_number_are_nobody(tmp_path):
    node, link = tmp_path / "ttyUSB7", tmp_path / "by-id"
    node.touch()
    link.symlink_to(node)
    assert adapter_at(str(link), [moved(MINE, str(node))]) is not None
    assert adapter_at(str(link), [Adapter(str(node), "1a86:7523", "")]) is None
    assert adapter_at(str(link), [MINE]) is None


def test_the_system_lists_its_adapters():
    assert all(isinstance(adapter, Adapter) for adapter in plugged_in())


class Line:
    """A raw pty at a path."""

    def __init__(self, path: Path) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        self.path = path
        path.symlink_to(os.ttyname(self.slave))

    def pull(self) -> None:
        os.close(self.master)
        os.close(self.slave)
        self.path.unlink()


async def test_the_link_opens_its_adapter_wherever_it_is_plugged_in(tmp_path):
    listed: list[Adapter] = []
    first = Line(tmp_path / "ttyUSB0")
    listed[:] = [moved(MINE, str(first.path))]
    link = ByteLink(SerialUrl(str(first.path)), lambda: listed)
    await link.open()
    await link.close()
    first.pull()
    stranger, mine = Line(tmp_path / "ttyUSB0"), Line(tmp_path / "ttyUSB1")
    listed[:] = [moved(OTHER, str(stranger.path)), moved(MINE, str(mine.path))]
    await link.open()
    await link.write(b"hello")
    assert os.read(mine.master, 10) == b"hello"
    await link.close()
    mine.pull()
    listed.pop()
    with pytest.raises(WrongDevice):
        await link.open()
    stranger.pull()


async def gone(descriptor: int, hang_up) -> OSError | None:
    loop = asyncio.get_running_loop()
    told: asyncio.Future[OSError | None] = loop.create_future()
    ring = Ring(1000)
    thread = ReadingThread(descriptor, ring, lambda error: loop.call_soon_threadsafe(told.set_result, error), "bar")
    hang_up()
    async with asyncio.timeout(within(5)):
        error = await told
    thread.stop()
    assert ring.take(0.0) is None, "the ring has ended with the line"
    return error


async def test_end_of_file_is_gone():
    """What a terminal gives whose other end was closed."""
    reader, writer = os.pipe()
    assert await gone(reader, lambda: os.close(writer)) is None
    os.close(reader)


async def test_an_input_output_error_is_gone():
    """What a USB adapter gives when it is pulled: here from the other side of a pty, whose host has left."""
    master, slave = pty.openpty()
    error = await gone(master, lambda: os.close(slave))
    assert error is not None
    assert error.errno == errno.EIO
    os.close(master)


async def test_no_such_device_is_gone(monkeypatch):
    """What some USB adapters give; only the system can say it, so its answer is replaced."""
    reader, writer = os.pipe()

    def removed(descriptor: int, size: int) -> bytes:
        raise OSError(errno.ENXIO, "No such device or address")

    monkeypatch.setattr(module.os, "read", removed)
    error = await gone(reader, lambda: os.write(writer, b"x"))
    monkeypatch.undo()
    assert error is not None
    assert error.errno == errno.ENXIO
    os.close(reader)
    os.close(writer)


async def test_what_has_arrived_is_read_before_the_port_closes(tmp_path):
    line = Line(tmp_path / "bar")
    link = ByteLink(SerialUrl(str(line.path)), list)
    await link.open()
    ring = Ring(100_000)
    link.start_reading(ring, lambda error: None)
    os.write(line.master, b"x" * 2000)
    await link.close()
    got = b""
    while pieces := ring.take(1.0):
        got += b"".join(piece.data for piece in pieces)
    assert got == b"x" * 2000
    line.pull()
