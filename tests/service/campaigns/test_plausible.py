"""What `abbe check-config` never calls good: inches, Fahrenheit, certificates that have ended, a timetable that cannot be kept.

Seen as "is good" at revision 0da5f34: each file of `IMPOSSIBLE`, `CANNOT_BE_KEPT` and the ended certificate.
"""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path

import pytest

from abbe.service import cli
from abbe.service.campaigns.plausibility import Plausibility, check_plausibility
from abbe.service.cli.administration.serve import setup_of
from abbe.service.config import load_machine
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.recipe import Helix
from abbe.service.sequences.recipes.recipe_file import recipe_text

pytestmark = pytest.mark.usefixtures("clean_environment")

TODAY = date(2026, 11, 23)
GOOD = """
name = "VMC-1"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0, 600]
Y = [0, 500]
Z = [0, 450]
[devices]
cnc = "modbus+tcp://127.0.0.1:9"
ballbar = "socket://127.0.0.1:9"
laser = "modbus+tcp://127.0.0.1:9"
fixture = "fixture+tcp://127.0.0.1:9"
[calibration]
ballbar = 2027-05-31
laser = 2027-05-31
[limits]
temperature_c = [18, 24]
[[schedule]]
name = "weekly"
cron = "0 6 * * 1"
recipe = "quick-check"
"""
IMPOSSIBLE = [
    ("X = [0, 600]", "X = [0, 1e9]", "stroke_mm.X = [0, 1e+09]: expected mm, no axis is longer than 50000 mm"),
    ("X = [0, 600]", "X = [-60000, -59400]", "no axis is longer than 50000 mm"),
    ("X = [0, 600]", "X = [0, 23.6]", "stroke_mm.X = [0, 23.6]: expected mm, 23.6 looks like inches; if it really is shorter than 50 mm"),
    ("temperature_c = [18, 24]", "temperature_c = [68, 72]", "degrees C from -20 to 50, got [68, 72]; is this Fahrenheit?"),
    ("temperature_c = [18, 24]", "run_temperature_c = [60, 80]", "limits.run_temperature_c: expected degrees C"),
    ("laser = 2027-05-31", "laser = 2927-05-31", "calibration.laser: expected the last day of a certificate"),
]
CANNOT_BE_KEPT = [
    ("quick-check", "quick-chekc", "schedule 'weekly': there is no recipe 'quick-chekc' - did you mean 'quick-check'?"),
    ("quick-check", "quick-check at 300 Hz", "there is no recipe 'quick-check at 300 Hz'"),
    ("temperature_c = [18, 24]", "feed_mm_min = 1000", "schedule 'weekly': test check-helix would move at 6000 mm/min"),
    ('laser = "modbus+tcp://127.0.0.1:9"', "", "schedule 'weekly': this needs a laser for test check-ppp, and the machine file names none"),
    ('cnc = "modbus+tcp://127.0.0.1:9"', "", "schedule 'weekly': this needs a controller for all motion"),
    ("fixture+tcp://127.0.0.1:9", "fixture+console:", "schedule 'weekly': the fixture is the console, which is unattended"),
    ("[[schedule]]", '[alarm]\ncampaign = "none.toml"\n[[schedule]]\non_alarm = "propose"', "none.toml does not exist"),
    ("[[schedule]]", '[alarm]\ncampaign = "bad.toml"\n[[schedule]]\non_alarm = "propose"', "bad.toml"),
    ("[[schedule]]", '[alarm]\ncampaign = "far.toml"\n[[schedule]]\non_alarm = "propose"', "schedule 'weekly': test far: X would go to"),
]
RARE = [
    ("ballbar = 2027-05-31", "ballbar = 2020-05-31", "the certificate of the ball-bar ended on 2020-05-31"),
    ("laser = 2027-05-31", "laser = 2027-05-31\nartefact = 2020-05-31", "the certificate of the artefact ended on 2020-05-31"),
    ("laser = 2027-05-31", "laser = 2072-05-31", "the certificate of the laser ends in 2072: is the year right?"),
    ("laser = 2027-05-31", "", "the laser has no certificate"),
    ("temperature_c = [18, 24]", "temperature_c = [0, 24]", "limits.temperature_c is 0 to 24 degrees C: is that intended?"),
    ("X = [0, 600]", "X = [0, 25000]", "stroke_mm.X is 25000 mm long: is that intended?"),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Recipe files beside the machine file: one that is none, one that leaves the strokes."""
    (tmp_path / "bad.toml").write_text("format = 3\n")
    (tmp_path / "far.toml").write_text(recipe_text("far", (Helix("far", "B1", "identify", (500.0, 250.0, 100.0), 200.0),)))
    return tmp_path


def written(folder: Path, old: str, new: str) -> Path:
    assert old in GOOD
    path = folder / "machine.toml"
    path.write_text(GOOD.replace(old, new, 1))
    return path


def looked_at(path: Path) -> Plausibility:
    return check_plausibility(load_machine(path).machine, path.parent, TODAY)


def checked(path: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        cli.main(["check-config", "-m", str(path), *more])
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def test_a_plausible_file_is_good(folder: Path) -> None:
    assert looked_at(written(folder, "600", "600")).good


@pytest.mark.parametrize(("old", "new", "says"), IMPOSSIBLE, ids=[new for _, new, _ in IMPOSSIBLE])
def test_what_no_machine_can_be_is_refused_wherever_the_file_is_read(folder: Path, old: str, new: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_machine(written(folder, old, new))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("old", "new", "says"), CANNOT_BE_KEPT, ids=[says for _, _, says in CANNOT_BE_KEPT])
def test_a_timetable_that_cannot_be_kept_is_an_error_and_serves_nothing(
    folder: Path, old: str, new: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(folder, old, new)
    code, out, err = checked(path, capsys)
    assert (code, says in err, "good" in out) == (2, True, False), err
    with pytest.raises(ConfigError) as caught:
        setup_of(load_machine(path))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("old", "new", "says"), RARE, ids=[says for _, _, says in RARE])
def test_what_is_possible_and_rarely_meant_is_told_and_not_called_good(
    folder: Path, old: str, new: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(folder, old, new)
    (told,) = looked_at(path).warnings
    assert says in told
    code, out, err = checked(path, capsys)
    assert (code, f"warning: {says}" in err, "good" in out) == (0, True, False)


def test_small_machines_are_asked_about_and_micro_machines_say_so(folder: Path) -> None:
    inches = GOOD.replace("600]", "59]").replace("500]", "118]").replace("450]", "118]").partition("[[schedule]]")[0]
    path = folder / "machine.toml"
    path.write_text(inches)
    assert any("are the strokes inches?" in line for line in looked_at(path).warnings)
    path.write_text(inches.replace("59]", "30]").replace("[stroke_mm]", "short_strokes = true\n[stroke_mm]"))
    assert looked_at(path).good


def test_the_answer_for_programs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = checked(written(folder, "quick-check", "quick-chekc"), capsys, "--json")
    found = json.loads(out)
    assert (code, found["good"], len(found["errors"])) == (2, False, 1)
    assert found["values"]["schedule[1].recipe"]["value"] == "quick-chekc"
