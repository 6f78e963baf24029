"""The command line: answers at once, one line for every mistake, exit codes that scripts can rely on."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from abbe.drivers.errors import LinkDown, ReplyTimeout
from abbe.service import cli
from abbe.service.storage import wal_is_safe
from abbe.service.storage.store import Store
from tests.patience import within

pytestmark = pytest.mark.usefixtures("clean_environment")

MACHINE_FILE = """
name = "VMC-1"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0, 600]
Y = [0, 500]
Z = [0, 450]
[mqtt]
url = "mqtt://me:topsecret@127.0.0.1:1883"
"""


class Result:
    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


class Abbe:
    """Runs the command inside this process, in a folder of its own."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: object) -> Result:
        with pytest.raises(SystemExit) as ended:
            cli.main([str(one) for one in arguments])
        out, err = self._capsys.readouterr()
        return Result(int(ended.value.code or 0), out, err)

    def fails(self, *arguments: object) -> str:
        """The one line of a bad input."""
        result = self(*arguments)
        assert (result.code, result.out) == (2, "")
        assert result.err.startswith("error ")
        assert result.err.count("\n") == 1
        assert "topsecret" not in result.err
        return result.err


@pytest.fixture
def abbe(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Abbe:
    monkeypatch.chdir(tmp_path)
    return Abbe(capsys)


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    path.write_text(MACHINE_FILE, encoding="utf-8")
    return path


def test_help_imports_nothing_heavy() -> None:
    program = "import sys\nfrom abbe.service.cli import run\nrun(['--help'])\nprint(sorted({m.partition('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "check-config" in done.stdout
    modules = done.stdout.splitlines()[-1]
    assert not [name for name in ("numpy", "scipy", "sqlalchemy", "pydantic", "fastapi", "alembic", "rich") if f"'{name}'" in modules]


def test_check_config(abbe: Abbe, machine: Path) -> None:
    result = abbe("check-config", "-m", machine)
    assert result.code == 0
    lines = [line.split() for line in result.out.splitlines()]
    assert ["chain", '"w-X-Y-b-Z-t"', "file"] in lines
    assert ["web.port", "8080", "default"] in lines
    assert "topsecret" not in result.out
    assert "me:***@127.0.0.1" in result.out


def test_check_config_json(abbe: Abbe, machine: Path, clean_environment: pytest.MonkeyPatch) -> None:
    clean_environment.setenv("ABBE_WEB__PORT", "9000")
    found = json.loads(abbe("check-config", "-m", machine, "--json").out)
    assert found["values"]["web.port"] == {"value": 9000, "origin": "environment"}
    assert found["values"]["mqtt.url"]["value"] == "mqtt://me:***@127.0.0.1:1883"
    assert found["database"] == f"sqlite:///{machine.parent / 'abbe.sqlite3'}"


def test_check_config_mistakes(abbe: Abbe, machine: Path) -> None:
    assert abbe.fails("check-config", "-m", "none.toml").startswith("error CFG-001: machine file none.toml does not exist")
    machine.write_text(MACHINE_FILE.replace("chain", "chian"), encoding="utf-8")
    assert "did you mean 'chain'?" in abbe.fails("check-config", "-m", machine)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["chek-config"], "error USE-001: No such command 'chek-config'. Did you mean 'check-config'?"),
        (["check-config"], "error CFG-001: no machine is named - give -m FILE"),
        (["comp", "push", "missing.json"], "error USE-001: Invalid value for 'PROPOSAL': expected an integer, got 'missing.json' - "),
        (["audit", "show", "--last", "0"], "error USE-001: Invalid value for '--last': expected greater than or equal to 1, got '0' - "),
        (["trend", "machine.toml"], "(machine.toml) - name the machine file by -m FILE"),
        (["runs", "--dp", "x"], "error USE-001: No such option: --dp"),
        (["runs"], "error STO-001: there is no database abbe.sqlite3 - give -m FILE or --db URL"),
        (["runs", "--db", "nonsense"], "error STO-001: database URL 'nonsense' cannot be understood"),
        (["runs", "--db", "sqlite://", "--machine", "m.toml"], "error CFG-001: --db and -m both name a database"),
        (["runs", "--machine", "m.toml"], "error CFG-001: machine file m.toml does not exist"),
        (["runs", "--db", "postgresql://me:topsecret@127.0.0.1:1/x"], "me:***@127.0.0.1:1/x"),
        (["show", "r01", "--db", "sqlite://"], "error STO-002: no run 'r01' in sqlite://"),
        (["export", "c1", "out", "--db", "sqlite://"], "error STO-002: no campaign 'c1' in sqlite://"),
        (["import", "nowhere", "--db", "sqlite://"], "error FMT-001: nowhere: no such file"),
    ],
)
def test_bad_input_is_one_line(abbe: Abbe, arguments: list[str], message: str) -> None:
    assert message in abbe.fails(*arguments)


