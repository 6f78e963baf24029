"""The machine file: what it says, what the environment changes, and one line for every mistake."""

from __future__ import annotations

import hashlib
import time
from datetime import date
from pathlib import Path

import pytest

from abbe.service.config import load_machine
from abbe.service.config_schema import ROOM_K
from abbe.service.errors import ConfigError
from abbe.service.site import site_of
from abbe.service.toml_text import key_lines
from abbe.service.verification.verify import SAME_AIR_C

GOOD = """
name = "VMC-1"
chain = "w-X-Y-b-Z-t"
vertical_axis = "Z"
tool_mm = [0, 0, 120]

[stroke_mm]
X = [0, 600]
Y = [0, 500]
Z = [0, 450.5]

[pivots_mm]
X = [300, 250, -150]

[devices]
cnc = "modbus+tcp://127.0.0.1:1502"
ballbar = "socket://127.0.0.1:4001"
laser = "modbus+rtu:///dev/ttyS0?baud=115200"
fixture = "fixture+console:"

[limits]
table_change_um = 50

[mqtt]
url = "mqtt://me:topsecret@127.0.0.1:1883"

[[schedule]]
name = "nightly"
cron = "0 3 * * *"
timezone = "Europe/Berlin"
"""

pytestmark = pytest.mark.usefixtures("clean_environment")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    path.write_text(GOOD, encoding="utf-8")
    return path


def test_values_and_defaults(file: Path) -> None:
    loaded = load_machine(file)
    machine = loaded.machine
    assert (machine.name, machine.chain, machine.tool_mm) == ("VMC-1", "w-X-Y-b-Z-t", (0.0, 0.0, 120.0))
    assert (machine.stroke_mm.Z, machine.pivots_mm.X, machine.pivots_mm.Y) == ((0.0, 450.5), (300.0, 250.0, -150.0), (0.0, 0.0, 0.0))
    assert (machine.limits.table_value_um, machine.limits.table_change_um, machine.limits.table_step_um) == (100.0, 50.0, 20.0)
    assert (machine.web.host, machine.web.port, machine.store.url) == ("127.0.0.1", 8080, "sqlite:///abbe.sqlite3")
    assert [(one.name, one.timezone, one.recipe) for one in machine.schedule] == [("nightly", "Europe/Berlin", "quick-check")]
    assert loaded.database_url == f"sqlite:///{file.parent / 'abbe.sqlite3'}"


def test_a_variable_spells_its_keys_in_any_case(file: Path, clean_environment: pytest.MonkeyPatch) -> None:
    clean_environment.setenv("ABBE_STROKE_MM__X", "[0, 450]")
    clean_environment.setenv("ABBE_WEB", '{"port": 1, "host": "127.0.0.2"}')
    clean_environment.setenv("abbe_web__port", "9000")
    clean_environment.setenv("ABBE_DB", "none of the file's keys")
    machine = load_machine(file).machine
    assert (machine.stroke_mm.X, machine.web.port, machine.web.host) == ((0.0, 450.0), 9000, "127.0.0.2")


def test_origins_and_masked_secrets(file: Path, clean_environment: pytest.MonkeyPatch) -> None:
    clean_environment.setenv("ABBE_WEB__PORT", "9000")
    clean_environment.setenv("ABBE_TOOL_MM", "[0, 0, 5]")
    clean_environment.setenv("ABBE_STORE__URL", "postgresql://me:topsecret@db/abbe")
    loaded = load_machine(file)
    values = {key: (value, origin) for key, value, origin in loaded.values()}
    assert loaded.machine.web.port == 9000
    assert values["web.port"] == (9000, "environment")
    assert values["tool_mm"] == ([0.0, 0.0, 5.0], "environment")
    assert values["store.url"] == ("postgresql://me:***@db/abbe", "environment")
    assert values["mqtt.url"] == ("mqtt://me:***@127.0.0.1:1883", "file")
    assert values["web.host"] == ("127.0.0.1", "default")
    assert values["schedule[1].cron"] == ("0 3 * * *", "file")
    assert values["schedule[1].recipe"] == ("quick-check", "default")
    assert loaded.database_url == "postgresql://me:topsecret@db/abbe"


