"""A plate of balls that lies tilted and turned by any angle is planned, probed and read in its own axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.campaigns.measure import measure
from abbe.service.domain.artefact import ArtefactObject
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.storage.store import Store
from abbe.simulators.artefact.plate import Plate
from abbe.simulators.scenario import ArtefactConfig
from tests.faults.sequencer_world import bench, small

BALLS = ArtefactConfig(kind="ball_plate", columns=2, rows=2, form_um=20.0, drift_um_per_h=0.0, clamping_um=0.0)


async def test_the_form_of_a_tilted_plate_is_read_in_its_own_axes(tmp_path: Path) -> None:
    async with bench(tmp_path, artefact=BALLS) as b:
        b.sim.pace(100.0)
        body = b.sim.world.table.body
        plate = ArtefactObject.read(body.document(0.0004))
        where = {"origin_mm": (300.0, 250.0, 200.0), "rotation_deg": (25.0, -10.0, 200.0), "turned_every": 0}
        made = CampaignPlan("plate", (small("ArtefactTest", plate=plate, **where),))
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            await measure(b.session, store, b.site, made)
            (run,) = from_store(store, "plate").runs
        read = np.column_stack([run.columns.further[f"deviation_{a}_mm"] for a in "xyz"])[:-1]
    left = without_motion(body, read - body.form_mm)
    assert np.abs(left).max() < 0.006, "the rest are the machine's errors over 75 mm"
    assert np.abs(left).max() < 0.25 * np.abs(without_motion(body, body.form_mm)).max()


def without_motion(body: Plate, moved: np.ndarray) -> np.ndarray:
    """Displacements (n, 3) without the best-fit rigid motion."""
    away = body.nominal_mm - body.nominal_mm.mean(axis=0)
    columns = [np.tile(axis, len(away)) for axis in np.eye(3)] + [np.cross(axis, away).ravel() for axis in np.eye(3)]
    basis = np.stack(columns, axis=1)
    return np.asarray(moved.ravel() - basis @ np.linalg.lstsq(basis, moved.ravel(), rcond=None)[0])
