"""Every recipe with each device left out, silent, and of the wrong identity: nothing moves, exit code 2, one line.

The command line runs in this process against simulators in another one, on real sockets and a real pty. What counts is the simulated
controller's own log of what it was told. A silent device takes the connection and never says a word.

Without `check_devices` a silent fixture is found at the first mounting, after the first move.
"""

from __future__ import annotations

import asyncio
import os
import re
import socket
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from abbe.service import cli
from abbe.service.config import load_machine
from abbe.service.domain.progress import ignore_progress
from abbe.service.errors import ConfigError, DevicesNotReady
from abbe.service.jobs.check import run_check
from abbe.service.sequences.recipes.recipe import Helix, Linear
from abbe.service.sequences.recipes.recipe_file import recipe_text
from abbe.service.storage.store import Store
from abbe.simulators.cnc.log import MOTION
from tests.scenarios.conftest import Sims, simulated

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(300)]

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
ROLES = ("cnc", "ballbar", "laser", "fixture")
RECIPES = ("quick-check", "verification", "identification", "own.toml")
OWN = recipe_text(
    "own",
    (
        Linear("line", "L1", "identify", 0, positions=5, at_share=(0.15, 0.15)),
        Helix("helix", "B1", "identify", (300.0, 250.0, 100.0), 100.0),
    ),
)
CASES = [(recipe, role) for k, recipe in enumerate(RECIPES) for n, role in enumerate(ROLES) if LONG or recipe == "quick-check" or k == n]
"""All pairs with ABBE_TEST_LONG=1; every day each device with the quick check, and each recipe with one device."""


@pytest.fixture(scope="module")
def sims(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sims]:
    """One simulated machine for all cases: none of them may move it."""
    folder = tmp_path_factory.mktemp("sims")
    with simulated(folder) as running:
        yield running


def told(sims: Sims) -> list[str]:
    """What the controller was told that starts, feeds or frees a motion, whoever told it."""
    return [kind for _, kind, _, moving in sims.ask("commands")["commands"] if kind in MOTION or (kind == "run" and moving)]


@contextmanager
def silent(role: str) -> Iterator[str]:
    """A device that takes the connection and never answers; gives its URL."""
    if role == "ballbar":
        box, ours = os.openpty()
        tty.setraw(box)
        try:
            yield f"serial://{os.ttyname(ours)}"
        finally:
            os.close(box)
            os.close(ours)
        return
    with socket.create_server(("127.0.0.1", 0)) as listening:
        scheme = "fixture+tcp" if role == "fixture" else "modbus+tcp"
        yield f"{scheme}://127.0.0.1:{listening.getsockname()[1]}"


def wrong(role: str, ready: dict[str, Any]) -> str:
    """Something else answers there: the controller for the laser, the laser for the controller, another box, a controller that mounts."""
    port = re.search(r":(\d+)\?", ready["cnc"])
    assert port is not None
    return {
        "cnc": ready["laser"],
        "laser": ready["cnc"],
        "ballbar": f"{ready['ballbar'].partition('?')[0]}?serial_no=815",
        "fixture": f"fixture+tcp://127.0.0.1:{port[1]}",
    }[role]


def machine_file(sims: Sims, folder: Path, devices: dict[str, str | None]) -> Path:
    """The simulated machine's file with other devices (None: left out)."""
    text = sims.machine_file.read_text()
    for role, url in devices.items():
        line = f'{role} = "{sims.ready[role]}"\n'
        assert line in text
        text = text.replace(line, "" if url is None else f'{role} = "{url}"\n')
    path = folder / "machine.toml"
    path.write_text(text)
    (folder / "own.toml").write_text(OWN)
    return path


Refuses = Callable[..., str]


@pytest.fixture
def refuses(sims: Sims, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Refuses:
    """``refuses(recipe, laser=None)``: measures it with these devices; gives the one line that was said."""
    monkeypatch.chdir(tmp_path)

    def measure(recipe: str, *more: str, **devices: str | None) -> str:
        path = machine_file(sims, tmp_path, devices)
        with pytest.raises(SystemExit) as ended:
            cli.main(["measure", "-m", str(path), "--recipe", recipe, *more])
        err = capsys.readouterr().err
        assert (ended.value.code, told(sims)) == (2, []), err
        assert re.fullmatch(r"error [A-Z]{3}-\d{3}: [^\n]+\n", err), err
        if (tmp_path / "abbe.sqlite3").exists():
            with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
                assert store.campaigns.all() == [], "a campaign that did not begin is none"
        return str(err)

    return measure


@pytest.mark.parametrize(("recipe", "role"), CASES)
def test_a_device_that_is_left_out(recipe: str, role: str, refuses: Refuses) -> None:
    said = refuses(recipe, **{role: None})
    assert f"{role} = ..." in said
    dry = refuses(recipe, "--dry-run", **{role: None})
    assert dry == said, "the dry run says the same, and asks no device"


@pytest.mark.parametrize(("recipe", "role"), CASES)
def test_a_device_that_is_silent(recipe: str, role: str, refuses: Refuses) -> None:
    with silent(role) as url:
        said = refuses(recipe, **{role: url})
    assert url.partition("?")[0] in said


@pytest.mark.parametrize(("recipe", "role"), CASES)
def test_a_device_of_the_wrong_identity(recipe: str, role: str, sims: Sims, refuses: Refuses) -> None:
    url = wrong(role, sims.ready)
    said = refuses(recipe, **{role: url})
    assert url.partition("?")[0] in said


def test_all_that_is_wrong_is_one_line(refuses: Refuses) -> None:
    assert "a ball-bar for test check-helix and a laser for test check-ppp" in refuses("quick-check", ballbar=None, laser=None)
    with silent("ballbar") as box, silent("laser") as laser:
        said = refuses("quick-check", ballbar=box, laser=laser)
    assert said.startswith(f"error {DevicesNotReady.code}: ")
    assert box in said
    assert laser in said


def test_a_console_without_a_person_is_found_before_the_machine_goes_to_the_first_place(
    sims: Sims, tmp_path: Path, refuses: Refuses
) -> None:
    assert "nobody is at the console" in refuses("quick-check", fixture="fixture+console:")
    config = load_machine(machine_file(sims, tmp_path, {"fixture": "fixture+console:"})).machine
    with Store.open(f"sqlite:///{tmp_path / 'night.sqlite3'}") as store, pytest.raises(ConfigError, match="nobody is at the console"):
        asyncio.run(run_check(config, store, "quick-check", ignore_progress))
    assert told(sims) == []