def test_without_a_certificate_nothing_is_measured_for_a_table(abbe: Abbe, machine: Path) -> None:
    said = abbe.fails("correct", "-m", machine, "june")
    assert "certificate" in said
    assert "[calibration]" in said


def test_no_command_prints_the_help(abbe: Abbe) -> None:
    result = abbe()
    assert result.code == 2
    assert "check-config" in result.err + result.out


def test_a_name_of_a_campaign_and_of_a_run_is_the_campaign(abbe: Abbe, campaign_folder: Path) -> None:
    for file in campaign_folder.glob("*.json"):
        file.write_text(file.read_text().replace('"c1"', '"r01"'))
    abbe("import", campaign_folder)
    assert json.loads(abbe("show", "r01", "--json").out)["name"] == "r01"
    assert json.loads(abbe("show", "r01/r01", "--json").out)["run_id"] == "r01"


def test_import_list_show_export(abbe: Abbe, campaign_folder: Path, tmp_path: Path) -> None:
    assert abbe("import", campaign_folder).out == "imported campaign 'c1' with 3 runs into sqlite:///abbe.sqlite3\n"
    assert "is in the database already" in abbe.fails("import", campaign_folder)
    listed = json.loads(abbe("runs", "--json").out)
    assert [(run["campaign"], run["run_id"], run["status"]) for run in listed] == [("c1", f"r0{n}", "complete") for n in (1, 2, 3)]
    assert "r02" in abbe("runs", "--campaign", "c1").out
    shown = abbe("show", "r02").out
    assert "setup.radius_mm" in shown
    assert "sealed" in shown
    assert json.loads(abbe("show", "c1/r01", "--json").out) == json.loads((campaign_folder / "r01-x.json").read_text())
    assert json.loads(abbe("show", "c1", "--json").out)["name"] == "c1"
    assert abbe("export", "c1", tmp_path / "out").out.startswith("exported campaign 'c1' with 3 runs")
    assert "nothing was written" in abbe.fails("export", "c1", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "campaign.json").read_text()) == json.loads((campaign_folder / "campaign.json").read_text())


def test_import_of_a_bad_folder_makes_no_database(abbe: Abbe, campaign_folder: Path, tmp_path: Path) -> None:
    (campaign_folder / "r03-x.json").write_text("{}")
    assert "r03-x.json" in abbe.fails("import", campaign_folder)
    assert not (tmp_path / "abbe.sqlite3").exists()


def test_database_of_environment_and_machine_file(
    abbe: Abbe, campaign_folder: Path, machine: Path, clean_environment: pytest.MonkeyPatch
) -> None:
    url = f"sqlite:///{machine.parent / 'abbe.sqlite3'}"
    abbe("import", campaign_folder, "--machine", machine)
    clean_environment.setenv("ABBE_DB", url)
    assert len(json.loads(abbe("runs", "--json").out)) == 3
    assert "no database" in abbe.fails("runs", "--db", "sqlite:///other.sqlite3")


