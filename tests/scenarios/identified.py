"""One identification and one verification of a simulated machine, measured once in a run of the tests for all files that begin there."""

from __future__ import annotations

import asyncio
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from abbe.models.machine import AXES
from abbe.models.paths import DIAGONALS
from abbe.service.campaigns.measure import measure
from abbe.service.config import load_machine
from abbe.service.devices.session import open_session
from abbe.service.domain.progress import ignore_progress
from abbe.service.sequences.control import Watching
from abbe.service.sequences.recipes.campaigns import identification, quick_check
from abbe.service.sequences.recipes.recipe import Diagonal, Linear
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site, site_of
from abbe.service.storage.store import Store
from tests.built_once import once_per_run
from tests.pretended import as_if_commissioned
from tests.scenarios.conftest import simulated

MACHINE = ("--seed", "2", "--boot-id", "20260601")
"""The simulated machine; its controller counts as switched on all the time."""
RATE_HZ = 20
POSITIONS, STEPS = 11, 6
"""Of a line and of a diagonal: every move costs a dozen questions over the wire, and half of the usual ones tell the same smooth errors."""


def copy_identified(factory: pytest.TempPathFactory, folder: Path) -> None:
    """Put the campaigns `june` (identification) and `start` (verification) of `MACHINE` into the database of a folder."""
    made, _ = once_per_run(factory, "identified", _identify)
    shutil.copytree(made, folder, dirs_exist_ok=True, ignore=lambda _, names: [n for n in names if not n.startswith("abbe.sqlite3")])


def _identify(folder: Path) -> None:
    with simulated(folder, *MACHINE, "--speed", "160") as sims:
        loaded = load_machine(sims.machine_file)
        with Store.open(loaded.database_url) as store:
            asyncio.run(_measure(site_of(loaded.machine), store))


async def _measure(site: Site, store: Store) -> None:
    full = identification(site.machine, rate_hz=RATE_HZ, name="june")
    tests = [t for t in full.tests if t.label in ("helix1", "judge-helix1", "helix2", "helix3")]
    tests += [Diagonal(f"step-{d}-XYZ", f"D{d}XYZ", "identify", d, STEPS, "XYZ").plan(site.machine) for d in DIAGONALS]
    tests += [
        Linear(f"line{AXES[a]}{k}", f"L{AXES[a]}{k}", "identify", a, at_share=(at, at), positions=POSITIONS).plan(site.machine)
        for a in range(3)
        for k, at in ((1, 0.15), (2, 0.85))
    ]
    site = replace(site, watching=Watching(unknown_s=5.0))
    async with open_session(site.urls) as session:
        await as_if_commissioned(session.controller, store, site)
        await measure(session, store, site, CampaignPlan("june", tuple(tests)), progress=ignore_progress)
        await measure(session, store, site, quick_check(site.machine, rate_hz=RATE_HZ, name="start"), progress=ignore_progress)
