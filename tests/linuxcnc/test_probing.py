"""A plate probed by a real LinuxCNC: recipe, G38.3, solution, tables, and another pose before and after.

The contact is simulated in the control's servo thread (contact.hal): the stylus is deflected when the drives leave the circle about the
place at which the tool, by a known error of the machine, is in the middle of a hole. The servo period makes each touch coarse: at 2 mm/s
it is two micrometres. Six holes and two poses suffice for this error: scales and squareness.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.drivers.cnc.driver import ModbusController
from abbe.drivers.links.modbus_link import Canary, ModbusLink
from abbe.drivers.links.urls import parse_url
from abbe.models.compensation.tables import quantise
from abbe.models.machine import Machine
from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.campaigns.measure import measure
from abbe.service.compensation.commission_levels import commission_levels
from abbe.service.compensation.proposals import change_of
from abbe.service.devices.session import DeviceUrls, Session
from abbe.service.domain.artefact import ArtefactObject
from abbe.service.domain.machine import machine_doc
from abbe.service.errors import MissedContact
from abbe.service.identification.solve import solve_runs
from abbe.service.sequences.control import Watching
from abbe.service.sequences.recipes.artefact import ArtefactTest
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.verification.verify import pose_figures
from tests.linuxcnc.instance import Instance
from tests.linuxcnc.test_control import bring
from tests.patience import within

HERE = Path(__file__).parent
MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]), np.zeros((3, 3)), np.array([0.0, 0.0, -120.0]))
SCALE_X, SCALE_Y, SQUARE = -90e-6, 60e-6, -40e-6
"""Errors of the machine about (300, 250): some 10 um over the plane; more of them would need more holes, and each takes seconds."""
FEED = 60_000.0
PITCH_MM, COLUMNS, ROWS = 70.0, 3, 2
FORM = 0.005 * np.random.default_rng(3).standard_normal((COLUMNS * ROWS, 2))
POSES = (((150.0, 120.0), 0), ((420.0, 130.0), 1))
CHECK = (((400.0, 265.0), 2),)
"""Inside the part of the plane that the poses have touched: beyond it the tables hold their ends, and a promise is of this part only."""


def nominal() -> np.ndarray:
    return np.array([[i % COLUMNS * PITCH_MM, i // COLUMNS * PITCH_MM] for i in range(COLUMNS * ROWS)])


def plate() -> ArtefactObject:
    ids = [f"{'ABC'[i % COLUMNS]}{i // COLUMNS + 1}" for i in range(COLUMNS * ROWS)]
    features = [
        {"id": name, "nominal_mm": [*map(float, p), 0.0], "sensed": "xy", "radius_mm": 10.0} for name, p in zip(ids, nominal(), strict=True)
    ]
    true = nominal() + FORM
    length = float(np.linalg.norm(true[COLUMNS - 1] - true[0]))
    known = [{"from": "A1", "to": ids[COLUMNS - 1], "length_mm": length, "U_mm": 0.0004, "k": 2}]
    return ArtefactObject.read({"kind": "hole_plate", "features": features, "calibrated_lengths": known})


def stand_mm(holes: np.ndarray) -> np.ndarray:
    """Where the drives stand when the tool is in the middle of each hole: place plus error of the machine is the hole."""
    turn = np.array([[1.0 + SCALE_X, SQUARE], [0.0, 1.0 + SCALE_Y]])
    return np.array([300.0, 250.0]) + (holes - [300.0, 250.0]) @ np.linalg.inv(turn).T


class Hands:
    """A fixture without hands: it only tells contact.hal where the holes are now."""

    name = "hands"

    def __init__(self, machine: Instance, reach_mm: float) -> None:
        self._machine, self._reach_mm = machine, reach_mm

    async def identify(self) -> str:
        return self.name

    async def mount_artefact(self, origin_mm: Any, matrix: Any) -> None:
        turn = np.array(matrix)[:2, :2]
        holes = np.array(origin_mm[:2]) + [0.02, -0.01] + (nominal() + FORM) @ turn.T
        values = {f"hole{k}-{a}.offset": -float(at[i]) for k, at in enumerate(stand_mm(holes)) for i, a in enumerate("xy")}
        await self._set(values | {f"hole{k}-out.in0": self._reach_mm for k in range(len(holes))})

    async def unmount(self) -> None:
        await self._set({f"hole{k}-out.in0": 1000.0 for k in range(COLUMNS * ROWS)})

    async def _set(self, values: dict[str, float]) -> None:
        await asyncio.to_thread(self._machine.halcmd, "-f", text="".join(f"setp {name} {value!r}\n" for name, value in values.items()))

    async def close(self) -> None:
        """Nothing is open."""


@asynccontextmanager
async def patient(machine: Instance) -> AsyncIterator[ModbusController]:
    """A controller whose replies may take long: this story is not about silence, and thousands of replies come from another process."""
    url = parse_url(f"modbus+tcp://127.0.0.1:{machine.port}")
    opened = ModbusController(await ModbusLink.connect(url, timeout_s=within(5.0), canary=Canary()))  # type: ignore[arg-type]
    try:
        await opened.identify()
        yield opened
    finally:
        await opened.close()


@asynccontextmanager
async def probing(machine: Instance, reach_mm: float = 7.0) -> AsyncIterator[tuple[Session, Site]]:
    hands = Hands(machine, reach_mm)
    site = Site(
        "control",
        MACHINE,
        machine_doc("control", MACHINE),
        DeviceUrls(cnc=f"modbus+tcp://127.0.0.1:{machine.port}"),
        watching=Watching(unknown_s=within(20.0)),
        max_feed_mm_min=FEED,
    )
    try:
        async with patient(machine) as cnc:
            yield Session(controller=cnc, ballbar=None, laser=None, fixture=hands), site  # type: ignore[arg-type]
    except Exception as error:
        error.add_note(machine.logs())
        raise
    finally:
        await hands.close()


def poses(name: str, where: Any, role: str) -> CampaignPlan:
    quick = {"search_mm": 0.12, "feed_mm_min": FEED, "touch_feed_mm_min": 120.0, "clear_mm": 5.0, "turned_every": 0, "requalify_every": 3}
    tests = [
        ArtefactTest(
            f"{name}-{k}", f"{name}-{k}", role, "plate", (*at, 200.0), rotation_deg=(0.0, 0.0, 90.0 * turn), plate=plate(), **quick
        )
        for k, (at, turn) in enumerate(where)
    ]
    return CampaignPlan(name, tuple(t.plan(MACHINE) for t in tests))


@pytest.mark.timeout(600)
async def test_a_plate_maps_corrects_and_verifies_the_plane(instances, tmp_path):
    machine = instances()
    (machine.run / "drives.hal").write_text((HERE / "contact.hal").read_text())
    machine.faster(2000, 100_000)
    await machine.start()
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        async with probing(machine) as (session, site):
            await commission_levels(session.controller, store, site)
            await measure(session, store, site, poses("plate", POSES, "identify"))
            await measure(session, store, site, poses("before", CHECK, "holdout"))
            solved = solve_runs(site, from_store(store, "plate").runs, model=None)
            change, promised, _ = change_of(solved)
            await bring(session.controller, store, site, quantise(change, 1e-4))  # type: ignore[arg-type]
            await measure(session, store, site, poses("after", CHECK, "holdout"))
        before, after = (pose_figures(from_store(store, name).runs, solved.joint).worst for name in ("before", "after"))
        rows = (("before", before), ("after", after))
        said = [f"{name} {1e3 * f.value_mm:.2f} ± {2e3 * f.u_mm:.2f}" for name, f in rows]
        figures = f"rms um: {', '.join(said)}, promised {1e3 * promised.after_mm:.2f} ± {2e3 * promised.u_model_mm:.2f}"
        sys.stderr.write(figures + "\n")
        assert before.value_mm > 0.003
        assert after.value_mm < 0.4 * before.value_mm, figures
        assert after.value_mm - promised.after_mm < 2.0 * np.hypot(promised.u_model_mm, after.u_mm), figures


@pytest.mark.timeout(300)
async def test_a_missed_contact_names_its_feature(instances, tmp_path):
    machine = instances()
    (machine.run / "drives.hal").write_text((HERE / "contact.hal").read_text())
    await machine.start()
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        async with probing(machine, reach_mm=9.0) as (session, site):
            with pytest.raises(MissedContact, match="feature A1"):
                await measure(session, store, site, poses("plate", POSES[:1], "identify"))
        (run,) = store.runs.all()
        assert run.reason.startswith("PRB-002")
