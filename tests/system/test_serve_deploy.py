"""What lies in deploy/ is what it says: the example loads, the unit is valid and locked down, the broker starts, images are pinned."""

from __future__ import annotations

import re
import subprocess
import tomllib
from contextlib import closing
from pathlib import Path

import pytest
import yaml

from abbe.service.cli.administration.serve import setup_of
from abbe.service.config import load_machine
from tests.system.serve_bench import Process, free_port, require

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit with a program that exists here: systemd-analyze insists on one."""
    copy = tmp_path / "abbe.service"
    copy.write_text(re.sub(r"(?m)^ExecStart=\S+", "ExecStart=/bin/true", (DEPLOY / "abbe.service").read_text()))
    return copy


def test_the_example_is_a_complete_machine_file() -> None:
    setup = setup_of(load_machine(DEPLOY / "machine.example.toml"))
    assert [schedule.name for schedule in setup.schedules] == ["weekly"]
    assert set(setup.devices) == {"ballbar", "laser", "cnc", "fixture"}
    assert setup.broker is not None
    assert setup.web.host == "127.0.0.1"


def test_the_unit_is_valid(unit: Path) -> None:
    done = subprocess.run([require("systemd-analyze"), "verify", unit], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_unit_is_locked_down(unit: Path) -> None:
    command = [require("systemd-analyze"), "security", "--offline=true", "--threshold=25", "--no-pager", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-300:]


def test_the_service_may_write_nothing_beside_the_passwords() -> None:
    """Page and core are one account: what the unit lets it write, an intruder in the page can write. PID 1 reads `secrets.env` as root."""
    unit, folders = ((DEPLOY / name).read_text() for name in ("abbe.service", "abbe-tmpfiles.conf"))
    assert re.findall(r"(?m)^ReadWritePaths=(.*)$", unit) == ["/run/abbe"]
    assert [line for line in folders.splitlines() if line and not line.startswith(("#", "d /run/"))] == []
    (allowed,) = re.findall(r"(?m)^# ReadWritePaths=(.*)$", unit)
    assert re.findall(r"(?m)^# d (\S+) ", folders) == [allowed]
    (secrets,) = re.findall(r"(?m)^EnvironmentFile=-(.*)$", unit)
    assert not Path(secrets).is_relative_to(allowed)


def test_the_page_s_memory_leaves_the_core_half_of_the_unit_s() -> None:
    """And a page that the kernel ends does not end the service."""
    text = (DEPLOY / "abbe.service").read_text()
    most = re.search(r"(?m)^MemoryMax=(\d+)G$", text)
    assert most is not None
    assert setup_of(load_machine(DEPLOY / "machine.example.toml")).web.memory_mb <= int(most[1]) * 1024 / 2
    assert re.search(r"(?m)^OOMPolicy=continue$", text)
    assert f"mem_limit: {most[1]}g" in (DEPLOY / "compose.yaml").read_text()


def test_the_broker_starts_with_its_file(tmp_path: Path) -> None:
    config = tmp_path / "mosquitto.conf"
    text = (
        (DEPLOY / "mosquitto.conf")
        .read_text()
        .replace("/mosquitto/data/", f"{tmp_path}/")
        .replace("listener 1883", f"listener {free_port()} 127.0.0.1")
    )
    config.write_text(text + "user root\n")
    with closing(Process(require("mosquitto", "/usr/sbin/mosquitto"), "-c", config)) as broker:
        broker.expect("running")


def test_the_postgres_lock_is_a_part_of_the_other_lock() -> None:
    whole = (ROOT / "requirements-dev.lock").read_text()
    lines = [line for line in (DEPLOY / "requirements-postgres.lock").read_text().splitlines() if line and not line.startswith("#")]
    assert sum(not line.startswith(" ") for line in lines) == 2
    assert [line for line in lines if line.rstrip(" \\") not in whole] == []


def test_containers_stay_on_this_computer() -> None:
    compose = (DEPLOY / "compose.yaml").read_text()
    published = re.findall(r'ports: \["([^"]+)"\]', compose)
    assert len(published) == 2
    assert all(port.startswith("127.0.0.1:") for port in published)
    images = re.findall(r"(?m)^\s*image: (\S+)", compose) + re.findall(r"(?m)^FROM (\S+)", (DEPLOY / "Dockerfile").read_text())
    assert not any("." in image.split("/")[0] for image in images if "/" in image), "a registry's address"
    assert "password" not in re.sub(r"postgres_password|POSTGRES_PASSWORD_FILE|/secrets/\S+", "", compose).lower()


def test_the_image_copies_what_is_here_and_what_the_build_needs() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    copied = [word for line in re.findall(r"(?m)^COPY (?!--from)(.+)$", text) for word in line.split()[:-1]]
    assert [name for name in copied if not (ROOT / name).exists()] == []
    passed = {line[1:] for line in (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines() if line.startswith("!")}
    assert set(copied) == passed
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    parts = {"abbe", *(link.readlink().name for link in (ROOT / "abbe").iterdir() if link.is_symlink())}
    assert parts | {project["readme"], *project["license-files"], "pyproject.toml", "requirements.lock"} <= set(copied)


def test_compose_names_what_it_uses() -> None:
    """Docker itself is not here: what a service needs is declared, and what is declared is used."""
    doc = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    services = doc["services"].values()
    assert {name for one in services for name in one.get("depends_on", {})} <= set(doc["services"])
    assert {name for one in services for name in one.get("secrets", [])} == set(doc["secrets"])
    mounted = {part.partition(":")[0] for one in services for part in one.get("volumes", [])}
    assert {name for name in mounted if not name.startswith(".")} == set(doc["volumes"])
    assert [name for name in mounted if name.startswith("./") and name != "./machine.toml" and not (DEPLOY / name).exists()] == []
    build = doc["services"]["abbe"]["build"]
    assert (DEPLOY / build["context"] / build["dockerfile"]).samefile(DEPLOY / "Dockerfile")


def test_the_rules_are_what_udev_reads() -> None:
    """Keys, operators and quoted values; also those that are to be uncommented."""
    text = (DEPLOY / "99-abbe.rules").read_text()
    rules = [line.lstrip("# ") for line in text.splitlines() if line.lstrip("# ").startswith(("SUBSYSTEM==", "ACTION"))]
    assert len(rules) == 4
    for rule in rules:
        assert re.fullmatch(r'[A-Z]+(\{\w+\})?(==|!=|\+=|=)"[^"]*"(, [A-Z]+(\{\w+\})?(==|!=|\+=|=)"[^"]*")*', rule), rule


def test_the_wheelhouse_refuses_what_it_would_overwrite(tmp_path: Path) -> None:
    """The way itself fetches a hundred megabytes; it is tried by hand."""
    for words, told in (([], "usage: "), ([str(tmp_path)], "exists; give the name of a new folder")):
        done = subprocess.run([DEPLOY / "wheelhouse.sh", *words], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert told in done.stderr
    for name in re.findall(r"deploy/([\w.-]+\.(?:lock|service|toml|rules))", (DEPLOY / "wheelhouse.sh").read_text()):
        assert (DEPLOY / name).is_file()
