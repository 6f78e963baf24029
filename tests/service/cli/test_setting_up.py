"""`abbe init` writes a machine file from eight answers; `abbe doctor` examines machine and computer; `abbe sim` writes a machine file."""

from __future__ import annotations

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from abbe.service.audit.book import follow
from abbe.service.cli import run
from abbe.service.config import load_machine
from abbe.service.devices.session import lock_machine
from abbe.service.domain.service_records import AuditEvent
from abbe.service.storage.store import Store
from tests.certificates import issued
from tests.patience import within

pytestmark = pytest.mark.usefixtures("clean_environment")
ABBE = [sys.executable, "-c", "from abbe.service.cli import main; main()"]
ANSWERS = ("--name", "mill-7", "--chain", "w-X-Y-b-Z-t", "--strokes", "0..600,-250..250,0..450", "--tool", "0,0,-120")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_answers_become_a_machine_file_that_abbe_reads(folder: Path, capsys) -> None:
    devices = ("--cnc", "modbus+tcp://127.0.0.1:9", "--laser", "modbus+tcp://127.0.0.1:8", "--certificates", "-,2030-05-31")
    assert run(["init", *ANSWERS, *devices]) == 0
    assert capsys.readouterr().err.endswith("next: abbe doctor\n")
    machine = load_machine("abbe.toml").machine
    assert (machine.name, machine.chain, machine.tool_mm) == ("mill-7", "w-X-Y-b-Z-t", (0.0, 0.0, -120.0))
    assert machine.stroke_mm.model_dump()["Y"] == (-250.0, 250.0)
    assert (machine.devices.cnc, machine.devices.ballbar, machine.devices.fixture) == ("modbus+tcp://127.0.0.1:9", None, "fixture+console:")
    assert (machine.calibration.ballbar, str(machine.calibration.laser)) == (None, "2030-05-31")
    assert run(["init", *ANSWERS]) == 2
    assert "error CFG-001: abbe.toml exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (("--chain", "w-X-Q-b-Z-t"), "chain: expected a chain from w to t"),
        (("--strokes", "600,500,450"), "three strokes FROM..TO in mm, separated by commas, are expected"),
        (("--strokes", "600..0,0..500,0..450"), "stroke_mm"),
        (("--laser", "COM3"), "laser"),
        (("--cnc", "modbus+tcp://[::1"), "cnc"),
        (("--certificates", "soon,later"), "--certificates 'soon,later'"),
    ],
)
def test_a_wrong_answer_leaves_no_file(folder: Path, capsys, changed: tuple[str, str], told: str) -> None:
    assert run(["init", *ANSWERS, *changed]) == 2
    err = capsys.readouterr().err
    assert told in err
    assert err.count("\n") == 1
    assert not (folder / "abbe.toml").exists()


def test_without_a_terminal_nothing_is_guessed(folder: Path, capsys) -> None:
    assert run(["init", *ANSWERS[:4]]) == 2
    assert "--strokes is missing, and standard input is not a terminal - add --strokes" in capsys.readouterr().err


def test_a_person_is_asked_eight_questions(folder: Path) -> None:
    """A wrong answer is asked again; Enter takes what is offered."""
    ours, theirs = pty.openpty()
    os.write(ours, b"mill-8\n\n600\n0..700,0..500,0..450\n\n\n\n\n\n")
    done = subprocess.run([*ABBE, "init", "m.toml"], stdin=theirs, capture_output=True, text=True, timeout=within(60), check=False)
    os.close(ours)
    os.close(theirs)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("]:") == 9
    assert load_machine("m.toml").machine.stroke_mm.model_dump()["X"] == (0.0, 700.0)