def test_incomplete_run_is_listed_as_such(abbe: Abbe) -> None:
    program = (
        "from abbe.service.storage.store import Store\n"
        "s = Store.open()\n"
        "s.runs.start(s.campaigns.add(s.machines.add('m', {}), 'c1', {}), 'r01', 'ballbar_helix', 'identify', {})\n"
        "import os; os._exit(9)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 9
    assert json.loads(abbe("runs", "--json").out)[0]["status"] == "incomplete"
    with Store.open() as store:
        assert store.runs.find("r01").status == "running"


def test_schema_writes_where_it_is_told(abbe: Abbe, tmp_path: Path) -> None:
    assert abbe("schema", tmp_path / "new").code == 0
    assert (tmp_path / "new" / "run.schema.json").exists()
    (tmp_path / "file").write_text("x")
    assert "is a file - give the name of a folder" in abbe.fails("schema", tmp_path / "file")


def test_version(abbe: Abbe) -> None:
    out = abbe("version").out
    assert abbe("--version").out == out
    assert out.startswith("abbe 0.")
    assert ("WAL-reset bug" in out) is not wal_is_safe()


def test_driver_error_is_one_line(abbe: Abbe, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: str | None, __: Path | None = None) -> str:
        raise LinkDown("mqtt://me:topsecret@h", "open", "refused\nby peer", "plug it in")

    monkeypatch.setattr("abbe.service.cli.results.show.database_url", broken)
    assert abbe.fails("runs") == "error DRV-002: mqtt://me:***@h: open: refused by peer (plug it in)\n"


def test_a_device_that_does_not_answer_is_one_line_too(abbe: Abbe, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is a TimeoutError, and so an OSError: not one of the output that cannot be written."""

    def silent(_: str | None, __: Path | None = None) -> str:
        raise ReplyTimeout("serial:///dev/ttyUSB0", "read samples", "no sample for 1 s", "box switched off?")

    monkeypatch.setattr("abbe.service.cli.results.show.database_url", silent)
    assert abbe.fails("runs") == "error DRV-003: serial:///dev/ttyUSB0: read samples: no sample for 1 s (box switched off?)\n"


def test_interrupt_exits_with_130(abbe: Abbe, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: str | None, __: Path | None = None) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("abbe.service.cli.results.show.database_url", interrupted)
    assert abbe("runs").code == 130


CHILD = """
import signal, sys
signal.signal(signal.SIGINT, lambda *_: sys.exit(5))
signal.signal(signal.SIGTERM, lambda *_: sys.exit(6))
print(sys.argv[1:], flush=True)
signal.pause()
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 5), (signal.SIGTERM, 6)])
def test_sim_forwards_arguments_and_signals(tmp_path: Path, number: signal.Signals, code: int) -> None:
    child = tmp_path / "child.py"
    child.write_text(CHILD)
    instead = (
        "from abbe.service.cli import main; from abbe.service.cli.administration import system; "
        f"system.python_command = lambda _, *words: [{sys.executable!r}, {str(child)!r}, *words]"
    )
    command = [sys.executable, "-c", f"{instead}; main()", "sim", "a.toml", "--help", "--speed=3"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "['a.toml', '--help', '--speed=3', '--watch-stdin']\n"
    process.send_signal(number)
    assert process.wait(timeout=within(20)) == code
    process.stdout.close()


def test_what_an_error_was_told_on_its_way_is_printed_with_it(monkeypatch, capsys):
    """Notes carry what safety rests on: a bar that still hangs in, a table that may be in force."""
    from abbe.service import cli
    from abbe.service.errors import DoorOpen

    def fails(**_: object) -> None:
        error = DoorOpen("the door is open", "close it")
        error.add_note("cup and bar may still be mounted: take them out before anything moves")
        raise error

    monkeypatch.setattr(cli, "named_by", lambda app, words: fails)
    assert cli.run(["check-config", "-m", "x"]) == 2
    assert capsys.readouterr().err == (
        "error ILK-003: the door is open - close it; cup and bar may still be mounted: take them out before anything moves\n"
    )


@pytest.mark.parametrize(
    "helix",
    [
        *("300,250,nan,100", "inf,250,100,100", "300,250,100,1e999", "300,250,100", "a,b,c,d"),
        *("300,250,100,-5", "300,250,100,0", "300,250,100,1e-300", "300,250,1e308,100"),
    ],
)
def test_a_helix_that_is_none_is_one_line(abbe: Abbe, machine: Path, helix: str) -> None:
    said = abbe.fails("measure", "-m", machine, "--helix", helix, "--dry-run")
    assert said.startswith("error CFG-001: ")


COMMANDS = ("effects backlash", "effects", "--help", "comp formats", "check-config -m machine.toml", "import µ→")


def judge_letters(words: str, place: str, out: bytes, err: bytes, code: int | None) -> None:
    assert code == (2 if words.startswith("import") else 0), err
    assert b"Traceback" not in err
    if place != "latin-1":
        assert (out + err).isascii()
    if words == "effects backlash":
        assert ("µm".encode("latin-1") if place == "latin-1" else b"30.0 um") in out


def test_a_place_that_has_no_letters_gets_plain_ones(machine: Path) -> None:
    """A whole process; the streams themselves: `test_every_command_writes_plain_letters_where_there_are_no_others`."""
    words = COMMANDS[0]
    command = [sys.executable, "-m", "abbe.service.cli", *words.split()]
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("LC_", "LANG"))}
    environment |= {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(command, cwd=machine.parent, env=environment, capture_output=True, check=False, timeout=60)
    judge_letters(words, "POSIX", done.stdout, done.stderr, done.returncode)


@pytest.mark.parametrize(("words", "place"), [(COMMANDS[0], "latin-1"), *((words, "ascii") for words in COMMANDS)])
def test_every_command_writes_plain_letters_where_there_are_no_others(
    machine: Path, monkeypatch: pytest.MonkeyPatch, words: str, place: str
) -> None:
    """In this process, on streams as a place without letters has them."""
    monkeypatch.chdir(machine.parent)
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding=place, errors=how) for how in ("strict", "backslashreplace"))
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "stderr", err)
        with pytest.raises(SystemExit) as ended:
            cli.main(words.split())
        out.flush()
        err.flush()
    written = [stream.buffer.getvalue() for stream in (out, err) if isinstance(stream.buffer, io.BytesIO)]
    judge_letters(words, place, *written, int(ended.value.code or 0))