def test_machine_object_of_the_exchange_format(file: Path) -> None:
    assert load_machine(file).machine.machine_doc() == {
        "name": "VMC-1",
        "chain": "w-X-Y-b-Z-t",
        "vertical_axis": "Z",
        "stroke_mm": {"X": [0.0, 600.0], "Y": [0.0, 500.0], "Z": [0.0, 450.5]},
        "pivots_mm": {"X": [300.0, 250.0, -150.0], "Y": [0.0] * 3, "Z": [0.0] * 3},
        "tool_mm": [0.0, 0.0, 120.0],
    }


ROOM = "[calibration]\nroom = 2027-05-31\nroom_temperature_c = "
LASER = 'laser = "modbus+rtu:///dev/ttyS0?baud=115200"\nfixture = "fixture+console:"\n'


def test_the_air_of_a_shop_without_a_laser_is_stated_within_1_k(file: Path) -> None:
    file.write_text(GOOD.replace(LASER, f"{ROOM}[15.1, 16.1]\n").replace("[limits]", "[limits]\ntemperature_c = [15, 25]"))
    site = site_of(load_machine(file).machine)
    assert ROOM_K == SAME_AIR_C, "what may be stated is what a verification accepts"
    assert (site.room_c, site.calibrated_until) == ((15.1, 16.1), {"room": date(2027, 5, 31)})


