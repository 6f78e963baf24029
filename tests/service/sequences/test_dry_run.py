"""`abbe measure` without a machine: figures, picture, NC program; what does not go together is one clear line."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios

import pytest
from typer.testing import CliRunner

from abbe.service.cli.app import app
from tests.patience import within

MACHINE_TOML = 'name = "m"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\nX = [0.0, 600.0]\nY = [0.0, 500.0]\nZ = [0.0, 450.0]\n'
DEVICES = """[devices]
cnc = "modbus+tcp://127.0.0.1:9"
ballbar = "socket://127.0.0.1:9"
laser = "modbus+tcp://127.0.0.1:9"
fixture = "fixture+tcp://127.0.0.1:9"
"""
RECIPE = """
format = "abbe-recipe/1"
name = "two <tests>"
[[test]]
kind = "circle"
label = "c&1"
setup = "cup"
centre_mm = [300.0, 250.0, 100.0]
radius_mm = 150.0
plane = "XY"
feed_mm_min = 1500.0
[[test]]
kind = "face"
label = "f1"
setup = "mirror"
plane = "ZX"
diagonal = "np"
steps = 6
cycles = 2
overrun_mm = 2.0
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "m.toml").write_text(MACHINE_TOML + DEVICES)
    (tmp_path / "r.toml").write_text(RECIPE)
    return tmp_path


def measure(folder, *words):
    return CliRunner().invoke(app, ["measure", "-m", str(folder / "m.toml"), "--recipe", str(folder / "r.toml"), *words])


def test_a_dry_run_says_duration_strokes_speed_and_readings_and_draws_three_views(folder):
    found = measure(folder, "--name", "<two>", "--dry-run", "--picture", str(folder / "p.html"))
    assert found.exit_code == 0, found.output
    page = (folder / "p.html").read_text()
    assert page.count("<svg") == 1
    for view in ("from above", "from the front", "from the side"):
        assert view in page
    assert re.search(r"2 tests in 2 set-ups, [\d.]+ min of machine time, \d+ readings", page)
    assert "Strokes used: X " in page
    assert "Largest speed 6000 mm/min" in page
    assert "&lt;two&gt;" in page  # names are text, not tags
    assert "c&amp;1" in page
    seconds = float(re.search(r"([\d.]+) min of machine time", page).group(1)) * 60.0
    assert seconds > 2 * 2 * 3.14159 * 150.0 / 1500.0 * 60.0  # two turns of the circle: feed-in, a whole one, feed-out
    assert (
        page == (measure(folder, "--name", "<two>", "--dry-run", "--picture", str(folder / "q.html")), (folder / "q.html").read_text())[1]
    )


@pytest.mark.parametrize(
    ("dialect", "word"), [("siemens", "MSG"), ("fanuc", "O0001"), ("heidenhain", "BEGIN PGM"), ("linuxcnc", "G64 P"), ("iso", "M00")]
)
def test_the_command_writes_nc_programs(folder, dialect, word):
    found = measure(folder, "--nc", dialect, "--out", str(folder / "p.nc"))
    assert found.exit_code == 0, found.output
    text = (folder / "p.nc").read_text()
    assert word in text
    assert f"{len(text.encode())} bytes, {len(text.splitlines())} blocks, about" in " ".join(found.output.split())


