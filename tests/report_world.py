"""One report of every kind that people read or sign, over the store of `tests.pages_world`."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
import pytest

from abbe.models.planning.measurements import Instruments
from abbe.service.campaign_data.campaign_folder import Campaign, from_folder, from_store
from abbe.service.campaigns.plan import plan_for, plan_report
from abbe.service.compensation.proposal_diff import compare, diff_report
from abbe.service.compensation.proposal_doc import load
from abbe.service.discovery.discover import prepare
from abbe.service.discovery.simulate import simulate, simulated_finding, verdict_line
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import AxisMaterial, Issuer, Item
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.identification.solve_report import assess, solution_of
from abbe.service.rendering.document import Document
from abbe.service.report.dry_run_page import dry_run_report
from abbe.service.report.report import certified, numbered_report, solution_report, stored_report
from abbe.service.report.report_discovery import simulation_report
from abbe.service.report.report_measured import Measured, SolutionResult, campaign_report, run_report
from abbe.service.report.report_parts import Rules
from abbe.service.site import Site
from abbe.service.storage.store import Store
from tests.artefact_campaign import campaign as artefact_campaign
from tests.pages_world import Filled, solved_campaign
from tests.run_documents import run_of

LABORATORY = Issuer(
    laboratory="Werk Nord", address="Ringstr. 1", city="Bonn", country="DE", person="A. Meier", procedure="VA-17", prefix="CAL-",
    customer="Muster GmbH", customer_address="Talweg 2, Bonn",
)  # fmt: skip
ITEM = Item(maker="Muster", model="M5", serial="4711", place="H3")
RULES = Rules(
    {"body_diagonal_um": 20.0, "helix_rms_um": 5.0},
    {"ballbar": date(2027, 5, 31), "laser": date(2027, 1, 1)},
    (18.0, 22.0),
    {axis: AxisMaterial(11.5e-6, 1e-6, 21.0, 0.2, 0.0, 1e-6) for axis in "XYZ"},
    {"ballbar": "BB-1; K12", "laser": "LX-2; K13"},
)  # fmt: skip
RULES_OF_LABORATORY = replace(RULES, issuer=LABORATORY, item=ITEM)


def iso_campaign(site: Site) -> Campaign:
    """Five cycles of X with temperatures, one of Y without, four body diagonals, a circle both ways: ISO 230-2, 230-6 and 230-4."""
    rng, box = np.random.default_rng(5), {axis: [0.0, 1000.0] for axis in "XYZ"}
    lines = [_laser("lx", "laser_linear", {"axis": "X"}, (1000.0, 0.0, 0.0), 5, rng)]
    lines += [_laser("ly", "laser_linear", {"axis": "Y"}, (0.0, 800.0, 0.0), 1, rng)]
    ends = {name: tuple(900.0 if sign == "p" else -900.0 for sign in name) for name in ("ppp", "npp", "pnp", "ppn")}
    lines += [_laser(f"d{name}", "laser_diagonal", {"diagonal": name}, end, 2, rng) for name, end in ends.items()]
    docs = [*lines, _circle("c1", 1, rng), _circle("c2", -1, rng)]
    return Campaign("norm", site, [run_of(doc | {"machine": site.doc | {"stroke_mm": box}}) for doc in docs], None)


def _laser(run_id: str, test: str, setup: Doc, way: tuple[float, ...], cycles: int, rng: np.random.Generator) -> Doc:
    out, end = np.linspace(0.0, 1.0, 6), np.array(way)
    share = np.tile(np.concatenate([out, out[::-1]]), cycles)
    start = np.where(end < 0.0, -end, 0.0)
    columns = {f"{axis}_mm": (start[k] + share * end[k]).tolist() for k, axis in enumerate("xyz")}
    columns |= {
        "direction": np.tile(np.repeat([1, -1], 6), cycles).tolist(),
        "deviation_mm": (0.02 * share + 1e-3 * rng.standard_normal(share.size)).tolist(),
    }
    columns |= {f"temp_{axis}_C": [22.0] * share.size for axis in ("x", "z", "air") if run_id != "ly"}
    whole = {
        "setup_id": run_id,
        "t_set_s": 0.0,
        "start_mm": start.tolist(),
        "end_mm": (start + end).tolist(),
        "nominal_beam": (end / np.linalg.norm(end)).tolist(),
    }
    return {
        "format": "abbe-run/1",
        "campaign": "norm",
        "run_id": run_id,
        "test": test,
        "role": "identify",
        "setup": whole | setup,
        "columns": columns,
    }


def _circle(run_id: str, sense: int, rng: np.random.Generator) -> Doc:
    angle = sense * np.linspace(0.0, 2.0 * np.pi, 361)
    columns = {
        "x_mm": (500.0 + 100.0 * np.cos(angle)).tolist(),
        "y_mm": (500.0 + 100.0 * np.sin(angle)).tolist(),
        "z_mm": [100.0] * angle.size,
    }
    columns["deviation_mm"] = (4e-3 * np.cos(2.0 * angle) + 3e-4 * rng.standard_normal(angle.size)).tolist()
    setup = {
        "setup_id": "cup",
        "t_set_s": 0.0,
        "centre_mm": [500.0, 500.0, 100.0],
        "radius_mm": 100.0,
        "length_calibrated": False,
        "plane": "XY",
    }
    return {
        "format": "abbe-run/1",
        "campaign": "norm",
        "run_id": run_id,
        "test": "ballbar_circle",
        "role": "identify",
        "setup": setup,
        "columns": columns,
    }


def documents(filled: Filled, factory: pytest.TempPathFactory) -> dict[str, Document]:
    """Reports by a short name: of runs, campaign, checks, pushes and discovery from the store, of a solution, a simulation and a change."""
    with Store.open(filled.url) as store:
        campaign = from_store(store, filled.campaign)
        store.machines.add(filled.machine, campaign.site.doc | {"tool_mm": [0.0, 0.0, 120.0]})  # pushes of the world know only a name
        found = {
            f"run {r.label}": stored_report(store, r, RULES)
            for r in store.runs.all(store.campaigns.find(filled.campaign).id)
            if r.id in {1, 8, 15}
        }
        found |= {"campaign": stored_report(store, store.campaigns.find(filled.campaign), RULES)}
        numbered = (
            ("verification", 1),
            ("verification", 22),
            ("verification", 24),
            ("push", 1),
            ("push", 2),
            ("discovery", filled.discovery),
        )
        found |= {f"{what} {n}": numbered_report(store, what, n, RULES) for what, n in numbered}
        proposal = filled.proposals[-1]
        found["table change"] = diff_report(compare(store, proposal, "ACTIVE"), load(store, proposal))
        solved = assess(solved_campaign(factory, filled.machine)[2])
        result = SolutionResult(solution_of(solved), account=solved)
        found["solution"] = solution_report(store, campaign, result, "2026-11-24T06:00:00+00:00", RULES)
    plate = from_folder(artefact_campaign(factory.mktemp("plate")))
    found["pose"] = run_report(Measured(replace(plate, name="p-1")), plate.runs[1].run_id, RULES)
    planned = plan_for(campaign.site, minutes=7.0, tools=Instruments(bar_lengths_mm=(100.0,)))
    found["plan"] = plan_report(campaign.site, planned)
    found["dry run"] = dry_run_report(filled.machine, campaign.site.machine, planned.campaign, tuple(planned.dry))
    job = prepare(from_folder(Path(filled.url.removeprefix("sqlite:///")).parent / "c1"), catalogue(), None)
    finding = simulated_finding(job, simulate(job))
    found["simulation"] = simulation_report(job, finding, verdict_line(finding), datetime(2026, 11, 24, tzinfo=UTC).isoformat())
    norm = campaign_report(Measured(iso_campaign(campaign.site), {}, days=("2026-11-20", "2026-11-21")), RULES)
    found["norm"] = norm
    found["poor certificate"] = certified(
        norm,
        replace(
            RULES,
            instruments={},
            issuer=Issuer(laboratory="Werk Nord", city="Bonn", country="DE", person="A. Meier", customer="Muster GmbH"),
            item=None,
        ),
        None,
        date(2026, 11, 25),
    )
    found["certificate"] = certified(found["campaign"], RULES_OF_LABORATORY, date(2026, 11, 24), date(2026, 11, 25))
    return found