BAD = [
    ('name = "VMC-1"', "", "key 'name' is missing"),
    ('name = "VMC-1"', "name = 5", "name: expected a string, got 5"),
    ('chain = "w-X-Y-b-Z-t"', 'chain = "w-X-X-b-Z-t"', "chain: expected a chain from w to t with X, Y, Z and b once each"),
    ('chain = "w-X-Y-b-Z-t"', 'chain = "t-X-Y-b-Z-w"', "chain: expected a chain"),
    ('vertical_axis = "Z"', 'vertical_axis = "A"', "vertical_axis: "),
    ('vertical_axis = "Z"', 'verticalaxis = "Z"', "unknown key 'verticalaxis' - did you mean 'vertical_axis'?"),
    ("X = [0, 600]", "X = [600, 0]", r"stroke_mm.X: expected \[smaller, larger\], got \[600.0, 0.0\]"),
    ("X = [0, 600]", "X = [0]", "stroke_mm.X"),
    ("X = [0, 600]", "", "key 'stroke_mm.X' is missing"),
    ("X = [0, 600]\nY = [0, 500]", "", "keys 'stroke_mm.X', 'stroke_mm.Y' are missing"),
    ("X = [0, 600]", "X = [0, inf]", r"stroke_mm.X\[2\]: expected a finite number"),
    ("table_change_um = 50", "table_chang_um = 50", "unknown key 'limits.table_chang_um' - did you mean 'table_change_um'?"),
    ("table_change_um = 50", "table_change_um = -1", "limits.table_change_um: expected .*greater than 0, got -1"),
    ("table_change_um = 50", 'table_change_um = "much"', "limits.table_change_um: expected a number, got 'much'"),
    ("table_change_um = 50", 'table_change_um = "50"', "limits.table_change_um: expected a number, got '50'"),
    ("table_change_um = 50", "temperature_c = [24, 18]", "limits.temperature_c: expected"),
    ("table_change_um = 50", "qqq = 1", "unknown key 'limits.qqq' - valid keys here: continue_after, feed_mm_min, measurement_a"),
    ("[limits]", "[limit]", "unknown key 'limit' - did you mean 'limits'?"),
    ('name = "VMC-1"', 'name = "VMC-1"\nweb = 3', "web: expected a table of keys, got 3"),
    ("modbus+tcp://127.0.0.1:1502", "modbus+tcp://127.0.0.1", "devices: cnc = .*the port is missing"),
    ("modbus+tcp://127.0.0.1:1502", "http://127.0.0.1:1502", "devices: cnc = .*unknown scheme 'http'"),
    ("modbus+tcp://127.0.0.1:1502", "socket://127.0.0.1:1502", "devices: cnc = .*expected modbus"),
    ("me:topsecret@127.0.0.1:1883", "me:topsecret@127.0.0.1:bad", "mqtt.url"),
    ('cron = "0 3 * * *"', 'cron = "0 3 * *"', r"schedule\[1\].cron: expected a cron expression"),
    ('cron = "0 3 * * *"', "", r"schedule\[1\]: expected either cron = ... or every_h = ..., got neither"),
    (
        "Europe/Berlin",
        "Europe/Atlantis",
        r"schedule\[1\].timezone: expected an IANA time zone .*, got 'Europe/Atlantis'",
    ),
    ('cron = "0 3 * * *"', 'cron = "0 3 * * *"\ncorn = 1', r"unknown key 'schedule\[1\].corn' - did you mean 'cron'?"),
    ('cron = "0 3 * * *"', 'cron = "0 3 * * *"\nevery_h = 6', "expected either cron = ... or every_h = ..., got both"),
    (
        'cron = "0 3 * * *"',
        'cron = "0 3 * * *"\nevery_h = 0',
        r"schedule\[1\]: expected either cron, or every_h, first, got cron, every_h",
    ),
    ('cron = "0 3 * * *"', 'cron = "0 3 * * *"\nfirst = 2026-01-01T00:00:00Z', r"schedule\[1\]: expected either cron, .*, got cron, first"),
    (
        'cron = "0 3 * * *"',
        'cron = ""\nevery_h = 6',
        r"schedule\[1\]: expected either cron, .*, got cron, every_h - remove every_h or cron",
    ),
    (
        "[[schedule]]",
        '[[staffed]]\nname="m"\ndays=["fri"]\nstart=22:00:00\nend=06:00:00\nhours=0\n[[schedule]]',
        r"staffed\[1\]: expected either cron and hours, or days, start, end, got hours, days, start, end",
    ),
    (
        "[[schedule]]",
        '[[maintenance]]\nname="m"\ncron="0 3 * * *"\nhours=2\ndays=[]\n[[schedule]]',
        r"maintenance\[1\]: expected either cron and hours, .*, got cron, hours, days",
    ),
    ('cron = "0 3 * * *"', 'cron = "0 3 * * *"\ncatch_up = "all"', r"schedule\[1\].catch_up: expected 'skip' or 'once'"),
    ('cron = "0 3 * * *"', 'cron = "0 3 * * *"\nneeds = { warm = 3 }', r"unknown key 'schedule\[1\].needs.warm'"),
    ('cron = "0 3 * * *"', 'cron = "0 3 * * *"\nneeds = { operator = "present" }', "'nightly' needs an operator, expected .*staffed"),
    (
        "[[schedule]]",
        '[[maintenance]]\nname="m"\ncron="0 3 * * *"\n[[schedule]]',
        r"maintenance\[1\]: expected either cron and hours, or days",
    ),
    ("[[schedule]]", '[[staffed]]\nname="m"\ndays=["fri"]\nstart=25\nend=06:00:00\n[[schedule]]', r"staffed\[1\].start: expected"),
    ("[[schedule]]", '[[schedule]]\nname="nightly"\ncron="0 3 * * *"\n[[schedule]]', "two schedules are named 'nightly'"),
    ('name = "VMC-1"', "name = ", "not valid TOML: .*line 2"),
    ("[limits]", "[calibration]\nroom_temperature_c = [20, 21]\n[limits]", "room and room_temperature_c belong together, expected both"),
    ("[limits]", f"{ROOM}[20, 21.2]\n[limits]", "room_temperature_c is 20 to 21.2, expected at most 1 K"),
    (
        "[limits]",
        f"{ROOM}[20, 21]\n[limits]",
        "room_temperature_c is stated beside a laser, whose sensor reads the air: expected only one of them",
    ),
    (LASER, f"{ROOM}[16.5, 17.5]\n", r"room_temperature_c is outside of \[limits\] temperature_c, expected inside 18 to 24"),
]


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[message[:40] for _, _, message in BAD])
def test_mistake_is_one_line(file: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    file.write_text(GOOD.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        load_machine(file)
    assert "machine.toml" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "topsecret" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("ABBE_WEB__PORT", "eighty", "environment: web.port: expected an integer, got 'eighty'"),
        ("ABBE_WEB__PROT", "80", "environment: unknown key 'web.prot' - did you mean 'port'?"),
        ("ABBE_WEB__PORT", "70000", "environment: web.port: expected .*65535, got 70000"),
        ("ABBE_TOOL_MM", "[1,", "environment: .*tool_mm"),
        ("ABBE_STORE__URL", "oracle://me:topsecret@h/x", "environment: store.url: database 'oracle' is not supported"),
    ],
)
def test_mistake_in_the_environment_is_one_line(
    file: Path, clean_environment: pytest.MonkeyPatch, name: str, value: str, message: str
) -> None:
    clean_environment.setenv(name, value)
    with pytest.raises(ConfigError, match=message) as caught:
        load_machine(file)
    assert "\n" not in str(caught.value)
    assert "topsecret" not in str(caught.value)