def test_the_machine_file_says_what_the_control_holds(folder):
    machine = folder / "m.toml"
    machine.write_text(machine.read_text() + "\n[nc]\nheidenhain_tool = 12\nmemory_kib = { heidenhain = 1.0 }\n")
    found = measure(folder, "--nc", "heidenhain", "--out", str(folder / "p.h"))
    assert found.exit_code == 0, found.output
    assert "TOOL CALL 12 Z" in (folder / "p.h").read_text()
    assert "warning: " in found.output
    assert "is assumed to hold 1 KiB" in " ".join(found.output.split())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--picture", "p.html"), "add --dry-run"),
        (("--path",), "add --dry-run"),
        (("--nc", "fanuc"), "go together"),
        (("--nc", "okuma", "--out", "p.nc"), "no NC dialect"),
        (("--nc", "iso", "--out", "p.nc", "--dry-run"), "do not go together"),
    ],
)
def test_options_that_do_not_go_together_are_one_line(folder, monkeypatch, words, says):
    monkeypatch.chdir(folder)
    found = measure(folder, *words)
    assert found.exit_code != 0
    assert says in str(found.exception) + found.output
    assert not (folder / "p.nc").exists()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('plane = "XY"', 'plane = "XX"', "test[1].plane"),
        ("radius_mm = 150.0", "radius_mm = 450.0", "beyond its stroke"),
        ("overrun_mm = 2.0", "overrun_mm = 20.0", "test[2].overrun_mm"),
        ("cycles = 2", "cycle = 2", "did you mean 'cycles'"),
        ("feed_mm_min = 1500.0", "feed_in_deg = -1.0", "test[1].feed_in_deg"),
    ],
)
def test_a_bad_recipe_is_one_line(folder, old, new, says):
    (folder / "r.toml").write_text(RECIPE.replace(old, new))
    found = measure(folder, "--dry-run")
    assert found.exit_code != 0
    assert says in str(found.exception)
    assert "\n" not in str(found.exception)


def test_what_a_recipe_needs_and_the_machine_file_lacks_is_said_below_the_figures(folder):
    machine = folder / "m.toml"
    machine.write_text(MACHINE_TOML + DEVICES.replace('laser = "modbus+tcp://127.0.0.1:9"\n', ""))
    found = measure(folder, "--dry-run")
    assert "c&1" in found.output
    assert str(found.exception) == "this needs a laser for test f1, and the machine file names none - add laser = ... under [devices]"
    written = measure(folder, "--nc", "iso", "--out", str(folder / "p.nc"))
    assert written.exit_code == 0, "a program for another day, or another computer, needs no device"


def test_an_expired_certificate_and_a_timetable_that_cannot_be_kept_are_told_before_a_measurement(folder):
    machine = folder / "m.toml"
    timetable = '[calibration]\nlaser = 2020-05-31\n[[schedule]]\nname = "w"\nevery_h = 24\nrecipe = "quick-chekc"\n'
    machine.write_text(MACHINE_TOML + DEVICES + timetable)
    found = measure(folder, "--dry-run")
    assert found.exit_code == 0, found.output
    assert "warning: the certificate of the laser ended on 2020-05-31" in found.stderr
    assert "warning: schedule 'w': there is no recipe 'quick-chekc'" in found.stderr


@pytest.mark.parametrize("columns", [None, 40, 80, 200])
def test_numbers_are_never_cut_and_names_fold(folder, columns):
    """Piped, and on terminals of some widths, from far negative coordinates: as they were cut to 118..4... at 80 columns."""
    machine = folder / "m.toml"
    machine.write_text((MACHINE_TOML + DEVICES).replace("Z = [0.0, 450.0]", "Z = [-12000.0, -11550.0]"))
    label = "a-name-that-is-longer-than-any-column-for-it"
    recipe = (folder / "r.toml").read_text().replace("250.0, 100.0]", "250.0, -11800.0]").replace('"c&1"', f'"{label}"')
    (folder / "r.toml").write_text(recipe)
    if columns is None:
        found = measure(folder, "--dry-run").stdout
        assert label in found
    else:
        found = on_a_terminal(columns, ["measure", "-m", str(machine), "--recipe", str(folder / "r.toml"), "--dry-run"])
    numbers = " ".join(re.findall(r"\S*\.\.\S*", found))
    assert numbers == "149..450 100..400 -11800..-11650 7..592 250..250 -11992..-11557"
    assert "…" not in found
    assert "..." not in found
    names = "".join(line.split()[0] for line in found.splitlines() if line.strip())
    assert label in names.replace("\x1b", ""), "what does not fit goes on in the line below"


def on_a_terminal(columns: int, words: list[str]) -> str:
    """What a person sees on a terminal of this width."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    program = "from abbe.service.cli import main; main()"
    environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES")} | {"TERM": "dumb"}
    with subprocess.Popen([sys.executable, "-c", program, *words], stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        seen = b""
        try:
            while chunk := os.read(ours, 65536):
                seen += chunk
        except OSError:  # the last one has closed it
            pass
        assert process.wait(within(60)) == 0, seen
    os.close(ours)
    return seen.decode()