@pytest.fixture
def simulated_machine(folder: Path):
    """`abbe sim --machine-file`, until the test ends."""
    process = subprocess.Popen(
        [*ABBE, "sim", "--speed", "50", "--machine-file", "abbe.toml"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    yield json.loads(process.stdout.readline())
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=within(20))[1] == "next: abbe doctor\n"
    assert process.returncode == 0


def test_the_doctor_reads_every_device_and_moves_nothing(simulated_machine, capsys) -> None:
    assert run(["doctor", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    found = {one["what"]: one for one in answer["examined"]}
    assert answer["ready"]
    assert {found[what]["state"] for what in ("machine file", "disk", "database", "lock", "cnc", "ballbar", "laser", "fixture")} == {"good"}
    assert "axes at 300.000, 250.000, 225.000 mm" in found["cnc"]["text"]
    assert simulated_machine["laser"] in found["laser"]["text"]
    assert not Path("abbe.sqlite3").exists()
    with lock_machine(simulated_machine["cnc"]):  # somebody measures: nobody else asks the devices
        assert run(["doctor"]) == 0
    said = capsys.readouterr()
    assert "its devices are left alone" in said.out
    assert "ABB-1" not in said.out
    assert said.err.splitlines()[-1] == "next: abbe measure --recipe quick-check"


def test_a_device_is_tested_and_told_for_programs(simulated_machine, capsys) -> None:
    code = run(["device", "test", simulated_machine["laser"], "--no-faults"])
    assert capsys.readouterr().err.splitlines()[-1].startswith("next: abbe ")
    assert run(["device", "test", simulated_machine["laser"], "--no-faults", "--json"]) == code
    assert json.loads(capsys.readouterr().out)["kind"] == "laser"


def test_the_doctor_says_what_to_do_about_a_device_that_is_not_there(folder: Path, capsys) -> None:
    assert run(["init", *ANSWERS, "--cnc", "modbus+tcp://127.0.0.1:9", "--ballbar", "serial:///dev/none?baud=460800"]) == 0
    capsys.readouterr()
    assert run(["doctor"]) == 1
    said = capsys.readouterr()
    rows = {line.split("\t")[0]: line.split("\t")[1:] for line in said.out.splitlines()}
    assert rows["cnc"][0] == rows["ballbar"][0] == "bad"
    assert rows["cnc"][1].startswith("DRV-002: modbus+tcp://127.0.0.1:9")
    assert "check address and port" in rows["cnc"][2]
    assert rows["laser"][0] == "look"
    assert "mill-7 is not ready" in said.err
    assert said.err.splitlines()[-1] == "next: abbe doctor"


def test_without_a_controller_the_doctor_promises_no_measurement(folder: Path, capsys) -> None:
    assert run(["init", *ANSWERS]) == 0
    capsys.readouterr()
    assert run(["doctor"]) == 0
    err = capsys.readouterr().err
    assert "mill-7 has no controller in its file, so that Abbe only listens, imports and solves" in err
    assert err.splitlines()[-1] == "next: abbe import FILE"


def test_what_this_computer_lacks_is_said(folder: Path, capsys, monkeypatch) -> None:
    """A certificate of the page that ended, a clock behind the newest record, a disk without room."""
    issued(folder, "page", None, days=(-30, -1))
    assert run(["init", *ANSWERS]) == 0
    with Path("abbe.toml").open("a") as file:
        file.write('[web]\ncertificate = "page.pem"\nkey = "page.key"\n')
    with Store.open("sqlite:///abbe.sqlite3") as store:
        store.audit.append(
            lambda last, utc: follow(
                last, "2099-01-01T00:00:00+00:00", AuditEvent(who="me", action="a", target="b", outcome="done"), b"k" * 32
            )
        )
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5 * 10**8))
    capsys.readouterr()
    assert run(["doctor", "--json"]) == 1
    bad = {one["what"]: one["text"] for one in json.loads(capsys.readouterr().out)["examined"] if one["state"] == "bad"}
    assert set(bad) >= {"certificate of the page", "clock", "disk"}
    assert "later than this computer's" in bad["clock"]
    assert bad["disk"].startswith("0.5 GB are free")
