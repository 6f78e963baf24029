"""Device URLs: what is understood, what is refused and how clearly."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers.errors import BadUrl
from abbe.drivers.links.urls import PARITIES, FixtureConsoleUrl, FixtureTcpUrl, ModbusRtuUrl, ModbusTcpUrl, SerialUrl, SocketUrl, parse_url

paths = (
    st.text(st.characters(codec="utf-8", exclude_categories=["C"]), min_size=1)
    .map(lambda s: "/" + s)
    .filter(lambda s: not s.endswith("/") and not s.startswith("//"))
)
hosts = st.one_of(st.from_regex(r"[a-z]([a-z0-9-]{0,20}[a-z0-9])?(\.[a-z]{2,5})?", fullmatch=True), st.ip_addresses().map(str))
ports = st.integers(1, 65535)
units = st.integers(1, 247)
bauds = st.integers(1, 12_000_000)
numbers = st.none() | st.integers(1, 2**32 - 1)
urls = st.one_of(
    st.builds(SerialUrl, paths, bauds, st.sampled_from(PARITIES), numbers),
    st.builds(SocketUrl, hosts, ports, numbers),
    st.builds(ModbusTcpUrl, hosts, ports, units),
    st.builds(ModbusRtuUrl, paths, bauds, units),
    st.builds(FixtureTcpUrl, hosts, ports),
    st.just(FixtureConsoleUrl()),
)


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("serial:///dev/ttyUSB0?baud=115200", SerialUrl("/dev/ttyUSB0", 115200)),
        ("serial:///dev/ttyUSB0", SerialUrl("/dev/ttyUSB0", 460800)),
        ("serial:///dev/x?parity=even&serial_no=4711", SerialUrl("/dev/x", 460800, "even", 4711)),
        ("socket://10.0.0.5:4001", SocketUrl("10.0.0.5", 4001)),
        ("socket://10.0.0.5:4001?serial_no=4711", SocketUrl("10.0.0.5", 4001, 4711)),
        ("socket://[::1]:4001", SocketUrl("::1", 4001)),
        ("modbus+tcp://cnc.local:502?unit=3", ModbusTcpUrl("cnc.local", 502, 3)),
        ("modbus+tcp://cnc.local:502", ModbusTcpUrl("cnc.local", 502, 1)),
        ("modbus+rtu:///dev/ttyS0?baud=9600&unit=2", ModbusRtuUrl("/dev/ttyS0", 9600, 2)),
        ("fixture+tcp://h:9", FixtureTcpUrl("h", 9)),
        ("fixture+console:", FixtureConsoleUrl()),
    ],
)
def test_understood(text, url):
    assert parse_url(text) == url


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "unknown scheme"),
        ("/dev/ttyUSB0", "unknown scheme"),
        ("http://host:1", "unknown scheme 'http'"),
        ("socket://host", "port is missing"),
        ("socket://host:0", "port is missing"),
        ("socket://:4001", "host is missing"),
        ("socket://host:70000", "port is not a number"),
        ("socket://host:abc", "port is not a number"),
        ("socket://host:1?baud=1", "unknown key 'baud'"),
        ("socket://host:1/dev", "a path"),
        ("socket://[::1:4001", ""),
        ("socket://u:p@host:1", "user names"),
        ("serial://ttyUSB0", "three slashes"),
        ("serial:", "device path"),
        ("serial:///", "device path"),
        ("serial:///dev/x?baud=fast", "baud='fast'"),
        ("serial:///dev/x?baud=0", "baud='0'"),
        ("serial:///dev/x?baud=-1", "baud"),
        ("serial:///dev/x?baud=99999999999", "baud"),
        ("serial:///dev/x?baud=1&baud=2", "twice"),
        ("serial:///dev/x?baud", "key=value"),
        ("serial:///dev/x?parity=mark", "parity='mark' is none of none, even, odd"),
        ("serial:///dev/x?serial_no=0", "serial_no='0'"),
        ("socket://h:1?serial_no=4294967296", "serial_no"),
        ("serial:///dev/x?speed=1", "unknown key 'speed'"),
        ("serial:///dev/x\n", "control characters"),
        ("modbus+tcp://h:502?unit=248", "unit='248'"),
        ("modbus+tcp://h:502?unit=0", "unit='0'"),
        ("modbus+tcp://h:502#x", "fragment"),
        ("fixture+console:now", "no address"),
    ],
)
def test_refused_with_one_clear_line(text, why):
    with pytest.raises(BadUrl) as caught:
        parse_url(text)
    message = str(caught.value)
    assert why in message
    assert "\n" not in message
    assert caught.value.remedy


@given(urls)
def test_round_trip(url):
    assert parse_url(str(url)) == url


@given(st.one_of(st.text(), st.text().map(lambda s: "modbus+tcp://" + s), st.text().map(lambda s: "serial:///dev?" + s)))
def test_any_text_is_understood_or_refused(text):
    try:
        url = parse_url(text)
    except BadUrl as error:
        message = str(error)
    else:
        message = ""
        assert parse_url(str(url)) == url
    assert "\n" not in message