def test_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none.toml does not exist"):
        load_machine(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_machine(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'name = "M\xfcller"')
    with pytest.raises(ConfigError, match="is not UTF-8"):
        load_machine(tmp_path / "latin.toml")


@pytest.mark.parametrize(("text", "says"), [("a = " + "[" * 5000, "nested too deeply"), ("a = " + "1" * 6000, "thousands of digits")])
def test_toml_that_no_parser_takes_is_one_line(tmp_path, text, says):
    path = tmp_path / "machine.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        load_machine(path)


def test_every_key_has_the_line_on_which_it_begins() -> None:
    text = 'a = 1\n\n[b]\nlong = [\n  1,\n  2,\n]\nsaid = """\nc = 5\n"""\ninline = {x = 1, y = 2}\n[[d]]\ne = 1\n# e = 2\n[[d]]\ne = 3\n'
    lines = {"a": 1, "b.long": 4, "b.said": 8, "b.inline.x": 11, "b.inline.y": 11, "d[1].e": 13, "d[2].e": 16}
    assert key_lines(text) == lines


def test_dotted_and_quoted_keys_lists_of_tables_and_long_texts_have_their_lines() -> None:
    text = """a.b = 1 # [
"c d" . 'e' = "# [ \\" {"
[[f]]
g = [ # ]
  "]", ']',
  { h = 1 },
]
  [f.i]
  j = '''
k = [''''
[[f.l]]
m = 1
[[f.l]]
m = \"\"\"
\\\"\"\" [
\"\"\"
[[f]]
[f.i]
j = 2
[[f.l]]
m.n = 3
o = [{p = 1}, {p = 2}]
"""
    lines = {"a.b": 1, "c d.e": 2, "f[1].g": 4, "f[1].i.j": 9, "f[1].l[1].m": 12, "f[1].l[2].m": 14, "f[2].i.j": 19}
    lines |= {"f[2].l[1].m.n": 21, "f[2].l[1].o[1].p": 22, "f[2].l[1].o[2].p": 22}
    assert key_lines(text) == lines


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_the_lines_of_a_long_file_are_found_at_once(file: Path, end: str) -> None:
    """3000 lines; the digest is that of the bytes that were read, also when the file is written meanwhile."""
    head = file.read_text()
    entry = '[[schedule]]\nname = "s"\nrecipe = "quick-check"\ncron = "0 6 * * 1-5"\ntimezone = "Europe/Berlin"\n'
    body = (head + entry.replace('"s"', '"s1"') + "# more\n" * 3000 + entry.replace('"s"', '"s2"')).replace("\n", end).encode()
    file.write_bytes(body)
    loaded = load_machine(file)
    file.write_text(head)
    begun = time.process_time()
    made = loaded.summary()
    assert time.process_time() - begun < 2.0
    assert made.sha256 == hashlib.sha256(body).hexdigest()
    found = {one.key: one.line for one in made.values}
    first = head.count("\n") + 2
    assert (found["schedule[2].name"], found["schedule[3].cron"]) == (first, first + 3007)
